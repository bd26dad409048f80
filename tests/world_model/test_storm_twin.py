"""STORM against its official architecture in numpy float64: logits, losses, the first step."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import storm_twin
import tiny_storm
from nets_twin import float64

from vawm.agent import make_agent
from vawm.config import ValueAlignmentConfig
from vawm.learning.objective import make_behaviour_loss, make_world_model_loss
from vawm.learning.state import init_learner
from vawm.learning.update import make_update
from vawm.types import Batch, EnvSpec, Trajectory, image

SPEC = EnvSpec("test", image(48), 3, True, 1, 1, None)
CONFIG = tiny_storm.config(
    world_model=tiny_storm.model(dropout=0.0, free_nats=0.1),
    value_alignment=ValueAlignmentConfig(warmup_steps=0),
)
SCALES = CONFIG.value_alignment.dynamics_scale, CONFIG.value_alignment.representation_scale
AGENT = make_agent(CONFIG, SPEC)
BATCH, LENGTH = 2, 3


def key_update():
    return jax.random.key(7)


def key_model():
    """What an update with `key_update` gives the world model."""
    return jax.random.split(key_update())[0]


def trajectory(shape, seed):
    """Random images, actions and rewards; an episode ends inside of the first sequence."""
    rng = np.random.default_rng(seed)
    flags = np.zeros(shape, bool)
    ended, begun = flags.copy(), flags.copy()
    ended[0, 2] = begun[0, 3] = True
    return Trajectory(
        obs=rng.integers(0, 256, (*shape, 48, 48, 3)).astype(np.uint8),
        reward=3 * rng.normal(size=shape).astype(np.float32),
        is_first=begun,
        is_last=ended,
        is_terminal=ended,
        action=np.eye(3, dtype=np.float32)[rng.integers(0, 3, shape)],
    )


DATA = trajectory((BATCH, LENGTH + 1), seed=0)


def as_batch(data):
    return Batch(jax.tree.map(jnp.asarray, data), ())


@functools.cache
def learner():
    """Fresh, but for norms and biases, which start at numbers that would hide mistakes."""
    fresh = jax.jit(lambda key: init_learner(AGENT, CONFIG, key))(jax.random.key(0))
    leaves, tree = jax.tree.flatten(fresh.params)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    noise = [0.1 * jax.random.normal(k, x.shape) for k, x in zip(keys, leaves, strict=True)]
    params = jax.tree.unflatten(tree, [x + n for x, n in zip(leaves, noise, strict=True)])
    return fresh._replace(params=params)


@functools.cache
def model_loss():
    return jax.jit(make_world_model_loss(AGENT, CONFIG))


@functools.cache
def ours():
    """Our loss and explanation; the samples of both go to the twin."""
    state = learner()
    arguments = state.params.world_model, state.model_state
    explain = jax.jit(AGENT.world_model.explain)
    explanation, statistics = explain(*arguments, key_model(), as_batch(DATA))
    _, explained = model_loss()(
        state.params, state, as_batch(DATA), key_model(), jnp.asarray(1)
    )
    return explanation, statistics, explained.metrics


def one_hots():
    """Of the posterior at all steps, of the prior at those between; exact ones and zeros."""
    explanation, _, _ = ours()
    shape = CONFIG.world_model.stoch, CONFIG.world_model.classes
    # The first z is in no inference: it is drawn again, from the same numbers.
    key_post = jax.random.split(key_model(), 3)[0]
    uniform = jax.random.uniform(key_post, (BATCH, LENGTH, shape[0]))
    first = twin_logits()[:, 0]
    probs = np.exp(storm_twin.unimix_log(first, CONFIG.world_model.unimix))
    passed = np.cumsum(probs, -1)[..., :-1] <= np.asarray(uniform)[:, 0, :, None]
    drawn = np.eye(shape[1])[passed.sum(-1)]
    rest = np.asarray(explanation.inference.latent.stoch, np.float64)
    prior = np.asarray(explanation.inference.prior_latent.stoch, np.float64)
    return np.concatenate([drawn[:, None], rest], axis=1), prior


def zeros():
    shape = CONFIG.world_model.stoch, CONFIG.world_model.classes
    return np.zeros((BATCH, LENGTH, *shape)), np.zeros((BATCH, LENGTH - 1, *shape))


@functools.cache
def twin_logits():
    """Of the posterior, which needs no samples."""
    state = learner()
    params, critic = float64(state.params.world_model), float64(state.params.critic)
    return storm_twin.forward(params, critic, DATA, CONFIG.world_model, zeros()).post_logits


@functools.cache
def twin():
    state = learner()
    params, critic = float64(state.params.world_model), float64(state.params.critic)
    return storm_twin.forward(
        params, critic, DATA, CONFIG.world_model, one_hots(), alignment=SCALES
    )


def test_logits_and_h_are_those_of_the_official_network():
    inference = ours()[0].inference
    np.testing.assert_allclose(inference.post_logits, twin().post_logits[:, 1:], atol=2e-5)
    np.testing.assert_allclose(inference.prior_logits, twin().prior_logits[:, :-1], atol=2e-5)
    np.testing.assert_allclose(inference.latent.deter, twin().deter[:, :-1], atol=2e-5)


def test_every_part_of_the_loss_is_the_official_one():
    for name, expected in twin().parts.items():
        np.testing.assert_allclose(ours()[2][name], expected, rtol=2e-5, err_msg=name)
    assert twin().parts["loss/value_alignment"] > 0
    assert twin().parts["loss/dynamics"] > 0.6 * CONFIG.world_model.free_nats  # not all free


def test_running_statistics_take_a_tenth_of_the_batch():
    pixels = DATA.obs[:, :-1].reshape(-1, 48, 48, 3) / 255.0
    kernel = float64(learner().params.world_model)["encoder"]["image"]["stages_0"]["kernel"]
    x = storm_twin.convolve(pixels, kernel).reshape(-1, kernel.shape[-1])
    moved = ours()[1]["encoder"]["image"]["stages_0"]["norm"]
    np.testing.assert_allclose(moved["mean"], 0.1 * x.mean(0), atol=1e-5)
    np.testing.assert_allclose(moved["var"], 0.9 + 0.1 * x.var(0, ddof=1), rtol=1e-5)


@functools.cache
def gradient():
    """Of the world model, by us."""
    state = learner()

    def loss(world_model):
        return model_loss()(
            state.params._replace(world_model=world_model),
            state,
            as_batch(DATA),
            key_model(),
            jnp.asarray(1),
        )[0]

    return jax.jit(jax.grad(loss))(state.params.world_model)


def difference(params, path, index):
    """The slope of the twin's loss along one parameter."""
    state = learner()
    critic = float64(state.params.critic)
    leaf = functools.reduce(lambda node, name: node[name], path, params)
    before, width, losses = leaf[index], 1e-6, []
    for sign in (1, -1):
        leaf[index] = before + sign * width
        moved = storm_twin.forward(
            params,
            critic,
            DATA,
            CONFIG.world_model,
            one_hots(),
            given=twin().given,
            alignment=SCALES,
        )
        losses.append(sum(moved.parts.values()))
    leaf[index] = before
    return (losses[0] - losses[1]) / (2 * width)


def leaves():
    tree = jax.tree_util.tree_leaves_with_path(learner().params.world_model)
    return [tuple(entry.key for entry in path) for path, _ in tree]


def test_gradients_are_the_differences_of_the_official_loss():
    params = jax.tree.map(np.array, float64(learner().params.world_model))
    rng = np.random.default_rng(2)
    for path in leaves():
        ours_here = np.asarray(
            functools.reduce(lambda node, name: node[name], path, gradient())
        )
        scale = np.abs(ours_here).max()
        for _ in range(2):
            index = tuple(rng.integers(0, n) for n in ours_here.shape)
            expected = difference(params, path, index)
            error = abs(ours_here[index] - expected)
            assert error <= 2e-3 * scale + 1e-5, (path, index, ours_here[index], expected)


def contexts():
    shape = CONFIG.imagination.batch_size, CONFIG.imagination.context_length
    return as_batch(trajectory(shape, seed=1))


@functools.cache
def compiled_update():
    return jax.jit(make_update(AGENT, CONFIG))


def update(state):
    """The learner after one update, and its metrics."""
    arguments = as_batch(DATA), contexts(), key_update(), jnp.asarray(1)
    after, _, metrics = compiled_update()(state, *arguments)
    return after, metrics


def test_actor_and_critic_learn_in_what_the_world_model_has_become():
    """With its new parameters and its new statistics, and not with either of the old ones."""
    world_model = jax.tree.map(lambda x: x, learner().params.world_model)
    kernel = world_model["storm"]["posterior_out"]["kernel"]
    world_model["storm"]["posterior_out"]["kernel"] = 300 * kernel  # so that z follows o
    state = learner()._replace(
        params=learner().params._replace(world_model=world_model),
        # Variances so small that a tenth of the batch's changes them a lot.
        model_state=jax.tree.map(lambda x: 1e-6 * x, learner().model_state),
    )
    after, metrics = update(state)
    behaviour_loss = jax.jit(make_behaviour_loss(AGENT, CONFIG))

    def critic_loss(world_model, model_state):
        _, (_, measured) = behaviour_loss(
            state.params._replace(world_model=world_model),
            state._replace(model_state=model_state),
            as_batch(DATA),
            (),
            contexts(),
            jax.random.split(key_update())[1],
        )
        return float(measured["loss/critic"])

    old, new = (s.params.world_model for s in (state, after))
    expected = float(metrics["loss/critic"])
    assert critic_loss(new, after.model_state) == pytest.approx(expected, rel=1e-5)
    for other in ((old, after.model_state), (new, state.model_state)):
        assert critic_loss(*other) != pytest.approx(expected, rel=1e-5)


def test_the_first_step_of_adam_is_that_of_the_official_optimiser():
    """lr * g / (|g| + eps): bias correction cancels, and so would clipping."""
    state, config = learner(), CONFIG.optimizer
    after, _ = update(state)
    official = float64(gradient())
    norm = np.sqrt(sum((g**2).sum() for g in jax.tree.leaves(official)))
    clipped = jax.tree.map(lambda g: g * min(1.0, config.clip / norm), official)
    old, new = float64(state.params.world_model), float64(after.params.world_model)

    def check(before, after, g):
        expected = before - config.learning_rate * g / (abs(g) + config.epsilon)
        clear = abs(g) > 1e-5 * abs(g).max()  # the sign of what is nearly 0 is rounding
        np.testing.assert_allclose(after[clear], expected[clear], atol=1e-6)
        assert clear.any()

    jax.tree.map(check, old, new, clipped)
