"""An agent to compute by hand: every network is one number, every latent two.

    filtering    h_t = (0 if first else h_{t-1} / 2 + a_{t-1}) + o_t,   z_t = 0
    imagination  a = 1 - h / 2,   h' = h + a,   z' = 0
    heads        observation h; reward and value: a bump over the bins around w h and around
                 w (h + z), with w the parameter; logit of the continuation 2 + h - 40 z

A predicted latent has z~ = 1. In an inferred state, z = 1 means that the episode ends there.
Random keys are not used.
"""

import dataclasses

import jax
import jax.numpy as jnp
import tiny

from vawm.agent import Agent
from vawm.agent.actor_critic import Actor, Critic
from vawm.losses import transforms
from vawm.nets.distributions import ActionDistribution
from vawm.types import (
    EnvSpec,
    Explanation,
    Inference,
    Latent,
    Params,
    Predictions,
    Targets,
    vector,
)
from vawm.world_model.packing import pack
from vawm.world_model.protocol import WorldModel

CONFIG = dataclasses.replace(  # no scale is 1, so that a forgotten one is noticed
    tiny.CONFIG,
    world_model=dataclasses.replace(
        tiny.CONFIG.world_model, classes=2, reconstruction_scale=0.7
    ),
    actor=dataclasses.replace(tiny.CONFIG.actor, scale=0.8, entropy_scale=0.1),
    critic=dataclasses.replace(tiny.CONFIG.critic, scale=0.9, slow_scale=0.6),
    imagination=dataclasses.replace(
        tiny.CONFIG.imagination, discount_horizon=10.0, return_scale_decay=0.5
    ),
    replay=dataclasses.replace(tiny.CONFIG.replay, batch_length=4),
)
PARAMS = Params(world_model=jnp.float32(0.7), actor=jnp.float32(0.4), critic=jnp.float32(0.5))
BINS = transforms.symexp_bins(41)


def latent(h, z):
    """`[...]` numbers as a `Latent`; z is the second of two classes."""
    return Latent(h[..., None], jnp.stack([1 - z, z], axis=-1)[..., None, :])


def numbers(latent):
    """The inverse of `latent`."""
    return latent.deter[..., 0], latent.stoch[..., 0, 1]


def around(center):
    """`[...]` -> `[..., 41]` logits of the bump."""
    bins = jnp.arange(-20.0, 21.0)
    return jnp.vectorize(lambda x: -jnp.square(bins - x), signature="()->(n)")(center)


def inference(h, z):
    """The `Inference` of states h and z, `[B, T]`."""
    logits = jnp.stack([h, jnp.zeros_like(h)], axis=-1)[..., None, :]
    return Inference(
        latent=latent(h, z),
        prior_latent=latent(h, jnp.ones_like(z)),
        post_logits=logits,
        prior_logits=jnp.zeros_like(logits),
    )


def observe(batch):
    steps = jax.tree.map(lambda x: x[:, 1:], batch.trajectory)
    prev_action = batch.trajectory.action[:, :-1]
    h, states = batch.context.deter, []
    for t in range(steps.reward.shape[1]):
        carried = jnp.where(steps.is_first[:, t, None], 0.0, h / 2 + prev_action[:, t])
        h = carried + steps.obs[:, t]
        states.append(h[:, 0])
    h = jnp.stack(states, axis=1)
    return steps, inference(h, jnp.zeros_like(h))


def explain(params, model_state, key, batch):
    steps, inferred = observe(batch)
    targets = Targets(steps.obs, steps.reward, steps.is_terminal)
    return Explanation(
        inferred, predict(params, model_state, inferred.latent), targets
    ), model_state


def starts(params, model_state, inference):
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), inference.latent)
    return flat, flat


def follow(params, model_state, key, batch, *, horizon):
    inferred = observe(batch)[1].latent
    last = jax.tree.map(lambda x: x[:, -1], inferred)
    return inferred, imagine(params, model_state, key, last, batch.trajectory.action[:, -1])


def imagine(params, model_state, key, carry, action):
    h, z = numbers(carry)
    following = latent(h + action[..., 0], jnp.zeros_like(z))
    return following, following


def predict(params, model_state, latent):
    h, z = numbers(latent)
    return Predictions(obs=h[..., None], reward=around(params * h), cont=2 + h - 40 * z)


def policy(params, latent):
    h, _ = numbers(latent)
    return ActionDistribution(
        sample=lambda key: (1 - h / 2)[..., None],
        log_prob=lambda action: -jnp.square(action[..., 0] - params * h),
        entropy=lambda: params * jnp.square(h),
        mode=None,
    )


AGENT = Agent(
    spec=EnvSpec("scalar", vector(1), 1, False, 2, 1, None),
    world_model=WorldModel(
        init=lambda key: (PARAMS.world_model, ()),
        initial=lambda batch_size: latent(jnp.zeros(batch_size), jnp.zeros(batch_size)),
        memory=pack,
        filter=None,
        explain=explain,
        starts=starts,
        follow=follow,
        imagine=imagine,
        predict=predict,
    ),
    actor=Actor(lambda key: PARAMS.actor, policy, behaviour=policy),
    critic=Critic(
        init=lambda key: PARAMS.critic,
        logits=lambda params, latent: around(params * sum(numbers(latent))),
        code=transforms.make_two_hot(41, "symexp"),
    ),
)
