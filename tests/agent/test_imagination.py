"""Rollouts in a world model that counts, where every number can be written down."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import tiny

from vawm.agent import make_agent
from vawm.agent.imagination import imagine
from vawm.nets.distributions import ActionDistribution
from vawm.types import Latent
from vawm.world_model.protocol import WorldModel


def counting_model():
    """h' = h + a, z unchanged."""

    def step(params, model_state, key, carry, action):
        del model_state, key
        latent = Latent(carry.deter + params * action, carry.stoch)
        return latent, latent

    return WorldModel(*[None] * 7, imagine=step, predict=None)


def doubling_policy(latent):
    """a = 2 h, deterministic."""
    return ActionDistribution(
        sample=lambda key: 2 * latent.deter, log_prob=None, entropy=None, mode=None
    )


def test_each_latent_follows_from_the_action_before_it():
    start = Latent(jnp.array([[1.0], [10.0]]), jnp.ones((2, 1, 1)))
    imagined = imagine(
        counting_model(), doubling_policy, 1.0, (), jax.random.key(0), start, start, horizon=3
    )
    np.testing.assert_array_equal(
        imagined.latent.deter[..., 0].T, [[1, 3, 9, 27], [10, 30, 90, 270]]
    )
    np.testing.assert_array_equal(imagined.action, 2 * imagined.latent.deter[:-1])


def test_no_gradient_leaves_imagination():
    def total(params, deter):
        start = Latent(deter, jnp.ones((2, 1, 1)))
        key = jax.random.key(0)
        imagined = imagine(
            counting_model(), doubling_policy, params, (), key, start, start, horizon=3
        )
        return imagined.latent.deter.sum() + imagined.action.sum()

    gradients = jax.grad(total, argnums=(0, 1))(1.0, jnp.ones((2, 1)))
    assert all((g == 0).all() for g in jax.tree.leaves(gradients))


def test_steps_and_states_draw_different_noise():
    agent = make_agent(tiny.CONFIG, tiny.env().spec)

    @jax.jit
    def roll(key):
        params, model_state = agent.init(jax.random.key(0))
        start = agent.world_model.initial(2)
        carry = jnp.zeros((4, 2, 8)), start
        policy = functools.partial(agent.actor.policy, params.actor)
        return imagine(
            agent.world_model,
            policy,
            params.world_model,
            model_state,
            key,
            carry,
            start,
            horizon=3,
        )

    imagined = roll(jax.random.key(1))
    chex.assert_shape(imagined.latent.deter, (4, 2, 32))
    actions = np.asarray(imagined.action).ravel()
    assert len(np.unique(actions)) == len(actions)
    np.testing.assert_array_equal(imagined.latent.deter[0], 0.0)
    jax.tree.map(np.testing.assert_array_equal, imagined, roll(jax.random.key(1)))
