"""Tables of a model's quality for the terminal, Markdown, JSON and CSV."""

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import pandas as pd

from benchnav.core.tables import NOTHING, Table
from benchnav.datagen.recipe.scenario import find_series
from benchnav.models.quality.columns import COLUMNS, FILES_ONLY, LOOK_ALIKES
from benchnav.models.quality.measure import Quality
from benchnav.models.quality.output import json_text
from benchnav.stats.tables import Column, cell_of, table_of


def quality_table(
    title: str, qualities: Mapping[str, Quality], all_columns: bool = False
) -> Table:
    """Return the numbers as a table with a row per split; a missing number is a dash.

    Args:
        title: title of the table.
        qualities: quality of the model, by split.
        all_columns: whether to include columns for which a terminal is too narrow.
    """
    rows = [numbers(quality) for quality in qualities.values()]
    table = pd.DataFrame(rows, index=list(qualities))
    has_values = np.isfinite(table).any()
    # Both columns are shown even if all their numbers are missing.
    is_optional = table.columns.isin(["rmse_expected", "nll"])
    available = set(table.columns[has_values | is_optional])
    if not all_columns:
        available -= set(FILES_ONLY)
    names = [name for name in COLUMNS if name in available]
    cells = []
    for split, row in table[names].to_dict("index").items():
        n_maps = qualities[split].maps
        cells.append({"split": split, "maps": n_maps, **row})
    split_meaning = "split of the dataset; maps: number of maps in the split."
    columns = [
        Column("split\n", cell_of("split"), split_meaning),
        Column("maps\n", cell_of("maps")),
    ]
    for name in names:
        heading, meaning = COLUMNS[name]
        cell = cell_of(name, _number)
        columns.append(Column(heading, cell, meaning))
    return table_of(cells, columns, title=title, numbers=True)


def _number(value: float) -> str:
    return NOTHING if math.isnan(value) else f"{value:.4f}"


def quality_json(header: Mapping[str, Any], qualities: Mapping[str, Quality]) -> str:
    """Return all results as JSON; a missing number is null.

    Args:
        header: information on model and data.
        qualities: quality of the model, by split.
    """
    splits = {
        split: {"maps": quality.maps, **_all_results(quality)}
        for split, quality in qualities.items()
    }
    return json_text(header, splits)


def quality_csv(qualities: Mapping[str, Quality]) -> str:
    """Return the numbers as CSV, one row per split.

    Splits of a series have a scenario and a severity. `std`, with which every series
    starts, has severity 0 and no scenario.
    """
    rows: dict[str, dict[str, Any]] = {}
    for split, quality in qualities.items():
        rows[split] = {"split": split, "scenario": "", "maps": quality.maps}
        rows[split] |= numbers(quality)
    for scenario, series in find_series(qualities).items():
        for severity, split in series:
            rows[split]["scenario"] = scenario if severity else ""
            rows[split]["severity"] = severity
    columns = ["split", "scenario", "severity", "maps", *COLUMNS]
    table = pd.DataFrame(rows.values(), columns=columns)
    if table[LOOK_ALIKES[0]].isna().all():
        table = table.drop(columns=list(LOOK_ALIKES))
    finite = table.replace((math.inf, -math.inf), math.nan)
    return finite.to_csv(index=False, float_format="%.6g")


def numbers(quality: Quality) -> dict[str, float]:
    """Return the scalar results of a split by name, in the order of `COLUMNS`."""
    values = _all_results(quality)
    return {name: float(values[name]) for name in COLUMNS if name in values}


def _all_results(quality: Quality) -> dict[str, Any]:
    """Return all results of a split by name, including those of look-alikes if any."""
    values: dict[str, Any] = {}
    for item in quality.classes:
        values |= asdict(item)
        values |= values.pop("look_alikes") or {}
    return values | asdict(quality.traversability)
