"""Acting on observations of the environment itself: as `act`, bit for bit, in every suite."""

import contextlib
import pathlib
import re

import gymnasium
import jax
import numpy as np
import pytest
import tiny
import tiny_pixels
from analysis_records import make_policy, save_run
from gymnasium import spaces
from refusals import refused

import vawm
import vawm.envs
from vawm.config import AtariConfig, GymnasiumConfig, VisionConfig
from vawm.envs import made as records
from vawm.envs.host import rendering
from vawm.envs.host.native import of_spaces
from vawm.envs.host.pool import episode_seed
from vawm.envs.host.simulator import legal
from vawm.envs.protocol import Environment
from vawm.runs import suites
from vawm.types import Made

README = (pathlib.Path(__file__).parents[2] / "README.md").read_text()
[SNIPPET] = re.findall(r"^## Load and act\n\n```python\n(.*?)^```$", README, re.M | re.S)

PIXELS = tiny_pixels.CONFIG.world_model


def gym_config(task, **changes):
    choices = GymnasiumConfig(workers=1, time_limit=5)
    return tiny.config(suite="gymnasium", task=task, env=choices, num_envs=1, **changes)


CONFIGS = {
    "mjx": tiny.config(task="pendulum_swingup", action_repeat=200, num_envs=1, env_steps=9600),
    "discrete": gym_config("CartPole-v1"),
    "box": gym_config("Pendulum-v1"),
    "dict and text": gym_config("MiniGrid-Empty-5x5-v0"),
    "bytes": gym_config("vawm/GridWorld-v0", world_model=PIXELS),
    "atari": tiny.config(
        suite="atari100k",
        task="pong",
        action_repeat=4,
        num_envs=1,
        world_model=PIXELS,
        env=AtariConfig(workers=1, max_frames=20, noops=0),
    ),
    "vision": tiny.config(
        suite="dmc_vision",
        task="cartpole_balance",
        action_repeat=200,
        env_steps=9600,
        num_envs=1,
        world_model=PIXELS,
        env=VisionConfig(workers=1, renderer="osmesa"),
    ),
}


def spec_of(config):
    """The spec that a run keeps."""
    env = suites.make(config)
    with contextlib.ExitStack() as stack:
        if not isinstance(env, Environment):
            stack.enter_context(contextlib.closing(env))
        return env.spec._replace(made=records.of(env))


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Name of a config -> the folder of a run with random parameters; made on first use."""
    made = {}

    def folder_of(name):
        if name == "dict and text":
            pytest.importorskip("minigrid")
        if name == "atari":
            pytest.importorskip("ale_py")
        if name == "vision" and (fault := rendering.fault("osmesa")):
            pytest.skip(f"osmesa does not render here: {fault}")
        if name not in made:
            config, folder = CONFIGS[name], tmp_path_factory.mktemp("act") / "run"
            made[name] = save_run(folder, make_policy(config, spec_of(config)))
        return made[name]

    return folder_of


@pytest.mark.parametrize("name", CONFIGS)
def test_the_lines_of_the_readme_act_in_every_suite(name, runs):
    names = {}
    exec(SNIPPET.replace("LOGDIR", runs(name)), names)
    with contextlib.closing(names["env"]) as env:
        assert names["done"]
        assert names["action"] in env.action_space
        assert names["obs"] in env.observation_space


STEPS, SEED = 9, 3


@pytest.mark.parametrize(
    ("name", "how"),
    [
        ("discrete", "mode"),
        ("discrete", "sample"),
        ("box", "sample"),
        ("dict and text", "sample"),
        ("atari", "sample"),
    ],
)
def test_predict_equals_act_and_the_conversion_of_the_pool(name, how, runs):
    """Bit for bit, on the same observations, keys and resets."""
    policy = vawm.load(runs(name))
    seen, raw = by_act(policy, CONFIGS[name], how)
    assert sum(step.is_first[0] for step in seen) > 1
    for step, one, action in zip(seen, raw, by_predict(policy, seen, how), strict=True):
        if step.is_last[0]:
            continue  # no action leaves from there
        expected = policy.native.actions.convert(legal(one[0], discrete=policy.spec.discrete))
        assert np.asarray(action).dtype == np.asarray(expected).dtype
        assert np.asarray(action).tobytes() == np.asarray(expected).tobytes()


def by_act(policy, config, how):
    """Time steps of the pool of training, and raw actions by `act`."""
    key, carry, seen, raw = jax.random.key(0), policy.initial(1), [], []
    with contextlib.closing(suites.make(config)) as pool:
        seen.append(pool.reset(SEED))
        while len(raw) < STEPS:
            key, key_act = jax.random.split(key)
            carry, action = policy.act(key_act, carry, seen[-1], how)
            raw.append(np.asarray(action))
            pool.send(raw[-1])
            seen.append(pool.receive())
    return seen[:-1], raw


def by_predict(policy, seen, how):
    """Actions by `predict` in the same episodes of the environment itself, played here."""
    session, actions, episode = policy.new_session(seed=0), [], -1
    with contextlib.closing(policy.make_env()) as env:
        for step in seen:
            episode += step.is_first[0]
            if policy.spec.native is None:  # it has no other observations than the agent
                obs = step.obs[0]
            elif step.is_first[0]:
                obs, _ = env.reset(seed=episode_seed(SEED, 0, int(episode)))
            else:
                obs, *_ = env.step(actions[-1])
            for a, b in zip(
                jax.tree.leaves(policy.native.see(obs)[0]),
                jax.tree.leaves(step.obs),
                strict=True,
            ):
                assert a.tobytes() == b.tobytes()
            actions.append(session.predict(obs, bool(step.is_first[0]), how=how))
    return actions


def test_predict_equals_act_on_mjx(runs):
    policy = vawm.load(runs("mjx"))
    env = policy.make_env()
    obs, _ = env.reset(seed=0)
    key, carry = jax.random.key(0), policy.initial(1)
    for step in range(3):
        key, key_act = jax.random.split(key)
        carry, action = policy.respond(key_act, carry, obs, step == 0)
        assert policy.predict(obs).tobytes() == action.tobytes()
        obs, *_ = env.step(action)


def test_a_batch_is_as_many_environments(runs):
    """Each row of a batch is read and acts as a single environment of the same batch would."""
    policy = vawm.load(runs("dict and text"))
    envs = gymnasium.vector.SyncVectorEnv([policy.make_env] * 2)
    obs, _ = envs.reset(seed=0)
    start = np.ones(2, bool)
    for _ in range(8):
        arrays, batched = policy.native.see(obs)
        assert batched
        rows = [{k: v[i] for k, v in obs.items() if k != "mission"} for i in range(2)]
        for i, row in enumerate(rows):
            own, batched = policy.native.see(row | {"mission": "anything"})
            assert not batched
            for name, array in own.items():
                np.testing.assert_array_equal(array[0], arrays[name][i])
        action = policy.predict(obs, episode_start=start)
        assert action in envs.action_space
        obs, _, terminated, truncated, _ = envs.step(action)
        start = terminated | truncated
    envs.close()


def test_a_start_forgets_what_was_before(runs):
    """Of one environment alone, and with the key that a fresh session would have."""
    policy = vawm.load(runs("discrete"))
    obs = np.float32([[0.1, 0.2, 0.3, 0.4], [1, 2, 3, 4]])
    session, fresh = policy.new_session(), policy.new_session()
    session.predict(obs, True)
    fresh.key = jax.random.clone(session.key)
    session.predict(-obs, np.array([True, False]))
    fresh.predict(-obs)
    leaves = [jax.tree.leaves(x.carry) for x in (session, fresh)]
    equal = [np.array(a) == np.array(b) for a, b in zip(*leaves, strict=True)]
    assert all(rows[0].all() for rows in equal)
    assert not all(rows[1].all() for rows in equal)


def test_sessions_do_not_share_what_they_remember(runs):
    policy = vawm.load(runs("discrete"))
    obs = np.zeros(4, np.float32)
    policy.predict(obs, True)
    assert policy.session.num == 1
    assert policy.new_session().carry is None
    assert policy._replace(env_steps=1).session.carry is None


def test_another_number_of_environments_needs_a_start(runs):
    policy = vawm.load(runs("discrete"))
    obs = np.zeros((2, 4), np.float32)
    policy.predict(obs)
    key = policy.session.key
    with refused("episode_start", None, naming=("3", "2", "True")):
        policy.predict(np.zeros((3, 4), np.float32))
    assert policy.session.key is key
    assert policy.predict(np.zeros((3, 4), np.float32), True).shape == (3,)
    assert policy.predict(np.zeros(4, np.float32), True).shape == ()


@pytest.mark.parametrize("start", [1, "yes", [True, False, True], np.ones((2, 1), bool)])
def test_a_start_is_a_flag_or_one_for_each(runs, start):
    policy = vawm.load(runs("discrete"))
    with refused("episode_start", naming=("True", "2")):
        policy.predict(np.zeros((2, 4), np.float32), start)


@pytest.mark.parametrize(
    ("obs", "field", "named"),
    [
        (np.zeros(3, np.float32), "obs", ("(4,)", "(N, 4)")),
        (np.zeros((0, 4), np.float32), "obs", ("(N, 4)",)),
        (np.float32([0, 0, np.nan, 0]), "obs[2]", ("nan",)),
        (["a"] * 4, "obs", ("numbers",)),
        ({"state": np.zeros(4)}, "obs", ("numbers",)),
    ],
)
def test_what_is_no_observation_is_refused(runs, obs, field, named):
    policy = vawm.load(runs("discrete"))
    with refused(field, naming=named):
        policy.predict(obs)
    assert policy.session.carry is None


def test_entries_of_a_dict_need_equal_numbers(runs):
    policy = vawm.load(runs("dict and text"))
    obs = {"image": np.zeros((2, 7, 7, 3), np.uint8), "direction": np.zeros(3, np.int64)}
    with refused("obs", naming="every"):
        policy.predict(obs | {"mission": ("", "")})
    with refused("obs"):
        policy.predict(obs)


# What a run keeps


class Own(gymnasium.Env):
    """An environment of the caller's."""

    observation_space = spaces.Box(-1, 1, (2,))
    action_space = spaces.Box(np.float32([0, -2]), np.float32([4, 2]))


OWN = Made("object", "mine.Own", {"time_limit": 5, "image_size": 64})


def own_policy(native):
    kept = of_spaces(Own.observation_space, Own.action_space, image_size=64)
    of_run = tiny.env().spec._replace(
        obs=kept.reading.spec, action_size=2, made=OWN, native=kept if native else None
    )
    return make_policy(gym_config("Own"), of_run._replace(num_envs=1))


def test_a_policy_of_the_callers_environment_acts_without_it(tmp_path):
    loaded = vawm.load(save_run(tmp_path / "run", own_policy(native=True)))
    action = loaded.predict(np.zeros(2, np.float32), episode_start=True)
    assert action in Own.action_space
    with refused("env", records.describe(OWN), naming=("vawm.load(LOGDIR)", "predict(")):
        loaded.make_env()


def test_an_earlier_run_is_looked_up_or_refused(tmp_path, runs):
    own = own_policy(native=False)
    with refused("env", records.describe(OWN), naming=("vawm.load(LOGDIR)", "policy.act(")):
        own.predict(np.zeros(2, np.float32))
    policy = vawm.load(runs("box"))
    earlier = policy._replace(spec=policy.spec._replace(native=None))
    assert earlier.native == policy.native
    first = policy._replace(spec=policy.spec._replace(native=None, made=None))
    assert first.native == policy.native


def test_an_environment_that_cannot_be_drawn_says_so(runs):
    with refused("render_mode", "human", naming="None"):
        vawm.load(runs("mjx")).make_env(render_mode="human")


def test_a_registered_environment_draws_itself(runs):
    env = vawm.load(runs("bytes")).make_env(render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (64, 64, 3)
    env.close()


def test_a_policy_is_a_few_lines(runs, tmp_path):
    text = repr(vawm.load(runs("box")))
    assert len(text.splitlines()) < 6
    for said in ("Pendulum-v1", "dreamerv3", "custom", "8 of 96", "not known"):
        assert said in text
    policy = make_policy(CONFIGS["box"], spec_of(CONFIGS["box"]))
    logdir = pathlib.Path(save_run(tmp_path / "run", policy))
    lines = '{"env_steps": 4, "episode/return": -7.25, "episode/count": 2}\n'
    (logdir / "metrics.jsonl").write_text(lines)
    assert "-7.2, the mean over 2 episodes" in str(vawm.load(logdir))
