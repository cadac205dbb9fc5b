"""A comparison of models in numbers and words: a table for each kind of file, and what
columns and figures mean.
"""

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

# What a model costs, which stands in the table next to its scores: heading and meaning.
COSTS = {
    "prediction_ms": (
        "ms a\nmap",
        "median time of predicting one map, in milliseconds.",
    ),
    "parameters": ("parameters\n", "number of weights of all networks of the model."),
}
PRIVILEGED_MARK = " †"
# size, decimal places and letter of a number of weights
_UNITS = (
    (1e6, 2, "M"),
    (1e3, 1, "k"),
    (1, 0, ""),
)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """What was measured of several models.

    Args:
        models: by label what is said of it, such as `source`, `privileged`,
            `parameters`, `prediction_ms`; those that compete first.
        summary: a row a split and model, `split`, `model` and the columns of
            `scores.summarise`.
        pairs: of each split, `split` and the columns of `scores.compare_pairs`.
        best: of each split, `split`, `model` and the columns of `scores.against_best`.
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
        """The summary with what each model costs, and whether it is privileged."""
        about = pd.DataFrame.from_dict(self.models, orient="index")
        return self.summary.join(about[["privileged", *COSTS]], on="model")


def compare_sums(
    sums: Mapping[str, Mapping[str, Any]], competing: Sequence[str]
) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """Compare models by their sums over maps, each split for itself.

    Args:
        sums: by split and model, from `map_sums.by_group`.
        competing: the models that compete.

    Returns:
        `summary`, `pairs` and `best` of `Comparison`.
    """
    summaries, pairs, best = {}, {}, {}
    for split, own in sums.items():
        summaries[split] = summarise((*COMPARED, *TAIL_RATES), own)
        pairs[split] = compare_pairs(COMPARED, own, competing, "cells")
        rivals = summaries[split][summaries[split].index.isin(competing)]
        best[split] = against_best(COMPARED, rivals, pairs[split])
    return (
        pd.concat(summaries, names=["split", "model"]).reset_index(),
        pd.concat(pairs, names=["split"]).reset_index("split").reset_index(drop=True),
        pd.concat(best, names=["split", "model"]).reset_index(),
    )


def comparison_table(title: str, comparison: Comparison, whole: bool = False) -> Table:
    """Write the numbers, a row a split and model; a missing number has a dash.

    Args:
        title: over the table.
        comparison: what was measured.
        whole: with both errors of E[λ]; else that to observed λ only if the other is
            unknown.
    """
    numbers = comparison.numbers
    known = [
        name
        for name in (*SCORES, *COSTS)
        if name in numbers and numbers[name].notna().any()
    ]
    hidden = {score.name for score in TAIL_RATES}
    if not whole and numbers.get("rmse_expected", pd.Series([math.nan])).notna().all():
        hidden.add("rmse_observed")
    best = comparison.best[comparison.best["marked"]]
    marked = {
        (row["split"], row["model"], row["measure"]) for row in best.to_dict("records")
    }
    columns = [
        Column("split\n", cell_of("split"), "split of the dataset."),
        Column(
            "model\n",
            lambda row: row["model"] + PRIVILEGED_MARK * row["privileged"],
            "† marks privileged models: references that are given part of the truth "
            "and do not compete.",
        ),
    ]
    for name in known:
        if name not in hidden:
            heading, meaning = COSTS.get(name) or (
                SCORES[name].heading,
                SCORES[name].meaning,
            )
            columns.append(Column(heading, partial(_cell, name, marked), meaning))
    note = (
        "best of its split by this measure, and all without a significant difference "
        "from it (permutation test by map, "
        f"Holm, p ≥ {ALPHA}). Privileged models (†) do not compete."
    )
    return table_of(
        numbers.to_dict("records"),
        columns,
        title=title,
        labels=2,
        numbers=True,
        bold_note=note if marked else "",
    )


def _cell(name: str, marked: set[tuple[str, str, str]], row: Row) -> str:
    value = row[name]
    if value is None or math.isnan(value):
        return NOTHING
    if name == "prediction_ms":
        return f"{value:.3g}"
    if name == "parameters":
        size, digits, unit = next(
            (known for known in _UNITS if value >= known[0]), _UNITS[-1]
        )
        return f"{value / size:.{digits}f}{unit}"
    text = f"{value:.4f}"
    return Bold(text) if (row["split"], row["model"], name) in marked else text


def difference_table(comparison: Comparison) -> Table:
    """Write the differences to the best, a row a split, measure and other model that
    competes.
    """
    rows = comparison.best[comparison.best["difference"].notna()]
    columns = [
        *labels_of("split"),
        Column("measure", cell_of("measure", lambda name: SCORES[name].title)),
        *labels_of("best", "model"),
        Column(
            "difference",
            lambda row: signed(row["difference"], 4),
            "the model less the best, by this measure; of “in 90 %” the difference of "
            "the distance to 0.9.",
        ),
        Column(
            "95 % interval",
            lambda row: signed_interval(row["low"], row["high"], 4),
            f"bootstrap over maps; no interval under {LEAST_MAPS} maps.",
        ),
        Column(
            "p (Holm)",
            lambda row: (
                p_value(row["p_holm"]) if row["alike"] else Bold(p_value(row["p_holm"]))
            ),
            "permutation test by map, which exchanges the two models; corrected over "
            "all pairs of models that compete, "
            "within measure and split (Holm).",
        ),
    ]
    note = "" if rows["alike"].all() else f"p under {ALPHA}."
    return table_of(
        rows.to_dict("records"),
        columns,
        title="Differences to the best",
        labels=4,
        bold_note=note,
    )


def comparison_json(about: Mapping[str, Any], comparison: Comparison) -> str:
    """Write everything that was measured as JSON; NaN is null."""
    splits: dict[str, Any] = {}
    for row in comparison.summary.to_dict("records"):
        split, model, units = row.pop("split"), row.pop("model"), row.pop("units")
        tally = comparison.tallies[split, model]
        own = splits.setdefault(split, {"units": units, "models": {}, "pairs": []})
        own["models"][model] = {
            **row,
            "pit": list(tally.pit),
            "sparsification": dict(
                zip(
                    ("left_out", "by_width", "by_error"),
                    tally.curves().tolist(),
                    strict=True,
                )
            ),
        }
    for row in comparison.pairs.to_dict("records"):
        splits[row.pop("split")]["pairs"].append(row)
    return json_text({**about, "models": comparison.models}, splits)


def comparison_csv(comparison: Comparison) -> str:
    """Write the numbers as CSV, a row a split and model, with the ends of their
    intervals.
    """
    numbers = comparison.numbers
    names = [
        own
        for score in COMPARED
        for own in (score.name, f"{score.name}_low", f"{score.name}_high")
    ]
    columns = [
        "split",
        "model",
        "privileged",
        "units",
        *names,
        *COSTS,
        *(score.name for score in TAIL_RATES),
    ]
    known = [name for name in columns if name in numbers]
    return numbers.to_csv(columns=known, index=False, float_format="%.6g")
