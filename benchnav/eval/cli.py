"""The command `benchnav-eval`: run suites, report on them, replay episodes."""

import os
import sys
from pathlib import Path

from benchnav.command import Command, run
from benchnav.eval.suite import Suite


def run_command(suite: Suite, out: str = "runs/latest", jobs: int = 1, overwrite: bool = False) -> None:
    """Run a suite into a folder, going on where an interrupted run stopped.

    Args:
        suite: What is evaluated.
        out: Run folder.
        jobs: Worker processes. The result is the same for any number.
        overwrite: Drop a run that is there.
    """
    import shutil

    from benchnav.command import show_progress
    from benchnav.datagen.store import TerrainDataset, find_dataset
    from benchnav.errors import ConfigError
    from benchnav.eval.report import write_report
    from benchnav.eval.runner import check, load_run, run_suite

    if jobs < 1:
        raise ConfigError(f"Expected `jobs` ≥ 1, got {jobs}.")
    folder = Path(out)
    check(suite, TerrainDataset(find_dataset(suite.data)))
    if overwrite and folder.exists():
        load_run(folder)  # Only what is a run folder may be dropped.
        dropped = folder.with_name(f".{folder.name}.{os.getpid()}.dropped")
        os.replace(folder, dropped)
        shutil.rmtree(dropped)
    for planner, options in suite.planner_options.items():
        print(
            f"{planner}: " + ", ".join(f"{name} = {value}" for name, value in options.items()),
            file=sys.stderr,
        )
    show_progress(run_suite(suite, folder, jobs), "units")
    _print_table(write_report(folder))
    print(f"report:  {folder / 'summary.md'}")
    _print_replay(suite, folder)


def report(folder: str) -> None:
    """Write tables and figures of a finished run again, and print the table.

    Args:
        folder: Run folder.
    """
    from benchnav.eval.report import write_report

    _print_table(write_report(Path(folder)))
    print(f"report:  {Path(folder) / 'summary.md'}")


def replay(
    folder: str,
    planner: str | None = None,
    risk: str | None = None,
    scenario: str | None = None,
    instance: int = 0,
    view: bool = True,
) -> int:
    """Play an episode back in the Rerun viewer, recording it first where that was not done.

    Args:
        folder: Run folder.
        planner: Planner; the run's first when not given.
        risk: Risk setting; the run's first when not given.
        scenario: Scenario; the run's first when not given.
        instance: Instance of the scenario.
        view: Open the viewer; false only makes the recording.
    """
    import subprocess

    from benchnav.eval.runner import load_run, record_episode

    suite, _ = load_run(Path(folder))
    path = record_episode(
        suite,
        Path(folder),
        planner or suite.planners[0],
        risk or suite.risks[0],
        scenario or suite.scenarios[0],
        instance,
    )
    print(f"recording: {path}")
    shown = sys.platform != "linux" or "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    if view and shown:
        return 1 if subprocess.run([sys.executable, "-m", "rerun", str(path)], check=False).returncode else 0
    print(
        f"{'there is no display here; ' if view and not shown else ''}view it with: {_program('rerun')} {path}"
    )
    return 0


def _print_table(summary) -> None:  # type: ignore[no-untyped-def]
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from benchnav.eval.report import HEADINGS, table_rows

    # Escaped, since square brackets are markup.
    table = Table(*map(escape, HEADINGS))
    for row in table_rows(summary):
        table.add_row(*row)
    Console(width=None if sys.stdout.isatty() else 130).print(table)


def _print_replay(suite: Suite, folder: Path) -> None:
    command = f"replay {folder} --planner {suite.planners[-1]} --risk {suite.risks[0]}"
    print(f"replay:  {_program('benchnav-eval')} {command}")


def _program(name: str) -> str:
    """How a program of this environment is called from here."""
    path = Path(sys.executable).parent / name
    if any(Path(folder) == path.parent for folder in os.environ.get("PATH", "").split(os.pathsep)):
        return name
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)


def main() -> None:
    """Entry point of `benchnav-eval`."""
    commands = {
        "run": Command(run_command, settings=Suite),
        "report": Command(report, ("folder",)),
        "replay": Command(replay, ("folder",)),
    }
    sys.exit(run("benchnav-eval", "Evaluate planners under risk settings; report and replay.", commands))
