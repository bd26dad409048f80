"""Settings of JAX for the whole process: what changes nothing, and what is refused."""

import contextlib
import os
import re
import subprocess
import sys

import jax
import numpy as np
import pytest
import tiny
import tiny_storm
import tiny_vagram
from refusals import refused
from runs import assert_same, quiet

import vawm
from vawm.agent import make_agent
from vawm.learning import train
from vawm.runs import resume, runner, settings


@pytest.fixture(scope="module")
def usual(tmp_path_factory):
    """A whole tiny run under JAX's usual settings."""
    logdir = tmp_path_factory.mktemp("usual")
    runner.run(tiny.CONFIG, logdir, env=tiny.env(), console=quiet())
    return logdir


SETTINGS = {
    "x64": lambda: jax.enable_x64(True),
    "strict": lambda: jax.numpy_dtype_promotion("strict"),
    "nans": lambda: jax.debug_nans(True),
    "infs": lambda: jax.debug_infs(True),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_a_run_is_the_same_bit_for_bit(usual, tmp_path, name):
    with SETTINGS[name]():
        runner.run(tiny.CONFIG, tmp_path, env=tiny.env(), console=quiet())
    assert_same(tmp_path, usual, tiny.CONFIG, tiny.env())


@pytest.mark.parametrize("config", [tiny.CONFIG, tiny_storm.CONFIG, tiny_vagram.CONFIG])
def test_no_array_is_float64_under_x64(config):
    """Scalars may be: Python's floats, before they are converted."""
    with jax.enable_x64(True):
        env = tiny.env()
        agent = make_agent(config, env.spec)
        key = jax.random.key(0)
        state = jax.eval_shape(lambda key: train.init(env, agent, config, key), key)
        text = jax.jit(train.make_train_step(env, agent, config)).lower(state).as_text()
    assert not re.findall(r"tensor<[0-9x]+xf64>", text)
    assert {str(x.dtype) for x in jax.tree.leaves(state)} <= {
        "float32",
        "int32",
        "bool",
        "uint8",
        "key<fry>",
    }


@pytest.mark.parametrize("config", [tiny_storm.CONFIG, tiny_vagram.CONFIG])
def test_other_agents_need_no_promotion_of_dtypes(config):
    with jax.numpy_dtype_promotion("strict"):
        env = tiny.env()
        agent = make_agent(config, env.spec)
        key = jax.random.key(0)
        state = jax.eval_shape(lambda key: train.init(env, agent, config, key), key)
        jax.eval_shape(train.make_train_step(env, agent, config), state)


def test_float64_of_an_environment_becomes_float32():
    plain = tiny.env()

    def in_float64(made):
        state, timestep = made
        return state, timestep._replace(
            obs=timestep.obs.astype("float64"), reward=timestep.reward.astype("float64")
        )

    env = plain._replace(
        reset=lambda key: in_float64(plain.reset(key)),
        step=lambda state, action: in_float64(plain.step(state, action)),
    )
    with jax.enable_x64(True):
        agent = make_agent(tiny.CONFIG, env.spec)
        key = jax.random.key(0)
        state = jax.eval_shape(lambda key: train.init(env, agent, tiny.CONFIG, key), key)
        after, _ = jax.eval_shape(train.make_train_step(env, agent, tiny.CONFIG), state)
    assert after.collector.timestep.reward.dtype == after.collector.timestep.obs.dtype
    assert after.collector.timestep.reward.dtype == np.float32
    assert after.collector.env_steps.dtype == np.int32


def test_a_policy_loads_under_x64(usual):
    expected = vawm.load(usual)
    with jax.enable_x64(True):
        policy = vawm.load(usual)
    for x, y in zip(
        jax.tree.leaves(policy.params), jax.tree.leaves(expected.params), strict=True
    ):
        assert x.dtype == y.dtype == np.float32
        assert (np.asarray(x) == np.asarray(y)).all()


@pytest.mark.parametrize("value", ["disallow", "disallow_explicit"])
def test_a_guard_against_transfers_is_refused(tmp_path, value):
    logdir = tmp_path / "run"
    with jax.transfer_guard(value):
        for start in (lambda: runner.run(tiny.CONFIG, logdir), lambda: vawm.load(logdir)):
            field = "JAX_TRANSFER_GUARD_HOST_TO_DEVICE"
            with refused(field, value, naming="log"):
                start()
    assert not logdir.exists()


def test_running_without_compiling_is_refused(tmp_path):
    with jax.disable_jit(), refused("JAX_DISABLE_JIT", True):
        runner.run(tiny.CONFIG, tmp_path / "run", env=tiny.env(), console=quiet())
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("error", [RuntimeError("no cuda\nand more"), AssertionError()])
def test_a_platform_without_a_device_is_refused(monkeypatch, error):
    def devices():
        raise error

    monkeypatch.setattr(jax, "devices", devices)
    with refused("JAX_PLATFORMS", naming=str(error).partition("\n")[0]):
        settings.check()


@pytest.mark.parametrize("impl", ["rbg", "unsafe_rbg"])
def test_a_run_is_not_resumed_with_another_generator(usual, impl):
    longer = tiny.config(env_steps=128)
    resume.check(usual, longer)
    with (
        jax.default_prng_impl(impl),
        refused("JAX_DEFAULT_PRNG_IMPL", impl, naming="threefry2x32"),
    ):
        resume.check(usual, longer)


def test_other_random_bits_are_said(usual, tmp_path):
    from vawm.runs.checkpoint import manifest

    before = manifest.computed()
    with contextlib.ExitStack() as stack:
        stack.enter_context(jax.threefry_partitionable(False))
        assert manifest.computed() != before
        assert "jax_threefry_partitionable=False" in manifest.computed()


@pytest.mark.parametrize("module", ["vawm.evaluate", "vawm.export", "vawm.cli.command_line"])
def test_stripped_docstrings_are_refused_in_one_line(module):
    program = subprocess.run(
        [sys.executable, "-m", module],
        env=os.environ | {"PYTHONOPTIMIZE": "2"},
        capture_output=True,
        text=True,
    )
    assert program.returncode == 2
    assert "PYTHONOPTIMIZE=2" in program.stderr
    assert program.stderr.count("\n") == 1
