"""Your own world model, trained with value alignment by the runner of all the others.

    python experiments/own_world_model.py        # cartpole_balance, minutes on a CPU
    python experiments/own_world_model.py --value-alignment.weight off
    python experiments/own_world_model.py --logdir LOGDIR --resume
    python -m vawm.evaluate --plugin experiments/own_world_model.py --logdir LOGDIR

A world model is nine pure functions, `vawm.world_model.protocol.WorldModel`. This one is a
plain GRU with categorical latents and the heads of DreamerV3:

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
    Explanation,
    Inference,
    Latent,
    Predictions,
    Targets,
    features,
    flat_stoch,
)
from vawm.world_model.heads import make_heads
from vawm.world_model.protocol import WorldModel


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
    """Builds the pure functions; `noise` says whether z~ shares the noise of z."""
    heads = make_heads(config, spec, dtype)
    width = config.stoch * config.classes
    cell, dense = linen.GRUCell(config.deter), linen.Dense(width)

    def init(key):
        keys = jax.random.split(key, 4)
        deter, tokens = jnp.zeros(config.deter), jnp.zeros(heads.token_size)
        params, model_state = heads.init(keys[0])
        params["cell"] = cell.init(keys[1], deter, jnp.zeros(width + spec.action_size))
        params["prior"] = dense.init(keys[2], deter)
        params["post"] = dense.init(keys[3], jnp.concatenate([deter, tokens]))
        return params, model_state

    def initial(batch_size):
        stoch = jnp.zeros((batch_size, config.stoch, config.classes))
        return Latent(jnp.zeros((batch_size, config.deter)), stoch)

    def advance(params, latent, action):
        inputs = jnp.concatenate([flat_stoch(latent.stoch), action], axis=-1)
        return cell.apply(params["cell"], latent.deter, inputs)[0]

    def logits(params, inputs):
        return jnp.asarray(dense.apply(params, inputs)).reshape(
            -1, config.stoch, config.classes
        )

    def sample(key, logits):
        uniform = jax.random.uniform(key, logits.shape[:-1])
        return distributions.sample_one_hot(logits, uniform, unimix=config.unimix)

    def observe(params, key, latent, tokens, prev_action, is_first):
        """One step of `[N, ...]`: everything is zero before the first step of an episode."""
        keep = 1.0 - is_first[:, None]
        latent = Latent(latent.deter * keep, latent.stoch * keep[..., None])
        deter = advance(params, latent, prev_action * keep)
        post = logits(params["post"], jnp.concatenate([deter, tokens], axis=-1))
        prior = logits(params["prior"], deter)
        key_post, key_prior = jax.random.split(key)
        predicted = sample(key_post if noise == "shared" else key_prior, prior)
        return Inference(
            Latent(deter, sample(key_post, post)), Latent(deter, predicted), post, prior
        )

    def observe_batch(params, model_state, key, batch):
        """Steps 1..T of a batch, `[B, T, ...]`; action t - 1 led to observation t."""
        time_major = jax.tree.map(lambda x: x.swapaxes(0, 1), batch.trajectory)
        obs, is_first = jax.tree.map(lambda x: x[1:], (time_major.obs, time_major.is_first))
        tokens, _ = heads.encode(params, model_state, obs)  # all at once, outside of the scan

        def step(latent, inputs):
            key, *arrived = inputs
            inference = observe(params, key, latent, *arrived)
            return inference.latent, inference

        keys = jax.random.split(key, len(is_first))
        inputs = keys, tokens, time_major.action[:-1], is_first
        _, inference = jax.lax.scan(step, batch.context, inputs)
        return jax.tree.map(lambda x: x.swapaxes(0, 1), inference)

    def filter_step(params, model_state, key, latent, obs, prev_action, is_first):
        tokens, _ = heads.encode(params, model_state, obs)
        latent = observe(params, key, latent, tokens, prev_action, is_first).latent
        return latent, latent

    def explain(params, model_state, key, batch):
        inference = observe_batch(params, model_state, key, batch)
        steps = jax.tree.map(lambda x: x[:, 1:], batch.trajectory)
        targets = Targets(steps.obs, steps.reward, steps.is_terminal)
        predictions = predict(params, model_state, inference.latent)
        return Explanation(inference, predictions, targets), model_state

    def starts(params, model_state, inference):
        latent = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), inference.latent)
        latent = jax.lax.stop_gradient(latent)
        return latent, latent

    def follow(params, model_state, key, batch, *, horizon):
        key_observe, key_imagine = jax.random.split(key)
        latent = observe_batch(params, model_state, key_observe, batch).latent
        last = jax.tree.map(lambda x: x[:, -1], latent)
        action = batch.trajectory.action[:, -1]
        return latent, imagine(params, model_state, key_imagine, last, action)

    def imagine(params, model_state, key, latent, action):
        deter = advance(params, latent, action)
        latent = Latent(deter, sample(key, logits(params["prior"], deter)))
        return latent, latent

    def predict(params, model_state, latent):
        obs, _ = heads.decode(params, model_state, features(latent))
        return Predictions(obs, *heads.outcome(params, features(latent)))

    def memory(latent):
        return latent

    return WorldModel(
        init, initial, memory, filter_step, explain, starts, follow, imagine, predict
    )


vawm.agent.register("gru", GRUConfig, gru)


def main(argv: Sequence[str] | None = None) -> int:
    """Trains one agent; returns the exit code."""
    argv = list(sys.argv[1:] if argv is None else argv)
    if "--resume" not in argv:
        argv = ["--agent", "gru", "--task", "cartpole_balance", *argv]
    return command_line.train(argv, suite="dmc_proprio", description=__doc__)


if __name__ == "__main__":
    huge_pages.use_huge_pages()
    sys.exit(command_line.guard(main))
