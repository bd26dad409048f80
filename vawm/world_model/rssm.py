"""The recurrent state-space model of DreamerV3 as a `WorldModel`."""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp

from vawm import nets
from vawm.config import RSSMConfig
from vawm.nets import distributions
from vawm.types import (
    Array,
    EnvSpec,
    Inference,
    Key,
    Latent,
    PyTree,
    flat_stoch,
)
from vawm.world_model.heads import make_heads
from vawm.world_model.protocol import Imagination, WorldModel
from vawm.world_model.recurrent import Cell, recurrent


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

    If deterministic, z and z~ are the probabilities of q and p instead of samples. Everything
    that needs no recurrence (the encoder, the share of the action and of the observation in
    their layers, the prior) is computed for all time steps at once; only the rest is in the
    scan. `model_state` has no arrays, and training and acting are the same.

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

    def init(key: Key) -> dict[str, PyTree]:
        widths = config.deter, config.stoch * config.classes, spec.action_size, heads.token_size
        inputs = [jnp.zeros((1, width), dtype) for width in widths]
        return {"rssm": net.init(key, *inputs)["params"]}

    def observe(
        params: PyTree,
        key: Key,
        latent: Latent,
        tokens: Array,
        prev_action: Array,
        is_first: Array,
    ) -> Inference:
        key_post, key_prior = jax.random.split(key)
        keep = 1.0 - is_first.astype(dtype)[..., None]
        drive = apply(params, lambda m, a: m.gru.drive(a), prev_action.astype(dtype) * keep)
        tokens = apply(params, nets.RSSM.read_tokens, tokens)
        uniform = jax.random.uniform(key_post, (*is_first.shape, config.stoch), jnp.float32)

        def step(latent: Latent, inputs):
            keep, drive, tokens, uniform = inputs
            deter, stoch = latent.deter * keep, flat_stoch(latent.stoch) * keep
            deter = apply(params, nets.RSSM.advance, deter, stoch, drive)
            logits = apply(params, nets.RSSM.posterior, deter, tokens)
            latent = Latent(deter, sample(logits, uniform))
            return latent, (latent, logits)

        inputs = keep, drive, tokens, uniform
        _, (latent, post_logits) = jax.lax.scan(step, latent, inputs)
        prior_logits = apply(params, nets.RSSM.prior, latent.deter)
        if noise == "independent":
            uniform = jax.random.uniform(key_prior, uniform.shape, jnp.float32)
        prior_latent = Latent(latent.deter, sample(prior_logits, uniform))
        return Inference(latent, prior_latent, post_logits, prior_logits)

    def begin(params: PyTree, latent: Latent) -> tuple[Array, Latent]:
        return apply(params, lambda m, h: m.gru.to_blocks(h), latent.deter), latent

    def imagine(
        params: PyTree, key: Key, carry: tuple[Array, Latent], action: Array
    ) -> Imagination:
        blocks, latent = carry
        drive = apply(params, lambda m, a: m.gru.drive(a), action.astype(dtype))
        blocks, deter, logits = apply(
            params, nets.RSSM.imagine, blocks, latent.deter, flat_stoch(latent.stoch), drive
        )
        uniform = jax.random.uniform(key, logits.shape[:-1], jnp.float32)
        latent = Latent(deter, sample(logits, uniform))
        return (blocks, latent), latent

    return recurrent(
        Cell(init, observe, begin, imagine),
        heads,
        config,
        dtype=dtype,
        one_hot=not deterministic,
        reconstruction_gradient=config.reconstruction_gradient,
    )
