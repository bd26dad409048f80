"""STORM's transformer: learned positions, post-norm blocks, and a cache of keys and values.

    e <- LN(e + position)
    in every block   e <- LN(e + dropout(W attention(e)))        causal, dropout on its weights
                     e <- LN(e + dropout(V relu(U e)))

A sequence is read at once, `[B, L, D]`, or one step at a time with a cache of keys and values.
(The official code caches the inputs and projects all of them again in every step, with the same
results.)
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from vawm.nets.relu import LayerNorm, UniformLinear
from vawm.process import dtypes
from vawm.types import Array

BLOCK_EPSILON = 1e-6  # of the norms in this module; others use `relu.NORM_EPSILON`
HIDDEN = -1e30  # score of steps that must not be attended to


class Cache(NamedTuple):
    """Keys and values of N sequences in a fixed number of slots; the first `length` are in use.

    A step without a free slot is lost, so there must be enough slots. Slots are the first
    axis, so that a step reads only those in use, each from contiguous memory.
    """

    keys: tuple[Array, ...]  # of each block, [slots, N, heads, D / heads]
    values: tuple[Array, ...]
    length: Array  # [] int32, slots in use
    visible: Array  # [slots, N] bool, which slots may be attended to


def causal(length: int) -> Array:
    """The causal mask `[1, L, L]`: step q sees steps k <= q."""
    return jnp.tril(jnp.ones((1, length, length), bool))


def attend(query: Array, key: Array, value: Array, visible: Array, dropout) -> Array:
    """Attention: three `[B, L, heads, d]`, mask `[B or 1, L, L]` -> `[B, L, heads * d]`."""
    f32 = jnp.float32
    scores = jnp.einsum("bqhd,bkhd->bhqk", query, key, preferred_element_type=f32)
    scores = jnp.where(visible[:, None], scores / math.sqrt(query.shape[-1]), HIDDEN)
    weights = dropout(jax.nn.softmax(scores)).astype(value.dtype)
    mixed = jnp.einsum("bhqk,bkhd->bqhd", weights, value)
    return mixed.reshape(*mixed.shape[:2], -1)


def attend_cached(
    query: Array, keys: Array, values: Array, visible: Array, length: Array
) -> Array:
    """Attention of one query `[N, heads, d]` to the slots in use -> `[N, heads * d]`.

    On a CPU it loops over the slots with a running softmax: products of N * heads tiny
    matrices take several times as long, and would read every slot.
    """
    arguments = query, keys, values, visible, length
    mixed = jax.lax.platform_dependent(
        *arguments, cpu=attend_slot_by_slot, default=attend_at_once
    )
    return mixed.reshape(mixed.shape[0], -1).astype(query.dtype)


def attend_at_once(
    query: Array, keys: Array, values: Array, visible: Array, length: Array
) -> Array:
    """`attend_cached` with matrix products; `[N, heads, d]` float32."""
    f32 = jnp.float32
    scores = jnp.einsum("nhd,snhd->nhs", query, keys, preferred_element_type=f32)
    used = jnp.arange(keys.shape[0], dtype=jnp.int32) < length
    shown = (visible & used[:, None]).T
    scores = jnp.where(shown[:, None], scores / math.sqrt(query.shape[-1]), HIDDEN)
    mixed = jnp.einsum("nhs,snhd->nhd", jax.nn.softmax(scores).astype(values.dtype), values)
    return mixed.astype(jnp.float32)


def attend_slot_by_slot(
    query: Array, keys: Array, values: Array, visible: Array, length: Array
) -> Array:
    """`attend_at_once` in a loop; sums are kept relative to the largest score so far."""
    query = query.astype(jnp.float32) / math.sqrt(query.shape[-1])

    def add(slot, sums: tuple[Array, Array, Array]):
        largest, weights, mixed = sums
        score = (query * keys[slot].astype(jnp.float32)).sum(-1)
        score = jnp.where(visible[slot][:, None], score, HIDDEN)
        largest, before = jnp.maximum(largest, score), largest
        keep, weight = jnp.exp(before - largest), jnp.exp(score - largest)
        value = values[slot].astype(jnp.float32)
        mixed = mixed * keep[..., None] + weight[..., None] * value
        return largest, weights * keep + weight, mixed

    nothing = jnp.zeros(query.shape[:-1], jnp.float32)
    start = (jnp.full_like(nothing, HIDDEN), nothing, jnp.zeros_like(query))
    _, weights, mixed = jax.lax.fori_loop(0, length, add, start)
    return mixed / weights[..., None]


class Dropout(nn.Dropout):
    """Flax's dropout; its mask does not depend on `jax_enable_x64`, which would draw others."""

    def __call__(self, *args: Any, **kwargs: Any) -> Array:
        with dtypes.usual():
            return super().__call__(*args, **kwargs)


class Block(nn.Module):
    """Attention and feed-forward layer, each added to its input and then normalised."""

    width: int
    heads: int
    feedforward: int
    dropout: float
    dtype: jnp.dtype = jnp.float32

    def setup(self):
        linear = UniformLinear
        self.qkv = linear(self.width, 3 * self.width, False, self.dtype)
        self.out = linear(self.width, self.width, False, self.dtype)
        self.attention_norm = LayerNorm(self.width, BLOCK_EPSILON)
        self.wide = linear(self.width, self.feedforward, True, self.dtype)
        self.narrow = linear(self.feedforward, self.width, True, self.dtype)
        self.feedforward_norm = LayerNorm(self.width, BLOCK_EPSILON)
        self.drop = Dropout(self.dropout)

    def project(self, x: Array) -> list[Array]:
        """Queries, keys and values, each `[..., heads, D / heads]`."""
        parts = jnp.split(self.qkv(x), 3, axis=-1)
        return [part.reshape(*part.shape[:-1], self.heads, -1) for part in parts]

    def add(self, x: Array, mixed: Array, deterministic: bool) -> Array:
        """The rest of the block after attention."""
        x = self.attention_norm(x + self.drop(self.out(mixed), deterministic))
        wide = nn.relu(self.wide(x))
        return self.feedforward_norm(x + self.drop(self.narrow(wide), deterministic))

    def __call__(
        self, x: Array, visible: Array, deterministic: bool, asked: slice = slice(None)
    ):
        """The outputs of the steps `asked`, and the keys and values of all steps."""
        query, key, value = self.project(x)
        mixed = attend(
            query[:, asked],
            key,
            value,
            visible[:, asked],
            lambda w: self.drop(w, deterministic),
        )
        return self.add(x[:, asked], mixed, deterministic), key, value


class Transformer(nn.Module):
    """Adds positions, then applies `blocks` blocks.

    Dropout uses the random numbers "dropout", unless `deterministic`.
    """

    width: int
    heads: int
    feedforward: int
    blocks: int
    positions: int
    dropout: float
    dtype: jnp.dtype = jnp.float32

    def setup(self):
        self.position = self.param(
            "position", nn.initializers.normal(1.0), (self.positions, self.width), jnp.float32
        )
        self.norm = LayerNorm(self.width, BLOCK_EPSILON)
        sizes = self.width, self.heads, self.feedforward, self.dropout, self.dtype
        self.layers = [Block(*sizes) for _ in range(self.blocks)]

    def place(self, x: Array, position: Array) -> Array:
        position = position.astype(x.dtype).reshape(
            (1,) * (x.ndim - position.ndim) + position.shape
        )
        return self.norm(x + position)

    def __call__(
        self,
        x: Array,
        visible: Array,
        deterministic: bool = True,
        asked: slice = slice(None),
    ) -> tuple[Array, list[Array], list[Array]]:
        """Reads `[B, L, D]` at positions 0..L-1.

        Args:
          x: mixed latents and actions.
          visible: `[B or 1, L, L]`, the steps (last axis) that each step sees.
          deterministic: without dropout.
          asked: the steps whose output is needed; the last block computes no other.

        Returns:
          `[B, steps asked, D]`, and the keys and values of each block,
          `[B, L, heads, D / heads]`.

        Raises:
          ValueError: more steps than positions.
        """
        if x.shape[1] > self.positions:
            raise ValueError(f"{x.shape[1]} steps, but only {self.positions} positions")
        x = self.place(x, self.position[: x.shape[1]])
        keys, values = [], []
        for block in self.layers:
            wanted = asked if block is self.layers[-1] else slice(None)
            x, key, value = block(x, visible, deterministic, wanted)
            keys.append(key)
            values.append(value)
        return x, keys, values

    def step(self, x: Array, cache: Cache) -> tuple[Array, Cache]:
        """Reads one more step `[N, D]`, without dropout, into the next free slot."""
        slot, length = cache.length, cache.length + 1
        visible = cache.visible.at[slot].set(True)
        x = self.place(x, self.position[slot])
        all_keys, all_values = [], []
        for block, keys, values in zip(self.layers, cache.keys, cache.values, strict=True):
            query, key, value = block.project(x)
            keys, values = keys.at[slot].set(key), values.at[slot].set(value)
            x = block.add(x, attend_cached(query, keys, values, visible, length), True)
            all_keys.append(keys)
            all_values.append(values)
        return x, Cache(tuple(all_keys), tuple(all_values), length, visible)


def fill(keys: list[Array], values: list[Array], visible: Array, *, slots: int) -> Cache:
    """A cache with sequences that were read at once.

    Args:
      keys: of each block, `[N, L, heads, D / heads]`.
      values: the same.
      visible: `[N, L]`, which steps may be attended to from now on.
      slots: L plus the number of steps that will follow.
    """
    length = keys[0].shape[1]

    def place(x: Array) -> Array:
        x = x.swapaxes(0, 1)
        return jnp.pad(x, [(0, slots - length)] + [(0, 0)] * (x.ndim - 1))

    return Cache(
        keys=tuple(place(x) for x in keys),
        values=tuple(place(x) for x in values),
        length=jnp.full((), length, jnp.int32),
        visible=place(visible),
    )


class Storm(nn.Module):
    """Posterior, action mixer, transformer and prior of STORM."""

    width: int
    heads: int
    feedforward: int
    blocks: int
    positions: int
    dropout: float
    stoch: int
    classes: int
    action: int
    tokens: int
    dtype: jnp.dtype = jnp.float32

    def setup(self):
        flat = self.stoch * self.classes
        self.posterior_out = UniformLinear(self.tokens, flat, True, self.dtype)
        self.prior_out = UniformLinear(self.width, flat, True, self.dtype)
        self.mix_in = UniformLinear(flat + self.action, self.width, False, self.dtype)
        self.mix_in_norm = LayerNorm(self.width)
        self.mix_out = UniformLinear(self.width, self.width, False, self.dtype)
        self.mix_out_norm = LayerNorm(self.width)
        self.transformer = Transformer(
            self.width,
            self.heads,
            self.feedforward,
            self.blocks,
            self.positions,
            self.dropout,
            self.dtype,
        )

    def posterior(self, tokens: Array) -> Array:
        """Logits `[..., stoch, classes]` of q(z_t | o_t)."""
        return self._to_logits(self.posterior_out(tokens))

    def prior(self, deter: Array) -> Array:
        """Logits `[..., stoch, classes]` of p(z_t | h_t)."""
        return self._to_logits(self.prior_out(deter))

    def mix(self, stoch: Array, action: Array) -> Array:
        """e_t from flat z_t and a_t; scales action entries beyond [-1, 1] to magnitude 1."""
        action = action / jax.lax.stop_gradient(jnp.maximum(1.0, jnp.abs(action)))
        x = nn.relu(self.mix_in_norm(self.mix_in(stoch, action)))
        return self.mix_out_norm(self.mix_out(x))

    def read(
        self, stoch: Array, action: Array, visible: Array, asked: slice = slice(None)
    ) -> tuple[Array, list[Array], list[Array]]:
        """See `Transformer`; without dropout."""
        return self.transformer(self.mix(stoch, action), visible, asked=asked)

    def read_in_training(self, stoch: Array, action: Array, visible: Array) -> Array:
        """h `[B, L, D]`, with dropout."""
        return self.transformer(self.mix(stoch, action), visible, deterministic=False)[0]

    def step(self, stoch: Array, action: Array, cache: Cache) -> tuple[Array, Cache]:
        """See `Transformer.step`."""
        return self.transformer.step(self.mix(stoch, action), cache)

    def _to_logits(self, x: Array) -> Array:
        logits = x.reshape(*x.shape[:-1], self.stoch, self.classes)
        return logits.astype(jnp.float32)

    def __call__(self, tokens: Array, action: Array) -> Array:
        """Touches every parameter once, for initialisation."""
        logits = self.posterior(tokens)
        stoch = logits.reshape(*logits.shape[:-2], -1)
        return self.prior(self.read(stoch, action, causal(action.shape[1]))[0])
