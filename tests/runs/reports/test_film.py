"""Films of a policy: every step of one episode, drawn and labelled."""

import dataclasses

import jax
import numpy as np
import pytest
import tiny
import tiny_pixels
from analysis_records import make_policy

from vawm import evaluate, presets
from vawm.agent import make_agent
from vawm.envs.host import rendering
from vawm.envs.protocol import EnvironmentFailure
from vawm.policy import movies
from vawm.runs import suites
from vawm.runs.reports import film
from vawm.runs.reports.film import Film, NoPicture


class DrawnLamp(tiny_pixels.Lamp):
    """Its picture is 60 x 80 pixels in the grey of its step."""

    def picture(self):
        return np.full((60, 80, 3), 10 * self.steps, np.uint8)


class GreyLamp(tiny_pixels.Lamp):
    def picture(self):
        return np.zeros((60, 80), np.uint8)


class BrokenLamp(tiny_pixels.Lamp):
    def picture(self):
        raise ImportError("pygame is not installed")


def recorded(make, **changes):
    with tiny_pixels.Pool(make, task="lamp", num_envs=1, workers=1) as env:
        policy = make_policy(tiny_pixels.CONFIG, env.spec)
        agent = make_agent(policy.config, policy.spec)
        choices = {"seed": 7, "steps": 100} | changes
        return film.record(agent, policy.params, policy.model_state, env, **choices)


@pytest.fixture(scope="module")
def whole():
    return recorded(DrawnLamp)


def test_a_film_has_every_step_of_an_episode(whole):
    assert whole.pictures.shape == (5, 60, 80, 3)
    assert whole.pictures[:, 0, 0, 0].tolist() == [0, 10, 20, 30, 40]
    assert whole.ended
    assert whole.returns[0] == 0
    assert set(np.diff(whole.returns)) <= {0.0, 1.0}
    assert np.isfinite(whole.values).all()
    assert len(set(whole.values)) > 1


def test_the_value_is_that_of_the_critic_for_what_the_agent_saw(whole):
    with tiny_pixels.Pool(DrawnLamp, task="lamp", num_envs=1, workers=1) as env:
        policy = make_policy(tiny_pixels.CONFIG, env.spec)
        timestep = env.reset(7)
    agent = make_agent(policy.config, policy.spec)
    _, key = jax.random.split(jax.random.key(7))
    _, _, latent = jax.jit(agent.see)(
        policy.params, policy.model_state, key, agent.initial(1), timestep
    )
    value = agent.critic.code.mean(agent.critic.logits(policy.params.critic, latent))
    assert whole.values[0] == pytest.approx(float(value[0]), rel=1e-4)


def test_a_film_can_be_cut():
    cut = recorded(DrawnLamp, steps=3)
    assert len(cut.pictures) == len(cut.values) == 3
    assert not cut.ended


@pytest.mark.parametrize(
    ("make", "error", "naming"),
    [
        (tiny_pixels.Lamp, NoPicture, "lamp"),
        (GreyLamp, NoPicture, r"uint8\[60, 80\]"),
        (BrokenLamp, EnvironmentFailure, "pygame is not installed"),
    ],
)
def test_what_cannot_be_drawn_says_why(make, error, naming):
    with pytest.raises(error, match=naming):
        recorded(make)


@pytest.mark.parametrize(
    ("size", "expected"),
    [((64, 64), (256, 256)), ((210, 160), (420, 320)), ((257, 301), (258, 302))],
)
def test_frames_are_large_and_labelled_and_have_even_sides(size, expected):
    pictures = np.full((2, *size, 3), 7, np.uint8)
    made = Film(pictures, np.array([0.0, 1.0]), np.array([2.0, 3.5]), True)
    shown = film.frames(made)
    height, width = expected
    assert shown.shape == (2, height + film.STRIP, width, 3)
    assert (shown[:, : height - 1, : width - 1] == 7).all()
    labels = shown[:, height:]
    assert (labels.min(axis=(1, 2, 3)) < 100).all()
    assert (labels[0] != labels[1]).any()


@pytest.mark.parametrize("name", ["a.mp4", "a.gif"])
def test_a_film_is_written_as_its_name_says(tmp_path, whole, name):
    if name.endswith("mp4"):
        pytest.importorskip("imageio")
    movies.check_name("video", tmp_path / name)
    movies.write(film.frames(whole), tmp_path / name)
    head = (tmp_path / name).read_bytes()[:12]
    assert head.startswith(b"GIF8") or head[4:8] == b"ftyp"


CARTPOLE = dataclasses.replace(tiny.CONFIG, task="cartpole_balance", action_repeat=5)


def cartpole():
    from vawm import envs

    spec = envs.make("cartpole_balance", num_envs=2, action_repeat=5).spec
    return make_policy(CARTPOLE, spec)


def test_a_task_on_mjx_is_drawn_by_dm_control():
    if rendering.fault("egl") and rendering.fault("osmesa"):
        pytest.skip(rendering.fault("egl"))
    made = evaluate.filmed(cartpole(), steps=3)
    assert made.pictures.shape == (3, 256, 320, 3)
    assert made.pictures.std() > 10
    assert (made.pictures[0] != made.pictures[2]).any()
    assert 0 < made.returns[-1] <= 10  # upright for 10 control steps


def test_without_a_renderer_the_scores_still_count(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(rendering, "fault", lambda backend: f"no {backend} here")
    monkeypatch.setattr(evaluate, "load", lambda _: cartpole())
    monkeypatch.setattr(evaluate, "by_protocol", lambda *_, **__: evaluate.Score((1.0, 3.0)))
    monkeypatch.setattr(evaluate.cache, "enable", lambda: None)
    path = tmp_path / "films" / "a.gif"
    assert evaluate.main(["--logdir", "somewhere", "--video", str(path)]) == 0
    _, score, line = capsys.readouterr().out.splitlines()
    assert "2.0 +- 1.0" in score
    assert "no film" in line
    assert "no egl here" in line
    assert not path.parent.exists()


def test_another_kind_of_file_is_refused_first(tmp_path, capsys):
    path = str(tmp_path / "a.avi")
    assert evaluate.guard(lambda: evaluate.main(["--logdir", ".", "--video", path])) == 2
    assert capsys.readouterr().err.startswith(f"error: video={path!r}: ")


def test_a_task_from_pixels_is_drawn_large_and_its_observations_stay_the_same():
    if rendering.fault("egl") and rendering.fault("osmesa"):
        pytest.skip(rendering.fault("egl"))
    choices = dataclasses.replace(presets.VISION_QUICK.env, fast_rendering=True, workers=1)
    config = dataclasses.replace(
        presets.VISION_QUICK, task="reacher_easy", num_envs=1, env=choices
    )
    with suites.make_drawn(config) as env:
        first = env.reset(3).obs
        large = env.picture()
        again = env.reset(3).obs
        env.send(np.ones((1, 2), np.float32))
        moved = env.receive().obs
        later = env.picture()
    assert large.shape == later.shape == (256, 256, 3)
    assert (first == again).all()
    assert (first != moved).any()
    small = large.reshape(64, 4, 64, 4, 3).mean((1, 3))
    assert abs(small - first[0].astype(float)).mean() < 10
    assert (large != later).any()


def test_a_registered_environment_is_asked_for_its_pictures():
    config = dataclasses.replace(presets.GYMNASIUM_PIXELS, num_envs=1)
    with suites.make_drawn(config) as env:
        seen = env.reset(0).obs[0]
        assert (env.picture() == seen).all()
    with suites.make(config) as env:
        env.reset(0)
        assert env.picture() is None
