"""Success and time over the level of CVaR, for docs/risk.md.

    python docs/risk/figure.py runs/stakes runs/control docs/figures/risk.png

A column a world, success above and time below, a colour a planner; `mean` and `expected-time` as lines. Bands and
bars are 95 % intervals: Wilson's of success, of time a bootstrap over maps. A failure counts as T.
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

COLOURS = {"astar_dwa": "#0072B2", "cl_rrt": "#D55E00", "mppi": "#009E73"}  # told apart by colour-blind eyes
LINES = {"mean": "--", "expected-time": ":"}
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


def draw(panel: Any, rows: pd.DataFrame, measure: Any) -> None:
    """Draws one measure of one world."""
    levels = sorted({float(risk.split(":")[1]) for risk in rows["risk"] if risk.startswith("cvar:")})
    places = np.arange(len(levels))  # levels crowd toward 1
    for (planner, colour), shift in zip(COLOURS.items(), (-0.06, 0.0, 0.06), strict=True):
        mine = rows[rows["planner"] == planner]
        if mine.empty:
            continue
        points = np.array([measure(mine[mine["risk"] == f"cvar:{level:g}"]) for level in levels])
        errors = np.abs(points[:, 1:] - points[:, :1]).T
        panel.errorbar(
            places + shift, points[:, 0], errors, color=colour, marker="o", ms=4, lw=1.5, capsize=2
        )
        for risk, style in LINES.items():
            panel.axhline(measure(mine[mine["risk"] == risk])[0], color=colour, ls=style, lw=1.2)
    blind = rows[rows["planner"] == "straight"]
    if not blind.empty:
        panel.axhline(measure(blind)[0], color="0.5", lw=1.2)
    panel.set_xticks(places, [f"{level:g}" for level in levels])
    panel.grid(axis="y", color="0.9")


def main() -> None:
    """Writes the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+", help="one a world, and the picture to write")
    *runs, out = parser.parse_args().runs
    figure = Figure(figsize=(4.2 * len(runs), 6.2), layout="constrained")
    panels = figure.subplots(2, len(runs), squeeze=False, sharex="col", sharey="row")
    for column, run in enumerate(runs):
        rows = pd.read_parquet(run / "episodes.parquet")
        models = rows.loc[rows["model"] != "–", "model"]
        rows = rows[rows["model"].isin(("–", models.iloc[0]))]
        panels[0, column].set_title(f"world {rows['world'].iloc[0]}")
        draw(panels[0, column], rows, success)
        draw(panels[1, column], rows, time_s)
        panels[1, column].set_xlabel("level of CVaR")
    panels[0, 0].set_ylabel("success [%]")
    panels[1, 0].set_ylabel("T_total [s], a failure counts as T")
    handles = [
        Line2D([], [], color=colour, marker="o", ms=4, label=display_name(name))
        for name, colour in COLOURS.items()
    ]
    handles += [Line2D([], [], color="0.3", ls=style, label=name) for name, style in LINES.items()]
    handles += [Line2D([], [], color="0.5", label="straight")]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(out, dpi=150)


if __name__ == "__main__":
    main()
