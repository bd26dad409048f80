"""What holds for every world model, through its public functions alone."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
import tiny_storm
import tiny_vagram
from nets_twin import noisy

from vawm.agent import make_agent
from vawm.config import ValueAlignmentConfig
from vawm.learning.alignment import make_value_alignment
from vawm.types import Batch, EnvSpec, Trajectory, image, vector

BATCH, LENGTH = 3, 6
VECTOR, PIXELS = vector(4), image(48)
MODELS = {
    "rssm": (tiny.CONFIG, VECTOR),
    "vagram": (tiny_vagram.CONFIG, VECTOR),
    "storm": (tiny_storm.CONFIG, VECTOR),
    "storm_clear": (
        tiny_storm.config(world_model=tiny_storm.model(clear_context=True)),
        VECTOR,
    ),
    "storm_pixels": (tiny_storm.config(world_model=tiny_storm.model(depth=4)), PIXELS),
}
RECURRENT = "rssm", "vagram"
FORGETTING = (*RECURRENT, "storm_clear")  # what was before an episode does not matter in it


@functools.cache
def agent_of(name):
    """Without unimix, so that samples can be made sure, as in `blind`."""
    config, obs = MODELS[name]
    model = dataclasses.replace(config.world_model, unimix=0.0)
    config = dataclasses.replace(config, world_model=model)
    return make_agent(config, EnvSpec("test", obs, 3, False, BATCH, 1, None))


@functools.cache
def variables(name):
    """Parameters that are nowhere 0, and a model_state that training has moved.

    Posteriors are made sure of what they see, so that z follows it and not its noise alone.
    """
    params, model_state = jax.jit(agent_of(name).init)(jax.random.key(0))
    params = noisy(params)
    if jax.tree.leaves(model_state):
        _, moved = explain(name)(params, model_state, 3, experience(name, seed=3))
        model_state = jax.tree.map(lambda old, new: old + 10 * (new - old), model_state, moved)
    net = params.world_model["rssm" if name in RECURRENT else "storm"]
    out = net["posterior_out"]
    net["posterior_out"] = out | {"kernel": 100 * out["kernel"]}
    return params, model_state


@functools.cache
def blind(name):
    """As `variables`, but z is the same whatever is seen and predicted, for every noise."""
    params, model_state = variables(name)
    world_model = jax.tree.map(lambda x: x, params.world_model)
    net = world_model["rssm" if name in RECURRENT else "storm"]
    prior = ("prior_net", "heads_0") if name in RECURRENT else "prior_out"
    for path in ("posterior_out", prior):
        path = (path,) if isinstance(path, str) else path
        layer = functools.reduce(lambda node, key: node[key], path, net)
        layer["kernel"] = jnp.zeros_like(layer["kernel"])
        sure = jnp.zeros_like(layer["bias"]).reshape(-1, 4).at[:, 1].set(1e3)
        layer["bias"] = sure.reshape(-1)
    return params._replace(world_model=world_model), model_state


def experience(name, seed=1, first=()):
    """`[BATCH, LENGTH + 1]` steps; episodes begin at the places in `first`."""
    agent, rng = agent_of(name), np.random.default_rng(seed)
    shape = BATCH, LENGTH + 1

    def draw(leaf):
        if leaf.dtype == jnp.uint8:
            light = rng.uniform(size=(*shape, 1, 1, 1))  # noise alone looks all the same
            pixels = light * rng.integers(0, 256, (*shape, *leaf.shape))
            return jnp.asarray(pixels, jnp.uint8)
        return jnp.asarray(rng.normal(size=(*shape, *leaf.shape)), jnp.float32)

    flags = jnp.zeros(shape, bool)
    is_first = flags
    for place in first:
        is_first = is_first.at[place].set(True)
    trajectory = Trajectory(
        obs=jax.tree.map(draw, agent.spec.obs),
        reward=jnp.asarray(rng.normal(size=shape), jnp.float32),
        is_first=is_first,
        is_last=flags,
        is_terminal=flags,
        action=jnp.asarray(rng.normal(size=(*shape, 3)), jnp.float32),
    )
    return Batch(trajectory, agent.world_model.memory(agent.world_model.initial(BATCH)))


def cut(batch, start, stop):
    return batch._replace(trajectory=jax.tree.map(lambda x: x[:, start:stop], batch.trajectory))


@functools.cache
def jitted(name, function):
    """A function of the world model, with a seed in place of its key."""
    run = getattr(agent_of(name).world_model, function)
    if function == "follow":
        run = functools.partial(run, horizon=LENGTH)
    return jax.jit(
        lambda params, model_state, seed, *args: run(
            params.world_model, model_state, jax.random.key(seed), *args
        )
    )


def follow(name):
    """`(params, model_state, seed, batch) -> (latents inferred, state of imagination)`."""
    return jitted(name, "follow")


def explain(name):
    return jitted(name, "explain")


def imagine(name):
    return jitted(name, "imagine")


def close(actual, expected, atol=1e-5):
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, atol=atol, rtol=1e-5), actual, expected
    )


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("seen", [2, 4])
def test_steps_imagined_one_by_one_are_those_of_the_whole_sequence(name, seen):
    """With z fixed, h depends on actions alone: read at once, or step by step from a cache."""
    (params, model_state), batch, seed = blind(name), experience(name), 2
    whole, (_, after) = follow(name)(params, model_state, seed, batch)
    _, (carry, latent) = follow(name)(params, model_state, seed, cut(batch, 0, seen))
    action = batch.trajectory.action
    for t in range(seen, LENGTH + 1):
        close(latent.deter, whole.deter[:, t - 1])
        np.testing.assert_array_equal(latent.stoch, whole.stoch[:, t - 1])
        carry, latent = imagine(name)(params, model_state, t, carry, action[:, t])
    close(latent.deter, after.deter)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("what", ["obs", "action"])
def test_a_change_leaves_everything_before_it_as_it_was(name, what):
    (params, model_state), seed, at = variables(name), 2, 3
    batch, other = experience(name), experience(name, seed=9).trajectory
    changed = jax.tree.map(
        lambda x, y: x.at[:, at].set(y[:, at]),
        getattr(batch.trajectory, what),
        getattr(other, what),
    )
    changed = batch._replace(trajectory=batch.trajectory._replace(**{what: changed}))
    (first, _), (second, _) = (
        follow(name)(params, model_state, seed, b) for b in (batch, changed)
    )
    # Entry t - 1 is step t: z_t is the first that sees o_t, h_{t+1} the first that sees a_t.
    untouched = at - 1 if what == "obs" else at
    for a, b in zip(first, second, strict=True):
        close(a[:, :untouched], b[:, :untouched], atol=1e-6)
    assert (first.deter[:, at:] != second.deter[:, at:]).any()
    close(first.deter[:, :at], second.deter[:, :at], atol=1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_a_first_step_forgets_what_was_before_it_if_the_model_does(name):
    (params, model_state), seed, at = variables(name), 2, 3
    places = [(slice(None), at)]
    batch, other = (experience(name, seed=s, first=places) for s in (1, 9))
    mixed = jax.tree.map(
        lambda x, y: x.at[:, :at].set(y[:, :at]), batch.trajectory, other.trajectory
    )
    first, (_, next_one) = follow(name)(params, model_state, seed, batch)
    second, (_, next_other) = follow(name)(
        params, model_state, seed, batch._replace(trajectory=mixed)
    )
    same = np.allclose(first.deter[:, at - 1 :], second.deter[:, at - 1 :], atol=1e-6)
    assert same == (name in FORGETTING)
    if same:
        close(next_one, next_other, atol=1e-6)
        return
    # Then flags change nothing at all.
    flagless = batch.trajectory._replace(is_first=jnp.zeros_like(batch.trajectory.is_first))
    close(
        follow(name)(params, model_state, seed, batch._replace(trajectory=flagless))[0], first
    )


@pytest.mark.parametrize("name", MODELS)
def test_imagination_after_a_first_step_does_not_see_the_episode_before(name):
    """The cache hides it too, where models forget."""
    (params, model_state), seed = variables(name), 2
    batch, other = (experience(name, seed=s, first=[(slice(None), 4)]) for s in (1, 9))
    mixed = jax.tree.map(
        lambda x, y: x.at[:, :4].set(y[:, :4]), batch.trajectory, other.trajectory
    )
    reached = []
    for data in (batch, batch._replace(trajectory=mixed)):
        _, (carry, _) = follow(name)(params, model_state, seed, data)
        reached.append(imagine(name)(params, model_state, seed, carry, jnp.ones((BATCH, 3))))
    same = np.allclose(reached[0][1].deter, reached[1][1].deter, atol=1e-6)
    assert same == (name in FORGETTING)


def test_training_forgets_at_the_same_step_as_acting():
    """With `clear_context` h is 0 at a first step, and what was before leaves no trace."""
    name, seed, at = "storm_clear", 2, 3
    (params, model_state), places = variables(name), [(slice(None), at)]
    batch, other = (experience(name, seed=s, first=places) for s in (1, 9))
    mixed = jax.tree.map(
        lambda x, y: x.at[:, :at].set(y[:, :at]), batch.trajectory, other.trajectory
    )
    deter, changed = (
        explain(name)(params, model_state, seed, b)[0].inference.latent.deter
        for b in (batch, batch._replace(trajectory=mixed))
    )
    # Entry t - 1 is step t.
    np.testing.assert_array_equal((deter == 0).all((0, 2)), np.arange(1, LENGTH) == at)
    close(deter[:, at - 1 :], changed[:, at - 1 :], atol=1e-6)
    assert (deter[:, : at - 1] != changed[:, : at - 1]).any()


def test_a_cleared_context_starts_anew_where_its_last_step_ends_an_episode():
    """As a sequence of training has it: h is 0 there, and nothing before is seen again."""
    name, seed = "storm_clear", 2
    params, model_state = variables(name)
    reached = []
    for s in (1, 9):
        batch = experience(name, seed=s)
        is_last = batch.trajectory.is_last.at[:, -1].set(True)
        ended = batch._replace(trajectory=batch.trajectory._replace(is_last=is_last))
        _, (carry, latent) = follow(name)(params, model_state, seed, ended)
        assert (latent.deter == 0).all()
        reached.append(imagine(name)(params, model_state, seed, carry, jnp.ones((BATCH, 3)))[1])
    close(*reached, atol=1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_acting_step_by_step_sees_what_a_sequence_sees(name):
    """The latents of `filter` have the h of `follow`, as long as its memory reaches back."""
    agent, (params, model_state) = agent_of(name), blind(name)
    batch, seed = experience(name, first=[(slice(None), 0)]), 2
    steps = batch.trajectory
    filter_step = jitted(name, "filter")
    carry = agent.world_model.initial(BATCH)
    whole, _ = follow(name)(params, model_state, seed, batch)
    action = jnp.zeros((BATCH, 3))
    for t in range(5):
        obs = jax.tree.map(lambda x, t=t: x[:, t], steps.obs)
        carry, latent = filter_step(
            params, model_state, seed, carry, obs, action, steps.is_first[:, t]
        )
        action = steps.action[:, t]
        if name in RECURRENT and t == 0:
            # A sequence of replay begins with the latent stored there, not with its first step.
            whole, _ = follow(name)(
                params,
                model_state,
                seed,
                batch._replace(context=agent.world_model.memory(latent)),
            )
        if t:
            close(latent.deter, whole.deter[:, t - 1])


@pytest.mark.parametrize("name", MODELS)
def test_explaining_is_traced_once_and_equal_without_jit(name):
    (params, model_state), seed = variables(name), 2
    run = agent_of(name).world_model.explain
    once = jax.jit(chex.assert_max_traces(lambda *args: run(*args), n=1))
    for s in (1, 2):
        batch = experience(name, seed=s)
        compiled = once(params.world_model, model_state, jax.random.key(seed), batch)
    eager = run(params.world_model, model_state, jax.random.key(seed), batch)
    for a, b in zip(*map(jax.tree.leaves, (compiled, eager)), strict=True):
        b = np.asarray(b, np.float32)  # logits are of the order of 100
        np.testing.assert_allclose(a, b, atol=2e-5 * max(1.0, abs(b).max() / 10))


@pytest.mark.parametrize("name", MODELS)
def test_imagining_is_traced_once_and_equal_without_jit(name):
    (params, model_state), batch = variables(name), experience(name)
    model, action = agent_of(name).world_model, batch.trajectory.action[:, 0]

    def two_steps(model_state, key):
        first, *keys = jax.random.split(key, 3)
        inferred, (carry, latent) = model.follow(
            params.world_model, model_state, first, batch, horizon=2
        )
        for key in keys:
            carry, latent = model.imagine(params.world_model, model_state, key, carry, action)
        return inferred, latent

    once = jax.jit(chex.assert_max_traces(two_steps, n=1))
    for seed in (1, 2):
        compiled = once(model_state, jax.random.key(seed))
    eager = two_steps(model_state, jax.random.key(seed))
    for a, b in zip(*map(jax.tree.leaves, (compiled, eager)), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5)


@pytest.mark.parametrize("name", ["storm", "storm_clear", "storm_pixels"])
def test_what_storm_imagines_is_drawn_from_the_prior_at_its_own_h(name):
    """That of the RSSM is in `test_world_model_rssm`. A sure prior leaves little to chance."""
    (params, model_state), batch = variables(name), experience(name)
    model = jax.tree.map(lambda x: x, params.world_model)
    out = model["storm"]["prior_out"]
    out = out | {"kernel": 100 * out["kernel"]}
    model["storm"]["prior_out"] = out
    params = params._replace(world_model=model)
    _, (carry, latent) = follow(name)(params, model_state, 2, batch)
    drawn = []
    for t in range(4):
        logits = latent.deter @ out["kernel"] + out["bias"].reshape(1, -1)
        probs = np.asarray(jax.nn.softmax(logits.reshape(latent.stoch.shape)))
        sure = probs.max(-1) > 0.999
        assert sure.mean() > 0.5
        np.testing.assert_array_equal(latent.stoch.argmax(-1)[sure], probs.argmax(-1)[sure])
        drawn.append(np.asarray(latent.stoch))
        carry, latent = imagine(name)(
            params, model_state, t, carry, batch.trajectory.action[:, t]
        )
    assert (drawn[0] != drawn[-1]).any()


@pytest.mark.parametrize("name", MODELS)
def test_targets_are_what_arrived_where_the_predictions_are(name):
    (params, model_state), batch = variables(name), experience(name)
    explanation, _ = explain(name)(params, model_state, 2, batch)
    predictions, targets = explanation.predictions, explanation.targets
    chex.assert_equal_shape([predictions.cont, targets.reward, targets.is_terminal])
    chex.assert_trees_all_equal_shapes(predictions.obs, targets.obs)
    np.testing.assert_array_equal(targets.reward, batch.trajectory.reward[:, 1:])
    at = slice(1, None) if name in RECURRENT else slice(0, -1)
    np.testing.assert_array_equal(targets.obs, batch.trajectory.obs[:, at])


def test_value_alignment_trains_the_latent_dynamics_of_storm_and_nothing_else():
    """That of DreamerV3 is in `test_objective`."""
    name = "storm_pixels"
    agent, (params, model_state) = agent_of(name), variables(name)
    config, _ = MODELS[name]
    alignment = ValueAlignmentConfig(weight="static", static_weight=1.0, warmup_steps=0)
    aligned = make_value_alignment(
        agent, dataclasses.replace(config, value_alignment=alignment)
    )

    def loss(params):
        explanation, _ = agent.world_model.explain(
            params.world_model, model_state, jax.random.key(2), experience(name)
        )
        inference = explanation.inference
        kl = jnp.ones(inference.post_logits.shape[:2])
        return aligned(params.critic, inference, kl, jnp.asarray(1)).loss.mean()

    gradient = jax.jit(jax.grad(loss))(params)
    assert norm(gradient.critic) == norm(gradient.actor) == 0.0
    model = gradient.world_model
    for head in ("decoder", "reward", "cont"):
        assert norm(model[head]) == 0.0
    for part in ("transformer", "mix_in", "prior_out", "posterior_out"):
        assert norm(model["storm"][part]) > 0, part
    assert norm(model["encoder"]) > 0


def norm(tree):
    return float(sum(jnp.sum(jnp.abs(x)) for x in jax.tree.leaves(tree)))


def test_dropout_is_on_in_training_and_off_in_acting_and_imagination():
    """z is the same for every noise here, so only dropout could tell two keys apart."""
    (params, model_state), batch = blind("storm"), experience("storm")
    explained = [explain("storm")(params, model_state, seed, batch)[0] for seed in (1, 2)]
    first, second = (e.inference.latent.deter for e in explained)
    assert (first != second).any(-1).all()
    followed = [follow("storm")(params, model_state, seed, batch) for seed in (1, 2)]
    close(*followed, atol=0)
    carry, action = followed[0][1][0], batch.trajectory.action[:, 0]
    close(
        *[imagine("storm")(params, model_state, seed, carry, action)[1] for seed in (1, 2)],
        atol=0,
    )
    window, acted = agent_of("storm").world_model.initial(BATCH), []
    obs = jax.tree.map(lambda x: x[:, 0], batch.trajectory.obs)
    for seed in (1, 2, 3):
        arguments = window, obs, action, batch.trajectory.is_first[:, 0]
        window, latent = jitted("storm", "filter")(params, model_state, seed, *arguments)
        acted.append(latent.deter)
        if seed > 1:
            other = jitted("storm", "filter")(params, model_state, seed + 10, *arguments)[1]
            close(other.deter, latent.deter, atol=0)
    assert (acted[1] != acted[2]).any()  # something is read by then


def test_batch_norm_learns_its_statistics_in_training_and_uses_them_elsewhere():
    agent, (params, model_state) = agent_of("storm_pixels"), variables("storm_pixels")
    batch, seed = experience("storm_pixels"), 2
    explanation, moved = explain("storm_pixels")(params, model_state, seed, batch)
    changed = jax.tree.map(lambda a, b: (a != b).all(), model_state, moved)
    assert all(jax.tree.leaves(changed))
    # Training is by the batch: running statistics do not matter.
    other = jax.tree.map(lambda x: 2 * x + 1, model_state)
    again, _ = explain("storm_pixels")(params, other, seed, batch)
    close(explanation, again, atol=0)
    # All else is by running statistics, and one image does not matter for another.
    first, _ = follow("storm_pixels")(params, model_state, seed, batch)
    second, _ = follow("storm_pixels")(params, other, seed, batch)
    assert (first.stoch != second.stoch).any()
    lone = jax.tree.map(lambda x: x.at[1:].set(0 * x[1:]), batch.trajectory.obs)
    lone = batch._replace(trajectory=batch.trajectory._replace(obs=lone))
    close(follow("storm_pixels")(params, model_state, seed, lone)[0].deter[0], first.deter[0])
    # So is acting: what one environment shows does not matter for another.
    filter_step, acted = jitted("storm_pixels", "filter"), []
    for seen in (batch.trajectory.obs, lone.trajectory.obs):
        carry, no = agent.world_model.initial(BATCH), jnp.zeros(BATCH, bool)
        for t in range(2):
            carry, latent = filter_step(
                params, model_state, seed, carry, seen[:, t], jnp.ones((BATCH, 3)), no
            )
        acted.append(latent)
    close(acted[0].deter[0], acted[1].deter[0])
    assert (acted[0].deter[1:] != acted[1].deter[1:]).any()
    latent = jax.tree.map(lambda x: x[:, 0], first)
    predict = jax.jit(agent.world_model.predict)
    decoded = [predict(params.world_model, s, latent).obs for s in (model_state, other)]
    assert (decoded[0] != decoded[1]).any()
