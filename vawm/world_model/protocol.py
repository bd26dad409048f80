"""What a world model is: six pure functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from vawm.types import Array, Inference, Key, Latent, Predictions, PyTree, Trajectory


class WorldModel(NamedTuple):
    """Pure functions of a latent world model; every one can be jitted and vmapped.

    Attributes:
      init: `(key) -> params`.
      initial: `(batch_size) -> carry`, the state before the first observation.
      observe: `(params, key, carry, obs, prev_action, is_first, *, train)
        -> (carry, Inference)`, filtering of `[B, T, ...]`; `prev_action[:, t]` is
        a_{t-1}. State and previous action are cleared where `is_first`.
      starts: `(params, key, trajectory, inference) -> (imagine_carry, Latent)`, the N
        latents at which imagination begins, batch-major, gradients stopped.
      imagine: `(params, key, imagine_carry, action) -> (imagine_carry, Latent)`, one step
        with the prior.
      predict: `(params, latent) -> Predictions`, any leading dims.
    """

    init: Callable[[Key], PyTree]
    initial: Callable[[int], PyTree]
    observe: Callable[..., tuple[PyTree, Inference]]
    starts: Callable[[PyTree, Key, Trajectory, Inference], tuple[PyTree, Latent]]
    imagine: Callable[[PyTree, Key, PyTree, Array], tuple[PyTree, Latent]]
    predict: Callable[[PyTree, Latent], Predictions]
