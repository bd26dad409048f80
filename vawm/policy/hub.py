"""What a hub of models reads of a policy's folder, beside the weights.

README.md      the model card; its head says what the model is and how well it does
results.json   the scores, as numbers
replay.mp4     an episode, if its environment can be drawn
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from vawm.config import Config
from vawm.policy.play import Score
from vawm.policy.policy import Policy

RESULTS, REPLAY = "results.json", "replay.mp4"
TASK = "reinforcement-learning"


def plain_head() -> str:
    """The head of a model card, in YAML."""
    return "---\n" + _common(TASK, "world-model", "jax")


def head(policy: Policy, scores: Score | None) -> str:
    """The head of a model card that hubs index, in YAML: it has the score of an evaluation."""
    config, task = policy.config, policy.spec.task
    tags = dict.fromkeys((TASK, "world-model", "jax", config.agent, config.suite, task))
    text = f"---\npipeline_tag: {TASK}\n" + _common(*tags)
    if scores is None:
        return text
    mean, spread = spread_of(scores)
    return (
        text
        + f"""model-index:
- name: {quoted(name_of(config, task))}
  results:
  - task:
      type: {TASK}
      name: {TASK}
    dataset:
      name: {quoted(task)}
      type: {quoted(task)}
    metrics:
    - type: mean_reward
      value: "{mean:.2f} +/- {spread:.2f}"
      name: mean_reward
      verified: false
"""
    )


def _common(*tags: str) -> str:
    """What every model card says."""
    listed = ", ".join(map(quoted, tags))
    return f"license: apache-2.0\nlibrary_name: vawm\ntags: [{listed}]\n"


def quoted(text: str) -> str:
    """A text as YAML reads it, whatever is in it."""
    return json.dumps(text)


def name_of(config: Config, task: str) -> str:
    """A name for the model."""
    return f"{config.agent}-{task}"


def spread_of(scores: Score) -> tuple[float, float]:
    """Mean and standard deviation of the returns, as hubs show them."""
    return scores.mean, float(np.std(scores.returns))


def results(policy: Policy, scores: Score | None, protocol: str) -> bytes:
    """The content of `results.json`.

    `std_reward` is the standard deviation over episodes. Without an evaluation there is only
    the last return of training.
    """
    content: dict[str, Any] = {"env_id": policy.spec.task, "env_steps": policy.env_steps}
    if scores is not None:
        mean, spread = spread_of(scores)
        content |= {
            "mean_reward": mean,
            "std_reward": spread,
            "n_eval_episodes": len(scores.returns),
            "is_deterministic": False,
            "protocol": protocol,
        }
    if policy.last_return is not None:
        content["last_training_return"] = policy.last_return._asdict()
    return (json.dumps(content, indent=2) + "\n").encode()
