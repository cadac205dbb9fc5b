"""A model's quality in numbers and words: a table for each kind of file, and what columns and figures mean."""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from benchnav.core.tables import NOTHING, Table, to_markdown
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.scenario import find_series
from benchnav.models.base import TraversabilityModel
from benchnav.models.quality.measure import Quality
from benchnav.models.slope_gp.table import SlopeTable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Of the numbers of ClassQuality and TraversabilityQuality: the heading in two lines, and what it means to who meets
# it first.
COLUMNS = {
    "accuracy": (
        "accuracy\n",
        "share of cells whose most likely class is the true one; 1 is perfect.",
    ),
    "miou": (
        "mIoU\n",
        "mean intersection over union: the cells where a class is both predicted and true, over those where it "
        "is either, in the mean over the classes that occur in truth; 1 is perfect.",
    ),
    "miou_predicted": (
        "mIoU\n∪ pred.",
        "the same in the mean over the classes that are true or predicted somewhere; one that never occurs "
        "counts as 0 as soon as a cell is taken for it.",
    ),
    "look_alike_accuracy": (
        "accuracy\nlook-alikes=1",
        "accuracy with classes of one colour counted as one, as no image tells them apart; 1 is perfect.",
    ),
    "look_alike_miou": (
        "mIoU\nlook-alikes=1",
        "mean intersection over union with classes of one colour counted as one; 1 is perfect.",
    ),
    "look_alike_share_error": (
        "look-alikes\noff ½",
        "of two classes that share a colour, how far the share of the true one is from ½, which is all that can "
        "be said; 0 is perfect.",
    ),
    "look_alike_share_ece": (
        "ECE\nlook-alikes",
        "of two classes that share a colour, the calibration error of the larger share; 0 is perfect.",
    ),
    "ece": (
        "ECE\n",
        "expected calibration error: how far the probability of the most likely class is from how often it is "
        "right, in the mean over cells; 0 is perfect.",
    ),
    "brier": (
        "Brier\n",
        "squared distance of the class probabilities to the truth, which is 1 for the true class and 0 for the "
        "rest; 0 is perfect, 2 is sure and wrong.",
    ),
    "entropy": (
        "entropy\n[nats]",
        "mean uncertainty of the class in nats; 0 is sure.",
    ),
    "mutual_information": (
        "mutual\ninf.",
        "the part of the entropy in which the members of an ensemble disagree, in nats.",
    ),
    "entropy_auroc": (
        "AUROC\nentropy",
        "how often a wrongly classified cell has a higher entropy than a right one: 1 where uncertainty finds "
        "every error, 0.5 where it tells nothing.",
    ),
    "mutual_information_auroc": (
        "AUROC\nm. inf.",
        "the same of mutual information.",
    ),
    "rmse_observed": (
        "RMSE\nλ",
        "typical distance of the predicted mean to λ as observed; the noise of the ground stays in it, even for "
        "a perfect model.",
    ),
    "rmse_expected": (
        "RMSE\nE[λ]",
        "typical distance of the predicted mean to the true mean of λ; 0 is perfect, and – stands where the true "
        "mean is unknown.",
    ),
    "nll": (
        "NLL\nλ",
        "minus the logarithm of the predicted density at λ as observed, in the mean; lower is better, it may be "
        "negative, and – stands where the predicted distribution has no density.",
    ),
    "crps": (
        "CRPS\nλ",
        "continuous ranked probability score: distance of the predicted distribution to λ as observed, in units "
        "of λ; lower is better.",
    ),
    "coverage": (
        "in 90 %\n(0.9)",
        "share of observed λ within the central 90 % of their prediction; 0.9 is perfect, and less means that "
        "the model is too sure.",
    ),
    "tail_rate": (
        "< VaR\n(0.1)",
        "share of observed λ under the value at risk (VaR) at level 0.9, under which a tenth should fall; 0.1 is "
        "perfect, and more means that bad ground comes more often than predicted.",
    ),
}
# Where classes look alike.
LOOK_ALIKES = ("look_alike_accuracy", "look_alike_miou", "look_alike_share_error", "look_alike_share_ece")
# For these a terminal is too narrow.
_FILES_ONLY = (
    "miou_predicted",
    "entropy",
    "mutual_information",
    "look_alike_miou",
    "look_alike_share_error",
)

# Title and explanation by the name of a figure; those of map sheets go on with the split.
_FIGURES = {
    "confusion": (
        "Which class is taken for which",
        "A row is a true class, a column the most likely one; a number is a share of the row in percent. A perfect "
        "model has 100 along the diagonal, but no model can tell classes of one colour apart. A grey row is of a class "
        "that no map of the split shows.",
    ),
    "reliability": (
        "Whether the class probabilities can be trusted",
        "Above, how often the most likely class is right, over its probability: on the dashed line they are the same, "
        "under it the model is too sure. ECE is the mean gap. Below, how many cells have such a probability.",
    ),
    "pit": (
        "Whether the predicted distribution of λ can be trusted",
        "The probability integral transform (PIT) says where an observed λ lies in its prediction, from 0 at the low "
        "end to 1 at the high end. Calibrated is flat at 1. High at both ends means too sure, high in the middle not "
        "sure enough; high at the left, in orange, that bad ground comes more often than predicted. Each panel has a "
        "scale of its own.",
    ),
    "severity": (
        "Quality over the severity of a shift",
        "The numbers of the table over the severity of each scenario, from 0, the maps of training, to the scenario "
        "itself at 1.",
    ),
    "latent": (
        "What the Gaussian processes have learned",
        "Traversability over slope, class by class, beside the truth in black where it is known. Where it is grey, few "
        "of the measured cells are as steep, or none.",
    ),
    "maps": (
        "Maps of",
        "A row a map, from what the robot sees to the truth, the prediction, its error and its uncertainty; where the "
        "true distribution of λ is unknown, λ as observed stands for it. A quantity has the same scale in all sheets "
        "of an evaluation.",
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
    names = [name for name in COLUMNS if name in kept and (whole or name not in _FILES_ONLY)]
    explained = [(" ".join(heading.split()), text) for heading, text in (COLUMNS[name] for name in names)]
    return Table(
        title=title,
        headings=("split\n", "maps\n", *(COLUMNS[name][0] for name in names)),
        numbers=True,
        rows=tuple(
            (
                split,
                str(qualities[split].maps),
                *(NOTHING if math.isnan(value) else f"{value:.4f}" for value in row),
            )
            for split, row in zip(qualities, table[names].to_numpy(), strict=True)
        ),
        explained=(("split", "the maps that were measured; their number is under maps."), *explained),
    )


def quality_json(about: Mapping[str, Any], qualities: Mapping[str, Quality]) -> str:
    """Writes everything that was measured as JSON; a number that there is not is null.

    Args:
        about: what is said of model and data.
        qualities: by split.
    """
    splits = {split: {"maps": quality.maps, **_everything(quality)} for split, quality in qualities.items()}
    all_series = {
        scenario: [{"severity": severity, "split": split} for severity, split in pairs]
        for scenario, pairs in find_series(qualities).items()
    }
    text = json.dumps({**about, "splits": splits, "series": all_series})
    # JSON has no word for what is no number.
    return json.dumps(json.loads(text, parse_constant=lambda _: None), indent=1) + "\n"


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
    lines = [f"# {title}", "", to_markdown(quality_table(title, qualities, whole=True)).rstrip()]
    lines += [text for note in notes for text in ("", note)]
    for path in figures:
        heading, text = caption(PurePath(path).stem, qualities)
        lines += ["", f"![{heading}]({path})", "", f"**{heading}.** {text}"]
    return "\n".join([*lines, ""])


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
