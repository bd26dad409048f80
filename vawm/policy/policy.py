"""A trained policy, ready to act: what `vawm.load` returns."""

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
from vawm.runs import budget, checkpoint, settings, validate
from vawm.runs.checkpoint import manifest
from vawm.runs.checkpoint.manifest import Manifest
from vawm.types import Array, EnvSpec, Key, Params, PyTree, TimeStep

log = logging.getLogger("vawm")


class Policy(NamedTuple):
    """A trained policy: the parameters of a checkpoint, without what only training needs.

    Attributes:
      config: of the run.
      spec: of the environment it was trained in.
      env_steps: at which the checkpoint was written.
      params: the parameters.
      model_state: what the world model carries besides its parameters.
      initial: `(batch_size) -> carry`, before the first observation.
      apply: `(params, model_state, key, carry, timestep, *, how) -> (carry, action [N, A])`,
        jitted and pure.
    """

    config: Config
    spec: EnvSpec
    env_steps: int
    params: Params
    model_state: PyTree
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
        return self.apply(self.params, self.model_state, key, carry, timestep, how=how)


def load(logdir: str | os.PathLike[str]) -> Policy:
    """Loads the policy in `logdir`, the folder of a run or one that `vawm.export` wrote.

    Of a run, it loads the newest undamaged checkpoint and reads nothing else. It warns in the
    log `vawm` if a newer one is damaged.

    Raises:
      InvalidInput: there is no checkpoint, or all are damaged; or JAX has no device.
    """
    if weights.found(logdir):
        return import_policy(logdir)
    settings.check()
    found = checkpoint.usable(logdir, checkpoint.ACTING)
    validate.check_spec(found.manifest.config, found.manifest.spec)
    return _policy(found.manifest, functools.partial(checkpoint.read_agent, found))


def import_policy(folder: str | os.PathLike[str]) -> Policy:
    """Loads the policy that `vawm.export` wrote to `folder`, bit-identical to its checkpoint.

    Raises:
      InvalidInput: a file is missing or damaged, or the weights do not fit the config.
    """
    settings.check()
    description = weights.describe(folder)
    return _policy(description, functools.partial(weights.read, folder, description))


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
