"""A model's quality in words and numbers: rows of a table, Markdown, CSV and JSON."""

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import PurePath
from typing import Any

from rich.table import Table

from benchnav.models.quality.measure import Quality
from benchnav.models.quality.series import find_series
from benchnav.models.quality.words import COLUMNS, caption

# Headings of the numbers of ClassQuality and TraversabilityQuality, in two lines.
HEADINGS = {
    "accuracy": "accuracy\n",
    "miou": "mIoU\n",
    "miou_predicted": "mIoU\n∪ pred.",
    "look_alike_accuracy": "accuracy\nlook-alikes=1",
    "look_alike_miou": "mIoU\nlook-alikes=1",
    "look_alike_share_error": "look-alikes\noff ½",
    "look_alike_share_ece": "ECE\nlook-alikes",
    "ece": "ECE\n",
    "brier": "Brier\n",
    "entropy": "entropy\n[nats]",
    "mutual_information": "mutual\ninf.",
    "entropy_auroc": "AUROC\nentropy",
    "mutual_information_auroc": "AUROC\nm. inf.",
    "rmse_observed": "RMSE\nλ",
    "rmse_expected": "RMSE\nE[λ]",
    "nll": "NLL\nλ",
    "crps": "CRPS\nλ",
    "coverage": "in 90 %\n(0.9)",
    "tail_rate": "< VaR\n(0.1)",
}
# Where classes look alike.
LOOK_ALIKES = ("look_alike_accuracy", "look_alike_miou", "look_alike_share_error", "look_alike_share_ece")
_FILES_ONLY = (
    "miou_predicted",
    "entropy",
    "mutual_information",
    "look_alike_miou",
    "look_alike_share_error",
)  # for which the terminal is too narrow


def quality_table(title: str, qualities: Mapping[str, Quality]) -> Table:
    """Lays the numbers out for a terminal, a row a split; a number that there is not has a dash.

    Args:
        title: over the table.
        qualities: by split.
    """
    rows = {split: numbers(quality) for split, quality in qualities.items()}
    names = [name for name in _shown(rows) if name not in _FILES_ONLY]
    table = Table(title=title, box=None, padding=(0, 1, 0, 0), header_style="bold")
    table.add_column("split\n", overflow="fold")
    for heading in ("maps\n", *(HEADINGS[name] for name in names)):
        table.add_column(heading, no_wrap=True, justify="right")
    for split, row in rows.items():
        table.add_row(split, str(qualities[split].maps), *(_decimal(row.get(name)) for name in names))
    return table


def quality_json(about: Mapping[str, Any], qualities: Mapping[str, Quality]) -> str:
    """Writes everything that was measured as JSON; a number that there is not is null.

    Args:
        about: what is said of model and data.
        qualities: by split.
    """
    splits = {
        split: {
            "maps": quality.maps,
            **_class_numbers(quality),
            **asdict(quality.traversability),
        }
        for split, quality in qualities.items()
    }
    all_series = {
        scenario: [{"severity": severity, "split": split} for severity, split in pairs]
        for scenario, pairs in find_series(qualities).items()
    }
    return json.dumps(_finite({**about, "splits": splits, "series": all_series}), indent=1) + "\n"


def quality_csv(qualities: Mapping[str, Quality]) -> str:
    """Writes the numbers as CSV, a row a split, with scenario and severity where it is of a series.

    `std` stands at severity 0 with no scenario, as it begins every series.
    """
    pairs: dict[str, tuple[str, float]] = {}
    for scenario, series in find_series(qualities).items():
        for severity, split in series:
            pairs[split] = (scenario if severity else "", severity)
    text = io.StringIO()
    columns = [
        name for name in HEADINGS if name not in LOOK_ALIKES or any(map(_has_look_alikes, qualities.values()))
    ]
    writer = csv.DictWriter(text, ["split", "scenario", "severity", "maps", *columns], lineterminator="\n")
    writer.writeheader()
    for split, quality in qualities.items():
        scenario, severity = pairs.get(split, ("", math.nan))
        row = {name: f"{value:.6g}" for name, value in numbers(quality).items() if math.isfinite(value)}
        place = {"scenario": scenario, "severity": "" if math.isnan(severity) else f"{severity:g}"}
        writer.writerow({"split": split, "maps": quality.maps} | place | row)
    return text.getvalue()


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
    rows = {split: numbers(quality) for split, quality in qualities.items()}
    names = _shown(rows)
    headings = ["split", "maps", *(" ".join(HEADINGS[name].split()) for name in names)]
    lines = [f"# {title}", "", "| " + " | ".join(headings) + " |", "|---" + "|---:" * (len(names) + 1) + "|"]
    for split, row in rows.items():
        cells = [split, str(qualities[split].maps), *(_decimal(row.get(name)) for name in names)]
        lines.append("| " + " | ".join(cells) + " |")
    lines += ["", "- **split**: the maps that were measured; their number is under **maps**."]
    lines += [f"- **{heading}**: {COLUMNS[name]}" for heading, name in zip(headings[2:], names, strict=True)]
    lines += [text for note in notes for text in ("", note)]
    for path in figures:
        heading, text = caption(PurePath(path).stem, qualities)
        lines += ["", f"![{heading}]({path})", "", f"**{heading}.** {text}"]
    return "\n".join([*lines, ""])


def numbers(quality: Quality) -> dict[str, float]:
    """The single numbers of a split's quality by name, in the order of `HEADINGS`."""
    values = {**_class_numbers(quality), **vars(quality.traversability)}
    return {name: float(values[name]) for name in HEADINGS if name in values}


def _class_numbers(quality: Quality) -> dict[str, Any]:
    """Everything of a split's classes, by name; what is of look-alikes only where there are any."""
    found: dict[str, Any] = {}
    for item in quality.classes:
        found |= asdict(item)
        found |= found.pop("look_alikes") or {}
    return found


def _has_look_alikes(quality: Quality) -> bool:
    return any(item.look_alikes is not None for item in quality.classes)


def _shown(rows: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Names of the numbers that some split has, and of the one whose truth may be unknown."""
    return [
        name
        for name in HEADINGS
        if name == "rmse_expected" or any(math.isfinite(row.get(name, math.nan)) for row in rows.values())
    ]


def _decimal(value: float | None) -> str:
    return "–" if value is None or math.isnan(value) else f"{value:.4f}"


def _finite(value: Any) -> Any:
    """Puts None for what is no number, which JSON has no word for."""
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
