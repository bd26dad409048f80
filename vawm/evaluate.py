"""Scores of a trained policy, by the protocol of its suite; and the command line.

    python -m vawm.evaluate --logdir runs/...

Actions are sampled from the policy, as in the official DreamerV3, at temperature 1 even if the
policy collected at another one; `how="mode"` takes its mode. How many episodes count is decided
before they begin, and each counts once. On the host, no episode of training is played again.

The protocol is part of the record of a suite, see `vawm.runs.suites`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import pathlib
import sys
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import jax

from vawm import envs
from vawm.cli import flags
from vawm.cli.command_line import guard
from vawm.envs.protocol import (
    Environment,
    EnvironmentFailure,
    HostEnvironment,
    check_environment,
    check_fits,
    check_positive,
)
from vawm.errors import InvalidInput
from vawm.policy import Policy, load, movies, play, scores
from vawm.policy.play import FRESH, How, Score
from vawm.process import cache, huge_pages
from vawm.process.names import shown
from vawm.runs import run_folder, suites
from vawm.runs.reports import film

LONGEST_FILM = 1_000
"""Steps of a film. Its frames have to fit into memory."""
AT_ONCE = 8
"""Environments on the host that are stepped together, each with its share of the episodes."""


def evaluate(
    policy: Policy,
    *,
    episodes: int,
    env: Environment | HostEnvironment,
    how: How = "sample",
    seed: int = 0,
) -> Score:
    """Plays `episodes` whole episodes in any environments.

    Args:
      policy: as `vawm.load` returns it.
      episodes: how many; a jittable environment needs `num_envs == episodes`.
      env: where to play; one on the host is not closed.
      how: sample actions from the policy, or take its mode.
      seed: of the episodes and of the actions.

    Raises:
      InvalidInput: the number of episodes is not positive, the seed is out of range, or the
        environments do not fit the policy.
      EnvironmentFailure: an environment on the host failed.
    """
    check(episodes, seed)
    check_environment(env)
    check_fits(policy.spec, env.spec)
    if not isinstance(env, Environment):
        return play.on_host(env, policy, episodes=episodes, seed=seed, how=how)
    if env.spec.num_envs != episodes:
        remedy = f"must equal the number of environments; use {env.spec.num_envs}"
        raise InvalidInput("episodes", episodes, remedy)
    returns = play.player(env, policy, how)(
        policy.params, policy.model_state, jax.random.key(seed)
    )
    return Score(tuple(map(float, returns)))


def check(episodes: int, seed: int) -> None:
    """Refuses a number of episodes or a seed that is out of range.

    Raises:
      InvalidInput: names the number and the remedy.
    """
    check_positive("episodes", episodes)
    if not 0 <= seed < 2**31:
        raise InvalidInput("seed", seed, f"use a number from 0 to {2**31 - 1}")


def by_protocol(
    policy: Policy,
    *,
    episodes: int | None = None,
    how: How = "sample",
    seed: int = 0,
    physics: str | None = None,
    **choices: Any,
) -> Score:
    """Plays by the protocol of the suite in which the policy was trained.

    Args:
      policy: as `vawm.load` returns it.
      episodes: how many; as many as the protocol says if None.
      how: sample actions from the policy, or take its mode.
      seed: of the episodes and of the actions.
      physics: one of `Protocol.physics`; that of training if None.
      **choices: of the environments, those in `Protocol.options`, such as `sticky=0.25` for
        Atari.

    Raises:
      InvalidInput: a number is out of range, the protocol does not have this option, or the
        policy was trained in environments that only the caller can make.
      EnvironmentFailure: an environment on the host failed.
    """
    protocol = suites.of(policy.config).protocol
    episodes = protocol.episodes if episodes is None else episodes
    check(episodes, seed)
    check_options(policy.config.suite, physics=physics, **choices)
    if physics == "mujoco":
        suites.check_made(policy.spec.made, python=in_python(episodes))
        envs.check_task(policy.spec.task)
        return play.in_mujoco(policy, episodes=episodes, seed=seed, how=how)
    changes = {**protocol.changes, **choices}
    with environments(policy, episodes, **changes) as env:
        if env.spec.task != policy.spec.task:
            remedy = f"is not the config's task, {env.spec.task}; use evaluate(..., env=...)"
            raise InvalidInput("task", policy.spec.task, remedy)
        return evaluate(policy, episodes=episodes, env=env, how=how, seed=seed)


def check_options(suite: str, *, physics: str | None = None, **choices: Any) -> None:
    """Refuses what the protocol of a suite does not let the caller choose.

    Raises:
      InvalidInput: names the option.
    """
    protocol = suites.SUITES[suite].protocol
    if physics is not None and physics not in protocol.physics:
        raise InvalidInput("physics", physics, f"is not an option of {suite}")
    for name, value in choices.items():
        if name not in protocol.options:
            raise InvalidInput(name, value, f"is not an option of {suite}")


def filmed(
    policy: Policy,
    *,
    seed: int = 0,
    steps: int = LONGEST_FILM,
    how: How = "sample",
    **changes: Any,
) -> film.Film:
    """Plays and draws one episode in the environments that the policy was trained in.

    A task on MJX is played in dm_control's own simulation, which draws it.

    Args:
      policy: as `vawm.load` returns it.
      seed: of the episode and of the actions.
      steps: longest film, which ends there if the episode does not.
      how: sample actions from the policy, or take its mode.
      **changes: choices of the environments that differ from those of training.

    Raises:
      InvalidInput: they were made by code of the caller's, or no renderer works here.
      NoPicture: nothing draws them.
      EnvironmentFailure: drawing or playing failed.
    """
    return film.play(
        policy.config,
        policy.agent,
        policy.params,
        policy.model_state,
        seed=FRESH + seed,
        steps=steps,
        python=in_python(1),
        how=how,
        **changes,
    )


@contextlib.contextmanager
def environments(
    policy: Policy, episodes: int, **changes: Any
) -> Iterator[Environment | HostEnvironment]:
    """The environments a policy was trained in, as many as `episodes` need, but on the host at
    most `AT_ONCE`.

    Args:
      policy: as `vawm.load` returns it.
      episodes: how many will be played.
      **changes: choices of the environments that differ from those of training.

    Raises:
      InvalidInput: they were made by code of the caller's; names the two lines of Python.
    """
    num_envs = episodes
    if suites.host_choices(policy.config) is not None:
        num_envs, changes = min(episodes, AT_ONCE), changes | {"on_failure": "raise"}
    env = suites.make_again(
        dataclasses.replace(policy.config, num_envs=num_envs),
        policy.spec.made,
        task=policy.spec.task,
        python=in_python(episodes),
        **changes,
    )
    try:
        yield env
    finally:
        if not isinstance(env, Environment):
            env.close()


def in_python(episodes: int) -> str:
    """The statements that evaluate a policy in environments of the caller's."""
    load = "policy = vawm.load(LOGDIR)"
    return f"{load}; vawm.evaluate.evaluate(policy, episodes={episodes}, env=...)"


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Evaluate the newest checkpoint of a run by the protocol of its suite."""

    logdir: pathlib.Path
    """folder of the run"""
    episodes: int | None = None
    """how many; as many as the protocol says if not given"""
    how: Literal["sample", "mode"] = "sample"
    """sample actions from the policy, or take its mode"""
    physics: Literal["mjx", "mujoco"] = "mjx"
    """mujoco: play in dm_control's own C simulation too; for dmc_proprio"""
    sticky: float = 0.0
    """probability of sticky actions; for atari100k"""
    seed: int = 0
    """of the episodes and of the actions"""
    video: pathlib.Path | None = None
    """also film one episode: a file that ends with .mp4 or .gif"""


def main(argv: Sequence[str] | None = None) -> int:
    """Prints the score, one line per physics engine; returns the exit code."""
    arguments = flags.read(Arguments, argv, description=description())
    check(1 if arguments.episodes is None else arguments.episodes, arguments.seed)
    if arguments.video is not None:
        run_folder.check_writable(arguments.video.parent, "video")
        movies.check_name("video", arguments.video)
    cache.enable()
    policy = load(arguments.logdir)
    suite, task = policy.config.suite, policy.spec.task
    variants = _variants(arguments, suite)
    suites.check_made(policy.spec.made, python=in_python(arguments.episodes or 1))
    print(f"{task} ({suite}) at {policy.env_steps} env steps, mean +- standard error")
    for name, options in variants.items():
        score = by_protocol(
            policy,
            episodes=arguments.episodes,
            how=arguments.how,
            seed=arguments.seed,
            **options,
        )
        print(f"  {name:6} {score}{_normalized(suite, task, score)}", flush=True)
    if arguments.video is not None:
        print(_film(policy, arguments))
    return 0


def _film(policy: Policy, arguments: Arguments) -> str:
    """Writes the film that was asked for; what came out, in one line.

    The scores count even where nothing can be drawn.
    """
    assert arguments.video is not None
    where = shown(arguments.video)
    changes = dict(suites.of(policy.config).protocol.changes)
    if arguments.sticky:
        changes["sticky"] = arguments.sticky
    try:
        made = filmed(policy, seed=arguments.seed, how=arguments.how, **changes)
    except (InvalidInput, film.NoPicture, EnvironmentFailure) as error:
        return f"  no film in {where}: {flags.in_flags(error)}"
    arguments.video.parent.mkdir(parents=True, exist_ok=True)
    movies.write(film.frames(made), arguments.video)
    return f"  film of an episode with return {made.returns[-1]:.1f}: {where}"


def description() -> str:
    """The help: what this module does, and the protocol of every suite."""
    rows = [
        f"    {name:12}{suite.protocol.episodes:4} {suite.protocol.text}"
        for name, suite in suites.SUITES.items()
    ]
    return "\n".join(
        [__doc__ or "", "The usual number of episodes, and what they are:", "", *rows]
    )


def _variants(arguments: Arguments, suite: str) -> dict[str, dict[str, Any]]:
    """Name of a line -> options of the protocol.

    Raises:
      InvalidInput: the protocol of this suite does not have the option.
    """
    options: dict[str, Any] = {"sticky": arguments.sticky} if arguments.sticky else {}
    other = arguments.physics if arguments.physics != "mjx" else None
    check_options(suite, physics=other, **options)
    if not 0 <= arguments.sticky < 1:
        raise InvalidInput("sticky", arguments.sticky, "use a number from 0 up to 1")
    engines = suites.SUITES[suite].protocol.physics[:1] + ((other,) if other else ())
    if not engines:
        return {arguments.how: options}
    return {name: {"physics": name, **options} for name in engines}


def _normalized(suite: str, task: str, score: Score) -> str:
    """The human-normalised score, where there is one of a human."""
    table = suites.SUITES[suite].human_table
    if not table:
        return ""
    return f", {scores.human_normalized(task, score.mean, table=table):.3f} human-normalised"


if __name__ == "__main__":
    huge_pages.use_huge_pages()
    sys.exit(guard(main))
