"""Exports a trained policy to a folder: weights, configuration, model card.

    python -m vawm.export --logdir runs/... --output cartpole --episodes 10

Wherever vawm is installed, five lines load it and act, without the run's folder:

    import vawm
    policy = vawm.load("cartpole")
    env = policy.make_env()
    obs, _ = env.reset(seed=0)
    action = policy.predict(obs, episode_start=True)

`python -m vawm.evaluate --logdir cartpole` evaluates it. `vawm.policy.weights` describes the
files. `--format hub` also writes what hubs of models index and show: the score in the head of
the card, `results.json`, and `replay.mp4` where the environment can be drawn.
"""

from __future__ import annotations

import dataclasses
import os
import pathlib
import sys
import tempfile
from collections.abc import Sequence
from typing import Literal

from vawm import evaluate
from vawm.agent import parameter_count, registry
from vawm.cli import flags
from vawm.cli.command_line import guard
from vawm.config import Config
from vawm.envs import made as records
from vawm.envs.protocol import EnvironmentFailure
from vawm.errors import InvalidInput
from vawm.policy import Policy, hub, load, movies, weights
from vawm.policy.play import Score
from vawm.process import cache, huge_pages, names
from vawm.runs import checkpoint, suites
from vawm.runs.checkpoint import manifest
from vawm.runs.reports import film as films

LOAD = """\
import vawm

policy = vawm.load("FOLDER")  # this folder
"""
USAGE = f"""{LOAD}\
env = policy.make_env()
obs, _ = env.reset(seed=0)
action = policy.predict(obs, episode_start=True)"""
OWN_USAGE = f"""{LOAD}\
action = policy.predict(obs, episode_start=True)  # an observation of your environment"""
"""How to act once, for the model card."""

Format = Literal["plain", "hub"]


def export(
    logdir: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    policy: Policy | None = None,
    scores: Score | None = None,
    protocol: str = "",
    layout: Format = "plain",
    replay: bytes | None = None,
) -> pathlib.Path:
    """Writes the policy of the newest checkpoint in `logdir` to `folder`.

    Args:
      logdir: folder of a run.
      folder: new or empty.
      policy: the policy to write, if it was loaded from `logdir` before, for example to
        measure `scores`. (The run may have a newer checkpoint by now.)
      scores: of an evaluation; without them the model card has the last training return.
      protocol: how the scores were measured; default the suite's protocol with sampled
        actions.
      layout: "hub" for a folder that hubs of models index.
      replay: the content of `replay.mp4` there; none without it.

    Returns:
      The folder.

    Raises:
      InvalidInput: no checkpoint, or a folder that is not empty; nothing was written.
      SaveError: writing failed, for example on a full disk; leaves no files behind.
    """
    logdir, folder = checkpoint.expanded(logdir), checkpoint.expanded(folder, "output")
    weights.check_output(folder)
    policy = policy or load(logdir)
    protocol = protocol or f"{suites.of(policy.config).protocol.text}; actions sampled"
    head, others = hub.plain_head(), {}
    if layout == "hub":
        head = hub.head(policy, scores)
        others = {hub.RESULTS: hub.results(policy, scores, protocol)}
        if replay is not None:
            others[hub.REPLAY] = replay
    weights.write(
        folder,
        policy.params,
        policy.model_state,
        config=policy.config,
        spec=policy.spec,
        env_steps=policy.env_steps,
        card=card(policy, measured(policy, scores, protocol), head=head),
        last_return=policy.last_return,
        others=others,
    )
    return folder


def measured(policy: Policy, scores: Score | None, protocol: str) -> str:
    """The score as a sentence, which says whether it is of an evaluation."""
    if scores is not None:
        return f"Evaluation: return {scores} ({protocol}), mean +- standard error."
    if policy.last_return is None:
        return "Not evaluated, and training recorded no return."
    return (
        f"Not evaluated. Last training return: {policy.last_return}, with the rewards and the "
        "exploration of training."
    )


def film(policy: Policy, *, seed: int = 0) -> bytes:
    """An MP4 of the beginning of one episode, see `vawm.evaluate.filmed`.

    Raises:
      InvalidInput: the environment cannot be made or drawn, or a package is not installed.
      NoPicture: nothing draws the environment.
      EnvironmentFailure: drawing or playing failed.
    """
    movies.check()
    shown = films.frames(evaluate.filmed(policy, seed=seed))
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / hub.REPLAY
        movies.write(shown, path)
        return path.read_bytes()


def card(policy: Policy, measured: str, *, head: str = "") -> str:
    """The text of `README.md`; `measured` is the sentence about the policy's score."""
    config, spec, made = policy.config, policy.spec, policy.spec.made
    plugin = registry.plugin_of(config.agent)
    file = names.shown(pathlib.Path(plugin).name) if plugin else ""
    evaluation = "python -m vawm.evaluate --logdir FOLDER"
    if file:
        evaluation += f" --plugin {file}"
    rows = {
        "task": f"{spec.task} ({config.suite})",
        "environment": "as the task's name says" if made is None else records.describe(made),
        "agent": config.agent + (f", registered by {file}: import it first" if file else ""),
        "size": f"{config.size}, {parameter_count(policy.params):,} parameters",
        "preset": config.preset,
        "env steps": f"{policy.env_steps:,} of {config.env_steps:,}, "
        f"action repeat {spec.action_repeat}",
        "seed": config.seed,
        "value alignment": _alignment(config, policy.env_steps),
        "written by": f"vawm {manifest.version()}",
    }
    table = "\n".join(f"| {name} | {value} |" for name, value in rows.items())
    return f"""{head or hub.plain_head()}---

# {spec.task}, {config.agent}

| | |
|---|---|
{table}

## Score

{measured}

## Use

```python
{_usage(policy)}
```

Evaluate it with `{evaluation}`. `{weights.CONFIG}` has all training
settings.

## Licence

Apache-2.0, as vawm.
"""


def _usage(policy: Policy) -> str:
    """The lines that load the policy and act once."""
    config, made = policy.config, policy.spec.made
    if not records.can_be_made_again(made):
        return OWN_USAGE
    try:  # of an earlier version: its spec names the task, its config another environment
        suites.check_task(dataclasses.replace(config, task=policy.spec.task))
    except InvalidInput:
        if made is None:
            return OWN_USAGE
    return USAGE


def _alignment(config: Config, env_steps: int) -> str:
    """Whether and how training used L_var."""
    alignment = config.value_alignment
    if alignment.weight == "off":
        return "off"
    warmup, unit = alignment.warmup_steps, alignment.warmup_unit.replace("_", " ")
    if alignment.warmup_unit == "env_steps" and env_steps <= warmup:
        return f"not active: training ended within the warm-up of {warmup:,} env steps"
    weight = {
        "adaptive": "weight 1 / max(1, KL)",
        "static": f"weight {alignment.static_weight:g}",
    }[alignment.weight]
    return f"{weight} after a warm-up of {warmup:,} {unit}"


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Write the policy of a run's newest checkpoint to a new folder."""

    logdir: pathlib.Path
    """folder of the run"""
    output: pathlib.Path
    """folder to write; new or empty"""
    format: Format = "plain"
    """hub: also what hubs of models index and show"""
    episodes: int | None = None
    """episodes to play by the suite's protocol, for the model card. If not given, none; for a
    hub as many as the protocol says"""
    seed: int = 0
    """seed of these episodes"""


def wanted_episodes(arguments: Arguments, policy: Policy) -> int:
    """How many episodes to play for the card."""
    if arguments.episodes is not None:
        return arguments.episodes
    if arguments.format == "plain" or not records.can_be_made_again(policy.spec.made):
        return 0
    return suites.of(policy.config).protocol.episodes


def main(argv: Sequence[str] | None = None) -> int:
    """Exports, prints the folder, and returns the exit code."""
    arguments = flags.read(Arguments, argv, description=__doc__)
    weights.check_output(checkpoint.expanded(arguments.output, "output"))
    evaluate.check(arguments.episodes or 1, arguments.seed)
    policy, scores, replay = load(arguments.logdir), None, None
    if episodes := wanted_episodes(arguments, policy):
        cache.enable()
        scores = evaluate.by_protocol(policy, episodes=episodes, seed=arguments.seed)
    if arguments.format == "hub":
        try:
            replay = film(policy, seed=arguments.seed)
        except (InvalidInput, films.NoPicture, EnvironmentFailure) as error:
            print(f"without {hub.REPLAY}: {flags.in_flags(error)}")
    folder = export(
        arguments.logdir,
        arguments.output,
        policy=policy,
        scores=scores,
        layout=arguments.format,
        replay=replay,
    )
    print(f"exported to {names.shown(folder)}" + (f", return {scores}" if scores else ""))
    print(f"evaluate with: python -m vawm.evaluate {names.flag('logdir', folder)}")
    return 0


if __name__ == "__main__":
    huge_pages.use_huge_pages()
    sys.exit(guard(main))
