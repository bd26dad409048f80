"""Losses along an unrolled model: float64 twins, cases by hand, and gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vawm import losses
from vawm.losses import returns

lambda_ac_loss = jax.jit(losses.lambda_ac_loss)
muzero_value_loss = jax.jit(losses.muzero_value_loss)
n_step_returns = jax.jit(losses.n_step_returns, static_argnames="steps")


def batch(steps, shape=(4, 3)):
    """Values, targets, and a mask that ends some episodes early."""
    rng = np.random.default_rng(0)
    end = rng.integers(1, steps + 1, size=shape)
    mask = np.arange(steps).reshape(-1, *[1] * len(shape)) < end
    values, targets = rng.normal(size=(2, steps, *shape))
    return tuple(jnp.asarray(x, jnp.float32) for x in (values, targets, mask))


@pytest.mark.parametrize(
    ("loss", "weights"),
    [(lambda_ac_loss, [1] * 5), (muzero_value_loss, [1] + [1 / 4] * 4)],
)
@pytest.mark.parametrize("shape", [(), (4, 3)])
def test_losses_match_their_sums(loss, weights, shape):
    values, targets, mask = (np.asarray(x, np.float64) for x in batch(5, shape))
    actual = np.asarray(loss(*batch(5, shape)))
    assert actual.shape == shape
    for i in np.ndindex(shape):
        expected = 0.0
        for j, weight in enumerate(weights):
            if mask[j, *i]:
                expected += weight * (values[j, *i] - targets[j, *i]) ** 2
        np.testing.assert_allclose(actual[i], expected, rtol=1e-5)


def test_losses_by_hand():
    values, targets = jnp.array([1.0, 2.0, 5.0]), jnp.array([3.0, 1.0, 1.0])
    mask = jnp.array([1.0, 1.0, 1.0])
    assert losses.lambda_ac_loss(values, targets, mask) == 4 + 1 + 16
    assert losses.muzero_value_loss(values, targets, mask) == 4 + (1 + 16) / 2
    mask = jnp.array([1.0, 1.0, 0.0])
    assert losses.lambda_ac_loss(values, targets, mask) == 4 + 1
    assert losses.muzero_value_loss(values, targets, mask) == 4 + 1 / 2


def test_a_muzero_that_does_not_unroll_learns_the_value_of_the_encoded_state():
    one = jnp.ones((1, 2))
    np.testing.assert_array_equal(losses.muzero_value_loss(3 * one, one, one), [4.0, 4.0])


@pytest.mark.parametrize("loss", [lambda_ac_loss, muzero_value_loss])
def test_losses_move_only_the_values_within_the_episode(loss):
    values, targets, mask = batch(5)
    gradient = jax.grad(lambda *x: loss(*x).sum(), argnums=(0, 1, 2))
    to_values, to_targets, to_mask = jax.jit(gradient)(values, targets, mask)
    np.testing.assert_array_equal(to_targets, np.zeros_like(targets))
    np.testing.assert_array_equal(to_mask, np.zeros_like(mask))
    assert ((np.abs(to_values) > 0) == (mask > 0)).all()


def linear_losses(loss, critic, model):
    """A critic V(z) = critic . z on latents z^_j = model^j z_0, against fixed targets."""
    latents = [jnp.array([1.0, -2.0])]
    for _ in range(2):
        latents.append(model @ latents[-1])
    values = jnp.stack(latents) @ critic
    return loss(values, jnp.array([1.0, 0.0, 2.0]), jnp.ones(3))


@pytest.mark.parametrize("loss", [lambda_ac_loss, muzero_value_loss])
@pytest.mark.parametrize("anything", [np.nan, np.inf])
def test_masked_entries_may_be_anything(loss, anything):
    values, targets, mask = (jnp.asarray(x) for x in batch(5))
    assert (mask == 0).any()
    spoiled = jnp.where(mask == 0, anything, values)
    run = jax.value_and_grad(lambda x: loss(x, targets, mask).sum())
    for actual, expected in zip(run(spoiled), run(values), strict=True):
        np.testing.assert_array_equal(actual, expected)


def test_muzero_trains_model_and_critic():
    gradient = jax.grad(linear_losses, argnums=(1, 2))
    to_critic, to_model = gradient(
        losses.muzero_value_loss, jnp.array([0.5, 1.0]), jnp.array([[1.0, 0.5], [-0.5, 1.0]])
    )
    assert (np.abs(to_critic) > 0).all()
    assert (np.abs(to_model) > 0).all()


def test_lambda_ac_leaves_a_stopped_critic_alone():
    def loss(critic, model):
        return linear_losses(losses.lambda_ac_loss, jax.lax.stop_gradient(critic), model)

    to_critic, to_model = jax.grad(loss, argnums=(0, 1))(
        jnp.array([0.5, 1.0]), jnp.array([[1.0, 0.5], [-0.5, 1.0]])
    )
    np.testing.assert_array_equal(to_critic, np.zeros(2))
    assert (np.abs(to_model) > 0).all()


@pytest.mark.parametrize("loss", [losses.lambda_ac_loss, losses.muzero_value_loss])
def test_losses_refuse_a_target_too_many(loss):
    values, targets, mask = batch(5)
    with pytest.raises(AssertionError):
        loss(values[:-1], targets, mask[:-1])
    with pytest.raises(AssertionError):
        loss(values, targets, mask[:1])


def experience(steps, shape=(4,)):
    rng = np.random.default_rng(1)
    reward, value = rng.normal(size=(2, steps, *shape))
    discount = 0.99 * (rng.random((steps, *shape)) < 0.8)
    return tuple(jnp.asarray(x, jnp.float32) for x in (reward, discount, value))


@pytest.mark.parametrize("steps", [1, 3, 6])
def test_n_step_returns_match_their_sum(steps):
    reward, discount, value = (np.asarray(x, np.float64) for x in experience(6))
    actual = np.asarray(n_step_returns(*experience(6), steps=steps))
    assert actual.shape == (6 - steps + 1, 4)
    for t, i in np.ndindex(actual.shape):
        expected, reached = 0.0, 1.0
        for k in range(t, t + steps):
            expected += reached * reward[k, i]
            reached *= discount[k, i]
        expected += reached * value[t + steps - 1, i]
        np.testing.assert_allclose(actual[t, i], expected, rtol=1e-4, atol=1e-6)


def test_n_step_returns_by_hand():
    reward, value = jnp.array([1.0, 10.0, 100.0]), jnp.array([7.0, 8.0, 9.0])
    discount = jnp.array([0.5, 0.0, 0.5])  # s_2 is terminal
    np.testing.assert_allclose(
        losses.n_step_returns(reward, discount, value, steps=1), [4.5, 10.0, 104.5]
    )
    np.testing.assert_allclose(
        losses.n_step_returns(reward, discount, value, steps=2), [6.0, 10.0]
    )


def test_n_step_returns_are_the_ends_of_lambda_returns():
    one = returns.lambda_returns(*experience(6), lambda_=0.0)
    whole = returns.lambda_returns(*experience(6), lambda_=1.0)[:1]
    for steps, expected in [(1, one), (6, whole)]:
        actual = n_step_returns(*experience(6), steps=steps)
        np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("steps", [0, 7])
def test_n_step_returns_refuse_more_steps_than_there_are(steps):
    with pytest.raises(ValueError, match=f"steps={steps}: .*6"):
        losses.n_step_returns(*experience(6), steps=steps)


@pytest.mark.parametrize("late", [0, 1, 2])
def test_n_step_returns_refuse_a_step_too_few_in_any_of_their_inputs(late):
    inputs = [x[1:] if i == late else x for i, x in enumerate(experience(6))]
    with pytest.raises(AssertionError):
        losses.n_step_returns(*inputs, steps=1)


def test_scaling_a_gradient_does_not_change_the_values():
    x = 10.0 ** jnp.arange(-20.0, 20.0)
    value, pullback = jax.vjp(lambda x: losses.scale_gradient(x, scale=0.3), x)
    np.testing.assert_array_equal(value, x)
    np.testing.assert_allclose(pullback(jnp.arange(40.0))[0], 0.3 * np.arange(40), rtol=1e-6)


def test_gradients_pass_through_n_step_returns():
    reward, discount, value = jnp.array([1.0, 2.0]), jnp.array([0.5, 0.25]), jnp.ones(2)
    first = lambda *x: n_step_returns(*x, steps=2)[0]  # noqa: E731
    to_reward, to_discount, to_value = jax.grad(first, argnums=(0, 1, 2))(
        reward, discount, value
    )
    # y_0 = r_1 + d_1 (r_2 + d_2 v_2)
    np.testing.assert_allclose(to_reward, [1.0, 0.5])
    np.testing.assert_allclose(to_discount, [2.25, 0.5])
    np.testing.assert_allclose(to_value, [0.0, 0.125])


@pytest.mark.parametrize("shape", [(7,), (4, 3, 7)])
def test_consistency_matches_its_sum(shape):
    prediction, target = np.random.default_rng(0).normal(size=(2, *shape))
    as_float32 = (jnp.asarray(x, jnp.float32) for x in (prediction, target))
    actual = np.asarray(jax.jit(losses.latent_consistency_loss)(*as_float32))
    assert actual.shape == shape[:-1]
    for i in np.ndindex(shape[:-1]):
        twin = sum((p - t) ** 2 for p, t in zip(prediction[i], target[i], strict=True))
        np.testing.assert_allclose(actual[i], twin, rtol=1e-5)


def test_consistency_is_the_squared_distance_and_stops_its_target():
    prediction, target = (
        jnp.array([[1.0, 2.0], [0.0, 0.0]]),
        jnp.array([[3.0, 1.0], [0.0, 2.0]]),
    )
    np.testing.assert_allclose(losses.latent_consistency_loss(prediction, target), [5.0, 4.0])
    gradient = jax.grad(lambda *x: losses.latent_consistency_loss(*x).sum(), argnums=(0, 1))
    to_prediction, to_target = gradient(prediction, target)
    np.testing.assert_allclose(to_prediction, [[-4.0, 2.0], [0.0, -4.0]])
    np.testing.assert_array_equal(to_target, np.zeros((2, 2)))
    with pytest.raises(AssertionError):
        losses.latent_consistency_loss(prediction, target[:1])


@pytest.mark.parametrize("loss", [lambda_ac_loss, muzero_value_loss])
def test_jit_equals_eager(loss):
    np.testing.assert_allclose(loss(*batch(5)), loss.__wrapped__(*batch(5)), rtol=1e-5)
