"""The ablations: all their runs pass the checks, and one small ablation is run."""

import csv
import dataclasses
import importlib.util
import pathlib
import sys

import pytest
from refusals import refused

from vawm.agent import registry
from vawm.cli import command_line
from vawm.errors import InvalidInput
from vawm.sweep import ablation, children, overhead, runs

FOLDER = pathlib.Path(__file__).parents[2] / "experiments" / "ablations"


def load(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # where dataclasses look their types up
    spec.loader.exec_module(module)
    return module


SCRIPTS = {path.stem: load(path) for path in sorted(FOLDER.glob("*.py"))}
ABLATIONS = {
    found.name: found
    for script in SCRIPTS.values()
    for found in vars(script).values()
    if isinstance(found, ablation.Ablation)
}


def possible(name, scale, agent):
    """Whether the agent has the preset of the scale, and the ablation applies to it."""
    chosen = getattr(ABLATIONS[name], scale)
    config = registry.kind(agent).presets.get(chosen.suite, {}).get(chosen.preset)
    if config is None:
        return False
    if agent == "vagram" and (name == "noise" or name.startswith("capacity")):
        return False
    return name != "replay_gradient" or config.critic.replay_scale > 0


def test_every_script_has_an_ablation():
    assert set(SCRIPTS) == {
        "weight",
        "capacity",
        "overhead",
        "replay_gradient",
        "noise",
        "deter_gradient",
    }
    assert len(ABLATIONS) == 7  # capacity has two


def make(name, scale, agent="dreamerv3", **changes):
    options = ablation.Options(scale=scale, agent=agent, **changes)
    return options, ablation.make_sweep(ABLATIONS[name], options)


def test_without_metrics_earlier_results_are_kept(tmp_path, capsys):
    written = tmp_path / "ablation_noise.md"
    written.write_text("a table")
    flags = ["--collect-only", "--runs", str(tmp_path / "none"), "--results", str(tmp_path)]
    assert command_line.guard(lambda: SCRIPTS["noise"].main(flags)) == 1
    assert str(tmp_path / "none") in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == [written.name]
    assert written.read_text() == "a table"


@pytest.mark.parametrize("agent", registry.names())
@pytest.mark.parametrize("scale", ["quick", "paper"])
@pytest.mark.parametrize("name", ABLATIONS)
def test_every_variant_passes_the_checks(name, scale, agent):
    if not possible(name, scale, agent):
        with pytest.raises(InvalidInput):
            ablation.check(ABLATIONS[name], *make(name, scale, agent))
        return
    options, sweep = make(name, scale, agent)
    ablation.check(ABLATIONS[name], options, sweep)
    suite = ablation.scale_of(ABLATIONS[name], options).suite
    configs = [
        runs.parsed(sweep, runs.Run(sweep.tasks[0], variant.name, 0), suite)
        for variant in sweep.variants
    ]
    assert len(set(configs)) == len(configs) > 1
    agents = {config.agent for config in configs}
    beside = name.startswith("capacity") and agent == "dreamerv3"
    assert agents == ({agent, "vagram"} if beside else {agent})


@pytest.mark.parametrize("name", ABLATIONS)
def test_quick_runs_have_twice_the_updates_of_the_learning_rate_warmup(name):
    options, sweep = make(name, "quick")
    suite = ablation.scale_of(ABLATIONS[name], options).suite
    for variant in sweep.variants:
        config = runs.parsed(sweep, runs.Run(sweep.tasks[0], variant.name, 0), suite)
        first = command_line.validate.smallest_replay(config)
        replayed = (config.env_steps // config.action_repeat - first) * config.train_ratio
        updates = replayed // config.replay.batch_steps
        assert updates >= 2 * config.optimizer.warmup_updates


def compared(name, *fields):
    """The values of `fields` for each variant of the paper's scale."""
    _, sweep = make(name, "paper")
    chosen = {}
    for variant in sweep.variants:
        config = runs.parsed(sweep, runs.Run(sweep.tasks[0], variant.name, 0), "atari100k")
        values = dict(command_line.validate.values(config))
        chosen[variant.name] = tuple(values[field] for field in fields)
    return chosen


def test_variants_set_what_their_names_say():
    weight, alignment = "value_alignment.weight", "value_alignment."
    assert compared("weight", weight, alignment + "static_weight") == {
        "adaptive": ("adaptive", 0.5),
        "static 0.5": ("static", 0.5),
        "static 50": ("static", 50.0),
        "off": ("off", 0.5),
    }
    assert compared("replay_gradient", weight, "critic.replay_gradient") == {
        "adaptive, replay gradient on": ("adaptive", True),
        "adaptive, replay gradient off": ("adaptive", False),
        "off, replay gradient on": ("off", True),
        "off, replay gradient off": ("off", False),
    }
    methods = {
        "adaptive": ("dreamerv3", "adaptive"),
        "off": ("dreamerv3", "off"),
        "vagram": ("vagram", "off"),
    }
    assert compared("capacity_model", "agent", weight, "size") == {
        f"{size} {name}": (*method, size)
        for size in ("1m", "12m", "25m")
        for name, method in methods.items()
    }
    assert compared("capacity_image", "agent", weight, "env.image_size", "size") == {
        f"{size} {name}": (*method, size, "12m")
        for size in (64, 96, 128)
        for name, method in methods.items()
    }
    assert compared("noise", weight, alignment + "noise") == {
        name: ("adaptive", name) for name in ("independent", "shared")
    }
    assert compared("deter_gradient", weight, alignment + "deter_gradient") == {
        name: ("adaptive", name) for name in ("live", "stop")
    }


def test_the_scale_of_the_paper_has_its_games():
    assert make("weight", "paper")[1].tasks == (
        *("alien", "crazy_climber", "demon_attack", "bank_heist", "battle_zone"),
    )
    assert make("capacity_model", "paper")[1].tasks == ("gopher", "krull")


@pytest.mark.parametrize(
    ("script", "words", "message"),
    [
        ("weight", ["--agent", "dreamer"], "--agent='dreamer': "),
        ("weight", ["--scale", "papr"], "--scale='papr': "),
        ("weight", ["--tasks", "walker_wlak"], "task='walker_wlak': "),
        ("noise", ["--seeds", "1", "1"], "seeds=(1, 1): "),
        ("noise", ["--jobs", "0"], "jobs=0: "),
        ("noise", ["--env-steps", "8"], "env_steps=8: "),
        ("noise", ["--env-steps", "0"], "env_steps=0: "),
        ("capacity", ["--agent", "vagram"], "agent='vagram': "),
        ("capacity", ["--vary", "images"], "--vary='images': "),
        ("capacity", ["--runs", "/dev/null/a"], "runs='/dev/null/a': "),
        ("replay_gradient", ["--agent", "storm"], "agent='storm': "),
        ("overhead", ["--repeats", "0"], "repeats=0: "),
        ("overhead", ["--results", "/dev/null/a"], "results='/dev/null/a': "),
    ],
)
def test_bad_input_is_one_line_before_anything_starts(
    script, words, message, capsys, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(children, "run", None)
    monkeypatch.setattr(overhead, "compare", None)
    assert command_line.guard(lambda: SCRIPTS[script].main(words)) == 2
    output = capsys.readouterr()
    assert output.err.startswith(f"error: {message}")
    assert output.err.count("\n") == 1
    assert not output.out
    assert not list(tmp_path.iterdir())


def test_results_are_named_after_scale_and_agent():
    names = [
        ablation.result_name(ABLATIONS["noise"], ablation.Options(scale=scale, agent=agent))
        for scale in ("quick", "paper")
        for agent in ("dreamerv3", "storm")
    ]
    suffixes = ("", "_storm", "_paper", "_storm_paper")
    assert names == ["ablation_noise" + suffix for suffix in suffixes]


def test_the_table_names_the_agent_and_exceptions_from_it():
    notes = [ablation.setting("dreamerv3", make(name, "paper")[1]) for name in ABLATIONS]
    plain = [note.startswith("Agent dreamerv3, preset paper") for note in notes]
    assert plain == [not name.startswith("capacity") for name in ABLATIONS]


def test_the_command_has_all_flags_that_change_the_numbers():
    options = SCRIPTS["capacity"].Options(
        scale="paper", seeds=(0, 1), env_steps=9, jobs=2, vary="image", runs=pathlib.Path("x")
    )
    assert ablation.command(options, "/any/where/capacity.py") == (
        "python experiments/ablations/capacity.py --scale paper --seeds 0 1 --env-steps 9 "
        "--vary image"
    )


TINY = """
--num-envs 2 --train-ratio 3 --log-every 32 --save-every 64
--world-model.deter 32 --world-model.hidden 16 --world-model.stoch 4 --world-model.classes 4
--world-model.units 16 --world-model.blocks 4 --world-model.bins 41
--actor.layers 1 --actor.units 16 --critic.layers 1 --critic.units 16 --critic.bins 41
--imagination.horizon 3 --replay.batch-size 2 --replay.batch-length 8 --env.workers 1
"""


def test_an_ablation_runs_from_end_to_end(tmp_path, capsys):
    scale = ablation.Scale(
        "gymnasium", "quick", ("CartPole-v1",), (0,), 128, tuple(TINY.split())
    )
    small = ABLATIONS["noise"]._replace(quick=scale)
    options = ablation.Options(jobs=2, runs=tmp_path / "runs", results=tmp_path / "results")
    assert ablation.run(small, options, script=str(FOLDER / "noise.py")) == 0
    output = capsys.readouterr()
    table = (tmp_path / "results" / "ablation_noise.md").read_text()
    assert table in output.out
    assert "Not in the means" not in table
    assert "Made by `python experiments/ablations/noise.py`." in table
    assert ablation.HOW_TO_READ_EXTRA in table
    with (tmp_path / "results" / "ablation_noise.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["variant"] for row in rows} == {"independent", "shared"}
    assert int([row["env_steps"] for row in rows if row["variant"] == "shared"][-1]) >= 128
    last = {row["variant"]: row["value_alignment_loss"] for row in rows}
    assert last["independent"] != last["shared"]
    for name in ("ablation_noise.png", "ablation_noise_curves.png"):
        assert (tmp_path / "results" / name).stat().st_size
    sweep = ablation.make_sweep(small, options)
    assert not runs.unfinished_jobs(sweep)
    ablation.check(small, options, sweep)
    longer = dataclasses.replace(options, env_steps=256)
    with refused("value_alignment.warmup_steps", 15, naming="7"):
        ablation.run(small, longer, script=str(FOLDER / "noise.py"))
