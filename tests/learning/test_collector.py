"""Acting: what an action leaves behind, and when it is a random one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from vawm.agent import make_agent
from vawm.envs import probes
from vawm.learning import collector
from vawm.types import TimeStep

NUM_ENVS, RANDOM_STEPS = 512, 40


def make(discrete):
    """An agent that knows what it wants: the last choice, or actions near 1."""
    name = "memory_discrete" if discrete else "memory"
    spec = probes.make(name, num_envs=NUM_ENVS).spec
    agent = make_agent(tiny.CONFIG, spec)
    params, model_state = agent.init(jax.random.key(0))
    bias = params.actor["heads_0"]["bias"]
    params.actor["heads_0"]["bias"] = bias.at[-1].set(30.0)
    return agent, params, model_state


def waiting(agent, env_steps):
    """Interaction after `env_steps`; the first environment's episode has just ended."""
    no = jnp.zeros(NUM_ENVS, bool)
    obs = jnp.ones((NUM_ENVS, *agent.spec.obs.shape))
    timestep = TimeStep(obs, jnp.zeros(NUM_ENVS), no, no.at[0].set(True), no)
    start = collector.begin(agent, timestep, (), num_envs=NUM_ENVS)
    return start._replace(env_steps=jnp.asarray(env_steps))


def depart(agent, params, model_state, env_steps, *, random_steps=RANDOM_STEPS, seed=1):
    key = jax.random.key(seed)
    after, stored = collector.depart(
        agent, params, model_state, waiting(agent, env_steps), key, random_steps=random_steps
    )
    action = np.asarray(stored.trajectory.action)
    np.testing.assert_array_equal(after.carry.action, action)  # what is remembered was done
    return after, stored, action


def test_random_choices_are_one_hot_and_each_as_likely_as_any_other():
    agent, params, model_state = make(discrete=True)
    *_, action = depart(agent, params, model_state, RANDOM_STEPS - 1)
    np.testing.assert_array_equal(action[0], 0.0)  # nothing leaves from a last observation
    size = agent.spec.action_size
    np.testing.assert_array_equal(np.sort(action[1:], -1), np.eye(size)[[-1] * (NUM_ENVS - 1)])
    expected = (NUM_ENVS - 1) / size
    assert (abs(action.sum(0) - expected) < 5 * np.sqrt(expected)).all()


def test_random_actions_are_uniform_between_minus_one_and_one():
    agent, params, model_state = make(discrete=False)
    *_, action = depart(agent, params, model_state, RANDOM_STEPS - 1)
    np.testing.assert_array_equal(action[0], 0.0)
    counts, _ = np.histogram(action[1:], bins=8, range=(-1, 1))
    assert counts.sum() == action[1:].size
    expected = action[1:].size / 8
    assert (abs(counts - expected) < 5 * np.sqrt(expected)).all()


@pytest.mark.parametrize("discrete", [True, False])
def test_random_actions_end_with_their_env_steps_and_are_not_the_policys(discrete):
    agent, params, model_state = make(discrete)
    before, other, random = depart(agent, params, model_state, RANDOM_STEPS - 1)
    after, stored, chosen = depart(agent, params, model_state, RANDOM_STEPS)
    assert (random[1:] != chosen[1:]).any(-1).mean() > 0.3
    assert (chosen[1:, -1] > 0).mean() > 0.8  # what this policy wants
    carry, expected = agent.act(
        params,
        model_state,
        jax.random.split(jax.random.key(1))[0],
        waiting(agent, 0).carry,
        waiting(agent, 0).timestep,
        how="collect",
    )
    np.testing.assert_array_equal(chosen, expected)
    # Whoever acts, what has arrived is remembered and stored as it is.
    jax.tree.map(np.testing.assert_array_equal, before.carry.memory, carry.memory)
    jax.tree.map(np.testing.assert_array_equal, after.carry.memory, carry.memory)
    jax.tree.map(np.testing.assert_array_equal, stored.latent, other.latent)
    jax.tree.map(np.testing.assert_array_equal, stored.trajectory[:-1], other.trajectory[:-1])


@pytest.mark.parametrize("discrete", [True, False])
def test_random_actions_differ_between_keys(discrete):
    agent, params, model_state = make(discrete)
    first, again, other = (
        depart(agent, params, model_state, 0, seed=seed)[-1] for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert (first[1:] != other[1:]).any(-1).mean() > 0.3


def test_without_random_steps_the_policy_acts_from_the_first_on():
    agent, params, model_state = make(discrete=True)
    *_, action = depart(agent, params, model_state, 0, random_steps=0)
    start = waiting(agent, 0)
    _, expected = agent.act(
        params, model_state, jax.random.key(1), start.carry, start.timestep, how="collect"
    )
    np.testing.assert_array_equal(action, expected)
