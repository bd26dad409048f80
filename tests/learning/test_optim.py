"""LaProp, adaptive gradient clipping and clipped Adam against float64 numpy, and by hand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from vawm.config import AdamConfig, LaPropConfig
from vawm.learning import optim

CONFIG = LaPropConfig()


def slow_laprop(gradients, rate, beta1, beta2, eps):
    """The update at every step, for one tensor."""
    v = m = np.zeros_like(gradients[0], np.float64)
    updates = []
    for t, g in enumerate(np.asarray(gradients, np.float64), start=1):
        v = beta2 * v + (1 - beta2) * g**2
        m = beta1 * m + (1 - beta1) * g / (np.sqrt(v / (1 - beta2**t)) + eps)
        updates.append(-rate(t - 1) * m / (1 - beta1**t))
    return updates


def run(optimizer, params, gradients):
    """The update at every step; parameters are held."""
    state = optimizer.init(params)
    update = jax.jit(optimizer.update)
    updates = []
    for gradient in gradients:
        step, state = update(gradient, state, params)
        updates.append(step)
    return updates


def test_laprop_matches_float64_over_many_steps():
    gradients = np.random.default_rng(0).normal(size=(50, 7)).astype(np.float32)
    gradients *= np.logspace(-6, 3, 7, dtype=np.float32)
    actual = run(optim.laprop(0.1, 0.9, 0.999, 1e-20), jnp.zeros(7), jnp.asarray(gradients))
    twin = slow_laprop(gradients, lambda t: 0.1, 0.9, 0.999, 1e-20)
    np.testing.assert_allclose(actual, twin, rtol=1e-3, atol=1e-5)


def test_laprop_moves_by_the_sign_at_first():
    (update,) = run(
        optim.laprop(0.1, 0.9, 0.999, 1e-20), jnp.zeros(3), [jnp.array([1e-8, -3.0, 1e4])]
    )
    np.testing.assert_allclose(update, [-0.1, 0.1, -0.1], rtol=1e-4)


def test_laprop_normalises_before_it_averages():
    """A burst 1000 times larger weighs as one step, where Adam would follow it for long."""
    gradients = [jnp.array([1.0]), jnp.array([-1000.0])]
    beta1, beta2 = 0.9, 0.5
    actual = run(optim.laprop(1.0, beta1, beta2, 0.0), jnp.zeros(1), gradients)[1]
    second = -1000 / np.sqrt((0.25 * 1 + 0.5 * 1000**2) / 0.75)
    expected = -(beta1 * 0.1 * 1 + 0.1 * second) / (1 - beta1**2)
    np.testing.assert_allclose(actual, [expected], rtol=1e-5)


def test_clip_is_per_tensor_and_by_hand():
    params = {"big": jnp.array([[3.0, 0.0], [0.0, 4.0]]), "zero": jnp.zeros(2)}
    gradient = {"big": jnp.array([[0.0, 6.0], [8.0, 0.0]]), "zero": jnp.array([3.0, 4.0])}
    clip = optim.adaptive_gradient_clip(0.3, 1e-3)
    clipped, _ = clip.update(gradient, clip.init(params), params)
    # Limits 0.3 * 5 and 0.3 * 1e-3, of gradients with norms 10 and 5.
    np.testing.assert_allclose(clipped["big"], gradient["big"] * 0.15, rtol=1e-6)
    np.testing.assert_allclose(clipped["zero"], gradient["zero"] * 6e-5, rtol=1e-6)


def test_clip_leaves_small_gradients_bit_for_bit():
    params = jnp.array([3.0, 4.0])
    gradient = jnp.array([0.7, -0.9])
    clip = optim.adaptive_gradient_clip(0.3, 1e-3)
    clipped, _ = clip.update(gradient, clip.init(params), params)
    np.testing.assert_array_equal(clipped, gradient)


def test_clip_refuses_to_work_without_parameters():
    clip = optim.adaptive_gradient_clip(0.3, 1e-3)
    with pytest.raises(ValueError, match="params"):
        clip.update(jnp.ones(2), clip.init(jnp.ones(2)))


def test_learning_rate_rises_from_zero_and_stays():
    config = dataclasses.replace(CONFIG, warmup_updates=4)
    gradients = [jnp.array([1e-5, -1e-5])] * 7
    updates = run(optim.make_laprop(config), jnp.ones(2), gradients)
    rates = [-float(update[0]) for update in updates]
    expected = config.learning_rate * np.array([0, 0.25, 0.5, 0.75, 1, 1, 1])
    np.testing.assert_allclose(rates, expected, rtol=1e-4)
    np.testing.assert_array_equal(updates[0], [0.0, 0.0])


def test_no_warm_up_is_the_full_rate_at_once():
    config = dataclasses.replace(CONFIG, warmup_updates=0)
    (update,) = run(optim.make_laprop(config), jnp.ones(1), [jnp.array([0.1])])
    np.testing.assert_allclose(update, [-config.learning_rate], rtol=1e-5)


def test_optimizer_matches_float64_with_clipping_and_warm_up():
    config = dataclasses.replace(CONFIG, learning_rate=0.01, warmup_updates=5)
    rng = np.random.default_rng(0)
    params = {"kernel": rng.normal(size=(4, 3)), "bias": np.zeros(3)}
    gradients = [
        {name: rng.normal(size=value.shape) for name, value in params.items()}
        for _ in range(20)
    ]
    as_float32 = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (params, gradients))
    actual = run(optim.make_laprop(config), *as_float32)
    for name, value in params.items():
        limit = config.agc * max(config.agc_floor, np.linalg.norm(value))
        clipped = [g[name] / max(1, np.linalg.norm(g[name]) / limit) for g in gradients]
        twin = slow_laprop(
            clipped, lambda t: 0.01 * min(1, t / 5), config.beta1, config.beta2, config.epsilon
        )
        np.testing.assert_allclose([u[name] for u in actual], twin, rtol=1e-3, atol=1e-7)


def test_a_tensor_without_gradient_never_moves():
    params = {"still": jnp.array([1.0, 0.0]), "moved": jnp.array([1.0])}
    optimizer = optim.make_laprop(dataclasses.replace(CONFIG, warmup_updates=0))
    gradient = {"still": jnp.zeros(2), "moved": jnp.ones(1)}
    state = optimizer.init(params)
    for _ in range(5):
        updates, state = optimizer.update(gradient, state, params)
        params = optax.apply_updates(params, updates)
    np.testing.assert_array_equal(params["still"], [1.0, 0.0])
    assert params["moved"] < 1.0


def slow_adam(gradients, rate, clip, eps, config):
    """The updates of a tree at every step, clipped as `torch.nn.utils.clip_grad_norm_` does."""
    m, v, updates = dict.fromkeys(gradients[0], 0.0), dict.fromkeys(gradients[0], 0.0), []
    for t, tree in enumerate(gradients, start=1):
        norm = np.sqrt(sum(np.square(g).sum() for g in tree.values()))
        g = {name: x * min(1.0, clip / (norm + 1e-6)) for name, x in tree.items()}
        update = {}
        for k, x in g.items():
            m[k] = config.beta1 * m[k] + (1 - config.beta1) * x
            v[k] = config.beta2 * v[k] + (1 - config.beta2) * x**2
            mean, square = m[k] / (1 - config.beta1**t), v[k] / (1 - config.beta2**t)
            update[k] = -rate * mean / (np.sqrt(square) + eps)
        updates.append(update)
    return updates


@pytest.mark.parametrize("size", [0.01, 1.0, 30.0])
def test_adams_match_float64_whether_or_not_they_clip(size):
    """An epsilon as large as a gradient shows what clipping does, which Adam else undoes."""
    config = AdamConfig(
        learning_rate=0.01,
        clip=2.0,
        epsilon=0.1,
        behaviour_learning_rate=0.02,
        behaviour_clip=0.5,
        behaviour_epsilon=1.0,
    )
    rng = np.random.default_rng(0)
    gradients = [
        {"kernel": size * rng.normal(size=(4, 3)), "bias": size * rng.normal(size=3)}
        for _ in range(3)
    ]
    norms = [np.sqrt(sum(np.square(g).sum() for g in tree.values())) for tree in gradients]
    assert (max(norms) < config.behaviour_clip) == (size == 0.01)
    as_float32 = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), gradients)
    adams = optim.make_adams(config)
    for adam, numbers in [
        (adams.world_model, (0.01, 2.0, 0.1)),
        (adams.behaviour, (0.02, 0.5, 1.0)),
    ]:
        actual = run(adam, jax.tree.map(jnp.zeros_like, as_float32[0]), as_float32)
        twin = slow_adam(gradients, *numbers, config)
        for update, expected in zip(actual, twin, strict=True):
            for name in expected:
                np.testing.assert_allclose(update[name], expected[name], rtol=2e-5)


def test_each_adam_moves_at_a_rate_of_its_own_from_the_first_step_on():
    config, gradient = AdamConfig(), [jnp.array([3.0, -0.2])]
    adams = optim.make_adams(config)
    for adam, rate in [
        (adams.world_model, config.learning_rate),
        (adams.behaviour, config.behaviour_learning_rate),
    ]:
        (update,) = run(adam, jnp.zeros(2), gradient)
        np.testing.assert_allclose(update, [-rate, rate], rtol=1e-3)


def test_actor_and_critic_are_clipped_together():
    """Norms 3 and 4, 5 in all: either alone would be left as it is."""
    config = AdamConfig(behaviour_clip=4.0, behaviour_epsilon=1e6, behaviour_learning_rate=1e6)
    gradient = (jnp.array([3.0]), jnp.array([4.0]))
    zeros = jax.tree.map(jnp.zeros_like, gradient)
    ((actor, critic),) = run(optim.make_adams(config).behaviour, zeros, [gradient])
    np.testing.assert_allclose([actor[0], critic[0]], [-3.0 * 0.8, -4.0 * 0.8], rtol=1e-4)
