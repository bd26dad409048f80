"""Two processes that take turns: the orders they get, and the table of their answers."""

import io
import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from vawm import presets
from vawm.agent import make_agent
from vawm.learning import host_train
from vawm.runs import trainer
from vawm.runs.runner import RunError
from vawm.sweep import costs, overhead
from vawm.sweep.runs import Run, Sweep, Variant

# Answers as `vawm.sweep.overhead` does, and records the order of the calls.
PROGRAM = """
import json, sys
log, name = sys.argv[1], sys.argv[3]
if name == "broken":
    sys.exit(7)
ready = {"updates": 2, "env_steps": 32, "compile_s": 5.0, "run_env_steps": 3200}
print(json.dumps(ready), flush=True)
seconds = 0.0
for word in sys.stdin:
    if word == "finish\\n":
        break
    seconds += 1.0
    with open(log, "a") as file:
        file.write(name + " ")
    factor = 2.0 if name == "on" else 1.0
    print(json.dumps({"seconds": factor * seconds}), flush=True)
print(json.dumps({"peak_bytes": 3 * 2**30 if name == "on" else 2 * 2**30}), flush=True)
"""


@pytest.fixture
def log(tmp_path, monkeypatch):
    script, path = tmp_path / "program.py", tmp_path / "log"
    script.write_text(PROGRAM)
    monkeypatch.setattr(overhead, "COMMAND", (sys.executable, str(script), str(path)))
    return path


def test_variants_take_turns_and_the_first_samples_do_not_count(log):
    on, off = overhead.compare("dmc_proprio", [["on"], ["off"]], repeats=3)
    assert log.read_text().split() == ["off", "on", "on", "off"] * 2 + ["off", "on"]
    assert (on.seconds, off.seconds) == ([6.0, 8.0, 10.0], [3.0, 4.0, 5.0])
    assert (on.peak_bytes, off.peak_bytes) == (3 * 2**30, 2 * 2**30)
    assert on.run_hours == pytest.approx(100 * 8.0 / 3600)


def test_a_variant_that_cannot_be_measured_is_named(log):
    with pytest.raises(RunError, match=r"broken .*7"):
        overhead.compare("dmc_proprio", [["on"], ["broken"]], repeats=1)


def test_the_table_equals_one_computed_by_hand(log):
    owned = [Run("task", name, 0) for name in ("on", "off")]
    rows = costs.rows_of(owned, overhead.compare("any", [["on"], ["off"]], repeats=3))
    table = costs.markdown(rows, notes="Two.", command="python it.py").splitlines()
    assert table[0] == "Two."
    assert table[6:8] == [
        "| task | on | 8 (7 to 9) | 100.0 % (100.0 to 100.0) | 3.00 GiB (+50.0 %) | 0.222 |",
        "| task | off | 4 (3.5 to 4.5) | - | 2.00 GiB | 0.111 |",
    ]
    assert "task: 2 updates and 32 environment steps per sample, 3 samples." in table


def test_the_numbers_are_written_and_drawn(log, tmp_path):
    variants = tuple(Variant(name, ()) for name in ("on", "off"))
    sweep = Sweep(tmp_path, tmp_path, variants, ("task",), (0,))
    owned = [Run("task", name, 0) for name in ("on", "off")]
    rows = costs.rows_of(owned, overhead.compare("any", [["on"], ["off"]], repeats=1))
    costs.write_csv(rows, tmp_path / "a.csv")
    heads, first, _ = (tmp_path / "a.csv").read_text().splitlines()
    cells = dict(zip(heads.split(","), first.split(","), strict=True))
    assert (cells["seconds"], cells["overhead_percent"], cells["peak_gib"]) == ("6", "100", "3")
    costs.plot(rows, sweep, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("count", [2, 5, 8])
def test_quartiles_are_those_of_numpy(count):
    values = np.random.default_rng(count).normal(size=count)
    expected = np.percentile(values, [25, 75])
    np.testing.assert_allclose(overhead.quartiles(values.tolist()), expected)


@pytest.mark.parametrize(
    ("config", "steps"),
    [
        (presets.QUICK, 1),  # 8 steps of 64: two updates of 256
        (presets.PAPER, 1),
        (presets.ATARI_PAPER, 4),  # 256 of the 1024 of an update
        (presets.STORM, 1),
        (tiny.config(train_ratio=3, collect_steps=1), 8),  # 6 of the 16 of an update
    ],
)
def test_a_sample_has_a_whole_number_of_updates(config, steps):
    earned = config.num_envs * config.collect_steps * config.train_ratio
    owed = [earned * n % config.replay.batch_steps for n in range(1, steps + 1)]
    assert overhead.steps_of_a_sample(config) == steps
    assert owed[-1] == 0
    assert all(owed[:-1])


EXECUTABLES = tuple(
    jax.jit(lambda x: x @ x + x.sum(), donate_argnums=donate)
    .lower(jax.ShapeDtypeStruct((size, size), jnp.float32))
    .compile()
    for size, donate in ((8, ()), (64, 0))
)


def test_planned_memory_is_of_the_largest_program_and_counts_donated_arguments_once():
    fresh, donated = EXECUTABLES
    temporaries = [each.memory_analysis().temp_size_in_bytes for each in EXECUTABLES]
    assert overhead.planned_bytes([fresh]) == 2 * 4 * 8**2 + temporaries[0]
    assert overhead.planned_bytes([donated]) == 4 * 64**2 + temporaries[1]
    assert overhead.planned_bytes(EXECUTABLES) == overhead.planned_bytes([donated])


class FakeTrainer:
    """A trainer with an update in every fourth step."""

    init = staticmethod(lambda seed: 0)
    compile = staticmethod(lambda state: trainer.CompiledStep(FakeTrainer.step, EXECUTABLES))
    close = staticmethod(lambda: None)

    @staticmethod
    def step(state):
        return state + 1, {"chunk/updates": np.int32(state % 4 == 3)}


def test_the_process_answers_every_line(monkeypatch):
    rules, answers = [], io.StringIO()

    def prepare(config, *, kept):
        rules.append(kept)
        return FakeTrainer()

    monkeypatch.setattr(overhead.runner, "prepare", prepare)
    asked = io.StringIO("sample\nsample\nfinish\nsample\n")
    flags = ["--value-alignment.weight", "off", "--env-steps", "40000"]
    assert overhead.main("dmc_proprio", flags, asked, answers) == 0
    ready, *timed, peak = map(json.loads, answers.getvalue().splitlines())
    assert (ready["updates"], ready["env_steps"]) == (2, 32)
    assert ready["run_env_steps"] == 40_000
    assert len(timed) == 2
    assert all(answer["seconds"] > 0 for answer in timed)
    assert peak["peak_bytes"] == overhead.planned_bytes(EXECUTABLES)
    assert rules[0]("loss/actor")
    assert not rules[0]("loss/value_alignment")


def test_metrics_that_are_not_kept_are_not_computed(monkeypatch):
    def two(*state):
        return (*state, {"kept": jnp.zeros(()), "dropped": jnp.ones(())})

    monkeypatch.setattr(trainer.train, "make_train_step", lambda *_: two)
    monkeypatch.setattr(trainer.train, "init", lambda *_: jnp.zeros(()))
    env = tiny.env()
    agent = make_agent(tiny.CONFIG, env.spec)
    made = trainer.on_device(env, agent, tiny.CONFIG, lambda name: name == "kept")
    _, metrics = made.compile(jnp.zeros(())).run(jnp.zeros(()))
    assert list(metrics) == ["kept"]

    monkeypatch.setattr(
        host_train.from_replay,
        "make_update_at",
        lambda *_: lambda learner, buffer, *_: two(0, 0),
    )
    update = host_train._make_update(None, tiny.CONFIG, lambda name: name == "kept")
    key = host_train.jax.random.key(0)
    assert list(update((), (), (), (), key, 0, 0)[2]) == ["kept"]
