"""The deterministic world model in the same training step: probabilities in replay."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import runs
import tiny
import tiny_pixels
import tiny_vagram

from vawm.agent import make_agent
from vawm.learning import train
from vawm.policy import policy
from vawm.runs import runner

CONFIG = tiny_vagram.CONFIG


def test_a_run_from_pixels_on_the_host(tmp_path):
    config = dataclasses.replace(
        tiny_pixels.CONFIG,
        agent="vagram",
        world_model=dataclasses.replace(CONFIG.world_model, depth=1),
        value_alignment=CONFIG.value_alignment,
    )
    runner.run(config, tmp_path, env=tiny_pixels.pool(), console=runs.quiet())
    *_, last = runs.lines(tmp_path)
    assert (last["env_steps"], last["updates"]) == (config.env_steps, 18)
    assert all(np.isfinite(x) for name, x in last.items() if name.startswith("loss/"))
    assert last["loss/value_gradient"] > 0
    assert last["loss/dynamics"] == last["loss/value_alignment"] == 0.0
    loaded = policy.load(tmp_path)
    assert loaded.config.agent == "vagram"


def test_it_learns_and_replay_remembers_probabilities():
    env = tiny.env()
    agent = make_agent(CONFIG, env.spec)
    step = chex.assert_max_traces(train.make_train_step(env, agent, CONFIG), n=1)
    run = jax.jit(step, donate_argnums=0)
    first = jax.jit(lambda key: train.init(env, agent, CONFIG, key))(jax.random.key(0))
    state, lines = jax.tree.map(jnp.copy, first), []
    for _ in range(8):
        state, metrics = run(state)
        lines.append({name: float(value) for name, value in metrics.items()})
    assert lines[-1]["updates"] > 2
    assert all(np.isfinite(value) for value in lines[-1].values())
    assert lines[-1]["loss/value_gradient"] > 0
    assert lines[-1]["loss/dynamics"] == lines[-1]["loss/value_alignment"] == 0.0
    for part in ("rssm", "encoder", "decoder", "reward", "cont"):
        moved = jax.tree.map(
            lambda a, b: float(abs(a - b).max()),
            first.learner.params.world_model[part],
            state.learner.params.world_model[part],
        )
        assert max(jax.tree.leaves(moved)) > 0, part
    kept = state.replay.latent.stoch[:, : int(state.replay.size)]
    assert kept.dtype == jnp.float32
    np.testing.assert_allclose(kept.sum(-1), 1.0, rtol=1e-5)
    assert ((kept > 0) & (kept < 1)).all()
    # Numbers of 1e30, whose squares are infinite, are learned from and all stays finite.
    stored = state.replay.trajectory
    obs, reward = stored.obs.at[:, ::3].set(1e30), stored.reward.at[:, ::3].set(-1e30)
    huge = stored._replace(obs=obs, reward=reward)
    state = state._replace(replay=state.replay._replace(trajectory=huge))
    for _ in range(3):
        state, metrics = run(state)
        assert all(np.isfinite(value) for value in metrics.values())
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(state.learner))
