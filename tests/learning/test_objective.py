"""Where gradients go, and that value alignment is wired as the paper says."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from learners import learner
from nets_twin import noisy
from toy_batch import BATCH, LENGTH, batch, norm

from vawm.agent import make_agent
from vawm.config import ValueAlignmentConfig
from vawm.learning import objective
from vawm.learning.alignment import make_value_alignment
from vawm.types import Inference, Latent

SPEC = tiny.env().spec
ON = ValueAlignmentConfig(weight="static", static_weight=1.0, warmup_steps=0)
STOPPED = dataclasses.replace(ON, deter_gradient="stop")
SLOW = dataclasses.replace(ON, critic="slow")
OTHER_HEADS = "decoder", "reward", "cont"


def make(alignment=ON, **critic):
    config = dataclasses.replace(
        tiny.CONFIG,
        value_alignment=alignment,
        critic=dataclasses.replace(tiny.CONFIG.critic, **critic),
    )
    return make_agent(config, SPEC), config


@functools.cache
def alignment_gradient(alignment):
    """A compiled function of parameters: L_var, and the gradient of its mean alone."""
    agent, config = make(alignment)
    value_alignment = make_value_alignment(agent, config)

    def loss(params):
        explanation, _ = agent.world_model.explain(
            params.world_model, model_state(), jax.random.key(1), batch(agent)
        )
        kl = jnp.ones((BATCH, LENGTH))
        aligned, weight, _ = value_alignment(
            params.critic, explanation.inference, kl, jnp.asarray(1)
        )
        return jnp.mean(aligned * weight), aligned

    return jax.jit(jax.grad(loss, has_aux=True))


@functools.cache
def initial():
    agent, _ = make()
    return jax.jit(agent.init)(jax.random.key(0))


def model_state():
    return initial()[1]


@functools.cache
def params(zero_critic=False):
    return (lambda x: x if zero_critic else noisy(x))(initial()[0])


def test_value_alignment_trains_the_latent_dynamics_and_nothing_else():
    gradient, aligned = alignment_gradient(ON)(params())
    assert (aligned > 0).any()
    model = gradient.world_model
    assert norm(gradient.critic) == 0.0
    assert norm(gradient.actor) == 0.0
    for head in OTHER_HEADS:
        assert norm(model[head]) == 0.0
    assert norm(model["encoder"]) > 0
    for part in ("gru", "prior_net", "posterior_out"):
        assert norm(model["rssm"][part]) > 0, part


def test_with_h_stopped_only_samples_carry_its_gradient():
    live = alignment_gradient(ON)(params())[0].world_model["rssm"]
    gradient = alignment_gradient(STOPPED)(params())[0].world_model["rssm"]
    assert 0 < norm(gradient["gru"]) < norm(live["gru"])
    assert norm(gradient["prior_net"]) > 0


def test_without_the_second_term_the_posterior_learns_only_through_later_states():
    """Eq. 4 as printed, h stopped: the last posterior of a sequence has no way to matter."""
    printed = dataclasses.replace(STOPPED, representation_scale=0.0)
    both = alignment_gradient(STOPPED)(params())[0].world_model["rssm"]
    first = alignment_gradient(printed)(params())[0].world_model["rssm"]
    assert norm(first["posterior_out"]) < norm(both["posterior_out"])
    assert norm(first["prior_net"]) == pytest.approx(norm(both["prior_net"]), rel=1e-5)


def test_a_critic_that_starts_at_zero_gives_exactly_no_loss_and_no_gradient():
    gradient, aligned = alignment_gradient(ON)(params(zero_critic=True))
    np.testing.assert_array_equal(aligned, 0.0)
    assert norm(gradient) == 0.0


@pytest.mark.parametrize(
    ("alignment", "step", "expected"),
    [
        (ValueAlignmentConfig(), 10_000, 0.0),
        (ValueAlignmentConfig(), 10_001, 1 / 3),
        (ValueAlignmentConfig(weight="static", static_weight=0.5), 10_000, 0.0),
        (ValueAlignmentConfig(weight="static", static_weight=0.5), 10_001, 0.5),
        (ValueAlignmentConfig(weight="off"), 10_001, 0.0),
    ],
)
def test_the_weight_is_gated_by_the_warmup_and_follows_its_mode(alignment, step, expected):
    agent, config = make(alignment)
    shape = BATCH, LENGTH
    deter, index = jnp.ones((*shape, 32)), jnp.zeros((*shape, 4), int)
    latents = [Latent(deter, jax.nn.one_hot(index + k, 4)) for k in (0, 1)]
    logits = jnp.zeros((*shape, 4, 4))
    inference = Inference(*latents, logits, logits)
    value_alignment = jax.jit(make_value_alignment(agent, config))
    aligned, weight, _ = value_alignment(
        params().critic, inference, jnp.full(shape, 3.0), jnp.asarray(step)
    )
    np.testing.assert_allclose(weight, expected * np.ones(shape), rtol=1e-6)
    assert (aligned > 0).all()  # logged whether or not it is used


@functools.cache
def full_gradients(alignment, **critic):
    """Gradients of the world model's and of the behaviour's loss, each alone."""
    agent, config = make(alignment, **critic)
    model_loss = objective.make_world_model_loss(agent, config)
    behaviour_loss = objective.make_behaviour_loss(agent, config)

    def losses(params, slow):
        data = batch(agent)
        keys = jax.random.split(jax.random.key(1))
        given = learner(params, model_state=model_state(), slow_critic=slow)
        first, explained = model_loss(params, given, data, keys[0], jnp.asarray(1))
        given = given._replace(model_state=explained.model_state)
        second, behaved = behaviour_loss(params, given, data, explained.inference, (), keys[1])
        return jnp.stack([first, second]), explained.metrics | behaved.metrics

    slow = jax.tree.map(lambda x: x + 0.01, params().critic)
    jacobian, metrics = jax.jit(jax.jacrev(losses, has_aux=True))(params(), slow)
    return (*(jax.tree.map(lambda x, i=i: x[i], jacobian) for i in (0, 1)), metrics)


def test_each_loss_trains_what_it_should():
    model, behaviour, metrics = full_gradients(ON, replay_gradient=True)
    assert norm(model.actor) == norm(model.critic) == 0.0
    for name, part in model.world_model.items():
        assert norm(part) > 0, name
    assert norm(behaviour.actor) > 0
    assert norm(behaviour.critic) > 0
    # The replay value loss is the only way from behaviour into the world model.
    assert norm(behaviour.world_model["encoder"]) > 0
    for head in OTHER_HEADS:
        assert norm(behaviour.world_model[head]) == 0.0
    assert all(np.isfinite(value) for value in metrics.values())


def test_the_replay_value_loss_can_be_kept_out_of_the_world_model():
    _, behaviour, _ = full_gradients(SLOW, replay_gradient=False)
    assert norm(behaviour.world_model) == 0.0
    assert norm(behaviour.critic) > 0


def products(alignment):
    """Matrix products in the compiled gradient of the world model's loss, metrics dropped."""
    agent, config = make(alignment)
    model_loss = objective.make_world_model_loss(agent, config)

    def loss(params):
        data, key = batch(agent), jax.random.key(1)
        given = learner(params, model_state=model_state())
        return model_loss(params, given, data, key, jnp.asarray(1))[0]

    hlo = jax.jit(jax.grad(loss)).lower(params()).compile().as_text()
    return hlo.count(" dot(") + hlo.count("dot_general")


def test_switched_off_its_products_are_not_computed():
    off = dataclasses.replace(ON, weight="off")
    assert products(off) < products(ON)


def test_shared_noise_gives_no_loss_where_prior_equals_posterior():
    agent, config = make(dataclasses.replace(ON, noise="shared"))

    @jax.jit
    def aligned(params):
        rssm = dict(params.world_model["rssm"])
        heads = {"posterior_out": rssm["posterior_out"], "prior_net": dict(rssm["prior_net"])}
        rssm["posterior_out"] = jax.tree.map(jnp.zeros_like, heads["posterior_out"])
        out = jax.tree.map(jnp.zeros_like, heads["prior_net"]["heads_0"])
        rssm["prior_net"] = heads["prior_net"] | {"heads_0": out}
        params = params._replace(world_model=params.world_model | {"rssm": rssm})
        given, key = learner(params, model_state=model_state()), jax.random.key(1)
        _, explained = objective.make_world_model_loss(agent, config)(
            params, given, batch(agent), key, jnp.asarray(1)
        )
        return explained.metrics["value_alignment/loss"]

    assert aligned(params()) == 0.0


def test_what_is_logged_does_not_depend_on_scales_or_weight():
    """KL of values and entropies of latents, comparable between all ablations."""
    scaled = dataclasses.replace(ON, dynamics_scale=2.0, representation_scale=1.0)
    off = dataclasses.replace(ON, weight="off")
    lines = []
    for alignment in (ON, scaled, off):
        agent, config = make(alignment)
        loss = jax.jit(objective.make_world_model_loss(agent, config))
        given, key = learner(params(), model_state=model_state()), jax.random.key(1)
        _, explained = loss(params(), given, batch(agent), key, jnp.asarray(1))
        lines.append(explained.metrics)
    first = lines[0]
    ratio = first["value_alignment/loss"] / first["value_alignment/kl"]
    np.testing.assert_allclose(ratio, ON.dynamics_scale + ON.representation_scale, rtol=1e-5)
    for name in ("value_alignment/kl", "latent/posterior_entropy", "latent/prior_entropy"):
        assert first[name] > 0
        np.testing.assert_allclose([line[name] for line in lines[1:]], first[name], rtol=1e-5)
    largest = tiny.CONFIG.world_model.stoch * np.log(tiny.CONFIG.world_model.classes)
    assert first["latent/prior_entropy"] < largest
