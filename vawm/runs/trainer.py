"""The compiled functions of a run, with environments on the device or on the host."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vawm.agent import Agent, make_agent
from vawm.config import Config
from vawm.envs import made
from vawm.envs.host.pool import Episodes
from vawm.envs.protocol import Environment, HostEnvironment
from vawm.errors import InvalidInput
from vawm.learning import host_train, image_store, train
from vawm.learning.train import TrainState
from vawm.runs import suites, validate
from vawm.types import EnvSpec, PyTree

Arrays = dict[str, np.ndarray]
Kept = Callable[[str], bool]
"""Whether to compute the metric with this name."""


def everything(name: str) -> bool:
    return True


class CompiledStep(NamedTuple):
    """A compiled training step.

    Attributes:
      run: `(state) -> (state, metrics)`; donates its state.
      executables: the compiled functions that it runs on the device, in order.
    """

    run: Callable[[TrainState], tuple[TrainState, Mapping[str, Any]]]
    executables: tuple[jax.stages.Compiled, ...]


class Trainer(NamedTuple):
    """The compiled functions of a run; nothing is allocated before `init`.

    Attributes:
      spec: of the environments.
      agent: the agent that learns.
      shapes: of the `TrainState`.
      init: `(seed) -> state`.
      compile: `(state) -> step` for states with these shapes.
      episodes: `() -> arrays` from which the running episodes can be replayed; None if the
        state contains the environments.
      resume: `(state, episodes) -> (state, count)`, restores the environments; `count`
        episodes could not be replayed and start again.
      close: stops the environments on the host.
      notices: what to say of the environments when a run starts, one line each.
    """

    spec: EnvSpec
    agent: Agent
    shapes: PyTree
    init: Callable[[int], TrainState]
    compile: Callable[[TrainState], CompiledStep]
    episodes: Callable[[], Arrays | None]
    resume: Callable[[TrainState, Arrays | None], tuple[TrainState, int]]
    close: Callable[[], None]
    notices: tuple[str, ...] = ()


def make(
    config: Config,
    env: Environment | HostEnvironment | None = None,
    *,
    kept: Kept = everything,
) -> Trainer:
    """Builds the trainer of `config`, for `env` or the environments that it names.

    Metrics that are not `kept` are not computed, unless updates need them.

    Raises:
      InvalidInput: the environments cannot be made, or do not fit the config.
    """
    env = env or suites.make(config)
    spec = env.spec._replace(made=made.of(env))
    try:
        validate.check_spec(config, env.spec)
        agent = make_agent(config, spec)
        if isinstance(env, Environment):
            return on_device(env, agent, config, kept)
        return on_host(env, agent, config, kept)
    except BaseException:
        if not isinstance(env, Environment):
            env.close()
        raise


def on_device(
    env: Environment, agent: Agent, config: Config, kept: Kept = everything
) -> Trainer:
    """Simulation, replay and learning in one jitted step."""
    train_step = train.make_train_step(env, agent, config)

    def train_step_kept(state: TrainState):
        state, metrics = train_step(state)
        return state, {name: value for name, value in metrics.items() if kept(name)}

    init = jax.jit(functools.partial(train.init, env, agent, config))
    step = jax.jit(train_step_kept, donate_argnums=0)

    def compile_step(state: TrainState) -> CompiledStep:
        compiled = step.lower(state).compile()
        return CompiledStep(compiled, (compiled,))

    return Trainer(
        spec=agent.spec,
        agent=agent,
        shapes=init.eval_shape(jax.random.key(0)),
        init=lambda seed: init(jax.random.key(seed)),
        compile=compile_step,
        episodes=lambda: None,
        resume=lambda state, _: (state, 0),
        close=lambda: None,
    )


def on_host(
    env: HostEnvironment, agent: Agent, config: Config, kept: Kept = everything
) -> Trainer:
    """The same update, with environments on the host."""
    spec, seed = agent.spec, config.seed
    begin = jax.jit(functools.partial(host_train.init, agent, config))
    shapes = begin.eval_shape(jax.random.key(0), host_train.first_timestep(spec))
    images: Callable[[], PyTree] = tuple
    if config.replay.images == "host":
        capacity = shapes.replay.trajectory.reward.shape[1]
        ring = {"num_envs": spec.num_envs, "capacity": capacity}
        shapes = shapes._replace(images=image_store.specs(spec.obs, **ring))
        images = functools.partial(image_store.init, spec.obs, **ring)

    def init(seed: int) -> TrainState:
        state = begin(jax.random.key(seed), env.reset(seed))
        return state._replace(images=images())

    def compile_step(state: TrainState) -> CompiledStep:
        programs = host_train.compile_programs(spec, agent, config, state, kept=kept)
        executables = programs.depart, programs.update, programs.arrive
        return CompiledStep(host_train.make_step(env, config, programs), executables)

    def resume(state: TrainState, episodes: Arrays | None) -> tuple[TrainState, int]:
        if episodes is None:
            remedy = "has no environments on the host; resume with the original environments"
            raise InvalidInput("checkpoint", "without episodes", remedy)
        collector = state.collector
        expected = jax.device_get(collector.timestep)
        timestep, same = env.restore(seed, Episodes(**episodes), expected)
        keep = jnp.asarray(same)
        collector = collector._replace(
            timestep=jax.tree.map(jnp.asarray, timestep),
            episode_return=jnp.where(keep, collector.episode_return, 0.0),
            episode_length=jnp.where(keep, collector.episode_length, 0),
        )
        return state._replace(collector=collector), int((~same).sum())

    return Trainer(
        spec=spec,
        agent=agent,
        shapes=shapes,
        init=init,
        compile=compile_step,
        episodes=lambda: env.episodes()._asdict(),
        resume=resume,
        close=env.close,
        notices=tuple(getattr(env, "notices", ())),
    )
