"""World models with a loss of their own, or without a decoder."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scalar_agent
from learners import learner
from objective_twin import SLOW, batch
from scalar_agent import AGENT, CONFIG, PARAMS

from vawm.errors import InvalidInput
from vawm.learning import objective
from vawm.learning.state import init_learner
from vawm.learning.update import make_update


def explaining(change):
    """The scalar agent; `change` makes another `Explanation` of its own and its parameter."""

    def explain(params, model_state, key, batch):
        explanation, model_state = scalar_agent.explain(params, model_state, key, batch)
        return change(explanation, params), model_state

    return AGENT._replace(world_model=AGENT.world_model._replace(explain=explain))


def adding(**named):
    """`named` are functions of the parameter."""
    return explaining(
        lambda explanation, params: explanation._replace(
            losses={name: loss(params) for name, loss in named.items()}
        )
    )


def without_decoder(*, targets):
    """It predicts no observation; its targets have one or not."""

    def change(explanation, params):
        own = explanation.targets if targets else explanation.targets._replace(obs=())
        return explanation._replace(
            predictions=explanation.predictions._replace(obs=()), targets=own
        )

    return explaining(change)


def of(agent):
    """The loss of the world model, its metrics and its gradient."""
    loss = objective.make_world_model_loss(agent, CONFIG)

    def run(world_model):
        params = PARAMS._replace(world_model=world_model)
        given = learner(params, slow_critic=jnp.float32(SLOW))
        value, explained = loss(params, given, batch(), jax.random.key(0), jnp.asarray(1))
        return value, explained.metrics

    differentiate = jax.jit(jax.value_and_grad(run, has_aux=True))
    (value, metrics), gradient = differentiate(PARAMS.world_model)
    return value, metrics, gradient


def test_a_further_loss_is_added_logged_and_differentiated():
    """A scalar 3 w^2 and a loss of each state that is 5 w on average."""
    weights = jnp.arange(8.0).reshape(2, 4) * 5 / 3.5
    value, metrics, gradient = of(
        adding(square=lambda w: 3 * w**2, slope=lambda w: w * weights)
    )
    usual, plain, plain_gradient = of(AGENT)
    w = PARAMS.world_model
    np.testing.assert_allclose(value - usual, 3 * w**2 + 5 * w, rtol=1e-5)
    np.testing.assert_allclose(gradient - plain_gradient, 6 * w + 5, rtol=1e-5)
    np.testing.assert_allclose(metrics["loss/square"], 3 * w**2, rtol=1e-6)
    np.testing.assert_allclose(metrics["loss/slope"], 5 * w, rtol=1e-6)
    assert metrics.keys() - plain.keys() == {"loss/square", "loss/slope"}
    for name in plain:
        np.testing.assert_array_equal(metrics[name], plain[name])


def test_without_further_losses_nothing_changes():
    for first, second in zip(of(adding()), of(AGENT), strict=True):
        jax.tree.map(np.testing.assert_array_equal, first, second)


def test_an_update_follows_a_further_loss():
    after = {}
    for name, agent in {"with": adding(push=lambda w: -1e3 * w), "without": AGENT}.items():
        start = init_learner(agent, CONFIG, jax.random.key(0))
        update = jax.jit(make_update(agent, CONFIG))
        for _ in range(2):  # the first one has a learning rate of 0
            start, _, metrics = update(start, batch(), (), jax.random.key(0), jnp.asarray(1))
        after[name] = start.params.world_model
    assert after["without"] < PARAMS.world_model < after["with"]
    assert "loss/push" not in metrics


@pytest.mark.parametrize("name", ["reward", "critic", "value_alignment", "total"])
def test_the_name_of_one_of_our_losses_is_refused(name):
    with pytest.raises(InvalidInput) as error:
        of(adding(**{name: lambda w: w}))
    assert (error.value.field, error.value.value) == ("loss", name)


def test_losses_on_latents_are_added_by_name_and_none_replaces_another():
    def losses(critic, slow_critic, inference):
        return {"mine": 3.0 + 0.0 * inference.latent.deter.sum()}

    value, metrics, _ = of(AGENT._replace(latent_losses=losses))
    usual, plain, _ = of(AGENT)
    np.testing.assert_allclose(value - usual, 3.0, rtol=1e-4)
    assert metrics.keys() - plain.keys() == {"loss/mine"}
    for taken in (adding(mine=lambda w: w)._replace(latent_losses=losses),):
        with pytest.raises(InvalidInput) as error:
            of(taken)
        assert (error.value.field, error.value.value) == ("loss", "mine")


@pytest.mark.parametrize("targets", [True, False])
def test_without_decoder_there_is_no_reconstruction_loss(targets):
    value, metrics, _ = of(without_decoder(targets=targets))
    usual, plain, _ = of(AGENT)
    np.testing.assert_allclose(usual - value, plain["loss/reconstruction"], rtol=1e-4)
    assert plain.keys() - metrics.keys() == {"loss/reconstruction"}
