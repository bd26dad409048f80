"""One update of everything that is learned, from one batch.

DreamerV3 follows one gradient of one summed loss, with one optimiser. STORM first updates its
world model, then actor and critic in what the world model has become, each with an optimiser of
its own. The losses are the same, those of `vawm.learning.objective`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from vawm.agent import Agent
from vawm.config import AdamConfig, Config, LaPropConfig
from vawm.learning import optim
from vawm.learning.objective import make_behaviour_loss, make_world_model_loss
from vawm.losses import returns
from vawm.types import Array, Batch, Key, Metrics, Params, PyTree


class Learner(NamedTuple):
    """Everything that updates change."""

    step: Array  # [] int32, updates done
    params: Params
    model_state: PyTree  # what the world model carries beside its parameters
    slow_critic: PyTree
    opt_state: PyTree
    return_scale: returns.ReturnScale


Update = Callable[[Learner, Batch, PyTree, Key, Array], tuple[Learner, PyTree, Metrics]]


def init_learner(agent: Agent, config: Config, key: Key) -> Learner:
    """Fresh parameters; the slow critic starts as an exact copy of the critic."""
    params, model_state = agent.init(key)
    return Learner(
        step=jnp.zeros((), jnp.int32),
        params=params,
        model_state=model_state,
        slow_critic=jax.tree.map(jnp.copy, params.critic),
        opt_state=init_optimizer(config, params),
        return_scale=returns.init_return_scale(),
    )


def init_optimizer(config: Config, params: Params) -> PyTree:
    """The optimisers' state before the first update."""
    if isinstance(config.optimizer, AdamConfig):
        adams = optim.make_adams(config.optimizer)
        behaviour = adams.behaviour.init((params.actor, params.critic))
        return optim.Adams(adams.world_model.init(params.world_model), behaviour)
    assert isinstance(config.optimizer, LaPropConfig)
    return optim.make_laprop(config.optimizer).init(params)


def make_update(agent: Agent, config: Config) -> Update:
    """Build `update(learner, batch, contexts, key, env_steps) -> (learner, latent, metrics)`.

    `contexts` are a `Batch` where imagination begins after them, else `()`. The returned latent
    is what replay keeps beside the batch's steps 1..T, if anything. `env_steps` only gates
    value alignment.
    """
    if isinstance(config.optimizer, AdamConfig):
        return make_update_in_turn(agent, config, optim.make_adams(config.optimizer))
    assert isinstance(config.optimizer, LaPropConfig)
    return make_joint_update(agent, config, optim.make_laprop(config.optimizer))


def make_joint_update(
    agent: Agent, config: Config, optimizer: optax.GradientTransformation
) -> Update:
    """One gradient of one summed loss for world model, actor and critic, one step, one EMA."""
    world_model_loss = make_world_model_loss(agent, config)
    behaviour_loss = make_behaviour_loss(agent, config)

    def loss_fn(params: Params, learner: Learner, batch, contexts, key: Key, env_steps: Array):
        key_model, key_behaviour = jax.random.split(key)
        slow_critic = learner.slow_critic
        model_loss, (inference, state, model_metrics) = world_model_loss(
            params,
            learner.model_state,
            slow_critic,
            batch,
            key_model,
            warmup_step(config, learner, env_steps),
        )
        agent_loss, (return_scale, agent_metrics) = behaviour_loss(
            params,
            state,
            slow_critic,
            learner.return_scale,
            batch,
            inference,
            contexts,
            key_behaviour,
        )
        total = model_loss + agent_loss
        metrics = model_metrics | agent_metrics | {"loss/total": total}
        return total, (inference.latent, state, return_scale, metrics)

    def update(
        learner: Learner, batch: Batch, contexts: PyTree, key: Key, env_steps: Array
    ) -> tuple[Learner, PyTree, Metrics]:
        gradient, (latent, state, return_scale, metrics) = jax.grad(loss_fn, has_aux=True)(
            learner.params, learner, batch, contexts, key, env_steps
        )
        updates, opt_state = optimizer.update(gradient, learner.opt_state, learner.params)
        metrics |= norms("optimizer", gradient, updates)
        learner = advance(
            learner,
            config,
            params=optax.apply_updates(learner.params, updates),
            model_state=state,
            opt_state=opt_state,
            return_scale=return_scale,
        )
        return learner, agent.world_model.memory(latent), metrics

    return update


def make_update_in_turn(agent: Agent, config: Config, optimizers: optim.Adams) -> Update:
    """The world model's step; then imagination in it, and one step of actor and critic."""
    world_model_loss = make_world_model_loss(agent, config)
    behaviour_loss = make_behaviour_loss(agent, config)

    def update(
        learner: Learner, batch: Batch, contexts: PyTree, key: Key, env_steps: Array
    ) -> tuple[Learner, PyTree, Metrics]:
        key_model, key_behaviour = jax.random.split(key)
        before, opt_state, slow_critic = learner.params, learner.opt_state, learner.slow_critic
        step = warmup_step(config, learner, env_steps)

        def model_loss(world_model: PyTree):
            params = before._replace(world_model=world_model)
            state = learner.model_state
            return world_model_loss(params, state, slow_critic, batch, key_model, step)

        (loss, (inference, state, metrics)), gradient = jax.value_and_grad(
            model_loss, has_aux=True
        )(before.world_model)
        updates, model_opt = optimizers.world_model.update(gradient, opt_state.world_model)
        world_model = optax.apply_updates(before.world_model, updates)
        metrics |= norms("optimizer", gradient, updates) | {"loss/total": loss}
        inference = jax.lax.stop_gradient(inference)

        def agent_loss(behaviour: tuple[PyTree, PyTree]):
            params, scale = Params(world_model, *behaviour), learner.return_scale
            start = inference, contexts, key_behaviour
            return behaviour_loss(params, state, slow_critic, scale, batch, *start)

        behaviour = before.actor, before.critic
        (loss, (return_scale, agent_metrics)), gradient = jax.value_and_grad(
            agent_loss, has_aux=True
        )(behaviour)
        updates, behaviour_opt = optimizers.behaviour.update(gradient, opt_state.behaviour)
        metrics |= agent_metrics | norms("optimizer/behaviour", gradient, updates)
        metrics["loss/total"] += loss
        learner = advance(
            learner,
            config,
            params=Params(world_model, *optax.apply_updates(behaviour, updates)),
            model_state=state,
            opt_state=optim.Adams(model_opt, behaviour_opt),
            return_scale=return_scale,
        )
        return learner, agent.world_model.memory(inference.latent), metrics

    return update


def warmup_step(config: Config, learner: Learner, env_steps: Array) -> Array:
    """The step that value alignment's warm-up counts."""
    return env_steps if config.value_alignment.warmup_unit == "env_steps" else learner.step


def norms(name: str, gradient: PyTree, updates: PyTree) -> Metrics:
    return {
        f"{name}/gradient_norm": optax.tree.norm(gradient),
        f"{name}/update_norm": optax.tree.norm(updates),
    }


def advance(
    learner: Learner,
    config: Config,
    *,
    params: Params,
    model_state: PyTree,
    opt_state: PyTree,
    return_scale: returns.ReturnScale,
) -> Learner:
    """The learner one update later; the slow critic follows the critic."""
    rate = config.critic.slow_rate
    return Learner(
        step=learner.step + 1,
        params=params,
        model_state=model_state,
        slow_critic=optax.incremental_update(params.critic, learner.slow_critic, rate),
        opt_state=opt_state,
        return_scale=return_scale,
    )
