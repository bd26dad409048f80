"""What a world model is: nine pure functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from vawm.types import Array, Batch, Explanation, Inference, Key, Latent, Predictions, PyTree

Imagination = tuple[PyTree, Latent]
"""The state of imagination: what `imagine` carries, and the latents that it has reached."""


class WorldModel(NamedTuple):
    """Pure functions of a latent world model; each of them can be jitted and vmapped.

    All but the first three take `params`, which are learned by gradient, and `model_state`,
    which updates carry along, such as running statistics; `()` if there are none.

    Attributes:
      init: `(key) -> (params, model_state)`.
      initial: `(batch_size) -> carry`, what is remembered before the first observation.
      memory: `(carry) -> PyTree`, what replay keeps beside every step; `()` for nothing.
        `explain` and `follow` start a sequence with it: it is the context of a `Batch`. Also
        called with the latents of an `Inference`, to store what was inferred.
      filter: `(params, model_state, key, carry, obs, prev_action, is_first)
        -> (carry, Latent)`, one step of acting, `[N, ...]`: the latent that the policy reads.
        `prev_action` led to `obs`; where `is_first` it belongs to no episode.
      explain: `(params, model_state, key, batch) -> (Explanation, model_state)`, in training.
      starts: `(params, model_state, inference) -> Imagination` from every inferred state,
        N = B * T, batch-major, gradients stopped; None if a model cannot start there.
      follow: `(params, model_state, key, batch, *, horizon) -> (Latent, Imagination)`: the
        states inferred at steps 1..T, `[B, T, ...]`, and the state predicted after the last
        action, `[B, ...]`, from which `horizon` further steps can be imagined.
      imagine: `(params, model_state, key, carry, action) -> Imagination`, one step of the
        prior.
      predict: `(params, model_state, latent) -> Predictions`, any leading dims.
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
