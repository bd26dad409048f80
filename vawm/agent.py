"""An agent: a world model, an actor and a critic, and how they act."""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from vawm.actor_critic import Actor, Critic, make_actor, make_critic
from vawm.config import Config
from vawm.types import Array, EnvSpec, Key, Latent, Params, PyTree, TimeStep
from vawm.world_model.protocol import WorldModel
from vawm.world_model.rssm import rssm


class PolicyCarry(NamedTuple):
    """What an agent remembers between observations."""

    latent: Latent
    action: Array  # [N, A], the raw action that left from the previous observation


class Agent(NamedTuple):
    """Pure functions of parameters; holds no arrays but constants."""

    spec: EnvSpec
    world_model: WorldModel
    actor: Actor
    critic: Critic

    def init(self, key: Key) -> Params:
        """Fresh parameters."""
        key_world_model, key_actor, key_critic = jax.random.split(key, 3)
        return Params(
            world_model=self.world_model.init(key_world_model),
            actor=self.actor.init(key_actor),
            critic=self.critic.init(key_critic),
        )

    def initial(self, batch_size: int) -> PolicyCarry:
        """The carry before the first observation."""
        return PolicyCarry(
            latent=self.world_model.initial(batch_size),
            action=jnp.zeros((batch_size, self.spec.action_size)),
        )

    def act(
        self,
        params: Params,
        key: Key,
        carry: PolicyCarry,
        timestep: TimeStep,
        *,
        how: Literal["collect", "sample", "mode"] = "sample",
    ) -> tuple[PolicyCarry, Array]:
        """Filter `timestep` (`[N, ...]`) and choose an action.

        The action is raw: environments clip it. It is zero where an episode has ended,
        since nothing leaves from a last observation.

        Args:
          params: of the agent.
          key: for latents and actions.
          carry: what the agent remembers.
          timestep: what has arrived.
          how: sample the policy; sample what collects, at its temperature; or take the
            policy's mode.
        """
        key_observe, key_action = jax.random.split(key)
        latent, _ = self.world_model.observe(
            params.world_model,
            key_observe,
            carry.latent,
            jax.tree.map(lambda x: x[:, None], timestep.obs),
            carry.action[:, None],
            timestep.is_first[:, None],
            train=False,
        )
        choose = self.actor.behaviour if how == "collect" else self.actor.policy
        policy = choose(params.actor, latent)
        action = policy.mode() if how == "mode" else policy.sample(key_action)
        action = jnp.where(timestep.is_last[:, None], 0.0, action)
        return PolicyCarry(latent, action), action


def resolve_dtype(compute_dtype: str) -> jnp.dtype:
    """The dtype of products: "auto" is bfloat16 on an accelerator, float32 on CPU."""
    if compute_dtype == "auto":
        compute_dtype = "float32" if jax.default_backend() == "cpu" else "bfloat16"
    return jnp.dtype(compute_dtype)


def make_agent(config: Config, spec: EnvSpec) -> Agent:
    """The agent that `config` describes, for environments of `spec`."""
    dtype = resolve_dtype(config.compute_dtype)
    model = config.world_model
    feature_size = model.deter + model.stoch * model.classes
    return Agent(
        spec=spec,
        world_model=rssm(model, spec, dtype=dtype, noise=config.value_alignment.noise),
        actor=make_actor(config.actor, spec, feature_size, dtype),
        critic=make_critic(config.critic, feature_size, dtype),
    )


def parameter_count(params: PyTree) -> int:
    """Number of learned scalars."""
    return sum(x.size for x in jax.tree.leaves(params))
