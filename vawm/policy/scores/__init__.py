"""Published scores to compare with, and the aggregate numbers of Atari 100k.

    table                rows                        from
    atari100k            26 games                    the paper, Table 1
    atari100k_dreamerv3  26 games                    the paper, Table 5
    atari100k_storm      26 games                    the paper, Table 6
    dmc_vision_1m        20 tasks, 1M steps          the paper, Table 2, left
    dmc_proprio_500k     18 tasks, 500K frames       score files published with the agents;
                                                     the rerun from the paper, Table 2, right

Columns that end in `_var` are agents with value alignment, from the paper. `dreamerv3` and
`storm` in the first table are the paper's own runs; the second and third table call these
`_reproduced`. `_reported` is what the agents' authors print, `storm_meo2024` what Meo et al.
(2024) print. For the rerun of dmc_proprio_500k, the paper prints 15 tasks without value
alignment and no task with it; over all 18 tasks it prints means of 805 without and 817 with
value alignment, and medians of 881 and 901.
BattleZone's human score is 37187.7 in the paper's tables, 37187.5 in most others.
"""

from __future__ import annotations

import csv
import functools
import math
import re
import statistics
from collections.abc import Iterable, Mapping
from importlib import resources
from typing import NamedTuple

from vawm.errors import InvalidInput, suggestion

FILES = resources.files(__name__)
TABLES = tuple(sorted(file.name[:-4] for file in FILES.iterdir() if file.name.endswith(".csv")))
"""The names of all tables. The record of a suite names its own, see `vawm.runs.suites`."""


class Game(NamedTuple):
    """The reference scores of one game.

    Attributes:
      name: as printed, "BankHeist".
      random: score of uniformly random play.
      human: human score.
    """

    name: str
    random: float
    human: float


class Aggregate(NamedTuple):
    """Aggregate human-normalised scores over games.

    Attributes:
      mean: over the games.
      median: over the games.
      superhuman: number of games above the human score.
      games: number of games; only all 26 compare with published numbers.
    """

    mean: float
    median: float
    superhuman: int
    games: int


def table(name: str) -> dict[str, dict[str, float]]:
    """Reads a table: row -> column -> score; scores that are not printed are left out.

    Args:
      name: one of `TABLES`. Games are named as printed, DMC tasks as in this package.

    Raises:
      InvalidInput: an unknown name.
    """
    if name not in TABLES:
        raise InvalidInput("table", name, remedy(name, TABLES))
    text = FILES.joinpath(f"{name}.csv").read_text(encoding="utf-8")
    header, *rows = csv.reader(text.splitlines())
    return {
        row[0]: {
            column: float(score)
            for column, score in zip(header[1:], row[1:], strict=True)
            if score
        }
        for row in rows
    }


def human_normalized(game: str, score: float, *, table: str = "atari100k") -> float:
    """(score - random) / (human - random): 0 for random play, 1 for a human.

    Args:
      game: as a task, "bank_heist", or as printed, "BankHeist".
      score: mean return of whole games, in the game's points.
      table: one with the columns `random` and `human`.

    Raises:
      InvalidInput: an unknown game, or a score that is not finite.
    """
    _, random, human = find_game(game, table)
    if not math.isfinite(score):
        raise InvalidInput(game, score, "give a finite score")
    return (score - random) / (human - random)


def aggregate(scores: Mapping[str, float]) -> Aggregate:
    """Aggregates the human-normalised scores of games, named as in `human_normalized`.

    Raises:
      InvalidInput: an unknown game, no game, one game under both of its names, or a score
        that is not finite.
    """
    if not scores:
        raise InvalidInput("scores", scores, "give the score of at least one game")
    names = [find_game(game).name for game in scores]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InvalidInput("scores", twice, "give each game once, under one of its names")
    normalized = [human_normalized(game, score) for game, score in scores.items()]
    return Aggregate(
        mean=statistics.fmean(normalized),
        median=statistics.median(normalized),
        superhuman=sum(score > 1 for score in normalized),
        games=len(normalized),
    )


def find_game(name: str, of: str = "atari100k") -> Game:
    """The game with either name in a table; refuses others and suggests the nearest one."""
    for task, game in games(of).items():
        if name in (task, game.name):
            return game
    raise InvalidInput("game", name, remedy(name, games(of)))


@functools.cache
def games(of: str = "atari100k") -> dict[str, Game]:
    """The games of a table by task name."""
    return {
        snake_case(name): Game(name, row["random"], row["human"])
        for name, row in table(of).items()
    }


def snake_case(name: str) -> str:
    """Turns "BankHeist" into "bank_heist"."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()


def remedy(name: str, known: Iterable[str]) -> str:
    """What to write instead of an unknown name: suggests the nearest one and lists all."""
    choices = list(known)
    return f"{suggestion(name, choices)}choose one of {', '.join(choices)}"
