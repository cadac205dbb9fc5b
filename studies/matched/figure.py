"""Success and time of planners over their planning time per step.

Each planner of the run `matched` drives one robot on each of three maps. The planning
time is the mean over steps without the first ten, during which code is compiled.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.progress import track

from benchnav.eval.experiment.condition import condition_from
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.run.unit import Settings, simulate
from benchnav.viz import styled
from studies.curves import SUCCESS, TOTAL_TIME, draw_curves, in_units
from studies.study import Rows, Work
from studies.units import build_unit

MAPS, SKIPPED = 3, 10


def computing(work: Work, folder: Path) -> dict[str, Rows | Figure]:
    """Return the table and the figure of the run `matched`."""
    run = work.out / "matched"
    conditions = json.loads((run / "run.json").read_text())["conditions"]
    rows = pd.read_csv(run / "summary.csv")
    rows["ms"] = [
        step_ms(conditions[condition])
        for condition in track(rows["condition"], "measuring")
    ]
    rows["family"] = rows["planner"].str.replace(r" \d+( x \d+)?$", "", regex=True)
    table = [
        {
            "planner": row["planner"],
            "ms a step": f"{row['ms']:.2g}",
            "success [%] (95 %)": "{:.0f} ({:.0f}–{:.0f})".format(
                *in_units(row, SUCCESS)
            ),
            "T_total [s] (95 %)": "{:.1f} ({:.1f}–{:.1f})".format(
                *in_units(row, TOTAL_TIME)
            ),
        }
        for row in rows.to_dict("records")
    ]
    return {"computing": table, "matched": matched_figure(rows)}


def step_ms(stored_condition: dict[str, Any]) -> float:
    """Return the mean planning time of a step of one robot, in milliseconds."""
    condition, took = condition_from(stored_condition), []
    for index in range(MAPS):
        unit = Unit(condition=condition, seed=1, realisation=0, maps=(index,))
        episodes, _ = simulate(unit, build_unit(unit), Settings())
        took.append(np.asarray(episodes.planning_s)[SKIPPED:])
    return 1000 * float(np.concatenate(took).mean())


@styled()
def matched_figure(rows: pd.DataFrame) -> Figure:
    """Draw success and T_total over the planning time of a step."""
    measures = {"success": SUCCESS, "time": TOTAL_TIME}
    rows = rows.assign(panel="", line=rows["family"], x=rows["ms"]).sort_values(
        ["line", "x"]
    )
    figure, panels = draw_curves(rows, measures, "ms a step of one robot")
    panels["", "success"].set_xscale("log")
    return figure
