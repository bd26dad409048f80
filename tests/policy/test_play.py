"""Playing on the host: the planned episodes count exactly once, whatever their length."""

import jax.numpy as jnp
import numpy as np
import pytest
import tiny_pixels
from refusals import refused

from vawm import evaluate
from vawm.envs.host.pool import Pool, episode_seed
from vawm.envs.host.simulator import Outcome
from vawm.policy import Policy, play
from vawm.types import vector

SEED = 5


class Uneven:
    """Episodes of 1 to 9 steps, depending on the seed; every reward is 1 + the action."""

    obs = vector(1)
    action_size = 1
    discrete = False
    episode_length = None

    def reset(self, seed):
        self.length, self.steps = length_of(seed), 0
        return np.array([self.length], np.float32)

    def step(self, action):
        self.steps += 1
        obs = np.array([self.length], np.float32)
        return Outcome(obs, float(1 + action[0]), self.steps == self.length, False)

    def close(self):
        pass


def length_of(seed):
    return 1 + seed % 9


def policy(spec, action=0.0, seen=None):
    """A policy with a constant action; records `how` it is asked."""

    def apply(params, state, key, carry, timestep, how):
        if seen is not None:
            seen.append(how)
        return carry + 1, jnp.full((carry.shape[0], 1), action)

    return Policy(tiny_pixels.CONFIG, spec, 0, None, None, lambda n: jnp.zeros(n), apply)


@pytest.fixture(scope="module", params=[1, 3])
def env(request):
    with Pool(Uneven, task="uneven", num_envs=request.param, workers=1) as env:
        yield env


@pytest.mark.parametrize("episodes", [1, 3, 7])
def test_the_episodes_that_count_are_fixed_in_advance(env, episodes):
    num_envs = env.spec.num_envs
    score = evaluate.evaluate(policy(env.spec), episodes=episodes, env=env, seed=SEED)
    expected = [
        length_of(episode_seed(play.FRESH + SEED, i, k))
        for i in range(num_envs)
        for k in range(len(range(i, episodes, num_envs)))
    ]
    assert list(score.returns) == expected
    assert len(score.returns) == episodes


def test_no_episode_of_training_is_played():
    trained = {episode_seed(SEED, i, k) for i in range(8) for k in range(1000)}
    played = {episode_seed(play.FRESH + SEED, i, k) for i in range(8) for k in range(1000)}
    assert not trained & played


def test_short_episodes_are_not_favoured():
    """The first 8 episodes to finish in 8 environments would be short ones."""
    with Pool(Uneven, task="uneven", num_envs=8, workers=1) as env:
        scores = [
            play.on_host(env, policy(env.spec), episodes=8, seed=seed) for seed in range(40)
        ]
    counted = [length for score in scores for length in score.returns]
    drawn = [
        length_of(episode_seed(play.FRESH + seed, i, 0)) for seed in range(40) for i in range(8)
    ]
    assert counted == drawn
    assert np.mean(counted) == pytest.approx(5.0, abs=0.5)  # of lengths 1 to 9


def test_returns_follow_from_the_actions_of_the_policy(env):
    score = play.on_host(env, policy(env.spec, action=0.5), episodes=3, seed=SEED)
    still = play.on_host(env, policy(env.spec), episodes=3, seed=SEED)
    np.testing.assert_allclose(score.returns, 1.5 * np.array(still.returns))


def test_the_policy_is_asked_to_sample_or_for_its_mode(env):
    for how in ("sample", "mode"):
        seen = []
        play.on_host(env, policy(env.spec, seen=seen), episodes=1, seed=SEED, how=how)
        assert set(seen) == {how}


def test_impossible_numbers_are_refused(env):
    with refused("episodes", 0):
        evaluate.evaluate(policy(env.spec), episodes=0, env=env)
    with refused("seed", -1):
        evaluate.evaluate(policy(env.spec), episodes=1, env=env, seed=-1)


def test_options_of_another_suite_are_refused(tmp_path, monkeypatch, capsys):
    with Pool(Uneven, task="uneven", num_envs=1) as pool:
        monkeypatch.setattr(evaluate, "load", lambda _: policy(pool.spec))
    monkeypatch.setattr(evaluate.cache, "enable", lambda: None)
    for flags, message in [
        (["--physics", "mujoco"], "physics='mujoco': "),
        (["--sticky", "0.25"], "sticky=0.25: "),
    ]:
        argv = ["--logdir", str(tmp_path), *flags]
        assert evaluate.guard(lambda argv=argv: evaluate.main(argv)) == 2
        told = capsys.readouterr().err
        assert told.startswith(f"error: {message}")
        assert told.count("\n") == 1
