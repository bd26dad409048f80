"""Prediction and dynamics losses against float64 twins, and by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from transforms_twin import slow_log_softmax, slow_two_hot

from vawm import losses
from vawm.losses import transforms

BINS = transforms.symexp_bins(41)
KL = {"unimix": 0.01, "free_nats": 1.0, "dynamics_scale": 1.0, "representation_scale": 0.1}


def slow_kl(post_logits, prior_logits, unimix):
    """`[...]` KL of unimixed categoricals, summed over the last two axes."""

    def probs(logits):
        p = np.exp(slow_log_softmax(logits))
        return (1 - unimix) * p + unimix / p.shape[-1]

    q, p = probs(post_logits), probs(prior_logits)
    return (q * np.log(q / p)).sum((-2, -1))


balanced_kl = jax.jit(losses.balanced_kl, static_argnames="unimix")
dynamics_loss = jax.jit(losses.dynamics_loss, static_argnames=tuple(KL))
batch_dynamics_loss = jax.jit(losses.batch_dynamics_loss, static_argnames=tuple(KL))
prediction_loss = jax.jit(losses.prediction_loss, static_argnames="discount")


def logits(scale, shape=(2, 3, 4, 5)):
    return scale * jax.random.normal(jax.random.key(0), (2, *shape))


def gradients(post, prior, **numbers):
    loss = lambda q, p: dynamics_loss(q, p, **numbers)[0].sum()  # noqa: E731
    return jax.jit(jax.grad(loss, argnums=(0, 1)))(post, prior)


@pytest.mark.parametrize("scale", [0.1, 3.0])
@pytest.mark.parametrize("unimix", [0.0, 0.01, 0.5])
def test_both_terms_of_the_balance_match_their_twin(scale, unimix):
    post, prior = logits(scale)
    for term in balanced_kl(post, prior, unimix=unimix):
        twin = slow_kl(post, prior, unimix)
        np.testing.assert_allclose(term, twin, rtol=1e-4, atol=1e-6)


def fair_and_loaded():
    """Three coins each at two states: fair against one in ten, and fair against fair."""
    post = jnp.zeros((2, 3, 2))
    return post, post.at[0].set(jnp.log(jnp.array([0.1, 0.9])))


# Half of log(5) and half of log(5/9), for each of the three coins.
THREE_COINS = 3 * 0.5 * (np.log(5) + np.log(5 / 9))


def test_balance_by_hand():
    for term in losses.balanced_kl(*fair_and_loaded(), unimix=0.0):
        np.testing.assert_allclose(term, [THREE_COINS, 0.0], rtol=1e-6)
    # Half of the mass mixed in evenly makes of one in ten three in ten.
    mixed = 3 * 0.5 * (np.log(5 / 3) + np.log(5 / 7))
    for term in losses.balanced_kl(*fair_and_loaded(), unimix=0.5):
        np.testing.assert_allclose(term, [mixed, 0.0], rtol=1e-5)


@pytest.mark.parametrize(("term", "moved"), [(0, "prior"), (1, "posterior")])
def test_each_term_of_the_balance_moves_its_own_side(term, moved):
    loss = lambda q, p: balanced_kl(q, p, unimix=0.01)[term].sum()  # noqa: E731
    to_post, to_prior = jax.jit(jax.grad(loss, argnums=(0, 1)))(*logits(3.0))
    to_own, to_other = (to_prior, to_post) if moved == "prior" else (to_post, to_prior)
    assert (np.abs(to_own).sum(-1) > 0).all()
    np.testing.assert_array_equal(to_other, np.zeros_like(to_other))


def test_balance_refuses_a_prior_of_another_shape():
    with pytest.raises(AssertionError):
        losses.balanced_kl(jnp.zeros((2, 3, 4, 5)), jnp.zeros((2, 1, 4, 5)), unimix=0.01)


def test_dynamics_losses_by_hand():
    numbers = KL | {"unimix": 0.0, "free_nats": 0.5}
    loss, kl = dynamics_loss(*fair_and_loaded(), **numbers)
    np.testing.assert_allclose(kl, [THREE_COINS, 0.0], rtol=1e-6)
    np.testing.assert_allclose(loss, [1.1 * THREE_COINS, 1.1 * 0.5], rtol=1e-6)
    loss, kl = batch_dynamics_loss(*fair_and_loaded(), **numbers)
    np.testing.assert_allclose(kl, [THREE_COINS, 0.0], rtol=1e-6)
    np.testing.assert_allclose(loss, 1.1 * THREE_COINS / 2, rtol=1e-6)


@pytest.mark.parametrize("scale", [0.1, 3.0, 100.0])
@pytest.mark.parametrize("unimix", [0.01, 0.5])
def test_dynamics_loss_matches_its_twin(scale, unimix):
    post, prior = logits(scale)
    loss, kl = dynamics_loss(post, prior, **KL | {"unimix": unimix})
    twin = slow_kl(post, prior, unimix)
    np.testing.assert_allclose(kl, twin, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(loss, 1.1 * np.maximum(1, twin), rtol=1e-4)


def test_free_nats_are_applied_after_the_sum_and_at_each_state():
    # 32 categoricals of 0.1 nats each: 3.2 in total, although each alone is below 1.
    post = jnp.tile(jnp.array([0.7375, 0.0]), (2, 32, 1))
    post = post.at[1].set(0.0)
    loss, kl = dynamics_loss(post, jnp.zeros_like(post), **KL | {"unimix": 0.0})
    assert kl[0] > 1.0
    assert kl[0] / 32 < 1.0
    np.testing.assert_allclose(loss, [1.1 * kl[0], 1.1], rtol=1e-6)
    assert kl[1] == 0


def test_dynamics_term_moves_only_the_prior():
    post, prior = logits(3.0)
    to_post, to_prior = gradients(post, prior, **KL | {"representation_scale": 0.0})
    np.testing.assert_array_equal(to_post, np.zeros_like(post))
    assert (np.abs(to_prior) > 0).any()


def test_representation_term_moves_only_the_posterior():
    post, prior = logits(3.0)
    to_post, to_prior = gradients(post, prior, **KL | {"dynamics_scale": 0.0})
    np.testing.assert_array_equal(to_prior, np.zeros_like(prior))
    assert (np.abs(to_post) > 0).any()


def test_below_the_free_nats_there_is_no_gradient():
    post, prior = logits(0.05)
    for gradient in gradients(post, prior, **KL):
        np.testing.assert_array_equal(gradient, np.zeros_like(post))


def test_reported_kl_has_no_gradient():
    post, prior = logits(3.0)
    kl = lambda q, p: dynamics_loss(q, p, **KL)[1].sum()  # noqa: E731
    for gradient in jax.jit(jax.grad(kl, argnums=(0, 1)))(post, prior):
        np.testing.assert_array_equal(gradient, np.zeros_like(post))


def batch_gradients(post, prior, **numbers):
    loss = lambda q, p: batch_dynamics_loss(q, p, **numbers)[0]  # noqa: E731
    return jax.jit(jax.grad(loss, argnums=(0, 1)))(post, prior)


@pytest.mark.parametrize("scale", [0.1, 3.0])
@pytest.mark.parametrize("unimix", [0.01, 0.5])
def test_batch_dynamics_loss_matches_its_twin(scale, unimix):
    post, prior = logits(scale)
    loss, kl = batch_dynamics_loss(post, prior, **KL | {"unimix": unimix})
    twin = slow_kl(post, prior, unimix)
    assert loss.shape == ()
    np.testing.assert_allclose(kl, twin, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(loss, 1.1 * max(1, twin.mean()), rtol=1e-4)


def far_off(state):
    """Posteriors equal to priors except in one state, whose KL is about 3.2 nats."""
    post = jnp.zeros((8, 32, 2))
    return post.at[state, :, 0].set(0.9), jnp.zeros_like(post)


def test_below_the_free_nats_of_a_batch_no_state_has_a_gradient():
    post, prior = far_off(3)
    loss, kl = batch_dynamics_loss(post, prior, **KL)
    assert kl[3] > KL["free_nats"] > kl.mean()
    np.testing.assert_allclose(loss, 1.1, rtol=1e-6)
    for gradient in batch_gradients(post, prior, **KL):
        np.testing.assert_array_equal(gradient, np.zeros_like(post))
    # Of each state, DreamerV3's, the same free nats leave that state its gradient.
    for gradient in gradients(post, prior, **KL):
        assert (gradient[3] != 0).all()
        np.testing.assert_array_equal(np.delete(gradient, 3, 0), 0.0)


def test_above_the_free_nats_of_a_batch_every_state_has_its_gradient():
    """The gradient of the mean KL: also for a state whose own KL is below."""
    post, prior = logits(3.0)
    post = post.at[0, 0].set(0.1 * post[0, 0])
    prior = prior.at[0, 0].set(0.1 * prior[0, 0])
    _, kl = batch_dynamics_loss(post, prior, **KL)
    assert kl[0, 0] < KL["free_nats"] < kl.mean()
    actual = batch_gradients(post, prior, **KL)
    count = kl.size
    expected = gradients(post, prior, **KL | {"free_nats": 0.0})
    for a, e in zip(actual, expected, strict=True):
        assert (np.abs(a[0, 0]) > 0).any()
        np.testing.assert_allclose(a, e / count, rtol=1e-5, atol=1e-8)


def test_each_term_of_the_batch_moves_its_own_side():
    post, prior = logits(3.0)
    to_post, to_prior = batch_gradients(post, prior, **KL | {"representation_scale": 0.0})
    np.testing.assert_array_equal(to_post, np.zeros_like(post))
    assert (np.abs(to_prior) > 0).any()
    to_post, to_prior = batch_gradients(post, prior, **KL | {"dynamics_scale": 0.0})
    np.testing.assert_array_equal(to_prior, np.zeros_like(prior))
    assert (np.abs(to_post) > 0).any()


def test_batch_dynamics_loss_refuses_a_prior_of_another_shape():
    with pytest.raises(AssertionError):
        batch_dynamics_loss(jnp.zeros((2, 3, 4, 5)), jnp.zeros((2, 1, 4, 5)), **KL)


def test_dynamics_loss_is_finite_at_certainty():
    post, prior = 1e6 * jnp.eye(5)[:2].reshape(2, 1, 1, 5)
    loss, _ = dynamics_loss(post, prior, **KL)
    assert np.isfinite(loss).all()
    for gradient in gradients(post, prior, **KL):
        assert np.isfinite(gradient).all()


def test_dynamics_loss_refuses_a_prior_of_another_shape():
    with pytest.raises(AssertionError):
        dynamics_loss(jnp.zeros((2, 3, 4, 5)), jnp.zeros((2, 1, 4, 5)), **KL)


def test_symlog_mse_by_hand():
    target = jnp.array([[0.0, np.e - 1, 1 - np.e**2]])
    actual = losses.symlog_mse(jnp.array([[1.0, 1.0, 1.0]]), target)
    np.testing.assert_allclose(actual, [1 + 0 + 9], rtol=1e-6)


def test_image_mse_by_hand():
    target = jnp.array([0, 255, 51], jnp.uint8).reshape(1, 1, 1, 3)
    prediction = jnp.array([1.0, 1.0, 0.0]).reshape(1, 1, 1, 3)
    np.testing.assert_allclose(losses.image_mse(prediction, target), [1.04], rtol=1e-6)


def test_the_two_mean_squares_stop_nothing():
    target, prediction = jnp.array([[1 - np.e**2, np.e - 1]]), jnp.array([[1.0, 3.0]])
    to_prediction, to_target = jax.grad(lambda *x: losses.symlog_mse(*x).sum(), argnums=(0, 1))(
        prediction, target
    )
    np.testing.assert_allclose(to_prediction, [[6.0, 4.0]], rtol=1e-6)
    # d symlog(x) / dx is 1 / (1 + |x|).
    np.testing.assert_allclose(to_target, [[-6.0 / np.e**2, -4.0 / np.e]], rtol=1e-5)
    pixel = jnp.array([0.25]).reshape(1, 1, 1, 1)
    byte = jnp.array([255], jnp.uint8).reshape(1, 1, 1, 1)
    gradient = jax.grad(lambda x: losses.image_mse(x, byte).sum())(pixel)
    np.testing.assert_allclose(gradient.ravel(), [-1.5], rtol=1e-6)


@pytest.mark.parametrize("logit", [-100.0, -1.0, 0.0, 3.0, 100.0])
@pytest.mark.parametrize("target", [0.0, 0.997, 1.0])
def test_continue_loss_is_soft_cross_entropy(logit, target):
    x = np.float64(logit)
    twin = target * np.logaddexp(0, -x) + (1 - target) * np.logaddexp(0, x)
    actual = losses.continue_loss(jnp.array(logit), jnp.array(target))
    np.testing.assert_allclose(actual, twin, rtol=1e-4, atol=1e-5)


def test_continue_loss_is_least_at_the_target():
    gradient = jax.grad(losses.continue_loss)(jnp.log(332.0), jnp.array(332 / 333))
    assert gradient == pytest.approx(0.0, abs=1e-6)


def heads_and_targets(obs):
    """Predictions and targets of 2 x 3 steps, some of them terminal."""
    rng = np.random.default_rng(0)
    reward = 3 * rng.normal(size=(2, 3))
    is_terminal = np.array([[False, True, False], [False, False, True]])
    return (
        jax.tree.map(lambda x: rng.random((2, 3, *x.shape[2:]), np.float32), obs),
        jnp.asarray(rng.normal(size=(2, 3, 41)), jnp.float32),
        jnp.asarray(rng.normal(size=(2, 3)), jnp.float32),
        obs,
        jnp.asarray(reward, jnp.float32),
        jnp.asarray(is_terminal),
    )


def observations():
    rng = np.random.default_rng(1)
    vector = jnp.asarray(5 * rng.normal(size=(2, 3, 7)), jnp.float32)
    return vector, jnp.asarray(rng.integers(0, 256, (2, 3, 4, 4, 3)), jnp.uint8)


def slow_prediction_loss(predicted, reward_logits, cont_logit, obs, reward, is_terminal):
    """Reconstruction, reward and continuation of one array, a step at a time; gamma is 0.9."""
    parts = np.zeros((3, *reward.shape))
    for i in np.ndindex(reward.shape):
        o = np.asarray(obs[i], np.float64)
        o = o / 255 if obs.dtype == np.uint8 else np.sign(o) * np.log1p(np.abs(o))
        parts[0][i] = ((np.asarray(predicted[i], np.float64) - o) ** 2).sum()
        code = slow_two_hot(reward[i][None], BINS)[0]
        parts[1][i] = -code @ slow_log_softmax(reward_logits[i])
        goes_on = 1 / (1 + np.exp(-np.float64(cont_logit[i])))
        c = 0.0 if is_terminal[i] else 0.9
        parts[2][i] = -c * np.log(goes_on) - (1 - c) * np.log(1 - goes_on)
    return parts


@pytest.mark.parametrize("kind", ["vector", "image"])
def test_prediction_loss_matches_its_twin(kind):
    vector, image = observations()
    arrays = heads_and_targets(vector if kind == "vector" else image)
    actual = prediction_loss(*arrays, bins=BINS, discount=0.9)
    for part, twin in zip(actual, slow_prediction_loss(*arrays), strict=True):
        np.testing.assert_allclose(part, twin, rtol=1e-5)


def test_prediction_loss_sums_over_observations():
    vector, image = observations()
    arrays = heads_and_targets({"vector": vector, "image": image})
    actual = prediction_loss(*arrays, bins=BINS, discount=0.9)
    predicted, rest = arrays[0], (arrays[1], arrays[2])
    apart = [
        slow_prediction_loss(predicted[k], *rest, obs, *arrays[4:])[0]
        for k, obs in (("vector", vector), ("image", image))
    ]
    np.testing.assert_allclose(actual.reconstruction, sum(apart), rtol=1e-5)


def test_prediction_loss_without_observations_is_that_of_reward_and_continuation():
    arrays = heads_and_targets(observations()[0])
    nothing = prediction_loss((), *arrays[1:3], (), *arrays[4:], bins=BINS, discount=0.9)
    usual = prediction_loss(*arrays, bins=BINS, discount=0.9)
    np.testing.assert_array_equal(nothing.reconstruction, np.zeros((2, 3)))
    np.testing.assert_array_equal(nothing.reward, usual.reward)
    np.testing.assert_array_equal(nothing.cont, usual.cont)


def test_prediction_loss_by_hand():
    bins = jnp.array([-1.0, 0.0, 1.0])
    loss = losses.prediction_loss(
        jnp.array([[1.0, 0.0]]),
        jnp.log(jnp.array([[0.25, 0.25, 0.5]])),
        jnp.array([jnp.log(3.0)]),
        jnp.array([[np.e - 1, np.e**2 - 1]]),
        jnp.array([0.5]),
        jnp.array([False]),
        bins=bins,
        discount=0.8,
    )
    np.testing.assert_allclose(loss.reconstruction, [4.0], rtol=1e-6)
    np.testing.assert_allclose(loss.reward, [0.5 * np.log(4) + 0.5 * np.log(2)], rtol=1e-6)
    np.testing.assert_allclose(loss.cont, [0.8 * np.log(4 / 3) + 0.2 * np.log(4)], rtol=1e-6)


def test_each_part_of_the_prediction_loss_moves_its_own_head_and_no_target():
    vector, _ = observations()
    *floats, is_terminal = heads_and_targets(vector)

    def parts(*floats):
        loss = prediction_loss(*floats, is_terminal, bins=BINS, discount=0.9)
        return jax.tree.map(jnp.sum, loss)

    routes = jax.jit(jax.jacobian(parts, argnums=(0, 1, 2, 4)))(*floats)
    for own, route in enumerate(routes):
        *to_heads, to_reward = route
        for head, gradient in enumerate(to_heads):
            assert (gradient != 0).any() == (head == own)
        np.testing.assert_array_equal(to_reward, np.zeros((2, 3)))


@pytest.mark.parametrize(
    "obs",
    [
        jnp.zeros((2, 3, 7), jnp.int32),
        jnp.zeros((2, 3, 4, 4, 3)),
        jnp.zeros((2, 4, 7)),
        jnp.zeros((3, 7)),
        {"vector": jnp.zeros((2, 3, 7))},
    ],
    ids=["whole numbers", "images of floats", "another time", "no batch", "another tree"],
)
def test_prediction_loss_refuses_observations_of_another_shape(obs):
    _, *logits, _, reward, is_terminal = heads_and_targets(observations()[0])
    predicted = obs["vector"] if isinstance(obs, dict) else obs
    with pytest.raises(AssertionError):
        prediction_loss(predicted, *logits, obs, reward, is_terminal, bins=BINS, discount=0.9)


def test_prediction_loss_refuses_rewards_of_another_time():
    *heads_and_obs, reward, is_terminal = heads_and_targets(observations()[0])
    with pytest.raises(AssertionError):
        prediction_loss(
            *heads_and_obs, reward[:, 1:], is_terminal[:, 1:], bins=BINS, discount=0.9
        )


def test_dynamics_loss_under_jit_equals_eager():
    post, prior = logits(3.0)
    for eager, jitted in zip(
        losses.dynamics_loss(post, prior, **KL), dynamics_loss(post, prior, **KL), strict=True
    ):
        np.testing.assert_allclose(eager, jitted, rtol=1e-5)
