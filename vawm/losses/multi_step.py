"""Value-aware losses along a model unrolled for several steps, with their helpers."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp

Array = jax.Array


def lambda_ac_loss(prediction_values: Array, target_values: Array, mask: Array) -> Array:
    """Multi-step IterVAML of a deterministic latent model: lambda-AC (Voelcker et al., 2023).

        L = sum_j mask_j (V(z^_j) - sg V(phi(x_j)))^2

    z^_j is the model's latent after j steps from an encoded state, and phi(x_j) the encoded
    latent of the observation. The original trains V separately, and adds a reward loss and
    `latent_consistency_loss`.

    Args:
      prediction_values: `[H, ...]` V at z^_1..z^_H.
      target_values: `[H, ...]` V at phi(x_1)..phi(x_H), by the same critic.
      mask: `[H, ...]` 1 if x_j belongs to the episode that the rollout started in, else 0.

    Returns:
      `[...]` losses, in squared units of the values. Targets and mask are stopped; the caller
      stops the critic's parameters.

    Raises:
      AssertionError: the shapes differ.
    """
    chex.assert_equal_shape([prediction_values, target_values, mask])
    return _masked_squares(prediction_values, target_values, mask).sum(0)


def muzero_value_loss(values: Array, returns: Array, mask: Array) -> Array:
    """Value loss of MuZero (Schrittwieser et al., 2020), with squared errors.

        L = mask_0 (v_0 - sg y_0)^2 + 1/K sum_{k=1..K} mask_k (v_k - sg y_k)^2

    v_0 is the value of the encoded state, and v_k that after the model was unrolled for k
    steps; y_k is bootstrapped from experience, by `n_step_returns`. The weights 1/K are the
    original's scaling of gradients by 1/K at each head. The original also halves gradients at
    the input of the dynamics: `scale_gradient(latent, scale=0.5)` before each step. Its reward
    and policy losses are not included. For a categorical critic it uses the cross-entropy
    `vawm.losses.transforms.two_hot_cross_entropy` to the same returns instead.

    The critic is NOT frozen: this loss trains both model and critic. In a stochastic
    environment its minimum is not at the true model. The original trains on absorbing states
    after an episode's end, with values of 0; here `mask` leaves them out.

    Args:
      values: `[K + 1, ...]` v_0..v_K.
      returns: `[K + 1, ...]` y_0..y_K, from a slow critic or the current one.
      mask: `[K + 1, ...]` 1 if x_k belongs to the episode that the unroll started in, else 0.

    Returns:
      `[...]` losses, in squared units of the values. Returns and mask are stopped.

    Raises:
      AssertionError: the shapes differ.
    """
    chex.assert_equal_shape([values, returns, mask])
    errors = _masked_squares(values, returns, mask)
    return errors[0] + errors[1:].sum(0) / max(1, len(values) - 1)


def n_step_returns(reward: Array, discount: Array, value: Array, *, steps: int) -> Array:
    """Returns of n steps of experience, bootstrapped with a value (Schrittwieser et al., 2020).

        y_t = r_{t+1} + d_{t+1} (r_{t+2} + ... + d_{t+n-1} (r_{t+n} + d_{t+n} v_{t+n}))

    As in `vawm.losses.returns.lambda_returns`, all three are indexed by arrival: entry k
    belongs to s_{k+1}.

    Args:
      reward: `[T, ...]` r_1..r_T, in any unit.
      discount: `[T, ...]` gamma at s_1..s_T, 0 if terminal. A window must not extend beyond a
        time limit, because rewards of the next episode would count.
      value: `[T, ...]` v_1..v_T, in the units of the reward.
      steps: n, from 1 to T.

    Returns:
      `[T - n + 1, ...]` y_0..y_{T-n}, in the units of the reward. Gradients are not stopped
      here.

    Raises:
      ValueError: `steps` outside 1..T.
      AssertionError: the shapes differ.
    """
    chex.assert_equal_shape([reward, discount, value])
    if not 1 <= steps <= len(reward):
        raise ValueError(f"steps={steps}: use a number from 1 to {len(reward)}, the arrivals")
    count = len(reward) - steps + 1
    returns = value[steps - 1 :]
    for k in reversed(range(steps)):
        returns = reward[k : k + count] + discount[k : k + count] * returns
    return returns


def scale_gradient(x: Array, *, scale: float) -> Array:
    """The identity with a scaled gradient (Schrittwieser et al., 2020).

        y = sg x + scale * (x - sg x)

    Args:
      x: `[...]` of any unit.
      scale: factor of the gradient; 1/2 in MuZero, before each step of the model.

    Returns:
      `[...]` exactly x if it is finite.
    """
    stopped = jax.lax.stop_gradient(x)
    return stopped + scale * (x - stopped)


def latent_consistency_loss(prediction: Array, target: Array) -> Array:
    """Squared distance of a predicted latent to the encoded one, summed over its dims.

        L = |z^_j - sg phi(x_j)|^2

    lambda-AC (Voelcker et al., 2023) adds it to keep latents from drifting where the critic
    does not depend on them; phi is then a slow copy of the encoder, as in BYOL.

    Args:
      prediction: `[..., D]` latents of the model.
      target: `[..., D]` latents of the (slow) encoder at the same steps.

    Returns:
      `[...]` losses, in squared units of the latents. The target is stopped.

    Raises:
      AssertionError: the shapes differ.
    """
    chex.assert_equal_shape([prediction, target])
    return jnp.square(prediction - jax.lax.stop_gradient(target)).sum(-1)


def _masked_squares(values: Array, targets: Array, mask: Array) -> Array:
    """`[H, ...]` squared errors, 0 where masked; only the values have a gradient."""
    targets, mask = jax.lax.stop_gradient((targets, mask))
    # Masked errors may be anything, so they are replaced by 0 before squaring.
    return mask * jnp.square(jnp.where(mask == 0, 0.0, values - targets))
