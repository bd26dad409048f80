"""Observations and rewards so large that their squares overflow float32, for every agent."""

import jax
import jax.numpy as jnp
import numpy as np
import tiny
import tiny_storm
import tiny_vagram
from nets_twin import noisy

from vawm.agent import make_agent
from vawm.learning import from_replay
from vawm.learning.state import init_learner
from vawm.learning.update import make_update
from vawm.types import Batch, TimeStep, Trajectory

AGENTS = (tiny.CONFIG, tiny_storm.CONFIG, tiny_vagram.CONFIG)
UPDATES = 3


def huge(agent, count, length):
    """A batch of mostly usual numbers, and some around 1e30 and -1e30."""
    rng = np.random.default_rng(count)

    def numbers(*shape):
        usual = rng.normal(size=shape)
        return jnp.asarray(usual * rng.choice([1.0, 1e30], shape, p=[0.8, 0.2]), jnp.float32)

    flags = jnp.zeros((count, length), bool)
    trajectory = Trajectory(
        obs=numbers(count, length, 2),
        reward=numbers(count, length),
        is_first=flags.at[0, 2].set(True),
        is_last=flags.at[0, 1].set(True),
        is_terminal=flags,
        action=jnp.asarray(rng.normal(size=(count, length, 1)), jnp.float32),
    )
    memory = agent.world_model.memory(agent.world_model.initial(count))
    return Batch(trajectory, memory)


def learn_from_them(config):
    """Makes `UPDATES` updates and an action after each; all results must be finite."""
    agent = make_agent(config, tiny.env().spec)
    update = make_update(agent, config)

    @jax.jit
    def learn_and_act(learner, batch, contexts, key):
        key_learn, key_act = jax.random.split(key)
        learner, _, metrics = update(learner, batch, contexts, key_learn, jnp.asarray(1000))
        seen = TimeStep(*(x[:, 0] for x in batch.trajectory[:-1]))
        carry = agent.initial(seen.reward.shape[0])
        _, action = agent.act(learner.params, learner.model_state, key_act, carry, seen)
        return learner, metrics, action

    learner = init_learner(agent, config, jax.random.key(0))
    learner = learner._replace(params=noisy(learner.params))  # zeros would hide errors
    shapes = from_replay.shapes(config)
    batch, contexts = from_replay.for_each(config, lambda shape: huge(agent, *shape), shapes)
    for number in range(UPDATES):
        learner, metrics, action = learn_and_act(
            learner, batch, contexts, jax.random.key(number)
        )
        assert_finite((learner, action, metrics), config.agent)
        assert np.abs(action).max() > 0


def assert_finite(tree, name=""):
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        assert np.isfinite(leaf).all(), f"{name}: {jax.tree_util.keystr(path)}"
