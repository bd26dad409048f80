"""The training step for environments on the host: the same functions, in a Python loop.

    act, store            on the device
    send the actions      now the environments simulate, in processes of their own
    the updates due       on the device at the same time; if the host keeps the images, it
                          gathers and sends the next batch while the device still computes
    receive what arrives

So every action comes from the newest parameters, and updates hide the time of simulation.
Updates are single calls, not a loop on the device, because XLA's convolutions on CPU are 16
times slower inside a loop.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vawm.agent import Agent
from vawm.config import Config
from vawm.envs.protocol import HostEnvironment
from vawm.learning import from_replay, image_store, replay
from vawm.learning.collector import Collector, arrive, begin, depart
from vawm.learning.replay import Replay
from vawm.learning.state import Learner, init_learner
from vawm.learning.train import TrainState, empty_replay
from vawm.types import EnvSpec, Key, Metrics, Params, PyTree, TimeStep

HostStep = Callable[[TrainState], tuple[TrainState, dict[str, Any]]]


class Compiled(NamedTuple):
    """The three programs of a step, and the names of the metrics of `update`.

    Attributes:
      depart: `(params, model_state, collector, replay, key) -> (collector, replay, key,
        key_learn)`.
      arrive: `(collector, timestep) -> (collector, metrics)`.
      update: `(learner, replay, positions, images, key_learn, number, env_steps) ->
        (learner, replay, metrics)`.
    """

    depart: jax.stages.Compiled
    arrive: jax.stages.Compiled
    update: jax.stages.Compiled
    metrics: tuple[str, ...]


def init(agent: Agent, config: Config, key: Key, timestep: TimeStep) -> TrainState:
    """The state before the first step, without `images`; `timestep` are first observations."""
    key, key_learner = jax.random.split(key)
    collector = begin(agent, timestep, (), num_envs=config.num_envs)
    stored = collector
    if config.replay.images == "host":
        obs = image_store.without_images(timestep.obs)
        stored = collector._replace(timestep=timestep._replace(obs=obs))
    return TrainState(
        learner=init_learner(agent, config, key_learner),
        collector=collector,
        replay=empty_replay(agent, stored, config),
        credit=jnp.zeros((), jnp.int32),
        key=key,
    )


def first_timestep(spec: EnvSpec) -> TimeStep:
    """Shapes and dtypes of what environments of `spec` return."""

    def of(shape: tuple[int, ...], dtype: Any) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((spec.num_envs, *shape), dtype)

    flag = of((), jnp.bool_)
    return TimeStep(
        obs=jax.tree.map(lambda x: of(x.shape, x.dtype), spec.obs),
        reward=of((), jnp.float32),  # type: ignore[arg-type]
        is_first=flag,  # type: ignore[arg-type]
        is_last=flag,  # type: ignore[arg-type]
        is_terminal=flag,  # type: ignore[arg-type]
    )


def compile_programs(
    spec: EnvSpec,
    agent: Agent,
    config: Config,
    state: TrainState,
    *,
    kept: Callable[[str], bool] = lambda name: True,
) -> Compiled:
    """Compiles the programs of a step for states like `state`, which may be shapes.

    Only metrics of `update` whose names are `kept` are computed.
    """
    key = jax.eval_shape(lambda: jax.random.key(0))
    positions = jax.eval_shape(lambda: _positions(config))
    images = jax.eval_shape(lambda: _images(spec, config))
    number = jax.ShapeDtypeStruct((), jnp.int32)
    learner, collector, buffer = state.learner, state.collector, state.replay
    timestep = first_timestep(spec)

    def build(function: Callable, donate: tuple[int, ...], *arguments: Any) -> Any:
        return jax.jit(function, donate_argnums=donate).lower(*arguments).compile()

    update = _make_update(agent, config, kept)
    to_depart = learner.params, learner.model_state, collector, buffer, key
    to_update = learner, buffer, positions, images, key, number, number
    return Compiled(
        depart=build(_make_depart(agent, config), (2, 3), *to_depart),
        arrive=build(_make_arrive(spec), (0,), collector, timestep),
        update=build(update, (0, 1), *to_update),
        metrics=tuple(jax.eval_shape(update, *to_update)[2]),
    )


def make_step(env: HostEnvironment, config: Config, programs: Compiled) -> HostStep:
    """Build `step(state) -> (state, metrics)`: collect K steps, then learn.

    Counts, credit and metrics are those of `vawm.learning.train.make_train_step`, with
    `env/restarts` in place of `env/nonfinite`: the number of environments that failed and
    were restarted. Updates do not wait for the step that is simulated at the same time, so
    warm-ups that count env steps do not count it yet. The state that is passed cannot be used
    again: `images` is written in place, the rest is donated.

    Raises:
      EnvironmentFailure: in `step`, if an environment fails and must not be restarted.
    """
    run_updates = _make_updates(env.spec, config, programs.update)
    on_host = config.replay.images == "host"

    def step(state: TrainState) -> tuple[TrainState, dict[str, Any]]:
        learner, collector, buffer = state.learner, state.collector, state.replay
        credit, key, images = state.credit, state.key, state.images
        restarts, arrived = env.restarts, []
        for number in range(config.collect_steps):
            if on_host:
                pending = jax.device_get(collector.timestep.obs)
                image_store.add(images, pending, at=int(buffer.head))
            collector, buffer, key, key_learn = programs.depart(
                learner.params, learner.model_state, collector, buffer, key
            )
            env.send(np.asarray(collector.carry.action))
            if number == config.collect_steps - 1:
                learner, buffer, credit, learned = run_updates(
                    learner, buffer, images, credit, key_learn, collector.env_steps
                )
            collector, metrics = programs.arrive(collector, env.receive())
            arrived.append(metrics)
        arrived, learned, counters = jax.device_get(
            (arrived, learned, {"env_steps": collector.env_steps, "updates": learner.step})
        )
        metrics = counters | {"chunk/updates": len(learned)}
        metrics |= jax.tree.map(lambda *parts: sum(parts), *arrived)
        metrics |= {"env/restarts": env.restarts - restarts} | _mean(learned, programs.metrics)
        state = TrainState(
            learner=learner,
            collector=collector,
            replay=buffer,
            credit=credit,
            key=key,
            images=images,
        )
        return state, metrics

    return step


def _make_updates(spec: EnvSpec, config: Config, update: Callable) -> Callable:
    """Build `run_updates(learner, replay, images, credit, key, env_steps)`: the updates due.

    Batches are drawn with numpy and depend only on the seed and the number of the update, so
    that no draw waits for the device.
    """
    length, batch_steps = config.replay.batch_length, config.replay.batch_steps
    earned = config.collect_steps * config.num_envs * config.train_ratio
    on_host = config.replay.images == "host"

    def run_updates(
        learner: Learner,
        buffer: Replay,
        images: PyTree,
        credit: Any,
        key: Key,
        env_steps: Any,
    ) -> tuple[Learner, Replay, np.int32, list[Metrics]]:
        capacity = buffer.trajectory.reward.shape[1]
        head, size, done = (int(x) for x in (buffer.head, buffer.size, learner.step))
        ready = spec.num_envs * (size - length) >= batch_steps
        owed = int(credit) + (earned if ready else 0)
        learned = []

        def read(positions: replay.Positions) -> PyTree:
            return image_store.read(images, positions)

        for number in range(owed // batch_steps):
            rng = np.random.default_rng((config.seed, done + number))
            positions = from_replay.draw_on_host(
                config, rng, spec.num_envs, capacity, head, size
            )
            pictures = from_replay.NO_IMAGES
            if on_host:
                pictures = from_replay.for_each(config, read, positions)
            learner, buffer, metrics = update(
                learner, buffer, positions, pictures, key, np.int32(number), env_steps
            )
            learned.append(metrics)
        return learner, buffer, np.int32(owed % batch_steps), learned

    return run_updates


def _make_depart(agent: Agent, config: Config) -> Callable:
    def depart_and_store(
        params: Params, model_state: PyTree, collector: Collector, buffer: Replay, key: Key
    ):
        key, key_act, key_learn = jax.random.split(key, 3)
        collector, stored = depart(
            agent, params, model_state, collector, key_act, random_steps=config.random_steps
        )
        if config.replay.images == "host":
            obs = image_store.without_images(stored.trajectory.obs)
            stored = stored._replace(trajectory=stored.trajectory._replace(obs=obs))
        one_step = jax.tree.map(lambda x: x[:, None], stored)
        return collector, replay.add(buffer, *one_step), key, key_learn

    return depart_and_store


def _make_arrive(spec: EnvSpec) -> Callable:
    def take_in(collector: Collector, timestep: TimeStep):
        return arrive(collector, timestep, action_repeat=spec.action_repeat)

    return take_in


def _make_update(agent: Agent, config: Config, kept: Callable[[str], bool]) -> Callable:
    update_at = from_replay.make_update_at(agent, config)

    def update(learner, buffer, positions, images, key, number, env_steps):
        key = jax.random.fold_in(key, number)
        learner, buffer, metrics = update_at(learner, buffer, positions, images, key, env_steps)
        return learner, buffer, {name: x for name, x in metrics.items() if kept(name)}

    return update


def _positions(config: Config) -> from_replay.Draw:
    """Positions of the shapes and dtypes that a draw has."""

    def at(shape: tuple[int, int]) -> replay.Positions:
        return replay.Positions(jnp.zeros(shape[0], jnp.int32), jnp.zeros(shape, jnp.int32))

    return from_replay.for_each(config, at, from_replay.shapes(config))


def _images(spec: EnvSpec, config: Config) -> from_replay.Draw:
    """Images of the shapes and dtypes that a draw has; `NO_IMAGES` if replay keeps them."""
    if config.replay.images == "device":
        return from_replay.NO_IMAGES

    def images(shape: tuple[int, int]) -> PyTree:
        whole = jax.tree.map(lambda x: jnp.zeros((*shape, *x.shape), x.dtype), spec.obs)
        empty = jax.tree.map(lambda x: jnp.zeros((*shape, 0), x.dtype), spec.obs)
        return image_store.merge(empty, whole)

    return from_replay.for_each(config, images, from_replay.shapes(config))


def _mean(learned: list[Metrics], names: tuple[str, ...]) -> dict[str, float]:
    """Means over the updates of a chunk; 0 if there were none."""
    if len(learned) == 0:
        return dict.fromkeys(names, 0.0)
    return {name: float(np.mean([m[name] for m in learned])) for name in names}
