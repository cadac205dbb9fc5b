"""Writes the tables of docs/studies/results.md and docs/studies/risk.md from the runs that they are of.

    python benchmarks/tables.py docs/studies/risk.md            # reads runs/NAME; --runs FOLDER for others

A table stands between `<!-- KIND RUN -->` and `<!-- end -->`, which may be indented, as in a fold. A table whose run is
missing stays as it is. Kinds:

- `results`: the table of the run's report;
- `hypotheses`: what the suite was to show, and the tests of it;
- `settings`: success and mean T_total, a row for each model, planner and world, a column for each risk setting;
- `sweep`: success of each setting under each value, and what the best gains on the worst; p of the sign-flip test,
  after Holm's correction over all pairs of settings of the row. Best and worst are chosen by what was seen, so
  that the gain leans upward;
- `arms`: of the study of risk on the cost each arm, and its difference from CVaR of time on the map with the same
  planner, or from the same arm with the shared time to go; p after Holm's correction over all rows that have one;
- `paper`: the paper's Table I beside a run's. Theirs: Wilson's interval of 20 episodes, and Student's of a mean of
  20 by its standard deviation. p: Fisher's exact test of success, Welch's of T_total, Holm's correction over the
  scenarios, each of the two apart.
"""

import argparse
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from textwrap import indent
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import fisher_exact, t, ttest_ind_from_stats

from benchnav.core.tables import Table, to_markdown
from benchnav.eval.compare import read_conditions
from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.folder.run_folder import EPISODES, open_run
from benchnav.eval.report.write import read_report
from benchnav.eval.stats.comparison import compare
from benchnav.eval.stats.pairs import Compared, Pair, check_maps, find_pairs, side_by_side
from benchnav.stats.holm import holm
from benchnav.stats.intervals import wilson_interval

# MPPI under CVaR at 0.9; Endo, Honda and Ishigami (2024), Table I: success, mean and standard deviation of T_total.
PAPER_EPISODES = 20
PAPER = {"std": (0.90, 52.7, 22.5), "hg": (0.80, 60.2, 26.1), "hs": (0.85, 58.6, 25.7)}

_MEASURES = ("success", "total_time_s", "time_budget_s")

_BLOCK = re.compile(r"^( *)<!-- (\w+) ([\w/-]+) -->\n.*?<!-- end -->", re.DOTALL | re.MULTILINE)
_BESIDE_RISK = ("data", "scenario", "world", "robot", "model", "sensor", "ground", "belief", "planner")


def table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Formats a Markdown table."""
    return to_markdown(Table(headings=tuple(headings), rows=tuple(map(tuple, rows)))).rstrip()


def results(run: Path) -> str:
    """The table of the run's report."""
    return to_markdown(read_report(run).table)


def hypotheses(run: Path) -> str:
    """The tests of the run's hypotheses."""
    return to_markdown(read_report(run).hypotheses)


def settings(run: Path) -> str:
    """Success with its interval and mean T_total, risk settings across."""
    summary = pd.read_csv(run / "summary.csv")
    summary = summary[summary["risk"] != NOT_USED]
    known = list(summary["risk"].unique())
    # Runs of version 0.10.0 and before have no columns of what robots learn.
    several = [name for name in _BESIDE_RISK if name in summary and summary[name].nunique() > 1] or [
        "planner"
    ]
    rows = []
    for labels, found in summary.groupby(several, sort=False):
        cells = {
            row["risk"]: f"{100 * row['success_rate']:.1f} ({100 * row['success_low']:.0f}–"
            f"{100 * row['success_high']:.0f}), {row['total_time_mean_s']:.1f} s"
            for row in found.to_dict("records")
        }
        rows.append([*labels, *(cells.get(risk, "") for risk in known)])
    return table([*several, *known], rows)


def sweep(run: Path) -> str:
    """Success of each setting under each value that was swept, and what the best gains on the worst."""
    pairs = find_pairs(read_conditions([open_run(run)]), by="risk")
    names = [name for name in _BESIDE_RISK if len({pair.shared[name] for pair in pairs}) > 1]
    variants: dict[tuple[str, ...], list[Pair]] = {}
    for pair in pairs:
        labels = {**pair.shared, "data": Path(pair.shared["data"]).name}
        variants.setdefault(tuple(labels[name] for name in names), []).append(pair)
    known = list(dict.fromkeys(end for pair in pairs for end in (pair.other, pair.one)))
    rows = []
    for labels, own in variants.items():
        success, gain, p = _best_and_worst(compare(own))
        rows.append([*labels, *(f"{success[risk]:.1f}" for risk in known), gain, p])
    return table([*names, *known, "best − worst [points] (95 %)", "p"], rows)


def _best_and_worst(compared: pd.DataFrame) -> tuple[dict[str, float], str, str]:
    """Success of each setting in per cent, what the best gains on the worst in points, and p."""
    success: dict[str, float] = {}
    for one in compared.to_dict("records"):
        success |= {one["other"]: 100 * one["success_other"], one["one"]: 100 * one["success_one"]}
    order = sorted(success, key=success.__getitem__)
    worst, best = order[0], order[-1]
    found = compared[compared["one"].isin((best, worst)) & compared["other"].isin((best, worst))].iloc[0]
    ends = [100 * found["success_low"], 100 * found["success_high"]]
    if found["one"] == worst:
        ends = [-end for end in reversed(ends)]
    gain = f"{best} − {worst} {success[best] - success[worst]:+.1f} ({ends[0]:+.0f} to {ends[1]:+.0f})"
    return success, gain, f"{found['success_p_holm']:.2g}"


def arms(run: Path) -> str:
    """Success, time and computing of each arm, and what it gains on another, which may be in the run `cost-primary`."""
    own = {_arm(each): each for each in read_conditions([open_run(run)])}
    known, pairs = own, {}
    if any(_compared_with(*arm) not in own for arm in own):
        known = own | {
            _arm(each): each for each in read_conditions([open_run(run.with_name("cost-primary"))])
        }
    for (planner, risk), one in own.items():
        other = known[_compared_with(planner, risk)]
        if one is not other:  # two that may differ in planner and risk setting alike
            check_maps(one, other, f"{planner} and {other.labels['planner']}")
            both = side_by_side(one.episodes, other.episodes, _MEASURES)
            pairs[planner, risk] = Pair(one=planner, other=other.labels["planner"], shared={}, episodes=both)
    compared = dict(zip(pairs, compare(list(pairs.values())).to_dict("records"), strict=True))
    rows = []
    for row in pd.read_csv(run / "summary.csv").to_dict("records"):
        arm, differs = (row["planner"], row["risk"]), ["", "", ""]
        if found := compared.get(arm):
            points = [100 * found[f"success_{end}"] for end in ("difference", "low", "high")]
            seconds = [found[f"arrival_time_{end}_s"] for end in ("difference", "low", "high")]
            differs = [
                f"{points[0]:+.1f} ({points[1]:.1f} to {points[2]:.1f})", f"{found['success_p_holm']:.2g}",
                f"{seconds[0]:+.1f} ({seconds[1]:.1f} to {seconds[2]:.1f})",
            ]  # fmt: skip
        rows.append([
            *arm, f"{100 * row['success_rate']:.1f} ({100 * row['success_low']:.0f}–{100 * row['success_high']:.0f})",
            f"{row['total_time_mean_s']:.1f}", f"{row['planning_ms_median']:.1f}", *differs,
        ])  # fmt: skip
    measures = ["success [%] (95 %)", "T_total [s]", "ms a step"]
    differences = ["Δ success [points] (95 %)", "p", "Δ time where both arrive [s] (95 %)"]
    return table(["planner", "risk", *measures, *differences], rows)


def _arm(condition: Compared) -> tuple[str, str]:
    return condition.labels["planner"], condition.labels["risk"]


def _compared_with(planner: str, risk: str) -> tuple[str, str]:
    """CVaR of time on the map with the same planner; of an arm with its own time to go that with the shared one."""
    if planner.endswith(" own"):
        return planner.removesuffix(" own"), "expected-time" if "cost" in planner else risk
    return f"{planner.split()[0]} map", "time-cvar:0.5"


def paper(run: Path) -> str:
    """The paper's Table I beside the run's rows of MPPI under `cvar`."""
    summary = pd.read_csv(run / "summary.csv")
    ours = summary[(summary["planner"] == "mppi") & (summary["risk"] == "cvar")]
    found = [(row["scenario"], *_beside(row)) for row in ours.to_dict("records") if row["scenario"] in PAPER]
    success, time = (holm(np.array([row[place] for row in found], float)) for place in (2, 3))
    headings = ["scenario", "Succ. [%], paper", "ours", "p", "T_total [s], paper", "ours", "p"]
    rows = [
        [scenario, *cells[:2], f"{success[place]:.2g}", *cells[2:], f"{time[place]:.2g}"]
        for place, (scenario, cells, *_) in enumerate(found)
    ]
    return table(headings, rows)


def _beside(row: dict[Any, Any]) -> tuple[list[str], float, float]:
    """The cells of a scenario, and p of success and of T_total, before correction."""
    rate, mean, std = PAPER[row["scenario"]]
    low, high = wilson_interval(rate, PAPER_EPISODES)
    reach = t.ppf(0.975, PAPER_EPISODES - 1) * std / PAPER_EPISODES**0.5
    cells = [
        f"{100 * rate:.0f} ({100 * low:.0f}–{100 * high:.0f})",
        f"{100 * row['success_rate']:.1f} ({100 * row['success_low']:.0f}–{100 * row['success_high']:.0f})",
        f"{mean:.1f} ({mean - reach:.1f}–{mean + reach:.1f})",
        f"{row['total_time_mean_s']:.1f} ({row['total_time_low_s']:.1f}–{row['total_time_high_s']:.1f})",
    ]
    count = row["n_episodes"]
    theirs, ours = round(rate * PAPER_EPISODES), round(row["success_rate"] * count)
    success = fisher_exact([[theirs, PAPER_EPISODES - theirs], [ours, count - ours]]).pvalue
    own = (row["total_time_mean_s"], row["total_time_std_s"], count)
    time = ttest_ind_from_stats(mean, std, PAPER_EPISODES, *own, equal_var=False).pvalue
    return cells, float(success), float(time)


KINDS: dict[str, Callable[[Path], str]] = {
    "results": results,
    "hypotheses": hypotheses,
    "settings": settings,
    "sweep": sweep,
    "arms": arms,
    "paper": paper,
}


def between(margin: str, name: str, lines: str) -> str:
    """A table between its markers; where it is indented, with the empty lines without which it is not a table."""
    body = f"\n{lines.rstrip()}\n" if margin else lines
    return indent(f"<!-- {name} -->\n{body}\n<!-- end -->", margin)


def main() -> None:
    """Rewrites the tables of a document."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("document", type=Path)
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder of the runs")
    given = parser.parse_args()

    def written(block: re.Match[str]) -> str:
        margin, kind, name = block.groups()
        if not (given.runs / name / EPISODES).exists():
            print(f"left as it is: {kind} {name}")
            return block.group()
        return between(margin, f"{kind} {name}", KINDS[kind](given.runs / name))

    given.document.write_text(_BLOCK.sub(written, given.document.read_text()))


if __name__ == "__main__":
    main()
