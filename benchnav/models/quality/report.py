"""A model's quality in numbers and words: a table for each kind of file, and what
columns and figures mean.
"""

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
    title: str, qualities: Mapping[str, Quality], whole: bool = False
) -> Table:
    """Formats the numbers, a row a split; a number that there is not has a dash.

    Args:
        title: over the table.
        qualities: by split.
        whole: with the numbers that a terminal is too narrow for.
    """
    table = pd.DataFrame(
        [numbers(quality) for quality in qualities.values()], index=list(qualities)
    )
    # Those that some split has, and those that the truth or the prediction may lack.
    kept = table.columns[
        np.isfinite(table).any() | table.columns.isin(["rmse_expected", "nll"])
    ]
    names = [
        name for name in COLUMNS if name in kept and (whole or name not in FILES_ONLY)
    ]
    rows = [
        {"split": split, "maps": qualities[split].maps, **row}
        for split, row in table[names].to_dict("index").items()
    ]
    columns = [
        Column(
            "split\n",
            cell_of("split"),
            "split of the dataset; maps: the number of its maps.",
        ),
        Column("maps\n", cell_of("maps")),
        *(
            Column(COLUMNS[name][0], cell_of(name, _number), COLUMNS[name][1])
            for name in names
        ),
    ]
    return table_of(rows, columns, title=title, numbers=True)


def _number(value: float) -> str:
    return NOTHING if math.isnan(value) else f"{value:.4f}"


def quality_json(about: Mapping[str, Any], qualities: Mapping[str, Quality]) -> str:
    """Writes everything that was measured as JSON; a number that there is not is null.

    Args:
        about: what is said of model and data.
        qualities: by split.
    """
    return json_text(
        about,
        {
            split: {"maps": quality.maps, **_everything(quality)}
            for split, quality in qualities.items()
        },
    )


def quality_csv(qualities: Mapping[str, Quality]) -> str:
    """Writes the numbers as CSV, a row a split, with scenario and severity where it is
    of a series.

    `std` stands at severity 0 with no scenario, as it begins every series.
    """
    rows: dict[str, dict[str, Any]] = {
        split: {
            "split": split,
            "scenario": "",
            "maps": quality.maps,
            **numbers(quality),
        }
        for split, quality in qualities.items()
    }
    for scenario, series in find_series(qualities).items():
        for severity, split in series:
            rows[split] |= {
                "scenario": scenario if severity else "",
                "severity": severity,
            }
    table = pd.DataFrame(
        rows.values(), columns=["split", "scenario", "severity", "maps", *COLUMNS]
    )
    if table[LOOK_ALIKES[0]].isna().all():
        table = table.drop(columns=list(LOOK_ALIKES))
    return table.replace((math.inf, -math.inf), math.nan).to_csv(
        index=False, float_format="%.6g"
    )


def numbers(quality: Quality) -> dict[str, float]:
    """The single numbers of a split's quality by name, in the order of `COLUMNS`."""
    values = _everything(quality)
    return {name: float(values[name]) for name in COLUMNS if name in values}


def _everything(quality: Quality) -> dict[str, Any]:
    """Everything of a split by name; what is of look-alikes only where there are any."""
    values: dict[str, Any] = {}
    for item in quality.classes:
        values |= asdict(item)
        values |= values.pop("look_alikes") or {}
    return values | asdict(quality.traversability)
