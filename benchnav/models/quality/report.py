"""A model's quality in numbers and words: a table for each kind of file, and what columns and figures mean."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from benchnav.core.tables import NOTHING, Table
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.scenario import find_series
from benchnav.models.base import TraversabilityModel
from benchnav.models.quality.columns import COLUMNS, FILES_ONLY, LOOK_ALIKES
from benchnav.models.quality.measure import Quality
from benchnav.models.quality.output import json_text, page
from benchnav.models.slope_gp.table import SlopeTable
from benchnav.stats.tables import Column, cell_of, table_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Title and explanation by the name of a figure; those of map sheets go on with the split.
_FIGURES = {
    "confusion": (
        "Confusion of classes",
        "Rows are true classes, columns the most likely ones, numbers shares of the row in per cent. A perfect model "
        "has 100 along the diagonal; no model can tell look-alike classes apart. Grey rows are classes that no map of "
        "the split shows.",
    ),
    "reliability": (
        "Calibration of the class probabilities",
        "Above: accuracy of the most likely class over its probability. Calibrated is on the dashed line; below it the "
        "model is overconfident. ECE is the mean gap. Below: number of cells with that probability.",
    ),
    "pit": (
        "Calibration of the predicted distribution of λ",
        "The probability integral transform (PIT) is the place of observed λ in its prediction, from 0 (low end) to 1 "
        "(high end). Calibrated is flat at 1. High at both ends is overconfident, high in the middle underconfident. "
        "High at the left (orange): bad ground is more frequent than predicted. Panels have scales of their own.",
    ),
    "severity": (
        "Quality over the severity of a shift",
        "Measures of the table over the severity of each scenario: 0 is the training maps, 1 the scenario itself.",
    ),
    "latent": (
        "What the Gaussian processes have learned",
        "Predicted traversability over slope for each class, with the truth in black where it is known. Few or no "
        "measured cells are as steep as the grey part.",
    ),
    "maps": (
        "Maps of",
        "Each row is a map: observation, truth, prediction, error and uncertainty. Observed λ stands for the truth "
        "where the true distribution is unknown. A quantity has one scale in all sheets of an evaluation.",
    ),
}


def quality_table(title: str, qualities: Mapping[str, Quality], whole: bool = False) -> Table:
    """Formats the numbers, a row a split; a number that there is not has a dash.

    Args:
        title: over the table.
        qualities: by split.
        whole: with the numbers that a terminal is too narrow for.
    """
    table = pd.DataFrame([numbers(quality) for quality in qualities.values()], index=list(qualities))
    # Those that some split has, and those that the truth or the prediction may lack.
    kept = table.columns[np.isfinite(table).any() | table.columns.isin(["rmse_expected", "nll"])]
    names = [name for name in COLUMNS if name in kept and (whole or name not in FILES_ONLY)]
    rows = [
        {"split": split, "maps": qualities[split].maps, **row}
        for split, row in table[names].to_dict("index").items()
    ]
    columns = [
        Column("split\n", cell_of("split"), "split of the dataset; maps: the number of its maps."),
        Column("maps\n", cell_of("maps")),
        *(Column(COLUMNS[name][0], cell_of(name, _number), COLUMNS[name][1]) for name in names),
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
    return json_text(about, {
        split: {"maps": quality.maps, **_everything(quality)} for split, quality in qualities.items()
    })  # fmt: skip


def quality_csv(qualities: Mapping[str, Quality]) -> str:
    """Writes the numbers as CSV, a row a split, with scenario and severity where it is of a series.

    `std` stands at severity 0 with no scenario, as it begins every series.
    """
    rows: dict[str, dict[str, Any]] = {
        split: {"split": split, "scenario": "", "maps": quality.maps, **numbers(quality)}
        for split, quality in qualities.items()
    }
    for scenario, series in find_series(qualities).items():
        for severity, split in series:
            rows[split] |= {"scenario": scenario if severity else "", "severity": severity}
    table = pd.DataFrame(rows.values(), columns=["split", "scenario", "severity", "maps", *COLUMNS])
    if table[LOOK_ALIKES[0]].isna().all():
        table = table.drop(columns=list(LOOK_ALIKES))
    return table.replace((math.inf, -math.inf), math.nan).to_csv(index=False, float_format="%.6g")


def quality_markdown(
    title: str, qualities: Mapping[str, Quality], notes: Sequence[str], figures: Sequence[str]
) -> str:
    """Writes the numbers as a page with its figures, and what each column and figure means.

    Args:
        title: of the page.
        qualities: by split.
        notes: lines under the table.
        figures: paths of images from the page, each named for what it shows.
    """
    captions = [(path, *caption(PurePath(path).stem, qualities)) for path in figures]
    return page(title, [quality_table(title, qualities, whole=True)], notes, captions)


def quality_figures(
    title: str,
    model: TraversabilityModel,
    dataset: TerrainDataset,
    qualities: Mapping[str, Quality],
    maps: int,
) -> "tuple[dict[str, Callable[[], Figure]], list[str]]":
    """Gives what draws the figures that apply, by name; and a line for each of those that do not, with why.

    Args:
        title: what the map sheets say of model and dataset.
        model: what was measured.
        dataset: on what.
        qualities: by split.
        maps: how many maps of each split the map sheets show.
    """
    from benchnav.models.quality import figures, map_sheet

    drawn: dict[str, Callable[[], Figure]] = {}
    absent = []
    by_class = {split: item for split, quality in qualities.items() for item in quality.classes}
    classes, table = dataset.recipe.classes, getattr(model, "table", None)
    if by_class:
        drawn["confusion"] = partial(figures.confusion_figure, by_class, [item.name for item in classes])
        drawn["reliability"] = partial(figures.reliability_figure, by_class)
    if len(by_class) < len(qualities):
        absent.append("no confusion matrix, reliability diagram or entropy: the model predicts no classes")
    by_cell = {split: quality.traversability for split, quality in qualities.items()}
    drawn["pit"] = partial(figures.pit_figure, by_cell)
    if all_series := find_series(qualities):
        found = {split: numbers(quality) for split, quality in qualities.items()}
        drawn["severity"] = partial(figures.severity_figure, all_series, found)
    if not isinstance(table, SlopeTable):
        absent.append("no latent functions: the model has no Gaussian processes over slope")
    elif by_class:
        cells = np.sum([quality.slope_cells for quality in by_class.values()], 0)
        known = all(dataset.truth_of(split) == "generated" for split in qualities)
        drawn["latent"] = partial(figures.latent_figure, table, classes, cells.tolist(), known)
    if not all_series:
        absent.append("no series of shifts: no splits such as test/hg-050 and test/hg-100 were measured")
    if maps:
        sheets = [
            map_sheet.read_sheet(model, dataset, split, range(min(maps, dataset.map_count(split))))
            for split in qualities
        ]
        scales = map_sheet.shared_scales(sheets, classes)
        for sheet in sheets:
            draw = partial(map_sheet.map_sheet_figure, sheet, scales, classes, title)
            drawn[sheet_name(sheet.split)] = draw
    return drawn, absent


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


def caption(figure: str, splits: Iterable[str]) -> tuple[str, str]:
    """Gives the title of a figure, and what it shows.

    Args:
        figure: its name, such as `pit`, or `maps-test-std` of a map sheet.
        splits: names of those that were measured.
    """
    if figure in _FIGURES:
        return _FIGURES[figure]
    title, text = _FIGURES["maps"]
    return f"{title} {next(split for split in splits if sheet_name(split) == figure)}", text


def sheet_name(split: str) -> str:
    """Name of the map sheet of a split."""
    return f"maps-{split.replace('/', '-')}"
