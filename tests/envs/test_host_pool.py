"""Pools: their stream, failures of environments, resuming, and their end."""

import contextlib
import gc
import importlib.util
import os
import pathlib
import re
import signal
import socket
import subprocess
import sys
import threading
import time

import host_simulators
import numpy as np
import pytest
from host_simulators import BadEnd, Chance, Changed, Echo, Parent, Slow, Troubled, Walk
from refusals import refused

from vawm.envs.host import channel, pool, usable, worker
from vawm.envs.host.pool import EnvironmentFailure, Episodes, Pool, episode_seed
from vawm.envs.host.simulator import Outcome
from vawm.errors import InvalidInput
from vawm.types import EnvSpec, TimeStep, vector

TESTS = pathlib.Path(host_simulators.__file__).parent
SEED = 3


@pytest.fixture(scope="module")
def walks():
    """Three walks in two workers, made by a closure; any test may reset them."""
    kind = Walk
    with Pool(lambda: kind(), task="walk", num_envs=3, workers=2) as walks:
        yield walks


def draw_actions(steps, num_envs, seed=0):
    actions = np.random.default_rng(seed).normal(size=(steps, num_envs, 2), scale=2)
    actions[::3, 0, 1] = np.nan
    return actions.astype(np.float32)


def play(envs, actions):
    """A time step per row of `[T, N, A]` actions."""
    timesteps = []
    for action in actions:
        envs.send(action)
        timesteps.append(envs.receive())
    return timesteps


def assert_equal(a: TimeStep, b: TimeStep):
    assert pool.rows_equal(a, b).all()
    assert [x.dtype for _, x in pool.arrays_of(a)] == [x.dtype for _, x in pool.arrays_of(b)]


def pids(envs):
    return [handle.process.pid for handle in envs._crew._handles]


def alive(pid):
    """Whether a process runs; a zombie does not."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_until(condition, seconds=10):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)
    return condition()


# The stream.


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_the_stream_equals_that_of_a_plain_loop_for_any_number_of_workers(walks, workers):
    actions = draw_actions(steps=20, num_envs=3)
    expected = host_simulators.serial_stream(Walk, SEED, actions)
    other = workers != 2 and Pool(Walk, task="walk", num_envs=3, workers=workers)
    with other or contextlib.nullcontext(walks) as envs:
        assert len(pids(envs)) == workers
        timesteps = [envs.reset(SEED), *play(envs, actions)]
    assert sum(t.is_first.sum() for t in timesteps) > 6  # resets are part of it
    for timestep, rows in zip(timesteps, expected, strict=True):
        for env, (obs, *rest) in enumerate(rows):
            assert timestep.obs.keys() == obs.keys()
            for key in obs:
                np.testing.assert_array_equal(timestep.obs[key][env], obs[key])
            assert [x[env] for x in timestep[1:]] == [np.float32(rest[0]), *rest[1:]]
        assert [x.dtype for x in timestep[1:]] == [np.float32, bool, bool, bool]


def test_a_pool_describes_its_environments(walks):
    assert walks.spec == EnvSpec(
        task="walk",
        obs=Walk.obs,
        action_size=2,
        discrete=False,
        num_envs=3,
        action_repeat=1,
        episode_length=None,
    )


def test_a_reset_starts_everything_again(walks):
    actions = draw_actions(steps=4, num_envs=3)
    first = [walks.reset(SEED), *play(walks, actions)]
    walks.send(actions[0])  # never received
    for a, b in zip(first, [walks.reset(SEED), *play(walks, actions)], strict=True):
        assert_equal(a, b)
    other = walks.reset(SEED + 1)
    assert (other.obs["state"] != first[0].obs["state"]).all()


def test_time_steps_are_copies(walks):
    before = walks.reset(SEED)
    kept = [np.array(x) for _, x in pool.arrays_of(before)]
    play(walks, draw_actions(steps=4, num_envs=3))
    for (name, x), y in zip(pool.arrays_of(before), kept, strict=True):
        np.testing.assert_array_equal(x, y, err_msg=name)
        assert x.base is None, name
        x[...] = 1  # the caller may write to them


def test_continuous_actions_are_clipped_and_nan_is_no_action():
    echo = lone_worker(Echo(discrete=False))
    echo.arrays["action"][0] = [np.nan, -np.inf, 0.25]
    assert not echo.answer(2, "step", {0: None}).troubles
    np.testing.assert_array_equal(echo.arrays["obs"], [[0, -1, 0.25]])


def test_a_discrete_action_is_an_index():
    echo = lone_worker(Echo(discrete=True))
    for raw, index in (([0, 0, 1], 2), ([np.nan, 3, 2], 1), ([np.nan, -1, -2], 0)):
        echo.arrays["action"][0] = raw
        assert not echo.answer(2, "step", {0: None}).troubles
        np.testing.assert_array_equal(echo.arrays["obs"], np.full((1, 3), index))


def test_seeds_of_episodes_differ_and_fit_in_31_bits():
    seeds = {
        episode_seed(seed, env, episode)
        for seed in (0, 1, 2**40)
        for env in range(10)
        for episode in range(10)
    }
    assert len(seeds) == 300
    assert all(0 <= seed < 2**31 for seed in seeds)


# Refusals.


@pytest.mark.parametrize(
    ("field", "value", "named"),
    [
        ("num_envs", 0, ()),
        ("action_repeat", 1.5, ()),
        ("workers", -1, ()),
        ("timeout", 0, ()),
        ("timeout", float("nan"), ()),
        ("on_failure", "ignore", ["'raise'", "'restart'"]),
    ],
)
def test_impossible_choices_are_refused(field, value, named):
    with refused(field, value, naming=named):
        Pool(Walk, **{"task": "walk", "num_envs": 1, field: value})


def test_a_factory_that_cannot_be_pickled_is_refused():
    lock = threading.Lock()
    make = lambda: Walk(lock)  # noqa: E731
    with refused("make", make, naming="lock"):
        Pool(make, task="walk", num_envs=1)


def test_actions_of_another_shape_are_refused(walks):
    walks.reset(SEED)
    with refused("action", (3,), naming="(3, 2)"):
        walks.send(np.zeros(3))
    play(walks, np.zeros((1, 3, 2)))


def test_calls_out_of_order_are_refused(walks):
    walks.reset(SEED)
    with pytest.raises(RuntimeError, match=r"send\(\)"):
        walks.receive()
    walks.send(np.zeros((3, 2)))
    with pytest.raises(RuntimeError, match=r"receive\(\)"):
        walks.send(np.zeros((3, 2)))
    walks.receive()


@pytest.mark.parametrize("seed", [-1, 1.5, True, None])
def test_an_impossible_seed_is_refused(walks, seed):
    with refused("seed", seed):
        walks.reset(seed)


# Outcomes that no agent can use; the worker runs in this process.


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"reward": float("nan")}, "reward .*nan"),
        ({"reward": 1e39}, r"reward .*1e\+39"),
        ({"reward": None}, "reward .*None"),
        ({"reward": np.ones(1)}, r"reward .*\(1,\)"),
        ({"is_last": 1}, "is_last .*1"),
        ({"is_terminal": None}, "is_terminal .*None"),
        ({"obs": np.float32([0, np.inf])}, r"obs\[1\] .*inf"),
        ({"obs": np.zeros(2)}, r"obs .*float64\[2\].*float32\[2\]"),
        ({"obs": np.zeros((2, 1), np.float32)}, r"obs .*float32\[2, 1\].*float32\[2\]"),
        ({"obs": [0.0, 0.0]}, "obs .*list"),
    ],
)
def test_invalid_outcomes_are_named(change, reason):
    class Still(Walk):
        obs = vector(2)

        def reset(self, seed):
            return np.zeros(2, np.float32)

        def step(self, action):
            return Outcome(np.zeros(2, np.float32), 0.0, False, False)._replace(**change)

    alone = lone_worker(Still())
    (trouble,) = alone.answer(2, "step", {0: None}).troubles.values()
    assert not trouble.building
    assert re.match(reason, trouble.reason), trouble.reason
    assert alone.arrays["reward"] == 0  # nothing was written


@pytest.mark.parametrize("obs", [np.zeros(3, np.float32), {"state": np.zeros(3, np.float32)}])
def test_an_observation_without_all_its_entries_is_named(obs):
    class Half(Walk):
        def reset(self, seed):
            return obs

    alone = lone_worker(Half(), begins=False)
    (trouble,) = alone.answer(1, "begin", {0: 5}).troubles.values()
    assert "['picture', 'state']" in trouble.reason


def test_rewards_may_be_numpy_scalars():
    for reward in (np.float64(2), np.int8(2), np.array(2.0), True + True):
        assert usable.check_number("reward", reward) == 2


def test_a_class_in_a_module_that_workers_cannot_import_is_named(tmp_path, monkeypatch):
    """Such as one that was loaded from its file, or whose folder left the path."""
    path = tmp_path / "hidden_walk.py"
    path.write_text("from host_simulators import Walk\nclass Hidden(Walk): pass\n")
    spec = importlib.util.spec_from_file_location("hidden_walk", path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "hidden_walk", module)
    spec.loader.exec_module(module)
    with refused("make", "hidden_walk", naming=["ModuleNotFoundError", "PYTHONPATH"]):
        Pool(module.Hidden, task="walk", num_envs=1)


def test_a_simulator_in_place_of_what_makes_it_is_the_mistake():
    walk = Walk()
    with refused("make", walk, naming="lambda: Walk(...)"):
        Pool(walk, task="walk", num_envs=1)


def test_a_pool_passes_on_the_notices_of_its_simulators():
    class Noted(Walk):
        notices = ("the picture is small",)

    with Pool(Noted, task="walk", num_envs=2, workers=1) as envs:
        assert envs.notices == ("the picture is small",)
        assert envs.reset(0).is_first.all()
    with Pool(Walk, task="walk", num_envs=1) as envs:
        assert envs.notices == ()


def lone_worker(simulator, begins=True):
    """A worker for one simulator, in this process."""
    file = channel.create_file()
    channel.reserve(file, worker.array_fields(1, 1, simulator.obs, simulator.action_size))
    alone = worker.Worker(0, 1, 1, channel=None, file=file)
    alone.simulators[0] = simulator
    alone.description = worker.describe_simulator(simulator)
    if begins:
        assert not alone.answer(1, "begin", {0: 5}).troubles
    return alone


# Channels and memory.


def test_a_message_that_arrived_is_read_however_late():
    ends = [channel.Channel(end) for end in socket.socketpair()]
    with pytest.raises(TimeoutError):
        ends[0].receive(deadline=time.monotonic() + 0.01)
    ends[1].send({"a": 1})
    ends[1].send("b")
    assert ends[0].receive(deadline=0.0) == {"a": 1}
    assert ends[0].receive(deadline=0.0) == "b"
    with pytest.raises(TimeoutError):
        ends[0].receive(deadline=0.0)
    ends[1].close()
    with pytest.raises(EOFError):
        ends[0].receive()
    with pytest.raises(OSError, match="Broken pipe"):
        ends[0].send("c")
    ends[0].close()
    with pytest.raises(EOFError):
        ends[0].receive()


def test_a_message_longer_than_a_socket_takes_arrives_in_parts():
    reader, writer = (channel.Channel(end) for end in socket.socketpair())
    message = np.arange(10**6)
    with pytest.raises(TimeoutError):
        writer.send(message, timeout=0.01)
    with pytest.raises(TimeoutError):
        reader.receive(deadline=time.monotonic() + 0.01)  # keeps the received part
    reader, writer = (channel.Channel(end) for end in socket.socketpair())
    thread = threading.Thread(target=writer.send, args=[message])
    thread.start()
    np.testing.assert_array_equal(reader.receive(), message)
    thread.join()


@pytest.mark.parametrize("memfd", [True, False])
def test_arrays_are_shared_and_grow(memfd, monkeypatch):
    if not memfd:
        monkeypatch.delattr(os, "memfd_create", raising=False)
    few = {"a": ((3,), np.int64)}
    more = {**few, "b": ((2, 5), np.uint8), "c": ((1,), np.float32)}
    file = channel.create_file()
    channel.reserve(file, few)
    before = channel.view(file, few)
    before["a"][:] = [1, 2, 3]
    channel.reserve(file, more)
    ours, theirs = channel.view(file, more), channel.view(file, more)
    ours["b"][1, 4], ours["c"][0] = 7, 0.5
    os.close(file)
    np.testing.assert_array_equal(theirs["a"], [1, 2, 3])
    assert (theirs["b"].sum(), theirs["b"][1, 4], theirs["c"][0]) == (7, 7, 0.5)
    theirs["a"][0] = 9
    assert before["a"][0] == 9


# Failures.

TIMEOUT = 1.5  # seconds; a step takes microseconds, on a machine that others use too
FAILURES = {
    "boom": "ValueError: boom, and more",
    "leave": "SystemExit: 1",
    "exit": "code 3",
    "crash": "SIGSEGV",
    "hang": "1.5 s",
    "hang_deaf": "1.5 s",
    "lose_reward": "nan",
}
SHOWN = {"boom": "in boom", "crash": "in crash", "hang": "in hang", "lose_reward": "in write"}
FATAL = {"exit", "crash", "hang", "hang_deaf"}  # to the worker


def troubled(*troubles, on_failure):
    """Two walks in one worker. The second walk has `troubles`, one in the second step of each
    of its first episodes."""
    plan = {episode_seed(SEED, 1, episode): what for episode, what in enumerate(troubles)}
    return Pool(
        lambda: Troubled(plan, step=2),
        task="troubled",
        num_envs=2,
        workers=1,
        timeout=TIMEOUT,
        on_failure=on_failure,
    )


@pytest.mark.parametrize("trouble", ["boom", *sorted(FATAL)])
def test_a_failure_names_environment_and_step_and_ends_the_pool(trouble):
    with troubled(trouble, on_failure="raise") as envs:
        envs.reset(SEED)
        actions = draw_actions(steps=3, num_envs=2)
        play(envs, actions[:1])
        workers = pids(envs)
        envs.send(actions[1])
        began = time.monotonic()
        with pytest.raises(EnvironmentFailure) as caught:
            envs.receive()
        assert time.monotonic() - began < 5
        failure = caught.value
        assert str(failure) == f"environment 1, episode 0, step 2: {failure.reason}"
        assert (failure.environment, failure.episode, failure.step) == (1, 0, 2)
        assert FAILURES[trouble] in failure.reason
        assert SHOWN.get(trouble, "") in failure.traceback
        assert not any(map(alive, workers))
        with pytest.raises(RuntimeError, match="closed") as after:
            envs.send(actions[2])
        assert after.value.__cause__ is failure


def test_a_failure_can_start_a_new_episode_instead():
    with troubled(*FAILURES, on_failure="restart") as envs:
        envs.reset(SEED)
        restarts = 0
        for episode, trouble in enumerate(FAILURES, start=1):
            going, failed = play(envs, np.zeros((2, 2, 2)))
            assert not going.is_first[1], trouble
            fatal = trouble in FATAL  # takes the other environment down too
            assert failed.is_first[1], trouble
            assert failed.is_first[0] >= fatal, trouble
            assert (failed.reward[1], failed.is_last[1]) == (0, False)
            restarts += 1 + fatal
            assert envs.restarts == restarts, trouble
            fresh = Walk().reset(episode_seed(SEED, 1, episode))["state"]
            np.testing.assert_array_equal(failed.obs["state"][1], fresh)
            assert envs.episodes().index[1] == episode
        assert not play(envs, np.zeros((2, 2, 2)))[1].is_first[1]


@pytest.mark.parametrize("end", ["exit", "hang"])
def test_a_broken_simulator_that_cannot_even_be_closed_is_replaced(end):
    """It takes its worker down, with the other environment."""
    plan = {episode_seed(SEED, 1, 0): "boom"}
    settings = {"num_envs": 2, "workers": 1, "timeout": TIMEOUT, "on_failure": "restart"}
    with Pool(lambda: BadEnd(plan, step=2, end=end), task="bad", **settings) as envs:
        envs.reset(SEED)
        _, failed = play(envs, np.zeros((2, 2, 2)))
        assert failed.is_first.tolist() == [True, True]
        assert envs.restarts == 2
        assert not play(envs, np.zeros((1, 2, 2)))[0].is_first.any()


@pytest.mark.parametrize("on_failure", ["raise", "restart"])
def test_a_worker_that_is_killed_from_outside_is_noticed(on_failure):
    with Pool(Walk, task="w", num_envs=3, workers=2, on_failure=on_failure) as envs:
        envs.reset(SEED)
        actions = draw_actions(steps=3, num_envs=3)
        play(envs, actions[:1])
        os.kill(pids(envs)[0], signal.SIGKILL)
        if on_failure == "restart":
            timesteps = play(envs, actions[1:])
            np.testing.assert_array_equal(timesteps[0].is_first, [True, False, True])
            assert not timesteps[1].is_first.any()
            assert envs.restarts == 2
            return
        with pytest.raises(EnvironmentFailure, match=r"SIGKILL.*\[0, 2\]") as caught:
            play(envs, actions[1:])
        assert (caught.value.environment, caught.value.step) == (0, 2)


def test_failures_without_a_step_between_them_end_the_pool():
    with Pool(
        lambda: Troubled("boom", step=1), task="t", num_envs=1, on_failure="restart"
    ) as envs:
        envs.reset(SEED)
        actions = draw_actions(steps=5, num_envs=1)
        play(envs, actions[:2])
        assert envs.restarts == 2
        with pytest.raises(EnvironmentFailure, match=r"boom.*3 failures") as caught:
            play(envs, actions[2:])
        assert caught.value.episode == 2


class Refusing(Walk):
    def __init__(self):
        raise InvalidInput("size", 7, "use an even number")


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda: 1 / 0, "ZeroDivisionError: division by zero"),
        (lambda: os._exit(3), "code 3"),
        (lambda: time.sleep(1000), "2 s"),
    ],
)
def test_a_simulator_that_cannot_be_made_is_a_failure(make, reason, monkeypatch):
    if reason == "2 s":
        monkeypatch.setattr(pool, "START_TIMEOUT", 2.0)
    with pytest.raises(EnvironmentFailure, match=f"made.*{reason}") as caught:
        Pool(make, task="none", num_envs=1, timeout=TIMEOUT, on_failure="restart")
    assert caught.value.environment == 0


def test_a_refusal_of_the_simulators_maker_reaches_the_caller():
    with refused("size", 7, naming="use an even number"):
        Pool(Refusing, task="none", num_envs=2, workers=1)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("obs", (3,)),
        ("obs", {"state": np.zeros(3)}),
        ("obs", {3: vector(3)}),
        ("action_size", 0),
        ("action_size", None),
        ("episode_length", 1.5),
    ],
)
def test_a_wrong_attribute_of_a_simulator_is_named(name, value):
    walk = Walk()
    setattr(walk, name, value)
    with pytest.raises(TypeError, match=f"^{name}"):
        worker.describe_simulator(walk)


def test_environments_that_differ_are_refused(tmp_path):
    def make():
        walk = Walk()
        walk.action_size = 1 + len(list(tmp_path.iterdir()))
        (tmp_path / "made").touch()
        return walk

    with refused("make", "environment 1", naming=["action_size=1", "action_size=2"]):
        Pool(make, task="none", num_envs=2, workers=1)


# Resuming.


def test_running_episodes_are_restored_wherever_they_were(walks):
    actions = draw_actions(steps=12, num_envs=3)
    timesteps, saved = [walks.reset(SEED)], [walks.episodes()]
    for action in actions:
        timesteps += play(walks, action[None])
        saved.append(walks.episodes())
    walks.send(actions[0])  # `episodes` is of the last received step
    assert_same_episodes(walks.episodes(), saved[-1])

    where = {"begun": 0, "amid": 0, "over": 0}
    for t in range(len(actions)):
        timestep, same = walks.restore(SEED, saved[t], timesteps[t])
        assert same.all()
        assert_equal(timestep, timesteps[t])
        assert_same_episodes(walks.episodes(), saved[t])
        where["begun"] += timestep.is_first.sum()
        where["over"] += timestep.is_last.sum()
        where["amid"] += (~timestep.is_first & ~timestep.is_last).sum()
        (following,) = play(walks, actions[t : t + 1])
        assert_equal(following, timesteps[t + 1])
    assert min(where.values()) > 2
    assert walks.restarts == 0

    with Pool(Walk, task="walk", num_envs=3, workers=1) as fresh:  # another process
        assert_same_episodes(fresh.episodes(), walks.reset(SEED) and walks.episodes())
        timestep, same = fresh.restore(SEED, saved[5], timesteps[5])
        assert same.all()
        assert_equal(timestep, timesteps[5])
        for t in range(5, len(actions)):
            assert_equal(play(fresh, actions[t : t + 1])[0], timesteps[t + 1])


def assert_same_episodes(a: Episodes, b: Episodes):
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x, y)
        assert x.dtype == y.dtype


def test_an_episode_that_cannot_be_replayed_exactly_is_replaced_by_a_new_one():
    seed = next(
        seed
        for seed in range(100)
        if [episode_seed(seed, env, 0) % 2 for env in range(2)] == [0, 1]
    )
    actions = draw_actions(steps=3, num_envs=2)
    with Pool(Chance, task="chance", num_envs=2, workers=1) as envs:
        envs.reset(seed)
        before = play(envs, actions[:2])[-1]
        timestep, same = envs.restore(seed, envs.episodes(), before)
        np.testing.assert_array_equal(same, [True, False])
        np.testing.assert_array_equal(timestep.is_first, [False, True])
        np.testing.assert_array_equal(timestep.obs["state"][0], before.obs["state"][0])
        assert timestep.reward[1] == 0
        np.testing.assert_array_equal(envs.episodes().index, [0, 1])
        np.testing.assert_array_equal(envs.episodes().length, [2, 0])
        (after,) = play(envs, actions[2:])
        assert not after.is_first.any()


def test_a_step_that_is_off_by_one_bit_is_not_the_same(walks):
    walks.reset(SEED)
    (timestep,) = play(walks, draw_actions(steps=1, num_envs=3))
    episodes = walks.episodes()
    timestep.obs["picture"][0, 1, 1, 0] ^= 1
    timestep.reward[1] = np.nextafter(timestep.reward[1], np.float32(9))
    _, same = walks.restore(SEED, episodes, timestep)
    np.testing.assert_array_equal(same, [False, False, True])
    _, same = walks.restore(SEED + 1, episodes, timestep)
    assert not same.any()


def test_an_episode_that_fails_when_replayed_is_replaced_by_a_new_one(tmp_path):
    path = tmp_path / "order"
    actions = draw_actions(steps=4, num_envs=2)
    with Pool(lambda: Changed(path), task="c", num_envs=2, workers=1, timeout=TIMEOUT) as envs:
        envs.reset(SEED)
        before = play(envs, actions[:3])[-1]
        episodes = envs.episodes()
        assert list(episodes.length) == [3, 3]
        for what in ("boom", "end", "exit", "hang"):
            path.write_text(what)
            timestep, same = envs.restore(SEED, episodes, before)
            assert not same.any(), what
            assert timestep.is_first.all(), what
            path.unlink()
            assert not play(envs, actions[3:])[0].is_first.any(), what
        assert envs.restore(SEED, episodes, before)[1].all()


def test_an_episode_that_is_too_long_is_not_kept(walks, monkeypatch):
    walks.reset(SEED)
    monkeypatch.setattr(pool, "MAX_KEPT", 2)
    lengths = []
    for action in draw_actions(steps=12, num_envs=3):
        (timestep,) = play(walks, action[None])
        episodes = walks.episodes()
        assert len(episodes.actions) == np.maximum(episodes.length, 0).sum()
        lengths.append(episodes.length)
    assert {*np.ravel(lengths)} == {-1, 0, 1, 2}
    restored, same = walks.restore(SEED, episodes, timestep)
    np.testing.assert_array_equal(same, episodes.length >= 0)
    np.testing.assert_array_equal(restored.is_first[~same], True)
    assert 0 < same.sum() < 3


def test_episodes_of_other_environments_are_refused(walks):
    timestep, episodes = walks.reset(SEED), walks.episodes()
    with refused("episodes.actions", (1, 2), naming="(0, 2)"):
        walks.restore(SEED, episodes._replace(actions=np.zeros((1, 2))), timestep)
    with refused("episodes.index", (2,)):
        walks.restore(SEED, episodes._replace(index=np.zeros(2)), timestep)
    with refused("expected", naming="float32[3, 3]"):
        walks.restore(SEED, episodes, timestep._replace(obs=timestep.obs["state"]))


# Interruptions and the end.


def test_after_an_interruption_a_pool_can_be_reset():
    def interrupt(*_):
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGALRM, interrupt)
    try:
        with Pool(Slow, task="slow", num_envs=1) as envs:
            first = envs.reset(SEED)
            envs.send(np.zeros((1, 2)))
            signal.setitimer(signal.ITIMER_REAL, 0.1)
            with pytest.raises(KeyboardInterrupt):
                envs.receive()
            with pytest.raises(RuntimeError, match=r"reset\(\) or restore\(\)"):
                envs.send(np.zeros((1, 2)))
            assert_equal(envs.reset(SEED), first)
            assert not play(envs, np.zeros((1, 1, 2)))[0].is_first
    finally:
        signal.signal(signal.SIGALRM, previous)


def test_workers_ignore_signals_meant_for_the_parent(walks):
    walks.reset(SEED)
    for pid in pids(walks):
        assert os.getpgid(pid) == pid  # Ctrl-C in a terminal does not reach it
        os.kill(pid, signal.SIGINT)
        os.kill(pid, signal.SIGTERM)
    assert not play(walks, np.zeros((1, 3, 2)))[0].is_first.any()


def test_closing_leaves_no_process_behind_and_may_be_repeated():
    envs = Pool(Parent, task="parent", num_envs=2, workers=1)
    children = envs.reset(SEED).obs[:, 0].astype(int).tolist()
    workers = pids(envs)
    assert all(map(alive, [*workers, *children]))
    envs.close()
    envs.close()
    assert wait_until(lambda: not any(map(alive, [*workers, *children])))
    with pytest.raises(RuntimeError, match="closed"):
        envs.reset(SEED)


def test_a_pool_that_is_garbage_collected_ends_its_workers():
    envs = Pool(Walk, task="walk", num_envs=1)
    workers = pids(envs)
    del envs
    gc.collect()
    assert not any(map(alive, workers))


SCRIPT = """
import os, signal, sys, threading, time
import numpy as np
from host_simulators import Loud, Parent, Troubled
from vawm.envs.host.pool import Pool

class Here(Loud):  # defined only in this script
    pass

def begin():
    global envs, begun
    makers = {"hang": lambda: Troubled("hang", step=1), "loud": Here, "parent": Parent}
    make = makers[sys.argv[1]]
    envs = Pool(make, task="script", num_envs=2, workers=1)
    begun = envs.reset(0)

if sys.argv[2] == "thread":
    thread = threading.Thread(target=begin)
    thread.start()
    thread.join()
else:
    begin()
signal.signal(signal.SIGINT, lambda *_: print("interrupted", flush=True))
if sys.argv[1] == "parent":
    print(*begun.obs[:, 0].astype(int), end=" ")
envs.send(np.zeros((2, 2)))
print(*(handle.process.pid for handle in envs._crew._handles), flush=True)
if sys.argv[1] == "loud":
    envs.receive()
    sys.stdin.readline()
    envs.send(np.zeros((2, 2)))
    envs.receive()
    print("done", flush=True)  # without closing the pool
else:
    time.sleep(1000)
"""


@contextlib.contextmanager
def script(*arguments):
    """Runs `SCRIPT`, which has no `if __name__ == "__main__"`, in a new process group."""
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        process_group=0,
        env={**os.environ, "PYTHONPATH": str(TESTS)},
    ) as process:
        try:
            yield process, [int(pid) for pid in process.stdout.readline().split()]
        finally:
            process.kill()


@pytest.mark.parametrize("thread", ["main", "thread"])
def test_workers_end_with_a_parent_that_is_killed(thread):
    with script("hang", thread) as (process, workers):
        assert len(workers) == 1
        assert all(map(alive, workers))
        process.kill()
        assert wait_until(lambda: not any(map(alive, workers)))


def test_processes_of_simulators_end_with_a_parent_that_is_killed():
    with script("parent", "main") as (process, running):
        assert len(running) == 3  # two children of simulators, and their worker
        assert all(map(alive, running))
        process.kill()
        assert wait_until(lambda: not any(map(alive, running)))


def test_output_to_a_closed_standard_error_is_no_failure():
    with script("loud", "main") as (process, workers):
        process.stderr.close()
        assert all(map(alive, workers))
        process.stdin.write("go on\n")
        process.stdin.flush()
        assert process.stdout.readline() == "done\n"
        assert process.wait(timeout=30) == 0


def test_ctrl_c_reaches_only_the_parent_and_output_goes_to_standard_error():
    with script("loud", "main") as (process, workers):
        os.killpg(process.pid, signal.SIGINT)
        assert process.stdout.readline() == "interrupted\n"
        assert all(map(alive, workers))
        out, err = process.communicate("go on\n", timeout=30)
        assert out == "done\n"
        assert err == "chatter\n" * 8
        assert process.returncode == 0
        assert wait_until(lambda: not any(map(alive, workers)))
