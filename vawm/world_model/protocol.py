"""What a world model is: pure functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from vawm.types import Array, Batch, Explanation, Inference, Key, Latent, Predictions, PyTree

Imagination = tuple[PyTree, Latent]
"""Where imagination stands: what `imagine` carries, and the latents reached."""


class WorldModel(NamedTuple):
    """Pure functions of a latent world model; every one can be jitted and vmapped.

    All but the first three take `params`, learned by gradient, and `state`, which is carried
    from update to update (running statistics of normalisation; `()` where there are none).

    Attributes:
      init: `(key) -> (params, state)`.
      initial: `(batch_size) -> carry`, what is remembered before the first observation.
      memory: `(carry) -> PyTree`, what replay keeps beside every step, from which `explain`
        and `follow` begin a sequence: the context of a `Batch`; `()` for nothing. Also of the
        latents of an `Inference`.
      filter: `(params, state, key, carry, obs, prev_action, is_first) -> (carry, Latent)`, one
        step of acting, `[N, ...]`: the latent that the policy reads. `prev_action` led to
        `obs`; where `is_first` it is of no episode.
      explain: `(params, state, key, batch) -> (Explanation, state)`, in training mode.
      starts: `(params, state, inference) -> Imagination`, from every state inferred, N = B * T,
        batch-major, gradients stopped; None where a model cannot.
      follow: `(params, state, key, batch, *, horizon) -> (Latent, Imagination)`: the states
        inferred at steps 1..T, `[B, T, ...]`, and the state expected after the last action,
        `[B, ...]`, from which `horizon` further steps can be imagined.
      imagine: `(params, state, key, carry, action) -> Imagination`, one step with the prior.
      predict: `(params, state, latent) -> Predictions`, any leading dims.
    """

    init: Callable[[Key], tuple[PyTree, PyTree]]
    initial: Callable[[int], PyTree]
    memory: Callable[[PyTree], PyTree]
    filter: Callable[..., tuple[PyTree, Latent]]
    explain: Callable[[PyTree, PyTree, Key, Batch], tuple[Explanation, PyTree]]
    starts: Callable[[PyTree, PyTree, Inference], Imagination] | None
    follow: Callable[..., tuple[Latent, Imagination]]
    imagine: Callable[[PyTree, PyTree, Key, PyTree, Array], Imagination]
    predict: Callable[[PyTree, PyTree, Latent], Predictions]
