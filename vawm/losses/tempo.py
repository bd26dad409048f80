"""TEMPO: learns the weight of each sample of a likelihood loss for the task."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import chex
import jax

Array = jax.Array
PyTree = Any


def tempo_meta_gradient(
    sample_losses: Callable[[PyTree], Array],
    weights: Callable[[PyTree], Array],
    task_loss: Callable[[PyTree], Array],
    params: PyTree,
    weight_params: PyTree,
    *,
    step_size: float,
) -> tuple[Array, PyTree]:
    """Gradient of the task loss after one step of the weighted model (Yuan et al., 2023).

        theta' = theta - step_size * grad_theta sum_i w_i(phi) L_i(theta)
        gradient = d L_task(theta'(phi)) / d phi
                 = -step_size * sum_i <grad L_task(theta'), grad L_i(theta)> dw_i / dphi

    A sample gains weight if learning from it also lowers the task loss.

    Known about the original: a network phi gives the weights of the samples of the likelihood
    loss; the problem is bi-level, with phi at the upper level, judged by a task-aware loss of
    the lower-level model after one unrolled step. Our reading: that step is plain gradient
    descent, and the weights enter as a sum. The caller chooses their normalisation (`weights`
    returns them as they enter) and the task loss, for example the divergence of values under
    prior and posterior, as in `value_alignment_loss`.

    Nothing is updated here: the caller steps phi along the gradient, then theta with weights
    w_i(phi), by its own optimisers. theta is held fixed and the inner gradient is linear in
    the weights, so L_i needs no second derivative: a `custom_vjp` without one is enough.

    Args:
      sample_losses: maps theta to `[...]` L_i, one per sample, of one batch.
      weights: maps phi to `[...]` w_i, of the same shape.
      task_loss: maps theta' to `[]` L_task, usually of another batch.
      params: theta, the model's parameters.
      weight_params: phi, the parameters of the weights.
      step_size: of the unrolled step.

    Returns:
      `[]` L_task(theta') in its own units, and its gradient, a tree like `weight_params`.
      Only phi is differentiated, so a critic in `task_loss` gets no gradient, stopped or not.

    Raises:
      AssertionError: losses and weights have different shapes, or L_task is not a scalar.

    Examples:
      A line through 0 and three samples; the last one leads away from the task's slope 2. The
      network of the weights has one layer and reads the samples.

      >>> import jax, jax.numpy as jnp
      >>> from vawm import losses
      >>> x, y = jnp.array([1.0, 2.0, 3.0]), jnp.array([2.0, 4.0, 0.0])
      >>> def sample_losses(theta):
      ...     return jnp.square(theta * x - y)
      >>> def weights(phi):
      ...     return jax.nn.softmax(x * phi["x"] + y * phi["y"])
      >>> def task_loss(theta):
      ...     return jnp.square(theta - 2.0)
      >>> theta, phi = jnp.array(1.0), {"x": jnp.array(0.0), "y": jnp.array(0.0)}
      >>> loss, gradient = losses.tempo_meta_gradient(
      ...     sample_losses, weights, task_loss, theta, phi, step_size=0.1
      ... )
      >>> print(f"{loss:.4f} {gradient['x']:.4f} {gradient['y']:.4f}")
      1.6044 1.6889 -4.3911

      Then both learn, the weights first: less weight for large x, more for large y.

      >>> phi = jax.tree.map(lambda p, g: p - 0.1 * g, phi, gradient)
      >>> step = jax.grad(lambda theta: (weights(phi) * sample_losses(theta)).sum())(theta)
      >>> theta = theta - 0.1 * step
    """

    def weighted_loss(params: PyTree, weight_params: PyTree) -> Array:
        each, weight = sample_losses(params), weights(weight_params)
        chex.assert_equal_shape([each, weight])
        return (weight * each).sum()

    def after_one_step(weight_params: PyTree) -> Array:
        gradient = jax.grad(weighted_loss)(params, weight_params)
        updated = jax.tree.map(lambda p, g: p - step_size * g, params, gradient)
        loss = task_loss(updated)
        chex.assert_rank(loss, 0)
        return loss

    return jax.value_and_grad(after_one_step)(weight_params)
