"""Success and time of planners against how long they compute: a curve a planner.

    benchnav-eval run --config benchmarks/matched.yaml --out runs/matched
    python benchmarks/matched.py runs/matched

Drives one robot on each of three maps by each planner of the run, on one thread, and takes the mean time of a step but
for the first ten, in which code is compiled. Prints a table, and draws `docs/figures/performance-matched.png`.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.progress import track

from benchnav.core.tables import Table, to_markdown
from benchnav.eval.experiment.condition import condition_from
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.run.unit import Settings, build, one_thread, simulate
from benchnav.viz.style import LINE_COLOURS, MARKERS, TWO_COLUMNS_IN, legend_outside, save, styled

FIGURE = Path(__file__).parents[1] / "docs/figures/performance-matched.png"
MAPS, SKIPPED = 3, 10


def step_ms(about: dict[str, object]) -> float:
    """Mean time of a step of one robot."""
    condition, took = condition_from(about), []
    settings = Settings()
    for place in range(MAPS):
        unit = Unit(condition=condition, seed=1, realisation=0, maps=(place,))
        with one_thread():
            built = build(unit, settings.origins().of(unit))
            episodes, _ = simulate(unit, built, settings)
        took.append(np.asarray(episodes.planning_s)[SKIPPED:])
    return 1000 * float(np.concatenate(took).mean())


@styled()
def matched_figure(rows: pd.DataFrame) -> Figure:
    """Success and T_total over the time of a step, with 95 % intervals."""
    figure = Figure(figsize=(TWO_COLUMNS_IN, 2.6), layout="constrained")
    panels = figure.subplots(1, 2)
    measures = (("success_rate", "success_low", "success_high", 100.0, "success [%]"),
                ("total_time_mean_s", "total_time_low_s", "total_time_high_s", 1.0, "T_total [s]"))  # fmt: skip
    for panel, (middle, low, high, factor, label) in zip(panels, measures, strict=True):
        for place, (name, own) in enumerate(rows.groupby("family", sort=False)):
            own = own.sort_values("ms")
            value, below, above = (factor * own[column].to_numpy() for column in (middle, low, high))
            panel.errorbar(
                own["ms"], value, yerr=[value - below, above - value], color=LINE_COLOURS[place],
                marker=MARKERS[place], ms=4, lw=1.1, elinewidth=0.7, capsize=2, label=str(name),
            )  # fmt: skip
        panel.set(xscale="log", xlabel="ms a step of one robot", ylabel=label)
        panel.grid(color="0.93")
    legend_outside(figure)
    return figure


def main() -> None:
    folder = Path(sys.argv[1])
    conditions = json.loads((folder / "run.json").read_text())["conditions"]
    rows = pd.read_csv(folder / "summary.csv")
    rows["ms"] = [step_ms(conditions[condition]) for condition in track(rows["condition"], "measuring")]
    rows["family"] = rows["planner"].str.replace(r" \d+( x \d+)?$", "", regex=True)
    lines = tuple(
        (
            row["planner"],
            f"{row['ms']:.2g}",
            f"{100 * row['success_rate']:.0f} ({100 * row['success_low']:.0f}–{100 * row['success_high']:.0f})",
            f"{row['total_time_mean_s']:.1f} ({row['total_time_low_s']:.1f}–{row['total_time_high_s']:.1f})",
        )
        for row in rows.to_dict("records")
    )
    headings = ("planner", "ms a step", "success [%] (95 %)", "T_total [s] (95 %)")
    print(to_markdown(Table(headings=headings, labels=1, rows=lines)))
    save(matched_figure(rows), FIGURE, "png", dpi=200)


if __name__ == "__main__":
    main()
