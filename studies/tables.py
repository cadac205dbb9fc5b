"""Tables of the studies' pages, by kind.

- `results`: the table of the run's report;
- `hypotheses`: the hypotheses of the suite and their tests;
- `settings`: success and mean T_total, with a row for each model, planner and world and
  a column for each risk setting;
- `sweep`: success of each risk setting under each swept value, and the gain of the best
  over the worst; p is of the sign-flip test, with Holm's correction over all pairs of
  settings in the row. Best and worst are chosen by the same data, so the gain is biased
  upward.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from benchnav.core.tables import Table
from benchnav.eval import read_report
from benchnav.eval.compare import read_conditions
from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.folder.run_folder import RUN, open_run
from benchnav.eval.stats.comparison import compare
from benchnav.eval.stats.pairs import Pair, find_pairs
from studies.rows import SUMMARY

NEXT_TO_RISK = (
    "data",
    "scenario",
    "world",
    "robot",
    "model",
    "sensor",
    "ground",
    "belief",
    "planner",
)


def table(
    headings: Sequence[str], rows: Sequence[Sequence[str]], labels: int = 1
) -> Table:
    """Return a table whose first `labels` columns are labels."""
    return Table(
        headings=tuple(headings), rows=tuple(map(tuple, rows)), n_labels=labels
    )


def success(row: Mapping[Any, Any]) -> str:
    """Format the success of a condition in per cent, with its interval."""
    rate, low, high = (100 * row[f"success_{end}"] for end in ("rate", "low", "high"))
    return f"{rate:.1f} ({low:.0f}–{high:.0f})"


def results(run: Path) -> Table:
    """Return the table of the run's report."""
    return read_report(run).table


def hypotheses(run: Path) -> Table:
    """Return the tests of the run's hypotheses."""
    return read_report(run).hypotheses


def settings(run: Path) -> Table:
    """Return success with its interval and mean T_total, one column per risk setting."""
    summary = pd.read_csv(run / SUMMARY)
    summary = summary[summary["risk"] != NOT_USED]
    risks = list(summary["risk"].unique())
    varied = [name for name in NEXT_TO_RISK if summary[name].nunique() > 1] or [
        "planner"
    ]
    rows = []
    for labels, conditions in summary.groupby(varied, sort=False):
        cells = {
            row["risk"]: f"{success(row)}, {row['total_time_mean_s']:.1f} s"
            for row in conditions.to_dict("records")
        }
        rows.append([*labels, *(cells.get(risk, "") for risk in risks)])
    return table([*varied, *risks], rows, len(varied))


def sweep(run: Path) -> Table:
    """Return success per risk setting and swept value, and the gain of best over worst."""
    pairs = find_pairs(read_conditions([open_run(run)]), by="risk")
    varied = [
        name for name in NEXT_TO_RISK if len({pair.shared[name] for pair in pairs}) > 1
    ]
    variants: dict[tuple[str, ...], list[Pair]] = {}
    for pair in pairs:
        labels = {**pair.shared, "data": Path(pair.shared["data"]).name}
        variants.setdefault(tuple(labels[name] for name in varied), []).append(pair)
    risks = list(dict.fromkeys(end for pair in pairs for end in (pair.other, pair.one)))
    rows = []
    for values, pairs_of_value in variants.items():
        rates, gain, p = _best_and_worst(compare(pairs_of_value))
        rows.append([*values, *(f"{rates[risk]:.1f}" for risk in risks), gain, p])
    return table(
        [*varied, *risks, "best − worst [points] (95 %)", "p"], rows, len(varied)
    )


def _best_and_worst(compared: pd.DataFrame) -> tuple[dict[str, float], str, str]:
    """Return success per setting in per cent, the gain of best over worst, and its p."""
    rates: dict[str, float] = {}
    for row in compared.to_dict("records"):
        rates |= {
            row["other"]: 100 * row["success_other"],
            row["one"]: 100 * row["success_one"],
        }
    order = sorted(rates, key=rates.__getitem__)
    worst, best = order[0], order[-1]
    pair = compared[
        compared["one"].isin((best, worst)) & compared["other"].isin((best, worst))
    ].iloc[0]
    low, high = 100 * pair["success_low"], 100 * pair["success_high"]
    if pair["one"] == worst:
        low, high = -high, -low
    gain = (
        f"{best} − {worst} {rates[best] - rates[worst]:+.1f} ({low:+.0f} to "
        f"{high:+.0f})"
    )
    return rates, gain, f"{pair['success_p_holm']:.2g}"


# Function of each kind, and the file of a run that it reads.
KINDS: dict[str, tuple[Callable[[Path], Table], str]] = {
    "results": (results, RUN),
    "hypotheses": (hypotheses, RUN),
    "settings": (settings, SUMMARY),
    "sweep": (sweep, RUN),
}
