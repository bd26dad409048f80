"""A trained policy as a folder to share: weights, configuration, model card.

    python -m vawm.export --logdir runs/... --output cartpole --episodes 10

Five lines load it and act, wherever vawm is installed; no run and no checkpoint is needed:

    import jax, vawm
    policy = vawm.load("cartpole")
    env = vawm.envs.make(policy.spec.task, num_envs=1, action_repeat=policy.spec.action_repeat)
    _, timestep = env.reset(jax.random.key(0))
    carry, action = policy.act(jax.random.key(1), policy.initial(1), timestep)

`python -m vawm.evaluate --logdir cartpole` evaluates it. The files are those of
`vawm.policy.weights`.
"""

from __future__ import annotations

import dataclasses
import os
import pathlib
import sys
from collections.abc import Sequence

from vawm import evaluate
from vawm.agent import parameter_count
from vawm.cli import flags
from vawm.cli.command_line import guard
from vawm.config import Config
from vawm.errors import InvalidInput
from vawm.policy import Policy, weights
from vawm.policy import policy as policy_lib
from vawm.policy.play import Score
from vawm.process import cache, huge_pages
from vawm.runs import suites
from vawm.runs.checkpoint import manifest as manifest_lib
from vawm.runs.reports import tracking

LOAD = """\
import jax, vawm

policy = vawm.load("FOLDER")  # this one
"""
USAGE = f"""{LOAD}\
env = vawm.envs.make(policy.spec.task, num_envs=1, action_repeat=policy.spec.action_repeat)
_, timestep = env.reset(jax.random.key(0))
carry, action = policy.act(jax.random.key(1), policy.initial(1), timestep)"""
HOST_USAGE = f"""{LOAD}\
with vawm.runs.suites.make(policy.config) as env:  # as in training, in processes of its own
    carry, timestep = policy.initial(env.spec.num_envs), env.reset(0)
    carry, action = policy.act(jax.random.key(1), carry, timestep)"""
OWN_USAGE = f"""{LOAD}\
carry, action = policy.act(jax.random.key(1), policy.initial(1), timestep)  # of your own"""
"""How to act once, for the model card: on MJX, on the host, in an environment of one's own."""


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
      folder: not there yet, or empty.
      policy: which `logdir` was loaded before, such as the one that `scores` are of: a run
        that goes on has a newer checkpoint by then.
      scores: of an evaluation; without them the model card has the last return of training.
      protocol: how they were obtained; that of the suite, with sampled actions, if not given.

    Returns:
      The folder.

    Raises:
      InvalidInput: no checkpoint, or a folder that is not empty; nothing was written.
      SaveError: the disk is full; nothing is left behind.
    """
    logdir, folder = pathlib.Path(logdir).expanduser(), pathlib.Path(folder).expanduser()
    weights.check_output(folder)
    policy = policy or policy_lib.load(logdir)
    measured = _last_return(logdir, policy.env_steps)
    if scores is not None:
        protocol = protocol or f"{suites.of(policy.config).protocol.text}; actions sampled"
        measured = f"Evaluation: return {scores} ({protocol}), mean +- standard error."
    weights.write(
        folder,
        policy.params,
        policy.state,
        config=policy.config,
        spec=policy.spec,
        env_steps=policy.env_steps,
        card=card(policy, measured),
    )
    return folder


def _last_return(logdir: pathlib.Path, env_steps: int) -> str:
    """What training measured last, and that it is no evaluation."""
    path = logdir / tracking.METRICS
    lines = [
        entry
        for entry in tracking.read(path)
        if entry["env_steps"] <= env_steps and entry.get("episode/return") is not None
    ]
    if not lines:
        return "Not evaluated, and no episode of training has a recorded return."
    last = lines[-1]
    return (
        f"Not evaluated. Last return of training: {last['episode/return']:.1f}, the mean over "
        f"{last['episode/count']} episodes that ended shortly before {last['env_steps']} env "
        "steps, with the rewards and the exploration of training."
    )


def card(policy: Policy, measured: str) -> str:
    """The text of `README.md`; `measured` says what the policy scores and how that is known."""
    config, spec = policy.config, policy.spec
    rows = {
        "task": f"{spec.task} ({config.suite})",
        "agent": config.agent,
        "size": f"{config.size}, {parameter_count(policy.params):,} parameters",
        "preset": config.preset,
        "env steps": f"{policy.env_steps:,} of {config.env_steps:,}, "
        f"action repeat {spec.action_repeat}",
        "seed": config.seed,
        "value alignment": _alignment(config, policy.env_steps),
        "written by": f"vawm {manifest_lib.version()}",
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

Evaluate it with `python -m vawm.evaluate --logdir FOLDER`. All choices of the training are in
`{weights.CONFIG}`.

## Licence

Apache-2.0, as vawm itself.
"""


def _usage(policy: Policy) -> str:
    """The lines that load the policy and act once."""
    config = policy.config
    try:  # not the task of the config, which says nothing of an environment of one's own
        suites.check_task(dataclasses.replace(config, task=policy.spec.task))
    except InvalidInput:
        return OWN_USAGE
    return USAGE if suites.host_choices(config) is None else HOST_USAGE


def _alignment(config: Config, env_steps: int) -> str:
    """Whether L_var was part of what was learned."""
    alignment = config.value_alignment
    if alignment.weight == "off":
        return "off"
    warmup, unit = alignment.warmup_steps, alignment.warmup_unit.replace("_", " ")
    if alignment.warmup_unit == "env_steps" and env_steps <= warmup:
        return f"not active yet: the warm-up of {warmup:,} env steps was not over"
    weight = {
        "adaptive": "weight 1 / max(1, KL)",
        "static": f"weight {alignment.static_weight:g}",
    }[alignment.weight]
    return f"{weight} after a warm-up of {warmup:,} {unit}"


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Write the policy of a run's newest checkpoint to a folder of its own."""

    logdir: pathlib.Path
    """folder of the run"""
    output: pathlib.Path
    """folder to write; not there yet, or empty"""
    episodes: int = 0
    """play so many by the protocol of the suite, for the model card; 0 for none"""
    seed: int = 0
    """of these episodes"""


def main(argv: Sequence[str] | None = None) -> int:
    """Prints where the policy is; returns the exit code."""
    arguments = flags.read(Arguments, argv, description=__doc__)
    weights.check_output(arguments.output.expanduser())
    evaluate.check(arguments.episodes or 1, arguments.seed)
    policy, scores = policy_lib.load(arguments.logdir), None
    if arguments.episodes:
        cache.enable()
        scores = evaluate.by_protocol(policy, episodes=arguments.episodes, seed=arguments.seed)
    folder = export(arguments.logdir, arguments.output, policy=policy, scores=scores)
    print(f"exported to {folder}" + (f", return {scores}" if scores else ""))
    print(f"evaluate with: python -m vawm.evaluate --logdir {folder}")
    return 0


if __name__ == "__main__":
    huge_pages.use_huge_pages()
    sys.exit(guard(main))
