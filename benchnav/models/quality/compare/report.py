"""Tables of a comparison of models for the terminal, Markdown, JSON and CSV."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import pandas as pd

from benchnav.core.tables import NOTHING, Bold, Table
from benchnav.models.quality.map_sums import MapTally
from benchnav.models.quality.output import json_text
from benchnav.models.quality.scores_of_maps import COMPARED, SCORES, TAIL_RATES
from benchnav.stats.bootstrap import LEAST_MAPS
from benchnav.stats.holm import ALPHA
from benchnav.stats.scores import against_best, compare_pairs, summarise
from benchnav.stats.tables import (
    Column,
    Row,
    cell_of,
    labels_of,
    p_value,
    signed,
    signed_interval,
    table_of,
)

# Costs of a model, shown in the table next to its scores: heading and meaning.
COSTS = {
    "prediction_ms": (
        "ms per\nmap",
        "median time to predict one map, in milliseconds.",
    ),
    "parameters": ("parameters\n", "number of weights of all networks of the model."),
}
PRIVILEGED_MARK = " †"
# Size, decimal places and letter for numbers of weights.
_UNITS = ((1e6, 2, "M"), (1e3, 1, "k"), (1, 0, ""))


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Measurements of several models.

    Args:
        models: information on each model by label, such as `source`, `privileged`,
            `parameters` and `prediction_ms`; competing models first.
        summary: table with a row per split and model: `split`, `model` and the columns
            of `scores.summarise`.
        pairs: table of all splits: `split` and the columns of `scores.compare_pairs`.
        best: table of all splits: `split`, `model` and the columns of
            `scores.against_best`.
        tallies: sums over maps, by split and model.
    """

    models: Mapping[str, Mapping[str, Any]]
    summary: pd.DataFrame
    pairs: pd.DataFrame
    best: pd.DataFrame
    tallies: Mapping[tuple[str, str], MapTally]

    @property
    def splits(self) -> list[str]:
        """Names of the measured splits."""
        return list(dict.fromkeys(self.summary["split"]))

    @property
    def privileged(self) -> list[str]:
        """Labels of models that receive part of the truth."""
        return [label for label, info in self.models.items() if info["privileged"]]

    @property
    def numbers(self) -> pd.DataFrame:
        """The summary with the costs of each model, and whether it is privileged."""
        models = pd.DataFrame.from_dict(self.models, orient="index")
        return self.summary.join(models[["privileged", *COSTS]], on="model")


def compare_sums(
    sums: Mapping[str, Mapping[str, Any]], competing: Sequence[str]
) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """Compare models by their sums over maps, separately for each split.

    Args:
        sums: sums from `map_sums.by_group`, by split and model.
        competing: labels of the competing models.

    Returns:
        `summary`, `pairs` and `best` of `Comparison`.
    """
    summaries = {}
    pairs = {}
    best = {}
    for split, by_model in sums.items():
        summary = summarise((*COMPARED, *TAIL_RATES), by_model)
        summaries[split] = summary
        pairs[split] = compare_pairs(COMPARED, by_model, competing, "cells")
        is_competing = summary.index.isin(competing)
        best[split] = against_best(COMPARED, summary[is_competing], pairs[split])
    all_pairs = pd.concat(pairs, names=["split"]).reset_index("split")
    all_summaries = pd.concat(summaries, names=["split", "model"])
    all_best = pd.concat(best, names=["split", "model"])
    return (
        all_summaries.reset_index(),
        all_pairs.reset_index(drop=True),
        all_best.reset_index(),
    )


def comparison_table(
    title: str, comparison: Comparison, all_columns: bool = False
) -> Table:
    """Return the numbers as a table with a row per split and model; NaN is a dash.

    Args:
        title: title of the table.
        comparison: measurements of the models.
        all_columns: whether to show both errors of E[λ]; if false, the error relative to
            observed λ is shown only if the error relative to the true mean is missing.
    """
    numbers = comparison.numbers
    hidden = {score.name for score in TAIL_RATES}
    expected_rmse = numbers.get("rmse_expected", pd.Series([math.nan]))
    if not all_columns and expected_rmse.notna().all():
        hidden.add("rmse_observed")
    names = [name for name in (*SCORES, *COSTS) if name in numbers]
    shown = []
    for name in names:
        has_values = numbers[name].notna().any()
        if has_values and name not in hidden:
            shown.append(name)
    best = comparison.best[comparison.best["marked"]]
    marked = set(zip(best["split"], best["model"], best["measure"], strict=True))
    model_meaning = (
        "† marks privileged models: references that receive part of the truth and do "
        "not compete."
    )
    columns = [
        Column("split\n", cell_of("split"), "split of the dataset."),
        Column("model\n", _model_cell, model_meaning),
    ]
    for name in shown:
        if name in COSTS:
            heading, meaning = COSTS[name]
        else:
            heading = SCORES[name].heading
            meaning = SCORES[name].meaning
        cell = partial(_cell, name, marked)
        columns.append(Column(heading, cell, meaning))
    note = (
        "best model of its split by this measure, and all models that do not differ "
        f"significantly from it (permutation test by map, Holm, p ≥ {ALPHA}). "
        "Privileged models (†) do not compete."
    )
    return table_of(
        numbers.to_dict("records"),
        columns,
        title=title,
        n_labels=2,
        numbers=True,
        bold_note=note if marked else "",
    )


def _model_cell(row: Row) -> str:
    label: str = row["model"]
    return label + PRIVILEGED_MARK if row["privileged"] else label


def _cell(name: str, marked: set[tuple[str, str, str]], row: Row) -> str:
    value = row[name]
    if value is None or math.isnan(value):
        return NOTHING
    if name == "prediction_ms":
        return f"{value:.3g}"
    if name == "parameters":
        fitting = (unit for unit in _UNITS if value >= unit[0])
        size, digits, letter = next(fitting, _UNITS[-1])
        return f"{value / size:.{digits}f}{letter}"
    text = f"{value:.4f}"
    is_marked = (row["split"], row["model"], name) in marked
    return Bold(text) if is_marked else text


def difference_table(comparison: Comparison) -> Table:
    """Return differences from the best model by split, measure and competing model."""
    rows = comparison.best[comparison.best["difference"].notna()]

    def p_cell(row: Row) -> str:
        text = p_value(row["p_holm"])
        return text if row["alike"] else Bold(text)

    columns = [
        *labels_of("split"),
        Column("measure", cell_of("measure", lambda name: SCORES[name].title)),
        *labels_of("best", "model"),
        Column(
            "difference",
            lambda row: signed(row["difference"], 4),
            "measure of the model minus that of the best model; for “in 90 %” "
            "(coverage), the model's distance from 0.9 minus that of the best model.",
        ),
        Column(
            "95 % interval",
            lambda row: signed_interval(row["low"], row["high"], 4),
            f"bootstrap over maps; none with fewer than {LEAST_MAPS} maps.",
        ),
        Column(
            "p (Holm)",
            p_cell,
            "permutation test that swaps the two models' scores map by map; corrected "
            "over all pairs of competing models, within measure and split (Holm).",
        ),
    ]
    note = "" if rows["alike"].all() else f"p < {ALPHA}."
    return table_of(
        rows.to_dict("records"),
        columns,
        title="Differences from the best model",
        n_labels=4,
        bold_note=note,
    )


def comparison_json(header: Mapping[str, Any], comparison: Comparison) -> str:
    """Return all results as JSON; NaN becomes null."""
    splits: dict[str, Any] = {}
    for row in comparison.summary.to_dict("records"):
        split = row.pop("split")
        model = row.pop("model")
        units = row.pop("units")
        if split not in splits:
            splits[split] = {"units": units, "models": {}, "pairs": []}
        tally = comparison.tallies[split, model]
        removed, by_width, by_error = tally.curves().tolist()
        curves = {"left_out": removed, "by_width": by_width, "by_error": by_error}
        result = {**row, "pit": list(tally.pit), "sparsification": curves}
        splits[split]["models"][model] = result
    for row in comparison.pairs.to_dict("records"):
        split = row.pop("split")
        splits[split]["pairs"].append(row)
    return json_text({**header, "models": comparison.models}, splits)


def comparison_csv(comparison: Comparison) -> str:
    """Return the numbers and their intervals as CSV, one row per split and model."""
    numbers = comparison.numbers
    columns = ["split", "model", "privileged", "units"]
    for score in COMPARED:
        columns += [score.name, f"{score.name}_low", f"{score.name}_high"]
    columns += COSTS
    columns += [score.name for score in TAIL_RATES]
    available = [name for name in columns if name in numbers]
    return numbers.to_csv(columns=available, index=False, float_format="%.6g")
