"""Which index meets which: the objective against loops over single states in float64."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scalar_agent
from learners import learner
from objective_twin import (
    DISCOUNT,
    REWARD,
    SLOW,
    B,
    T,
    batch,
    cross_entropy,
    slow_behaviour,
    trajectory,
)
from scalar_agent import AGENT, CONFIG, PARAMS

from vawm.config import ValueAlignmentConfig
from vawm.learning import objective
from vawm.learning.state import init_learner
from vawm.learning.update import make_update
from vawm.losses import returns

# Behaviour. A state is a pair (h, z).


behaviour_loss = jax.jit(objective.make_behaviour_loss(AGENT, CONFIG))


def behaviour(h, z, scale=(-2.0, 4.0)):
    inference = scalar_agent.inference(jnp.asarray(h), jnp.asarray(z))
    scale = returns.ReturnScale(*map(jnp.float32, scale))
    start = learner(PARAMS, slow_critic=jnp.float32(SLOW), return_scale=scale)
    _, (scale, metrics) = behaviour_loss(
        PARAMS, start, batch(), inference, (), jax.random.key(0)
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
        params,
        learner(params, slow_critic=jnp.float32(SLOW)),
        batch(),
        jax.random.key(0),
        jnp.asarray(1),
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
    start = init_learner(AGENT, CONFIG, jax.random.key(0))
    start = start._replace(step=jnp.asarray(updates))
    _, _, metrics = compiled_update()(
        start, batch(), (), jax.random.key(0), jnp.asarray(env_steps)
    )
    assert (metrics["value_alignment/weight"] > 0) == opens
    assert (metrics["loss/value_alignment"] > 0) == opens
