"""A world model from outside of the package goes everywhere that the package's own go."""

import dataclasses
import importlib.util
import json
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
import toy_batch
from analysis_records import make_episodes

import vawm
from vawm import evaluate, export
from vawm.agent import Agent, make_agent, registry
from vawm.analysis import values
from vawm.cli import command_line
from vawm.envs import probes
from vawm.learning import train
from vawm.runs import runner
from vawm.sweep import runs
from vawm.sweep.runs import Sweep, Variant

FOLDER = pathlib.Path(__file__).parents[2] / "experiments"
PATH = FOLDER / "own_world_model.py"


@pytest.fixture(scope="module", autouse=True)
def own():
    """The program as a module; what it registers is gone after these tests."""
    rows = dict(registry._ROWS)
    spec = importlib.util.spec_from_file_location(PATH.stem, PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[PATH.stem] = module  # where dataclasses look their types up
    spec.loader.exec_module(module)
    yield module
    registry._ROWS.clear()
    registry._ROWS.update(rows)


@pytest.fixture(scope="module")
def config(own):
    model = own.GRUConfig(deter=32, stoch=4, classes=4, units=16, bins=41)
    return tiny.config(agent="gru", world_model=model)


@pytest.fixture(scope="module")
def logdir(config, tmp_path_factory):
    """A run that was stopped half way and went on."""
    folder = tmp_path_factory.mktemp("own") / "run"
    half = dataclasses.replace(config, env_steps=config.env_steps // 2)
    runner.run(half, folder, env=tiny.env())
    runner.run(config, folder, env=tiny.env(), resume=True)
    return folder


def lines(logdir):
    return [json.loads(line) for line in (logdir / "metrics.jsonl").read_text().splitlines()]


def test_it_trains_with_value_alignment(logdir):
    last = lines(logdir)[-1]
    assert last["value_alignment/weight"] > 0
    assert last["loss/value_alignment"] > 0
    assert all(np.isfinite(last[name]) for name in last if name.startswith("loss/"))


def test_a_run_that_was_resumed_equals_one_in_one_piece(config, logdir, tmp_path):
    runner.run(config, tmp_path / "whole", env=tiny.env())
    one, two = vawm.load(tmp_path / "whole"), vawm.load(logdir)
    jax.tree.map(np.testing.assert_array_equal, one.params, two.params)


@pytest.mark.parametrize("noise", ["independent", "shared"])
def test_it_can_be_traced_in_half_precision_as_on_a_gpu(config, noise):
    config = dataclasses.replace(
        config,
        compute_dtype="bfloat16",
        value_alignment=dataclasses.replace(config.value_alignment, noise=noise),
    )
    env = tiny.env()
    agent = make_agent(config, env.spec)
    state = jax.eval_shape(lambda k: train.init(env, agent, config, k), jax.random.key(0))
    after, _ = jax.eval_shape(train.make_train_step(env, agent, config), state)
    assert after == state


def test_with_shared_noise_equal_distributions_give_equal_samples(config, own):
    world_model = own.gru(
        config.world_model, tiny.env().spec, dtype=jnp.float32, noise="shared"
    )
    params, model_state = world_model.init(jax.random.key(0))
    params["prior"] = jax.tree.map(jnp.zeros_like, params["prior"])
    params["post"] = jax.tree.map(jnp.zeros_like, params["post"])
    batch = toy_batch.batch(Agent(tiny.env().spec, world_model, None, None))
    explanation, _ = world_model.explain(params, model_state, jax.random.key(1), batch)
    inference = explanation.inference
    np.testing.assert_array_equal(inference.latent.stoch, inference.prior_latent.stoch)


def test_it_is_evaluated_and_exported(logdir, tmp_path):
    policy = vawm.load(logdir)
    env = probes.make("observation_action", num_envs=3)
    score = evaluate.evaluate(policy, episodes=3, env=env)
    assert np.isfinite(score.returns).all()
    export.export(logdir, tmp_path / "out", policy=policy)
    assert "--plugin own_world_model.py" in (tmp_path / "out" / "README.md").read_text()
    again = vawm.load(tmp_path / "out")
    assert again.config == policy.config
    jax.tree.map(np.testing.assert_array_equal, again.params, policy.params)


def test_it_is_analysed(logdir):
    policy = vawm.load(logdir)
    episodes = make_episodes(policy, episodes=2, length=13)
    report = values.report(policy, episodes, context=3, depth=4, seed=0)
    assert np.isfinite(report.imagined[report.counts]).all()


def test_sweeps_know_it(tmp_path):
    sweep = Sweep(
        program=runs.trains("dmc_proprio"),
        folder=tmp_path,
        variants=(Variant("off", ("--value-alignment.weight", "off")),),
        tasks=("cartpole_balance",),
        seeds=(0,),
        flags=("--agent", "gru", "--preset", "quick"),
        env_steps=None,
    )
    [run] = runs.all_runs(sweep)
    assert runs.parsed(sweep, run, "dmc_proprio").agent == "gru"


def test_the_program_trains_on_mjx(own, tmp_path, monkeypatch):
    monkeypatch.setattr(command_line.cache, "enable", lambda: None)
    sizes = "--world-model.deter 32 --world-model.units 16 --critic.units 16 --actor.units 16"
    batch = "--replay.batch-size 2 --replay.batch-length 8 --imagination.horizon 3"
    run = "--num-envs 2 --env-steps 600 --train-ratio 2 --log-every 100"
    flags = f"{run} {batch} {sizes}"
    logdir = tmp_path / "run"
    assert own.main([*flags.split(), "--logdir", str(logdir), "--no-film"]) == 0
    policy = vawm.load(logdir)
    assert (policy.config.agent, policy.config.task) == ("gru", "cartpole_balance")
    assert lines(logdir)[-1]["updates"] > 0
