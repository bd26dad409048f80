"""Value errors by depth of imagination: how far imagined states mislead the critic.

From every inferred state s_t of a recorded episode, the world model imagines k = 0..K steps
along the recorded actions, with its prior. Predictions from s~_{t+k} are compared with
those from the inferred s_{t+k}, and with the recorded rewards:

    value        |V(s~_{t+k}) - V(s_{t+k})|
    return       |V(s~_{t+k}) - G_{t+k}|,  G_t = sum_{i >= 1} gamma^{i-1} r_{t+i}
    bootstrapped the same, with gamma^{T-t} V(s_T) added to G_t if s_T is not terminal
    reward       |R(s~_{t+k}) - r_{t+k}|, R the mean of the reward head
    value_kl     KL[V(s_{t+k}) || V(s~_{t+k})] in nats, of the critic's distributions
    latent_kl    KL[q(z_{t+k} | h_{t+k}, o_{t+k}) || p(z | h~_{t+k})] in nats, summed over the
                 categoricals, with unimix
    distance     half of |z~ - z|^2, mean over the categoricals: for one-hot z, the share of
                 categoricals that differ

At depth 0 the imagined state is the inferred one. Only depths inside the same episode count;
for the returns, only states with an action (all but the last step T). V is the online critic's
mean, in units of the reward. If a time limit truncates an episode, "return" leaves the missing
rewards out of G; "bootstrapped" replaces them by the critic's estimate.

A critic whose values hardly differ has small errors whatever its world model does. So the
first three errors are also given relative to the values of the run:

    relative_value, relative_return, relative_bootstrapped    the error / spread
    spread    standard deviation (of the population) of V(s_t) over the inferred states s_t with
              an action, pooled over all episodes

If the spread is 0 they are NaN. Standard errors treat the spread as exact.

Source: our reading of Figs 3 and 7, which show imagined trajectories as pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vawm.agent import Agent, make_agent
from vawm.analysis.episodes import Episodes, select
from vawm.analysis.inference import check, make_infer, make_prior
from vawm.config import Config
from vawm.learning.discount import discount_of
from vawm.losses import transforms
from vawm.policy import Policy
from vawm.types import Array, Key, Latent, Params, PyTree


class Rollouts(NamedTuple):
    """Results of imagination, `[N, K + 1]`: entry (i, k) is k steps after the i-th state."""

    value: Any  # a jax or numpy array, like the others
    reward: Any
    value_kl: Any
    latent_kl: Any  # NaN if the world model's protocol does not provide logits
    distance: Any


def make_rollouts(
    agent: Agent, config: Config, *, context: int, depth: int
) -> Callable[[Params, PyTree, Key, Episodes], Rollouts]:
    """Builds `rollouts(params, model_state, key, episode) -> Rollouts`; `episode` has E = 1.

    The N states are the last N steps of the record. Depths beyond its end repeat its last step
    and are meaningless. No gradient is stopped.
    """
    world_model, critic = agent.world_model, agent.critic
    infer = make_infer(agent, context=context, horizon=depth)
    prior = make_prior(agent)
    model = config.world_model
    reward_code = transforms.make_two_hot(model.bins, model.bin_spacing)

    def latent_kl(post_logits: PyTree, prior_logits: Array) -> Array:
        pair = post_logits, prior_logits
        mixed = [transforms.unimix_logits(logits, model.unimix) for logits in pair]
        return transforms.categorical_kl(*mixed).sum(-1)

    def rollouts(params: Params, model_state: PyTree, key: Key, episode: Episodes) -> Rollouts:
        key_infer, key_prior, key_imagine = jax.random.split(key, 3)
        inferred = infer(params, model_state, key_infer, episode)
        count = inferred.latent.deter.shape[0]
        action = episode.trajectory.action[0, -count:]
        value_logits = critic.logits(params.critic, inferred.latent)

        def later(x: PyTree, k: Array | int) -> PyTree:
            at = jnp.minimum(jnp.arange(count) + k, count - 1)
            return jax.tree.map(lambda leaf: leaf[at], x)

        def prior_logits(key: Key, latent: Latent, action: Array) -> Array | None:
            if prior is None or inferred.post_logits is None:
                return None
            return prior(params, model_state, key, latent, action)

        def look(latent: Latent, logits: Array | None, k: Array | int) -> Rollouts:
            here = critic.logits(params.critic, latent)
            reward = world_model.predict(params.world_model, model_state, latent).reward
            gap = jnp.square(latent.stoch - later(inferred.latent.stoch, k))
            value = critic.code.mean(here)
            latents = jnp.full_like(value, jnp.nan)
            if logits is not None:
                latents = latent_kl(later(inferred.post_logits, k), logits)
            return Rollouts(
                value=value,
                reward=reward_code.mean(reward),
                value_kl=transforms.categorical_kl(later(value_logits, k), here),
                latent_kl=latents,
                distance=gap.sum(-1).mean(-1) / 2,
            )

        def deeper(reached: PyTree, inputs: PyTree):
            carry, latent, logits = reached
            k, key_prior, key_imagine = inputs
            seen = look(latent, logits, k)
            leaves = later(action, k)
            logits = prior_logits(key_prior, latent, leaves)
            carry, latent = world_model.imagine(
                params.world_model, model_state, key_imagine, carry, leaves
            )
            return (carry, latent, logits), seen

        key_prior, key_first = jax.random.split(key_prior)
        first: PyTree = (*inferred.ahead, prior_logits(key_first, inferred.latent, action))
        keys = [jax.random.split(k, depth) for k in (key_prior, key_imagine)]
        inputs: PyTree = (jnp.arange(1, depth + 1), *keys)
        _, imagined = jax.lax.scan(deeper, first, inputs)
        root = look(inferred.latent, inferred.post_logits, 0)
        return jax.tree.map(
            lambda a, b: jnp.concatenate([a[:, None], b.swapaxes(0, 1)], axis=1), root, imagined
        )

    return rollouts


RELATIVE = {f"relative_{name}": name for name in ("value", "return", "bootstrapped")}
"""Relative measure -> the measure that is divided by the spread of the run's values."""
MEASURES = (
    "value",
    "return",
    "bootstrapped",
    "reward",
    "value_kl",
    "latent_kl",
    "distance",
    *RELATIVE,
)


class ErrorByDepth(NamedTuple):
    """Errors of E units at depths 0..K; units are the episodes of a run or the runs of a group.

    Attributes:
      states: measure -> `[E, K + 1]` number of states that reach this depth in an episode.
      errors: measure -> `[E, K + 1]`, mean of the unit; NaN if it has none.
      units: the units that E counts and that standard errors are over.
    """

    states: dict[str, np.ndarray]
    errors: dict[str, np.ndarray]
    units: Literal["episodes", "runs"] = "episodes"

    def mean(self, measure: str) -> np.ndarray:
        """`[K + 1]` mean over the units with an error at this depth; NaN if there is none."""
        return mean_and_error(self.errors[measure])[0]

    def standard_error(self, measure: str) -> np.ndarray:
        """`[K + 1]` standard error of `mean`; NaN for fewer than two units."""
        return mean_and_error(self.errors[measure])[1]

    def number(self, measure: str) -> np.ndarray:
        """`[K + 1]` number of units that `mean` is over."""
        return (~np.isnan(self.errors[measure])).sum(0)


class Report(NamedTuple):
    """The value errors of one run.

    Attributes:
      by_depth: the errors.
      first: the step of an episode of the first inferred state.
      value: `[E, N]` V of the inferred states s_first, s_{first + 1}, ...
      imagined: `[E, N, K + 1]` values along imagined rollouts.
      returns: `[E, N]` G of these states.
      bootstrapped: `[E, N]` the same, plus the critic's value of the last state.
      counts: `[E, N]` bool, whether the state has an action.
      spread: standard deviation of V over the states with an action.
    """

    by_depth: ErrorByDepth
    first: int
    value: np.ndarray
    imagined: np.ndarray
    returns: np.ndarray
    bootstrapped: np.ndarray
    counts: np.ndarray
    spread: float


class Group(NamedTuple):
    """The value errors of runs that differ only in their seed.

    Attributes:
      by_depth: a row per run, its mean over its episodes.
      spread: mean over the runs.
    """

    by_depth: ErrorByDepth
    spread: float


def report(
    policy: Policy, episodes: Episodes, *, context: int, depth: int, seed: int
) -> Report:
    """Imagines along every episode and compares; one compiled function for all of them.

    Raises:
      InvalidInput: an impossible depth or context, see `inference.check`.
    """
    check(policy.config, context=context, depth=depth)
    agent = make_agent(policy.config, policy.spec)
    rollouts = jax.jit(make_rollouts(agent, policy.config, context=context, depth=depth))
    keys = jax.random.split(jax.random.key(seed), len(episodes.length))
    rolled = [
        jax.device_get(rollouts(policy.params, policy.model_state, key, select(episodes, i)))
        for i, key in enumerate(keys)
    ]
    return compare(
        jax.tree.map(lambda *x: np.stack(x).astype(np.float64), *rolled),
        jax.device_get(episodes),
        discount=discount_of(policy.config),
    )


def compare(rollouts: Rollouts, episodes: Episodes, *, discount: float) -> Report:
    """Computes the errors of rollouts `[E, N, K + 1]` of the last N steps of a record.

    Plain numpy in float64; the module's docstring has the equations.
    """
    steps, length = episodes.trajectory, np.asarray(episodes.length)
    _, count, depths = rollouts.value.shape
    first = steps.reward.shape[1] - count
    time, depth = np.arange(first, first + count)[:, None], np.arange(depths)
    reached = time + depth < length[:, None, None]  # [E, N, K + 1]
    left = time + depth < length[:, None, None] - 1
    at = np.minimum(np.arange(count)[:, None] + depth, count - 1)

    rows, last = np.arange(len(length)), length - 1
    final = rollouts.value[rows, np.maximum(last - first, 0), 0]
    tail = np.where(np.asarray(steps.is_terminal)[rows, last], 0.0, final)
    truth = {
        name: discounted_returns(steps.reward, length, end, discount=discount)[:, first:]
        for name, end in [("return", np.zeros_like(tail)), ("bootstrapped", tail)]
    }
    value, reward = rollouts.value[..., 0], np.asarray(steps.reward, np.float64)[:, first:]
    errors = {
        "value": np.abs(rollouts.value - value[:, at]),
        "return": np.abs(rollouts.value - truth["return"][:, at]),
        "bootstrapped": np.abs(rollouts.value - truth["bootstrapped"][:, at]),
        "reward": np.abs(rollouts.reward - reward[:, at]),
        "value_kl": rollouts.value_kl,
        "latent_kl": rollouts.latent_kl,
        "distance": rollouts.distance,
    }
    spread = spread_of(value[left[..., 0]])
    errors |= {name: relative(errors[of], spread) for name, of in RELATIVE.items()}
    masks = {name: left if RELATIVE.get(name, name) in truth else reached for name in errors}
    return Report(
        by_depth=ErrorByDepth(
            states={name: mask.sum(1) for name, mask in masks.items()},
            errors={name: mean_over(error, masks[name]) for name, error in errors.items()},
        ),
        first=first,
        value=value,
        imagined=rollouts.value,
        returns=truth["return"],
        bootstrapped=truth["bootstrapped"],
        counts=left[..., 0],
        spread=spread,
    )


def spread_of(values: np.ndarray) -> float:
    """Standard deviation; 0 if the values differ by no more than float32 rounding."""
    values = np.asarray(values, np.float64)
    if not values.size:
        return 0.0
    resolution = np.finfo(np.float32).eps * np.abs(values).max()
    return float(values.std()) if np.ptp(values) > resolution else 0.0


def relative(errors: np.ndarray, spread: float) -> np.ndarray:
    """Errors in units of the spread; NaN if the spread is 0."""
    return errors / spread if spread else np.full_like(errors, np.nan)


def pooled(
    reports: Mapping[str, Report], groups: Mapping[str, Sequence[str]]
) -> dict[str, Report | Group]:
    """One entry per group: a `Group` for several runs, the `Report` for a single one.

    A run whose relative errors are NaN is left out of those of its group, and not counted.

    Args:
      reports: by name of the run.
      groups: name of the group -> names of its runs.

    Returns:
      Reports of single runs under the run's name; groups under their name and number of runs.
    """
    entries: dict[str, Report | Group] = {}
    for group, names in groups.items():
        if len(names) == 1:
            entries |= {names[0]: reports[names[0]]}
        else:
            members = [reports[name] for name in names]
            entries[f"{group} ({len(names)} runs)"] = pool(members)
    return entries


def pool(reports: Sequence[Report]) -> Group:
    """Pools runs: they are the units of one error by depth."""
    of_runs = [run.by_depth for run in reports]
    return Group(
        ErrorByDepth(
            states={m: np.stack([run.states[m].sum(0) for run in of_runs]) for m in MEASURES},
            errors={m: np.stack([run.mean(m) for run in of_runs]) for m in MEASURES},
            units="runs",
        ),
        spread=float(np.mean([run.spread for run in reports])),
    )


def discounted_returns(
    reward: Any, length: np.ndarray, tail: np.ndarray, *, discount: float
) -> np.ndarray:
    """G_t = r_{t+1} + gamma G_{t+1} up to the last step T, where G_T = `tail`; float64.

    Args:
      reward: `[E, T]` by arrival: r_t arrives with o_t.
      length: `[E]` steps of each episode; G is 0 beyond.
      tail: `[E]` the return of the last step, G_T.
      discount: gamma.
    """
    reward = np.asarray(reward, np.float64)
    returns = np.zeros_like(reward)
    for row, (steps, end) in enumerate(zip(length, tail, strict=True)):
        returns[row, steps - 1] = end
        for t in range(steps - 2, -1, -1):
            returns[row, t] = reward[row, t + 1] + discount * returns[row, t + 1]
    return returns


def mean_over(error: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """`[E, N, K]` -> `[E, K]` mean over the entries in the mask; NaN if there are none."""
    total, count = np.where(mask, error, 0.0).sum(1), mask.sum(1)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)


def mean_and_error(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean over rows `[E, ...]` that are not NaN, and its standard error, both `[...]`."""
    there = ~np.isnan(values)
    count = there.sum(0)
    mean = np.where(there, values, 0.0).sum(0) / np.where(count, count, np.nan)
    squares = np.where(there, np.square(values - mean), 0.0).sum(0)
    variance = squares / np.where(count > 1, count - 1, np.nan)
    return mean, np.sqrt(variance / np.where(count, count, np.nan))


def rows(name: str, entry: Report | Group) -> list[dict[str, Any]]:
    """Rows for a CSV, one per depth and measure.

    The mean and its standard error are `over` episodes or runs, `count` of them.
    """
    result = []
    by_depth = entry.by_depth
    for measure in MEASURES:
        mean, error = mean_and_error(by_depth.errors[measure])
        count, states = by_depth.number(measure), by_depth.states[measure].sum(0)
        for k in range(len(mean)):
            result.append(
                {
                    "run": name,
                    "measure": measure,
                    "depth": k,
                    "mean": float(mean[k]),
                    "standard_error": float(error[k]),
                    "over": by_depth.units,
                    "count": int(count[k]),
                    "states": int(states[k]),
                    "spread": entry.spread,
                }
            )
    return result


SHOWN = ("value", "return", "relative_value", "relative_return")


def table(entries: Mapping[str, Report | Group], *, measures: tuple[str, ...] = SHOWN) -> str:
    """A few depths of a few measures as text: mean +- standard error."""
    wide = max(map(len, entries))
    lines = []
    for measure in measures:
        lines.append(f"{measure.replace('_', ' ')} error by depth")
        for name, entry in entries.items():
            mean, error = mean_and_error(entry.by_depth.errors[measure])
            deepest = len(mean) - 1
            shown = sorted({0, 1, deepest // 4, deepest // 2, deepest})
            cells = [f"{k}: {mean[k]:.3g} +- {error[k]:.2g}" for k in shown]
            lines.append(f"  {name:{wide}}   " + "   ".join(cells))
    lines.append("spread of V (relative errors = errors / spread)")
    lines += [f"  {name:{wide}}   {entry.spread:.3g}" for name, entry in entries.items()]
    return "\n".join(lines)
