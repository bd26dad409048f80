"""Videos from replayed images: predictions of the world model, and episodes of the policy.

Both are read from replay, so they need no extra memory, and they use none of the run's random
numbers.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from PIL import Image

from vawm.agent.open_loop import make_open_loop
from vawm.config import Config
from vawm.learning import image_store, replay
from vawm.learning.replay import Positions
from vawm.learning.train import TrainState
from vawm.runs.trainer import Trainer
from vawm.types import Batch, PyTree, is_image

FRAMES_PER_SECOND = 20
BORDER = 2  # pixels
SEEN, IMAGINED = (0, 160, 0), (200, 0, 0)  # colours of the border


class Video(NamedTuple):
    """A video and its numbers.

    Attributes:
      name: kind of video, such as "open_loop".
      frames: `[T, H, W, 3]` uint8.
      numbers: written next to it, ready for JSON.
    """

    name: str
    frames: np.ndarray
    numbers: dict[str, Any]


def make(trainer: Trainer, config: Config) -> Callable[[TrainState], list[Video]] | None:
    """Builds `film(state) -> videos`; None if the config asks for no videos.

    `film` leaves out a video if replay does not have enough steps for it yet.
    """
    if not config.video.every:
        return None
    choices = config.video
    on_host = config.replay.images == "host"
    predict = jax.jit(make_open_loop(trainer.agent, context=choices.context))
    look_up = jax.jit(lambda buffer, at: replay.read(buffer, at))

    def look(state: TrainState, positions: Positions) -> Batch:
        batch = look_up(state.replay, positions)
        if not on_host:
            return batch
        return image_store.complete(batch, image_store.read(state.images, positions))

    def film(state: TrainState) -> list[Video]:
        learner, buffer = state.learner, state.replay
        env_steps = int(state.collector.env_steps)
        num_envs, capacity = buffer.trajectory.reward.shape
        head, size = int(buffer.head), int(buffer.size)
        length, videos = config.replay.batch_length + 1, []
        if size >= length:
            positions = replay.draw_on_host(
                np.random.default_rng((config.seed, env_steps)),
                *(num_envs, capacity, head, size),
                batch_size=choices.sequences,
                length=length,
            )
            batch = look(state, positions)
            key = jax.random.fold_in(jax.random.key(config.seed), env_steps)
            predicted, same = jax.device_get(
                predict(learner.params, learner.model_state, key, batch)
            )
            truth = jax.device_get(jax.tree.map(lambda x: x[:, 1:], batch.trajectory.obs))
            if jax.tree.leaves(predicted):  # there is a decoder
                videos.append(open_loop_video(truth, predicted, same, context=choices.context))
        times = last_episode(
            *jax.device_get((buffer.trajectory.is_first[0], buffer.trajectory.is_last[0])),
            head=head,
            size=size,
        )
        if times is not None:
            shown = times[: choices.episode_steps]
            # A constant length, so that it is compiled once.
            padded = np.resize(shown, choices.episode_steps).astype(np.int32)
            batch = look(state, Positions(np.zeros(1, np.int32), padded[None]))
            frames = side_by_side(jax.device_get(batch.trajectory.obs))[0, : len(shown)]
            rewards = np.asarray(buffer.trajectory.reward[0])[times]
            numbers = {"return": float(rewards.sum()), "steps": len(times) - 1}
            videos.append(Video("episode", frames, numbers))
        return videos

    return film


def open_loop_video(
    truth: PyTree, predicted: PyTree, same_episode: np.ndarray, *, context: int
) -> Video:
    """Truth, prediction and their difference, one above the other; sequences side by side.

    The border is green while the world model observes, red while it imagines. Zero
    difference is grey. `numbers` has, for each step, the mean squared error of pixels in
    [0, 1] over all channels and over the sequences without a reset so far; None if all had a
    reset or a prediction is not finite.
    """
    error = squared_error(truth, predicted)
    kept = [error[same_episode[:, t], t] for t in range(error.shape[1])]
    pixels = side_by_side(truth).astype(np.float32) / 255
    guess = side_by_side(jax.tree.map(to_bytes, predicted, truth)).astype(np.float32) / 255
    numbers = {
        "context": context,
        "error": [mean_or_none(step) for step in kept],
    }
    rows = np.concatenate([pixels, guess, (guess - pixels + 1) / 2], axis=2)
    frames = np.round(255 * rows).astype(np.uint8)
    frames = np.stack(
        [framed(frames[:, t], SEEN if t < context else IMAGINED) for t in range(rows.shape[1])]
    )
    return Video("open_loop", np.concatenate(list(frames.swapaxes(0, 1)), axis=2), numbers)


def mean_or_none(values: np.ndarray) -> float | None:
    """The mean, or None if it is not finite, as JSON requires."""
    mean = float(values.mean()) if values.size else np.nan
    return mean if np.isfinite(mean) else None


def squared_error(truth: PyTree, predicted: PyTree) -> np.ndarray:
    """Squared error of the predicted images `[B, T]`, mean over pixels and channels."""
    errors = [
        np.square(np.asarray(guess, np.float64) - pixels / 255.0)
        for pixels, guess in zip(
            jax.tree.leaves(truth), jax.tree.leaves(predicted), strict=True
        )
        if is_image(pixels)
    ]
    flat = [error.reshape(*error.shape[:2], -1) for error in errors]
    return np.concatenate(flat, axis=-1).mean(-1)


def to_bytes(predicted: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Images in [0, 1] as uint8; values that are not finite become black. Keeps vectors."""
    if not is_image(like):
        return like
    return np.round(255 * np.clip(np.nan_to_num(predicted), 0, 1)).astype(np.uint8)


def framed(images: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Replaces the outermost pixels of `[B, H, W, 3]` by a border of `color`."""
    images = images.copy()
    edges = slice(BORDER), slice(-BORDER, None)
    for edge in edges:
        images[:, edge] = color
        images[:, :, edge] = color
    return images


def side_by_side(obs: PyTree) -> np.ndarray:
    """Joins the images of `[B, T, ...]` observations to `[B, T, H, W, 3]` uint8.

    Shows the first three channels, or the first one in grey if there are fewer than three.
    """
    images = [np.asarray(x) for x in jax.tree.leaves(obs) if is_image(x)]
    colored = [
        x[..., :3] if x.shape[-1] >= 3 else np.repeat(x[..., :1], 3, axis=-1) for x in images
    ]
    return np.concatenate(colored, axis=-2)


def last_episode(
    is_first: np.ndarray, is_last: np.ndarray, *, head: int, size: int
) -> np.ndarray | None:
    """Indices of the newest complete episode of one stream, oldest step first; or None.

    Args:
      is_first: `[C]` flags of one stream of replay.
      is_last: `[C]`.
      head: index at which the next step will be written.
      size: number of steps stored.
    """
    times = (head - size + np.arange(size)) % len(is_first)
    starts, ends = (np.flatnonzero(flags[times]) for flags in (is_first, is_last))
    for end in ends[::-1]:
        before = starts[starts <= end]
        if len(before) and not np.any((ends >= before[-1]) & (ends < end)):
            return times[before[-1] : end + 1]
    return None


def as_gif(frames: np.ndarray) -> bytes:
    """An animated GIF of `[T, H, W, 3]` frames that loops forever."""
    first, *rest = (Image.fromarray(frame) for frame in frames)
    file = io.BytesIO()
    first.save(
        file,
        format="GIF",
        save_all=True,
        append_images=rest,
        duration=1000 // FRAMES_PER_SECOND,
        loop=0,
    )
    return file.getvalue()
