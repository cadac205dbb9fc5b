"""A comparison in numbers and words: a table for each kind of file, and what columns and figures mean."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from benchnav.core.resampling import LEAST_MAPS
from benchnav.core.tables import NOTHING, Bold, Table, to_markdown
from benchnav.datagen.recipe.scenario import find_series
from benchnav.models.quality.compare.paired import ALPHA, MEASURES
from benchnav.models.quality.map_sums import MapTally
from benchnav.models.quality.report import COLUMNS

# Of the numbers that are compared: the heading in two lines, and what it means. Those of `evaluate` mean the same here.
HEADINGS = {
    name: COLUMNS[name]
    for name in ("accuracy", "miou", "rmse_expected", "rmse_observed", "nll", "crps", "coverage")
} | {
    "pinball": (
        "pinball\nfifth",
        "pinball loss of the lower fifth: u·(λ − Q(u)) where λ is at least the quantile Q(u), else (1 − u)·(Q(u) − λ), "
        "averaged over the levels u = 0.01, 0.02, …, 0.20. It scores the bad end of the prediction; lower is better.",
    ),
    "width": (
        "width\n90 %",
        "sharpness: mean width Q(0.95) − Q(0.05) of the central 90 % interval; narrower is better where “in 90 %” is "
        "right.",
    ),
    "tail_error": (
        "tail\nerror",
        "tail calibration: mean gap between the share of observed λ below VaR₀.₈, VaR₀.₉ and VaR₀.₉₅, and 0.2, 0.1 and "
        "0.05; 0 is perfect.",
    ),
    "ause": (
        "AUSE\n",
        "area under the sparsification error curve: cells are removed by uncertainty, and by error; the area between "
        "the two curves of the mean error |λ − E[λ]| of the rest is averaged over maps. 0 is perfect; noise of the "
        "ground keeps any model above it.",
    ),
    "prediction_ms": (
        "ms a\nmap",
        "median time of predicting one map, in milliseconds.",
    ),
    "parameters": (
        "parameters\n",
        "number of weights of all networks of the model.",
    ),
}  # fmt: skip
ORDER = (*MEASURES, "prediction_ms", "parameters")
PRIVILEGED_MARK = " †"


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """What was measured of several models.

    Args:
        models: by label what is said of it, such as `source`, `privileged`, `parameters`, `prediction_ms`; those that
            compete first.
        summary: from `paired.summarise` of each split.
        pairs: from `paired.compare_pairs` of each split.
        best: from `paired.against_best`.
        tallies: by split and model.
    """

    models: Mapping[str, Mapping[str, Any]]
    summary: pd.DataFrame
    pairs: pd.DataFrame
    best: pd.DataFrame
    tallies: Mapping[tuple[str, str], MapTally]

    @property
    def splits(self) -> list[str]:
        """Those that were measured."""
        return list(dict.fromkeys(self.summary["split"]))

    @property
    def privileged(self) -> list[str]:
        """Models that are given part of the truth."""
        return [label for label, about in self.models.items() if about["privileged"]]

    @property
    def numbers(self) -> pd.DataFrame:
        """The summary with what each model costs."""
        costs = pd.DataFrame(
            [
                {"model": label, **{name: about[name] for name in ("prediction_ms", "parameters")}}
                for label, about in self.models.items()
            ]
        )
        return self.summary.merge(costs, on="model", how="left")


def comparison_table(title: str, comparison: Comparison, whole: bool = False) -> Table:
    """Formats the numbers, a row a split and model; a number that there is not has a dash.

    Args:
        title: over the table.
        comparison: what was measured.
        whole: with both errors of E[λ]; else that to λ as observed stands where the other is unknown alone.
    """
    numbers = comparison.numbers
    shown = [name for name in ORDER if name in numbers and numbers[name].notna().any()]
    if not whole and numbers.get("rmse_expected", pd.Series([math.nan])).notna().all():
        shown.remove("rmse_observed")
    best = comparison.best
    marked = {(row["split"], row["model"], row["measure"]) for row in best[best["marked"]].to_dict("records")}
    rows = []
    for row in numbers.to_dict("records"):
        privileged = comparison.models[row["model"]]["privileged"]
        cells = [row["split"], row["model"] + PRIVILEGED_MARK * privileged]
        for name in shown:
            text = _cell(name, row[name])
            cells.append(Bold(text) if (row["split"], row["model"], name) in marked else text)
        rows.append(tuple(cells))
    explained = [(" ".join(heading.split()), text) for heading, text in (HEADINGS[name] for name in shown)]
    return Table(
        title=title,
        headings=("split\n", "model\n", *(HEADINGS[name][0] for name in shown)),
        labels=2,
        numbers=True,
        rows=tuple(rows),
        bold_note=_BOLD if marked else "",
        explained=(
            ("split", "split of the dataset."),
            ("model", "† marks privileged models: references that are given part of the truth and do not compete."),
            *explained,
        ),
    )  # fmt: skip


_BOLD = (
    "best of its split by this measure, and all without a significant difference from it (permutation test by map, "
    f"Holm, p ≥ {ALPHA}). Privileged models (†) do not compete."
)  # fmt: skip


def difference_table(comparison: Comparison) -> Table:
    """Formats the differences to the best, a row a split, measure and other model that competes."""
    rows = []
    for row in comparison.best.to_dict("records"):
        if row["model"] == row["best"] or math.isnan(row["difference"]):
            continue
        interval = NOTHING if math.isnan(row["low"]) else f"{row['low']:+.4f} to {row['high']:+.4f}"
        p = "≤ 0.0001" if row["p_holm"] <= 1e-4 else f"{row['p_holm']:.2g}"
        name = " ".join(HEADINGS[row["measure"]][0].split())
        cells = (row["split"], name, row["best"], row["model"], f"{row['difference']:+.4f}", interval)
        rows.append((*cells, p if row["alike"] else Bold(p)))
    return Table(
        title="Differences to the best",
        headings=("split", "measure", "best", "model", "difference", "95 % interval", "p (Holm)"),
        labels=4,
        rows=tuple(rows),
        bold_note=f"p under {ALPHA}." if any(isinstance(row[-1], Bold) for row in rows) else "",
        explained=(
            ("difference", "the model less the best, by this measure; of “in 90 %” the difference of the distance to "
             "0.9."),
            ("95 % interval", f"bootstrap over maps; no interval under {LEAST_MAPS} maps."),
            ("p (Holm)", "permutation test by map, which exchanges the two models; corrected over all pairs of models "
             "that compete, within measure and split (Holm)."),
        ),
    )  # fmt: skip


def comparison_json(about: Mapping[str, Any], comparison: Comparison) -> str:
    """Writes everything that was measured as JSON; a number that there is not is null."""
    splits: dict[str, Any] = {}
    for row in comparison.summary.to_dict("records"):
        split, model = row.pop("split"), row.pop("model")
        tally = comparison.tallies[split, model]
        curves = tally.curves()
        place = splits.setdefault(split, {"units": row["units"], "models": {}, "pairs": []})
        place["models"][model] = {
            **{name: value for name, value in row.items() if name != "units"},
            "pit": list(tally.pit),
            "sparsification": dict(zip(("left_out", "by_width", "by_error"), curves.tolist(), strict=True)),
        }
    for row in comparison.pairs.to_dict("records"):
        splits[row.pop("split")]["pairs"].append(row)
    all_series = {
        scenario: [{"severity": severity, "split": split} for severity, split in pairs]
        for scenario, pairs in find_series(splits).items()
    }
    whole = {**about, "models": comparison.models, "splits": splits, "series": all_series}
    # JSON has no word for what is no number.
    text = json.loads(json.dumps(whole, default=int), parse_constant=lambda _: None)
    return json.dumps(text, indent=1) + "\n"


def comparison_csv(comparison: Comparison) -> str:
    """Writes the numbers as CSV, a row a split and model, with the ends of their intervals."""
    numbers = comparison.numbers
    measured = [name for name in ORDER if name in numbers]
    singles = [name for name in numbers if name.startswith("tail_rate_")]
    names = [own for name in measured for own in (name, f"{name}_low", f"{name}_high") if own in numbers]
    privileged = numbers["model"].map(lambda model: comparison.models[model]["privileged"])
    table = numbers.assign(privileged=privileged)
    columns = ["split", "model", "privileged", "units", *names, *singles]
    return table.to_csv(columns=columns, index=False, float_format="%.6g")


def comparison_markdown(
    title: str, comparison: Comparison, notes: Sequence[str], figures: Mapping[str, tuple[str, str]]
) -> str:
    """Writes the tables as a page with its figures, and what columns and figures mean.

    Args:
        title: of the page.
        comparison: what was measured.
        notes: lines under the table.
        figures: by the path of an image from the page its heading and its caption.
    """
    lines = [f"# {title}", "", to_markdown(comparison_table(title, comparison, whole=True)).rstrip()]
    lines += [text for note in notes for text in ("", note)]
    differences = difference_table(comparison)
    if differences.rows:
        lines += ["", f"## {differences.title}", "", to_markdown(differences).rstrip()]
    for path, (heading, text) in figures.items():
        lines += ["", f"![{heading}]({path})", "", f"**{heading}.** {text}"]
    return "\n".join([*lines, ""])


def _cell(name: str, value: float) -> str:
    if value is None or math.isnan(value):
        return NOTHING
    if name == "parameters":
        return (
            f"{value / 1e6:.2f}M"
            if value >= 1e6
            else f"{value / 1e3:.1f}k"
            if value >= 1e3
            else f"{value:.0f}"
        )
    return f"{value:.3g}" if name == "prediction_ms" else f"{value:.4f}"
