"""Figures of a run: trajectories like the paper's Fig. 2, and success with its uncertainty."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchnav.files import replacing

# Half-way for most episodes; the paper shows 25 s, when robots here have mostly arrived.
SNAPSHOT_STEP = 150

PLANNER_NAMES = {"astar_dwa": "A* + DWA", "cl_rrt": "CL-RRT", "mppi": "MPPI"}


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """One panel of the trajectory figure.

    Args:
        title: over the panel.
        rgb: uint8, shape [3, H, W].
        predicted: λ̂, shape [H, W].
        extent_m: size of the map along x and y.
        goal_m: (x, y).
        stuck_threshold: cells at or under it are drawn dark.
        time_s: when the plan was made.
        track: driven positions to the end, shape [N + 1, 2].
        traversability: λ met, shape [N].
        now: index of the position at `time_s`.
        plan: `path`, `samples`, `reference`, `tree` as arrays; see `playback.PlanSketch`.
    """

    title: str
    rgb: np.ndarray
    predicted: np.ndarray
    extent_m: tuple[float, float]
    goal_m: np.ndarray
    stuck_threshold: float
    time_s: float
    track: np.ndarray
    traversability: np.ndarray
    now: int
    plan: dict[str, np.ndarray]


def save_trajectories(snapshots: list[Snapshot], path: Path) -> None:
    """Draws snapshots side by side: the terrain above with what was planned, the map planned on below."""
    figure = Figure(figsize=(4.6 * len(snapshots) + 0.8, 9.4), layout="constrained")
    panels = figure.subplots(2, len(snapshots), squeeze=False, sharex=True, sharey=True)
    image, lines = None, None
    for column, snapshot in enumerate(snapshots):
        extent = (0, snapshot.extent_m[0], 0, snapshot.extent_m[1])
        panels[0, column].imshow(np.moveaxis(snapshot.rgb, 0, -1), origin="lower", extent=extent)
        image = panels[1, column].imshow(
            snapshot.predicted, origin="lower", extent=extent, cmap="RdYlGn", vmin=0, vmax=1
        )
        blocked = np.where(snapshot.predicted <= snapshot.stuck_threshold, 1.0, np.nan)
        panels[1, column].imshow(blocked, origin="lower", extent=extent, cmap="gray_r", vmin=0, vmax=1.2)
        for panel in panels[:, column]:
            lines = _draw_snapshot(panel, snapshot)
        panels[0, column].set_title(f"{snapshot.title}, t = {snapshot.time_s:g} s", fontsize=11)
        panels[1, column].set_xlabel("x [m]")
    for panel in panels[:, 0]:
        panel.set_ylabel("y [m]")
    assert image is not None
    assert lines is not None
    figure.legend(handles=_legend(snapshots), loc="outside lower center", ncols=4, frameon=False)
    figure.colorbar(lines, ax=panels[0], fraction=0.03, label="traversability met along the path")
    figure.colorbar(
        image, ax=panels[1], fraction=0.03, label="traversability given to the planner (dark: stuck)"
    )
    _save(figure, path)


def save_success(summary: pd.DataFrame, path: Path) -> None:
    """Draws the success rate of every cell with its Wilson interval, a panel a scenario."""
    scenarios = list(summary["scenario"].unique())
    planners = list(summary["planner"].unique())
    risks = list(summary["risk"].unique())
    figure = Figure(figsize=(3.9 * len(scenarios) + 0.6, 3.6), layout="constrained")
    panels = figure.subplots(1, len(scenarios), squeeze=False, sharey=True)[0]
    for panel, scenario in zip(panels, scenarios, strict=True):
        for place, risk in enumerate(risks):
            cells = (
                summary.query("scenario == @scenario and risk == @risk").set_index("planner").loc[planners]
            )
            x = np.arange(len(planners)) + (place - (len(risks) - 1) / 2) * 0.8 / len(risks)
            rate = 100 * cells["success_rate"].to_numpy()
            low, high = 100 * cells["success_low"].to_numpy(), 100 * cells["success_high"].to_numpy()
            errors = np.stack((rate - low, high - rate)).clip(min=0)
            panel.bar(x, rate, 0.72 / len(risks), yerr=errors, capsize=2, label=risk, error_kw={"lw": 0.8})
        panel.set_xticks(range(len(planners)), [PLANNER_NAMES.get(name, name) for name in planners])
        panel.set_title(scenario, fontsize=11)
        panel.grid(axis="y", alpha=0.3)
        panel.set_axisbelow(True)
        panel.set_ylim(0, 105)
    panels[0].set_ylabel("success rate [%], 95 % Wilson interval")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(risks))
    _save(figure, path)


def _draw_snapshot(panel: Axes, snapshot: Snapshot) -> LineCollection:
    plan = snapshot.plan
    panel.add_collection(
        LineCollection(_strips(plan["tree"]), colors="black", linewidths=0.5, linestyles="dashed", alpha=0.6)
    )
    panel.add_collection(
        LineCollection(_strips(plan["samples"]), colors="lightskyblue", linewidths=0.7, alpha=0.7)
    )
    panel.plot(*plan["reference"].T, color="blue", ls="--", lw=1.2)
    panel.plot(*plan["path"].T, color="navy", lw=2.2)
    driven = snapshot.track[: snapshot.now + 1]
    segments = np.stack((driven[:-1], driven[1:]), axis=1)
    lines = LineCollection(list(segments), cmap="turbo_r", linewidths=3.2)
    lines.set_array(snapshot.traversability[: snapshot.now])
    lines.set_clim(0, 1)
    panel.add_collection(lines)
    panel.plot(*snapshot.track[0], "o", color="red", mec="white", ms=9)
    panel.plot(*snapshot.goal_m, "X", color="magenta", mec="white", ms=11)
    panel.plot(*driven[-1], "o", color="limegreen", mec="black", ms=8)
    panel.set_xlim(0, snapshot.extent_m[0])
    panel.set_ylim(0, snapshot.extent_m[1])
    panel.set_aspect("equal")
    return lines


def _legend(snapshots: list[Snapshot]) -> list[Line2D]:
    drawn = {name for snapshot in snapshots for name, line in snapshot.plan.items() if line.size}
    marks = [
        Line2D([], [], marker="o", color="red", mec="white", ms=9, ls="none", label="start"),
        Line2D([], [], marker="X", color="magenta", mec="white", ms=11, ls="none", label="goal"),
        Line2D([], [], marker="o", color="limegreen", mec="black", ms=8, ls="none", label="robot"),
    ]
    lines = {
        "path": Line2D([], [], color="navy", lw=2.2, label="planned"),
        "reference": Line2D([], [], color="blue", ls="--", lw=1.2, label="reference path"),
        "samples": Line2D([], [], color="lightskyblue", lw=1.5, label="samples"),
        "tree": Line2D([], [], color="black", ls="--", lw=0.7, label="tree"),
    }
    return marks + [line for name, line in lines.items() if name in drawn]


def _strips(lines: np.ndarray) -> list[np.ndarray]:
    return [line[np.isfinite(line).all(axis=1)] for line in lines]


def _save(figure: Figure, path: Path) -> None:
    with replacing(path) as partial:
        figure.savefig(partial, dpi=120, format=path.suffix[1:], bbox_inches="tight")
