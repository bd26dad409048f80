"""The data of the package: every array lives in one of these NamedTuples.

One convention of time holds everywhere. Everything at index t *arrived with* observation o_t;
the action a_t leaves from it:

    index            t                          t + 1
    arrives      o_t, r_t, flags_t   ->     o_{t+1}, r_{t+1}, flags_{t+1}
    leaves              a_t  ----------------^
    latent       s_t = (h_t, z_t)           h_{t+1} = f(h_t, z_t, a_t)

So r_{t+1} is the reward *of* a_t, and the reward head predicts it from s_{t+1}.
Shapes are `[B, T, ...]` for experience (replay order) and `[H, N, ...]` for imagination
(scan order). Actions are float arrays `[..., action_size]`; discrete ones are one-hot.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

Array = jax.Array
Key = jax.Array
PyTree = Any
Metrics = dict[str, jax.Array]
ArraySpec = jax.ShapeDtypeStruct


IMAGE_SIZES = range(48, 257, 16)
"""Sizes of the images that the CNNs read: halved four times, they are 3 to 16 pixels wide."""


def vector(size: int) -> ArraySpec:
    """An observation of `size` float32 numbers."""
    return ArraySpec((size,), jnp.float32)


def image(size: int, channels: int = 3) -> ArraySpec:
    """An observation of `size` x `size` pixels, channels last, uint8."""
    return ArraySpec((size, size, channels), jnp.uint8)


def is_image(obs: Any) -> bool:
    """Whether an array or `ArraySpec` holds pixels: it does if it is uint8."""
    return obs.dtype == jnp.uint8


class Made(NamedTuple):
    """How the environments of a run were made, so that commands can make the same again.

    Attributes:
      by: the name of a suite, whose environments can be made again; or "object", a function, a
        class or an object of the caller's.
      name: the task or registered id; of an object its qualified name.
      options: what was chosen beside it, such as a time limit; values that JSON has.
      kwargs: keyword arguments of the environment itself; values that JSON has.
      opaque: other keyword arguments -> their `repr`. They cannot be made again.
      registered: what a registered id stood for: its entry point, keyword arguments and
        wrappers.
    """

    by: str
    name: str
    options: dict[str, Any] = {}  # noqa: RUF012 - never mutated
    kwargs: dict[str, Any] = {}  # noqa: RUF012
    opaque: dict[str, str] = {}  # noqa: RUF012
    registered: dict[str, Any] = {}  # noqa: RUF012


class EnvSpec(NamedTuple):
    """What an agent must know about an environment; all static.

    Attributes:
      task: name of the task, such as "walker_walk".
      obs: an `ArraySpec`, or a dict of them, of one observation without batch: float32
        vectors `[D]`, uint8 images `[size, size, channels]`.
      action_size: width of the action vector, or number of discrete actions.
      discrete: whether actions are one-hot choices.
      num_envs: N, environments that are stepped together.
      action_repeat: control steps per call of `step`.
      episode_length: calls of `step` in a full episode; None if it varies.
      made: how they were made; the runner fills it in. None in runs of earlier versions.
      native: a `vawm.envs.host.native.Native`, how the observations and actions of the
        environment itself become these; None where they are these, as in DMC and Atari.
    """

    task: str
    obs: PyTree
    action_size: int
    discrete: bool
    num_envs: int
    action_repeat: int
    episode_length: int | None
    made: Made | None = None
    native: Any = None


class TimeStep(NamedTuple):
    """What arrives with o_t, for N environments.

    `is_last` marks the end of an episode for any reason, `is_terminal` only an end of the
    return itself (no bootstrap). The step after `is_last` is a reset: the action before it is
    ignored, its reward is 0 and it has `is_first`.
    """

    obs: PyTree  # [N, ...] as EnvSpec.obs says
    reward: Array  # [N] float32
    is_first: Array  # [N] bool
    is_last: Array  # [N] bool
    is_terminal: Array  # [N] bool


class Trajectory(NamedTuple):
    """Each `TimeStep` with the raw action that left from it, `[B, T, ...]`."""

    obs: PyTree
    reward: Array
    is_first: Array
    is_last: Array
    is_terminal: Array
    action: Array  # [B, T, action_size], as sampled, before any clipping


class Latent(NamedTuple):
    """s_t = (h_t, z_t)."""

    deter: Array  # [..., D]
    stoch: Array  # [..., S, K] one-hot, straight-through; deterministic models: probabilities


def flat_stoch(stoch: Array) -> Array:
    """z as one vector: `[..., S, K]` -> `[..., S * K]`."""
    return stoch.reshape(*stoch.shape[:-2], -1)


def features(latent: Latent) -> tuple[Array, Array]:
    """[h, z] as the two inputs of a network: `[..., D]` and `[..., S * K]`."""
    return latent.deter, flat_stoch(latent.stoch)


class Inference(NamedTuple):
    """States that a world model has both inferred and predicted, `[B, T, ...]`.

    `latent` and `prior_latent` have the same h_t. Their z_t come from the posterior and from
    the prior. Logits are before unimix.
    """

    latent: Latent
    prior_latent: Latent
    post_logits: Array  # [B, T, S, K]
    prior_logits: Array  # [B, T, S, K]


class Imagined(NamedTuple):
    """A rollout in imagination: `latent[k + 1]` follows `action[k]` at `latent[k]`."""

    latent: Latent  # [H + 1, N, ...]
    action: Array  # [H, N, action_size]


class Predictions(NamedTuple):
    """What the heads predict from a latent, any leading dims.

    A world model without a decoder predicts `()` as `obs`.
    """

    obs: PyTree  # as EnvSpec.obs: symlog units for vectors, [0, 1] for images
    reward: Array  # [..., bins] logits of the two-hot code
    cont: Array  # [...] logit of P(not terminal), or of the discount times it


class Targets(NamedTuple):
    """What arrived: the truth for `Predictions`, entry by entry."""

    obs: PyTree
    reward: Array
    is_terminal: Array


class Explanation(NamedTuple):
    """How a world model explains a batch.

    `predictions` and `targets` agree entry by entry. The world model chooses which steps each
    of their fields covers; they may differ from the steps of `inference`.

    Attributes:
      inference: the states that it inferred and predicted.
      predictions: what its heads predict.
      targets: what they should predict.
      losses: further losses of this world model by name, `[B, T]` or scalar, with their
        scales. They are added to the loss and logged as `loss/<name>`.
    """

    inference: Inference
    predictions: Predictions
    targets: Targets
    losses: dict[str, Array] = {}  # noqa: RUF012


class Batch(NamedTuple):
    """Sequences of experience: T + 1 steps, the first of which only gives context.

    What the context is depends on the world model: the latent that was stored beside the first
    step, or the step itself.
    """

    trajectory: Trajectory  # [B, T + 1, ...]
    context: PyTree  # [B, ...] what replay keeps beside step 0; () for nothing


class Params(NamedTuple):
    """Everything that is learned by gradient."""

    world_model: PyTree
    actor: PyTree
    critic: PyTree
