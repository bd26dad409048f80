"""Published scores: the paper's aggregates follow from its tables."""

import math
import statistics
from importlib import resources

import pytest
from refusals import refused

from vawm.envs.host import atari
from vawm.policy import scores


def column(table, name):
    return {row: cells[name] for row, cells in scores.table(table).items()}


@pytest.mark.parametrize(
    ("agent", "mean", "median", "superhuman"),
    [
        ("dreamerv3", 1.102, 0.579, 10),
        ("dreamerv3_var", 1.337, 0.997, 13),
        ("storm", 1.140, 0.513, 9),
        ("storm_var", 1.364, 0.808, 12),
    ],
)
def test_the_printed_aggregates_follow_from_the_printed_scores(agent, mean, median, superhuman):
    actual = scores.aggregate(column("atari100k", agent))
    assert actual.mean == pytest.approx(mean, abs=5e-4)
    assert actual.median == pytest.approx(median, abs=5e-4)
    assert actual.superhuman == superhuman
    assert actual.games == 26


@pytest.mark.parametrize("agent", ["dreamerv3", "storm"])
def test_value_alignment_is_better_in_22_of_26_games(agent):
    with_it, without = column("atari100k", f"{agent}_var"), column("atari100k", agent)
    assert sum(with_it[game] > without[game] for game in without) == 22


@pytest.mark.parametrize("agent", ["dreamerv3", "storm"])
def test_the_tables_of_one_agent_repeat_the_table_of_all(agent):
    table = f"atari100k_{agent}"
    for name in ("random", "human", f"{agent}_var"):
        assert column(table, name) == column("atari100k", name)
    assert column(table, f"{agent}_reproduced") == column("atari100k", agent)


def test_the_printed_mean_of_the_vision_tasks_follows_from_the_table():
    vision = column("dmc_vision_1m", "dreamerv3_var")
    assert len(vision) == 20
    assert statistics.fmean(vision.values()) == pytest.approx(827, abs=0.5)


def test_scores_that_are_not_printed_are_left_out():
    proprio = scores.table("dmc_proprio_500k")
    assert len(proprio) == 18
    assert sum("dreamerv3_paper_rerun" in row for row in proprio.values()) == 15
    assert "dreamerv3_paper_rerun" not in proprio["acrobot_swingup"]
    assert proprio["walker_walk"]["dreamerv3_official"] == 925


def test_the_package_contains_exactly_the_tables_listed():
    files = {file.name for file in resources.files(scores).iterdir()}
    assert {name for name in files if name.endswith(".csv")} == {
        f"{name}.csv" for name in scores.TABLES
    }


def test_changing_a_table_does_not_change_the_next_one_read():
    scores.table("atari100k")["Pong"]["human"] = 1e9
    assert scores.human_normalized("pong", 14.6) == pytest.approx(1)


@pytest.mark.parametrize(
    ("game", "score", "expected"),
    [
        ("breakout", 1.7, 0.0),
        ("breakout", 30.5, 1.0),
        ("breakout", 16.1, 0.5),  # halfway: 14.4 of 28.8
        ("Pong", -20.7, 0.0),
        ("pong", 21.0, 41.7 / 35.3),
        ("BankHeist", 14.2 - 738.9, -1.0),  # as far below random as the human is above
        ("freeway", 29.6, 1.0),  # random is 0
    ],
)
def test_human_normalised_scores_by_hand(game, score, expected):
    assert scores.human_normalized(game, score) == pytest.approx(expected)


def test_aggregates_by_hand():
    """Normalised 0, 1, 2 and 5: a score equal to the human's is not superhuman."""
    of_three = {"breakout": 1.7, "Freeway": 29.6, "boxing": 0.1 + 2 * 12}
    assert scores.aggregate(of_three) == pytest.approx((1, 1, 1, 3))
    of_four = of_three | {"krull": 1598 + 5 * 1067.5}
    assert scores.aggregate(of_four) == pytest.approx((2, 1.5, 2, 4))


def test_games_are_found_by_task_name_and_by_printed_name():
    assert {task: game.name for task, game in scores.games().items()} == atari.GAMES
    for task, printed in atari.GAMES.items():
        assert scores.human_normalized(task, 7.0) == scores.human_normalized(printed, 7.0)


@pytest.mark.parametrize("name", ["bankheist", "Bank Heist", "bank_hiest", "BANK_HEIST"])
def test_an_unknown_game_is_refused_with_the_nearest(name):
    with refused("game", name, naming="'bank_heist'"):
        scores.human_normalized(name, 1.0)
    with refused("game", name, naming="'bank_heist'"):
        scores.aggregate({"pong": 1.0, name: 1.0})


def test_an_unknown_table_is_refused_with_the_nearest():
    with refused("table", "atari_100k", naming="'atari100k'"):
        scores.table("atari_100k")
    with refused("table", "../errors", naming="atari100k, "):
        scores.table("../errors")


def test_an_aggregate_of_nothing_or_of_one_game_twice_is_refused():
    with refused("scores", {}):
        scores.aggregate({})
    with refused("scores", ["UpNDown"]):
        scores.aggregate({"up_n_down": 1.0, "UpNDown": 2.0, "pong": 3.0})


@pytest.mark.parametrize("score", [math.nan, math.inf])
def test_a_score_that_is_not_finite_is_refused(score):
    with refused("pong", score, naming="finite"):
        scores.aggregate({"breakout": 1.0, "pong": score})
