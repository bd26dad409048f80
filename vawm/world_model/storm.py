"""The transformer world model of STORM as a `WorldModel`."""

from __future__ import annotations

import functools
from typing import Literal

import jax
import jax.numpy as jnp

from vawm import nets
from vawm.config import StormConfig
from vawm.nets import Cache, distributions
from vawm.types import (
    Array,
    Batch,
    EnvSpec,
    Explanation,
    Inference,
    Key,
    Latent,
    Predictions,
    PyTree,
    Targets,
    flat_stoch,
)
from vawm.world_model.protocol import Imagination, WorldModel
from vawm.world_model.storm_heads import make_storm_heads
from vawm.world_model.window import Window, empty_window, remember


def storm(
    config: StormConfig,
    spec: EnvSpec,
    *,
    dtype: jnp.dtype = jnp.float32,
    noise: Literal["independent", "shared"] = "independent",
) -> WorldModel:
    """STORM's world model: a transformer over what was seen and done.

        z_t ~ q(z | o_t),  e_t = mix(z_t, a_t),  h_{t+1} = f(e_1 .. e_t),  z~_t ~ p(z | h_t)

    In our index h_{t+1} belongs to what arrives at t + 1: the reward, the end of the episode
    and the prediction of z_{t+1} are read from it. The official code calls it h_t, and its
    agent's state [z_t, h_{t-1}] is our s_t = (h_t, z_t). Reward and continue head read h alone,
    the decoder z alone, the posterior o_t alone.

    Training uses T + 1 steps: the first T observations are inferred and reconstructed, the last
    T rewards are predicted, and the T - 1 states between are both inferred and predicted.
    Attention, predictions and the KL cross the ends of episodes, as in the official code. With
    `clear_context` they do not: no step attends to an earlier episode, and h is 0 at a first
    step.

    Acting reads the last `act_context` steps again at every step. The policy's latent has z~_t,
    the prediction made before o_t is seen, or z_t with `act_latent="posterior"`. Before
    anything was seen, h is 0. There the official code takes a random action instead, and it
    fills its window only after the random steps at the start.

    Args:
      config: widths, layers, and choices of the official code.
      spec: shapes of observation and action.
      dtype: of products; parameters, logits and norms stay float32.
      noise: "independent": z~ has random numbers of its own; "shared": those of z.
    """
    heads = make_storm_heads(config, spec, dtype)
    net = nets.Storm(
        width=config.deter,
        heads=config.heads,
        feedforward=config.feedforward,
        blocks=config.blocks,
        positions=config.positions,
        dropout=config.dropout,
        stoch=config.stoch,
        classes=config.classes,
        action=spec.action_size,
        tokens=heads.token_size,
        dtype=dtype,
    )

    def apply(params: PyTree, method, *args, rngs=None):
        return net.apply({"params": params["storm"]}, *args, method=method, rngs=rngs)

    def sample(logits: Array, uniform: Array) -> Array:
        return distributions.sample_one_hot(logits, uniform, unimix=config.unimix).astype(dtype)

    def init(key: Key) -> tuple[PyTree, PyTree]:
        key_net, key_heads = jax.random.split(key)
        widths = heads.token_size, spec.action_size
        params = net.init(key_net, *(jnp.zeros((1, 1, width), jnp.float32) for width in widths))
        head_params, model_state = heads.init(key_heads)
        return {"storm": params["params"], **head_params}, model_state

    def visibility(is_first: Array) -> Array:
        """`[B or 1, L, L]`: whether a step may attend to another."""
        past = nets.causal(is_first.shape[1])
        if not config.clear_context:
            return past
        episode = jnp.cumsum(is_first.astype(jnp.int32), axis=1)
        return past & (episode[:, :, None] == episode[:, None, :])

    def clear(deter: Array, is_first: Array) -> Array:
        """h; with `clear_context` 0 where an episode begins."""
        if not config.clear_context:
            return deter
        return deter * (1.0 - is_first.astype(deter.dtype)[..., None])

    def infer(
        params: PyTree, model_state: PyTree, key: Key, obs: PyTree, *, train: bool
    ) -> tuple[Array, Array, Array, PyTree]:
        """For each observation alone: logits, z and its random numbers; the new model_state."""
        tokens, model_state = heads.encode(params, model_state, obs, train=train)
        logits = apply(params, nets.Storm.posterior, tokens)
        uniform = jax.random.uniform(key, logits.shape[:-1], jnp.float32)
        return logits, sample(logits, uniform), uniform, model_state

    def explain(
        params: PyTree, model_state: PyTree, key: Key, batch: Batch
    ) -> tuple[Explanation, PyTree]:
        key_post, key_prior, key_dropout = jax.random.split(key, 3)
        steps = batch.trajectory
        taken = jax.tree.map(lambda x: x[:, :-1], steps)
        arrived = jax.tree.map(lambda x: x[:, 1:], steps)
        post_logits, stoch, uniform, model_state = infer(
            params, model_state, key_post, taken.obs, train=True
        )
        z = flat_stoch(stoch)
        deter = apply(
            params,
            nets.Storm.read_in_training,
            z,
            taken.action,
            visibility(taken.is_first),
            rngs={"dropout": key_dropout},
        )
        deter = clear(deter, arrived.is_first)
        prior_logits = apply(params, nets.Storm.prior, deter)
        uniform = uniform[:, 1:]
        if noise == "independent":
            uniform = jax.random.uniform(key_prior, uniform.shape, jnp.float32)
        inference = Inference(
            latent=Latent(deter[:, :-1], stoch[:, 1:]),
            prior_latent=Latent(deter[:, :-1], sample(prior_logits[:, :-1], uniform)),
            post_logits=post_logits[:, 1:],
            prior_logits=prior_logits[:, :-1],
        )
        obs, model_state = heads.decode(params, model_state, (z,), train=True)
        predictions = Predictions(obs, *heads.outcome(params, (deter,)))
        targets = Targets(taken.obs, arrived.reward, arrived.is_terminal)
        return Explanation(inference, predictions, targets), model_state

    def read(
        params: PyTree, stoch: Array, action: Array, visible: Array, asked: slice = slice(None)
    ):
        """h after the steps `asked`, and the keys and values of all steps; no dropout."""
        return apply(params, nets.Storm.read, flat_stoch(stoch), action, visible, asked)

    def expect(params: PyTree, key: Key, deter: Array) -> Latent:
        """The latent with a sample of the prior at h, `[N, D]`."""
        logits = apply(params, nets.Storm.prior, deter)
        return Latent(
            deter, sample(logits, jax.random.uniform(key, logits.shape[:-1], jnp.float32))
        )

    def follow(
        params: PyTree, model_state: PyTree, key: Key, batch: Batch, *, horizon: int
    ) -> tuple[Latent, Imagination]:
        key_post, key_prior = jax.random.split(key)
        steps = batch.trajectory
        _, stoch, _, _ = infer(params, model_state, key_post, steps.obs, train=False)
        visible = visibility(steps.is_first)
        # Imagination needs only the newest h. Callers that use nothing else do not compute the
        # other h; what both calls have in common is computed once.
        deter, _, _ = read(params, stoch, steps.action, visible)
        newest, keys, values = read(params, stoch, steps.action, visible, slice(-1, None))
        inferred = Latent(clear(deter[:, :-1], steps.is_first[:, 1:]), stoch[:, 1:])
        ends = steps.is_last[:, -1]  # a new episode is what comes next
        latent = expect(params, key_prior, clear(newest[:, 0], ends))
        last = jnp.broadcast_to(visible[:, -1], steps.is_first.shape)
        if config.clear_context:
            last = last & ~ends[:, None]
        cache = nets.fill(keys, values, last, slots=steps.is_first.shape[1] + horizon)
        return inferred, ((cache, latent), latent)

    def imagine(
        params: PyTree,
        model_state: PyTree,
        key: Key,
        carry: tuple[Cache, Latent],
        action: Array,
    ) -> Imagination:
        del model_state
        cache, latent = carry
        deter, cache = apply(params, nets.Storm.step, flat_stoch(latent.stoch), action, cache)
        latent = expect(params, key, deter)
        return (cache, latent), latent

    def filter_step(
        params: PyTree,
        model_state: PyTree,
        key: Key,
        carry: Window,
        obs: PyTree,
        prev_action: Array,
        is_first: Array,
    ) -> tuple[Window, Latent]:
        key_post, key_z = jax.random.split(key)
        window = remember(carry, prev_action)
        if config.clear_context:
            window = window._replace(length=jnp.where(is_first, 0, window.length))
        _, stoch, _, _ = infer(params, model_state, key_post, window.obs, train=False)
        deter, _, _ = read(params, stoch, window.action, nets.causal(config.act_context))
        newest = jnp.maximum(window.length - 1, 0)[:, None, None]
        deter = jnp.take_along_axis(deter, newest, axis=1)[:, 0]
        deter = deter * (window.length > 0).astype(deter.dtype)[:, None]
        if config.act_latent == "prior":
            latent = expect(params, key_z, deter)
        else:
            _, stoch, _, _ = infer(params, model_state, key_z, obs, train=False)
            latent = Latent(deter, stoch)
        return window._replace(latest=obs, waits=jnp.ones_like(window.waits)), latent

    def predict(params: PyTree, model_state: PyTree, latent: Latent) -> Predictions:
        obs, _ = heads.decode(params, model_state, (flat_stoch(latent.stoch),))
        return Predictions(obs, *heads.outcome(params, (latent.deter,)))

    return WorldModel(
        init=init,
        initial=functools.partial(empty_window, spec, config.act_context),
        memory=lambda carry: (),
        filter=filter_step,
        explain=explain,
        starts=None,
        follow=follow,
        imagine=imagine,
        predict=predict,
    )
