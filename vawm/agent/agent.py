"""An agent: a world model, an actor and a critic, and how it acts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from vawm.agent import registry
from vawm.agent.actor_critic import Actor, Critic, make_actor, make_critic
from vawm.config import Config
from vawm.types import Array, EnvSpec, Inference, Key, Latent, Params, PyTree, TimeStep
from vawm.world_model.protocol import WorldModel


class PolicyCarry(NamedTuple):
    """What an agent remembers between observations."""

    memory: PyTree  # the world model's
    action: Array  # [N, A], the raw action that left from the previous observation


LatentLosses = Callable[[PyTree, PyTree, Inference], dict[str, Array]]
"""`(critic_params, slow_critic_params, inference) -> {name: [B, T]}`, of the world model."""


class Agent(NamedTuple):
    """Pure functions of parameters; it holds no arrays except constants."""

    spec: EnvSpec
    world_model: WorldModel
    actor: Actor
    critic: Critic
    latent_losses: LatentLosses | None = None

    def init(self, key: Key) -> tuple[Params, PyTree]:
        """Fresh parameters, and the `model_state` that the world model carries beside them."""
        key_world_model, key_actor, key_critic = jax.random.split(key, 3)
        world_model, model_state = self.world_model.init(key_world_model)
        actor, critic = self.actor.init(key_actor), self.critic.init(key_critic)
        return Params(world_model, actor, critic), model_state

    def initial(self, batch_size: int) -> PolicyCarry:
        """The carry before the first observation."""
        return PolicyCarry(
            memory=self.world_model.initial(batch_size),
            action=jnp.zeros((batch_size, self.spec.action_size), jnp.float32),
        )

    def act(
        self,
        params: Params,
        model_state: PyTree,
        key: Key,
        carry: PolicyCarry,
        timestep: TimeStep,
        *,
        how: Literal["collect", "sample", "mode"] = "sample",
    ) -> tuple[PolicyCarry, Array]:
        """Reads `timestep` (`[N, ...]`) and chooses an action.

        The action is raw: environments clip it. It is zero where an episode has ended, because
        no action leaves from a last observation.

        Args:
          params: of the agent.
          model_state: of its world model.
          key: for latents and actions.
          carry: what the agent remembers.
          timestep: what has arrived.
          how: "sample" from the policy; "collect": sample at `actor.collect_temperature`; or
            "mode", the most likely action.
        """
        carry, action, _ = self.see(params, model_state, key, carry, timestep, how=how)
        return carry, action

    def see(
        self,
        params: Params,
        model_state: PyTree,
        key: Key,
        carry: PolicyCarry,
        timestep: TimeStep,
        *,
        how: Literal["collect", "sample", "mode"] = "sample",
    ) -> tuple[PolicyCarry, Array, Latent]:
        """As `act`, and the latent `[N, ...]` from which the action was chosen."""
        key_filter, key_action = jax.random.split(key)
        memory, latent = self.world_model.filter(
            params.world_model,
            model_state,
            key_filter,
            carry.memory,
            timestep.obs,
            carry.action,
            timestep.is_first,
        )
        choose = self.actor.behaviour if how == "collect" else self.actor.policy
        distribution = choose(params.actor, latent)
        action = distribution.mode() if how == "mode" else distribution.sample(key_action)
        action = jnp.where(timestep.is_last[:, None], 0.0, action)
        return PolicyCarry(memory, action), action, latent

    def random_action(self, key: Key, timestep: TimeStep) -> Array:
        """A uniformly random action: one of all choices, or numbers in [-1, 1]."""
        shape = (*timestep.is_last.shape, self.spec.action_size)
        if self.spec.discrete:
            chosen = jax.random.randint(key, shape[:-1], 0, shape[-1], jnp.int32)
            action = jax.nn.one_hot(chosen, shape[-1], dtype=jnp.float32)
        else:
            action = jax.random.uniform(key, shape, jnp.float32, -1.0, 1.0)
        return jnp.where(timestep.is_last[:, None], 0.0, action)


def resolve_dtype(compute_dtype: str) -> jnp.dtype:
    """The dtype of products: "auto" is bfloat16 on GPU and TPU, float32 on CPU."""
    if compute_dtype == "auto":
        compute_dtype = "float32" if jax.default_backend() == "cpu" else "bfloat16"
    return jnp.dtype(compute_dtype)


def make_agent(config: Config, spec: EnvSpec) -> Agent:
    """The agent that `config` describes, for environments of `spec`.

    Raises:
      UnknownAgent: nothing has registered `config.agent`.
    """
    dtype = resolve_dtype(config.compute_dtype)
    row, model = registry.kind(config.agent), config.world_model
    feature_size = model.deter + model.stoch * model.classes
    critic = make_critic(config.critic, feature_size, dtype)
    latent_losses = None
    if row.make_latent_losses is not None:
        latent_losses = row.make_latent_losses(critic, model)
    return Agent(
        spec=spec,
        world_model=row.make(model, spec, dtype=dtype, noise=config.value_alignment.noise),
        actor=make_actor(config.actor, spec, feature_size, dtype),
        critic=critic,
        latent_losses=latent_losses,
    )


def parameter_count(params: PyTree) -> int:
    """Number of learned scalars."""
    return sum(x.size for x in jax.tree.leaves(params))
