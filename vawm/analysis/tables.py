"""Numbers on disk: CSV for rows, JSON for what a program measured once."""

from __future__ import annotations

import csv
import json
import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from vawm.runs.reports.tracking import as_json


def write_csv(rows: Sequence[Mapping[str, Any]], path: pathlib.Path) -> None:
    """A column for every key of the first row; what is not finite is left empty.

    Of no rows a single empty line is written: their columns are not known.
    """
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [], lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _plain(value) for name, value in row.items()} for row in rows)


def write_json(values: Mapping[str, Any], path: pathlib.Path) -> None:
    """Strictly valid JSON of one level or two: what is not finite becomes null."""
    path.write_text(json.dumps({k: _strict(v) for k, v in values.items()}, indent=2) + "\n")


def _strict(value: Any) -> Any:
    return json.loads(as_json(value)) if isinstance(value, dict) else value


def _plain(value: Any) -> Any:
    if not isinstance(value, float):
        return value
    return f"{value:.6g}" if math.isfinite(value) else ""
