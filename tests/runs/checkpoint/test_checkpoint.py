"""Checkpoints: restored bit for bit, complete or absent, never silently different."""

import contextlib
import errno
import gc
import logging
import re
import resource
import shutil
import sys
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
import toy
from refusals import refused
from runs import files_of, save_toy

from vawm.config import as_dict
from vawm.runs import checkpoint
from vawm.runs.checkpoint import manifest

PROGRESS = {"env_steps": 8, "seconds": 1 / 3}


def save(logdir, state, env_steps=8, **changes):
    return save_toy(logdir, state, env_steps, **{"progress": PROGRESS} | changes)


def test_everything_is_restored_bit_for_bit(tmp_path):
    state = toy.state()
    save(tmp_path, state)
    restored, saved = checkpoint.restore(tmp_path, jax.eval_shape(lambda: state))
    toy.assert_equal(restored, state)
    assert saved.config == tiny.CONFIG
    assert saved.spec == toy.SPEC
    assert saved.progress == PROGRESS
    assert saved.env_steps == 8


class Host(NamedTuple):
    """A state with images in host memory."""

    learner: Any
    images: Any
    key: Any


def with_images():
    state = toy.state()
    pictures = np.arange(2 * 3 * 4, dtype=np.uint8).reshape(2, 3, 4)
    images = {"picture": pictures, "state": np.zeros((2, 0), np.float32)}
    return Host(state.learner, images, state.key)


EPISODES = {
    "index": np.array([3, 2**40]),
    "length": np.array([2, 0]),
    "actions": np.array([[0.5], [-1.0]], np.float32),
}


def test_images_and_episodes_of_the_host_are_restored_as_numpy(tmp_path):
    state = with_images()
    save(tmp_path, state, episodes=EPISODES)
    restored, _ = checkpoint.restore(tmp_path, state)
    for name, images in state.images.items():
        assert isinstance(restored.images[name], np.ndarray)
        assert restored.images[name].dtype == images.dtype
        np.testing.assert_array_equal(restored.images[name], images)
    assert isinstance(restored.key, jax.Array)
    episodes = checkpoint.restore_episodes(tmp_path)
    assert episodes.keys() == EPISODES.keys()
    for name, array in EPISODES.items():
        assert episodes[name].dtype == array.dtype
        np.testing.assert_array_equal(episodes[name], array)


def test_a_state_without_environments_on_the_host_has_no_episodes(tmp_path):
    save(tmp_path, toy.state())
    assert checkpoint.restore_episodes(tmp_path) is None


@pytest.mark.parametrize("item", ["images", "episodes"])
def test_damage_to_arrays_of_the_host_is_noticed(tmp_path, item):
    state = with_images()
    path = save(tmp_path, state, episodes=EPISODES)
    largest = max(files_of(path / item), key=lambda file: file.stat().st_size)
    data = bytearray(largest.read_bytes())
    data[len(data) // 2] ^= 1
    largest.write_bytes(bytes(data))
    with refused("checkpoint", str(largest), naming="checksum"):
        checkpoint.restore(tmp_path, state), checkpoint.restore_episodes(tmp_path)


def with_model_state():
    """A state with a world model that has a `model_state`."""
    state = toy.state()
    mean = jnp.array([0.25, -3.0])
    statistics = {"encoder": {"mean": mean, "var": mean**2}, "decoder": {"vector": ()}}
    return state._replace(learner=state.learner._replace(model_state=statistics))


@pytest.mark.parametrize("make", [toy.state, with_model_state])
def test_what_is_needed_to_act_is_read_without_the_rest(tmp_path, make):
    state = make()
    learner = state.learner
    path = save(tmp_path, state)
    shutil.rmtree(path / "state")
    assert (path / "model_state").exists() == bool(jax.tree.leaves(learner.model_state))
    shapes = jax.eval_shape(lambda: (learner.params, learner.model_state))
    restored, saved = checkpoint.restore_agent(tmp_path, *shapes)
    toy.assert_equal(restored, (learner.params, learner.model_state))
    assert saved.config == tiny.CONFIG


def test_the_model_state_is_restored_bit_for_bit(tmp_path):
    state = with_model_state()
    path = save(tmp_path, state)
    restored, saved = checkpoint.restore(tmp_path, jax.eval_shape(lambda: state))
    toy.assert_equal(restored, state)
    assert set(saved.leaves["model_state"]) == {"['encoder']['mean']", "['encoder']['var']"}
    assert not [name for name in saved.leaves["state"] if "model_state" in name]
    largest = max(files_of(path / "model_state"), key=lambda file: file.stat().st_size)
    largest.unlink()
    with refused("checkpoint", str(largest)):
        checkpoint.restore_agent(tmp_path, state.learner.params, state.learner.model_state)


@pytest.mark.parametrize("make", [toy.state, with_model_state])
def test_another_model_state_is_refused_by_name(tmp_path, make):
    save(tmp_path, make())
    learner = with_model_state().learner
    wanted = {"encoder": {"mean": jnp.zeros(3), "var": jnp.zeros(2)}}
    with refused("checkpoint", naming=["['encoder']['mean']", "float32[3]"]):
        checkpoint.restore_agent(tmp_path, learner.params, wanted)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (
            lambda s: s._replace(env_steps=jnp.zeros(2, jnp.int32)),
            [".env_steps is int32[]", "int32[2]"],
        ),
        (lambda s: s._replace(env_steps=jnp.zeros(())), [".env_steps is int32[]", "float32[]"]),
        (lambda s: s._replace(key=jnp.zeros((2, 2), jnp.uint32)), [".key is key<fry>[2]"]),
        (
            lambda s: s._replace(replay={"more": s.env_steps, **s.replay}),
            ["['more'] is missing"],
        ),
        (lambda s: s._replace(replay={}), ["expected nothing", "1 more"]),
    ],
)
def test_a_leaf_that_differs_is_named(tmp_path, change, named):
    save(tmp_path, toy.state())
    with refused("checkpoint", naming=named):
        checkpoint.restore(tmp_path, change(toy.state()))


def test_another_width_is_refused_with_both_shapes(tmp_path):
    save(tmp_path, toy.state(width=3))
    with refused("checkpoint", naming=["float32[2,3]", "float32[2,4]"]):
        checkpoint.restore(tmp_path, toy.state(width=4))


@pytest.mark.parametrize("keep", [1, 2])
def test_the_newest_checkpoints_are_kept_as_many_as_configured(tmp_path, keep):
    for env_steps in (8, 16, 120):
        save(
            tmp_path,
            toy.state(env_steps),
            env_steps,
            config=tiny.config(keep_checkpoints=keep),
        )
    names = sorted(path.name for path in checkpoint.root(tmp_path).iterdir())
    assert names == ["000000000016", "000000000120"][-keep:]
    restored, _ = checkpoint.restore(tmp_path, toy.state())
    toy.assert_equal(restored, toy.state(120))


def test_an_incomplete_checkpoint_is_ignored_and_deleted(tmp_path):
    first = save(tmp_path, toy.state())
    shutil.copytree(first, first.with_name(checkpoint.SCRATCH + "000000000016"))
    assert checkpoint.latest(tmp_path) == first
    second = save(tmp_path, toy.state(), 24)
    assert set(checkpoint.root(tmp_path).iterdir()) == {first, second}


def test_a_full_disk_leaves_the_previous_checkpoint_alone(tmp_path, monkeypatch):
    first = save(tmp_path, toy.state())

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(manifest, "write", full)
    with pytest.raises(checkpoint.SaveError, match="No space left") as error:
        save(tmp_path, toy.state(1), 16)
    assert re.search(r"\d+ B needed, [\d.]+ [KMG]iB free", str(error.value))
    assert "checkpoint at 8" in str(error.value)
    assert "--resume" in str(error.value)
    monkeypatch.undo()
    assert list(checkpoint.root(tmp_path).iterdir()) == [first]
    toy.assert_equal(checkpoint.restore(tmp_path, toy.state())[0], toy.state())


@pytest.mark.parametrize(
    ("nbytes", "text"),
    [(0, "0 B"), (337, "337 B"), (1024, "1.0 KiB"), (1_600_000, "1.5 MiB"), (2**35, "32 GiB")],
)
def test_bytes_are_shown_in_a_suitable_unit(nbytes, text):
    assert checkpoint.writing.amount(nbytes) == text


class Stray:
    """Raises an unraisable exception, as TensorStore's callbacks do."""

    def __init__(self, text):
        self._text = text

    def __del__(self):
        raise RuntimeError(self._text)


@pytest.mark.parametrize("error", [None, OSError("full")])
def test_after_an_error_only_the_traces_of_closed_loops_are_suppressed(monkeypatch, error):
    heard = []
    monkeypatch.setattr(sys, "unraisablehook", lambda stray: heard.append(str(stray.exc_value)))
    with contextlib.suppress(OSError), checkpoint.arrays.quiet():
        Stray("Event loop is closed")
        if error:
            raise error
    Stray("Event loop is closed")
    Stray("something else")
    assert heard == ([] if error else ["Event loop is closed"]) + ["something else"]


# TensorStore may still report to the loop that Orbax has closed, once pytest listens again.
@pytest.mark.filterwarnings("ignore:.*:pytest.PytestUnraisableExceptionWarning")
def test_a_failed_write_is_one_error_without_traces(tmp_path, caplog):
    """The limit on the size of files fails the write of one array, in Orbax's threads."""
    save_toy(tmp_path, toy.state(8), 8)
    noise = jnp.asarray(np.random.default_rng(0).normal(size=100_000), jnp.float32)
    large = toy.state(16)._replace(replay=noise)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(checkpoint.SaveError, match="File too large") as error:
            save_toy(tmp_path, large, 16)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "\n" not in str(error.value)
    del error
    gc.collect()
    assert not caplog.records
    assert [path.name for path in checkpoint.root(tmp_path).iterdir()] == ["000000000008"]
    logging.getLogger("absl").warning("is heard again")
    assert [record.getMessage() for record in caplog.records] == ["is heard again"]


def test_parameters_that_are_not_finite_are_not_saved(tmp_path):
    state = toy.state()
    params = state.learner.params._replace(actor={"bias": jnp.array([jnp.nan])})
    with pytest.raises(checkpoint.SaveError, match=r"\.actor\['bias'\]"):
        save(tmp_path, state._replace(learner=state.learner._replace(params=params)))
    statistics = {"mean": jnp.array([jnp.inf])}
    with pytest.raises(checkpoint.SaveError, match=r"\['mean'\]"):
        save(tmp_path, state._replace(learner=state.learner._replace(model_state=statistics)))
    assert checkpoint.latest(tmp_path) is None


def test_a_folder_without_a_checkpoint_is_refused(tmp_path):
    with refused("logdir", str(tmp_path)):
        checkpoint.restore(tmp_path, toy.state())


def test_a_config_survives_json():
    content = as_dict(tiny.CONFIG)
    assert manifest.config_from_dict(content) == tiny.CONFIG
    with refused("Config.colour", 1):
        manifest.config_from_dict(content | {"colour": 1})


@pytest.mark.parametrize("env_steps", [8, 16])
def test_a_checkpoint_older_than_the_newest_is_refused(tmp_path, env_steps):
    newest = save(tmp_path, toy.state(), 16)
    before = files_of(tmp_path)
    with pytest.raises(checkpoint.SaveError, match="16 env steps"):
        save(tmp_path, toy.state(1), env_steps)
    assert files_of(tmp_path) == before
    assert checkpoint.latest(tmp_path) == newest
