"""Success and time over the level of CVaR, for docs/risk.md.

    python docs/risk/figure.py runs/stakes runs/control docs/figures/risk.png

A column a planner, success above and time below, a colour a world; `mean`, `expected-time` and the blind straight
line as lines across. Bars are 95 % intervals: Wilson's of success, of time a bootstrap over maps. A failure counts
as T. A level stands at −log(1 − level), so that each halving of the tail is one step. Of a run with several models
the first is drawn.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.stats import binomtest

from benchnav.eval.report.figures import display_name

PLANNERS = ("astar_dwa", "cl_rrt", "mppi")
COLOURS = ("#0072B2", "#D55E00")  # told apart by colour-blind eyes
LINES = {"mean": (0, (5, 2)), "expected-time": (0, (1, 1.5)), "straight": "-."}
DRAWS = 10_000


def success(rows: pd.DataFrame) -> tuple[float, float, float]:
    """Success rate in percent, and its interval."""
    found = binomtest(int(rows["success"].sum()), len(rows))
    interval = found.proportion_ci(method="wilson")
    return 100 * rows["success"].mean(), 100 * interval.low, 100 * interval.high


def time_s(rows: pd.DataFrame) -> tuple[float, float, float]:
    """Mean time in seconds, and its interval."""
    times = rows["total_time_s"].to_numpy()
    draws = times[np.random.default_rng(0).integers(len(times), size=(DRAWS, len(times)))].mean(1)
    return times.mean(), *np.percentile(draws, (2.5, 97.5))


def draw(panel: Any, rows: pd.DataFrame, measure: Any, colour: str, shift: float) -> None:
    """Draws one measure of one planner in one world."""
    levels = sorted({float(risk.split(":")[1]) for risk in rows["risk"] if risk.startswith("cvar:")})
    places = -np.log2(1 - np.array(levels))
    points = np.array([measure(rows[rows["risk"] == f"cvar:{level:g}"]) for level in levels])
    errors = np.abs(points[:, 1:] - points[:, :1]).T
    panel.errorbar(places + shift, points[:, 0], errors, color=colour, marker="o", ms=4, lw=1.5, capsize=2)
    for name, style in LINES.items():
        one = rows[(rows["risk"] == name) | (rows["planner"] == name)]
        if not one.empty:
            panel.axhline(measure(one)[0], color=colour, ls=style, lw=1, alpha=0.9)
    panel.set_xticks(places, [f"{level:g}" for level in levels])
    panel.grid(axis="y", color="0.9")


def main() -> None:
    """Writes the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "runs", type=Path, nargs="+", help="one or two, one a world, and the picture to write"
    )
    *runs, out = parser.parse_args().runs
    figure = Figure(figsize=(9.6, 6.4), layout="constrained")
    panels = figure.subplots(2, len(PLANNERS), squeeze=False, sharex="col", sharey="row")
    handles, named = [], []
    for run, colour, shift in zip(runs, COLOURS, (-0.04, 0.04), strict=False):
        rows = pd.read_parquet(run / "episodes.parquet")
        model = rows.loc[rows["model"] != "–", "model"].iloc[0]
        rows = rows[rows["model"].isin(("–", model))]
        named.append(model)
        label = f"world {rows['world'].iloc[0]}"
        handles.append(Line2D([], [], color=colour, marker="o", ms=4, label=f"{label}, CVaR"))
        for column, planner in enumerate(PLANNERS):
            mine = rows[rows["planner"].isin((planner, "straight"))]
            draw(panels[0, column], mine, success, colour, shift)
            draw(panels[1, column], mine, time_s, colour, shift)
    for column, planner in enumerate(PLANNERS):
        panels[0, column].set_title(display_name(planner))
        panels[1, column].set_xlabel("level of CVaR")
    panels[0, 0].set_ylabel("success [%]")
    panels[1, 0].set_ylabel("T_total [s], a failure counts as T")
    handles += [Line2D([], [], color="0.3", ls=style, lw=1, label=name) for name, style in LINES.items()]
    title = f"model {', '.join(dict.fromkeys(named))}"
    figure.legend(handles=handles, title=title, loc="outside lower center", ncols=5, frameon=False)
    figure.savefig(out, dpi=150)


if __name__ == "__main__":
    main()
