"""The estimate before anything is allocated."""

import dataclasses
import pathlib

import jax
import jax.numpy as jnp
import pytest
import tiny

from vawm import config as config_lib
from vawm import memory, train
from vawm.agent import make_agent
from vawm.envs import probes
from vawm.errors import InvalidInput
from vawm.memory import Estimate

NEEDED = Estimate(
    replay=1000 * 2**20,
    replay_capacity=1000,
    params=100 * 2**20,
    optimizer=200 * 2**20,
    other_state=0,
    working=300 * 2**20,
    process=400 * 2**20,
    copies=1,
)


def test_the_state_is_counted_exactly():
    env = tiny.env()
    agent = make_agent(tiny.CONFIG, env.spec)
    state = jax.eval_shape(lambda k: train.init(env, agent, tiny.CONFIG, k), jax.random.key(0))
    needed = memory.estimate(state, tiny.CONFIG)
    total = needed.replay + needed.params + needed.optimizer + needed.other_state
    assert total == memory.nbytes(state)
    assert needed.params == memory.nbytes(jax.eval_shape(agent.init, jax.random.key(0)))
    assert needed.replay_capacity == tiny.CONFIG.replay.capacity


def test_keys_and_small_types_are_counted_in_bytes():
    tree = (
        jax.random.split(jax.random.key(0), 3),
        jnp.zeros(5, jnp.bfloat16),
        jnp.zeros((2, 0)),
    )
    assert memory.nbytes(tree) == 3 * 8 + 5 * 2


def test_what_fits_is_accepted():
    memory.check(NEEDED, NEEDED.total, configured=1000)
    memory.check(NEEDED, None, configured=1000)


def test_what_does_not_fit_is_refused_with_the_largest_replay_that_would():
    with pytest.raises(InvalidInput) as error:
        memory.check(NEEDED, 1500 * 2**20, configured=5000)
    assert str(error.value).startswith(
        "replay.capacity=5000: needs 1.95 GiB for a run that fills 1000 of it, 1.46 GiB are"
    )
    assert str(error.value).endswith("use replay.capacity=500 at most")


@pytest.mark.parametrize("copies", [1, 2])
def test_the_replay_that_is_named_fits_and_a_larger_one_does_not(copies):
    needed = NEEDED._replace(copies=copies)
    available = int(0.6 * needed.total)
    with pytest.raises(InvalidInput) as error:
        memory.check(needed, available, configured=1000)
    largest = int(error.value.remedy.split("replay.capacity=")[1].split()[0])
    for capacity, fits in [(largest, True), (largest + 1, False)]:
        replay = needed.replay // needed.replay_capacity * capacity
        total = needed._replace(replay=replay, replay_capacity=capacity).total
        assert (total <= available) == fits


def test_a_replay_too_small_to_learn_from_is_not_named():
    memory.check(NEEDED, NEEDED.total, configured=1000, smallest=501)
    with pytest.raises(InvalidInput, match="use a smaller size or batch"):
        memory.check(NEEDED, 1500 * 2**20, configured=1000, smallest=501)


# GiB at the peak, on a CPU with 2 cores: cartpole_swingup, and walker_walk until a few
# dozen updates were done.
SHORT = dataclasses.replace(config_lib.PAPER, env_steps=4_300)
MEASURED = [
    (config_lib.QUICK, 2.47),
    (SHORT, 4.28),
    (config_lib.with_size(SHORT, "25m"), 5.73),
]


@pytest.mark.parametrize(("config", "measured"), MEASURED, ids=lambda x: getattr(x, "size", ""))
def test_the_estimate_is_not_below_what_was_measured_nor_far_above(
    config, measured, monkeypatch
):
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    env = probes.make("observation_action", num_envs=config.num_envs)
    env = env._replace(spec=env.spec._replace(action_repeat=config.action_repeat))
    agent = make_agent(config, env.spec)
    state = jax.eval_shape(lambda key: train.init(env, agent, config, key), jax.random.key(0))
    total = memory.estimate(state, config).total
    assert measured < total / 2**30 < 1.4 * measured


def test_a_model_that_does_not_fit_alone_is_not_blamed_on_replay():
    with pytest.raises(InvalidInput, match="use a smaller size or batch"):
        memory.check(NEEDED, 900 * 2**20, configured=1000)


def test_free_memory_is_known_here():
    if not pathlib.Path("/proc/meminfo").exists():
        pytest.skip("only Linux tells")
    assert memory.available_bytes() > 0


def test_a_control_group_lowers_what_is_free(tmp_path, monkeypatch):
    maximum, usage, stat = (tmp_path / name for name in ("max", "current", "stat"))
    maximum.write_text("1000000\n")
    usage.write_text("600000\n")
    stat.write_text("inactive_file 1000\nactive_file 500\n")
    monkeypatch.setattr(memory, "CGROUP_LIMITS", [(str(maximum), str(usage), str(stat))])
    assert memory._available_on_host() == 1000000 - 600000 + 1500
    maximum.write_text("max\n")
    assert memory._available_on_host() != 401500
