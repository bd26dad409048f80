"""The optimisers: LaProp after per-tensor adaptive gradient clipping, and clipped Adam."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import optax

from vawm.config import AdamConfig, LaPropConfig, OptimizerConfig
from vawm.process import dtypes
from vawm.types import Params, PyTree


def adaptive_gradient_clip(clip: float, floor: float) -> optax.GradientTransformation:
    """Scale each gradient tensor down to at most `clip * max(floor, ||parameter||)`.

    Norms are over whole tensors, as in DreamerV3; `optax.adaptive_grad_clip` has one norm per
    output unit. Without `floor`, tensors that start at zero would never move.
    """

    def init(params: Any) -> optax.EmptyState:
        del params
        return optax.EmptyState()

    def update(updates: Any, state: optax.EmptyState, params: Any = None):
        if params is None:
            raise ValueError(
                "adaptive_gradient_clip needs params: update(updates, state, params)"
            )

        def shrink(gradient, param):
            limit = clip * jnp.maximum(floor, _norm(param))
            return gradient / jnp.maximum(1.0, _norm(gradient) / limit)

        return jax.tree.map(shrink, updates, params), state

    return optax.GradientTransformation(init, update)


def laprop(
    learning_rate: optax.ScalarOrSchedule, beta1: float, beta2: float, eps: float
) -> optax.GradientTransformation:
    """LaProp: momentum of normalised gradients (Adam normalises the momentum instead).

        v <- beta2 * v + (1 - beta2) * g^2
        m <- beta1 * m + (1 - beta1) * g / (sqrt(v / (1 - beta2^t)) + eps)
        update = -learning_rate * m / (1 - beta1^t)

    A parameter whose gradient has always been 0 does not move. The first update reads a
    schedule at 0.
    """
    return optax.chain(
        optax.scale_by_rms(beta2, eps=eps, eps_in_sqrt=False, bias_correction=True),
        optax.ema(beta1, debias=True),
        optax.scale_by_learning_rate(learning_rate),
    )


def make_laprop(config: LaPropConfig) -> optax.GradientTransformation:
    """For all parameters: clipping, then LaProp with a warm-up of its learning rate.

    The rate rises linearly: it is 0 in update 0, and full from update `warmup_updates` on.
    """
    rate: optax.ScalarOrSchedule = config.learning_rate
    if config.warmup_updates > 0:
        rate = optax.linear_schedule(0.0, config.learning_rate, config.warmup_updates)
    return optax.chain(
        adaptive_gradient_clip(config.agc, config.agc_floor),
        laprop(rate, config.beta1, config.beta2, config.epsilon),
    )


class Adams(NamedTuple):
    """One optimiser for the world model, one for actor and critic together."""

    world_model: optax.GradientTransformation
    behaviour: optax.GradientTransformation


class AdamStates(NamedTuple):
    """The states of `Adams`."""

    world_model: PyTree
    behaviour: PyTree


Optimizer: TypeAlias = optax.GradientTransformation | Adams


def make_adams(config: AdamConfig) -> Adams:
    """Adam after clipping by the global norm."""

    def adam(learning_rate: float, clip: float, epsilon: float) -> optax.GradientTransformation:
        return optax.chain(
            optax.clip_by_global_norm(clip),
            optax.adam(learning_rate, b1=config.beta1, b2=config.beta2, eps=epsilon),
        )

    return Adams(
        world_model=adam(config.learning_rate, config.clip, config.epsilon),
        behaviour=adam(
            config.behaviour_learning_rate, config.behaviour_clip, config.behaviour_epsilon
        ),
    )


def make_optimizer(config: OptimizerConfig) -> Optimizer:
    """One optimiser for all parameters, or one for the world model and one for the rest."""
    if isinstance(config, LaPropConfig):
        return with_usual_dtypes(make_laprop(config))
    if isinstance(config, AdamConfig):
        return Adams(*map(with_usual_dtypes, make_adams(config)))
    raise TypeError(f"no optimiser for {type(config).__name__}")


def with_usual_dtypes(optimizer: optax.GradientTransformation) -> optax.GradientTransformation:
    """`optimizer` under JAX's usual rules for dtypes, whatever this process has set.

    optax computes bias corrections from its int32 counts and Python's floats: in float64 under
    `jax_enable_x64`, and not at all under `jax_numpy_dtype_promotion=strict`.
    """

    def update(updates: Any, state: Any, params: Any = None):
        with dtypes.usual():
            return optimizer.update(updates, state, params)

    return optax.GradientTransformation(optimizer.init, update)


def init_optimizer(optimizer: Optimizer, params: Params) -> PyTree:
    """The state of `optimizer` before the first update."""
    if isinstance(optimizer, Adams):
        behaviour = params.actor, params.critic
        return AdamStates(
            world_model=optimizer.world_model.init(params.world_model),
            behaviour=optimizer.behaviour.init(behaviour),
        )
    return optimizer.init(params)


def _norm(x: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(jnp.square(x)))
