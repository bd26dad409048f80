"""A trained agent, ready to act: what `vawm.load` returns."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Literal, NamedTuple

import jax

from vawm import checkpoint, validate, weights
from vawm.agent import PolicyCarry, make_agent
from vawm.config import Config
from vawm.types import Array, EnvSpec, Key, Params, PyTree, TimeStep


class Policy(NamedTuple):
    """A checkpoint of a run, the newest that is whole, without what only training needs.

    Attributes:
      config: of the run.
      spec: of the environment it was trained in.
      env_steps: when the checkpoint was written.
      params: the parameters.
      state: what the world model carries beside them.
      initial: `(batch_size) -> carry`, before the first observation.
      apply: `(params, state, key, carry, timestep, *, how) -> (carry, action [N, A])`,
        jitted and pure.
    """

    config: Config
    spec: EnvSpec
    env_steps: int
    params: Params
    state: PyTree
    initial: Callable[[int], PolicyCarry]
    apply: Callable[..., tuple[PolicyCarry, Array]]

    def act(
        self,
        key: Key,
        carry: PolicyCarry,
        timestep: TimeStep,
        how: Literal["sample", "mode"] = "sample",
    ) -> tuple[PolicyCarry, Array]:
        """The next carry and a raw action `[N, A]`: sampled, or the policy's mode."""
        return self.apply(self.params, self.state, key, carry, timestep, how=how)


def load(logdir: str | os.PathLike[str]) -> Policy:
    """The policy in `logdir`, of a run or as `vawm.export` wrote it; nothing else is read.

    Where that is damaged, the newest older one that is whole is loaded, and the log of `vawm`
    says so.

    Raises:
      InvalidInput: there is no checkpoint, or all are damaged.
    """
    if weights.found(logdir):
        return import_policy(logdir)
    found = checkpoint.usable(logdir, checkpoint.ACTING)
    manifest = found.manifest
    validate.check_spec(manifest.config, manifest.spec)
    agent = make_agent(manifest.config, manifest.spec)
    target = jax.eval_shape(agent.init, jax.random.key(0))
    params, state = checkpoint.read_agent(found, *target)
    return Policy(
        config=manifest.config,
        spec=manifest.spec,
        env_steps=manifest.env_steps,
        params=params,
        state=state,
        initial=agent.initial,
        apply=jax.jit(agent.act, static_argnames="how"),
    )


def import_policy(folder: str | os.PathLike[str]) -> Policy:
    """The policy that `vawm.export` wrote to `folder`, bit for bit that of the checkpoint.

    Raises:
      InvalidInput: a file is missing or damaged, or the weights are not those of its config.
    """
    description = weights.describe(folder)
    agent = make_agent(description.config, description.spec)
    target = jax.eval_shape(agent.init, jax.random.key(0))
    params, state = weights.read(folder, description, *target)
    return Policy(
        config=description.config,
        spec=description.spec,
        env_steps=description.env_steps,
        params=params,
        state=state,
        initial=agent.initial,
        apply=jax.jit(agent.act, static_argnames="how"),
    )
