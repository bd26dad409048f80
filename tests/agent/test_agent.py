"""Parameter counts of the official code, and acting."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from vawm.agent import make_agent, parameter_count, resolve_dtype, with_size
from vawm.config.presets import PAPER
from vawm.envs import probes
from vawm.errors import InvalidInput
from vawm.types import EnvSpec, TimeStep, image, vector

# The official DreamerV3's counts for 24 observations and 6 continuous actions.
OFFICIAL = {
    "1m": {
        "total": 640_867,
        "encoder": 10_112,
        "rssm": 364_416,
        "decoder": 51_096,
        "reward": 57_663,
        "cont": 41_153,
        "actor": 50_316,
        "critic": 66_111,
    },
    "12m": {
        "total": 9_738_019,
        "encoder": 138_752,
        "rssm": 5_783_040,
        "decoder": 794_136,
        "reward": 721_407,
        "cont": 656_129,
        "actor": 791_052,
        "critic": 853_503,
    },
    "25m": {"total": 21_782_947},
}
# The same for images of 64 x 64 x 3, by number of actions: continuous, discrete.
OFFICIAL_FROM_PIXELS = {
    ("1m", 6, False): 686_846,
    ("1m", 18, True): 688_004,
    ("12m", 6, False): 10_494_158,
    ("12m", 18, True): 10_498_772,
    ("25m", 6, False): 23_489_326,
    ("25m", 18, True): 23_496_244,
}


def spec(discrete=False):
    return EnvSpec("test", vector(24), 6, discrete, 1, 1, None)


@pytest.mark.parametrize("size", OFFICIAL)
def test_parameter_counts_are_the_official_ones(size):
    agent = make_agent(with_size(PAPER, size), spec())
    params, _ = jax.eval_shape(agent.init, jax.random.key(0))
    actual = {name: parameter_count(part) for name, part in params.world_model.items()}
    actual |= {"actor": parameter_count(params.actor), "critic": parameter_count(params.critic)}
    actual["total"] = parameter_count(params)
    assert {name: actual[name] for name in OFFICIAL[size]} == OFFICIAL[size]


@pytest.mark.parametrize(("size", "actions", "discrete"), OFFICIAL_FROM_PIXELS)
def test_parameter_counts_from_pixels_are_the_official_ones(size, actions, discrete):
    pixels = EnvSpec("test", image(64), actions, discrete, 1, 1, None)
    agent = make_agent(with_size(PAPER, size), pixels)
    params, _ = jax.eval_shape(agent.init, jax.random.key(0))
    assert parameter_count(params) == OFFICIAL_FROM_PIXELS[size, actions, discrete]


def observation(agent, is_first, is_last):
    flags = jnp.array(is_first), jnp.array(is_last)
    obs = jnp.array([[0.5, 1.0], [-2.0, 0.0]])
    return TimeStep(obs, jnp.zeros(2), *flags, jnp.zeros(2, bool))


def test_acting_is_pure_and_depends_on_the_key():
    agent = make_agent(tiny.CONFIG, tiny.env().spec)
    (params, model_state), carry = agent.init(jax.random.key(0)), agent.initial(2)
    timestep = observation(agent, [True, True], [False, False])
    act = jax.jit(agent.act)
    first = act(params, model_state, jax.random.key(1), carry, timestep)
    again = act(params, model_state, jax.random.key(1), carry, timestep)
    other = act(params, model_state, jax.random.key(2), carry, timestep)
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert (first[1] != other[1]).all()


def test_nothing_leaves_from_a_last_observation():
    agent = make_agent(tiny.CONFIG, tiny.env().spec)
    (params, model_state), carry = agent.init(jax.random.key(0)), agent.initial(2)
    timestep = observation(agent, [False, False], [True, False])
    carry, action = agent.act(params, model_state, jax.random.key(1), carry, timestep)
    assert (action[0] == 0).all()
    assert (action[1] != 0).all()
    np.testing.assert_array_equal(carry.action, action)


def test_a_first_observation_clears_what_was_remembered():
    agent = make_agent(tiny.CONFIG, tiny.env().spec)
    (params, model_state), fresh = agent.init(jax.random.key(0)), agent.initial(2)
    full = jax.tree.map(jnp.ones_like, fresh)
    timestep = observation(agent, [True, False], [False, False])
    _, expected = agent.act(params, model_state, jax.random.key(1), fresh, timestep)
    _, actual = agent.act(params, model_state, jax.random.key(1), full, timestep)
    np.testing.assert_array_equal(actual[0], expected[0])
    assert (actual[1] != expected[1]).any()


def test_a_discrete_actor_gives_one_hot_actions():
    agent = make_agent(tiny.CONFIG, tiny.env().spec._replace(discrete=True, action_size=3))
    timestep = observation(agent, [True, True], [False, False])
    _, action = agent.act(
        *agent.init(jax.random.key(0)), jax.random.key(1), agent.initial(2), timestep
    )
    assert action.shape == (2, 3)
    np.testing.assert_array_equal(np.sort(action, -1), [[0, 0, 1]] * 2)


@pytest.mark.parametrize(
    ("backend", "auto"), [("cpu", jnp.float32), ("gpu", jnp.bfloat16), ("tpu", jnp.bfloat16)]
)
def test_the_compute_dtype_follows_the_device_unless_asked_otherwise(
    backend, auto, monkeypatch
):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    assert resolve_dtype("auto") == auto
    assert resolve_dtype("bfloat16") == jnp.bfloat16
    assert resolve_dtype("float32") == jnp.float32


def discrete_agent(temperature=1.0):
    actor = dataclasses.replace(tiny.CONFIG.actor, collect_temperature=temperature)
    config = tiny.config(actor=actor)
    return make_agent(config, probes.make("memory_discrete", num_envs=256).spec)


def choices(agent, how, seed=1):
    """Actions of 256 environments that look all the same."""
    params, model_state = agent.init(jax.random.key(0))
    logits = params.actor["heads_0"]["bias"]
    params.actor["heads_0"]["bias"] = jnp.array([0.0, 1.0]).astype(logits.dtype)
    no = jnp.zeros(256, bool)
    timestep = TimeStep(jnp.zeros((256, 2)), jnp.zeros(256), ~no, no, no)
    _, action = agent.act(
        params, model_state, jax.random.key(seed), agent.initial(256), timestep, how=how
    )
    return np.asarray(action)


def test_a_low_temperature_commits_the_policy_only_while_it_collects():
    """Logits 0 and 1: 73 % for the second, nearly all of it at a temperature of 0.01."""
    cold = discrete_agent(temperature=0.01)
    assert choices(cold, "collect")[:, 1].mean() > 0.97  # 1 % is uniform
    assert 0.6 < choices(cold, "sample")[:, 1].mean() < 0.85
    usual = discrete_agent()
    np.testing.assert_array_equal(choices(usual, "collect"), choices(usual, "sample"))


def test_a_mode_is_the_same_for_every_key():
    agent = discrete_agent()
    np.testing.assert_array_equal(choices(agent, "mode"), choices(agent, "mode", seed=2))
    assert (choices(agent, "mode")[:, 1] == 1).all()


def test_a_temperature_of_continuous_actions_is_refused():
    actor = dataclasses.replace(tiny.CONFIG.actor, collect_temperature=0.5)
    with pytest.raises(InvalidInput, match=r"actor.collect_temperature=0.5: use 1"):
        make_agent(tiny.config(actor=actor), spec())
