"""Which index meets which: the objective against loops over single states in float64."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scalar_agent
from scalar_agent import AGENT, CONFIG, PARAMS
from test_returns import slow_lambda_returns, slow_replay_returns

from vawm import objective, returns
from vawm.config import ValueAlignmentConfig
from vawm.learner import init_learner, make_update
from vawm.types import Batch, Trajectory

B, T, H = CONFIG.replay.batch_size, CONFIG.replay.batch_length, CONFIG.imagination.horizon
DISCOUNT, LAMBDA = 1 - 1 / CONFIG.imagination.discount_horizon, CONFIG.imagination.lambda_
REWARD, ACTOR, CRITIC = (float(w) for w in PARAMS)
SLOW = 0.3
BINS = np.asarray(scalar_agent.BINS, np.float64)


def batch():
    """T + 1 steps of two streams: in one an episode ends at step 2, in one it is cut at 1."""
    rng, shape = np.random.default_rng(0), (B, T + 1)
    is_first, is_last, is_terminal = np.zeros((3, *shape), bool)
    is_last[0, 2] = is_terminal[0, 2] = is_first[0, 3] = True
    is_last[1, 1] = is_first[1, 2] = True
    trajectory = Trajectory(
        obs=rng.normal(size=(*shape, 1)),
        reward=rng.normal(size=shape),
        is_first=is_first,
        is_last=is_last,
        is_terminal=is_terminal,
        action=rng.normal(size=(*shape, 1)),
    )
    context = scalar_agent.latent(jnp.array([0.8, -1.2]), jnp.zeros(B))
    return Batch(jax.tree.map(jnp.asarray, trajectory), context)


def trajectory():
    """That of the batch, for loops."""
    return jax.tree.map(np.asarray, batch().trajectory)


def log_probs(center):
    logits = -((np.arange(-20, 21) - center) ** 2)
    return logits - np.log(np.exp(logits).sum())


def mean(center):
    return np.exp(log_probs(center)) @ BINS


def cross_entropy(center, target):
    above = np.searchsorted(BINS, target)
    share = (target - BINS[above - 1]) / (BINS[above] - BINS[above - 1])
    return -(1 - share) * log_probs(center)[above - 1] - share * log_probs(center)[above]


# Behaviour. A state is a pair (h, z).


def value(state):
    return mean(CRITIC * sum(state))


def cont(state):
    h, z = state
    return 1 / (1 + np.exp(-(2 + h - 40 * z)))


def critic_loss(state, target):
    to_slow = cross_entropy(CRITIC * sum(state), mean(SLOW * sum(state)))
    return cross_entropy(CRITIC * sum(state), target) + CONFIG.critic.slow_scale * to_slow


def actor_loss(state, advantage):
    h, _ = state
    action = 1 - h / 2
    log_prob, entropy = -((action - ACTOR * h) ** 2), ACTOR * h**2
    return -(advantage * log_prob + CONFIG.actor.entropy_scale * entropy)


def path(state):
    """s_0 .. s_H, of which s_0 is `state`."""
    states = [state]
    for _ in range(H):
        h, _ = states[-1]
        states.append((h + 1 - h / 2, 0.0))
    return states


def imagined_returns(states):
    """R_0 .. R_{H-1}: what arrives with s_1 .. s_H."""
    arriving = states[1:]
    reward = [mean(REWARD * h) for h, _ in arriving]
    return slow_lambda_returns(
        reward, [cont(s) for s in arriving], [value(s) for s in arriving], LAMBDA
    )


def slow_behaviour(h, z, scale):
    """The three losses and the new return scale for inferred states `[B, T]`."""
    paths = [path((h[b, t], z[b, t])) for b in range(B) for t in range(T)]
    targets = np.array([imagined_returns(states) for states in paths])
    decay = CONFIG.imagination.return_scale_decay
    scale = decay * np.array(scale) + (1 - decay) * np.quantile(targets, [0.05, 0.95])
    actor, critic, replayed = [], [], []
    for states, target in zip(paths, targets, strict=True):
        weight = 1.0
        for k in range(H):
            weight *= cont(states[k])
            advantage = (target[k] - value(states[k])) / max(1.0, scale[1] - scale[0])
            actor.append(weight * actor_loss(states[k], advantage))
            critic.append(weight * critic_loss(states[k], target[k]))
    data = trajectory()
    target = slow_replay_returns(
        *(x[:, 1:] for x in (data.reward, data.is_last, data.is_terminal)),
        targets[:, 0].reshape(B, T),
        DISCOUNT,
        LAMBDA,
    )
    for b in range(B):
        for t in range(T - 1):
            last = data.is_last[b, t + 1]  # the first step of the batch is context
            replayed.append(0.0 if last else critic_loss((h[b, t], z[b, t]), target[b, t]))
    return scale, {
        "loss/actor": CONFIG.actor.scale * np.mean(actor),
        "loss/critic": CONFIG.critic.scale * np.mean(critic),
        "loss/replay_critic": CONFIG.critic.replay_scale * np.mean(replayed),
        "imagination/return_scale": scale[1] - scale[0],
    }


behaviour_loss = jax.jit(objective.make_behaviour_loss(AGENT, CONFIG))


def behaviour(h, z, scale=(-2.0, 4.0)):
    inference = scalar_agent.inference(jnp.asarray(h), jnp.asarray(z))
    scale = returns.ReturnScale(*map(jnp.float32, scale))
    _, (scale, metrics) = behaviour_loss(
        PARAMS, (), jnp.float32(SLOW), scale, batch(), inference, (), jax.random.key(0)
    )
    return scale, metrics


def test_actor_critic_and_return_scale_equal_loops_over_imagined_paths():
    h = 2 * np.random.default_rng(1).normal(size=(B, T))
    z = trajectory().is_terminal[:, 1:].astype(float)
    scale, metrics = behaviour(h, z)
    expected_scale, expected = slow_behaviour(h, z, scale=(-2.0, 4.0))
    np.testing.assert_allclose(scale, expected_scale, rtol=1e-4)
    assert expected["imagination/return_scale"] > 2.0  # the limit of 1 is not what is seen
    for name, number in expected.items():
        np.testing.assert_allclose(metrics[name], number, rtol=1e-4, err_msg=name)


def test_paths_from_a_state_that_nothing_follows_weigh_nothing():
    h = np.random.default_rng(1).normal(size=(B, T))
    _, metrics = behaviour(h, z=np.ones((B, T)))
    assert abs(metrics["loss/actor"]) < 1e-12
    assert abs(metrics["loss/critic"]) < 1e-12
    assert metrics["loss/replay_critic"] > 0


# The world model.


@functools.cache
def compiled_model_loss(critic="online"):
    alignment = ValueAlignmentConfig(weight="static", warmup_steps=0, critic=critic)
    config = dataclasses.replace(CONFIG, value_alignment=alignment)
    return jax.jit(objective.make_world_model_loss(AGENT, config))


def model_loss(critic="online", params=PARAMS):
    _, (inference, _, metrics) = compiled_model_loss(critic)(
        params, (), jnp.float32(SLOW), batch(), jax.random.key(0), jnp.asarray(1)
    )
    return inference, metrics


def test_each_state_is_inferred_from_the_action_before_it_and_scored_on_what_arrived_with_it():
    data, context = trajectory(), batch().context
    h = np.zeros((B, T + 1))
    h[:, 0] = context.deter[:, 0]
    parts = []
    for b in range(B):
        for t in range(1, T + 1):
            obs = data.obs[b, t, 0]
            carried = h[b, t - 1] / 2 + data.action[b, t - 1, 0]
            h[b, t] = (0.0 if data.is_first[b, t] else carried) + obs
            logit, target = 2 + h[b, t], DISCOUNT * (not data.is_terminal[b, t])
            parts.append(
                (
                    (h[b, t] - np.sign(obs) * np.log1p(abs(obs))) ** 2,
                    cross_entropy(REWARD * h[b, t], data.reward[b, t]),
                    np.log1p(np.exp(logit)) - target * logit,
                )
            )
    inference, metrics = model_loss()
    np.testing.assert_allclose(inference.latent.deter[..., 0], h[:, 1:], rtol=1e-5)
    parts = np.mean(parts, axis=0) * [CONFIG.world_model.reconstruction_scale, 1, 1]
    for name, part in zip(("reconstruction", "reward", "continue"), parts, strict=True):
        np.testing.assert_allclose(metrics[f"loss/{name}"], part, rtol=1e-5, err_msg=name)


# Value alignment.


def test_with_critic_slow_alignment_is_that_of_the_slow_parameters():
    params_of_slow = PARAMS._replace(critic=jnp.float32(SLOW))
    slow, same, online = (
        metrics["value_alignment/loss"]
        for _, metrics in (model_loss("slow"), model_loss(params=params_of_slow), model_loss())
    )
    np.testing.assert_allclose(slow, same, rtol=1e-6)
    assert abs(slow - online) > 0.01


@functools.cache
def compiled_update():
    alignment = ValueAlignmentConfig(warmup_steps=24, warmup_unit="updates")
    config = dataclasses.replace(CONFIG, value_alignment=alignment)
    return jax.jit(make_update(AGENT, config))


@pytest.mark.parametrize(("updates", "env_steps", "opens"), [(24, 10**6, False), (25, 0, True)])
def test_counted_in_updates_the_warmup_ignores_env_steps(updates, env_steps, opens):
    learner = init_learner(AGENT, CONFIG, jax.random.key(0))
    learner = learner._replace(step=jnp.asarray(updates))
    _, _, metrics = compiled_update()(
        learner, batch(), (), jax.random.key(0), jnp.asarray(env_steps)
    )
    assert (metrics["value_alignment/weight"] > 0) == opens
    assert (metrics["loss/value_alignment"] > 0) == opens
