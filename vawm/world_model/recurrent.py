"""A world model made of a recurrent cell and heads."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm.config import WorldModelConfig
from vawm.types import (
    Array,
    Batch,
    Explanation,
    Inference,
    Key,
    Latent,
    Predictions,
    PyTree,
    Targets,
    features,
)
from vawm.world_model.heads import Heads
from vawm.world_model.packing import pack, unpack
from vawm.world_model.protocol import Imagination, WorldModel


class Cell(NamedTuple):
    """What one recurrent world model has and another has not, as pure functions.

    Attributes:
      init: `(key) -> params`, a dict without the keys of the heads.
      observe: `(params, key, latent, tokens, prev_action, is_first) -> Inference` of steps
        1..T, time-major: `[T, B, ...]`. `latent` is s_0, `prev_action[t]` led to `tokens[t]`;
        where `is_first` the state before is zero and the action none.
      begin: `(params, latent) -> carry`, what `imagine` needs of states `[N, ...]`.
      imagine: `(params, key, carry, action) -> (carry, latent)`, one step with the prior.
    """

    init: Callable[[Key], dict[str, PyTree]]
    observe: Callable[[PyTree, Key, Latent, Array, Array, Array], Inference]
    begin: Callable[[PyTree, Latent], PyTree]
    imagine: Callable[[PyTree, Key, PyTree, Array], Imagination]


def swap_time(tree: PyTree) -> PyTree:
    """`[B, T, ...]` -> `[T, B, ...]`, and back."""
    return jax.tree.map(lambda x: x.swapaxes(0, 1), tree)


def recurrent(
    cell: Cell,
    heads: Heads,
    config: WorldModelConfig,
    *,
    dtype: jnp.dtype,
    one_hot: bool = True,
    reconstruction_gradient: bool = True,
) -> WorldModel:
    """The world model of a cell whose heads read [h, z].

    It remembers the `Latent` s_{t-1}, which replay keeps beside every step. Observations are
    encoded for all steps at once, outside of the cell's scan. `model_state` is the heads'; it
    does not change.

    Args:
      cell: the recurrence.
      heads: encoder, decoder, reward and continue heads.
      config: widths of the latent.
      dtype: of latents.
      one_hot: whether z is one-hot, so that replay can keep it as indices.
      reconstruction_gradient: whether the reconstruction loss reaches latents.
    """

    def init(key: Key) -> tuple[PyTree, PyTree]:
        key_cell, key_heads = jax.random.split(key)
        head_params, model_state = heads.init(key_heads)
        return {**cell.init(key_cell), **head_params}, model_state

    def initial(batch_size: int) -> Latent:
        stoch = batch_size, config.stoch, config.classes
        return Latent(jnp.zeros((batch_size, config.deter), dtype), jnp.zeros(stoch, dtype))

    def memory(latent: Latent) -> Latent:
        return pack(latent) if one_hot else latent

    def observe(
        params: PyTree,
        model_state: PyTree,
        key: Key,
        latent: Latent,
        obs: PyTree,
        prev_action: Array,
        is_first: Array,
    ) -> Inference:
        """Infers `[B, T, ...]` after `latent`; `prev_action[:, t]` is a_{t-1}."""
        obs, prev_action, is_first = swap_time((obs, prev_action, is_first))
        tokens, _ = heads.encode(params, model_state, obs)
        return swap_time(cell.observe(params, key, latent, tokens, prev_action, is_first))

    def observe_batch(params: PyTree, model_state: PyTree, key: Key, batch: Batch) -> Inference:
        steps = batch.trajectory
        obs, is_first = jax.tree.map(lambda x: x[:, 1:], (steps.obs, steps.is_first))
        latent = unpack(batch.context, config.classes) if one_hot else batch.context
        return observe(params, model_state, key, latent, obs, steps.action[:, :-1], is_first)

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
        if not reconstruction_gradient:
            shown = jax.lax.stop_gradient(shown)
        obs, _ = heads.decode(params, model_state, features(shown))
        outcome = heads.outcome(params, features(inference.latent))
        targets = Targets(steps.obs, steps.reward, steps.is_terminal)
        return Explanation(inference, Predictions(obs, *outcome), targets), model_state

    def starts(params: PyTree, model_state: PyTree, inference: Inference) -> Imagination:
        """From every inferred state of the batch, terminal ones included."""
        del model_state
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), inference.latent)
        latent = jax.lax.stop_gradient(flat)
        return cell.begin(params, latent), latent

    def follow(
        params: PyTree, model_state: PyTree, key: Key, batch: Batch, *, horizon: int
    ) -> tuple[Latent, Imagination]:
        del horizon
        key_observe, key_imagine = jax.random.split(key)
        latent = observe_batch(params, model_state, key_observe, batch).latent
        last = jax.lax.stop_gradient(jax.tree.map(lambda x: x[:, -1], latent))
        action = batch.trajectory.action[:, -1]
        return latent, cell.imagine(params, key_imagine, cell.begin(params, last), action)

    def imagine(
        params: PyTree, model_state: PyTree, key: Key, carry: PyTree, action: Array
    ) -> Imagination:
        del model_state
        return cell.imagine(params, key, carry, action)

    def predict(params: PyTree, model_state: PyTree, latent: Latent) -> Predictions:
        obs, _ = heads.decode(params, model_state, features(latent))
        return Predictions(obs, *heads.outcome(params, features(latent)))

    return WorldModel(
        init=init,
        initial=initial,
        memory=memory,
        filter=filter_step,
        explain=explain,
        starts=starts,
        follow=follow,
        imagine=imagine,
        predict=predict,
    )
