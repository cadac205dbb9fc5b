"""Several models on the same maps: intervals of each measure, and differences of each pair with a test.

The map is the unit, or the group of maps where a dataset has groups. Every measure is a function of sums over maps
(`quality.map_sums`), so that one way serves means, roots, ratios and distances alike:

- an interval is that of the bootstrap by percentiles: maps are drawn anew and their sums added up;
- a test exchanges the two models on each map, in all ways on few maps, else in 9 999 drawn ones, and asks how often the
  difference is at least as large as the one that was seen (Fisher, 1935);
- Holm's correction is over all pairs of models that compete, within a measure and a split.

Letters in shapes: M units.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
import pandas as pd

from benchnav.core.resampling import LEAST_MAPS, bootstrap_counts, holm, sign_flips
from benchnav.models.quality.map_sums import Sums, added, measures_of

ALPHA = 0.05
COVERAGE = 0.9
# Of each measure which way is better; of the width neither, since a narrow interval is good only where it holds.
HIGHER = ("accuracy", "miou")
LOWER = ("rmse_expected", "rmse_observed", "nll", "crps", "pinball", "tail_error", "ause")
MEASURES = (*HIGHER, *LOWER[:5], "coverage", "width", *LOWER[5:])

_ROUNDING = 1e-12


def summarise(split: str, sums: Mapping[str, Sums]) -> pd.DataFrame:
    """Measures each model on a split.

    Args:
        split: its name.
        sums: by model, of M units each.

    Returns:
        A row a model, as `split`, `model`, `units` and of each measure `NAME`, `NAME_low` and `NAME_high`, its 95 %
        interval, which is not a number under `core.resampling.LEAST_MAPS` units; `tail_rate_80` and others alone.
    """
    rows = []
    for model, own in sums.items():
        units = len(own["cells"])
        row = {"split": split, "model": model, "units": units}
        values = measures_of(added(own, np.ones(units)))
        drawn = measures_of(added(own, bootstrap_counts(units))) if units >= LEAST_MAPS else {}
        for name, value in values.items():
            row[name] = float(value)
            if name in MEASURES:
                row[f"{name}_low"], row[f"{name}_high"] = _interval(drawn.get(name))
        rows.append(row)
    return pd.DataFrame(rows)


def compare_pairs(split: str, sums: Mapping[str, Sums], competing: Sequence[str]) -> pd.DataFrame:
    """Compares all pairs of models on a split, map by map.

    Args:
        split: its name.
        sums: by model, of the same M units each.
        competing: the models over whose pairs Holm's correction goes.

    Returns:
        A row a pair and measure: `split`, `measure`, `one`, `other`; `difference`, by how much more the one has, of
        coverage by how much it is farther from 0.9, with its 95 % interval `low`, `high`; `p`; `p_holm`, corrected, of
        competing models alone. Pairs of which one lacks a measure, or was measured on other cells, are left out.
    """
    units = len(next(iter(sums.values()))["cells"])
    flips, counts = sign_flips(units), bootstrap_counts(units)
    found = [
        {"split": split, "measure": name, "one": one, "other": other, **row}
        for one, other in combinations(sums, 2)
        if np.array_equal(sums[one]["cells"], sums[other]["cells"])
        for name, row in _pair(sums[one], sums[other], flips, counts).items()
    ]
    columns = ["split", "measure", "one", "other", "difference", "low", "high", "p", "p_holm"]
    table = pd.DataFrame(found, columns=columns).astype(dict.fromkeys(columns[4:], float))
    rivals = table["one"].isin(competing) & table["other"].isin(competing)
    for _, rows in table[rivals].groupby("measure"):
        table.loc[rows.index, "p_holm"] = holm(rows["p"].to_numpy())
    return table


def _pair(one: Sums, other: Sums, flips: np.ndarray, counts: np.ndarray) -> dict[str, dict[str, float]]:
    shared = [name for name in one if name in other]
    one, other = ({name: own[name] for name in shared} for own in (one, other))
    units = len(one["cells"])
    whole = np.ones(units)
    seen = _difference(added(one, whole), added(other, whole))
    gap = added({name: one[name] - other[name] for name in shared}, flips)
    total = added({name: one[name] + other[name] for name in shared}, whole)
    exchanged = _difference(
        {name: _half(total[name], gap[name]) for name in shared},
        {name: _half(total[name], -gap[name]) for name in shared},
    )
    drawn = _difference(added(one, counts), added(other, counts)) if units >= LEAST_MAPS else {}
    rows = {}
    for name in (name for name in MEASURES if name in seen and np.isfinite(seen[name])):
        # Sums are exact to rounding, and ways that tie with what was seen count.
        least = abs(seen[name]) * (1 - 1e-9) - _ROUNDING
        low, high = _interval(drawn.get(name))
        p = float(np.mean(np.abs(exchanged[name]) >= least))
        rows[name] = {"difference": float(seen[name]), "low": low, "high": high, "p": p}
    return rows


def _half(total: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """Half of their sum; what rounding leaves of 0, of which a root would be far from 0, is 0."""
    half = (total + gap) / 2
    return np.where(np.abs(half) < _ROUNDING * np.abs(total), 0, half)


def _difference(one: Sums, other: Sums) -> dict[str, np.ndarray]:
    first, second = (judged(measures_of(sums)) for sums in (one, other))
    return {name: first[name] - second[name] for name in first}


def judged(measures: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What models are compared by: the measures, and of coverage its distance to 0.9."""
    return {**measures, "coverage": abs(measures["coverage"] - COVERAGE)}


def _interval(drawn: np.ndarray | None) -> tuple[float, float]:
    if drawn is None or not np.isfinite(drawn).all():
        return np.nan, np.nan
    low, high = np.quantile(drawn, [0.025, 0.975])
    return float(low), float(high)


def against_best(summary: pd.DataFrame, pairs: pd.DataFrame, competing: Sequence[str]) -> pd.DataFrame:
    """Tells which model is the best by each measure of each split, and which are significantly worse.

    Args:
        summary: from `summarise`, of one split or several.
        pairs: from `compare_pairs`, of the same splits.
        competing: the models that compete.

    Returns:
        A row a split, measure and competing model that has the measure, but for the width: `split`, `measure`,
        `model`, `best`; of all but the best `difference`, by how much more the model has, `low`, `high` and `p_holm`
        as of `compare_pairs`; `alike`, true where it is not significantly worse than the best; and `marked`, true
        where it is alike and another competing model is not.
    """
    found = []
    for split, rows in summary[summary["model"].isin(competing)].groupby("split", sort=False):
        for name in (name for name in MEASURES if name != "width" and name in rows):
            values = rows.set_index("model")[name].dropna()
            if values.empty:
                continue
            cost = -values if name in HIGHER else abs(values - COVERAGE) if name == "coverage" else values
            best = str(cost.idxmin())
            own = pairs[(pairs["split"] == split) & (pairs["measure"] == name)]
            entries = [_entry(own, best, str(model)) for model in values.index]
            some_worse = not all(entry["alike"] for entry in entries)
            for entry in entries:
                marked = bool(entry["alike"]) and some_worse
                found.append({"split": split, "measure": name, "best": best, **entry, "marked": marked})
    columns = ["split", "measure", "model", "best", "difference", "low", "high", "p_holm", "alike", "marked"]
    return pd.DataFrame(found, columns=columns)


def _entry(pairs: pd.DataFrame, best: str, model: str) -> dict[str, object]:
    forward = pairs[(pairs["one"] == model) & (pairs["other"] == best)]
    backward = pairs[(pairs["one"] == best) & (pairs["other"] == model)]
    for sign, rows in ((1, forward), (-1, backward)):
        for row in rows.to_dict("records"):
            ends = sorted((sign * row["low"], sign * row["high"]))
            return {
                "model": model, "difference": sign * row["difference"], "low": ends[0], "high": ends[1],
                "p_holm": row["p_holm"], "alike": row["p_holm"] >= ALPHA,
            }  # fmt: skip
    return {"model": model, "alike": True}
