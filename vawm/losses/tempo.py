"""TEMPO: learn how much each sample of a likelihood loss should weigh for the task."""

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

    A sample gains weight where learning from it also lowers the task loss.

    Known of the original: weights from a network phi for the samples of the likelihood loss; a
    bi-level problem, with phi above, judged by a task-aware loss of the model below; one
    unrolled step in between. Our reading: that step is plain gradient descent, the weights
    enter as a sum, and how they are normalised and what the task loss is stay with the
    caller: `weights` returns them as they enter, and `task_loss` may be the divergence of
    values under prior and posterior, as in `value_alignment_loss`.

    Nothing is updated here: the caller steps phi along the gradient, then theta with weights
    w_i(phi), by its own optimisers. The inner gradient is differentiated, so L_i needs a
    second derivative: a `custom_vjp` without one will not do.

    Args:
      sample_losses: maps theta to `[...]` L_i, one per sample, of one batch.
      weights: maps phi to `[...]` w_i, of the same shape.
      task_loss: maps theta' to `[]` L_task, usually of another batch.
      params: theta, the model's parameters.
      weight_params: phi, the parameters of the weights.
      step_size: of the unrolled step.

    Returns:
      `[]` L_task(theta') and its gradient, a tree like `weight_params`. Nothing but phi is
      differentiated, so a critic in `task_loss` is left as it is, stopped or not.
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
