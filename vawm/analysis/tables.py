"""Writes numbers to disk: CSV for rows, JSON for single values."""

from __future__ import annotations

import csv
import json
import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from vawm.runs.reports.tracking import as_json


def write_csv(rows: Sequence[Mapping[str, Any]], path: pathlib.Path) -> None:
    """Writes a column for every key of the first row; numbers that are not finite are empty.

    Without rows it writes one empty line, because the columns are unknown.
    """
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [], lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _plain(value) for name, value in row.items()} for row in rows)


def write_json(values: Mapping[str, Any], path: pathlib.Path) -> None:
    """Writes strictly valid JSON, at most two levels deep; non-finite numbers become null."""
    path.write_text(json.dumps({k: _strict(v) for k, v in values.items()}, indent=2) + "\n")


def _strict(value: Any) -> Any:
    return json.loads(as_json(value)) if isinstance(value, dict) else value


def _plain(value: Any) -> Any:
    if not isinstance(value, float):
        return value
    return f"{value:.6g}" if math.isfinite(value) else ""
