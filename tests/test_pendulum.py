"""A whole run on real physics: trained, resumed, evaluated, used as README and guide say."""

import dataclasses
import pathlib
import re

import jax
import pytest
import runs
import tiny
from gymnasium.envs.classic_control import CartPoleEnv

import vawm
from vawm import envs, evaluate, presets
from vawm.config import GymnasiumConfig
from vawm.runs import checkpoint, runner

CONFIG = tiny.config(
    task="pendulum_swingup", action_repeat=20, env_steps=3000, log_every=320, save_every=960
)  # 160 env steps per chunk; an episode ends at 2000
ROOT = pathlib.Path(__file__).parents[1]
README, GUIDE = ROOT / "README.md", ROOT / "docs" / "guides" / "proprio.md"


def snippets(page):
    return re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)


@pytest.fixture(scope="module")
def logdir(tmp_path_factory):
    """The folder of an uninterrupted run."""
    logdir = tmp_path_factory.mktemp("pendulum")
    assert runner.run(CONFIG, logdir, console=runs.quiet()).exit_code == 0
    return logdir


def test_the_simulation_is_part_of_the_checkpoint(logdir):
    state, manifest = checkpoint.restore(logdir, runner.prepare(CONFIG).shapes)
    assert isinstance(state.collector.env_state, envs.EnvState)
    # Chunks of 4 calls: 19 make 3000 env steps of 2 environments, a reset among them.
    assert state.collector.env_state.steps.tolist() == [500, 500]
    assert manifest.spec.task == CONFIG.task


def test_resuming_on_mjx_equals_a_run_in_one_piece(logdir, tmp_path):
    first = tiny.dataclasses.replace(CONFIG, env_steps=1280)
    runner.run(first, tmp_path, console=runs.quiet())
    runner.run(CONFIG, tmp_path, resume=True, console=runs.quiet())
    runs.assert_same(tmp_path, logdir, CONFIG)


def test_both_simulations_report_whole_episodes(logdir, capsys):
    flags = ["--logdir", str(logdir), "--episodes", "2", "--physics", "mujoco"]
    assert evaluate.main(flags) == 0
    title, *scores = capsys.readouterr().out.splitlines()
    assert title.startswith("pendulum_swingup (dmc_proprio) at 3000 env steps")
    assert [score.split()[0] for score in scores] == ["mjx", "mujoco"]
    for score in scores:
        assert score.endswith("over 2 episodes")
        assert 0 <= float(score.split()[1]) <= 1000


def snippet(name, page=README):
    """The one block of Python of a page that mentions `name`."""
    (found,) = [text for text in snippets(page) if name in text]
    return found


def test_the_readme_loads_a_checkpoint_and_acts(logdir, monkeypatch):
    monkeypatch.chdir(logdir.parent)
    names = {}
    exec(snippet("vawm.load").replace("LOGDIR", logdir.name), names)
    assert names["action"] in names["env"].action_space
    assert (names["terminated"], names["truncated"]) == (False, True)
    assert "last training return: " in str(names["policy"])
    assert "not known" not in str(names["policy"])


def test_the_guide_makes_environments():
    names = {}
    exec(snippet("gymnasium.make_vec", GUIDE), names)
    assert names["env"].spec.num_envs == 64
    assert names["gym_env"].num_envs == 64


def test_the_guide_stacks_seeds(monkeypatch):
    monkeypatch.setattr(presets, "QUICK", tiny.CONFIG)
    monkeypatch.setattr(envs, "make", lambda *_, **__: tiny.env())
    names = {}
    with jax.debug_key_reuse(False):  # it takes a slice of a batch of keys for all of them
        exec(snippet("over_seeds", GUIDE), names)
    assert names["metrics"]["env_steps"].tolist() == [8] * 8


def test_the_readme_trains_in_an_environment_of_ones_own(tmp_path, monkeypatch):
    settings = {"suite": "gymnasium", "env": GymnasiumConfig(workers=1)}
    monkeypatch.setattr(presets, "GYMNASIUM_QUICK", tiny.config(**settings))
    monkeypatch.chdir(tmp_path)
    names = {"MyEnv": CartPoleEnv, "dataclasses": dataclasses, "presets": presets}
    exec(snippet("from_gymnasium"), names | {"runner": runner, "vawm": vawm})
    assert runs.lines(tmp_path / "runs" / "my_env")[-1]["env_steps"] >= 96


def test_every_snippet_of_the_readme_is_run_here():
    """The losses of the README in `test_docs.py`."""
    assert len(snippets(README)) == 3
