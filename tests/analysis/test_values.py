"""Value errors by depth: a numpy twin, exact zeros, masks, and units of the standard error."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scalar_agent
import tiny
import tiny_storm
import tiny_vagram
from analysis_records import make_episodes, make_policy
from refusals import refused

from vawm.analysis import episodes, inference, values
from vawm.types import Trajectory

LENGTH, DEPTH, COUNT = (7, 4, 2), 3, 3


def record(rng):
    """Episodes of the scalar agent's world, noise beyond their ends."""
    shape = COUNT, max(LENGTH)
    obs, reward, action = (
        jnp.asarray(rng.normal(size=shape) / 2, jnp.float32) for _ in range(3)
    )
    length = np.array(LENGTH)
    time = np.arange(shape[1])
    last = time == length[:, None] - 1
    trajectory = Trajectory(
        obs=obs[..., None],
        reward=reward,
        is_first=jnp.asarray((time == 0) | (time == length[:, None])),
        is_last=jnp.asarray(last),
        is_terminal=jnp.asarray(last & (np.arange(COUNT) == 1)[:, None]),
        action=action[..., None],
    )
    memory = scalar_agent.latent(obs, jnp.zeros_like(obs))  # as if h_t were o_t
    return episodes.Episodes(trajectory, memory, jnp.asarray(length))


def bump_mean(center):
    logits = -np.square(np.arange(-20.0, 21.0) - center[..., None])
    probs = np.exp(logits - logits.max(-1, keepdims=True))
    probs /= probs.sum(-1, keepdims=True)
    bins = np.asarray(scalar_agent.BINS, np.float64)
    return (probs * bins).sum(-1), probs


def twin(steps, length, terminal):
    """One episode in loops: errors, measure -> depth -> list over states; V of the states with
    an action."""
    w, gamma = float(scalar_agent.PARAMS.critic), 0.9
    w_reward = float(scalar_agent.PARAMS.world_model)
    obs, reward, action = (np.asarray(x, np.float64).ravel() for x in steps)
    h = [obs[0]]
    for t in range(1, length):
        h.append(h[-1] / 2 + action[t - 1] + obs[t])
    errors = {name: [[] for _ in range(DEPTH + 1)] for name in values.MEASURES}
    returns = {}
    for name, tail in [("return", 0.0), ("bootstrapped", bump_mean(w * np.array(h))[0][-1])]:
        returns[name] = [0.0 if terminal else tail]
        for t in range(length - 2, -1, -1):
            returns[name].insert(0, reward[t + 1] + gamma * returns[name][0])
    for t in range(1, length):  # step 0 only gives context
        imagined = h[t]
        for k in range(DEPTH + 1):
            if t + k >= length:
                break
            value, probs = bump_mean(np.array(w * imagined))
            true_value, true_probs = bump_mean(np.array(w * h[t + k]))
            errors["value"][k].append(abs(value - true_value))
            guess = bump_mean(np.array(w_reward * imagined))[0]
            errors["reward"][k].append(abs(guess - reward[t + k]))
            kl = (true_probs * np.log(true_probs / probs)).sum()
            errors["value_kl"][k].append(kl)
            post = np.exp([h[t + k], 0.0]) / np.exp([h[t + k], 0.0]).sum()
            post = 0.99 * post + 0.01 / 2
            errors["latent_kl"][k].append((post * np.log(post / 0.5)).sum() if k else 0.0)
            errors["distance"][k].append(0.0)  # z is 0 in both
            for name, truth in returns.items():
                if t + k < length - 1:
                    errors[name][k].append(abs(value - truth[t + k]))
            imagined += action[t + k]
    return errors, [bump_mean(np.array(w * h[t]))[0] for t in range(1, length - 1)]


@pytest.fixture(scope="module")
def scalar():
    """Episodes of the scalar agent, and the report of them."""
    recorded = record(np.random.default_rng(0))
    make = functools.partial(values.make_rollouts, context=2, depth=DEPTH)
    rollouts = jax.jit(make(scalar_agent.AGENT, scalar_agent.CONFIG))
    rolled = [
        rollouts(scalar_agent.PARAMS, (), jax.random.key(0), episodes.select(recorded, i))
        for i in range(COUNT)
    ]
    stacked = jax.tree.map(lambda *x: np.stack(x).astype(np.float64), *rolled)
    return recorded, stacked, values.compare(stacked, recorded, discount=0.9)


@pytest.fixture(scope="module")
def loops(scalar):
    """The results of `twin` for every episode."""
    steps = scalar[0].trajectory
    return [
        twin(
            (steps.obs[i], steps.reward[i], steps.action[i]),
            length,
            bool(steps.is_terminal[i, length - 1]),
        )
        for i, length in enumerate(LENGTH)
    ]


@pytest.mark.parametrize("measure", values.MEASURES)
def test_every_measure_equals_that_of_the_loops(scalar, loops, measure):
    report, unit = scalar[2], 1.0
    if measure in values.RELATIVE:
        unit = np.std([value for _, left in loops for value in left])
        assert report.spread == pytest.approx(unit, rel=1e-4)
    for i, (errors, _) in enumerate(loops):
        own = errors[values.RELATIVE.get(measure, measure)]
        expected = [np.mean(errors) / unit if errors else np.nan for errors in own]
        actual = report.by_depth.errors[measure][i]
        np.testing.assert_allclose(actual, expected, rtol=2e-4, atol=1e-5)
        assert report.by_depth.states[measure][i].tolist() == [len(errors) for errors in own]


def test_episodes_and_not_states_are_the_units(scalar):
    by_depth = scalar[2].by_depth
    errors = by_depth.errors["value"]
    assert np.isnan(errors[2, 1:]).all()  # two steps: nothing reaches depth 1
    np.testing.assert_allclose(by_depth.mean("value")[0], errors[:, 0].mean())
    np.testing.assert_allclose(by_depth.mean("value")[1], errors[:2, 1].mean())
    expected = errors[:2, 1].std(ddof=1) / np.sqrt(2)
    np.testing.assert_allclose(by_depth.standard_error("value")[1], expected)
    assert np.isnan(by_depth.standard_error("value")[3])  # of one episode
    rows = [row for row in values.rows("a", scalar[2]) if row["measure"] == "value"]
    assert [row["count"] for row in rows] == [3, 2, 2, 1]
    assert [row["states"] for row in rows] == [10, 7, 5, 3]
    assert {row["over"] for row in rows} == {"episodes"}


def test_relative_errors_do_not_depend_on_the_unit_of_rewards(scalar):
    recorded, rolled, report = scalar
    reward = 7.0 * recorded.trajectory.reward
    larger = values.compare(
        rolled._replace(value=7.0 * rolled.value),
        recorded._replace(trajectory=recorded.trajectory._replace(reward=reward)),
        discount=0.9,
    )
    assert larger.spread == pytest.approx(7 * report.spread)
    for name, of in values.RELATIVE.items():
        actual, expected = (r.by_depth.errors[name] for r in (larger, report))
        np.testing.assert_allclose(actual, expected, rtol=1e-5)
        actual, expected = (r.by_depth.errors[of] for r in (larger, report))
        np.testing.assert_allclose(actual, 7 * expected, rtol=1e-5)


def test_values_that_do_not_differ_have_no_relative_errors(scalar):
    recorded, rolled, report = scalar
    flat = values.compare(
        rolled._replace(value=np.full_like(rolled.value, 0.1)), recorded, discount=0.9
    )
    assert flat.spread == 0
    for name, of in values.RELATIVE.items():
        assert np.isnan(flat.by_depth.errors[name]).all()
        np.testing.assert_array_equal(
            np.isnan(flat.by_depth.errors[of]), np.isnan(report.by_depth.errors[of])
        )
    assert "0: nan +- nan" in values.table({"a": flat}, measures=("relative_value",))
    rows = [row for row in values.rows("a", flat) if row["measure"] == "relative_value"]
    assert {row["count"] for row in rows} == {0}


def test_a_spread_by_hand():
    assert values.spread_of(np.array([1.0, 1.0, 3.0, 3.0])) == 1.0
    assert values.spread_of(np.array([3.0, 3.0 + 1e-9])) == 0.0  # float32 rounds to 2e-7
    assert values.spread_of(np.array([])) == 0.0
    assert np.isnan(values.relative(np.array([0.0, 2.0]), 0.0)).all()


def told(errors, spread):
    """A report with only errors and spread."""
    errors = np.array(errors)
    by_depth = values.ErrorByDepth(
        states={name: np.where(np.isnan(errors), 0, 4) for name in values.MEASURES},
        errors=dict.fromkeys(values.MEASURES, errors)
        | {name: values.relative(errors, spread) for name in values.RELATIVE},
    )
    return values.Report(by_depth, 1, *5 * [np.zeros((2, 3))], spread)


def test_runs_are_the_units_of_a_group_by_hand():
    reports = {
        "a": told([[1.0, 2.0], [3.0, np.nan]], 2.0),  # on the mean 2, 2
        "b": told([[4.0, 6.0], [6.0, 2.0]], 0.0),  # 5, 4; its values do not differ
        "c": told([[9.0, 9.0]], 1.0),
        "d": told([[8.0, 0.0], [8.0, 0.0]], 4.0),  # 8, 0
    }
    entries = values.pooled(reports, {"alike": ["a", "b", "d"], "other": ["c"]})
    assert list(entries) == ["alike (3 runs)", "c"]
    assert entries["c"] is reports["c"]
    group = entries["alike (3 runs)"]
    np.testing.assert_allclose(group.by_depth.mean("value"), [5.0, 2.0])
    error = np.array([3.0, 2.0]) / np.sqrt(3)  # deviations -3, 0, 3 and 0, 2, -2
    np.testing.assert_allclose(group.by_depth.standard_error("value"), error)
    np.testing.assert_allclose(group.by_depth.mean("relative_value"), [1.5, 0.5])
    assert group.spread == 2.0
    rows = {(r["measure"], r["depth"]): r for r in values.rows("alike", group)}
    assert rows["value", 1]["over"] == "runs"
    assert [rows[name, 1]["count"] for name in ("value", "relative_value")] == [3, 2]
    assert rows["value", 1]["states"] == 4 + 8 + 8
    lines = values.table(reports | entries).splitlines()
    assert lines[:2] == [
        "value error by depth",
        "  a                0: 2 +- 1   1: 2 +- nan",
    ]
    assert lines[5] == "  alike (3 runs)   0: 5 +- 1.7   1: 2 +- 1.2"
    assert lines[-1] == "  alike (3 runs)   2"


def test_steps_beyond_the_end_do_not_count(scalar):
    recorded, rolled, report = scalar
    length = np.array(LENGTH)[:, None]
    noise = jnp.where(np.arange(7) >= length, 1e3, recorded.trajectory.reward)
    time = np.arange(1, 7)[:, None] + np.arange(DEPTH + 1)
    beyond = time >= length[..., None]
    changed = values.compare(
        jax.tree.map(lambda x: np.where(beyond, 1e3, x), rolled),
        recorded._replace(trajectory=recorded.trajectory._replace(reward=noise)),
        discount=0.9,
    )
    for name in values.MEASURES:
        actual, expected = (r.by_depth.errors[name] for r in (changed, report))
        np.testing.assert_array_equal(actual, expected)


def test_returns_by_hand():
    """Truncated by a time limit: G_T is 0, or the critic's value of s_T."""
    reward = [[9.0, 1.0, 2.0, 4.0, 9.0]]
    length = np.array([4])
    cut = values.discounted_returns(reward, length, np.zeros(1), discount=0.5)
    np.testing.assert_array_equal(cut, [[3.0, 4.0, 4.0, 0.0, 0.0]])
    tail = values.discounted_returns(reward, length, np.array([8.0]), discount=0.5)
    np.testing.assert_array_equal(tail, [[4.0, 6.0, 8.0, 8.0, 0.0]])


CONFIGS = {"rssm": tiny.CONFIG, "storm": tiny_storm.CONFIG, "vagram": tiny_vagram.CONFIG}


@pytest.fixture(scope="module", params=CONFIGS.values(), ids=CONFIGS)
def played(request):
    """An agent and its episodes of 13 steps."""
    policy = make_policy(request.param, tiny.env().spec)
    recorded = make_episodes(policy, episodes=2, length=13)
    return policy, recorded, values.report(policy, recorded, context=3, depth=4, seed=0)


def test_at_depth_zero_the_imagined_state_is_the_inferred_one(played):
    by_depth = played[2].by_depth
    for measure in ("value", "value_kl", "distance"):
        assert (by_depth.errors[measure][:, 0] == 0).all()
        assert (by_depth.errors[measure][:, 1:] > 0).all()
    assert (by_depth.errors["return"][:, 0] > 0).all()


def test_every_state_with_a_context_is_inferred(played):
    policy, recorded, report = played
    first = 2 if policy.config.agent == "storm" else 1  # the last of a window of 3
    assert report.first == first
    assert report.value.shape == (2, 13 - first)
    assert report.by_depth.states["value"][0].tolist() == [13 - first - k for k in range(5)]
    expected = values.discounted_returns(
        recorded.trajectory.reward,
        np.array([13, 13]),
        np.zeros(2),
        discount=1 - 1 / policy.config.imagination.discount_horizon,
    )
    np.testing.assert_allclose(report.returns, expected[:, first:])


@pytest.fixture(scope="module")
def explained(played):
    """What a world model that has states infers from the first episode, as in the report."""
    policy, recorded, _ = played
    agent = values.make_agent(policy.config, policy.spec)
    if agent.world_model.starts is None:
        return agent, None, None
    key = jax.random.split(jax.random.split(jax.random.key(0), 2)[0], 3)[0]
    batch = episodes.windows(episodes.select(recorded, 0), [0], [0], length=13)
    explain = jax.jit(agent.world_model.explain)
    model = policy.params.world_model
    return agent, batch, explain(model, policy.model_state, jax.random.split(key)[0], batch)[0]


def test_one_step_ahead_the_latent_kl_is_that_of_training(played, explained):
    """For a world model that provides logits; NaN for others."""
    policy, _, report = played
    kl = report.by_depth.errors["latent_kl"]
    if policy.config.agent == "storm":
        assert np.isnan(kl).all()
        return
    inference = explained[2].inference
    unimix, pair = policy.config.world_model.unimix, []
    for logits in (inference.post_logits, inference.prior_logits):
        probs = np.exp(np.asarray(logits, np.float64))
        probs /= probs.sum(-1, keepdims=True)
        pair.append((1 - unimix) * probs + unimix / probs.shape[-1])
    expected = (pair[0] * np.log(pair[0] / pair[1])).sum((-1, -2))[0, 1:].mean()
    assert (kl[:, 0] == 0).all()
    np.testing.assert_allclose(kl[0, 1], expected, rtol=1e-4)


def test_a_prior_is_that_of_the_next_step(played, explained):
    policy, (agent, batch, explanation) = played[0], explained
    prior = inference.make_prior(agent)
    if policy.config.agent == "storm":
        assert prior is None
        return
    latent = jax.tree.map(lambda x: x[0, :-1], explanation.inference.latent)
    action = batch.trajectory.action[0, 1:-1]
    logits = jax.jit(prior)(
        policy.params, policy.model_state, jax.random.key(1), latent, action
    )
    expected = explanation.inference.prior_logits[0, 1:]
    np.testing.assert_allclose(logits, expected, atol=1e-5)


def test_impossible_depths_and_contexts_are_refused():
    with refused("depth", 0):
        inference.check(tiny.CONFIG, context=3, depth=0)
    with refused("context", 1, naming="2"):
        inference.check(tiny.CONFIG, context=1, depth=3)
    inference.check(tiny.CONFIG, context=8, depth=100)
    with refused("depth", 6, naming="5"):
        inference.check(tiny_storm.CONFIG, context=3, depth=6)
    with refused("context", 8, naming="8"):
        inference.check(tiny_storm.CONFIG, context=8, depth=1)
