"""A model's quality in numbers and words: a table for each kind of file, and what columns and figures mean."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import pandas as pd

from benchnav.core.tables import NOTHING, Table, to_markdown
from benchnav.datagen.recipe.scenario import find_series
from benchnav.models.quality.measure import Quality

# Of the numbers of ClassQuality and TraversabilityQuality: the heading in two lines, and what it means to who meets
# it first.
COLUMNS = {
    "accuracy": (
        "accuracy\n",
        "share of cells whose most likely class is the true one; 1 is perfect.",
    ),
    "miou": (
        "mIoU\n",
        "mean intersection over union of the predicted and the true cells of a class, averaged over the classes that "
        "occur in truth; 1 is perfect.",
    ),
    "miou_predicted": (
        "mIoU\n∪ pred.",
        "mIoU averaged over all classes that are true or predicted somewhere; a class that is predicted and never "
        "occurs counts as 0.",
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
        "distance from ½ of the share that the true one of two look-alike classes is given; 0 is perfect, since no "
        "image tells them apart.",
    ),
    "look_alike_share_ece": (
        "ECE\nlook-alikes",
        "calibration error of the larger share of two look-alike classes; 0 is perfect.",
    ),
    "ece": (
        "ECE\n",
        "expected calibration error: mean gap between the probability of the most likely class and its accuracy; 0 is "
        "perfect.",
    ),
    "brier": (
        "Brier\n",
        "mean squared distance of the class probabilities to the true class; 0 is perfect, 2 is sure and wrong.",
    ),
    "entropy": (
        "entropy\n[nats]",
        "mean entropy of the class probabilities in nats; 0 is sure.",
    ),
    "mutual_information": (
        "mutual\ninf.",
        "the part of the entropy in which the members of an ensemble disagree, in nats.",
    ),
    "entropy_auroc": (
        "AUROC\nentropy",
        "probability that a wrong cell has a higher entropy than a right one; 1 is perfect, 0.5 is chance.",
    ),
    "mutual_information_auroc": (
        "AUROC\nm. inf.",
        "AUROC of mutual information, as for entropy.",
    ),
    "rmse_observed": (
        "RMSE\nλ",
        "root mean squared error of the predicted mean against observed λ; noise of the ground keeps it above 0 even "
        "for a perfect model.",
    ),
    "rmse_expected": (
        "RMSE\nE[λ]",
        "root mean squared error of the predicted mean against the true mean of λ; 0 is perfect. A dash: the true mean "
        "is unknown.",
    ),
    "nll": (
        "NLL\nλ",
        "mean negative log-likelihood of observed λ; lower is better, also below 0. A dash: the predicted distribution "
        "has no density.",
    ),
    "crps": (
        "CRPS\nλ",
        "continuous ranked probability score of the predicted distribution against observed λ, in units of λ; lower is "
        "better.",
    ),
    "coverage": (
        "in 90 %\n(0.9)",
        "coverage: share of observed λ within the central 90 % interval of its prediction; 0.9 is perfect, less means "
        "overconfident.",
    ),
    "tail_rate": (
        "< VaR\n(0.1)",
        "share of observed λ below the value at risk VaR₀.₉; 0.1 is perfect, more means that bad ground is more "
        "frequent than predicted.",
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
        explained=(("split", "split of the dataset; maps: the number of its maps."), *explained),
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
    title: str,
    qualities: Mapping[str, Quality],
    notes: Sequence[str],
    figures: Mapping[str, tuple[str, str]],
) -> str:
    """Writes the numbers as a page with its figures, and what each column and figure means.

    Args:
        title: of the page.
        qualities: by split.
        notes: lines under the table.
        figures: by the path of an image from the page its heading and its caption.
    """
    lines = [f"# {title}", "", to_markdown(quality_table(title, qualities, whole=True)).rstrip()]
    lines += [text for note in notes for text in ("", note)]
    for path, (heading, text) in figures.items():
        lines += ["", f"![{heading}]({path})", "", f"**{heading}.** {text}"]
    return "\n".join([*lines, ""])


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
