"""Imagined trajectories against the truth, Figs 3 and 7.

After an observed context, the world model follows the recorded actions open loop, without
further observations; its decoder predicts them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from vawm.agent import make_agent
from vawm.agent.open_loop import make_open_loop
from vawm.analysis import inference
from vawm.analysis.episodes import Episodes, windows
from vawm.losses.transforms import symlog
from vawm.policy import Policy
from vawm.runs.reports import video
from vawm.types import Batch, Key, Params, PyTree, is_image


class Trajectories(NamedTuple):
    """R windows of T steps, `context` of them observed; numpy.

    Attributes:
      start: `[R]` the step of the episode at which each window starts.
      truth: observations, `[R, T, ...]`.
      predicted: the decoder's output: symlog for vectors, [0, 1] for images.
      inside: `[R, T]` bool, whether the step is inside the episode.
      context: number of observed steps.
    """

    start: np.ndarray
    truth: PyTree
    predicted: PyTree
    inside: np.ndarray
    context: int


def imagine(
    policy: Policy,
    episodes: Episodes,
    *,
    context: int,
    depth: int,
    seed: int,
    at_most: int = 4,
) -> Trajectories:
    """Imagines windows of `context + depth` steps, one in each of the first `at_most` episodes.

    `seed` draws the position of a window among those where it fits; in a shorter episode it
    starts at the first step. The step before the window only gives context, as in every
    `Batch`.

    Raises:
      InvalidInput: an impossible depth or context, see `inference.check`.
    """
    inference.check(policy.config, context=context, depth=depth)
    agent = make_agent(policy.config, policy.spec)
    start, batch = draw(episodes, length=context + depth + 1, seed=seed, at_most=at_most)
    length = np.asarray(episodes.length)[:at_most]
    open_loop = make_open_loop(agent, context=context)

    @jax.jit
    def predict(params: Params, model_state: PyTree, key: Key, batch: Batch) -> PyTree:
        return inference.reconstruction(open_loop(params, model_state, key, batch).predicted)

    predicted = predict(policy.params, policy.model_state, jax.random.key(seed), batch)
    time = start[:, None] + np.arange(1, context + depth + 1)
    return Trajectories(
        start=start + 1,
        truth=jax.device_get(jax.tree.map(lambda x: x[:, 1:], batch.trajectory.obs)),
        predicted=jax.device_get(predicted),
        inside=time < length[:, None],
        context=context,
    )


def draw(
    episodes: Episodes, *, length: int, seed: int, at_most: int
) -> tuple[np.ndarray, Batch]:
    """Draws a window of `length` steps from each episode; returns their starts and them."""
    room = np.maximum(np.asarray(episodes.length)[:at_most] - length, 0)
    start = np.random.default_rng(seed).integers(room + 1)
    return start, windows(episodes, np.arange(len(start)), start, length=length)


def errors(trajectories: Trajectories) -> dict[str, np.ndarray]:
    """Mean squared error by step, `[T]`, of "image" and "vector", if there are any.

    In the decoder's units, over pixels or coordinates of the windows that are still inside
    their episode; NaN if none is.
    """
    kinds: dict[str, list[np.ndarray]] = {}
    pairs = zip(
        jax.tree.leaves(trajectories.truth),
        jax.tree.leaves(trajectories.predicted),
        strict=True,
    )
    for truth, guess in pairs:
        target = truth / 255.0 if is_image(truth) else np.asarray(symlog(truth))
        square = np.square(np.asarray(guess, np.float64) - target)
        kind = "image" if is_image(truth) else "vector"
        kinds.setdefault(kind, []).append(square.reshape(*square.shape[:2], -1))
    inside = trajectories.inside
    result = {}
    for kind, squares in kinds.items():
        error = np.concatenate(squares, -1).mean(-1)
        count = inside.sum(0)
        total = np.where(inside, error, 0.0).sum(0)
        result[kind] = np.divide(
            total, count, out=np.full(total.shape, np.nan), where=count > 0
        )
    return result


def rows(name: str, trajectories: Trajectories) -> list[dict[str, Any]]:
    """Rows for a CSV, one per step; observed steps have a depth of 0 or less."""
    return [
        {
            "run": name,
            "kind": kind,
            "depth": t + 1 - trajectories.context,
            "squared_error": float(error[t]),
            "windows": int(trajectories.inside[:, t].sum()),
        }
        for kind, error in errors(trajectories).items()
        for t in range(len(error))
    ]


def film(trajectories: Trajectories) -> np.ndarray:
    """Frames `[T, H, W, 3]` uint8: truth, imagination and difference, one above the other.

    Windows are side by side; the border is that of `video.open_loop_video`.
    """
    shown = video.open_loop_video(
        trajectories.truth,
        trajectories.predicted,
        trajectories.inside,
        context=trajectories.context,
    )
    return shown.frames


def vectors(trajectories: Trajectories) -> tuple[np.ndarray, np.ndarray]:
    """Truth and prediction of all coordinates in symlog, both `[R, T, D]`."""
    pairs = [
        (np.asarray(symlog(truth)), np.asarray(guess))
        for truth, guess in zip(
            jax.tree.leaves(trajectories.truth),
            jax.tree.leaves(trajectories.predicted),
            strict=True,
        )
        if not is_image(truth)
    ]
    truths, guesses = zip(*pairs, strict=True)
    return np.concatenate(truths, -1), np.concatenate(guesses, -1)
