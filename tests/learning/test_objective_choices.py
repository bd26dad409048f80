"""STORM's choices of behaviour learning, each alone and all together, against loops in float64.

The states, networks and helpers are those of `test_objective_twin`.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scalar_agent
from learners import learner
from objective_twin import (
    ACTOR,
    CRITIC,
    DISCOUNT,
    LAMBDA,
    REWARD,
    SLOW,
    B,
    H,
    T,
    batch,
    path,
    trajectory,
)
from scalar_agent import AGENT, PARAMS

from vawm.learning import objective
from vawm.losses import returns, transforms
from vawm.types import Batch, Trajectory

BASE = dataclasses.replace(
    scalar_agent.CONFIG,
    critic=dataclasses.replace(scalar_agent.CONFIG.critic, replay_scale=0.0),
)
CONTEXTS, LENGTH = 5, 3
CHOICES = {
    "contexts": ("imagination", "starts", "contexts"),
    "current": ("imagination", "value_index", "current"),
    "threshold": ("imagination", "continuation", "threshold"),
    "unweighted": ("imagination", "reach_weights", False),
    "slow_returns": ("critic", "slow_target", "returns"),
    "plain": ("world_model", "continue_target", "plain"),
}
SYMLOGS = np.linspace(-20, 20, 41)


def config_of(*names):
    config = BASE
    for name in names:
        part, field, value = CHOICES[name]
        changed = dataclasses.replace(getattr(config, part), **{field: value})
        config = dataclasses.replace(config, **{part: changed})
    return config


def contexts():
    rng = np.random.default_rng(3)
    shape, no = (CONTEXTS, LENGTH), np.zeros((CONTEXTS, LENGTH), bool)
    obs, action = rng.normal(size=(2, *shape, 1)).astype(np.float32)
    steps = Trajectory(obs, np.zeros(shape, np.float32), no, no, no, action)
    before = rng.normal(size=CONTEXTS)
    latent = scalar_agent.latent(jnp.asarray(before, jnp.float32), jnp.zeros(CONTEXTS))
    return steps, before, Batch(jax.tree.map(jnp.asarray, steps), latent)


def starts(names, h, z):
    """States that imagination begins at."""
    if "contexts" not in names:
        return [(h[b, t], z[b, t]) for b in range(B) for t in range(T)]
    steps, before, _ = contexts()
    h = before
    for t in range(1, LENGTH):
        h = h / 2 + steps.action[:, t - 1, 0] + steps.obs[:, t, 0]
    return [(x, 0.0) for x in h + steps.action[:, -1, 0]]


def log_probs(center):
    logits = -((np.arange(-20, 21) - center) ** 2)
    return logits - np.log(np.exp(logits).sum())


def mean(center, bins):
    return np.exp(log_probs(center)) @ bins


def cross_entropy(center, target, bins):
    above = np.searchsorted(bins, target)
    share = (target - bins[above - 1]) / (bins[above] - bins[above - 1])
    return -(1 - share) * log_probs(center)[above - 1] - share * log_probs(center)[above]


def slow_behaviour(names, h, z, scale):
    """Losses of actor and critic, and the return scale."""
    config, bins = config_of(*names), np.asarray(scalar_agent.BINS, np.float64)

    def discount(state):
        logit = 2 + state[0] - 40 * state[1]
        if "threshold" in names:  # more likely than not, once gamma is divided out
            gamma = 1.0 if "plain" in names else DISCOUNT
            return DISCOUNT * (1 / (1 + np.exp(-logit)) / gamma >= 0.5)
        cont = 1 / (1 + np.exp(-logit))
        return DISCOUNT * cont if "plain" in names else cont

    def returns_of(states, weight):
        values = [mean(weight * sum(s), bins) for s in states]
        following = values[-1]
        found = []
        for k in reversed(range(H)):
            reward = mean(REWARD * states[k + 1][0], bins)
            mixed = values[k] if "current" in names else values[k + 1]
            live = discount(states[k + 1])
            following = reward + live * ((1 - LAMBDA) * mixed + LAMBDA * following)
            found.append(following)
        return found[::-1]

    paths = [path(s) for s in starts(names, h, z)]
    targets = [returns_of(states, CRITIC) for states in paths]
    slow = [returns_of(states, SLOW) for states in paths]
    decay = config.imagination.return_scale_decay
    scale = decay * np.array(scale) + (1 - decay) * np.quantile(targets, [0.05, 0.95])
    actor, critic = [], []
    for states, target, second in zip(paths, targets, slow, strict=True):
        reach = 1.0
        for k, state in enumerate(states[:-1]):
            reach *= discount(state)
            weight = 1.0 if "unweighted" in names else reach
            value, action = mean(CRITIC * sum(state), bins), 1 - state[0] / 2
            advantage = (target[k] - value) / max(1.0, scale[1] - scale[0])
            log_prob, entropy = -((action - ACTOR * state[0]) ** 2), ACTOR * state[0] ** 2
            loss = -(advantage * log_prob + config.actor.entropy_scale * entropy)
            actor.append(weight * loss)
            own = mean(SLOW * sum(state), bins)
            other = second[k] if "slow_returns" in names else own
            loss = cross_entropy(CRITIC * sum(state), target[k], bins)
            loss += config.critic.slow_scale * cross_entropy(CRITIC * sum(state), other, bins)
            critic.append(weight * loss)
    return {
        "loss/actor": config.actor.scale * np.mean(actor),
        "loss/critic": config.critic.scale * np.mean(critic),
        "imagination/return_scale": max(1.0, scale[1] - scale[0]),
    }


@pytest.mark.parametrize("names", [*((name,) for name in CHOICES), tuple(CHOICES)])
def test_behaviour_equals_loops_over_imagined_paths(names):
    h = 2 * np.random.default_rng(1).normal(size=(B, T))
    z = trajectory().is_terminal[:, 1:].astype(float)
    loss = jax.jit(objective.make_behaviour_loss(AGENT, config_of(*names)))
    inference = scalar_agent.inference(jnp.asarray(h), jnp.asarray(z))
    scale = returns.ReturnScale(jnp.float32(-2.0), jnp.float32(4.0))
    given = contexts()[2] if "contexts" in names else ()
    start = learner(PARAMS, slow_critic=jnp.float32(SLOW), return_scale=scale)
    _, (_, metrics) = loss(PARAMS, start, batch(), inference, given, jax.random.key(0))
    expected = slow_behaviour(names, h, z, scale=(-2.0, 4.0))
    assert "loss/replay_critic" not in metrics
    for name, number in expected.items():
        np.testing.assert_allclose(metrics[name], number, rtol=2e-4, err_msg=name)
    if len(names) == 1:  # and the choice matters
        usual = slow_behaviour((), h, z, scale=(-2.0, 4.0))
        assert any(abs(usual[k] - expected[k]) > 1e-3 * abs(usual[k]) for k in expected)


def test_a_symlog_critic_learns_symlogs_and_decodes_their_mean():
    """Its targets are the symlogs of returns: a bump at 3 stands for symexp(3)."""
    config = config_of("slow_returns")
    code = transforms.make_two_hot(41, "symlog")
    agent = AGENT._replace(critic=AGENT.critic._replace(code=code))
    loss = jax.jit(objective.make_behaviour_loss(agent, config))
    h, z = np.random.default_rng(1).normal(size=(B, T)), np.zeros((B, T))
    inference = scalar_agent.inference(jnp.asarray(h), jnp.asarray(z))
    start = learner(PARAMS, slow_critic=jnp.float32(SLOW))
    _, (_, metrics) = loss(PARAMS, start, batch(), inference, (), jax.random.key(0))
    bins = np.asarray(scalar_agent.BINS, np.float64)

    def decoded(center):
        y = mean(center, SYMLOGS)
        return np.sign(y) * np.expm1(abs(y))

    def returns_of(states, weight):
        following, found = decoded(weight * sum(states[-1])), []
        for s in reversed(states[1:]):
            cont = 1 / (1 + np.exp(-(2 + s[0] - 40 * s[1])))
            mixed = (1 - LAMBDA) * decoded(weight * sum(s)) + LAMBDA * following
            following = mean(REWARD * s[0], bins) + cont * mixed
            found.append(following)
        return found[::-1]

    losses = []
    for start in starts((), h, z):
        states, reach = path(start), 1.0
        both = [returns_of(states, weight) for weight in (CRITIC, SLOW)]
        for k, state in enumerate(states[:-1]):
            reach *= 1 / (1 + np.exp(-(2 + state[0] - 40 * state[1])))
            scales = 1.0, config.critic.slow_scale
            for weight, target in zip(scales, both, strict=True):
                y = np.sign(target[k]) * np.log1p(abs(target[k]))
                losses.append(reach * weight * cross_entropy(CRITIC * sum(state), y, SYMLOGS))
    expected = config.critic.scale * 2 * np.mean(losses)
    np.testing.assert_allclose(metrics["loss/critic"], expected, rtol=2e-4)
