"""Makes a film of truth, imagination and value, side by side.

It shows one window of an episode, as in `vawm.analysis.trajectories`: the world model observes
the first steps, then imagines the recorded actions without further observations. The third
panel is the map `Saliency.value` of `vawm.analysis.saliency`, at the states of the second.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from vawm.agent import make_agent
from vawm.agent.open_loop import make_states
from vawm.analysis import figures, inference, saliency, trajectories
from vawm.analysis.episodes import Episodes
from vawm.policy import Policy
from vawm.runs.reports import video

PANEL = 256  # least height of a panel, in pixels
GAP, TITLE = 8, 28  # pixels between panels, and above them
PAPER, INK = (255, 255, 255), (40, 40, 40)


class Film(NamedTuple):
    """T steps of one window as numpy arrays; the world model observed the first `context`.

    Attributes:
      truth: `[T, H, W, 3]` uint8, the observed images.
      imagined: `[T, H, W, 3]` uint8, the decoded images.
      value: `[T, H, W]`, how much the decoded pixels change in the direction of rising V.
      context: number of steps that the world model observed.
    """

    truth: np.ndarray
    imagined: np.ndarray
    value: np.ndarray
    context: int


def make(
    policy: Policy,
    episodes: Episodes,
    *,
    context: int,
    depth: int,
    seed: int,
    unit: saliency.Unit = "symlog",
) -> Film:
    """Makes the film of the first window of `trajectories.imagine`.

    The policy has to observe images. A window of an episode shorter than `context + depth` ends
    with the episode.

    Raises:
      InvalidInput: `context` or `depth` cannot be imagined, see `inference.check`.
    """
    inference.check(policy.config, context=context, depth=depth)
    agent = make_agent(policy.config, policy.spec)
    length = context + depth + 1
    _, batch = trajectories.draw(episodes, length=length, seed=seed, at_most=1)
    truth = jax.tree.map(lambda x: x[0, 1:], batch.trajectory.obs)
    states, maps = make_states(agent, context=context), saliency.value_map(agent, unit=unit)

    def compute(params, model_state, key, batch, truth):
        parts = states(params, model_state, key, batch)
        latent = jax.tree.map(lambda a, b: jnp.concatenate([a[0], b[0]]), *parts)
        return maps(params, model_state, latent, truth)

    key = jax.random.key(seed)
    decoded, value = jax.device_get(
        jax.jit(compute)(policy.params, policy.model_state, key, batch, truth)
    )
    weight = saliency.images(truth, value)
    assert weight is not None  # the policy observes images
    shown = jax.device_get(truth)
    imagined = jax.tree.map(video.to_bytes, decoded, shown)
    steps = min(length, int(np.asarray(episodes.length)[0])) - 1
    return Film(_pictures(shown)[:steps], _pictures(imagined)[:steps], weight[:steps], context)


def _pictures(obs) -> np.ndarray:
    """All images of observations `[T, ...]` side by side, `[T, H, W, 3]`."""
    return video.side_by_side(jax.tree.map(lambda x: x[None], obs))[0]


def frames(film: Film) -> np.ndarray:
    """The frames `[T, H, W, 3]` uint8: three panels, each with a title.

    The second panel's border is green while the world model observes, red while it imagines.
    """
    scale = -(-PANEL // film.truth.shape[1])
    heat = figures.heat(film.imagined, film.value)
    return np.stack(
        [
            _frame((film.truth[t], film.imagined[t], heat[t]), t + 1 - film.context, scale)
            for t in range(len(film.truth))
        ]
    )


def _frame(pictures: tuple[np.ndarray, ...], ahead: int, scale: int) -> np.ndarray:
    """One frame, `ahead` steps after the last observed one."""
    height, width = (scale * side for side in pictures[0].shape[:2])
    color = video.IMAGINED if ahead > 0 else video.SEEN
    model = f"world model imagines, step {ahead}" if ahead > 0 else "world model observes"
    titles = (("truth", INK), (model, color), ("what its value depends on", INK))
    size = 3 * width + 2 * GAP, TITLE + height
    canvas = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.load_default(size=15)
    for i, (picture, (title, ink)) in enumerate(zip(pictures, titles, strict=True)):
        left = i * (width + GAP)
        large = Image.fromarray(picture).resize((width, height), Image.Resampling.BICUBIC)
        canvas.paste(large, (left, TITLE))
        draw.text((left + width / 2, TITLE / 2), title, fill=ink, font=font, anchor="mm")
    left = width + GAP
    draw.rectangle((left, TITLE, left + width - 1, size[1] - 1), outline=color, width=3)
    return np.asarray(canvas)
