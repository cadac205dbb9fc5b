"""The report of a run: its table, where its rows come from, and its figures."""

import shutil
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from benchnav.eval.report.driven import write_driven
from benchnav.eval.report.figures import save
from benchnav.eval.report.recording import read_snapshots
from benchnav.eval.report.rendering import to_latex, to_markdown, to_terminal
from benchnav.eval.report.success import success_figure
from benchnav.eval.report.tables import NOT_USED, ResultTable, result_table
from benchnav.eval.report.trajectories import choose, trajectory_figure
from benchnav.eval.report.version1 import convert_about, convert_rows
from benchnav.eval.run.folder import ERRORS, open_run, read_table
from benchnav.eval.stats.summary import summarise
from benchnav.files import write_text

_LEGEND = (
    "T_total counts a failure as T. Mean ± standard deviation over episodes; λ̄ is the mean λ met. The interval "
    "is Wilson's, with maps as the unit: episodes on one map count as fewer the more alike they end."
)
_SUCCESS = "Success rates with their 95 % intervals; grey: planners that look at nothing predicted."
_TRAJECTORIES = "What was planned and driven, on the terrain and on the λ̂ that the planner was given."
_TO_THE_END = "Below, the whole driven path on λ as it was."


@dataclass(frozen=True, kw_only=True)
class Report:
    """What is reported of a run.

    Args:
        header: lines on where the rows come from.
        table: a row a trial.
        warnings: lines on what went wrong.
        summary: the numbers behind the table.
        commands: that made the run.
    """

    header: tuple[str, ...]
    table: ResultTable
    warnings: tuple[str, ...]
    summary: pd.DataFrame
    commands: tuple[str, ...]


def read_report(folder: Path) -> Report:
    """Makes the report of a finished run, of either format version, and writes nothing.

    Args:
        folder: a finished run.

    Raises:
        ConfigError: the folder is no run folder, or its run is not finished.
    """
    run, episodes = open_run(folder), read_table(folder, "episodes.parquet")
    about = run.about
    if run.version == 1:
        episodes = convert_rows(episodes, about)
        about = {**about, **convert_about(about, episodes)}
    summary = summarise(episodes)
    return Report(
        header=(*_header(summary, about), *_redrawn(episodes, about["trials"])),
        table=result_table(summary, about["trials"]),
        warnings=tuple(_warnings(summary, folder)),
        summary=summary,
        commands=tuple(about["commands"]),
    )


def write_report(folder: Path) -> pd.DataFrame:
    """Writes `summary.{csv,md,tex}` and `figures/` of a run from its tables and snapshots.

    Args:
        folder: a finished run.

    Returns:
        The summary, a row a trial; see `summary.summarise`.
    """
    report = read_report(folder)
    write_text(folder / "summary.csv", report.summary.to_csv(index=False, float_format="%.6g"))
    write_text(folder / "summary.tex", _as_latex(report))
    figures = {"success": _SUCCESS} | _trajectories(folder, report.summary) | write_driven(folder)
    save(success_figure(report.summary), folder / "figures" / "success.png")
    write_text(folder / "summary.md", _as_markdown(report, figures))
    return report.summary


def print_report(folder: Path) -> None:
    """Prints the header and the table of a finished run, as wide as the terminal, or unbroken where none is."""
    report = read_report(folder)
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    print("\n".join([*report.header, to_terminal(report.table, width).rstrip(), *report.warnings]))


def _trajectories(folder: Path, summary: pd.DataFrame) -> dict[str, str]:
    """Draws the trajectories of recorded episodes; a caption by name, none where nothing was recorded."""
    recorded = read_snapshots(folder)
    chosen = choose(recorded, list(summary["trial"]))
    if not chosen:
        return {}
    save(trajectory_figure(chosen), folder / "figures" / "trajectories.png")
    words = [_TRAJECTORIES, f"{len(chosen)} of {len(recorded)} recorded episodes."]
    if any(snapshot.field is not None for snapshot in chosen):
        words.insert(1, _TO_THE_END)
    return {"trajectories": " ".join(words)}


def _header(summary: pd.DataFrame, about: Mapping[str, Any]) -> list[str]:
    trials = [about["trials"][trial] for trial in summary["trial"]]
    worlds = {trial["labels"]["world"]: _world(trial["value"]) for trial in trials}
    lines = [f"World {label}: {text}." for label, text in worlds.items()]
    seeds = dict.fromkeys(seed for trial in trials for seed in trial["seeds"])
    lines.append(f"Data: {_list(summary['data'])}. Models: {_list(summary['model'])}. Seeds: {_list(seeds)}.")
    if summary["n_episodes"].nunique() == summary["n_maps"].nunique() == 1:
        lines.append(f"Each trial: {summary['n_episodes'][0]} episodes on {summary['n_maps'][0]} maps.")
    options = dict.fromkeys(
        f"{trial['labels']['planner']} {change}" for trial in trials for change in trial.get("changed", ())
    )
    return [*lines, f"Planner options: {', '.join(options)}."] if options else lines


def _redrawn(episodes: pd.DataFrame, trials: Mapping[str, Any]) -> list[str]:
    """How often frozen λ was drawn again; runs of before there was such have no such column."""
    frozen = [name for name, about in trials.items() if about["value"]["world"]["noise"] == "frozen"]
    episodes = episodes[episodes["trial"].isin(frozen)]
    if "redrawn" not in episodes or not episodes["redrawn"].any():
        return []
    draws = ["data", "scenario", "world", "seed", "realisation", "instance"]
    # All trials met the same; where a model failed nothing was drawn.
    again = episodes.groupby(draws)["redrawn"].max()
    share = again.sum() / (again + 1).sum()
    return [f"Of the draws of λ {100 * share:.1f} % joined start and goal by no ground and were drawn again."]


def _world(value: Mapping[str, Any]) -> str:
    world, rules = value["world"], value.get("rules")
    words = [f"λ {world['noise']}"]
    if "correlation_m" in world:
        words[0] += f", correlated over {world['correlation_m']:g} m"
    if "immobile" in world:
        held = world["immobile"]
        words.append(f"an episode ends after {held['for_s']:g} s of λ under {held['below']:g}")
    if "time_budget_ratio" in world:
        words.append(f"T = {world['time_budget_ratio']:g} × the reference time at the robot's top speed")
    else:
        words.append(f"T = {world['time_budget_s']:g} s")
    if rules:
        free = rules["free_space"]
        words.append(f"free where the {free['by']} map is above {free['above']:g}")
    return ", ".join(words)


def _warnings(summary: pd.DataFrame, folder: Path) -> list[str]:
    count = int(summary["planner_error_count"].sum() + summary["model_error_count"].sum())
    if not count:
        return []
    episodes = "1 episode" if count == 1 else f"{count} episodes"
    return [f"In {episodes} a planner or model failed; tracebacks: {folder / ERRORS}"]


def _list(values: Iterable[Any]) -> str:
    return ", ".join(dict.fromkeys(str(value) for value in values if value != NOT_USED)) or NOT_USED


def _as_markdown(report: Report, figures: Mapping[str, str]) -> str:
    lines = ["# Run summary", "", *(f"- {line}" for line in (*report.header, *report.warnings)), "", _LEGEND]
    lines += ["", to_markdown(report.table)]
    for name, caption in figures.items():
        lines += [f"![{name}](figures/{name}.png)", "", caption, ""]
    return "\n".join([*lines, "Commands:", "", *(f"    {command}" for command in report.commands), ""])


def _as_latex(report: Report) -> str:
    return "".join(f"% {line}\n" for line in report.header) + to_latex(report.table)
