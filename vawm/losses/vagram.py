"""VaGraM: errors of the model's next state, weighted by how much the value depends on them."""

from __future__ import annotations

from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp

Array = jax.Array
Value = Callable[[Array], Array]


def vagram_loss(value: Value, prediction: Array, target: Array) -> Array:
    """Value-gradient-weighted squared error (Voelcker et al., 2022), diagonal form.

        L = sum_j (dV/dx_j)^2 e_j^2,    e = prediction - sg(x),    dV/dx at sg(x)

    n L bounds (grad V . e)^2, the square of the first-order expansion of V(prediction) - V(x),
    where n is the size of x (Cauchy-Schwarz). Unlike that square, L is minimal only if e_j = 0
    for every j with dV/dx_j other than 0 at x: errors in different dims never cancel.

    Args:
      value: maps `[..., n]` to `[...]`, one value per state.
      prediction: `[..., n]` the model's next state.
      target: `[..., n]` x, the true next state, or its encoding.

    Returns:
      `[...]` losses, in squared units of the value. Their gradient reaches only `prediction`:
      the target and dV/dx, and so everything that `value` closes over, are stopped.

    Raises:
      AssertionError: the states have different shapes, or there is not one value per state.
    """
    error, gradient = _error_and_gradient(value, prediction, target)
    return jnp.square(gradient * error).sum(-1)


def vagram_taylor_loss(value: Value, prediction: Array, target: Array) -> Array:
    """Square of the value's first-order error (Voelcker et al., 2022).

        L = (grad V . e)^2,    e = prediction - sg(x),    grad V at sg(x)

    L is zero on the whole hyperplane grad V . e = 0, however large e is. A prediction can
    drift along it without bound, to states where the expansion is not valid. `vagram_loss`
    has no such directions except those along which V is flat at x.

    Args:
      value: maps `[..., n]` to `[...]`, one value per state.
      prediction: `[..., n]` the model's next state.
      target: `[..., n]` x, the true next state, or its encoding.

    Returns:
      `[...]` losses, in squared units of the value. As in `vagram_loss`, their gradient reaches
      only `prediction`.

    Raises:
      AssertionError: the states have different shapes, or there is not one value per state.
    """
    error, gradient = _error_and_gradient(value, prediction, target)
    return jnp.square((gradient * error).sum(-1))


def vagram_second_order_loss(value: Value, prediction: Array, target: Array) -> Array:
    """Bound on the squared error of the value to second order; derived here.

        L = 2 (g . e)^2 + 1/2 (e' H e)^2  >=  (g . e + 1/2 e' H e)^2

    g and H are gradient and Hessian of V at sg(x); e = prediction - sg(x). The right side is
    the square of the second-order expansion of V(prediction) - V(x); the step to L is
    (a + b)^2 <= 2 a^2 + 2 b^2. L is zero if both terms are zero, so it has the drawback of
    `vagram_taylor_loss`: e can grow along g . e = e' H e = 0.

    H e is a Hessian-vector product: no Hessian is built or decomposed. A network of ReLUs has
    H = 0 almost everywhere.

    Args:
      value: maps `[..., n]` to `[...]`, one value per state; it is differentiated twice.
      prediction: `[..., n]` the model's next state.
      target: `[..., n]` x, the true next state, or its encoding.

    Returns:
      `[...]` losses, in squared units of the value. The target and g are stopped. H e is not,
      because it contains `prediction`: the caller stops the critic's parameters.

    Raises:
      AssertionError: the states have different shapes, or there is not one value per state.
    """
    error, gradient = _error_and_gradient(value, prediction, target)
    curvature = (error * _hessian_product(value, target, error)).sum(-1)
    return 2 * jnp.square((gradient * error).sum(-1)) + 0.5 * jnp.square(curvature)


def vagram_joint_loss(value: Value, prediction: Array, target: Array) -> Array:
    """Second order with a diagonal first term: `joint` in the code of Voelcker et al., 2022.

        L = 2 sum_j g_j^2 e_j^2 + 1/2 |H e|^2

    Errors in different dims do not cancel in the first term. With n the size of x, by
    Cauchy-Schwarz in both terms (derived here)

        max(n, |e|^2) L  >=  (g . e + 1/2 e' H e)^2

    L is zero only for errors in dims with g_j = 0 that H maps to 0. Symbols are those of
    `vagram_second_order_loss`; the first term is twice `vagram_loss`.

    Args:
      value: maps `[..., n]` to `[...]`, one value per state; it is differentiated twice.
      prediction: `[..., n]` the model's next state.
      target: `[..., n]` x, the true next state, or its encoding.

    Returns:
      `[...]` losses. The first term is in squared units of the value, the second also per
      squared unit of x. The target and g are stopped. H e is not: the caller stops the
      critic's parameters.

    Raises:
      AssertionError: the states have different shapes, or there is not one value per state.
    """
    error, gradient = _error_and_gradient(value, prediction, target)
    curvature = _hessian_product(value, target, error)
    return 2 * jnp.square(gradient * error).sum(-1) + 0.5 * jnp.square(curvature).sum(-1)


def _error_and_gradient(value: Value, prediction: Array, target: Array) -> tuple[Array, Array]:
    """`[..., n]` e and dV/dx at the target; only the prediction in e has a gradient."""
    chex.assert_equal_shape([prediction, target])
    target = jax.lax.stop_gradient(target)
    return prediction - target, jax.lax.stop_gradient(_gradient(value)(target))


def _hessian_product(value: Value, target: Array, error: Array) -> Array:
    """`[..., n]` H e with the Hessian at sg(target)."""
    target = jax.lax.stop_gradient(target)
    return jax.jvp(_gradient(value), (target,), (error,))[1]


def _gradient(value: Value) -> Value:
    """Maps `[..., n]` to the gradient of each value: that of the sum, as states do not mix."""

    def total(x: Array) -> Array:
        values = value(x)
        chex.assert_shape(values, x.shape[:-1])
        return values.sum()

    return jax.grad(total)
