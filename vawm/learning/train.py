"""The training step: collect, store, update, as one pure function.

`make_train_step` joins interaction (`vawm.learning.collector`) and learning
(`vawm.learning.update`). Nothing here is jitted; the caller compiles `train_step` once and
donates its state. For environments that run on the host, `vawm.learning.host_train` takes its
place.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm.agent import Agent
from vawm.config import Config
from vawm.envs.protocol import Environment
from vawm.learning import replay
from vawm.learning.collector import Collector, begin, in_float32, make_collect
from vawm.learning.from_replay import make_learn
from vawm.learning.replay import Replay
from vawm.learning.state import Learner, init_learner
from vawm.types import Array, Key, Metrics, PyTree, Trajectory


class TrainState(NamedTuple):
    """The whole state of a run: what a checkpoint holds, and what `train_step` advances."""

    learner: Learner
    collector: Collector
    replay: Replay
    credit: Array  # [] int32, steps that are still to be replayed, less than one batch
    key: Key
    images: PyTree = ()  # replayed images if the host keeps them: `learning.image_store`


Init = Callable[[Key], TrainState]
TrainStep = Callable[[TrainState], tuple[TrainState, Metrics]]


def make_train_step(env: Environment, agent: Agent, config: Config) -> TrainStep:
    """Build `train_step(state) -> (state, metrics)`: collect K steps, then learn.

    Every collected step of every environment earns `train_ratio` replayed steps; an update
    replays batch_size * batch_length. Earning starts with the first chunk after which replay
    can fill a batch with different sequences. The updates that are due run after each chunk,
    and the remainder is carried over, so that their number is exactly
    `floor(collected steps * train_ratio / (batch_size * batch_length))`.

    Metrics: the counters `env_steps`, `updates` (so far), `chunk/updates` and `chunk/nonfinite`
    (of what environments return, and of actions); sums over finished episodes, `episode/*` and
    `env/nonfinite`; and means of the rest over the updates of this chunk, 0 if there were none.
    """
    collect = make_collect(env, agent, config)
    learn = make_learn(agent, config)
    length, batch_steps = config.replay.batch_length, config.replay.batch_steps
    earned = config.collect_steps * config.num_envs * config.train_ratio

    def train_step(state: TrainState) -> tuple[TrainState, Metrics]:
        key, key_collect, key_learn = jax.random.split(state.key, 3)
        collector, buffer, collected = collect(
            state.learner.params,
            state.learner.model_state,
            state.collector,
            state.replay,
            key_collect,
        )
        ready = replay.num_starts(buffer, length + 1) >= batch_steps
        credit = state.credit + jnp.where(ready, earned, 0)
        due = credit // batch_steps
        learner, buffer, learned = learn(
            state.learner, buffer, key_learn, collector.env_steps, due
        )
        counters = {
            "env_steps": collector.env_steps,
            "updates": learner.step,
            "chunk/updates": due,
        }
        state = TrainState(
            learner=learner,
            collector=collector,
            replay=buffer,
            credit=credit - due * batch_steps,
            key=key,
            images=state.images,
        )
        return state, counters | collected | learned

    return train_step


def init(env: Environment, agent: Agent, config: Config, key: Key) -> TrainState:
    """The state before the first step: fresh parameters, environments and replay."""
    key, key_learner, key_env = jax.random.split(key, 3)
    env_state, timestep = env.reset(key_env)
    collector = begin(agent, in_float32(timestep), env_state, num_envs=config.num_envs)
    return TrainState(
        learner=init_learner(agent, config, key_learner),
        collector=collector,
        replay=empty_replay(agent, collector, config),
        credit=jnp.zeros((), jnp.int32),
        key=key,
    )


def empty_replay(agent: Agent, collector: Collector, config: Config) -> Replay:
    """Empty replay for the steps of `collector`; never larger than what the run collects."""
    example = Trajectory(*collector.timestep, action=collector.carry.action)
    capacity = replay.capacity_per_env(
        config.replay.capacity,
        agent.spec,
        env_steps=config.env_steps,
        collect_steps=config.collect_steps,
    )
    kept = agent.world_model.memory(collector.carry.memory)
    return replay.init(example, kept, capacity=capacity)


SEED_AXES = TrainState(
    learner=0,  # type: ignore[arg-type]
    collector=0,  # type: ignore[arg-type]
    replay=Replay(trajectory=0, latent=0, head=None, size=None),  # type: ignore[arg-type]
    credit=None,  # type: ignore[arg-type]
    key=0,  # type: ignore[arg-type]
    images=None,
)
"""Which leaves of a `TrainState` are stacked over seeds.

How full replay is, and how many updates are due, depends only on the number of chunks. As
shared values they give the loop of updates one trip count. Stacked, the loop would have to
select between the old and the new replay of every seed after every update."""


def over_seeds(init: Init, train_step: TrainStep) -> tuple[Init, TrainStep]:
    """`init` for keys `[S]`, and `train_step` for all S seeds at once."""
    return (
        jax.vmap(init, out_axes=SEED_AXES),
        jax.vmap(train_step, in_axes=(SEED_AXES,), out_axes=(SEED_AXES, 0)),
    )
