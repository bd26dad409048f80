"""Batch and environments spread over two devices; this file, run as a script, has two."""

import functools
import os
import subprocess
import sys
import tempfile

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tiny
import toy
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from toy_batch import batch

from vawm.agent import make_agent
from vawm.learning import train
from vawm.learning.collector import make_collect
from vawm.learning.update import make_update
from vawm.process import cache
from vawm.runs import checkpoint

QUICKLY = {"xla_backend_optimization_level": 0}  # each is compiled twice and run twice


def test_two_devices_give_what_one_gives():
    two = {
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": "--xla_force_host_platform_device_count=2",
        "PYTHONPATH": os.pathsep.join(sys.path),  # with tests/support, which pytest adds
    }
    subprocess.run([sys.executable, __file__], env=os.environ | two, check=True)


def put(tree, *axis):
    """On both devices: every array split along its first axis, or whole if none is named."""
    mesh = jax.make_mesh((2,), ("data",), axis_types=(AxisType.Auto,))

    def place(x):
        spec = PartitionSpec(*axis) if x.ndim else PartitionSpec()
        return jax.device_put(x, NamedSharding(mesh, spec))

    return jax.tree.map(place, tree)


def assert_close(actual, expected):
    """Within 1e-4 of the largest number in each array."""
    for a, e in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        a, e = np.asarray(a, np.float64), np.asarray(e, np.float64)
        np.testing.assert_allclose(a, e, rtol=0, atol=1e-4 * abs(e).max(initial=0.0))


def check_update(update, learner, data):
    arguments = jax.random.key(1), jnp.asarray(1000)
    expected = update(learner, data, (), *arguments)
    actual = update(put(learner), put(data, "data"), (), *arguments)
    assert not actual[1].deter.sharding.is_fully_replicated
    # Squared gradients: the first update is but their sign.
    squares = (optax.tree.get(after[0].opt_state, "nu") for after in (actual, expected))
    assert_close(*squares)
    assert_close(actual[1:], expected[1:])


def check_collect(collect, state):
    params, model_state = state.learner.params, state.learner.model_state
    key = jax.random.key(1)
    expected = collect(params, model_state, state.collector, state.replay, key)
    actual = collect(
        *put((params, model_state)),
        *put((state.collector, state.replay), "data"),
        key,
    )
    assert not actual[1].trajectory.obs.sharding.is_fully_replicated
    assert_close(actual[1:], expected[1:])


def check_checkpoint(state, spec, config):
    """What two devices save is what one has: every bit, and on one device again."""
    spread = state._replace(
        learner=put(state.learner),
        collector=put(state.collector, "data"),
        replay=put(state.replay, "data"),
    )
    assert len(spread.replay.trajectory.obs.devices()) == 2
    with tempfile.TemporaryDirectory() as folder:
        usual = {"config": config, "spec": spec, "progress": {}}
        checkpoint.save(folder, spread, env_steps=8, **usual)
        restored, _ = checkpoint.restore(folder, jax.eval_shape(lambda: state))
    toy.assert_equal(restored, state)
    assert {len(x.devices()) for x in jax.tree.leaves(restored)} == {1}


def main():
    cache.enable()
    env, config = tiny.env(), tiny.CONFIG
    agent = make_agent(config, env.spec)
    compiled = functools.partial(jax.jit, compiler_options=QUICKLY)
    state = compiled(lambda key: train.init(env, agent, config, key))(jax.random.key(0))
    rng = np.random.default_rng(0)

    def disturb(x):
        """A critic that starts at zero would hide differences."""
        return x + jnp.asarray(0.1 * rng.normal(size=x.shape), x.dtype)

    learner = state.learner._replace(params=jax.tree.map(disturb, state.learner.params))
    check_update(compiled(make_update(agent, config)), learner, batch(agent))
    check_collect(compiled(make_collect(env, agent, config)), state)
    check_checkpoint(state._replace(learner=learner), env.spec, config)


if __name__ == "__main__":
    main()
