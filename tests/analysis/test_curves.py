"""Curves of several runs: groups, means and ranges."""

import dataclasses
import json

import numpy as np
import pytest
import tiny
import tiny_pixels
from refusals import refused

from vawm.analysis import curves
from vawm.runs import resume, run_folder, validate

PLAIN = dataclasses.replace(
    tiny.CONFIG,
    value_alignment=dataclasses.replace(tiny.CONFIG.value_alignment, weight="off"),
)


def run(config, points, metric="latent/kl", **changes):
    lines = [{"env_steps": steps, metric: value} for steps, value in points]
    return curves.Run(dataclasses.replace(config, **changes), lines)


def test_runs_that_differ_only_in_their_seed_are_one_group():
    static = dataclasses.replace(
        tiny.CONFIG,
        value_alignment=dataclasses.replace(
            tiny.CONFIG.value_alignment, weight="static", static_weight=50.0
        ),
    )
    runs = [
        run(tiny.CONFIG, []),
        run(PLAIN, [], seed=1),
        run(tiny.CONFIG, [], seed=2),
        run(static, []),
        run(tiny.CONFIG, [], train_ratio=4),
    ]
    groups = curves.group(runs)
    start = "probe_observation_action, dreamerv3, alignment"
    assert list(groups) == [
        f"{start} adaptive (1)",
        f"{start} off",
        f"{start} static 50",
        f"{start} adaptive (2)",
    ]
    assert [len(own) for own in groups.values()] == [2, 1, 1, 1]


def changed(config, name, value):
    """`config` with another value of a field, given by its dotted name."""
    first, _, rest = name.partition(".")
    if rest:
        value = changed(getattr(config, first), rest, value)
    return dataclasses.replace(config, **{first: value})


@pytest.mark.parametrize("name", resume.MAY_DIFFER)
def test_fields_that_a_resumed_run_may_change_do_not_split_a_group(name):
    own = dict(validate.values(tiny_pixels.CONFIG))[name]
    other = "other" if isinstance(own, str) else own + 1
    config = changed(tiny_pixels.CONFIG, name, other)
    assert config != tiny_pixels.CONFIG
    groups = curves.group([run(tiny_pixels.CONFIG, []), run(config, [], seed=1)])
    assert [len(own) for own in groups.values()] == [2]


def test_a_nested_choice_makes_another_group():
    config = changed(tiny_pixels.CONFIG, "critic.slow_rate", 0.5)
    assert len(curves.group([run(tiny_pixels.CONFIG, []), run(config, [])])) == 2


def test_a_curve_is_mean_and_range_by_hand():
    """On the common range, without None, linear between lines."""
    runs = [
        run(tiny.CONFIG, [(0, None), (10, 1.0), (20, 3.0), (30, 5.0)]),
        run(tiny.CONFIG, [(10, 3.0), (25, 6.0)]),
    ]
    found = curves.curve(runs, "latent/kl")
    np.testing.assert_array_equal(found.env_steps, [10, 20, 25])
    np.testing.assert_allclose(found.mean, [2.0, 4.0, 5.0])
    np.testing.assert_allclose(found.low, [1.0, 3.0, 4.0])
    np.testing.assert_allclose(found.high, [3.0, 5.0, 6.0])
    assert found.seeds == 2
    assert curves.curve(runs, "loss/dynamics") is None
    apart = [run(tiny.CONFIG, [(0, 1.0)]), run(tiny.CONFIG, [(5, 1.0)])]
    assert curves.curve(apart, "latent/kl") is None


def test_rows_name_group_metric_and_step():
    found = curves.curves(curves.group([run(PLAIN, [(8, 0.5)])]))
    (row,) = curves.rows(found)
    assert row == {
        "group": "probe_observation_action, dreamerv3, alignment off",
        "metric": "latent/kl",
        "env_steps": 8,
        "mean": 0.5,
        "min": 0.5,
        "max": 0.5,
        "seeds": 1,
    }


def test_a_run_is_read_from_its_folder(tmp_path):
    with refused("logdirs", str(tmp_path)):
        curves.read(tmp_path)
    run_folder.write_config(tmp_path, PLAIN)
    with refused("logdirs", str(tmp_path)):
        curves.read(tmp_path)
    line = {"env_steps": 8, "latent/kl": 0.5}
    (tmp_path / "metrics.jsonl").write_text(json.dumps(line) + "\n")
    assert curves.read(tmp_path) == curves.Run(PLAIN, [line])
