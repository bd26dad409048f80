"""A trained policy, ready to act: what `vawm.load` returns."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium
import jax
import numpy as np

from vawm.agent import Agent, PolicyCarry, make_agent, parameter_count
from vawm.config import Config
from vawm.envs.host import native
from vawm.envs.host.native import Native
from vawm.errors import InvalidInput
from vawm.policy import returned, session, weights
from vawm.policy.returned import LastReturn
from vawm.policy.session import How, Session
from vawm.policy.weights import Description
from vawm.runs import budget, checkpoint, settings, suites, validate
from vawm.runs.checkpoint import manifest
from vawm.runs.checkpoint.manifest import Manifest
from vawm.types import Array, EnvSpec, Key, Params, PyTree, TimeStep

log = logging.getLogger("vawm")


IN_PYTHON_PURE = "policy = vawm.load(LOGDIR); carry, action = policy.act(key, carry, timestep)"
IN_PYTHON = "policy = vawm.load(LOGDIR); action = policy.predict(obs, episode_start=...)"
"""The statements that act in environments of the caller's, without a record of their spaces and
with one."""


class Trained(NamedTuple):
    """What a trained policy is made of.

    Attributes:
      config: of the run.
      spec: of the environment it was trained in.
      env_steps: at which the checkpoint was written.
      params: the parameters.
      model_state: what the world model carries besides its parameters.
      initial: `(batch_size) -> carry`, before the first observation.
      apply: `(params, model_state, key, carry, timestep, *, how) -> (carry, action [N, A])`,
        jitted and pure.
      last_return: the last return of training; None if it is not known.
    """

    config: Config
    spec: EnvSpec
    env_steps: int
    params: Params
    model_state: PyTree
    initial: Callable[[int], PolicyCarry]
    apply: Callable[..., tuple[PolicyCarry, Array]]
    last_return: LastReturn | None = None


class Policy(Trained):
    """A trained policy: the parameters of a checkpoint, without what only training needs.

        action = policy.predict(obs, episode_start=True)           # remembers
        carry, action = policy.respond(key, carry, obs, is_first)  # pure, of the same
        carry, action = policy.act(key, carry, timestep)           # pure, as in training

    `predict` and `respond` take observations and return actions of the environment itself, one
    or a batch; `act` takes and returns those of the agent. Only `predict` remembers anything
    between calls, in `session`.
    """

    @property
    def agent(self) -> Agent:
        """The pure functions that it consists of."""
        return make_agent(self.config, self.spec)

    def act(
        self, key: Key, carry: PolicyCarry, timestep: TimeStep, how: How = "sample"
    ) -> tuple[PolicyCarry, Array]:
        """The next carry and a raw action `[N, A]`: sampled, or the policy's mode."""
        return self.apply(self.params, self.model_state, key, carry, timestep, how=how)

    def respond(
        self, key: Key, carry: PolicyCarry, obs: Any, is_first: Any, how: How = "sample"
    ) -> tuple[PolicyCarry, Any]:
        """As `act`, for an observation of the environment itself.

        Args:
          key: for latents and actions.
          carry: `initial(N)` or what the last call returned; N is 1 for one observation.
          obs: as the environment returns it: one observation, or a batch `[N, ...]`.
          is_first: whether it is the first of an episode: a bool, or `[N]` of them.
          how: sample the action, or take the policy's mode.

        Returns:
          The next carry, and an action of the environment's own space, or a batch `[N, ...]`.

        Raises:
          InvalidInput: the observation is not of the environment's space.
        """
        arrays, batched = self.native.see(obs)
        starts = np.broadcast_to(np.asarray(is_first, bool), (session.count(arrays),))
        carry, raw = self.act(key, carry, session.arrived(arrays, starts), how)
        return carry, self.native.take(raw, batched=batched)

    def predict(self, obs: Any, episode_start: Any = None, *, how: How = "sample") -> Any:
        """The action for an observation, as `Session.predict` of the policy's own `session`."""
        return self.session.predict(obs, episode_start, how=how)

    def new_session(self, seed: int = 0) -> Session:
        """A session of its own, for example for a second environment at the same time."""
        return Session(self.act, self.initial, self.native, jax.random.key(seed))

    @functools.cached_property
    def session(self) -> Session:
        """What `predict` remembers; its seed is 0. A copy by `_replace` has another."""
        return self.new_session()

    @functools.cached_property
    def native(self) -> Native:
        """The observations and actions of the environment itself.

        Raises:
          InvalidInput: an earlier version trained it without keeping them, in an environment
            that only the caller can make.
        """
        if self.spec.native is not None:
            return self.spec.native
        image_size = suites.resized_to(self.config, self.spec.made)
        if image_size is None:
            return native.of_spec(self.spec)
        with contextlib.closing(self._make_env(None, IN_PYTHON_PURE)) as env:
            own = native.of_spaces(
                env.observation_space, env.action_space, image_size=image_size
            )
        if not native.fits(own, self.spec):
            remedy = f"has other spaces now than in training; in Python: {IN_PYTHON_PURE}"
            raise InvalidInput("env", self.spec.task, remedy)
        return own

    def make_env(self, *, render_mode: str | None = None) -> gymnasium.Env:
        """An environment as those of the run, as its record says; close it.

        It is of Gymnasium, with observations and actions that `predict` takes and returns.
        `gymnasium.vector.SyncVectorEnv([policy.make_env] * 4)` is a batch of them.

        Args:
          render_mode: of a registered environment any that it has, such as "human";
            "rgb_array" where observations have an image; otherwise None.

        Raises:
          InvalidInput: only the caller can make it, or it cannot be made or rendered here.
        """
        return self._make_env(render_mode, IN_PYTHON)

    def _make_env(self, render_mode: str | None, python: str) -> gymnasium.Env:
        made = self.spec.made
        return suites.make_one(self.config, made, python=python, render_mode=render_mode)

    def __repr__(self) -> str:
        """A few lines: what was trained, how large it is, how long, and what came out."""
        config = self.config
        size = f"{config.size}, {parameter_count(self.params):,} parameters"
        score = self.last_return or "not known"
        return (
            f"Policy of {self.spec.task} ({config.suite})\n"
            f"  agent: {config.agent} of size {size}\n"
            f"  trained: {self.env_steps:,} of {config.env_steps:,} env steps\n"
            f"  last training return: {score}"
        )


def load(logdir: str | os.PathLike[str]) -> Policy:
    """Loads the policy in `logdir`, the folder of a run or one that `vawm.export` wrote.

    Of a run, it loads the newest undamaged checkpoint, and reads the last return from its
    metrics. It warns in the log `vawm` if a newer one is damaged.

    Raises:
      InvalidInput: there is no checkpoint, or all are damaged; or JAX has no device.
    """
    if weights.found(logdir):
        return import_policy(logdir)
    settings.check()
    found = checkpoint.usable(logdir, checkpoint.ACTING)
    validate.check_spec(found.manifest.config, found.manifest.spec)
    policy = _policy(found.manifest, functools.partial(checkpoint.read_agent, found))
    return policy._replace(last_return=returned.find(logdir, policy.env_steps))


def import_policy(folder: str | os.PathLike[str]) -> Policy:
    """Loads the policy that `vawm.export` wrote to `folder`, bit-identical to its checkpoint.

    Raises:
      InvalidInput: a file is missing or damaged, or the weights do not fit the config.
    """
    settings.check()
    description = weights.describe(folder)
    policy = _policy(description, functools.partial(weights.read, folder, description))
    return policy._replace(last_return=description.last_return)


def _policy(
    of: Manifest | Description, read: Callable[[PyTree, PyTree], tuple[PyTree, PyTree]]
) -> Policy:
    """Builds the policy that `of` describes; `read` loads parameters and state of given shapes.

    Raises:
      InvalidInput: the policy does not fit into memory.
    """
    if of.version != manifest.version():
        log.warning(
            "this policy was trained with vawm %s and loaded with vawm %s: it may act "
            "differently",
            of.version,
            manifest.version(),
        )
    agent = make_agent(of.config, of.spec)
    shapes = jax.eval_shape(agent.init, jax.random.key(0))
    budget.check_policy(shapes, of.config)
    params, model_state = read(*shapes)
    return Policy(
        config=of.config,
        spec=of.spec,
        env_steps=of.env_steps,
        params=params,
        model_state=model_state,
        initial=agent.initial,
        apply=jax.jit(agent.act, static_argnames="how"),
    )
