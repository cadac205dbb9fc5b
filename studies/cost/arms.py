"""Table and figure of the arms of the study of risk on the cost.

An arm is the quantity whose CVaR is planned on: λ, time or the cost.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from benchnav.core.tables import Table
from benchnav.eval.compare import read_conditions
from benchnav.eval.folder.run_folder import open_run
from benchnav.eval.stats.comparison import compare
from benchnav.eval.stats.pairs import Compared, Pair, check_maps, side_by_side
from benchnav.viz import (
    draw_estimates,
    legend_outside,
    line_looks,
    panel_grid,
    planner_name,
    styled,
)
from studies.curves import SUCCESS, in_units
from studies.tables import success, table

ARMS = ("CVaR of λ", "CVaR of time", "CVaR of the cost")
_MEASURES = ("success", "total_time_s", "time_budget_s")


_HEADINGS = (
    "planner",
    "risk",
    "success [%] (95 %)",
    "T_total [s]",
    "ms a step",
    "Δ success [points] (95 %)",
    "p",
    "Δ time where both arrive [s] (95 %)",
)


def arms(run: Path) -> Table:
    """Return success, time, planning time and gain of each arm.

    The gain is over a baseline: CVaR of time on the map with the same planner, or, for
    an arm with a time to go of its own, the same arm with the shared one. Baselines
    that are not in this run are read from the run `cost-primary` in the same folder. p
    has Holm's correction over all rows with a p.
    """
    arms_of_run = _by_arm(run)
    others = arms_of_run
    if any(_compared_with(*arm) not in arms_of_run for arm in arms_of_run):
        others = arms_of_run | _by_arm(run.with_name("cost-primary"))
    pairs = {}
    for (planner, risk), condition in arms_of_run.items():
        baseline = others[_compared_with(planner, risk)]
        if condition is not baseline:
            # The two may differ both in planner and in risk setting.
            check_maps(
                condition, baseline, f"{planner} and {baseline.labels['planner']}"
            )
            paired = side_by_side(condition.episodes, baseline.episodes, _MEASURES)
            pairs[planner, risk] = Pair(
                one=planner,
                other=baseline.labels["planner"],
                shared={},
                episodes=paired,
            )
    compared = dict(
        zip(pairs, compare(list(pairs.values())).to_dict("records"), strict=True)
    )
    rows = []
    for row in pd.read_csv(run / "summary.csv").to_dict("records"):
        arm, differences = (row["planner"], row["risk"]), ["", "", ""]
        if comparison := compared.get(arm):
            points = [
                100 * comparison[f"success_{end}"]
                for end in ("difference", "low", "high")
            ]
            seconds = [
                comparison[f"arrival_time_{end}_s"]
                for end in ("difference", "low", "high")
            ]
            differences = [
                _interval(points),
                f"{comparison['success_p_holm']:.2g}",
                _interval(seconds),
            ]
        times = f"{row['total_time_mean_s']:.1f}", f"{row['planning_ms_median']:.1f}"
        rows.append([*arm, success(row), *times, *differences])
    return table(_HEADINGS, rows, 2)


def _by_arm(run: Path) -> dict[tuple[str, str], Compared]:
    conditions = read_conditions([open_run(run)])
    return {
        (condition.labels["planner"], condition.labels["risk"]): condition
        for condition in conditions
    }


def _interval(values: list[float]) -> str:
    return "{:+.1f} ({:.1f} to {:.1f})".format(*values)


def _compared_with(planner: str, risk: str) -> tuple[str, str]:
    if planner.endswith(" own"):
        return planner.removesuffix(
            " own"
        ), "expected-time" if "cost" in planner else risk
    return f"{planner.split()[0]} map", "time-cvar:0.5"


def arm_of(row: Mapping[Any, Any]) -> dict[str, Any]:
    """Return planner, arm, level and entrapment (`held`) of a condition.

    The arm is empty for conditions that belong to none.
    """
    part, _, kind = row["planner"].partition(" ")
    name, _, level = row["risk"].partition(":")
    labels = {
        "planner": planner_name(part),
        "held": "held" in kind,
        "arm": "",
        "level": 0.0,
    }
    if not kind or row["model"] == "clairvoyant":
        return labels
    if "cost" in kind:
        return labels | {"arm": "CVaR of the cost", "level": float(kind.split()[1])}
    arm = "CVaR of λ" if name in ("cvar", "mean") else "CVaR of time"
    return labels | {"arm": arm, "level": float(level or 0)}


@styled()
def frontier(summary: pd.DataFrame) -> Figure:
    """Draw success over the time to the goal, one curve per arm through its levels.

    Markers grow with the level. There is one panel per planner, and the row below shows
    the same with entrapment.
    """
    rows = summary.assign(
        **pd.DataFrame(
            [arm_of(row) for row in summary.to_dict("records")], summary.index
        )
    )
    rows = rows[rows["arm"] != ""].sort_values(["held", "arm", "level"], kind="stable")
    kind = rows["held"].map({True: ", entrapment", False: ""})
    rows = rows.assign(panel=rows["planner"] + kind, x=rows["success_time_mean_s"])
    looks, titles = line_looks(ARMS), list(dict.fromkeys(rows["panel"]))
    figure, places = panel_grid(titles, 2, 2.0, sharey=True)
    for title, (panel,) in zip(titles, places, strict=True):
        for arm, curve in rows[rows["panel"] == title].groupby("arm", sort=False):
            look, (success_rate, low, high) = looks[arm], in_units(curve, SUCCESS)
            draw_estimates(
                panel, curve["x"], success_rate, low, high, look, str(arm), bars=True
            )
            sizes = (3 + 5 * curve["level"]) ** 2
            panel.scatter(
                curve["x"],
                success_rate,
                sizes,
                look["color"],
                look["marker"],
                lw=0,
                zorder=3,
            )
        panel.set_xlabel("mean time of those that arrive [s]")
    places[0][0].set_ylabel(SUCCESS[-1])
    legend_outside(figure)
    return figure
