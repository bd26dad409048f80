"""The recurrent state-space model of DreamerV3 as a `WorldModel`."""

from __future__ import annotations

import functools
from typing import Literal

import jax
import jax.numpy as jnp

from vawm import nets
from vawm.config import RSSMConfig
from vawm.nets import distributions
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
    features,
    flat_stoch,
)
from vawm.world_model.heads import make_heads
from vawm.world_model.packing import pack, unpack
from vawm.world_model.protocol import Imagination, WorldModel


def network(config: RSSMConfig, *, actions: int, tokens: int, dtype: jnp.dtype) -> nets.RSSM:
    """The layers for actions and tokens of these widths."""
    return nets.RSSM(
        deter=config.deter,
        hidden=config.hidden,
        stoch=config.stoch,
        classes=config.classes,
        action=actions,
        tokens=tokens,
        blocks=config.blocks,
        prior_layers=config.prior_layers,
        dtype=dtype,
    )


def blank(config: RSSMConfig, batch_size: int, *, dtype: jnp.dtype) -> Latent:
    """The latents before the first observation: all zero."""
    return Latent(
        jnp.zeros((batch_size, config.deter), dtype),
        jnp.zeros((batch_size, config.stoch, config.classes), dtype),
    )


def swap_time(tree: PyTree) -> PyTree:
    """`[B, T, ...]` -> `[T, B, ...]`, and back."""
    return jax.tree.map(lambda x: x.swapaxes(0, 1), tree)


def rssm(
    config: RSSMConfig,
    spec: EnvSpec,
    *,
    dtype: jnp.dtype = jnp.float32,
    noise: Literal["independent", "shared"] = "independent",
    deterministic: bool = False,
) -> WorldModel:
    """DreamerV3's world model with block GRU.

        h_t = f(h_{t-1}, z_{t-1}, a_{t-1}),  z_t ~ q(z | h_t, o_t),  z~_t ~ p(z | h_t)

    If deterministic, z and z~ are the probabilities of q and p instead of samples. The model
    remembers the `Latent` s_{t-1}, which replay keeps beside every step. Everything that needs
    no recurrence (the encoder, the share of the action and of the observation in their layers,
    the prior) is computed for all time steps at once; only the rest is in the scan.
    `model_state` has no arrays, and training and acting are the same.

    Args:
      config: widths and layers.
      spec: shapes of observation and action.
      dtype: of products; parameters, logits and norms stay float32.
      noise: "independent": z~ has random numbers of its own; "shared": those of z, so that
        equal distributions give equal samples.
      deterministic: whether z and z~ are probabilities. Then keys do not matter.
    """
    heads = make_heads(config, spec, dtype)
    net = network(config, actions=spec.action_size, tokens=heads.token_size, dtype=dtype)

    def apply(params: PyTree, method, *args):
        return net.apply({"params": params["rssm"]}, *args, method=method)

    def sample(logits: Array, uniform: Array) -> Array:
        if deterministic:
            return distributions.probabilities(logits, unimix=config.unimix).astype(dtype)
        return distributions.sample_one_hot(logits, uniform, unimix=config.unimix).astype(dtype)

    def remember(latent: Latent) -> Latent:
        return latent if deterministic else pack(latent)

    def recall(context: Latent) -> Latent:
        return context if deterministic else unpack(context, config.classes)

    def init(key: Key) -> tuple[PyTree, PyTree]:
        key_rssm, key_heads = jax.random.split(key)
        widths = config.deter, config.stoch * config.classes, spec.action_size, heads.token_size
        params = net.init(key_rssm, *(jnp.zeros((1, width), dtype) for width in widths))
        head_params, model_state = heads.init(key_heads)
        return {"rssm": params["params"], **head_params}, model_state

    def observe(
        params: PyTree,
        model_state: PyTree,
        key: Key,
        carry: Latent,
        obs: PyTree,
        prev_action: Array,
        is_first: Array,
    ) -> Inference:
        """Infers `[B, T, ...]` after the latent `carry`; `prev_action[:, t]` is a_{t-1}."""
        key_post, key_prior = jax.random.split(key)
        batch, length = is_first.shape
        obs, prev_action, is_first = swap_time((obs, prev_action, is_first))
        keep = 1.0 - is_first.astype(dtype)[..., None]
        drive = apply(params, lambda m, a: m.gru.drive(a), prev_action.astype(dtype) * keep)
        tokens, _ = heads.encode(params, model_state, obs)
        tokens = apply(params, nets.RSSM.read_tokens, tokens)
        uniform = jax.random.uniform(key_post, (length, batch, config.stoch))

        def step(latent: Latent, inputs):
            keep, drive, tokens, uniform = inputs
            deter, stoch = latent.deter * keep, flat_stoch(latent.stoch) * keep
            deter = apply(params, nets.RSSM.advance, deter, stoch, drive)
            logits = apply(params, nets.RSSM.posterior, deter, tokens)
            latent = Latent(deter, sample(logits, uniform))
            return latent, (latent, logits)

        inputs = keep, drive, tokens, uniform
        _, (latent, post_logits) = jax.lax.scan(step, carry, inputs)
        prior_logits = apply(params, nets.RSSM.prior, latent.deter)
        if noise == "independent":
            uniform = jax.random.uniform(key_prior, uniform.shape)
        prior_latent = Latent(latent.deter, sample(prior_logits, uniform))
        return swap_time(Inference(latent, prior_latent, post_logits, prior_logits))

    def observe_batch(params: PyTree, model_state: PyTree, key: Key, batch: Batch) -> Inference:
        steps = batch.trajectory
        obs, is_first = jax.tree.map(lambda x: x[:, 1:], (steps.obs, steps.is_first))
        prev_action = steps.action[:, :-1]
        context = recall(batch.context)
        return observe(params, model_state, key, context, obs, prev_action, is_first)

    def filter_step(
        params: PyTree,
        model_state: PyTree,
        key: Key,
        carry: Latent,
        obs: PyTree,
        prev_action: Array,
        is_first: Array,
    ) -> tuple[Latent, Latent]:
        one_step = jax.tree.map(lambda x: x[:, None], (obs, prev_action, is_first))
        inference = observe(params, model_state, key, carry, *one_step)
        latent = jax.tree.map(lambda x: x[:, 0], inference.latent)
        return latent, latent

    def explain(
        params: PyTree, model_state: PyTree, key: Key, batch: Batch
    ) -> tuple[Explanation, PyTree]:
        """All at steps 1..T."""
        inference = observe_batch(params, model_state, key, batch)
        steps = jax.tree.map(lambda x: x[:, 1:], batch.trajectory)
        shown = inference.latent
        if not config.reconstruction_gradient:
            shown = jax.lax.stop_gradient(shown)
        obs, _ = heads.decode(params, model_state, features(shown))
        outcome = heads.outcome(params, features(inference.latent))
        targets = Targets(steps.obs, steps.reward, steps.is_terminal)
        return Explanation(inference, Predictions(obs, *outcome), targets), model_state

    def begin(params: PyTree, latent: Latent) -> Imagination:
        latent = jax.lax.stop_gradient(latent)
        blocks = apply(params, lambda m, h: m.gru.to_blocks(h), latent.deter)
        return (blocks, latent), latent

    def starts(params: PyTree, model_state: PyTree, inference: Inference) -> Imagination:
        """From every inferred state of the batch, terminal ones included."""
        del model_state
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), inference.latent)
        return begin(params, flat)

    def follow(
        params: PyTree, model_state: PyTree, key: Key, batch: Batch, *, horizon: int
    ) -> tuple[Latent, Imagination]:
        del horizon
        key_observe, key_imagine = jax.random.split(key)
        latent = observe_batch(params, model_state, key_observe, batch).latent
        carry, _ = begin(params, jax.tree.map(lambda x: x[:, -1], latent))
        return latent, imagine(
            params, model_state, key_imagine, carry, batch.trajectory.action[:, -1]
        )

    def imagine(
        params: PyTree,
        model_state: PyTree,
        key: Key,
        carry: tuple[Array, Latent],
        action: Array,
    ) -> Imagination:
        del model_state
        blocks, latent = carry
        drive = apply(params, lambda m, a: m.gru.drive(a), action.astype(dtype))
        blocks, deter, logits = apply(
            params, nets.RSSM.imagine, blocks, latent.deter, flat_stoch(latent.stoch), drive
        )
        uniform = jax.random.uniform(key, logits.shape[:-1])
        latent = Latent(deter, sample(logits, uniform))
        return (blocks, latent), latent

    def predict(params: PyTree, model_state: PyTree, latent: Latent) -> Predictions:
        feature = features(latent)
        obs, _ = heads.decode(params, model_state, feature)
        return Predictions(obs, *heads.outcome(params, feature))

    return WorldModel(
        init=init,
        initial=functools.partial(blank, config, dtype=dtype),
        memory=remember,
        filter=filter_step,
        explain=explain,
        starts=starts,
        follow=follow,
        imagine=imagine,
        predict=predict,
    )
