"""The replay buffer against a list of Python lists."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vawm.learning import replay
from vawm.types import EnvSpec, Latent, Trajectory, vector

CLASSES = 3


def steps(num_envs, first, count):
    """Steps whose reward says which they are: 1000 * env + time."""
    time = jnp.arange(first, first + count)
    reward = 1000.0 * jnp.arange(num_envs)[:, None] + time[None, :]
    flags = jnp.zeros(reward.shape, bool)
    trajectory = Trajectory(reward[..., None], reward, flags, flags, flags, reward[..., None])
    index = jnp.broadcast_to(time % CLASSES, reward.shape)[..., None]
    return trajectory, Latent(reward[..., None] + 0.5, index.astype(jnp.uint8))


def first_step(tree):
    return jax.tree.map(lambda x: x[:, 0], tree)


def filled(num_envs, capacity, chunks):
    trajectory, latent = steps(num_envs, 0, 1)
    buffer = replay.init(first_step(trajectory), first_step(latent), capacity=capacity)
    first = 0
    for count in chunks:
        buffer = replay.add(buffer, *steps(num_envs, first, count))
        first += count
    return buffer


def draw(buffer, key, batch_size, length):
    positions = replay.draw(buffer, key, batch_size=batch_size, length=length)
    return *replay.read(buffer, positions), positions


@pytest.mark.parametrize("chunks", [[4], [4, 4, 4], [3, 5, 5], [7, 7, 7, 7]])
def test_samples_are_consecutive_and_never_cross_the_write_head(chunks):
    buffer, length = filled(2, 7, chunks), 4
    trajectory, _, _ = draw(buffer, jax.random.key(0), 256, length)
    reward = np.asarray(trajectory.reward)
    assert (np.diff(reward, axis=1) == 1).all()
    newest = sum(chunks) - 1
    oldest = max(0, newest - 6)
    starts = set(reward[:, 0].astype(int))
    possible = range(oldest, newest - length + 2)
    assert starts == {1000 * env + time for env in range(2) for time in possible}


def test_starts_are_drawn_uniformly():
    buffer = filled(2, 7, [5, 5])
    trajectory, _, _ = draw(buffer, jax.random.key(1), 8000, 4)
    _, counts = np.unique(np.asarray(trajectory.reward)[:, 0], return_counts=True)
    assert len(counts) == 8
    assert (abs(counts - 1000) < 5 * np.sqrt(1000)).all()


def test_a_sample_starts_from_the_latent_stored_at_its_first_step():
    trajectory, latent, _ = draw(filled(2, 7, [5, 5]), jax.random.key(2), 64, 4)
    first = np.asarray(trajectory.reward)[:, 0]
    np.testing.assert_array_equal(latent.deter[:, 0], first + 0.5)
    np.testing.assert_array_equal(latent.stoch[:, 0], first % 1000 % CLASSES)


def test_latents_written_back_are_found_again_and_nothing_else_changes():
    buffer = filled(2, 7, [5, 5])
    _, _, positions = draw(buffer, jax.random.key(3), 1, 4)
    new = Latent(-jnp.ones((1, 4, 1)), jnp.full((1, 4, 1), 2, jnp.uint8))
    after = replay.write_back(buffer, positions, new)
    touched = np.zeros((2, 7), bool)
    touched[np.asarray(positions.env)[:, None], np.asarray(positions.time)] = True
    assert touched.sum() == 4
    before = np.asarray(buffer.latent.deter)
    np.testing.assert_array_equal(after.latent.deter[touched], -1.0)
    np.testing.assert_array_equal(np.asarray(after.latent.deter)[~touched], before[~touched])
    np.testing.assert_array_equal(np.asarray(after.latent.stoch)[touched], 2)
    jax.tree.map(np.testing.assert_array_equal, after.trajectory, buffer.trajectory)


def test_number_of_starts_counts_all_streams():
    assert replay.num_starts(filled(2, 7, [3]), 4) == 0
    assert replay.num_starts(filled(2, 7, [5]), 4) == 4
    assert replay.num_starts(filled(2, 7, [5, 5]), 4) == 8


def test_an_episode_that_a_reset_cut_short_ends_in_the_sample():
    buffer = filled(1, 6, [6])
    is_first = jnp.array([[False, False, False, True, False, False]])
    buffer = buffer._replace(trajectory=buffer.trajectory._replace(is_first=is_first))
    trajectory, _, _ = draw(buffer, jax.random.key(4), 1, 6)
    expected = [False, False, True, False, False, False]
    np.testing.assert_array_equal(np.asarray(trajectory.is_last)[0], expected)


def test_adding_more_steps_than_fit_is_refused():
    with pytest.raises(ValueError, match=r"8.*7"):
        filled(2, 7, [8])


def test_capacity_is_shared_by_environments_and_bounded_by_the_run():
    spec = EnvSpec("test", vector(1), 1, False, 4, 5, 200)

    def capacity(env_steps, collect_steps=1):
        return replay.capacity_per_env(
            1000, spec, env_steps=env_steps, collect_steps=collect_steps
        )

    assert capacity(10**6) == 250
    assert capacity(1000) == 51  # 1000 / (4 * 5) calls and one reset
    assert capacity(4000) == 202  # a second reset after 200 calls
    assert capacity(1000, collect_steps=20) == 60


def test_without_latents_a_sample_has_no_context_and_nothing_is_written_back():
    trajectory, _ = steps(2, 0, 5)
    buffer = replay.init(first_step(trajectory), (), capacity=7)
    buffer = replay.add(buffer, trajectory, ())
    positions = replay.draw(buffer, jax.random.key(5), batch_size=3, length=4)
    read, context = replay.read(buffer, positions)
    assert context == buffer.latent == ()
    assert (np.diff(read.reward, axis=1) == 1).all()
    jax.tree.map(
        np.testing.assert_array_equal, replay.write_back(buffer, positions, ()), buffer
    )
