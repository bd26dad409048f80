"""A trained agent, ready to act: what `vawm.load` returns."""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Callable
from typing import Literal, NamedTuple

import jax

from vawm.agent import PolicyCarry, make_agent
from vawm.config import Config
from vawm.policy import weights
from vawm.policy.weights import Description
from vawm.runs import budget, checkpoint, validate
from vawm.runs.checkpoint import manifest as manifest_lib
from vawm.runs.checkpoint.manifest import Manifest
from vawm.types import Array, EnvSpec, Key, Params, PyTree, TimeStep

log = logging.getLogger("vawm")


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
    return _policy(manifest, functools.partial(checkpoint.read_agent, found))


def import_policy(folder: str | os.PathLike[str]) -> Policy:
    """The policy that `vawm.export` wrote to `folder`, bit for bit that of the checkpoint.

    Raises:
      InvalidInput: a file is missing or damaged, or the weights are not those of its config.
    """
    description = weights.describe(folder)
    return _policy(description, functools.partial(weights.read, folder, description))


def _policy(
    of: Manifest | Description, read: Callable[[PyTree, PyTree], tuple[PyTree, PyTree]]
) -> Policy:
    """The policy that `of` describes; `read` fills shapes of parameters and state.

    Raises:
      InvalidInput: it does not fit into memory.
    """
    if of.version != manifest_lib.version():
        log.warning(
            "vawm %s trained this policy and this is vawm %s: that it acts the same is not "
            "promised",
            *(of.version, manifest_lib.version()),
        )
    agent = make_agent(of.config, of.spec)
    shapes = jax.eval_shape(agent.init, jax.random.key(0))
    budget.check_policy(shapes, of.config)
    params, state = read(*shapes)
    return Policy(
        config=of.config,
        spec=of.spec,
        env_steps=of.env_steps,
        params=params,
        state=state,
        initial=agent.initial,
        apply=jax.jit(agent.act, static_argnames="how"),
    )
