"""Training around environments on the host: order, counting, where images are, failures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_pixels
import tiny_storm
from runs import assert_same, lines, quiet
from tiny_pixels import Lamp, Picture

from vawm.envs.protocol import EnvironmentFailure
from vawm.errors import InvalidInput
from vawm.learning import host_train
from vawm.runs import checkpoint, runner, trainer
from vawm.runs.reports import tracking


def run(config, logdir, env=None, **changes):
    env = env or tiny_pixels.pool()
    return runner.run(config, logdir, env=env, console=quiet(), **changes)


@pytest.fixture(scope="module")
def trained():
    """A compiled step and its first 20 chunks, images on the device."""
    with tiny_pixels.pool() as env:
        made = trainer.make(tiny_pixels.CONFIG, env)
        state = made.init(0)
        step = made.compile(state).run
        history = []
        for _ in range(20):
            state, metrics = step(state)
            history.append({name: float(value) for name, value in metrics.items()})
        yield env, made, step, state, history


def test_the_number_of_updates_follows_the_train_ratio_exactly(trained):
    *_, history = trained
    config = tiny_pixels.CONFIG
    per_chunk, batch = config.collect_steps * config.num_envs, config.replay.batch_steps
    ready = [chunk for chunk in range(1, 21) if 2 * (4 * chunk - 8) >= batch]
    expected = [
        max(0, chunk - ready[0] + 1) * per_chunk * config.train_ratio // batch
        for chunk in range(1, 21)
    ]
    assert [line["updates"] for line in history] == expected
    assert [line["chunk/updates"] for line in history] == list(np.diff(expected, prepend=0))


def test_env_steps_leave_resets_out(trained):
    *_, history = trained
    calls = 4 * np.arange(1, 21)
    expected = 2 * (calls - calls // 5)  # every fifth call is a reset
    assert [line["env_steps"] for line in history] == expected.tolist()
    assert sum(line["episode/count"] for line in history) == 2 * (80 // 5)
    assert sum(line["episode/length"] for line in history) == 4 * 2 * (80 // 5)


def test_metrics_of_updates_are_finite_and_0_without_one(trained):
    *_, history = trained
    assert history[0].keys() == history[-1].keys()
    assert history[0]["chunk/updates"] == history[0]["loss/total"] == 0
    assert all(np.isfinite(value) for value in history[-1].values())
    assert {"loss/value_alignment", "latent/kl", "env/restarts"} <= set(history[-1])


def test_replay_holds_what_the_environments_showed(trained):
    """Clock, brightness and flags of the stored stream agree; rewards fit the actions."""
    *_, state, _ = trained
    stored = jax.device_get(state.replay.trajectory)
    order = (int(state.replay.head) - np.arange(32, 0, -1)) % 32
    stored = jax.tree.map(lambda x: x[:, order], stored)
    clock, picture = stored.obs["clock"][..., 0], stored.obs["picture"]
    np.testing.assert_array_equal(picture.max((2, 3, 4)), 50 * (clock + 1))
    np.testing.assert_array_equal(stored.is_first, clock == 0)
    np.testing.assert_array_equal(stored.is_last, clock == 4)
    np.testing.assert_array_equal(stored.is_terminal, clock == 4)
    right = picture[:, :, 0, 30, 0] > 0
    hit = stored.action.argmax(-1) == right
    np.testing.assert_array_equal(
        stored.reward[:, 1:], np.where(stored.is_first, 0.0, np.roll(hit, 1, 1))[:, 1:]
    )


def chunks(config, count, env=None):
    """The state after `count` chunks of a new run, and the metrics of each."""
    with env or tiny_pixels.pool() as env:
        made = trainer.make(config, env)
        state = made.init(0)
        step = made.compile(state).run
        history = []
        for _ in range(count):
            state, metrics = step(state)
            history.append({name: float(value) for name, value in metrics.items()})
        return jax.device_get(state), history


def test_it_does_not_matter_where_images_are_kept(trained):
    *_, history = trained
    state, other = chunks(tiny_pixels.config("host"), 20)
    assert state.replay.trajectory.obs["picture"].size == 0
    assert state.images["picture"].shape == (2, 32, 48, 48, 3)
    assert state.images["clock"].size == 0
    assert other[-1].keys() == history[-1].keys()
    for line, expected in zip(other, history, strict=True):
        assert line == pytest.approx(expected, rel=1e-5)
    assert (state.images["picture"] != 0).any((2, 3, 4)).all()


def test_updates_run_between_sending_and_receiving(trained):
    """So that they and the simulation hide each other."""
    env, made, _, state, _ = trained
    order = []

    class Watched:
        spec, restarts = env.spec, 0

        def send(self, action):
            order.append("send")
            env.send(action)

        def receive(self):
            order.append("receive")
            return env.receive()

    def compiled(name):
        function = getattr(programs, name)

        def call(*arguments):
            order.append(name)
            return function(*arguments)

        return call

    programs = host_train.compile_programs(env.spec, made.agent, tiny_pixels.CONFIG, state)
    watched = programs._replace(
        **{name: compiled(name) for name in ("depart", "arrive", "update")}
    )
    step = host_train.make_step(Watched(), tiny_pixels.CONFIG, watched)
    state = jax.tree.map(jnp.copy, state)
    for _ in range(2):
        state, _ = step(state)
    calls = ["depart", "send", "receive", "arrive"]
    assert [name for name in order if name != "update"] == 8 * calls
    updates = [i for i, name in enumerate(order) if name == "update"]
    assert len(updates) >= 2
    for i in updates:
        before = [name for name in order[:i] if name != "update"]
        assert (before[-1], order[i + 1]) in [("send", "receive"), ("send", "update")]


LONG = tiny_pixels.config(env_steps=192)


@pytest.mark.parametrize(
    ("images", "make", "agent"),
    [
        ("device", Picture, lambda config: config),
        ("host", Lamp, tiny_storm.storm),
    ],
)
def test_a_run_that_is_resumed_equals_one_in_one_piece(tmp_path, images, make, agent):
    long = agent(tiny_pixels.config(images, env_steps=192))
    run(long, tmp_path / "whole", tiny_pixels.pool(make))
    short = agent(tiny_pixels.config(images, env_steps=104))
    run(short, tmp_path / "parts", tiny_pixels.pool(make))
    run(long, tmp_path / "parts", tiny_pixels.pool(make), resume=True)
    assert_same(tmp_path / "parts", tmp_path / "whole", long, tiny_pixels.pool(make))
    videos = [
        sorted(p.name for p in tmp_path.glob(f"{x}/videos/*")) for x in ("parts", "whole")
    ]
    assert videos[0] == videos[1]
    for name in videos[0]:
        parts, whole = (tmp_path / x / "videos" / name for x in ("parts", "whole"))
        assert parts.read_bytes() == whole.read_bytes()
    numbers = [tracking.read(tmp_path / x / "videos.jsonl") for x in ("parts", "whole")]
    assert numbers[0] == numbers[1]


class Fickle(Lamp):
    """Does not do the same again."""

    count = 0

    def _look(self):
        obs = super()._look()
        Fickle.count += 1
        obs["picture"][0, 0, 0] = Fickle.count % 256
        return obs


def test_a_run_in_environments_that_cannot_repeat_themselves_goes_on_and_says_so(tmp_path):
    run(tiny_pixels.config(env_steps=102), tmp_path, tiny_pixels.pool(Fickle))
    console = quiet()
    env = tiny_pixels.pool(Fickle)
    runner.run(LONG, tmp_path, env=env, console=console, resume=True)
    text = console.file.getvalue()
    assert "2 of 2 environments" in text
    assert lines(tmp_path)[-1]["env_steps"] >= 192


class Broken(Lamp):
    """Raises in the 60th step of its process."""

    count = 0

    def step(self, action):
        Broken.count += 1
        if Broken.count == 60:
            raise OSError("the lamp is broken")
        return super().step(action)


def test_an_environment_that_fails_ends_the_run_in_one_line(tmp_path):
    env = tiny_pixels.pool(Broken)
    with pytest.raises(runner.RunError) as error:
        run(tiny_pixels.CONFIG, tmp_path, env)
    assert_closed(env)
    text = str(error.value)
    assert text.startswith("environment 1, episode 7, step ")
    assert "OSError: the lamp is broken" in text
    assert "checkpoint at 32" in text
    assert "on_failure='restart'" in text
    assert error.value.settings == {"on_failure": "restart"}
    assert "\n" not in text
    assert isinstance(error.value.__cause__, EnvironmentFailure)


def test_an_environment_that_may_restart_does_and_is_counted(tmp_path):
    result = run(tiny_pixels.CONFIG, tmp_path, tiny_pixels.pool(Broken, on_failure="restart"))
    assert result.env_steps == 96
    assert sum(line["env/restarts"] for line in lines(tmp_path)) == 1
    with tiny_pixels.pool() as env:
        state, _ = checkpoint.restore(tmp_path, trainer.make(tiny_pixels.CONFIG, env).shapes)
    stored = state.replay.trajectory
    first, clock = np.asarray(stored.is_first), np.asarray(stored.obs["clock"])[..., 0]
    np.testing.assert_array_equal(first, clock == 0)


class Lost(Lamp):
    """Loses the reward of every second step, or one entry of the clock."""

    fields = {"reward": np.nan}  # noqa: RUF012

    def step(self, action):
        outcome = super().step(action)
        if self.steps == 2 and "clock" in self.fields:
            outcome.obs["clock"][0] = self.fields["clock"]
        if self.steps == 2 and "reward" in self.fields:
            outcome = outcome._replace(reward=self.fields["reward"])
        return outcome


class LostClock(Lost):
    fields = {"clock": np.inf}  # noqa: RUF012


class LostBelow(Lost):
    fields = {"clock": -np.inf}  # noqa: RUF012


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (Lost, "reward is nan"),
        (LostClock, r"obs\['clock'\]\[0\] is inf"),
        (LostBelow, r"obs\['clock'\]\[0\] is -inf"),
    ],
)
def test_what_is_not_finite_ends_the_run_with_environment_step_and_field(
    tmp_path, make, reason
):
    with pytest.raises(runner.RunError, match=f"environment 0, episode 0, step 2: {reason}"):
        run(tiny_pixels.CONFIG, tmp_path, tiny_pixels.pool(make))


def test_where_environments_may_restart_what_is_not_finite_is_never_learned_from(tmp_path):
    """Every episode is broken off before its second step, and never three times in a row."""
    pool = tiny_pixels.pool(Lost, on_failure="restart")
    assert run(tiny_pixels.CONFIG, tmp_path, pool).env_steps >= 96
    assert sum(line["env/restarts"] for line in lines(tmp_path)) > 20
    with tiny_pixels.pool() as env:
        shapes = trainer.make(tiny_pixels.CONFIG, env).shapes
    state, _ = checkpoint.restore(tmp_path, shapes)
    assert not np.asarray(state.replay.trajectory.is_last).any()
    for leaf in jax.tree.leaves((state.learner.params, state.replay)):
        assert np.isfinite(leaf).all()


class Huge(Lost):
    """Numbers that float32 can just about hold, and whose squares it cannot."""

    fields = {"clock": 1e30, "reward": -1e30}  # noqa: RUF012


def test_huge_observations_and_rewards_are_learned_from_and_all_stays_finite(tmp_path):
    assert run(tiny_pixels.CONFIG, tmp_path, tiny_pixels.pool(Huge)).env_steps == 96
    with tiny_pixels.pool() as env:
        shapes = trainer.make(tiny_pixels.CONFIG, env).shapes
    state, _ = checkpoint.restore(tmp_path, shapes)
    assert (np.asarray(state.replay.trajectory.obs["clock"]) == np.float32(1e30)).any()
    for leaf in jax.tree.leaves(state.learner):
        assert np.isfinite(leaf).all()


def assert_closed(env):
    with pytest.raises(RuntimeError):
        env.reset(0)


def test_environments_are_closed_where_a_run_is_refused(tmp_path):
    env = tiny_pixels.pool()
    with pytest.raises(InvalidInput, match="num_envs=3: the environments have 2"):
        run(tiny_pixels.config(num_envs=3), tmp_path, env)
    assert_closed(env)


def test_a_run_closes_its_environments_and_leaves_videos_and_their_numbers(tmp_path):
    env = tiny_pixels.pool()
    run(tiny_pixels.CONFIG, tmp_path, env)
    assert_closed(env)
    entries = tracking.read(tmp_path / "videos.jsonl")
    assert [entry["env_steps"] for entry in entries] == [52, 52, 96, 96]  # from 48 on
    loop, episode = entries[:2]
    assert loop["context"] == 3
    assert len(loop["error"]) == tiny_pixels.CONFIG.replay.batch_length
    assert episode["steps"] == 4
    assert episode["return"] == int(episode["return"])
    for entry in entries:
        assert (tmp_path / "videos" / entry["video"]).read_bytes().startswith(b"GIF8")
