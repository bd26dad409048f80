"""What is STORM's own: its size, what acting remembers, and its own choices."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_storm
from nets_twin import noisy

from vawm.agent import make_agent, parameter_count
from vawm.config.presets import STORM, STORM_QUICK
from vawm.types import EnvSpec, image, vector
from vawm.world_model.storm import storm
from vawm.world_model.window import Window, remember

SPEC = EnvSpec("test", vector(2), 3, False, 2, 1, None)
# The official code's, for RGB images of 64 x 64 and 18 actions.
OFFICIAL = {
    "encoder": 690_624,
    "decoder": 4_884_931,
    "reward": 657_151,
    "cont": 526_849,
    "transformer": 5_032_960,
    "distributions": 4_720_640,
    "world_model": 16_513_155,
    "agent": 3_422_736,
}


def test_parameter_counts_are_the_official_ones():
    agent = make_agent(STORM, EnvSpec("test", image(64), 18, True, 1, 4, None))
    params, model_state = jax.eval_shape(agent.init, jax.random.key(0))
    model = params.world_model
    actual = {name: parameter_count(model[name]) for name in OFFICIAL if name in model}
    net = model["storm"]
    heads = {name: net[name] for name in ("posterior_out", "prior_out")}
    actual["distributions"] = parameter_count(heads)
    actual["transformer"] = parameter_count(net) - actual["distributions"]
    actual["world_model"] = parameter_count(model)
    # The official agent holds the slow critic as well.
    actual["agent"] = parameter_count(params.actor) + 2 * parameter_count(params.critic)
    assert actual == OFFICIAL
    assert parameter_count(model_state) == 2 * 960  # running means and variances


def test_the_quick_preset_is_small():
    agent = make_agent(STORM_QUICK, SPEC)
    params, _ = jax.eval_shape(agent.init, jax.random.key(0))
    assert 0.5e6 < parameter_count(params) < 1e6


def window(steps, length, latest, waits):
    """One row per entry; a step is a number, its action ten times that."""
    steps = jnp.asarray(steps, jnp.float32)
    return Window(
        obs={"a": steps[..., None]},
        action=10 * steps[..., None],
        length=jnp.asarray(length),
        latest={"a": jnp.asarray(latest, jnp.float32)[:, None]},
        waits=jnp.asarray(waits),
    )


def test_the_window_takes_the_waiting_step_and_drops_the_oldest_when_full():
    before = window(
        steps=[[0, 0, 0], [1, 0, 0], [1, 2, 3], [1, 2, 3]],
        length=[0, 1, 3, 3],
        latest=[5, 6, 7, 8],
        waits=[True, True, True, False],
    )
    after = jax.jit(remember)(before, 10 * before.latest["a"])
    expected = [[5, 0, 0], [1, 6, 0], [2, 3, 7], [1, 2, 3]]
    np.testing.assert_array_equal(after.obs["a"][..., 0], expected)
    np.testing.assert_array_equal(after.action[..., 0], 10 * np.array(expected))
    np.testing.assert_array_equal(after.length, [1, 2, 3, 3])


@functools.cache
def make(**changes):
    model = storm(tiny_storm.model(**changes), SPEC)
    params, model_state = model.init(jax.random.key(0))
    params = noisy(params)
    out = params["storm"]["posterior_out"]
    params["storm"]["posterior_out"] = out | {"kernel": 100 * out["kernel"]}
    return model, jax.jit(model.filter), params, model_state


def act(steps, is_first=None, **changes):
    """Latents along observations `[T, 2 environments]`, under one noise; actions are 0.5."""
    model, filter_step, params, model_state = make(**changes)
    carry, latents = model.initial(2), []
    action = jnp.full((2, 3), 0.5)
    for t, seen in enumerate(steps):
        first = jnp.zeros(2, bool) if is_first is None else jnp.asarray(is_first[t])
        obs = jnp.broadcast_to(jnp.asarray(seen, jnp.float32)[:, None], (2, 2))
        carry, latent = filter_step(
            params, model_state, jax.random.key(1), carry, obs, action, first
        )
        latents.append(latent)
    return latents


def test_before_anything_was_seen_h_is_0():
    first, second = act([[1.0, -3.0], [1.0, 1.0]])
    assert (first.deter == 0).all()
    assert (second.deter != 0).any(-1).all()


def test_with_the_prior_the_policy_does_not_see_the_observation_it_acts_on():
    seen, other = ([[1.0, 1.0], [x, x], [2.0, 2.0]] for x in (0.0, 30.0))
    first, second = act(seen), act(other)
    jax.tree.map(np.testing.assert_array_equal, first[1], second[1])
    assert (first[2].deter != second[2].deter).any()  # but the one after that does


def test_with_the_posterior_it_does():
    seen, other = ([[1.0, 1.0], [x, x]] for x in (0.0, 30.0))
    first, second = (act(steps, act_latent="posterior") for steps in (seen, other))
    np.testing.assert_array_equal(first[1].deter, second[1].deter)
    assert (first[1].stoch != second[1].stoch).any()


@pytest.mark.parametrize("clear", [False, True])
def test_only_a_cleared_context_forgets_the_episode_before(clear):
    steps, other = ([[x, x], [0.5, 0.5], [1.0, 1.0]] for x in (0.0, 30.0))
    flags = [[False, False], [True, False], [False, False]]
    first, second = (act(s, flags, clear_context=clear) for s in (steps, other))
    same = [(a.deter == b.deter).all(-1) for a, b in zip(first, second, strict=True)]
    np.testing.assert_array_equal(same[1], [clear, False])
    np.testing.assert_array_equal(same[2], [clear, False])


def test_no_more_than_the_last_steps_are_remembered():
    context = tiny_storm.CONFIG.world_model.act_context
    steps, other = ([[x, x]] + [[0.1 * t] * 2 for t in range(context + 1)] for x in (0.0, 30.0))
    first, second = act(steps), act(other)
    assert (first[context].deter != second[context].deter).any()
    np.testing.assert_array_equal(first[context + 1].deter, second[context + 1].deter)
