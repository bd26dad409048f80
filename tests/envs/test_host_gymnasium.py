"""Gymnasium environments as simulators, and the problems found in them."""

import time
from fractions import Fraction

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from refusals import refused

from vawm import envs
from vawm.envs.host.gymnasium import (
    PACKAGES,
    GymnasiumSimulator,
    check_id,
    from_gymnasium,
    name_of,
    problems,
)
from vawm.envs.host.pool import EnvironmentFailure, episode_seed
from vawm.envs.host.usable import Unusable
from vawm.types import image, vector


def least(space):
    """Zeros in a space, the first choices, and the text "here"."""
    if isinstance(space, spaces.Dict):
        return {key: least(inner) for key, inner in space.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(map(least, space))
    if isinstance(space, spaces.Text):
        return "here"
    if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        return space.start.copy() if space.shape else int(space.start)
    return np.zeros(space.shape, space.dtype)


def texts(env, **limits):
    """The problems of an environment, as texts."""
    return [problem.text for problem in problems(env, **limits)]


class Example(gymnasium.Env):
    """An environment that returns zeros in its spaces, with episodes of 10 steps.

    Attributes that tests replace: `obs`, `reward`, `terminated`.
    """

    observation_space = spaces.Box(-1, 1, (3,))
    action_space = spaces.Box(-1, 1, (2,))
    reward = 1.0
    terminated = None  # at the end

    def __init__(self, **changes):
        for name, value in changes.items():
            setattr(self, name, value)
        self.seen = []

    def show(self):
        return self.obs if hasattr(self, "obs") else least(self.observation_space)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.show(), {}

    def step(self, action):
        self.steps += 1
        self.seen.append(action)
        over = self.steps == 10 if self.terminated is None else self.terminated
        return self.show(), self.reward, over, False, {}


# As a simulator.


@pytest.mark.parametrize(
    ("box", "spec"),
    [
        (spaces.Box(-1, 1, (3,)), vector(3)),
        (spaces.Box(-1, 1, (2, 3), np.float64), vector(6)),
        (spaces.Box(-5, 5, (), np.int64), vector(1)),
        (spaces.Box(0, 1, (4,), np.bool_), vector(4)),
        (spaces.Box(0, 255, (128,), np.uint8), vector(128)),
        (spaces.Box(0, 255, (4, 7), np.uint8), vector(28)),
        (spaces.Box(0, 255, (15, 15), np.uint8), vector(225)),
        (spaces.Box(0, 255, (64, 64), np.uint8), image(64, channels=1)),
        (spaces.Box(0, 255, (64, 64, 3), np.uint8), image(64)),
        (spaces.Box(0, 255, (7, 7, 3), np.uint8), vector(147)),
        (spaces.Box(0, 1, (40, 40), np.float32), vector(1600)),
    ],
)
def test_an_observation_is_an_image_or_a_vector(box, spec):
    simulator = GymnasiumSimulator(Example(observation_space=box))
    assert simulator.obs == spec
    for obs in (simulator.reset(0), simulator.step(np.zeros(2, np.float32)).obs):
        assert (obs.shape, obs.dtype) == (spec.shape, spec.dtype)


def test_the_numbers_of_an_observation_keep_their_order():
    picture = np.resize(np.arange(256, dtype=np.uint8), (48, 48))
    table = np.arange(6.0).reshape(2, 3)
    space = spaces.Dict(
        picture=spaces.Box(0, 255, (48, 48), np.uint8),
        table=spaces.Box(0, 9, (2, 3), np.float64),
    )
    env = Example(observation_space=space, obs={"picture": picture, "table": table})
    simulator = GymnasiumSimulator(env, image_size=48)
    assert simulator.obs == {"picture": image(48, channels=1), "table": vector(6)}
    obs = simulator.reset(0)
    np.testing.assert_array_equal(obs["picture"][..., 0], picture)
    np.testing.assert_array_equal(obs["table"], np.arange(6))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_actions_are_stretched_to_their_bounds(dtype):
    low, high = np.array([[-2, 0.1, -3e38]], dtype), np.array([[6, 0.3, 3e38]], dtype)
    env = Example(action_space=spaces.Box(low, high, dtype=dtype))
    simulator = GymnasiumSimulator(env)
    assert (simulator.action_size, simulator.discrete) == (3, False)
    simulator.reset(0)
    for action in (-1, 0, 1, 0.5):
        simulator.step(np.full(3, action, np.float32))
    assert all(action in env.action_space for action in env.seen)
    np.testing.assert_allclose(env.seen[0], low, rtol=1e-6)
    np.testing.assert_allclose(env.seen[1], [[2, 0.2, 0]], rtol=1e-6)
    np.testing.assert_allclose(env.seen[2], high, rtol=1e-6)
    np.testing.assert_allclose(env.seen[3], [[4, 0.25, 1.5e38]], rtol=1e-6)


def test_discrete_actions_start_at_the_start_of_their_space():
    env = Example(action_space=spaces.Discrete(3, start=-1))
    simulator = GymnasiumSimulator(env)
    assert (simulator.action_size, simulator.discrete) == (3, True)
    simulator.reset(0)
    for index in range(3):
        simulator.step(index)
    assert env.seen == [-1, 0, 1]
    assert all(action in env.action_space for action in env.seen)


SCALARS = [2, 2.0, np.float64(2), np.int32(2), np.array(2.0), jnp.float32(2), Fraction(2)]


@pytest.mark.parametrize("reward", SCALARS)
@pytest.mark.parametrize("flag", [bool, np.bool_, np.array, jnp.array])
def test_rewards_and_ends_are_numbers_and_flags_of_any_library(reward, flag):
    """For the look and for the run."""

    class Other(Example):
        def step(self, action):
            obs, reward, over, _, info = super().step(action)
            return obs, reward, flag(over), flag(False), info

    assert problems(Other(reward=reward), steps=30) == []
    simulator = GymnasiumSimulator(TimeLimit(Other(reward=reward), 12))
    simulator.reset(0)
    outcomes = [simulator.step(np.zeros(2, np.float32)) for _ in range(12)]
    assert all(outcome.reward == 2 for outcome in outcomes)
    assert [(o.is_last, o.is_terminal) for o in outcomes[8:]] == [
        (False, False),
        (True, True),
        (False, False),
        (True, False),
    ]
    assert simulator.episode_length is None


def test_an_observation_of_another_shape_is_not_flattened():
    simulator = GymnasiumSimulator(Example(obs=np.zeros((3, 1), np.float32)))
    with pytest.raises(ValueError, match=r"\(3, 1\).*\(3,\)"):
        simulator.reset(0)


# Problems.


def test_a_sound_environment_has_no_problems():
    assert problems(Example()) == []
    assert problems(Example(reward=np.float32(1), terminated=np.bool_(True))) == []
    assert problems(TimeLimit(Example(terminated=False), 20)) == []
    for name in ("CartPole-v1", "Pendulum-v1", "Acrobot-v1", "MountainCarContinuous-v0"):
        assert problems(gymnasium.make(name, disable_env_checker=True)) == [], name


def test_all_problems_come_at_once():
    class Wrong(Example):
        observation_space = spaces.Dict(
            cube=spaces.Box(0, 255, (20, 20, 20), np.uint8),
            real=spaces.Box(0, 1, (64, 64, 3)),
            stack=spaces.Box(0, 255, (4, 84, 84, 3), np.uint8),
            choice=spaces.Discrete(4, start=1),
            choices=spaces.MultiDiscrete([2, 3]),
            many=spaces.Discrete(10**6),
            graph=spaces.Graph(spaces.Box(0, 1, (2,)), None),
            sequence=spaces.Sequence(spaces.Box(0, 1, (2,))),
            nothing=spaces.Box(0, 1, (0,)),
            double=spaces.Box(-1, 1, (2,)),
            shape=spaces.Box(-1, 1, (2,)),
            nan=spaces.Box(-1, 1, (2,)),
            far=spaces.Box(-1, 1, (2,)),
            list=spaces.Box(-1, 1, (2,)),
            big=spaces.Box(-np.inf, np.inf, (2,), np.float64),
        )
        action_space = spaces.Box(-np.inf, np.inf, (2,))

        def reset(self, *, options=None):
            return self.show()

        def show(self):
            known = self.observation_space.spaces.items()
            return {
                **{key: least(x) for key, x in known if key not in ("graph", "sequence")},
                "graph": None,
                "sequence": (),
                "choice": 5,
                "choices": np.array([1, 3]),
                "big": np.array([0, -1e39]),
                "double": np.zeros(2),
                "shape": np.zeros((2, 1), np.float32),
                "nan": np.float32([0, np.nan]),
                "far": np.float32([0, 3]),
                "list": [0.0, 0.0],
            }

        def step(self, action):
            return self.show(), np.ones(1), 0, {}

    found = texts(Wrong())
    expected = [
        ("observation_space['nothing']", "(0,)"),
        ("observation_space['stack']", "(4, 84, 84, 3)", "(H, W, C)"),
        ("observation_space['cube']", "(20, 20, 20)", "(H, W, C)"),
        ("observation_space['real']", "(64, 64, 3)", "float32", "uint8"),
        ("observation_space['many']", "1000000", "65536"),
        ("observation_space['graph']", "Graph", "Box"),
        ("observation_space['sequence']", "Sequence", "Box"),
        ("action space", "Box(-inf, inf, (2,), float32)", "low and high"),
        ("reset()", "seed=None"),
        ("reset()", "one value", "dict", "obs, info"),
        ("obs['choice']", "5"),
        ("obs['choices'][1]", "3"),
        ("obs['big'][1]", "-1e+39", "float32"),
        ("obs['double']", "float64", ".astype(np.float32)"),
        ("obs['far'][1]", "3"),
        ("obs['list']", "list", "float32"),
        ("obs['nan'][1]", "nan"),
        ("obs['shape']", "(2, 1)", "(2,)"),
        ("step()", "4 values", "obs, reward, terminated, truncated, info"),
        ("reward", "(1,)"),
        ("terminated", "0", "True or False"),
        ("no episode", "1000", "time_limit="),
    ]
    assert len(found) == len(expected), found
    for start, *parts in expected:
        ours = [text for text in found if text.startswith(start)]
        assert any(all(part in text for part in parts) for text in ours), (start, parts)
        assert all(": " in text for text in ours), ours  # the remedy


FLAG = spaces.Discrete(2)
"""A space with two choices."""


def raises(error):
    def method(*args, **kwargs):
        raise error

    return method


@pytest.mark.parametrize(
    ("changes", "start", "part"),
    [
        ({"observation_space": spaces.Tuple([]), "obs": ()}, "observation space", "Tuple()"),
        ({"observation_space": spaces.Dict()}, "observation space", "Dict()"),
        ({"observation_space": spaces.Text(9)}, "observation space", "Text("),
        (
            {"observation_space": spaces.Dict({1: FLAG})},
            "observation_space[1]",
            "key",
        ),
        (
            {"observation_space": spaces.Dict({"a/0": FLAG, "a": spaces.Tuple([FLAG])})},
            "observation_space",
            "'a/0'",
        ),
        ({"observation_space": spaces.Dict(a=FLAG), "obs": {}}, "obs ", "'a'"),
        ({"observation_space": spaces.Tuple([FLAG]), "obs": (1, 1)}, "obs ", "2"),
        ({"observation_space": spaces.Tuple([FLAG]), "obs": 1}, "obs ", "int"),
        ({"observation_space": None, "obs": 0}, "observation space", "None"),
        ({"action_space": spaces.MultiDiscrete([2, 3])}, "action space", "MultiDiscrete"),
        ({"action_space": spaces.Box(0, 5, (2,), np.int32)}, "action space", "int32"),
        ({"action_space": spaces.Box(0, 1, (0,))}, "action space", "(0,)"),
        ({"obs": {"state": np.zeros(3)}}, "obs ", "dict"),
        ({"obs": np.full(3, np.inf, np.float32)}, "obs[0]", "inf"),
        ({"reward": None}, "reward", "None"),
        ({"reward": float("nan")}, "reward", "nan"),
        ({"reward": 3.5e38}, "reward", "float32"),
        ({"reward": 10**400}, "reward", "finite"),
        ({"reward": "1"}, "reward", "'1'"),
        ({"reward": jnp.ones(1)}, "reward", "(1,)"),
        ({"terminated": jnp.ones(1, bool)}, "terminated", "(1,)"),
        ({"terminated": None, "reset": raises(OSError("no"))}, "reset()", "OSError: no"),
        ({"reset": raises(TypeError("a seed is missing"))}, "reset()", "a seed is missing"),
        ({"step": raises(KeyError("x"))}, "step()", "KeyError: 'x'"),
        ({"step": raises(SystemExit("x"))}, "step()", "SystemExit: x"),
        ({"step": lambda action: (0, 0)}, "step()", "2 values"),
        ({"step": lambda action: None}, "step()", "NoneType"),
        ({"terminated": False}, "no episode", "100"),
    ],
)
def test_a_problem_is_named_with_a_remedy(changes, start, part):
    (found,) = texts(Example(**changes), steps=100)
    assert found.startswith(start)
    assert part in found
    assert ": " in found


def test_what_goes_wrong_later_in_an_episode_is_a_problem():
    """For the look and for the run, by the same words."""

    class Later(Example):
        observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)

        def show(self):
            return np.array([1e39 if self.steps == 3 else 0.0])

    (found,) = texts(Later(), steps=30)
    simulator = GymnasiumSimulator(Later())
    simulator.reset(0)
    action = np.zeros(2, np.float32)
    simulator.step(action)
    simulator.step(action)
    with pytest.raises(Unusable) as error:
        simulator.step(action)
    assert found == f"{error.value}: {error.value.remedy}"


def test_errors_inside_of_a_space_are_told_as_they_are():
    class Own(spaces.Discrete):
        def sample(self, mask=None, probability=None):
            raise LookupError("my own mistake")

    (found,) = texts(Example(action_space=Own(2)), steps=20)
    assert "LookupError: my own mistake" in found


def test_reversed_bounds_are_a_problem():
    box = spaces.Box(-1, 1, (2,))
    box.low, box.high = box.high, box.low
    (found,) = texts(Example(action_space=box))
    assert found.startswith("action space")
    assert "low" in found
    assert "high" in found


def test_an_environment_of_the_old_api_is_understood_behind_wrappers():
    def step(action):
        return np.zeros(3, np.float32), 1.0, False, {}

    def reset(seed=None, options=None):
        return np.zeros(3, np.float32)

    env = TimeLimit(Example(step=step, reset=reset), 50)
    of_reset, of_step = texts(env)
    assert of_reset.startswith("reset()")
    assert "ndarray" in of_reset
    assert of_step.startswith("step()")
    assert "4 values" in of_step


def test_an_object_of_another_kind_is_one_problem():
    (found,) = texts(object())
    assert "builtins.object" in found
    assert "gymnasium.Env" in found
    (found,) = texts(Example)
    assert "class Example" in found
    (found,) = texts(gymnasium.make_vec("CartPole-v1", num_envs=2))
    assert "num_envs" in found


def test_an_empty_environment_has_a_problem_everywhere():
    observation, action, reset, play = texts(type("Bare", (gymnasium.Env,), {})())
    assert observation.startswith("observation_space raised AttributeError")
    assert action.startswith("action_space raised AttributeError")
    assert reset.startswith("reset()")
    assert "NoneType" in reset
    assert "AttributeError" in play


def test_a_slow_environment_is_played_for_some_seconds_only():
    def step(action):
        time.sleep(0.1)
        return np.zeros(3, np.float32), 1.0, False, False, {}

    began = time.monotonic()
    assert problems(Example(step=step), seconds=0.3) == []  # not even "no episode ended"
    assert time.monotonic() - began < 2


# In a pool.


def play_alone(env, seed, actions):
    """(obs, reward, is_first, is_last, is_terminal) per action, of environment 0 of a pool."""
    episode, over = 0, True
    for action in actions:
        if over:
            obs, _ = env.reset(seed=episode_seed(seed, 0, episode))
            episode, over = episode + 1, False
            yield obs, 0, True, False, False
        else:
            obs, reward, terminated, truncated, _ = env.step(action)
            over = terminated or truncated
            yield obs, reward, False, over, terminated


@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1"])
def test_a_pool_plays_what_the_environment_does(name):
    discrete = name == "CartPole-v1"
    rng = np.random.default_rng(0)
    size = 2 if discrete else 1
    actions = rng.uniform(-1, 1, size=(60, 1, size)).astype(np.float32)
    alone = gymnasium.make(name, max_episode_steps=15)
    native = actions[:, 0].argmax(-1) if discrete else 2 * actions[:, 0]
    expected = play_alone(alone, 5, [None, *native])
    with envs.from_gymnasium(name, time_limit=15) as pool:
        assert pool.spec.task == name
        assert (pool.spec.discrete, pool.spec.action_size) == (discrete, size)
        assert pool.spec.episode_length is None
        timesteps = [pool.reset(5)]
        for action in actions:
            pool.send(action)
            timesteps.append(pool.receive())
    assert sum(t.is_first[0] for t in timesteps) > 3
    for timestep, (obs, reward, *flags) in zip(timesteps, expected, strict=True):
        np.testing.assert_array_equal(timestep.obs[0], obs)
        assert timestep.reward[0] == np.float32(reward)
        assert [x[0] for x in timestep[2:]] == flags


def test_all_problems_reach_the_caller_as_one_refusal():
    with refused("env", "Example", naming=["2 problems", "(1) reward", "(2) no episode"]):
        from_gymnasium(Example, terminated=False, reward=None)


def test_without_a_check_the_first_failure_ends_the_pool():
    with from_gymnasium(Example, check=False, reward=None, task="mine") as pool:
        assert pool.spec.task == "mine"
        pool.reset(0)
        pool.send(np.zeros((1, 2)))
        with pytest.raises(EnvironmentFailure, match=r"reward.*None") as caught:
            pool.receive()
        assert (caught.value.environment, caught.value.step) == (0, 1)


def test_an_id_that_only_this_process_registered_is_made_in_workers():
    gymnasium.register(
        "vawm-test/Here-v0", entry_point=lambda size: Example(), kwargs={"size": 1}
    )
    try:
        with from_gymnasium("vawm-test/Here-v0", num_envs=2, workers=1, size=1) as pool:
            assert pool.spec.obs == vector(3)
            assert pool.reset(0).is_first.all()
    finally:
        del gymnasium.registry["vawm-test/Here-v0"]


def test_an_environment_that_cannot_be_made_is_refused():
    entry_point = "a_package_that_is_missing:Env"
    gymnasium.register("vawm-test/Missing-v0", entry_point=entry_point)
    try:
        with refused("env", "vawm-test/Missing-v0", naming="ModuleNotFoundError"):
            from_gymnasium("vawm-test/Missing-v0")
    finally:
        del gymnasium.registry["vawm-test/Missing-v0"]


@pytest.mark.parametrize(
    ("name", "named"),
    [
        ("CartPole-v7", "'CartPole-v1'"),
        ("CartPole", "'CartPole-v1'"),
        ("cartpole-v1", "'CartPole-v1'"),
        ("ALE/Brekout-v5", "'ALE/Breakout-v5'"),
        ("xyz", "id"),
        ("not_there:Env-v0", "'not_there'"),
    ],
)
def test_an_unknown_id_is_refused_with_the_nearest(name, named):
    with refused("env", name, naming=named):
        from_gymnasium(name)


def test_an_impossible_time_limit_is_refused():
    with refused("time_limit", 0):
        from_gymnasium("CartPole-v1", time_limit=0)


def test_a_module_in_an_id_is_imported():
    assert check_id("gymnasium:CartPole-v1").id == "CartPole-v1"


@pytest.mark.parametrize(
    "name",
    [
        "ALE/Breakout-v5",
        "BreakoutNoFrameskip-v4",
        "Breakout-v4",
        "MiniGrid-Empty-5x5-v0",
        "BabyAI-GoToRedBall-v0",
    ],
)
def test_the_package_of_a_well_known_id_is_imported(name):
    assert check_id(name).id == name


def test_a_package_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setitem(PACKAGES, "Nowhere-.+", "not_installed")
    with refused("env", "Nowhere-v0", naming="pip install not_installed"):
        check_id("Nowhere-v0")


@pytest.mark.parametrize(
    ("env", "naming"),
    [
        (TimeLimit(Example(), 5), "lambda: Example(...)"),
        (gymnasium.make("CartPole-v1"), "'CartPole-v1'"),
        (gymnasium.make_vec("CartPole-v1", num_envs=2), "num_envs"),
        (spaces.Discrete(2), "Discrete"),
    ],
)
def test_an_environment_in_place_of_what_makes_it_is_the_mistake(env, naming):
    with refused("make", env, naming=naming):
        from_gymnasium(env)


def test_the_look_names_the_setting_that_is_missing():
    with refused("env", "Example", naming="time_limit=1000") as refusal:
        from_gymnasium(Example, terminated=False)
    assert refusal.value.settings == {"time_limit": 1000}


def test_sizes_that_no_network_reads_are_refused():
    with refused("image_size", 60):
        from_gymnasium("CartPole-v1", image_size=60)


def test_a_task_is_named_after_what_makes_it():
    assert name_of("ALE/Pong-v5") == "ALE/Pong-v5"
    assert name_of("module:Name-v0") == "Name-v0"
    assert name_of(Example) == "Example"
    assert name_of(lambda: None) == "environment"
