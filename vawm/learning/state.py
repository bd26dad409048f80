"""Everything that learning changes, and the step from one update to the next."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from vawm.agent import Agent
from vawm.config import Config
from vawm.learning import optim
from vawm.losses import returns
from vawm.types import Array, Key, Params, PyTree


class Learner(NamedTuple):
    """Everything that updates change."""

    step: Array  # [] int32, updates done
    params: Params
    model_state: PyTree  # what the world model carries beside its parameters
    slow_critic: PyTree  # parameters of the critic's moving average
    opt_state: PyTree
    return_scale: returns.ReturnScale


def init_learner(agent: Agent, config: Config, key: Key) -> Learner:
    """Fresh parameters; the slow critic starts as an exact copy of the critic."""
    params, model_state = agent.init(key)
    optimizer = optim.make_optimizer(config.optimizer)
    return Learner(
        step=jnp.zeros((), jnp.int32),
        params=params,
        model_state=model_state,
        slow_critic=jax.tree.map(jnp.copy, params.critic),
        opt_state=optim.init_optimizer(optimizer, params),
        return_scale=returns.init_return_scale(),
    )


def advance(
    learner: Learner,
    config: Config,
    *,
    params: Params,
    model_state: PyTree,
    opt_state: PyTree,
    return_scale: returns.ReturnScale,
) -> Learner:
    """The learner one update later; the slow critic moves towards the new critic."""
    rate = config.critic.slow_rate
    return Learner(
        step=learner.step + 1,
        params=params,
        model_state=model_state,
        slow_critic=optax.incremental_update(params.critic, learner.slow_critic, rate),
        opt_state=opt_state,
        return_scale=return_scale,
    )
