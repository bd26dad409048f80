"""Films of an agent that acts: pictures of its environment, labelled.

The pictures are those that the environments on the host can draw (`Pool.picture`). Tasks on MJX
are played in dm_control's own simulation, see `vawm.envs.host.drawn`.
"""

from __future__ import annotations

import contextlib
import dataclasses
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from vawm.agent import Agent, PolicyCarry
from vawm.config import Config
from vawm.envs.host.pool import Pool
from vawm.envs.protocol import check_fits
from vawm.learning.state import Learner
from vawm.runs import suites
from vawm.runs.reports.video import Video
from vawm.types import Array, Key, Params, PyTree, TimeStep

SMALLEST = 256  # pixels, the shorter side of a picture
STRIP = 28  # pixels for the label below it
PAPER, INK = (255, 255, 255), (40, 40, 40)
STEPS = 200
"""Of the film at the end of a run: ten seconds."""
SEED = 2**33
"""Added to the seed of the run: neither training nor an evaluation plays this episode."""


class NoPicture(RuntimeError):
    """The environment cannot be drawn; the message says why."""


class Film(NamedTuple):
    """T steps of one environment, from the first of an episode on; numpy.

    Attributes:
      pictures: `[T, H, W, 3]` uint8.
      returns: `[T]` sum of the rewards of the episode so far.
      values: `[T]` the critic's value of what the agent saw.
      ended: whether the last picture is the last of the episode.
    """

    pictures: np.ndarray
    returns: np.ndarray
    values: np.ndarray
    ended: bool


def record(
    agent: Agent,
    params: Params,
    model_state: PyTree,
    env: Pool,
    *,
    seed: int,
    steps: int,
    how: Literal["sample", "mode"] = "sample",
) -> Film:
    """Plays one episode and draws every step of it.

    Args:
      agent: that acts.
      params: its parameters.
      model_state: of its world model.
      env: where to play, one environment on the host; not closed.
      seed: of the episode and of the actions.
      steps: longest film, which ends there if the episode does not.
      how: sample actions, or take the mode.

    Raises:
      NoPicture: the environment cannot be drawn.
      EnvironmentFailure: it failed.
    """

    @jax.jit
    def act(
        params: Params, model_state: PyTree, key: Key, carry: PolicyCarry, timestep: TimeStep
    ) -> tuple[PolicyCarry, Array, Array]:
        carry, action, latent = agent.see(params, model_state, key, carry, timestep, how=how)
        value = agent.critic.code.mean(agent.critic.logits(params.critic, latent))
        return carry, action, value

    pictures, returns, values, total = [], [], [], 0.0
    carry, key = agent.initial(1), jax.random.key(seed % 2**32)
    timestep = env.reset(seed)
    while True:
        total += float(timestep.reward[0])
        pictures.append(picture(env))
        key, key_act = jax.random.split(key)
        carry, action, value = act(params, model_state, key_act, carry, timestep)
        returns.append(total)
        values.append(float(value[0]))
        ended = bool(timestep.is_last[0])
        if ended or len(pictures) == steps:
            return Film(np.stack(pictures), np.array(returns), np.array(values), ended)
        env.send(np.asarray(action))
        timestep = env.receive()


def play(
    config: Config,
    agent: Agent,
    params: Params,
    model_state: PyTree,
    *,
    seed: int,
    steps: int,
    python: str,
    how: Literal["sample", "mode"] = "sample",
    **changes: Any,
) -> Film:
    """`record` in an environment like those that a run was trained in.

    Args:
      config: of the run.
      agent: of it.
      params: as in `record`, and so are the following, if not told otherwise.
      model_state: of the world model.
      seed: of the episode and of the actions.
      steps: longest film.
      python: what films environments of the caller's, for the remedy.
      how: sample actions, or take the mode.
      **changes: choices of the environments that differ from those of training.

    Raises:
      InvalidInput: its environments cannot be made again, or no renderer works here.
      NoPicture: nothing draws them.
      EnvironmentFailure: drawing or playing failed.
    """
    env = suites.make_again(
        dataclasses.replace(config, num_envs=1),
        agent.spec.made,
        task=agent.spec.task,
        python=python,
        drawn=True,
        **changes,
    )
    with contextlib.closing(env):  # type: ignore[type-var]
        check_fits(agent.spec, env.spec)
        return record(
            agent,
            params,
            model_state,
            env,  # type: ignore[arg-type]
            seed=seed,
            steps=steps,
            how=how,
        )


def of_run(config: Config, agent: Agent, learner: Learner) -> Video:
    """The film at the end of a run: the beginning of an episode of its policy.

    It has random numbers of its own, so that the run has the same with and without it. Raises
    what `play` does.
    """
    made = play(
        config,
        agent,
        learner.params,
        learner.model_state,
        seed=SEED + config.seed,
        steps=STEPS,
        python="vawm.runs.reports.film.record(agent, params, model_state, env)",
    )
    numbers = {"return": float(made.returns[-1]), "steps": len(made.returns) - 1}
    return Video("policy", frames(made), numbers | {"ended": made.ended})


def picture(env: Pool) -> np.ndarray:
    """`[H, W, 3]` uint8, what the first environment looks like now.

    Raises:
      NoPicture: it does not say, or not in bytes of RGB.
    """
    drawn = env.picture() if hasattr(env, "picture") else None
    if drawn is None:
        raise NoPicture(f"{env.spec.task} has nothing that draws it")
    if drawn.dtype != np.uint8 or drawn.ndim != 3 or drawn.shape[-1] != 3:
        raise NoPicture(f"{env.spec.task} is drawn as {drawn.dtype}{list(drawn.shape)}")
    return drawn


def frames(film: Film) -> np.ndarray:
    """The frames `[T, H, W, 3]` uint8: enlarged pictures above step, return and value.

    Both sides of a frame are even, as the codecs of MP4 need.
    """
    height, width = film.pictures.shape[1:3]
    scale = max(1, -(-SMALLEST // min(height, width)))
    size = (scale * width, scale * height)
    font = ImageFont.load_default(size=15)
    canvases = []
    for step, shown in enumerate(film.pictures):
        canvas = Image.new("RGB", (size[0] + size[0] % 2, size[1] + size[1] % 2 + STRIP), PAPER)
        canvas.paste(Image.fromarray(shown).resize(size, Image.Resampling.NEAREST), (0, 0))
        text = f"step {step}   return {film.returns[step]:.1f}   value {film.values[step]:.1f}"
        at = canvas.width / 2, canvas.height - STRIP / 2
        ImageDraw.Draw(canvas).text(at, text, fill=INK, font=font, anchor="mm")
        canvases.append(np.asarray(canvas))
    return np.stack(canvases)
