"""Scores: whole episodes, each counted once, and raw actions in the actuator's range."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from analysis_records import make_policy

from vawm import evaluate, presets
from vawm.agent import make_agent
from vawm.config import AtariConfig
from vawm.envs import probes
from vawm.errors import InvalidInput
from vawm.learning import train
from vawm.policy import Policy, play, policy
from vawm.policy.play import Score
from vawm.runs import checkpoint, suites
from vawm.runs.reports import film
from vawm.types import EnvSpec, vector

CARTPOLE = EnvSpec("cartpole_balance", vector(5), 1, False, 2, 5, 200)


def scripted(spec, action, config=tiny.CONFIG):
    """A policy that always does the same."""
    return Policy(
        config=config,
        spec=spec,
        env_steps=0,
        params=None,
        model_state=None,
        initial=lambda n: jnp.zeros(n),
        apply=lambda params, state, key, carry, timestep, how: (
            carry,
            jnp.full((carry.shape[0], 1), action),
        ),
    )


def test_a_score_has_mean_and_standard_error():
    score = Score((1.0, 2.0, 6.0))
    assert score.mean == 3.0
    assert score.standard_error == pytest.approx(math.sqrt(7 / 3))
    assert str(score) == "3.0 +- 1.5 over 3 episodes"
    assert math.isnan(Score((1.0,)).standard_error)
    assert str(Score((1.0,))) == "1.0 over 1 episode"


@pytest.mark.parametrize(("action", "expected"), [(0.5, 4.0), (0.0, 0.0), (9.0, 0.0)])
def test_only_the_first_episode_of_each_environment_counts(action, expected):
    env = probes.make("action_reward", num_envs=3)
    score = evaluate.evaluate(scripted(env.spec, action), episodes=3, env=env)
    np.testing.assert_allclose(score.returns, [expected] * 3)


def test_the_seed_decides():
    env = probes.make("observation_reward", num_envs=4)
    returns = [
        evaluate.evaluate(scripted(env.spec, 0.0), episodes=4, seed=seed, env=env).returns
        for seed in (0, 0, 1)
    ]
    assert returns[0] == returns[1] != returns[2]


def test_no_episodes_are_refused():
    with pytest.raises(InvalidInput, match="episodes=0: use a whole number of at least 1"):
        evaluate.by_protocol(scripted(CARTPOLE, 0.0), episodes=0)


def quick(suite):
    return presets.DREAMERV3[suite]["quick"]


@pytest.mark.parametrize(
    ("suite", "episodes", "num_envs", "changes"),
    [
        ("dmc_proprio", 10, 10, {}),
        ("dmc_vision", 10, 8, {}),
        ("atari100k", 100, 8, {"sticky": 0.0, "life_loss": "ignore", "clip_reward": False}),
        ("gymnasium", 20, 8, {}),
    ],
)
def test_a_policy_is_evaluated_by_the_protocol_of_its_suite(
    suite, episodes, num_envs, changes, monkeypatch
):
    """In the environments of its own config, but for what the protocol changes."""
    config, made, played = quick(suite), [], []
    if suite == "atari100k":
        other = {"sticky": 0.25, "life_loss": "end", "clip_reward": True}
        config = dataclasses.replace(config, env=AtariConfig(**other))
    if suite != "dmc_proprio":
        changes = changes | {"on_failure": "raise"}
    env = tiny.env()

    def make(config):
        made.append(config)
        return env

    def play(policy, *, episodes, env, how, seed):
        played.append((episodes, env, how, seed))
        return Score((1.0,))

    monkeypatch.setattr(evaluate.suites, "make", make)
    monkeypatch.setattr(evaluate, "evaluate", play)
    policy = scripted(env.spec, 0.0, config)
    assert evaluate.by_protocol(policy) == Score((1.0,))
    evaluate.by_protocol(policy, episodes=3, how="mode", seed=7)
    assert played == [(episodes, env, "sample", 0), (3, env, "mode", 7)]
    choices = dataclasses.replace(config.env, **changes)
    assert made == [dataclasses.replace(config, num_envs=n, env=choices) for n in (num_envs, 3)]


def test_only_what_a_protocol_has_can_be_chosen(monkeypatch):
    made = []
    monkeypatch.setattr(
        evaluate.suites, "make", lambda config: made.append(config) or tiny.env()
    )
    monkeypatch.setattr(evaluate, "evaluate", lambda *_, **__: Score((1.0,)))
    atari = scripted(tiny.env().spec, 0.0, quick("atari100k"))
    evaluate.by_protocol(atari, sticky=0.25)
    assert made[0].env.sticky == 0.25
    for suite, options in [
        ("atari100k", {"life_loss": "end"}),
        ("atari100k", {"physics": "mjx"}),
        ("gymnasium", {"sticky": 0.25}),
        ("dmc_vision", {"physics": "mujoco"}),
        ("dmc_proprio", {"physics": "bullet"}),
        ("dmc_proprio", {"sticky": 0.0}),
    ]:
        ((name, value),) = options.items()
        with pytest.raises(InvalidInput) as refusal:
            evaluate.by_protocol(atari._replace(config=quick(suite)), **options)
        assert (refusal.value.field, refusal.value.value) == (name, value)
    assert len(made) == 1


@pytest.mark.parametrize("physics", [None, "mjx", "mujoco"])
def test_a_policy_of_an_environment_of_ones_own_has_no_protocol(physics):
    """Its config names a task in which it was not trained."""
    config = tiny.config(task="cartpole_balance")
    policy = scripted(CARTPOLE._replace(task="my_own"), 0.0, config)
    with pytest.raises(InvalidInput, match="task='my_own': "):
        evaluate.by_protocol(policy, episodes=2, physics=physics)


def test_environments_on_the_host_are_closed_after_playing(monkeypatch):
    closed = []

    class Host:
        spec = tiny.env().spec

        def close(self):
            closed.append(True)

    def fail(*_, **__):
        raise InvalidInput("episodes", 1, "for the sake of this test")

    monkeypatch.setattr(evaluate.suites, "make", lambda _: Host())
    monkeypatch.setattr(evaluate, "evaluate", fail)
    with pytest.raises(InvalidInput):
        evaluate.by_protocol(scripted(Host.spec, 0.0, quick("gymnasium")))
    assert closed == [True]


def test_help_has_the_protocol_of_every_suite():
    lines = evaluate.description().splitlines()
    for name, suite in suites.SUITES.items():
        (line,) = [line for line in lines if line.split()[:1] == [name]]
        assert line.split()[1] == str(suite.protocol.episodes)
        assert line.endswith(suite.protocol.text)


def test_environments_of_another_kind_are_refused():
    env = probes.make("observation_reward", num_envs=4)
    other = env.spec._replace(action_repeat=2)
    with pytest.raises(InvalidInput, match=r"env='action_repeat 1': .* trained with 2"):
        evaluate.evaluate(scripted(other, 0.0), episodes=4, env=env)


def test_the_same_policy_plays_in_the_simulation_of_dm_control():
    """Still, a cartpole that starts upright falls within seconds: a middling return."""
    still = evaluate.by_protocol(scripted(CARTPOLE, 0.0), episodes=2, physics="mujoco")
    assert all(100 < total < 900 for total in still.returns)
    again = evaluate.by_protocol(scripted(CARTPOLE, 0.0), episodes=2, physics="mujoco")
    assert again == still
    pushed = evaluate.by_protocol(scripted(CARTPOLE, 5.0), episodes=2, physics="mujoco")
    assert pushed.mean < still.mean


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A folder with an untrained checkpoint, and what acting needs of it."""
    logdir = tmp_path_factory.mktemp("saved")
    env = tiny.env()
    agent = make_agent(tiny.CONFIG, env.spec)
    state = jax.jit(lambda key: train.init(env, agent, tiny.CONFIG, key))(jax.random.key(3))
    checkpoint.save(logdir, state, env_steps=0, config=tiny.CONFIG, spec=env.spec, progress={})
    return logdir, state.learner.params, state.learner.model_state


def test_a_loaded_policy_acts_like_the_agent_that_was_saved(saved):
    logdir, *needed = saved
    env = tiny.env()
    loaded = policy.load(logdir)
    agent = make_agent(tiny.CONFIG, env.spec)
    _, timestep = env.reset(jax.random.key(0))
    carry, action = loaded.act(jax.random.key(1), loaded.initial(2), timestep)
    expected = jax.jit(agent.act)(*needed, jax.random.key(1), agent.initial(2), timestep)
    jax.tree.map(np.testing.assert_array_equal, (carry, action), expected)
    assert (loaded.config, loaded.spec, loaded.env_steps) == (tiny.CONFIG, env.spec, 0)


def test_parameters_are_arguments_of_the_compiled_program(saved):
    """So another checkpoint of the same shapes finds it in the compilation cache."""
    env, key = tiny.env(), jax.random.key(0)
    first = policy.load(saved[0])
    second = policy.load(saved[0])
    second = second._replace(params=jax.tree.map(lambda x: x + 1, second.params))
    texts = [
        play.player(env, p).lower(p.params, p.model_state, key).as_text()
        for p in (first, second)
    ]
    assert texts[0] == texts[1]


def test_the_command_line_reports_each_simulation(saved, monkeypatch, capsys):
    asked = []

    def fake(_, **kwargs):
        asked.append(kwargs)
        return Score((1.0, 3.0))

    monkeypatch.setattr(evaluate, "by_protocol", fake)
    monkeypatch.setattr(evaluate.cache, "enable", lambda: None)
    arguments = ["--logdir", str(saved[0]), "--episodes", "2", "--physics", "mujoco"]
    assert evaluate.main(arguments) == 0
    assert [kwargs["physics"] for kwargs in asked] == ["mjx", "mujoco"]
    assert capsys.readouterr().out.count("2.0 +- 1.0 over 2 episodes") == 2


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--logdir", "."], "logdir='.': holds no checkpoint"),
        (["--logdir", ".", "--episodes", "0"], "episodes=0: use a whole number of at least 1"),
        (["--logdir", ".", "--seed", "-1"], "seed=-1: use a number from 0"),
        ([], "--logdir=None: is required"),
        (["--logdir", ".", "--physics", "mujok"], "--physics='mujok': did you mean 'mujoco'"),
        (["--logdir", ".", "--episode", "3"], "--episode='3': no such flag; did you mean"),
    ],
)
def test_bad_input_is_one_line_and_code_2(tmp_path, capsys, monkeypatch, flags, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(evaluate.cache, "enable", lambda: None)
    assert evaluate.guard(lambda: evaluate.main(flags)) == 2
    output = capsys.readouterr()
    assert output.err.startswith(f"error: {message}")
    assert output.err.count("\n") == 1
    assert not output.out


@pytest.mark.parametrize("seed", [-1, 2**31])
def test_an_impossible_seed_is_refused(seed):
    with pytest.raises(InvalidInput, match="seed="):
        evaluate.by_protocol(scripted(CARTPOLE, 0.0), episodes=1, seed=seed)


def test_a_film_is_of_an_episode_that_training_has_not_played(monkeypatch):
    calls = {}

    class Drawn:
        spec = tiny.env().spec

        def close(self):
            calls["closed"] = True

    def make_again(config, made, **choices):
        calls["made"] = config.num_envs, choices["drawn"], choices["sticky"]
        return Drawn()

    def record(agent, params, model_state, env, **choices):
        calls["record"] = choices

    monkeypatch.setattr(film.suites, "make_again", make_again)
    monkeypatch.setattr(film, "record", record)
    policy = make_policy(tiny.CONFIG, tiny.env().spec)
    evaluate.filmed(policy, seed=3, steps=5, how="mode", sticky=0.25)
    assert calls["record"] == {"seed": play.FRESH + 3, "steps": 5, "how": "mode"}
    assert calls["made"] == (1, True, 0.25)
    assert calls["closed"]
