"""The estimate before anything is allocated."""

import dataclasses
import pathlib

import jax
import jax.numpy as jnp
import pytest
import tiny

from vawm import presets
from vawm.agent import make_agent, with_size
from vawm.cli import flags
from vawm.envs import probes
from vawm.errors import InvalidInput
from vawm.learning import host_train, image_store, train
from vawm.runs import budget
from vawm.runs.budget import Estimate
from vawm.types import EnvSpec, image

NEEDED = Estimate(
    where="device",
    replay=1000 * 2**20,
    replay_capacity=1000,
    images=0,
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
    (needed,) = budget.estimate(state, env.spec, tiny.CONFIG)
    total = needed.replay + needed.params + needed.optimizer + needed.other_state
    assert total == budget.nbytes(state)
    params, _ = jax.eval_shape(agent.init, jax.random.key(0))
    assert needed.params == budget.nbytes(params)
    assert needed.replay_capacity == tiny.CONFIG.replay.capacity


def test_keys_and_small_types_are_counted_in_bytes():
    tree = (
        jax.random.split(jax.random.key(0), 3),
        jnp.zeros(5, jnp.bfloat16),
        jnp.zeros((2, 0)),
    )
    assert budget.nbytes(tree) == 3 * 8 + 5 * 2


def check(needed, device, host=None, *, capacity=1000, **smallest):
    replay = dataclasses.replace(tiny.CONFIG.replay, capacity=capacity)
    config = tiny.config(replay=replay)
    budget.check([needed], {"device": device, "host": host}, config, **smallest)


def test_a_policy_that_does_not_fit_is_refused_with_the_numbers(monkeypatch):
    free = {"device": 2**30, "host": 2**28}
    monkeypatch.setattr(budget, "available", lambda: free)
    budget.check_policy({"a": jax.ShapeDtypeStruct((2**25,), jnp.float32)}, tiny.CONFIG)
    with pytest.raises(InvalidInput, match=r"256 MiB to read its parameters, 256 MiB are free"):
        budget.check_policy({"a": jax.ShapeDtypeStruct((2**25 + 1,), jnp.float32)}, tiny.CONFIG)


def test_what_fits_is_accepted():
    check(NEEDED, NEEDED.total)
    check(NEEDED, None)


def test_what_does_not_fit_is_refused_with_the_largest_replay_that_would():
    with pytest.raises(InvalidInput) as error:
        check(NEEDED, 1500 * 2**20, capacity=5000)
    assert str(error.value).startswith(
        "replay.capacity=5000: needs 1.95 GiB for a run that fills 1000 of it, 1.46 GiB are"
    )
    assert str(error.value).endswith("use replay.capacity=500 at most")
    assert flags.in_flags(error.value).endswith("use --replay.capacity 500 at most")


@pytest.mark.parametrize("images", [0, 3000 * 2**20])
@pytest.mark.parametrize("copies", [1, 2])
def test_the_replay_that_is_named_fits_and_a_larger_one_does_not(copies, images):
    needed = NEEDED._replace(copies=copies, images=images)
    available = int(0.6 * needed.total)
    with pytest.raises(InvalidInput) as error:
        check(needed, available)
    largest = int(error.value.remedy.split("replay.capacity=")[1].split()[0])
    for capacity, fits in [(largest, True), (largest + 1, False)]:
        rings = [size // needed.replay_capacity * capacity for size in (needed.replay, images)]
        total = needed._replace(
            replay=rings[0], images=rings[1], replay_capacity=capacity
        ).total
        assert (total <= available) == fits


def test_a_replay_too_small_to_learn_from_is_not_named():
    check(NEEDED, NEEDED.total, smallest=501)
    with pytest.raises(InvalidInput, match="use a smaller size or batch"):
        check(NEEDED, 1500 * 2**20, smallest=501)


def pixels(monkeypatch, backend, images="device", env_steps=20_000_000):
    """Estimates for 5 million images of 64 x 64 x 3 in replay, and the config."""
    config = dataclasses.replace(
        presets.VISION_PAPER,
        env_steps=env_steps,
        replay=dataclasses.replace(presets.VISION_PAPER.replay, images=images),
    )
    spec = EnvSpec("test", image(64), 6, False, config.num_envs, 2, 500)
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    return on_the_host(spec, config)


def on_the_host(spec, config):
    """Estimates for environments of `spec` on the host, and the config."""
    agent = make_agent(config, spec)
    timestep = host_train.first_timestep(spec)
    state = jax.eval_shape(
        lambda key, timestep: host_train.init(agent, config, key, timestep),
        jax.random.key(0),
        timestep,
    )
    if config.replay.images == "host":
        capacity = state.replay.trajectory.reward.shape[1]
        ring = image_store.specs(spec.obs, num_envs=config.num_envs, capacity=capacity)
        state = state._replace(images=ring)
    return budget.estimate(state, spec, config), config


FIVE_MILLION = 5_000_000 * 64 * 64 * 3


def test_five_million_images_are_refused_with_the_numbers(monkeypatch):
    needed, config = pixels(monkeypatch, "gpu")
    assert pytest.approx(57.2, abs=0.1) == FIVE_MILLION / 2**30
    assert needed[0].replay_capacity == 5_000_000
    assert needed[0].replay > FIVE_MILLION
    free = {"device": 70 * 2**30, "host": 900 * 2**30}
    with pytest.raises(InvalidInput) as error:
        budget.check(needed, free, config)
    assert error.value.field == "replay.capacity"
    assert "70.00 GiB are free (replay 7" in str(error.value)  # latents take the rest
    assert error.value.remedy.endswith("or replay.images='host' if that has more memory")
    assert "--replay.images host" in flags.in_flags(error.value)


def test_images_on_the_host_are_counted_there(monkeypatch):
    (device, host), config = pixels(monkeypatch, "gpu", images="host")
    assert (device.where, host.where) == ("device", "host")
    assert device.images == 0
    assert host.images == FIVE_MILLION
    assert device.replay < FIVE_MILLION < host.total
    assert host.copies == budget.SAVING_COPIES  # of the images too, as measured
    budget.check((device, host), {"device": 80 * 2**30, "host": 900 * 2**30}, config)
    with pytest.raises(InvalidInput, match=r"in host memory .* use replay.capacity=") as error:
        budget.check((device, host), {"device": 80 * 2**30, "host": 170 * 2**30}, config)
    assert "replay.images" not in str(error.value)


@pytest.mark.parametrize("images", ["device", "host"])
def test_on_a_cpu_there_is_one_memory_for_both(monkeypatch, images):
    (needed,), _ = pixels(monkeypatch, "cpu", images=images)
    assert needed.where == "device"
    assert needed.replay + needed.images > FIVE_MILLION
    assert needed.copies == budget.SAVING_COPIES


def test_a_run_is_charged_for_no_more_images_than_it_collects(monkeypatch):
    (device, _), _ = pixels(monkeypatch, "gpu", env_steps=1_000_000)
    assert device.replay_capacity == 16 * (31_250 + 63)  # decisions, and a reset per 500


# GiB at the peak, on a CPU with 2 cores: cartpole_swingup, and walker_walk until a few
# dozen updates were done.
SHORT = dataclasses.replace(presets.PAPER, env_steps=4_300)
MEASURED = [
    (presets.QUICK, 2.47),
    (SHORT, 4.28),
    (with_size(SHORT, "25m"), 5.73),
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
    (needed,) = budget.estimate(state, env.spec, config)
    total = needed.total
    assert measured < total / 2**30 < 1.4 * measured


# The same with environments on the host: breakout and cartpole_balance from pixels for 6,000
# env steps, walker_walk from pixels until 3 updates were done, STORM on kung_fu_master until
# some were.
MEASURED_ON_THE_HOST = [
    (dataclasses.replace(presets.ATARI_QUICK, env_steps=6_000), 2.23),
    (dataclasses.replace(presets.VISION_QUICK, env_steps=6_000), 2.76),
    (dataclasses.replace(presets.VISION_PAPER, env_steps=4_300), 8.60),
    (dataclasses.replace(presets.STORM, env_steps=4_500), 4.82),
]


@pytest.mark.parametrize(
    ("config", "measured"), MEASURED_ON_THE_HOST, ids=["atari", "vision", "vision-12m", "storm"]
)
def test_the_estimate_covers_images_and_workers_and_little_more(config, measured, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    monkeypatch.setattr(budget, "cores", lambda: 2)
    spec = EnvSpec(
        "test",
        image(64),
        6,
        config.suite == "atari100k",
        config.num_envs,
        config.action_repeat,
        None,
    )
    needed, _ = on_the_host(spec, config)
    assert measured < needed[0].total / 2**30 < 1.4 * measured


def test_a_model_that_does_not_fit_alone_is_not_blamed_on_replay():
    with pytest.raises(InvalidInput, match="use a smaller size or batch"):
        check(NEEDED, 900 * 2**20)


def test_free_memory_is_known_here():
    if not pathlib.Path("/proc/meminfo").exists():
        pytest.skip("only Linux tells")
    assert budget.available_bytes() > 0


def test_a_control_group_lowers_what_is_free(tmp_path, monkeypatch):
    maximum, usage, stat = (tmp_path / name for name in ("max", "current", "stat"))
    maximum.write_text("1000000\n")
    usage.write_text("600000\n")
    stat.write_text("inactive_file 1000\nactive_file 500\n")
    monkeypatch.setattr(budget, "CGROUP_LIMITS", [(str(maximum), str(usage), str(stat))])
    assert budget._available_on_host() == 1000000 - 600000 + 1500
    maximum.write_text("max\n")
    assert budget._available_on_host() != 401500
