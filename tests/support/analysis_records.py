"""Policies with random parameters, and random episodes, without compiling anything."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import toy

from vawm.agent import make_agent
from vawm.analysis.episodes import Episodes
from vawm.policy import Policy
from vawm.runs import checkpoint, run_folder
from vawm.types import Trajectory


def make_policy(config, spec, seed=0):
    """Random parameters, so that every head has an output; ones for the model state."""
    agent, rng = make_agent(config, spec), np.random.default_rng(seed)
    params, state = jax.eval_shape(agent.init, jax.random.key(0))
    params = jax.tree.map(
        lambda x: jnp.asarray(0.3 * rng.normal(size=x.shape), x.dtype), params
    )
    state = jax.tree.map(lambda x: jnp.ones(x.shape, x.dtype), state)
    act = jax.jit(agent.act, static_argnames="how")
    return Policy(config, spec, 0, params, state, agent.initial, act)


def save_run(logdir, policy, *, env_steps=8):
    """The folder of a run that saved what is needed to act, with two lines of metrics."""
    state = toy.state()
    learner = state.learner._replace(params=policy.params, model_state=policy.model_state)
    checkpoint.save(
        logdir,
        state._replace(learner=learner),
        env_steps=env_steps,
        config=policy.config,
        spec=policy.spec,
        progress={},
    )
    run_folder.write_config(logdir, policy.config)
    lines = [{"env_steps": n, "latent/kl": n / 8, "loss/dynamics": None} for n in (8, 16)]
    (logdir / "metrics.jsonl").write_text("".join(json.dumps(x) + "\n" for x in lines))
    return str(logdir)


def make_episodes(policy, *, episodes, length, seed=0):
    """Random observations, rewards and actions; the last steps are not terminal."""
    rng, shape = np.random.default_rng(seed), (episodes, length)

    def draw(leaf):
        if leaf.dtype == jnp.uint8:
            return jnp.asarray(rng.integers(0, 256, (*shape, *leaf.shape)), jnp.uint8)
        return jnp.asarray(rng.normal(size=(*shape, *leaf.shape)), jnp.float32)

    def flag(at):
        return jnp.broadcast_to(jnp.arange(length) == at, shape)

    steps = Trajectory(
        obs=jax.tree.map(draw, policy.spec.obs),
        reward=jnp.asarray(rng.normal(size=shape), jnp.float32),
        is_first=flag(0),
        is_last=flag(length - 1),
        is_terminal=flag(-1),
        action=jnp.asarray(rng.normal(size=(*shape, policy.spec.action_size)), jnp.float32),
    )
    agent = make_agent(policy.config, policy.spec)
    memory = agent.world_model.memory(policy.initial(episodes * length).memory)
    memory = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), memory)
    return Episodes(steps, memory, jnp.full(episodes, length))
