"""The recurrent networks of DreamerV3: block GRU, posterior and prior."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp

from vawm.nets.layers import MLP, Layer, Linear, rms_norm, truncated_normal_in
from vawm.types import Array


class BlockGRU(nn.Module):
    """The sequence model h' = f(h, z, a) of the RSSM, with block-diagonal recurrence.

        x  = [layer(h), layer(z), layer(a)]                      shared by all blocks
        y  = layer of block k: W_k [h_k, x]
        reset, candidate, update = V_k y_k                       within block k
        h' = u * tanh(r * candidate) + (1 - u) * h,   u = sigmoid(update - 1)

    h is stored as `[blocks, N, deter / blocks]`, so block products need no transposition,
    and the product with x is one dense matrix for all blocks instead of a copy of x per
    block. Kernels keep the official layout `[blocks, in, out]`, on which AGC and the initial
    scale (whose fan-in is the full input width) are defined.
    """

    deter: int
    hidden: int
    stoch: int
    action: int
    blocks: int
    dtype: jnp.dtype = jnp.float32

    def setup(self):
        width = self.deter // self.blocks
        self.from_deter = Layer(self.deter, self.hidden, self.dtype)
        self.from_stoch = Layer(self.stoch, self.hidden, self.dtype)
        self.from_action = Layer(self.action, self.hidden, self.dtype)
        shared = 3 * self.hidden
        fan_in = self.deter + shared * self.blocks
        zeros, ones = nn.initializers.zeros, nn.initializers.ones
        self.mix_kernel = self.param(
            "mix_kernel",
            truncated_normal_in(fan_in, 1.0),
            (self.blocks, width + shared, width),
        )
        self.mix_bias = self.param("mix_bias", zeros, (self.deter,), jnp.float32)
        self.mix_norm = self.param("mix_norm", ones, (self.deter,), jnp.float32)
        self.gate_kernel = self.param(
            "gate_kernel", truncated_normal_in(self.deter, 1.0), (self.blocks, width, 3 * width)
        )
        self.gate_bias = self.param("gate_bias", zeros, (3 * self.deter,), jnp.float32)

    def to_blocks(self, deter: Array) -> Array:
        """`[N, D]` -> `[blocks, N, D / blocks]`."""
        return deter.reshape(deter.shape[0], self.blocks, -1).swapaxes(0, 1)

    def from_blocks(self, blocks: Array) -> Array:
        """`[blocks, N, D / blocks]` -> `[N, D]`."""
        return blocks.swapaxes(0, 1).reshape(blocks.shape[1], -1)

    def drive(self, action: Array) -> Array:
        """The contribution of the action to the mixing layer, including bias: `[..., D]`.

        Does not depend on the state, so a caller with all actions of a sequence can compute
        it outside the time loop.
        """
        magnitude = jnp.maximum(1.0, jnp.abs(action))
        action = action / jax.lax.stop_gradient(magnitude)
        x = self.from_action(action) @ self._shared_kernel(2 * self.hidden)
        return x + self.mix_bias.astype(self.dtype).reshape((1,) * (x.ndim - 1) + (-1,))

    def _shared_kernel(self, start: int, stop: int | None = None) -> Array:
        """Rows of the mixing kernels that read x, all blocks side by side: `[rows, D]`."""
        width = self.deter // self.blocks
        kernel = self.mix_kernel[:, width:][:, start:stop].astype(self.dtype)
        return kernel.swapaxes(0, 1).reshape(kernel.shape[1], self.deter)

    def __call__(self, blocks: Array, deter: Array, stoch: Array, drive: Array) -> Array:
        """One step; `deter` is the flat form of `blocks`. Returns the next blocks."""
        width = self.deter // self.blocks
        x = jnp.concatenate([self.from_deter(deter), self.from_stoch(stoch)], -1)
        x = self.to_blocks(x @ self._shared_kernel(0, 2 * self.hidden) + drive)
        x = x + block_product(blocks, self.mix_kernel[:, :width], self.dtype)
        x = nn.silu(rms_norm(x, self.mix_norm.reshape(self.blocks, 1, width), (0, 2)))
        gates = block_product(x, self.gate_kernel, self.dtype)
        gates = gates + self.gate_bias.astype(self.dtype).reshape(self.blocks, 1, -1)
        reset, candidate, update = jnp.split(gates, 3, -1)
        candidate = jnp.tanh(nn.sigmoid(reset) * candidate)
        update = nn.sigmoid(update - 1.0)
        return update * candidate + (1.0 - update) * blocks


def block_product(x: Array, kernel: Array, dtype: jnp.dtype) -> Array:
    """`[g, N, in]` times `[g, in, out]` -> `[g, N, out]`."""
    return jnp.einsum("gni,gio->gno", x.astype(dtype), kernel.astype(dtype))


class RSSM(nn.Module):
    """Sequence model, posterior q(z|h,o) and prior p(z|h) of DreamerV3."""

    deter: int
    hidden: int
    stoch: int
    classes: int
    action: int
    tokens: int
    blocks: int
    prior_layers: int
    dtype: jnp.dtype = jnp.float32

    def setup(self):
        flat = self.stoch * self.classes
        self.gru = BlockGRU(self.deter, self.hidden, flat, self.action, self.blocks, self.dtype)
        self.posterior_layer = Layer(self.deter + self.tokens, self.hidden, self.dtype)
        self.posterior_out = Linear(self.hidden, flat, dtype=self.dtype)
        self.prior_net = MLP(
            self.deter, self.prior_layers, self.hidden, (flat,), (1.0,), self.dtype
        )

    def read_tokens(self, tokens: Array) -> Array:
        """The part of the posterior's first layer that reads o_t, including bias."""
        linear = self.posterior_layer.linear
        return linear.add_bias(linear.rows(tokens, self.deter))

    def posterior(self, deter: Array, token_part: Array) -> Array:
        """Logits `[..., stoch, classes]` of q(z_t | h_t, o_t)."""
        x = self.posterior_layer.linear.rows(deter, 0) + token_part
        return self._to_logits(self.posterior_out(self.posterior_layer.activate(x)))

    def prior(self, deter: Array) -> Array:
        """Logits `[..., stoch, classes]` of p(z_t | h_t)."""
        return self._to_logits(self.prior_net(deter)[0])

    def advance(self, deter: Array, stoch: Array, drive: Array) -> Array:
        """The recurrence from flat h_t to flat h_{t+1}."""
        blocks = self.gru(self.gru.to_blocks(deter), deter, stoch, drive)
        return self.gru.from_blocks(blocks)

    def imagine(
        self, blocks: Array, deter: Array, stoch: Array, drive: Array
    ) -> tuple[Array, Array, Array]:
        """The recurrence and the prior: the next h in blocks, flat h, and the prior logits."""
        blocks = self.gru(blocks, deter, stoch, drive)
        deter = self.gru.from_blocks(blocks)
        return blocks, deter, self.prior(deter)

    def _to_logits(self, x: Array) -> Array:
        logits = x.reshape(*x.shape[:-1], self.stoch, self.classes)
        return logits.astype(jnp.float32)

    def __call__(self, deter: Array, stoch: Array, action: Array, tokens: Array) -> Array:
        """Touches every parameter once, for initialisation."""
        blocks = self.gru.to_blocks(deter)
        blocks = self.gru(blocks, deter, stoch, self.gru.drive(action))
        deter = self.gru.from_blocks(blocks)
        return self.prior(deter) + self.posterior(deter, self.read_tokens(tokens))
