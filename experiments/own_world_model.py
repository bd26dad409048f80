"""Your own world model, trained with value alignment by the runner of all the others.

    python experiments/own_world_model.py        # cartpole_balance, minutes on a CPU
    python experiments/own_world_model.py --value-alignment.weight off
    python experiments/own_world_model.py --logdir LOGDIR --resume
    python -m vawm.evaluate --plugin experiments/own_world_model.py --logdir LOGDIR

A world model is nine pure functions, `vawm.world_model.protocol.WorldModel`; a recurrent one
needs only a cell, `vawm.world_model.recurrent`, and heads. This one is a plain GRU with
categorical latents between the heads of DreamerV3:

    h_t = GRU(h_{t-1}, [z_{t-1}, a_{t-1}]),  z_t ~ q(z | h_t, o_t),  z~_t ~ p(z | h_t)
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import linen

import vawm.agent
from vawm.cli import command_line
from vawm.config import HeadsConfig
from vawm.nets import distributions
from vawm.process import huge_pages
from vawm.types import (
    EnvSpec,
    Inference,
    Latent,
    flat_stoch,
)
from vawm.world_model.heads import make_heads
from vawm.world_model.protocol import WorldModel
from vawm.world_model.recurrent import Cell, recurrent


@dataclass(frozen=True)
class GRUConfig(HeadsConfig):
    """Every field is a flag, `--world-model.deter 256`, and is saved with the run."""

    deter: int = 128
    stoch: int = 8
    classes: int = 8
    units: int = 64
    encoder_layers: int = 1
    decoder_layers: int = 1


def gru(config: GRUConfig, spec: EnvSpec, *, dtype, noise) -> WorldModel:
    """The cell of the model, between the heads; `noise` says whether z~ shares that of z."""
    heads = make_heads(config, spec, dtype)
    width = config.stoch * config.classes
    net = linen.GRUCell(config.deter, dtype=dtype)
    dense = linen.Dense(width)  # logits are float32

    def init(key):
        keys = jax.random.split(key, 3)
        deter, tokens = jnp.zeros(config.deter), jnp.zeros(heads.token_size)
        return {
            "cell": net.init(keys[0], deter, jnp.zeros(width + spec.action_size)),
            "prior": dense.init(keys[1], deter),
            "post": dense.init(keys[2], jnp.concatenate([deter, tokens])),
        }

    def advance(params, latent, action):
        inputs = jnp.concatenate([flat_stoch(latent.stoch), action], axis=-1)
        return net.apply(params["cell"], latent.deter, inputs)[0]

    def logits(params, *inputs):
        flat = jnp.asarray(dense.apply(params, jnp.concatenate(inputs, axis=-1)))
        return flat.reshape(*flat.shape[:-1], config.stoch, config.classes)

    def sample(uniform, logits):
        return distributions.sample_one_hot(logits, uniform, unimix=config.unimix).astype(dtype)

    def observe(params, key, latent, tokens, prev_action, is_first):
        def step(latent, inputs):
            uniform, tokens, prev_action, is_first = inputs
            keep = 1 - is_first.astype(dtype)[:, None]  # an episode starts with zeros
            latent = Latent(latent.deter * keep, latent.stoch * keep[..., None])
            deter = advance(params, latent, prev_action * keep)
            post = logits(params["post"], deter, tokens)
            latent = Latent(deter, sample(uniform, post))
            return latent, (latent, post)

        key_post, key_prior = jax.random.split(key)
        uniform = jax.random.uniform(key_post, (*is_first.shape, config.stoch))
        inputs = uniform, tokens, prev_action, is_first
        _, (latent, post) = jax.lax.scan(step, latent, inputs)
        prior = logits(params["prior"], latent.deter)
        if noise == "independent":
            uniform = jax.random.uniform(key_prior, uniform.shape)
        return Inference(latent, Latent(latent.deter, sample(uniform, prior)), post, prior)

    def begin(params, latent):
        return latent

    def imagine(params, key, latent, action):
        deter = advance(params, latent, action)
        prior = logits(params["prior"], deter)
        latent = Latent(deter, sample(jax.random.uniform(key, prior.shape[:-1]), prior))
        return latent, latent

    return recurrent(Cell(init, observe, begin, imagine), heads, config, dtype=dtype)


vawm.agent.register("gru", GRUConfig, gru)


def main(argv: Sequence[str] | None = None) -> int:
    """Trains one agent; returns the exit code."""
    return command_line.train(
        argv,
        suite="dmc_proprio",
        description=__doc__,
        agent="gru",
        task="cartpole_balance",
    )


if __name__ == "__main__":
    huge_pages.use_huge_pages()
    sys.exit(command_line.guard(main))
