"""Open-loop prediction against the model's own functions, one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scalar_agent
import tiny

from vawm.agent import make_agent
from vawm.agent.open_loop import make_open_loop
from vawm.types import Batch, EnvSpec, Trajectory, image, vector

BATCH, LENGTH, CONTEXT = 2, 6, 3


def batch(agent, seed=0, first=()):
    rng = np.random.default_rng(seed)
    shape = BATCH, LENGTH + 1

    def draw(leaf):
        if leaf.dtype == jnp.uint8:
            return jnp.asarray(rng.integers(0, 256, (*shape, *leaf.shape)), jnp.uint8)
        return jnp.asarray(rng.normal(size=(*shape, *leaf.shape)), jnp.float32)

    flag = jnp.zeros(shape, bool)
    is_first = flag
    for place in first:
        is_first = is_first.at[place].set(True)
    action = jnp.asarray(rng.normal(size=(*shape, agent.spec.action_size)), jnp.float32)
    trajectory = Trajectory(
        jax.tree.map(draw, agent.spec.obs), jnp.zeros(shape), is_first, flag, flag, action
    )
    return Batch(trajectory, agent.world_model.memory(agent.world_model.initial(BATCH)))


def predict(agent, data, params, model_state):
    open_loop = jax.jit(make_open_loop(agent, context=CONTEXT))
    return open_loop(params, model_state, jax.random.key(1), data)


def test_by_hand_on_the_scalar_agent():
    """h is filtered over the context, then follows the actions alone."""
    agent = scalar_agent.AGENT
    data = batch(agent)
    actual = predict(agent, data, scalar_agent.PARAMS, ()).predicted[..., 0]
    obs, action = (np.asarray(x)[..., 0] for x in (data.trajectory.obs, data.trajectory.action))
    h = np.zeros(BATCH)
    for t in range(LENGTH):
        h = h / 2 + action[:, t] + obs[:, t + 1] if t < CONTEXT else h + action[:, t]
        np.testing.assert_allclose(actual[:, t], h, rtol=1e-5)


@pytest.fixture(scope="module")
def mixed():
    spec = EnvSpec("test", {"a": image(48), "b": vector(2)}, 3, False, 2, 1, None)
    agent = make_agent(tiny.CONFIG, spec)
    params, model_state = agent.init(jax.random.key(0))
    # So that samples of z follow what is seen, and not their noise alone.
    out = params.world_model["rssm"]["posterior_out"]
    params.world_model["rssm"]["posterior_out"] = jax.tree.map(lambda x: 100 * x, out)
    return agent, params, model_state


def test_what_comes_after_the_context_is_never_looked_at(mixed):
    agent, *needed = mixed
    data, other = batch(agent), batch(agent, seed=1)
    seen = jax.tree.map(
        lambda x, y: x.at[:, CONTEXT + 1 :].set(y[:, CONTEXT + 1 :]),
        data.trajectory.obs,
        other.trajectory.obs,
    )
    same = Batch(data.trajectory._replace(obs=seen), data.context)
    jax.tree.map(
        np.testing.assert_array_equal,
        predict(agent, data, *needed),
        predict(agent, same, *needed),
    )
    early = jax.tree.map(
        lambda x, y: x.at[:, CONTEXT].set(y[:, CONTEXT]),
        data.trajectory.obs,
        other.trajectory.obs,
    )
    changed = Batch(data.trajectory._replace(obs=early), data.context)
    first, second = (predict(agent, d, *needed).predicted["a"] for d in (data, changed))
    assert (first[:, CONTEXT - 1 :] != second[:, CONTEXT - 1 :]).any((2, 3, 4)).any(1).all()
    np.testing.assert_array_equal(first[:, : CONTEXT - 1], second[:, : CONTEXT - 1])


def test_predictions_have_the_tree_and_the_shapes_of_what_is_predicted(mixed):
    agent, *needed = mixed
    predicted = predict(agent, batch(agent), *needed).predicted
    assert predicted["a"].shape == (BATCH, LENGTH, 48, 48, 3)
    assert predicted["b"].shape == (BATCH, LENGTH, 2)


def test_steps_after_a_reset_are_marked(mixed):
    agent, *needed = mixed
    # Flags of the trajectory, whose first step only gives context.
    data = batch(agent, first=[(0, 2), (1, 5)])
    expected = [[False] + [True] * 5, [True] * 4 + [False] * 2]
    np.testing.assert_array_equal(predict(agent, data, *needed).same_episode, expected)
