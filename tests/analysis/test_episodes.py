"""Recorded episodes: whole, the same as those of a score, with the memory for a batch."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
import tiny_pixels
import tiny_storm
import tiny_vagram
from analysis_records import make_policy
from refusals import refused

from vawm.agent import make_agent
from vawm.analysis import episodes
from vawm.envs.host.pool import Pool
from vawm.envs.host.simulator import Outcome
from vawm.errors import InvalidInput
from vawm.policy import Policy, play
from vawm.types import image, vector

CONFIGS = {"rssm": tiny.CONFIG, "storm": tiny_storm.CONFIG, "vagram": tiny_vagram.CONFIG}


@pytest.fixture(scope="module", params=CONFIGS.values(), ids=CONFIGS)
def policy(request):
    return make_policy(request.param, tiny.env().spec)


@pytest.fixture(scope="module")
def record(policy):
    return episodes.record_in(tiny.env(), policy, episodes=2, seed=3)


def test_on_the_device_whole_first_episodes_are_recorded(record):
    steps = record.trajectory
    np.testing.assert_array_equal(record.length, [5, 5])  # 4 actions and the first step
    np.testing.assert_array_equal(steps.is_first, [[True] + 4 * [False]] * 2)
    np.testing.assert_array_equal(steps.is_last, [4 * [False] + [True]] * 2)
    np.testing.assert_allclose(steps.obs[..., 1], [[0, 0.25, 0.5, 0.75, 1]] * 2)
    # The reward of a_t arrives with o_{t+1}.
    fit = 1 - 4 * (np.clip(steps.action[:, :4, 0], -1, 1) - steps.obs[:, :4, 0] / 2) ** 2
    np.testing.assert_allclose(steps.reward[:, 1:], fit, rtol=1e-5)
    np.testing.assert_allclose(record.returns, fit.sum(1), rtol=1e-5)


def test_memory_is_what_replay_would_store(policy, record):
    memory = record.memory
    agent = make_agent(policy.config, policy.spec)
    expected = agent.world_model.memory(agent.initial(2).memory)
    shapes = jax.tree.map(lambda x: (x.shape[0], *x.shape[2:]), memory)
    assert shapes == jax.tree.map(lambda x: x.shape, expected)
    for leaf in jax.tree.leaves(memory)[:1]:
        assert np.any(leaf[:, 0] != leaf[:, 1])


def test_a_policy_that_watches_its_own_episodes_remembers_the_same(policy, record):
    """With the key that acted; with any key if latents are not sampled."""
    if policy.config.agent == "vagram":
        again = episodes.watched_by(policy, record, seed=9)
        assert again.trajectory is record.trajectory
        assert again.length is record.length
    else:
        agent = make_agent(policy.config, policy.spec)
        remember = jax.jit(functools.partial(episodes.remember, agent))
        key_act = jax.random.split(jax.random.key(3))[1]
        memory = remember(policy.params, policy.model_state, key_act, record.trajectory)
        again = record._replace(memory=memory)
    assert jax.tree.structure(again.memory) == jax.tree.structure(record.memory)
    for actual, expected in zip(
        *map(jax.tree.leaves, (again.memory, record.memory)), strict=True
    ):
        assert actual.dtype == expected.dtype
        np.testing.assert_allclose(actual, expected, atol=1e-5)


SPEC = tiny.env().spec


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"task": "another"}, "player='task another': b was trained with probe_"),
        ({"obs": vector(3)}, r"player='obs Shape.*\(3,\).*': b was trained with Shape.*\(2,\)"),
        ({"obs": {"a": vector(2)}}, "obs {'a': Shape.*: b was trained with Shape"),
        ({"obs": image(48)}, r"player='obs Shape.*uint8.*: b was trained with Shape.*float32"),
        ({"action_size": 2}, "player='action_size 2': b was trained with 1"),
        ({"discrete": True}, "player='discrete True': b was trained with False"),
        ({"action_repeat": 2}, "player='action_repeat 2': b was trained with 1"),
    ],
)
def test_episodes_of_other_environments_are_refused(other, message):
    with pytest.raises(InvalidInput, match=message) as error:
        episodes.check_can_watch("b", SPEC, SPEC._replace(**other))
    assert "\n" not in str(error.value)


def test_the_number_of_environments_does_not_matter():
    episodes.check_can_watch("b", SPEC, SPEC._replace(num_envs=9, episode_length=None))


class Count:
    """Episodes of 1 to 3 steps, depending on the seed; observes the step."""

    obs = vector(1)
    action_size = 1
    discrete = False
    episode_length = None

    def reset(self, seed):
        self.length, self.steps = 1 + seed % 3, 0
        return np.zeros(1, np.float32)

    def step(self, action):
        self.steps += 1
        obs = np.array([self.steps], np.float32)
        return Outcome(obs, float(self.steps), self.steps == self.length, False)

    def close(self):
        pass


def still(spec):
    def apply(params, state, key, carry, timestep, how):
        return carry, jnp.zeros((spec.num_envs, 1))

    agent = make_agent(tiny_pixels.CONFIG, spec)
    return Policy(tiny_pixels.CONFIG, spec, 0, None, None, agent.initial, apply)


def test_on_the_host_the_episodes_of_a_score_are_recorded():
    """Whole episodes of different lengths, in the same order."""
    with Pool(Count, task="count", num_envs=2, workers=1) as env:
        record = episodes.record_in(env, still(env.spec), episodes=5, seed=1)
        score = play.on_host(env, still(env.spec), episodes=5, seed=1)
    assert len(set(record.length.tolist())) > 1
    np.testing.assert_array_equal(record.returns, score.returns)
    for i, length in enumerate(record.length):
        steps = jax.tree.map(lambda x, i=i, n=length: x[i, :n], record.trajectory)
        np.testing.assert_array_equal(steps.obs[:, 0], np.arange(length))
        np.testing.assert_array_equal(steps.reward, np.arange(length))
        assert steps.is_first.tolist() == [True] + [False] * (length - 1)
        assert steps.is_last.tolist() == [False] * (length - 1) + [True]


def test_windows_are_runs_of_steps_that_stop_at_the_last():
    record = episodes.Episodes(
        trajectory=jax.tree.map(
            lambda _: jnp.arange(10).reshape(2, 5),
            episodes.Trajectory(*6 * [0]),
        ),
        memory=jnp.arange(10).reshape(2, 5),
        length=jnp.array([5, 5]),
    )
    batch = episodes.windows(record, [1, 0, 1], [0, 2, 3], length=3)
    expected = [[5, 6, 7], [2, 3, 4], [8, 9, 9]]
    np.testing.assert_array_equal(batch.trajectory.reward, expected)
    np.testing.assert_array_equal(batch.context, [5, 2, 8])


def test_impossible_numbers_and_environments_are_refused(policy):
    env = tiny.env()
    with refused("episodes", 0):
        episodes.record_in(env, policy, episodes=0, seed=0)
    with refused("seed", -1):
        episodes.record_in(env, policy, episodes=2, seed=-1)
    with refused("episodes", 3, naming="2"):
        episodes.record_in(env, policy, episodes=3, seed=0)
    endless = env._replace(spec=env.spec._replace(episode_length=None))
    with refused("env", naming="episode_length"):
        episodes.record_in(endless, policy, episodes=2, seed=0)
