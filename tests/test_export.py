"""An exported policy: the same actions bit for bit; damaged and foreign files are refused."""

import dataclasses
import errno
import io
import json
import os
import pathlib
import re
import shutil
import subprocess
import sys

import imageio.v3 as imageio
import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest
import safetensors.numpy
import tiny
import tiny_pixels
import toy
from analysis_records import make_policy
from refusals import refused

import vawm
from vawm import evaluate, export
from vawm.agent import make_agent
from vawm.config import GymnasiumConfig
from vawm.envs import made as records
from vawm.envs.protocol import Environment
from vawm.learning import train
from vawm.policy import hub, policy, weights
from vawm.policy.play import Score
from vawm.runs import checkpoint, suites
from vawm.runs.checkpoint import SaveError, manifest

STEPS = 3


@pytest.fixture(scope="module")
def logdir(tmp_path_factory):
    """A run with an untrained checkpoint at 32 env steps, and lines of metrics."""
    folder = tmp_path_factory.mktemp("run")
    env = tiny.env()
    agent = make_agent(tiny.CONFIG, env.spec)
    state = jax.jit(lambda key: train.init(env, agent, tiny.CONFIG, key))(jax.random.key(3))
    checkpoint.save(folder, state, env_steps=32, config=tiny.CONFIG, spec=env.spec, progress={})
    lines = [(16, 0.25, 3), (32, None, 0), (48, 9.0, 1)]
    text = "".join(
        json.dumps({"env_steps": s, "episode/return": r, "episode/count": n}) + "\n"
        for s, r, n in lines
    )
    (folder / "metrics.jsonl").write_text(text)
    return folder


@pytest.fixture(scope="module")
def exported(logdir, tmp_path_factory):
    return export.export(logdir, tmp_path_factory.mktemp("exports") / "policy")


@pytest.fixture
def copy(exported, tmp_path):
    return shutil.copytree(exported, tmp_path / "policy")


def test_the_weights_are_restored_bit_for_bit(logdir, exported):
    trained, loaded = policy.load(logdir), vawm.load(exported)
    toy.assert_equal((loaded.params, loaded.model_state), (trained.params, trained.model_state))
    assert loaded[:3] == trained[:3] == (tiny.CONFIG, tiny.env().spec, 32)
    names = sorted(path.name for path in exported.iterdir())
    assert names == ["README.md", "config.json", "model.safetensors"]
    assert len({path.stat().st_mode for path in exported.iterdir()}) == 1
    assert list(exported.parent.iterdir()) == [exported]


ACT = """
import pathlib, sys
import jax, numpy as np, vawm
from vawm.process import cache
from vawm.types import TimeStep

cache.enable()
policy = vawm.load(sys.argv[1])
carry, actions = policy.initial(2), []
with np.load(sys.argv[2]) as seen:
    steps = [TimeStep(*(seen[f"{name}{i}"] for name in TimeStep._fields)) for i in range(3)]
for i, timestep in enumerate(steps):
    carry, action = policy.act(jax.random.key(i), carry, timestep)
    actions.append(action)
np.save(sys.argv[3], np.stack(actions))
"""


def test_a_process_that_never_trained_acts_bit_for_bit_the_same(logdir, exported, tmp_path):
    trained, env = policy.load(logdir), tiny.env()
    env_state, timestep = env.reset(jax.random.key(7))
    carry, actions, seen = trained.initial(2), [], {}
    for i in range(STEPS):
        seen |= {f"{name}{i}": np.asarray(x) for name, x in timestep._asdict().items()}
        carry, action = trained.act(jax.random.key(i), carry, timestep)
        actions.append(np.asarray(action))
        env_state, timestep = env.step(env_state, action)
    np.savez(tmp_path / "seen.npz", **seen)
    moved = shutil.copytree(exported, tmp_path / "elsewhere")
    path = str(pathlib.Path(vawm.__file__).parents[1])
    files = [str(moved), str(tmp_path / "seen.npz"), str(tmp_path / "actions.npy")]
    subprocess.run(
        [sys.executable, "-c", ACT, *files],
        env=os.environ | {"PYTHONPATH": path},
        cwd=tmp_path,
        check=True,
        timeout=300,
    )
    there = np.load(tmp_path / "actions.npy")
    assert np.abs(there).max() > 0
    assert there.tobytes() == np.stack(actions).tobytes()


def lines_of(text):
    """The indented lines of a text."""
    return "\n".join(line[4:] for line in text.splitlines() if line.startswith("    "))


@pytest.mark.parametrize(
    ("task", "changes"),
    [
        ("cartpole_swingup", {}),
        ("CartPole-v1", {"suite": "gymnasium", "env": GymnasiumConfig(workers=1)}),
    ],
)
def test_the_documented_lines_act_in_a_process_that_never_trained(tmp_path, task, changes):
    """The lines of the docstring and of the model card."""
    config = tiny.config(task=task, size="custom", **changes)
    made = suites.make(config)
    agent = make_agent(config, made.spec)
    trained = policy.Policy(config, made.spec, 32, *agent.init(jax.random.key(0)), None, None)
    if not isinstance(made, Environment):
        made.close()
    card = export.card(trained, "")
    usual = {"config": config, "spec": made.spec, "env_steps": 32, "card": card}
    weights.write(tmp_path / "cartpole", trained.params, trained.model_state, **usual)
    shown = card.partition("```python\n")[2].partition("```")[0]
    blocks = [shown.replace("FOLDER", "cartpole")]
    if not changes:
        blocks.append(lines_of(export.__doc__.partition("--episodes 10")[2]))
        assert len(blocks[-1].splitlines()) == 5
    check = "assert action in env.action_space\n"
    subprocess.run(
        [sys.executable, "-c", "".join(f"{block}\n{check}" for block in blocks)],
        env=os.environ | {"PYTHONPATH": str(pathlib.Path(vawm.__file__).parents[1])},
        cwd=tmp_path,
        check=True,
        timeout=300,
    )


@pytest.mark.parametrize("task", [tiny.CONFIG.task, "cartpole_swingup"])
def test_the_card_of_a_users_environment_does_not_make_it(exported, task):
    """Whatever task its config has, such as that of a preset."""
    loaded = vawm.load(exported)
    config = dataclasses.replace(loaded.config, task=task)
    card = export.card(loaded._replace(config=config), "")
    assert "policy.predict(" in card
    assert "make_env(" not in card


def test_a_policy_of_another_version_is_loaded_with_a_warning(exported, monkeypatch, caplog):
    before = manifest.version()
    monkeypatch.setattr(manifest, "version", lambda: "9.9.9")
    vawm.load(exported)
    [record] = [record for record in caplog.records if record.name == "vawm"]
    assert record.levelname == "WARNING"
    assert f"vawm {before}" in record.getMessage()
    assert "vawm 9.9.9" in record.getMessage()


@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.float16, jnp.int32, bool])
def test_every_dtype_and_the_state_of_a_world_model_are_kept(tmp_path, dtype):
    params = {"a": {"b/c": jnp.arange(6).reshape(2, 3).astype(dtype)}, "scalar": jnp.float32(2)}
    state = {"mean": jnp.arange(3.0), "empty": jnp.zeros((2, 0))}
    spec, folder = tiny.env().spec, tmp_path / "policy"
    weights.write(
        folder, params, state, config=tiny.CONFIG, spec=spec, env_steps=1, card="a card"
    )
    description = weights.describe(folder)
    assert (description.config, description.spec) == (tiny.CONFIG, spec)
    shapes = jax.eval_shape(lambda: (params, state))
    toy.assert_equal(weights.read(folder, description, *shapes), (params, state))
    with refused("output", str(folder)):
        weights.write(folder, {}, {}, config=tiny.CONFIG, spec=spec, env_steps=1, card="")


def test_names_are_paths_and_nothing_is_pickled(exported):
    stored = safetensors.numpy.load_file(exported / weights.MODEL)
    assert all(name.startswith(("params.", "model_state")) for name in stored)
    assert any(name.startswith("params.actor[") for name in stored)
    size = json.loads((exported / weights.MODEL).read_bytes()[8:].split(b"}}")[0] + b"}}")
    assert size["__metadata__"] == {"format": "np"}


# The model card


def test_the_card_says_what_was_trained_and_that_it_was_not_evaluated(exported):
    text = (exported / weights.CARD).read_text()
    for said in [
        "| task | probe_observation_action (dmc_proprio) |",
        "| agent | dreamerv3 |",
        "| preset | custom |",
        "| env steps | 32 of 96, action repeat 1 |",
        "| seed | 0 |",
        "| value alignment | weight 1 / max(1, KL) after a warm-up of 24 env steps |",
        "Not evaluated",
        "0.2, the mean over 3 episodes that ended shortly before 16 env steps",
        "python -m vawm.evaluate --logdir FOLDER",
        "Apache-2.0",
    ]:
        assert said in text, text


def test_the_card_has_the_scores_of_an_evaluation_and_its_protocol(logdir, tmp_path):
    folder = export.export(logdir, tmp_path / "policy", scores=Score((1.0, 3.0)))
    text = (folder / weights.CARD).read_text()
    assert "return 2.0 +- 1.0 over 2 episodes (whole episodes of 1000" in text
    assert "Not evaluated" not in text


def changed(**changes):
    alignment = tiny.CONFIG.value_alignment
    return tiny.config(value_alignment=type(alignment)(**changes))


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        (changed(weight="off"), "off"),
        (changed(weight="static", warmup_steps=8), "weight 0.5 after a warm-up of 8 env steps"),
        (changed(), "not active: training ended within the warm-up of 10,000 env steps"),
        (
            changed(warmup_unit="updates", warmup_steps=5),
            "weight 1 / max(1, KL) after a warm-up of 5 updates",
        ),
    ],
)
def test_the_card_says_what_value_alignment_was(exported, config, expected):
    text = export.card(vawm.load(exported)._replace(config=config), "")
    assert f"| value alignment | {expected} |" in text


# For hubs


def front_matter(folder):
    """The head of a card, by a reader of YAML."""
    yaml = pytest.importorskip("yaml")
    return yaml.safe_load((folder / weights.CARD).read_text().split("---\n")[1])


def test_a_hub_finds_the_score_in_the_card_and_in_the_results(logdir, tmp_path):
    folder = export.export(
        logdir, tmp_path / "policy", scores=Score((1.0, 3.0)), layout="hub", replay=b"film"
    )
    head = front_matter(folder)
    assert (head["library_name"], head["license"]) == ("vawm", "apache-2.0")
    assert head["pipeline_tag"] == "reinforcement-learning"
    assert {"reinforcement-learning", "dreamerv3", tiny.CONFIG.task} <= set(head["tags"])
    [result] = head["model-index"][0]["results"]
    assert result["task"]["type"] == "reinforcement-learning"
    assert result["dataset"] == {"name": tiny.CONFIG.task, "type": tiny.CONFIG.task}
    expected = {"type": "mean_reward", "value": "2.00 +/- 1.00", "verified": False}
    assert expected.items() <= result["metrics"][0].items()
    results = json.loads((folder / hub.RESULTS).read_text())
    assert (results["mean_reward"], results["std_reward"]) == (2.0, 1.0)
    assert results["n_eval_episodes"] == 2
    assert results["last_training_return"] == {"mean": 0.25, "episodes": 3, "env_steps": 16}
    assert (folder / hub.REPLAY).read_bytes() == b"film"


def test_a_hub_folder_is_loaded_even_through_links(logdir, tmp_path):
    """As the cache of a hub has them: every file is a link."""
    folder = export.export(logdir, tmp_path / "policy", layout="hub")
    assert "model-index" not in front_matter(folder)
    linked = tmp_path / "snapshot"
    linked.mkdir()
    for path in folder.iterdir():
        (linked / path.name).symlink_to(path)
    trained, loaded = policy.load(logdir), vawm.load(linked)
    toy.assert_equal(loaded.params, trained.params)
    assert loaded.last_return == trained.last_return == (0.25, 3, 16)


@pytest.mark.parametrize("damage", [{"mean": "x"}, {"episodes": -1}, {"more": 1}])
def test_a_damaged_return_is_refused(copy, damage):
    content = json.loads((copy / weights.CONFIG).read_text())
    content["last_return"] |= damage
    (copy / weights.CONFIG).write_text(json.dumps(content))
    with refused("weights", str(copy / weights.CONFIG)):
        vawm.load(copy)


def test_the_program_says_why_there_is_no_film(logdir, tmp_path, capsys):
    argv = ["--logdir", str(logdir), "--output", str(tmp_path / "policy")]
    assert export.main([*argv, "--format", "hub", "--episodes", "0"]) == 0
    assert f"without {hub.REPLAY}: " in capsys.readouterr().out
    names = sorted(path.name for path in (tmp_path / "policy").iterdir())
    assert names == ["README.md", "config.json", "model.safetensors", "results.json"]


def test_a_film_shows_what_the_environment_draws():
    """Of the first steps of an episode, large enough to look at."""
    config = tiny_pixels.config(task="vawm/GridWorld-v0", video=tiny.CONFIG.video, num_envs=1)
    env = dataclasses.replace(config.env, time_limit=3)
    config = dataclasses.replace(config, env=env)
    with suites.make(config) as made:
        spec = made.spec._replace(made=records.of(made))
    film = export.film(make_policy(config, spec))
    drawn = imageio.imread(io.BytesIO(film), extension=".mp4", plugin="FFMPEG")
    assert drawn.shape[0] == 4
    assert min(drawn.shape[1:3]) >= 256
    assert drawn[0, :256, :256].std() > 10  # not of one colour


# Refusals


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_nothing_is_ever_overwritten(logdir, tmp_path, kind):
    there = tmp_path / "there"
    if kind == "folder":
        there.mkdir()
        (there / "mine").write_text("precious")
    else:
        there.write_text("precious")
    with refused("output", str(there)):
        export.export(logdir, there)
    assert sum(path.is_file() for path in tmp_path.rglob("*")) == 1


def test_a_config_that_could_not_be_loaded_is_not_written(tmp_path):
    config, spec = tiny.config(seed=-1), tiny.env().spec
    with refused("seed", -1):
        weights.write(
            tmp_path / "policy", {}, {}, config=config, spec=spec, env_steps=1, card=""
        )
    assert not list(tmp_path.iterdir())


def test_an_empty_folder_is_accepted(logdir, tmp_path):
    (tmp_path / "policy").mkdir()
    assert weights.found(export.export(logdir, tmp_path / "policy"))


def test_a_full_disk_leaves_nothing(logdir, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(pathlib.Path, "write_text", full)
    with pytest.raises(SaveError, match="No space left"):
        export.export(logdir, tmp_path / "policy")
    assert not list(tmp_path.iterdir())


def rewrite(folder, change):
    """Replaces the weights by `change(weights)`, and updates the checksum."""
    stored = change(safetensors.numpy.load_file(folder / weights.MODEL))
    safetensors.numpy.save_file(stored, folder / weights.MODEL)
    content = json.loads((folder / weights.CONFIG).read_text())
    content["sha256"] = manifest.sha256(folder / weights.MODEL)
    (folder / weights.CONFIG).write_text(json.dumps(content))


def first(stored):
    return min(stored)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: {k: v for k, v in s.items() if k != first(s)}, "missing, .*float32"),
        (lambda s: s | {"more": np.zeros(2, np.float32)}, r"more is float32\[2\]"),
        (lambda s: s | {first(s): np.zeros((5, 7), np.float32)}, r"is float32\[5,7\]"),
        (
            lambda s: s | {first(s): s[first(s)].astype(ml_dtypes.bfloat16)},
            r"is bfloat16\[.*\], .*float32",
        ),
        (lambda s: {k + "x": v for k, v in s.items()}, "and [0-9]+ more"),
    ],
)
def test_weights_of_another_model_are_a_difference_in_one_line(copy, change, message):
    rewrite(copy, change)
    with refused("weights", str(copy / weights.MODEL), naming=weights.CONFIG) as error:
        vawm.load(copy)
    assert re.search(message, error.value.remedy)


def flip(data):
    return data[:-2] + bytes([data[-2] ^ 1]) + data[-1:]


@pytest.mark.parametrize(
    ("name", "change", "named"),
    [
        ("model.safetensors", flip, "checksum"),
        ("model.safetensors", lambda data: data[:-8], "not fully covered"),
        ("model.safetensors", lambda data: b"", "header too small"),
        ("model.safetensors", None, ""),
        ("config.json", lambda data: data[:50], "JSONDecodeError"),
        ("config.json", lambda data: b"[]", "TypeError"),
        ("config.json", lambda data: b"\xff\xfe", "JSONDecodeError"),
        ("config.json", None, "No such file"),
        ("config.json", lambda data: b"[" * 200_000, "RecursionError"),
        ("config.json", lambda data: data + b" " * 2**24, "16777216"),
        ("config.json", lambda data: data.replace(b": 32,", b": Infinity,"), "OverflowError"),
        ("config.json", lambda data: data.replace(b'"schema": 1', b'"schema": 2'), "schema=2"),
        ("config.json", lambda data: data.replace(b'"seed": 0', b'"seed": -1'), "seed=-1"),
        ("config.json", lambda data: data.replace(b'"seed"', b'"sede"'), "sede=0"),
        ("config.json", lambda data: data.replace(b'"obs"', b'"abs"'), "obs"),
    ],
)
def test_a_damaged_file_is_one_line(copy, name, change, named):
    path = copy / name
    if change is None:
        path.unlink()
    else:
        path.write_bytes(change(path.read_bytes()))
    with refused("weights", str(path), naming=named):
        vawm.load(copy)


def test_a_folder_of_a_run_is_not_taken_for_an_export(logdir, tmp_path):
    assert not weights.found(logdir)
    assert not weights.found(tmp_path)
    with refused("logdir", str(tmp_path)):
        vawm.load(tmp_path)


# The command line


def test_the_command_line_evaluates_and_exports(logdir, tmp_path, monkeypatch, capsys):
    logdir = shutil.copytree(logdir, tmp_path / "run")
    asked = []

    def fake(policy, **kwargs):
        """Plays while the run continues."""
        asked.append((policy.env_steps, kwargs))
        agent, key = make_agent(tiny.CONFIG, policy.spec), jax.random.key(1)
        newer = train.init(tiny.env(), agent, tiny.CONFIG, key)
        usual = {"config": tiny.CONFIG, "spec": policy.spec, "progress": {}}
        checkpoint.save(logdir, newer, env_steps=40, **usual)
        return Score((1.0, 3.0))

    monkeypatch.setattr(evaluate, "by_protocol", fake)
    monkeypatch.setattr(export.cache, "enable", lambda: None)
    words = ["--logdir", str(logdir), "--output", str(tmp_path / "policy")]
    assert export.main([*words, "--episodes", "2", "--seed", "5"]) == 0
    assert asked == [(32, {"episodes": 2, "seed": 5})]
    assert "return 2.0 +- 1.0 over 2 episodes" in capsys.readouterr().out
    assert "2.0 +- 1.0" in (tmp_path / "policy" / weights.CARD).read_text()
    assert vawm.load(logdir).env_steps == 40
    assert vawm.load(tmp_path / "policy").env_steps == 32  # the policy with the score


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--logdir", "."], "--output=None: "),
        (["--logdir", ".", "--output", "."], "output='.': "),
        (["--logdir", ".", "--output", "new"], "logdir='.': "),
        (["--logdir", ".", "--output", "new", "--episodes", "-1"], "episodes=-1: "),
    ],
)
def test_bad_input_is_one_line_and_code_2(tmp_path, monkeypatch, capsys, words, message):
    (tmp_path / "mine").write_text("precious")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(export.cache, "enable", lambda: None)
    assert export.guard(lambda: export.main(words)) == 2
    assert capsys.readouterr().err.startswith(f"error: {message}")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
