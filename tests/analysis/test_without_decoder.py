"""A world model that predicts no observation: what needs a decoder says so, or is left out."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_pixels
from analysis_records import make_episodes, make_policy
from refusals import refused

from vawm.agent import make_agent, registry
from vawm.analysis import film, saliency, trajectories
from vawm.learning.replay import Replay
from vawm.runs.reports import video
from vawm.types import EnvSpec

SPEC = EnvSpec("mixed", tiny_pixels.Lamp.obs, 2, False, 2, 1, None)


@pytest.fixture
def policy(monkeypatch):
    row = registry.kind("dreamerv3")

    def without_decoder(*arguments, **choices):
        world_model = row.make(*arguments, **choices)

        def predict(*arguments):
            return world_model.predict(*arguments)._replace(obs=())

        return world_model._replace(predict=predict)

    monkeypatch.setitem(registry._ROWS, "dreamerv3", row._replace(make=without_decoder))
    return make_policy(tiny_pixels.CONFIG, SPEC)


ANALYSES = {
    "film": lambda *given: film.make(*given, context=3, depth=4, seed=0),
    "trajectories": lambda *given: trajectories.imagine(*given, context=3, depth=4, seed=0),
    "saliency": lambda *given: saliency.look(*given, context=3, frames=1, seed=0),
}


@pytest.mark.parametrize("name", ANALYSES)
def test_an_analysis_that_needs_a_decoder_is_refused(policy, name):
    with refused("world_model", None):
        ANALYSES[name](policy, make_episodes(policy, episodes=1, length=12))


def test_training_films_the_episode_alone(policy):
    config = dataclasses.replace(policy.config, video=tiny_pixels.CONFIG.video)
    agent = make_agent(config, SPEC)
    steps = make_episodes(policy, episodes=2, length=16).trajectory
    first = jnp.arange(16) % 5 == 0
    steps = steps._replace(
        is_first=jnp.tile(first, (2, 1)), is_last=jnp.tile(jnp.roll(first, -1), (2, 1))
    )
    latent = agent.world_model.memory(agent.world_model.initial(2))
    latent = jax.tree.map(lambda x: jnp.repeat(x[:, None], 16, axis=1), latent)
    state = SimpleNamespace(
        learner=SimpleNamespace(params=policy.params, model_state=policy.model_state),
        collector=SimpleNamespace(env_steps=jnp.int32(32)),
        replay=Replay(steps, latent, head=np.int32(0), size=np.int32(16)),
        images=(),
    )
    films = video.make(SimpleNamespace(agent=agent), config)(state)
    assert [made.name for made in films] == ["episode"]
