"""Any config is refused in one line or trains; `drills.py` does the same for many more."""

import pathlib

import fuzz
import hypothesis
import jax
import pytest

NOWHERE = pathlib.Path("nowhere")


@hypothesis.given(fuzz.configs())
@hypothesis.settings(max_examples=250)
def test_a_config_is_refused_by_the_name_of_a_choice_or_not_at_all(config):
    fuzz.refusal(config, NOWHERE)
    assert not NOWHERE.exists()


@pytest.mark.parametrize("config", (fuzz.BASES | fuzz.PIXELS).values())
def test_what_is_begun_with_is_not_refused(config):
    assert not fuzz.refusal(config, NOWHERE)


@hypothesis.given(fuzz.configs(fuzz.PIXELS))
@hypothesis.settings(max_examples=120)
def test_so_is_one_for_images_in_any_suite_on_the_host(config):
    """What is accepted is traced as far as its first state: `prepare` does that."""
    fuzz.refusal(config, NOWHERE)
    assert not NOWHERE.exists()


@pytest.mark.parametrize("seed", range(3))
def test_what_is_not_refused_trains(seed):
    accepted = []

    @hypothesis.seed(seed)
    @hypothesis.settings(max_examples=100, derandomize=False, database=None)
    @hypothesis.given(fuzz.configs())
    def collect(config):
        if len(accepted) < 1 and not fuzz.refusal(config, NOWHERE):
            accepted.append(config)

    collect()
    with jax.debug_key_reuse(False):  # which costs most of a trace
        fuzz.trace(*accepted)
