"""One update of everything that is learned, from one batch.

DreamerV3 follows one gradient of one summed loss, with one optimiser. STORM first updates its
world model, then actor and critic in the updated world model, each with an optimiser of its
own. Both use the losses of `vawm.learning.objective`, whose six steps are numbered here too.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import optax

from vawm.agent import Agent
from vawm.config import Config
from vawm.learning import optim
from vawm.learning.objective import make_behaviour_loss, make_world_model_loss
from vawm.learning.state import Learner, advance
from vawm.types import Array, Batch, Key, Metrics, Params, PyTree

Update = Callable[[Learner, Batch, PyTree, Key, Array], tuple[Learner, PyTree, Metrics]]


def make_update(agent: Agent, config: Config) -> Update:
    """Build `update(learner, batch, contexts, key, env_steps) -> (learner, latent, metrics)`.

    `contexts` are a `Batch` if imagination starts after contexts, else `()`. The returned
    latent is what replay keeps beside steps 1..T of the batch, if anything. `env_steps` is only
    used by the warm-up of value alignment.
    """
    optimizer = optim.make_optimizer(config.optimizer)
    if isinstance(optimizer, optim.Adams):
        return make_update_in_turn(agent, config, optimizer)
    return make_joint_update(agent, config, optimizer)


def make_joint_update(
    agent: Agent, config: Config, optimizer: optax.GradientTransformation
) -> Update:
    """World model, actor and critic together: one summed loss, one gradient, one step."""
    world_model_loss = make_world_model_loss(agent, config)
    behaviour_loss = make_behaviour_loss(agent, config)

    def summed_loss(params: Params, learner: Learner, batch, contexts, key, env_steps):
        key_model, key_behaviour = jax.random.split(key)
        # 1 to 3: the world model.
        model_loss, explained = world_model_loss(params, learner, batch, key_model, env_steps)
        # 4 to 6: actor and critic, in the same world model.
        learner = learner._replace(model_state=explained.model_state)
        inference = explained.inference
        agent_loss, behaved = behaviour_loss(
            params, learner, batch, inference, contexts, key_behaviour
        )
        return model_loss + agent_loss, (explained, behaved)

    def update(
        learner: Learner, batch: Batch, contexts: PyTree, key: Key, env_steps: Array
    ) -> tuple[Learner, PyTree, Metrics]:
        differentiate = jax.value_and_grad(summed_loss, has_aux=True)
        (loss, (explained, behaved)), gradient = differentiate(
            learner.params, learner, batch, contexts, key, env_steps
        )
        updates, opt_state = optimizer.update(gradient, learner.opt_state, learner.params)
        after = advance(
            learner,
            config,
            params=optax.apply_updates(learner.params, updates),
            model_state=explained.model_state,
            opt_state=opt_state,
            return_scale=behaved.return_scale,
        )
        metrics = explained.metrics | behaved.metrics | {"loss/total": loss}
        metrics |= norms("optimizer", gradient, updates)
        return after, agent.world_model.memory(explained.inference.latent), metrics

    return update


def make_update_in_turn(agent: Agent, config: Config, optimizers: optim.Adams) -> Update:
    """A step of the world model; then imagination in it, and a step of actor and critic."""
    world_model_loss = make_world_model_loss(agent, config)
    behaviour_loss = make_behaviour_loss(agent, config)

    def update(
        learner: Learner, batch: Batch, contexts: PyTree, key: Key, env_steps: Array
    ) -> tuple[Learner, PyTree, Metrics]:
        key_model, key_behaviour = jax.random.split(key)

        # 1 to 3: the world model.
        def model_loss(world_model: PyTree):
            params = learner.params._replace(world_model=world_model)
            return world_model_loss(params, learner, batch, key_model, env_steps)

        (loss_of_model, explained), gradient = jax.value_and_grad(model_loss, has_aux=True)(
            learner.params.world_model
        )
        updates, model_opt = optimizers.world_model.update(
            gradient, learner.opt_state.world_model
        )
        world_model = optax.apply_updates(learner.params.world_model, updates)
        metrics = explained.metrics | norms("optimizer", gradient, updates)

        # 4 to 6: actor and critic, in the updated world model.
        inference = jax.lax.stop_gradient(explained.inference)
        between = learner._replace(
            params=learner.params._replace(world_model=world_model),
            model_state=explained.model_state,
        )

        def agent_loss(behaviour: tuple[PyTree, PyTree]):
            params = Params(world_model, *behaviour)
            return behaviour_loss(params, between, batch, inference, contexts, key_behaviour)

        behaviour = learner.params.actor, learner.params.critic
        (loss_of_agent, behaved), gradient = jax.value_and_grad(agent_loss, has_aux=True)(
            behaviour
        )
        updates, behaviour_opt = optimizers.behaviour.update(
            gradient, learner.opt_state.behaviour
        )
        after = advance(
            learner,
            config,
            params=Params(world_model, *optax.apply_updates(behaviour, updates)),
            model_state=explained.model_state,
            opt_state=optim.AdamStates(model_opt, behaviour_opt),
            return_scale=behaved.return_scale,
        )
        metrics |= behaved.metrics | norms("optimizer/behaviour", gradient, updates)
        metrics |= {"loss/total": loss_of_model + loss_of_agent}
        return after, agent.world_model.memory(inference.latent), metrics

    return update


def norms(name: str, gradient: PyTree, updates: PyTree) -> Metrics:
    """Norms of a gradient and of the step that an optimiser makes of it."""
    return {
        f"{name}/gradient_norm": optax.tree.norm(gradient),
        f"{name}/update_norm": optax.tree.norm(updates),
    }
