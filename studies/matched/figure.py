"""Success and time of planners over how long they compute: a curve a planner.

Drives one robot on each of three maps by each planner of the run `matched`, and takes the mean time of a step but for
the first ten, in which code is compiled.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.progress import track

from benchnav.core.tables import Table
from benchnav.eval.experiment.condition import condition_from
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.run.unit import Settings, simulate
from benchnav.viz.style import TWO_COLUMNS_IN, legend_outside, styled
from studies.curves import SUCCESS, TOTAL_TIME, draw_curve
from studies.study import Work
from studies.tables import table
from studies.units import build_unit

MAPS, SKIPPED = 3, 10


def computing(work: Work, folder: Path) -> dict[str, Table | Figure]:
    """Return the table and the figure of the run `matched`."""
    run = work.out / "matched"
    conditions = json.loads((run / "run.json").read_text())["conditions"]
    rows = pd.read_csv(run / "summary.csv")
    rows["ms"] = [step_ms(conditions[condition]) for condition in track(rows["condition"], "measuring")]
    rows["family"] = rows["planner"].str.replace(r" \d+( x \d+)?$", "", regex=True)
    cells = [
        (
            row["planner"],
            f"{row['ms']:.2g}",
            f"{100 * row['success_rate']:.0f} ({100 * row['success_low']:.0f}–{100 * row['success_high']:.0f})",
            f"{row['total_time_mean_s']:.1f} ({row['total_time_low_s']:.1f}–{row['total_time_high_s']:.1f})",
        )
        for row in rows.to_dict("records")
    ]
    headings = ("planner", "ms a step", "success [%] (95 %)", "T_total [s] (95 %)")
    return {"computing": table(headings, cells), "matched": matched_figure(rows)}


def step_ms(about: dict[str, Any]) -> float:
    """Return the mean time of a step of one robot."""
    condition, took = condition_from(about), []
    for index in range(MAPS):
        unit = Unit(condition=condition, seed=1, realisation=0, maps=(index,))
        episodes, _ = simulate(unit, build_unit(unit), Settings())
        took.append(np.asarray(episodes.planning_s)[SKIPPED:])
    return 1000 * float(np.concatenate(took).mean())


@styled()
def matched_figure(rows: pd.DataFrame) -> Figure:
    """Draw success and T_total over the time of a step."""
    figure = Figure(figsize=(TWO_COLUMNS_IN, 2.6), layout="constrained")
    for panel, measure in zip(figure.subplots(1, 2), (SUCCESS, TOTAL_TIME), strict=True):
        for place, (name, family) in enumerate(rows.groupby("family", sort=False)):
            family = family.sort_values("ms")
            draw_curve(panel, family["ms"], family, place, str(name), measure=measure)
        panel.set(xscale="log", xlabel="ms a step of one robot")
    legend_outside(figure)
    return figure
