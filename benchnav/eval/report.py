"""The report of a finished run: tables in Markdown, CSV and LaTeX, and figures."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchnav.datagen.store import TerrainDataset, find_dataset
from benchnav.eval import plots
from benchnav.eval.runner import load_run, read_map, read_table, sizes
from benchnav.eval.statistics import summarise
from benchnav.eval.suite import Suite, Unit, units
from benchnav.files import write_text

HEADINGS = (
    "scenario",
    "planner",
    "risk",
    "Succ. [%]",
    "95 % interval",
    "T_total [s]",
    "T if success [s]",
    "λ̄ [%]",
)


def write_report(folder: Path) -> pd.DataFrame:
    """Writes `summary.{csv,md,tex}` and `figures/` of a run from its tables.

    Args:
        folder: a finished run.

    Returns:
        The summary, a row a cell; see `statistics.summarise`.
    """
    suite, about = load_run(folder)
    summary = summarise(read_table(folder, "episodes.parquet"))
    rows = table_rows(summary)
    write_text(folder / "summary.csv", summary.to_csv(index=False, float_format="%.6g"))
    write_text(folder / "summary.tex", _latex(rows))
    plots.save_success(summary, folder / "figures" / "success.png")
    snapshots = _snapshots(folder, suite)
    if snapshots:
        plots.save_trajectories(snapshots, folder / "figures" / "trajectories.png")
    figures = ["success", "trajectories"] if snapshots else ["success"]
    write_text(folder / "summary.md", _markdown(rows, suite, about, figures))
    return summary


def table_rows(summary: pd.DataFrame) -> list[tuple[str, ...]]:
    """Formats a summary as the paper does: rates and λ̄ in per cent, mean ± standard deviation."""
    return [
        (
            row["scenario"],
            row["planner"],
            row["risk"],
            f"{100 * row['success_rate']:.0f}",
            f"{100 * row['success_low']:.0f}–{100 * row['success_high']:.0f}",
            _spread(row["total_time_mean_s"], row["total_time_std_s"]),
            _spread(row["success_time_mean_s"], row["success_time_std_s"]),
            _spread(100 * row["traversability_mean"], 100 * row["traversability_std"]),
        )
        for _, row in summary.iterrows()
    ]


def _spread(mean: float, std: float) -> str:
    if np.isnan(mean):
        return "–"
    return f"{mean:.1f}" if np.isnan(std) else f"{mean:.1f} ± {std:.1f}"


def _markdown(rows: list[tuple[str, ...]], suite: Suite, about: dict[str, Any], figures: list[str]) -> str:
    lines = [
        "# Run summary",
        "",
        f"Dataset `{about['dataset']['id']}`, model `{suite.model}`, seed {suite.seed}, noise {suite.noise}, "
        f"T = {suite.time_budget_s:g} s.",
        f"Planner options: {_options(suite)}. Command: `{about['command']}`",
        "",
        "T_total counts a failure as T. Mean ± standard deviation over instances.",
        "",
        "| " + " | ".join(HEADINGS) + " |",
        "|" + "---|" * len(HEADINGS),
    ]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    lines += [text for name in figures for text in ("", f"![{name}](figures/{name}.png)")]
    return "\n".join([*lines, ""])


def _options(suite: Suite) -> str:
    changes = [
        f"{planner} {name} = {value}"
        for planner, options in suite.planner_options.items()
        for name, value in options.items()
    ]
    return ", ".join(changes) or "defaults"


def _latex(rows: list[tuple[str, ...]]) -> str:
    def cell(text: str) -> str:
        return (
            text.replace("±", r"$\pm$")
            .replace("–", "--")
            .replace("%", r"\%")
            .replace("_", r"\_")
            .replace("λ̄", r"$\bar{\lambda}$")
        )

    lines = [r"\begin{tabular}{lll" + "c" * (len(HEADINGS) - 3) + "}", r"\toprule"]
    lines += [" & ".join(map(cell, HEADINGS)) + r" \\", r"\midrule"]
    lines += [" & ".join(map(cell, row)) + r" \\" for row in rows]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _snapshots(folder: Path, suite: Suite) -> list[plots.Snapshot]:
    """The first recorded episode of each planner, at the time of the snapshot or when it ended."""
    dataset = TerrainDataset(find_dataset(suite.data))
    recorded = [unit for unit in units(suite, sizes(suite, dataset)) if unit.recorded]
    steps = read_table(folder, "steps.parquet") if recorded else pd.DataFrame()
    return [_snapshot(folder, suite, dataset, unit, steps) for unit in recorded]


def _snapshot(
    folder: Path, suite: Suite, dataset: TerrainDataset, unit: Unit, steps: pd.DataFrame
) -> plots.Snapshot:
    with np.load(folder / "units" / f"{unit.episode_name(0)}.plans.npz") as stored:
        plan = dict(stored)
    step = int(plan.pop("step"))
    planner, risk, scenario, instance = unit.planner, unit.risk, unit.scenario, unit.instances[0]
    episode = steps.query(
        "planner == @planner and risk == @risk and scenario == @scenario and instance == @instance"
    )
    entry = dataset.read(f"test/{scenario}", [instance], ["rgb", "goal_m"])
    return plots.Snapshot(
        title=f"{plots.PLANNER_NAMES.get(planner, planner)} ({risk}, {scenario})",
        rgb=entry["rgb"][0],
        predicted=read_map(folder, scenario, risk)[instance],
        extent_m=dataset.grid.extent_m,
        goal_m=entry["goal_m"][0],
        stuck_threshold=dataset.recipe.stuck_threshold,
        time_s=float(episode["time_s"].iloc[min(step, len(episode) - 1)]),
        track=episode[["x_m", "y_m"]].to_numpy(),
        traversability=episode["traversability"].to_numpy()[:-1],
        now=min(step, len(episode) - 1),
        plan=plan,
    )
