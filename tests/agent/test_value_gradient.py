"""VaGraM on latents: against loops, by hand, and what learns from it."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
import tiny_vagram
from learners import learner
from nets_twin import noisy
from toy_batch import batch, norm

from vawm import losses
from vawm.agent import make_agent
from vawm.agent.actor_critic import Critic
from vawm.agent.value_gradient import make_value_gradient_loss
from vawm.learning import objective
from vawm.losses.transforms import TwoHot
from vawm.types import Inference, Latent, image

CONFIG, SPEC = tiny_vagram.CONFIG, tiny.env().spec
SHAPE = 2, 3  # B, T
AGENT = make_agent(CONFIG, SPEC)

# V = p * (sum_j w_j z_j)^2 * mean(h): two numbers are enough to compute its gradient by hand.
WEIGHT = np.linspace(-1.0, 2.0, 16)
SIMPLE = Critic(
    init=lambda key: jnp.float32(1),
    logits=lambda p, latent: (
        p
        * jnp.square(latent.stoch.reshape(*latent.stoch.shape[:-2], 16) @ WEIGHT)
        * latent.deter.mean(-1)
    )[..., None],
    code=TwoHot(jnp.zeros(1), lambda y: y, lambda logits: logits[..., 0]),
)


def model(**changes):
    return dataclasses.replace(CONFIG.world_model, **changes)


def inference():
    keys = jax.random.split(jax.random.key(0), 3)
    deter = 1.0 + jax.random.uniform(keys[0], (*SHAPE, 32))
    post, prior = (2 * jax.random.normal(key, (*SHAPE, 4, 4)) for key in keys[1:])
    samples = (Latent(deter, jax.nn.softmax(logits)) for logits in (post, prior))
    return Inference(*samples, post, prior)


def slow_loss(critic, unit, scale):
    """Diagonal form, state by state, from softmax and the derivative of the square."""
    inferred = jax.tree.map(lambda x: np.asarray(x, np.float64), inference())
    loss = np.zeros(SHAPE)
    for at in np.ndindex(SHAPE):
        z, guess = (
            0.99 * np.exp(x[at]) / np.exp(x[at]).sum(-1, keepdims=True) + 0.01 / 4
            for x in (inferred.post_logits, inferred.prior_logits)
        )
        along, h = z.reshape(16) @ WEIGHT, inferred.latent.deter[at].mean()
        centred = WEIGHT.reshape(4, 4) - WEIGHT.reshape(4, 4).mean(-1, keepdims=True)
        for j, (a, b) in enumerate(zip(guess.reshape(16), z.reshape(16), strict=True)):
            gradient = critic * 2 * along * centred.reshape(16)[j] * h
            if unit == "symlog":
                gradient /= 1 + abs(critic * along**2 * h)
            loss[at] += scale * (gradient * (a - b)) ** 2
    return loss


@pytest.mark.parametrize("unit", ["symlog", "raw"])
def test_the_loss_equals_a_loop_over_the_entries_of_z(unit):
    choices = model(value_gradient_unit=unit, value_gradient_scale=0.3)
    loss = jax.jit(make_value_gradient_loss(SIMPLE, choices))
    actual = loss(jnp.float32(1.5), jnp.float32(0.5), inference())
    expected = sum(slow_loss(critic, unit, 0.3) for critic in (1.5, 0.5)) / 2
    np.testing.assert_allclose(actual, expected, rtol=2e-4)


@pytest.mark.parametrize(("critic", "number"), [("online", 1.5), ("slow", 0.5)])
def test_either_critic_alone_can_judge(critic, number):
    loss = make_value_gradient_loss(SIMPLE, model(value_gradient_critic=critic))
    actual = loss(jnp.float32(1.5), jnp.float32(0.5), inference())
    np.testing.assert_allclose(actual, slow_loss(number, "symlog", 1.0), rtol=2e-4)


@pytest.mark.parametrize(
    ("form", "function"),
    [
        ("taylor", losses.vagram_taylor_loss),
        ("second_order", losses.vagram_second_order_loss),
    ],
)
def test_the_other_forms_are_those_of_the_library(form, function):
    choices = model(
        value_gradient_form=form,
        value_gradient_unit="raw",
        value_gradient_critic="online",
        unimix=0.0,
    )
    actual = make_value_gradient_loss(SIMPLE, choices)(jnp.float32(2), (), inference())
    inferred = inference()
    h = inferred.latent.deter.mean(-1)
    flat = [x.stoch.reshape(*SHAPE, 16) for x in (inferred.prior_latent, inferred.latent)]
    expected = function(lambda z: 2 * jnp.square(z @ WEIGHT) * h, *flat)
    np.testing.assert_allclose(actual, expected, rtol=1e-4)


def test_the_joint_form_equals_its_derivatives_by_hand():
    """V = 2 (w . z)^2 h has the gradient 4 h (w . z) c and H e = 4 h (c . e) c, c centred w."""
    choices = model(
        value_gradient_form="joint",
        value_gradient_unit="raw",
        value_gradient_critic="online",
        unimix=0.0,
    )
    actual = make_value_gradient_loss(SIMPLE, choices)(jnp.float32(2), (), inference())
    inferred = jax.tree.map(lambda x: np.asarray(x, np.float64), inference())
    h = inferred.latent.deter.mean(-1)[..., None]
    z, guess = (x.stoch.reshape(*SHAPE, 16) for x in (inferred.latent, inferred.prior_latent))
    centred = WEIGHT.reshape(4, 4) - WEIGHT.reshape(4, 4).mean(-1, keepdims=True)
    centred, error = centred.reshape(16), guess - z
    gradient = 4 * h * (z @ WEIGHT)[..., None] * centred
    product = 4 * h * (error @ centred)[..., None] * centred
    expected = (2 * (gradient * error) ** 2 + product**2 / 2).sum(-1)
    np.testing.assert_allclose(actual, expected, rtol=1e-4)


@pytest.mark.parametrize("form", ["diagonal", "joint"])
def test_a_critic_that_ignores_z_has_no_loss(form):
    """Weights that are equal over the classes of a categorical say nothing of its class."""
    ignoring = SIMPLE._replace(
        logits=lambda p, latent: (
            p * latent.stoch.sum(-1) @ jnp.arange(1.0, 5.0) * latent.deter.mean(-1)
        )[..., None]
    )
    loss = make_value_gradient_loss(ignoring, model(value_gradient_form=form))
    np.testing.assert_allclose(loss(jnp.float32(2), jnp.float32(3), inference()), 0, atol=1e-9)


@functools.cache
def gradient(**changes):
    """Of the world model's loss."""
    config = dataclasses.replace(CONFIG, world_model=model(**changes))
    agent = make_agent(config, SPEC)
    loss = objective.make_world_model_loss(agent, config)
    params, model_state = jax.jit(agent.init)(jax.random.key(0))
    params = noisy(params)

    def total(params, slow):
        given = learner(params, model_state=model_state, slow_critic=slow)
        return loss(params, given, batch(agent), jax.random.key(1), jnp.asarray(1))

    run = jax.jit(jax.grad(total, has_aux=True, argnums=(0, 1)))
    (own, slow), (_, _, metrics) = run(params, params.critic)
    assert norm(slow) == norm(own.critic) == norm(own.actor) == 0.0
    return own.world_model, metrics


def test_vagram_alone_trains_the_prior_and_reaches_h():
    with_it, metrics = gradient()
    without, _ = gradient(value_gradient_scale=0.0)
    assert metrics["loss/value_gradient"] > 0
    assert metrics["loss/dynamics"] == 0.0
    assert norm(with_it["rssm"]["prior_net"]) > 0
    assert norm(without["rssm"]["prior_net"]) == 0.0
    moved = jax.tree.map(jnp.subtract, with_it, without)
    assert norm(moved["rssm"]["gru"]) > 0
    for head in ("decoder", "reward", "cont"):
        assert norm(moved[head]) == 0.0


def test_from_pixels_it_alone_trains_the_prior_and_every_layer_of_the_encoder():
    choices, pixels = model(depth=1), SPEC._replace(obs=image(48))
    config = dataclasses.replace(CONFIG, world_model=choices)
    agent = make_agent(config, pixels)
    vagram = make_value_gradient_loss(agent.critic, choices)
    seen = np.random.default_rng(0).integers(0, 256, (2, 9, 48, 48, 3), np.uint8)
    data = batch(agent)
    data = data._replace(trajectory=data.trajectory._replace(obs=jnp.asarray(seen)))

    @jax.jit
    def gradient(key):
        params, model_state = agent.init(key)
        params = noisy(params)

        def loss(world_model):
            explained, _ = agent.world_model.explain(
                world_model, model_state, jax.random.key(1), data
            )
            return vagram(params.critic, params.critic, explained.inference).mean()

        return jax.grad(loss)(params.world_model)

    own = gradient(jax.random.key(0))
    for leaf in jax.tree.leaves([own["encoder"], own["rssm"]["prior_net"]]):
        assert 0 < jnp.abs(leaf).max() < np.inf
    for head in ("decoder", "reward", "cont"):
        assert norm(own[head]) == 0.0


@pytest.mark.parametrize("form", ["taylor", "second_order"])
def test_the_other_forms_train_the_prior_with_the_critic_itself(form):
    own, metrics = gradient(value_gradient_form=form)
    assert 0 < norm(own["rssm"]["prior_net"]) < np.inf
    assert metrics["loss/value_gradient"] > 0


def test_the_decoder_only_shows_what_rewards_and_values_have_made_of_the_latents():
    shown, _ = gradient()
    unseen, _ = gradient(reconstruction_scale=0.0)
    shaped, _ = gradient(reconstruction_gradient=True)
    assert norm(shown["decoder"]) > 0
    assert norm(unseen["decoder"]) == 0.0
    for part in ("encoder", "rssm"):
        jax.tree.map(
            functools.partial(np.testing.assert_allclose, atol=1e-5, rtol=1e-4),
            shown[part],
            unseen[part],
        )
        assert norm(jax.tree.map(jnp.subtract, shaped[part], shown[part])) > 1e-3
    np.testing.assert_allclose(norm(shaped["decoder"]), norm(shown["decoder"]), rtol=1e-5)


def test_nothing_is_random_but_actions():
    params, model_state = jax.jit(AGENT.init)(jax.random.key(0))
    params, world_model = noisy(params).world_model, AGENT.world_model
    first, again = (
        world_model.explain(params, model_state, jax.random.key(seed), batch(AGENT))[
            0
        ].inference
        for seed in (1, 2)
    )
    jax.tree.map(np.testing.assert_array_equal, first, again)
    np.testing.assert_allclose(first.latent.stoch.sum(-1), 1.0, rtol=1e-5)
    assert (first.latent.stoch.max(-1) < 0.999).all()
    # Replay keeps the probabilities themselves.
    kept = world_model.memory(first.latent)
    jax.tree.map(np.testing.assert_array_equal, kept, first.latent)
