"""The objective of `scalar_agent` as loops over single states, in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import scalar_agent
from returns_twin import slow_lambda_returns, slow_replay_returns
from scalar_agent import CONFIG, PARAMS

from vawm.types import Batch, Trajectory

B, T, H = CONFIG.replay.batch_size, CONFIG.replay.batch_length, CONFIG.imagination.horizon


DISCOUNT, LAMBDA = 1 - 1 / CONFIG.imagination.discount_horizon, CONFIG.imagination.lambda_


REWARD, ACTOR, CRITIC = (float(w) for w in PARAMS)


SLOW = 0.3


BINS = np.asarray(scalar_agent.BINS, np.float64)


def batch():
    """T + 1 steps of two streams: one has an episode end at step 2, one is cut at step 1."""
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
    """The trajectory of the batch as numpy arrays."""
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
    """s_0 .. s_H, where s_0 is `state`."""
    states = [state]
    for _ in range(H):
        h, _ = states[-1]
        states.append((h + 1 - h / 2, 0.0))
    return states


def imagined_returns(states):
    """R_0 .. R_{H-1}, from the rewards that arrive with s_1 .. s_H."""
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
