"""Saliency against an explicit Jacobian, and through the straight-through gradient."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
import tiny_pixels
import tiny_storm
import tiny_vagram
from analysis_records import make_episodes, make_policy
from refusals import refused

from vawm.agent import Agent, make_agent
from vawm.analysis import episodes, saliency
from vawm.losses import transforms
from vawm.policy import Policy
from vawm.types import Batch, EnvSpec, Latent, vector

# As the run from pixels that test_analysis_program analyses, so that one of both compiles.
MIXED = EnvSpec("mixed", tiny_pixels.Lamp.obs, 2, False, 2, 1, None)
VECTORS = MIXED._replace(obs={"clock": vector(2)})
CONTEXT, FRAMES, LENGTH, SEED = 3, 2, 6, 2


class Setting(NamedTuple):
    policy: Policy
    agent: Agent
    data: episodes.Episodes
    batch: Batch
    unit: saliency.Unit
    maps: saliency.Saliency

    def follow(self, batch):
        """The states at the ends of `batch`, drawn as the maps were."""
        key = jax.random.split(jax.random.key(SEED))[0]
        inferred, _ = self.agent.world_model.follow(
            self.policy.params.world_model, self.policy.model_state, key, batch, horizon=1
        )
        return jax.tree.map(lambda x: x[:, -1], inferred)

    def value(self, latent):
        logits = self.agent.critic.logits(self.policy.params.critic, latent)
        mean = self.agent.critic.code.mean(logits)
        return transforms.symlog(mean) if self.unit == "symlog" else mean


@pytest.fixture(
    scope="module",
    params=[(tiny.CONFIG, MIXED, "symlog"), (tiny_storm.CONFIG, VECTORS, "raw")],
    ids=["rssm", "storm"],
)
def setting(request):
    return make_setting(*request.param)


def make_setting(config, spec, unit):
    model = dataclasses.replace(config.world_model, depth=1)
    policy = make_policy(dataclasses.replace(config, world_model=model), spec)
    agent = make_agent(policy.config, spec)
    data = make_episodes(policy, episodes=1, length=LENGTH)
    batch = episodes.windows(data, [0, 0], [0, LENGTH - CONTEXT], length=CONTEXT)
    make = jax.jit(saliency.make_saliency(agent, unit=unit))
    maps = make(policy.params, policy.model_state, jax.random.key(SEED), batch)
    return Setting(policy, agent, data, batch, unit, maps)


@pytest.fixture(scope="module")
def straight(setting):
    """The states that the maps are of, and the gradient of the value through their z."""
    batch = setting.batch

    def weighed(last):
        obs = batch.trajectory.obs
        seen = {k: jnp.concatenate([x[:, :-1], last[k][:, None]], 1) for k, x in obs.items()}
        moved = batch._replace(trajectory=batch.trajectory._replace(obs=seen))
        latent = setting.follow(moved)
        slope = jax.grad(lambda z: setting.value(Latent(latent.deter, z)).sum())(latent.stoch)
        # Only the draw of z is differentiated: its gradient is that of its probabilities.
        return (latent.stoch * jax.lax.stop_gradient(slope)).sum(), latent

    gradient = jax.jit(jax.grad(weighed, has_aux=True))
    last = {k: x[:, -1].astype(jnp.float32) for k, x in batch.trajectory.obs.items()}
    return gradient(last)


PIXELS = np.random.default_rng(5).integers(48, size=(2, 12))  # some of them


def some(maps):
    """`[F, ...]` at `PIXELS`, and all coordinates."""
    return {k: x[:, *PIXELS] if x.ndim > 2 else x for k, x in maps.items()}


@pytest.fixture(scope="module")
def slow(setting, straight):
    """Rows of the decoder's Jacobian, `[F, ..., S * K]`, and dV/dz, on the simplex of z."""
    policy, agent, *_ = setting
    latent = straight[1]

    def decode(z, h):
        one = Latent(h[None], z[None])
        obs = agent.world_model.predict(policy.params.world_model, policy.model_state, one).obs
        return jax.tree.map(lambda x: x[0], some(obs))

    def value(z, h):
        return setting.value(Latent(h[None], z[None]))[0]

    jacobian, slope = jax.jit(
        jax.vmap(lambda *s: (jax.jacrev(decode)(*s), jax.grad(value)(*s)))
    )(latent.stoch, latent.deter)

    def flat(x):
        x = np.asarray(x, np.float64)
        return (x - x.mean(-1, keepdims=True)).reshape(*x.shape[:-2], -1)

    return {k: flat(x) for k, x in jacobian.items()}, flat(slope)


def over_colours(squares, kind):
    """Euclidean norm, or absolute value."""
    return np.sqrt(squares.sum(-1) if kind == "picture" else squares)


def test_the_value_map_is_the_jacobian_times_the_slope_of_the_value(setting, slow):
    jacobians, slope = slow
    for kind, jacobian in jacobians.items():
        moved = np.einsum("f...j,fj->f...", jacobian, slope)
        actual = np.asarray(some(setting.maps.value)[kind])
        expected = over_colours(moved**2, kind)
        np.testing.assert_allclose(actual, expected, rtol=1e-3, atol=1e-3 * expected.max())
        assert (actual > 0).any()


def test_the_sensitivity_is_the_length_of_the_jacobian_s_rows(setting, slow):
    """Within five standard errors of its random signs, of which each is at most 13 %."""
    for kind, jacobian in slow[0].items():
        exact = over_colours((jacobian**2).sum(-1), kind)
        ratio = (np.asarray(some(setting.maps.sensitivity)[kind]) / exact) ** 2
        assert abs(ratio - 1).max() < 5 * np.sqrt(2 / 128)
        assert ratio.mean() == pytest.approx(1, abs=0.15)


def test_the_observed_gradient_goes_through_the_probabilities_of_z(setting, straight):
    for kind, slope in straight[0].items():
        expected = np.abs(slope)
        if kind == "picture":  # by pixels in [0, 1], over colours
            expected = 255 * np.sqrt(np.square(np.asarray(slope, np.float64)).sum(-1))
        actual = np.asarray(setting.maps.observed[kind])
        np.testing.assert_allclose(actual, expected, rtol=1e-3, atol=1e-3 * expected.max())
        assert (actual > 0).any()


def test_without_sampling_the_observed_gradient_is_that_of_the_value():
    setting = make_setting(tiny_vagram.CONFIG, VECTORS, "raw")
    steps = setting.batch.trajectory

    def value(last):
        seen = jnp.concatenate([steps.obs["clock"][:, :-1], last[:, None]], axis=1)
        moved = steps._replace(obs={"clock": seen})
        return setting.value(setting.follow(setting.batch._replace(trajectory=moved))).sum()

    slope = jax.jit(jax.grad(value))(steps.obs["clock"][:, -1])
    np.testing.assert_allclose(setting.maps.observed["clock"], abs(slope), rtol=1e-4)
    assert (setting.maps.observed["clock"] > 0).all()


def test_the_value_is_in_its_unit(setting, straight):
    np.testing.assert_allclose(setting.maps.states, setting.value(straight[1]), rtol=1e-4)


def test_a_look_at_an_episode_is_evenly_spaced(setting):
    policy, _, data, *_ = setting
    if "picture" in data.trajectory.obs:
        return  # the same, for more work
    choices = {"context": CONTEXT, "frames": FRAMES, "seed": SEED, "unit": setting.unit}
    look = saliency.look(policy, data, **choices)
    assert look.step.tolist() == [2, 5]
    # The same windows and the same key as the maps have.
    np.testing.assert_array_equal(look.saliency.value["clock"], setting.maps.value["clock"])
    np.testing.assert_array_equal(
        look.truth["clock"], data.trajectory.obs["clock"][0, look.step]
    )
    assert saliency.coordinates(look.truth, look.saliency.observed).shape == (2, 2)


def test_rows_are_of_images_and_of_coordinates(setting):
    truth = jax.tree.map(lambda x: x[:, -1], setting.batch.trajectory.obs)
    look = saliency.Look(np.array([2, 5]), *jax.device_get((truth, setting.maps)), "raw")
    rows = {(row["map"], row["what"]): row["value"] for row in saliency.rows("run", look)}
    expected = np.mean(setting.maps.observed["clock"][:, 0])
    assert rows["observed", "coordinate 0"] == pytest.approx(expected)
    if "picture" in truth:
        for kind in saliency.MAPS:
            pixels = saliency.images(look.truth, getattr(look.saliency, kind))
            np.testing.assert_array_equal(pixels, getattr(setting.maps, kind)["picture"])
            assert rows[kind, "concentration"] == saliency.concentration(pixels)


def test_impossible_contexts_and_frames_are_refused(setting):
    policy, _, data, *_ = setting
    with refused("context", 7, naming="6"):
        saliency.look(policy, data, context=7, frames=1, seed=0)
    with refused("frames", 0):
        saliency.look(policy, data, context=3, frames=0, seed=0)


def test_concentration_by_hand():
    even, single = np.ones((1, 10, 2)), np.zeros((1, 10, 2))
    single[0, 3, 1] = 5.0
    assert saliency.concentration(even) == pytest.approx(0.1)
    assert saliency.concentration(np.concatenate([even, single])) == pytest.approx(0.55)
    assert np.isnan(saliency.concentration(np.zeros((2, 4))))
