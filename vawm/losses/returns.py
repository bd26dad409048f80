"""Lambda-returns of imagination and of replay, and the scale that normalises advantages."""

from __future__ import annotations

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

Array = jax.Array


def lambda_returns(
    reward: Array,
    discount: Array,
    value: Array,
    bootstrap: Array | None = None,
    *,
    lambda_: float,
) -> Array:
    """Bootstrapped lambda-returns, Eq. 7.

        R_t = r_{t+1} + d_{t+1} * ((1 - lambda) * v_{t+1} + lambda * R_{t+1})

    All three inputs are indexed by arrival: entry k belongs to s_{k+1}, so no
    value of the state being scored ever leaks into its own target. The last
    return bootstraps fully from the last value.

    Args:
      reward: `[H, ...]` rewards r_1..r_H, in environment units (not symlog).
      discount: `[H, ...]` gamma * P(continue) at s_1..s_H, in [0, 1].
      value: `[H, ...]` critic means v_1..v_H, in environment units.
      bootstrap: `[...]` v_H, only if `value` is indexed differently: STORM's official code
        uses v_t instead of v_{t+1}, and passes v_0..v_{H-1} as `value`.
      lambda_: mixing weight; 0 is one-step TD, 1 is Monte Carlo.

    Returns:
      `[H, ...]` returns R_0..R_{H-1}, in environment units. Gradients are not stopped here.

    Raises:
      AssertionError: the shapes differ.
    """
    chex.assert_equal_shape([reward, discount, value])
    last = value[-1] if bootstrap is None else bootstrap
    chex.assert_equal_shape([last, reward[0]])

    def backward(next_return, step):
        r, d, v = step
        r = r + d * ((1 - lambda_) * v + lambda_ * next_return)
        return r, r

    _, returns = jax.lax.scan(backward, last, (reward, discount, value), reverse=True)
    return returns


def replay_returns(
    reward: Array,
    is_last: Array,
    is_terminal: Array,
    bootstrap: Array,
    *,
    discount: float,
    lambda_: float,
) -> Array:
    """Lambda-returns along replayed experience, for the replay value loss; Eq. 7 in replay.

        R_t = r_{t+1} + gamma * (1 - term_{t+1})
              * ((1 - lambda_{t+1}) * b_{t+1} + lambda_{t+1} * R_{t+1})
        lambda_t = lambda * (1 - last_t),   R_{T-1} = b_{T-1}

    As in the official DreamerV3, b_t is the imagined return that starts at s_t, not a critic
    value. A truncated episode bootstraps fully from its last state.

    Args:
      reward: `[B, T]` rewards r_0..r_{T-1}, in environment units; r_0 is not used.
      is_last: `[B, T]` bool, the end of an episode for any reason.
      is_terminal: `[B, T]` bool, the end of the return.
      bootstrap: `[B, T]` imagined returns R_0 of rollouts that start at s_0..s_{T-1}.
      discount: gamma.
      lambda_: mixing weight inside an episode.

    Returns:
      `[B, T - 1]` returns R_0..R_{T-2}, in environment units. Gradients are not stopped here.
      The caller masks t where `is_last`, because another episode follows.

    Raises:
      AssertionError: the shapes are not `[B, T]`, all the same.
    """
    chex.assert_rank(reward, 2)
    chex.assert_equal_shape([reward, is_last, is_terminal, bootstrap])
    mix = lambda_ * (1.0 - is_last.astype(reward.dtype))
    live = discount * (1.0 - is_terminal.astype(reward.dtype))
    # R_t = base_{t+1} + carry_{t+1} * R_{t+1}
    base = reward + live * (1 - mix) * bootstrap
    carry = live * mix

    def backward(next_return, step):
        b, c = step
        r = b + c * next_return
        return r, r

    arriving = (base[:, 1:].T, carry[:, 1:].T)
    _, returns = jax.lax.scan(backward, bootstrap[:, -1], arriving, reverse=True)
    return returns.T


class ReturnScale(NamedTuple):
    """Moving averages of two percentiles of returns, Eq. 9, in environment units."""

    low: Array  # [] float32
    high: Array  # [] float32


def init_return_scale() -> ReturnScale:
    """The averages of Eq. 9 before the first update.

    Returns:
      `ReturnScale` with both percentiles 0, each `[]`; without bias correction, as in the
      official DreamerV3.
    """
    return ReturnScale(low=jnp.zeros((), jnp.float32), high=jnp.zeros((), jnp.float32))


def update_return_scale(
    state: ReturnScale, returns: Array, *, decay: float, low: float, high: float
) -> ReturnScale:
    """Moves towards the percentiles of a batch of returns, Eq. 9. Update before use.

        Per <- decay * Per + (1 - decay) * quantile(R),  for both fractions

    Args:
      state: the averages so far.
      returns: `[...]` all returns of the batch, pooled, in environment units.
      decay: share of the old average that is kept.
      low: lower fraction, such as 0.05.
      high: upper fraction, such as 0.95.

    Returns:
      `ReturnScale` of `[]` averages, in environment units. The returns are stopped.
    """
    returns = jax.lax.stop_gradient(returns)
    now = jnp.quantile(returns, jnp.array([low, high], returns.dtype))
    now = now.astype(state.low.dtype)
    return ReturnScale(
        low=decay * state.low + (1 - decay) * now[0],
        high=decay * state.high + (1 - decay) * now[1],
    )


def return_scale(state: ReturnScale, *, limit: float) -> Array:
    """The divisor of advantages, Eq. 9; with limit 1 it never enlarges them.

        S = max(limit, high - low)

    Args:
      state: the averages, after their update.
      limit: the smallest S, in environment units.

    Returns:
      `[]` S, in environment units. Nothing is stopped here; updates are stopped.
    """
    return jnp.maximum(limit, state.high - state.low)
