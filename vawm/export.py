"""Exports a trained policy to a folder: weights, configuration, model card.

    python -m vawm.export --logdir runs/... --output cartpole --episodes 10

Wherever vawm is installed, five lines load it and act, without the run's folder:

    import jax, vawm
    policy = vawm.load("cartpole")
    env = vawm.envs.make(policy.spec.task, num_envs=1, action_repeat=policy.spec.action_repeat)
    _, timestep = env.reset(jax.random.key(0))
    carry, action = policy.act(jax.random.key(1), policy.initial(1), timestep)

`python -m vawm.evaluate --logdir cartpole` evaluates it. `vawm.policy.weights` describes the
files.
"""

from __future__ import annotations

import dataclasses
import os
import pathlib
import sys
from collections.abc import Sequence

from vawm import evaluate
from vawm.agent import parameter_count, registry
from vawm.cli import flags
from vawm.cli.command_line import guard
from vawm.config import Config
from vawm.envs import made as records
from vawm.errors import InvalidInput
from vawm.policy import Policy, load, weights
from vawm.policy.play import Score
from vawm.process import cache, huge_pages, names
from vawm.runs import checkpoint, suites
from vawm.runs.checkpoint import manifest
from vawm.runs.reports import tracking

LOAD = """\
import jax, vawm

policy = vawm.load("FOLDER")  # this folder
"""
USAGE = f"""{LOAD}\
env = vawm.envs.make(policy.spec.task, num_envs=1, action_repeat=policy.spec.action_repeat)
_, timestep = env.reset(jax.random.key(0))
carry, action = policy.act(jax.random.key(1), policy.initial(1), timestep)"""
HOST_USAGE = f"""import vawm.evaluate
{LOAD}\
with vawm.evaluate.environments(policy, episodes=1) as env:  # as in training
    carry, timestep = policy.initial(env.spec.num_envs), env.reset(0)
    carry, action = policy.act(jax.random.key(1), carry, timestep)"""
OWN_USAGE = f"""{LOAD}\
carry, action = policy.act(jax.random.key(1), policy.initial(1), timestep)  # your timestep"""
"""How to act once, for the model card: on MJX, on the host, in the user's environment."""


def export(
    logdir: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    policy: Policy | None = None,
    scores: Score | None = None,
    protocol: str = "",
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

    Returns:
      The folder.

    Raises:
      InvalidInput: no checkpoint, or a folder that is not empty; nothing was written.
      SaveError: writing failed, for example on a full disk; leaves no files behind.
    """
    logdir, folder = checkpoint.expanded(logdir), checkpoint.expanded(folder, "output")
    weights.check_output(folder)
    policy = policy or load(logdir)
    measured = _last_return(logdir, policy.env_steps)
    if scores is not None:
        protocol = protocol or f"{suites.of(policy.config).protocol.text}; actions sampled"
        measured = f"Evaluation: return {scores} ({protocol}), mean +- standard error."
    weights.write(
        folder,
        policy.params,
        policy.model_state,
        config=policy.config,
        spec=policy.spec,
        env_steps=policy.env_steps,
        card=card(policy, measured),
    )
    return folder


def _last_return(logdir: pathlib.Path, env_steps: int) -> str:
    """The last return of training as a sentence, which says that it is not an evaluation."""
    path = logdir / tracking.METRICS
    lines = [
        entry
        for entry in tracking.read(path)
        if entry["env_steps"] <= env_steps and entry.get("episode/return") is not None
    ]
    if not lines:
        return "Not evaluated, and training recorded no return."
    last = lines[-1]
    return (
        f"Not evaluated. Last training return: {last['episode/return']:.1f}, the mean over "
        f"{last['episode/count']} episodes that ended shortly before {last['env_steps']} env "
        "steps, with the rewards and the exploration of training."
    )


def card(policy: Policy, measured: str) -> str:
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
    return f"""---
license: apache-2.0
library_name: vawm
tags: [reinforcement-learning, world-model, jax]
---

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
    return USAGE if suites.host_choices(config) is None else HOST_USAGE


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
    episodes: int = 0
    """episodes to play by the suite's protocol, for the model card; 0 for none"""
    seed: int = 0
    """seed of these episodes"""


def main(argv: Sequence[str] | None = None) -> int:
    """Exports, prints the folder, and returns the exit code."""
    arguments = flags.read(Arguments, argv, description=__doc__)
    weights.check_output(checkpoint.expanded(arguments.output, "output"))
    evaluate.check(arguments.episodes or 1, arguments.seed)
    policy, scores = load(arguments.logdir), None
    if arguments.episodes:
        cache.enable()
        scores = evaluate.by_protocol(policy, episodes=arguments.episodes, seed=arguments.seed)
    folder = export(arguments.logdir, arguments.output, policy=policy, scores=scores)
    print(f"exported to {names.shown(folder)}" + (f", return {scores}" if scores else ""))
    print(f"evaluate with: python -m vawm.evaluate {names.flag('logdir', folder)}")
    return 0


if __name__ == "__main__":
    huge_pages.use_huge_pages()
    sys.exit(guard(main))
