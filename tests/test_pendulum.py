"""A whole state with real physics, saved, restored, and played with."""

import jax
import pytest
import tiny
import toy

from vawm import checkpoint, envs, evaluate, train
from vawm.agent import make_agent
from vawm.envs import EnvState

CONFIG = tiny.config(task="pendulum_swingup", action_repeat=20, env_steps=2000)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """The folder of an untrained checkpoint, and its `TrainState`."""
    env = envs.make(CONFIG.task, num_envs=CONFIG.num_envs, action_repeat=CONFIG.action_repeat)
    agent = make_agent(CONFIG, env.spec)
    state = jax.jit(lambda key: train.init(env, agent, CONFIG, key))(jax.random.key(0))
    logdir = tmp_path_factory.mktemp("pendulum")
    checkpoint.save(logdir, state, env_steps=0, config=CONFIG, spec=env.spec, progress={})
    return logdir, state


def test_the_state_of_the_simulation_comes_back_bit_for_bit(saved):
    logdir, state = saved
    assert isinstance(state.collector.env_state, EnvState)
    restored, manifest = checkpoint.restore(logdir, jax.eval_shape(lambda: state))
    toy.assert_equal(restored, state)
    assert manifest.spec.task == CONFIG.task


def test_both_simulations_report_whole_episodes(saved, capsys):
    flags = ["--logdir", str(saved[0]), "--episodes", "2", "--physics", "mujoco"]
    assert evaluate.main(flags) == 0
    title, *scores = capsys.readouterr().out.splitlines()
    assert title.startswith("pendulum_swingup at 0 env steps")
    assert [score.split()[0] for score in scores] == ["mjx", "mujoco"]
    for score in scores:
        assert score.endswith("over 2 episodes")
        assert 0 <= float(score.split()[1]) <= 1000
