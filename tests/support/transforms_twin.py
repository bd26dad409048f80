"""Two-hot codes and log-softmax, written simply and slowly, in float64."""

import numpy as np


def slow_two_hot(y, bins):
    """The two-hot code of each target: a float64 row, found by search."""
    bins = np.asarray(bins, np.float64)
    rows = np.zeros((len(y), len(bins)))
    for row, value in zip(rows, np.asarray(y, np.float64), strict=True):
        value = np.clip(value, bins[0], bins[-1])
        below = max(np.flatnonzero(bins <= value))
        if bins[below] == value:
            row[below] = 1.0
        else:
            share = (value - bins[below]) / (bins[below + 1] - bins[below])
            row[below], row[below + 1] = 1 - share, share
    return rows


def slow_log_softmax(logits):
    logits = np.asarray(logits, np.float64)
    shifted = logits - logits.max(-1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(-1, keepdims=True))
