"""The command `benchnav-eval`: run suites, list parts, report on runs, replay episodes."""

import os
import shlex
import sys
from pathlib import Path

from benchnav.command import Command, run
from benchnav.eval.suite import Suite

SUITES = Path(__file__).parent / "suites"


def run_command(
    suite: Suite,
    out: str = "runs/latest",
    jobs: int = 1,
    overwrite: bool = False,
    planner_limit_s: float = 0.0,
) -> int:
    """Run a suite into a folder, going on with or extending the run that is there.

    Args:
        suite: What is evaluated.
        out: Run folder.
        jobs: Worker processes. The result is the same for any number.
        overwrite: Drop a run that is there.
        planner_limit_s: Seconds that a planner may take for one answer; planners then run in processes of
            their own. 0 sets no limit.
    """
    from benchnav.command import show_progress
    from benchnav.errors import ConfigError
    from benchnav.eval.report.write import write_report
    from benchnav.eval.runner import run_suite

    if jobs < 1:
        raise ConfigError(f"Expected `jobs` ≥ 1, got {jobs}.")
    if planner_limit_s < 0:
        raise ConfigError(f"Expected `planner_limit_s` ≥ 0, got {planner_limit_s}.")
    folder = Path(out)
    for planner, options in suite.planner_options.items():
        _say(f"{planner}: " + ", ".join(f"{name} = {value}" for name, value in options.items()))
    show_progress(run_suite(suite, folder, jobs, overwrite, planner_limit_s, _say), "units")
    write_report(folder)
    _print(folder)
    _print_replay(folder)
    return _failed(folder)


def list_command(kinds: list[str]) -> None:
    """List planners, models, risk measures, robots, objectives and worlds with their options.

    Args:
        kinds: Some of planner, model, risk, robot, objective and world; all when none is named.
    """
    from benchnav.eval.catalogue import print_catalogue

    print_catalogue(*kinds)


def report(folder: str) -> None:
    """Write tables and figures of a finished run again, and print the table.

    Args:
        folder: Run folder.
    """
    from benchnav.eval.report.write import write_report

    write_report(Path(folder))
    _print(Path(folder))


def compare(
    folders: list[str],
    against: str = "",
    by: str = "",
    planner: str = "",
    risk: str = "",
    scenario: str = "",
    model: str = "",
    robot: str = "",
    objective: str = "",
    world: str = "",
    data: str = "",
    points: float = 5.0,
    out: str = "",
) -> None:
    """Compare trials that met the same maps under the same luck, with intervals and corrected tests.

    Args:
        folders: Folders of finished runs, one or more.
        against: What all others are compared with, such as mean or straight; all pairs when not given.
        by: Label in which trials differ: risk, planner, model, objective, robot, world or run. When not given, that in
            which `against` is found; run where runs share trials; else risk.
        planner: Planners that are looked at, as the table calls them, with a comma between; all when not given.
        risk: Risk settings.
        scenario: Scenarios.
        model: Models.
        robot: Robots.
        objective: Objectives.
        world: Worlds.
        data: Datasets.
        points: Difference of success in percentage points, for which the maps that it needs are told.
        out: Path without a suffix; .csv, .md and .tex are written there.
    """
    from benchnav.eval.compare import compare_runs, print_comparison, write_comparison

    labels = {
        **{"planner": planner, "risk": risk, "scenario": scenario, "model": model},
        **{"robot": robot, "objective": objective, "world": world, "data": data},
    }
    asked = {name: label for name, label in labels.items() if label}
    table, shown = compare_runs([Path(folder) for folder in folders], by, against, asked, points / 100)
    print_comparison(shown)
    if out:
        print("written:", ", ".join(map(str, write_comparison(Path(out), table, shown))))


def replay(
    folder: str,
    planner: str = "",
    risk: str = "",
    scenario: str = "",
    model: str = "",
    robot: str = "",
    objective: str = "",
    world: str = "",
    data: str = "",
    seed: int = -1,
    realisation: int = 0,
    instance: int = 0,
    view: bool = True,
) -> int:
    """Play an episode back in the Rerun viewer, recording it first where that was not done.

    Args:
        folder: Run folder.
        planner: Planner as the table calls it; the run's first that fits when not given, as all of these.
        risk: Risk setting.
        scenario: Scenario.
        model: Model.
        robot: Robot.
        objective: Objective.
        world: World.
        data: Dataset.
        seed: Root seed; the run's first when not given.
        realisation: Draw of the world's luck.
        instance: Instance of the scenario.
        view: Open the viewer; false only makes the recording.
    """
    import subprocess

    from benchnav.eval.recorder import record_episode

    labels = {
        **{"planner": planner, "risk": risk, "scenario": scenario, "model": model},
        **{"robot": robot, "objective": objective, "world": world, "data": data},
    }
    asked = {name: label for name, label in labels.items() if label}
    path = record_episode(Path(folder), asked, seed if seed >= 0 else None, realisation, instance)
    print(f"recording: {path}")
    shown = sys.platform != "linux" or "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    if view and shown:
        return 1 if subprocess.run([sys.executable, "-m", "rerun", str(path)], check=False).returncode else 0
    print(
        f"{'there is no display here; ' if view and not shown else ''}view it with: {_program('rerun')} {path}"
    )
    return 0


def _say(line: str) -> None:
    print(f"benchnav-eval: {line}", file=sys.stderr, flush=True)


def _print(folder: Path) -> None:
    from benchnav.eval.report.write import print_report

    print_report(folder)
    print(f"report:  {folder / 'summary.md'}")


def _print_replay(folder: Path) -> None:
    from benchnav.eval.run.folder import open_run
    from benchnav.eval.trial import NOT_USED

    every = [trial.labels for trial, _ in open_run(folder).trials.values()]
    words = ["replay", str(folder)]
    for name, label in every[-1].items():
        if label != NOT_USED and (name in ("planner", "scenario") or len({one[name] for one in every}) > 1):
            words += [f"--{name}", label]
    print(f"replay:  {_program('benchnav-eval')} {shlex.join(words)}")


def _failed(folder: Path) -> int:
    """Exit status of a finished run: 1 where a planner or model failed, which one line says."""
    from benchnav.eval.run.folder import EPISODES, ERRORS, read_table

    outcomes = read_table(folder, EPISODES)["outcome"]
    faults = {kind: int((outcomes == kind).sum()) for kind in ("planner_error", "model_error")}
    if not any(faults.values()):
        return 0
    counted = " and ".join(f"{count} in {kind}" for kind, count in faults.items() if count)
    _say(f"episodes that ended by a fault of the code they ran: {counted}; see {folder / ERRORS}")
    return 1


def _program(name: str) -> str:
    """How a program of this environment is called from here."""
    path = Path(sys.executable).parent / name
    if any(Path(folder) == path.parent for folder in os.environ.get("PATH", "").split(os.pathsep)):
        return name
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)


def main() -> None:
    """Entry point of `benchnav-eval`."""
    commands = {
        "run": Command(run_command, settings=Suite, configs=SUITES),
        "list": Command(list_command, ("kinds",)),
        "report": Command(report, ("folder",)),
        "compare": Command(compare, ("folders",)),
        "replay": Command(replay, ("folder",)),
    }
    sys.exit(run("benchnav-eval", "Evaluate planners under risk settings; report and replay.", commands))
