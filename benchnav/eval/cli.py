"""The command `benchnav-eval`: run, merge, rerun, list, report, compare, replay."""

import json
import os
import shlex
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Literal

from benchnav.core.command import INTERRUPTED, Command, Device, run, tell
from benchnav.core.errors import ConfigError, expect
from benchnav.core.progress import show_progress
from benchnav.core.store import check_workers, read_shard
from benchnav.eval.experiment.suite import Labels, Suite
from benchnav.eval.replay import other_folder, program, replay

_MAX_LIMIT_S = 1_000_000
SUITES = Path(__file__).parent / "suites"


def run_command(
    suite: Suite,
    out: str = "runs/latest",
    jobs: int = 1,
    overwrite: bool = False,
    planner_limit_s: float = 0.0,
    shard: str = "",
    backend: Literal["local", "dask"] = "local",
    scheduler: str = "",
    device: Device = "auto",
    reuse_code: bool = False,
    check_determinism: bool = False,
) -> int:
    """Run a suite into a folder; resume or extend an existing run.

    Args:
        suite: Suite to evaluate.
        out: Run folder.
        jobs: Number of worker processes; it does not affect results.
        overwrite: Delete the run in `out` first.
        planner_limit_s: Time limit per planner call [s]; planners then run in separate
            processes. 0 sets no limit.
        shard: I/N runs only the I-th of N shards of the run; `merge` merges shards.
        backend: Workers: processes on this machine, or a Dask cluster.
        scheduler: Address of the Dask cluster's scheduler, tcp://HOST:PORT.
        device: Device of predictions and episodes; auto uses CUDA if there is a GPU.
        reuse_code: Also use finished units that were run with other code, and mark
            their rows.
        check_determinism: First run a unit of each condition twice, in new processes
            and in two orders; if rows differ, name them and exit with status 1.
    """
    from benchnav.eval.run.runner import run_suite
    from benchnav.eval.run.unit import Settings

    _check_workers(jobs, backend, scheduler)
    shard_to_run = read_shard(shard)
    expect(
        0 <= planner_limit_s <= _MAX_LIMIT_S,
        f"`planner_limit_s` from 0 to {_MAX_LIMIT_S}, got {planner_limit_s}.",
    )
    folder = _run_folder(out)
    if check_determinism and not _repeats(suite, planner_limit_s, device):
        return 1
    settings = Settings.on(device, planner_limit_s)
    steps = run_suite(
        suite,
        folder,
        scheduler or jobs,
        overwrite,
        settings,
        _say,
        shard_to_run,
        reuse_code,
    )
    show_progress(steps, "units")
    command = program("benchnav-eval")
    if not _is_complete(folder):
        print(f"so far:  {command} report {shlex.quote(str(folder))} --partial")
        return _failed(folder)
    if shard_to_run is None:
        return _finish(folder)
    print(f"shard {shard_to_run} is finished in {folder}")
    print(
        f"merge:   {command} merge OUT PART …, once all {shard_to_run.of} "
        "shards are finished"
    )
    return _failed(folder)


def merge(out: str, parts: list[str]) -> int:
    """Merge the shards of a run, and write its report.

    Args:
        out: New run folder.
        parts: Folders of all shards of the run, in any order.
    """
    from benchnav.eval.run.merge import merge_shards

    folder = _run_folder(out)
    copied = merge_shards([Path(part) for part in parts], folder)
    show_progress(copied, "units")
    return _finish(folder)


def rerun(
    folder: str,
    out: str = "",
    jobs: int = 1,
    overwrite: bool = False,
    backend: Literal["local", "dask"] = "local",
    scheduler: str = "",
) -> int:
    """Repeat a run from its provenance, and compare every row.

    Args:
        folder: Run folder of a finished run.
        out: Run folder of the repeated run; if empty, RUN-rerun.
        jobs: Number of worker processes.
        overwrite: Delete the run in `out` first.
        backend: Workers: processes on this machine, or a Dask cluster.
        scheduler: Address of the Dask cluster's scheduler, tcp://HOST:PORT.
    """
    from benchnav.eval.run import rerun

    _check_workers(jobs, backend, scheduler)
    original = _run_folder(folder)
    repeated = _run_folder(out or f"{original.resolve()}-rerun")
    steps = rerun.rerun(original, repeated, scheduler or jobs, overwrite, _say)
    show_progress(steps, "units")
    same, lines = rerun.compare(original, repeated)
    print("\n".join(lines))
    return 0 if same else 1


def verify(folder: str) -> int:
    """Check all files of a run against their recorded digests.

    Args:
        folder: Run folder, finished or not.
    """
    from benchnav.eval.folder.verify import verify_run

    damage, notes = verify_run(_run_folder(folder))
    for line in notes:
        print(f"note: {line}")
    for line in damage:
        print(f"damaged: {line}")
    if not damage:
        print(f"{folder}: no file is damaged")
    elif not damage[0].startswith("run.json"):
        print(
            "Run the run's command again: it runs damaged units again and writes "
            "tables, figures and playback files."
        )
    return 1 if damage else 0


def list_command(kinds: list[str]) -> None:
    """List parts of each kind, metrics, layers, figures and worlds, with their options.

    Args:
        kinds: Some of planner, model, risk, robot, objective, sensor, ground, belief,
            metric, layer, figure and world; all if empty.
    """
    from benchnav.eval.catalogue import print_catalogue

    print_catalogue(*kinds)


def report(
    folder: str, out: str = "", partial: bool = False, figures: tuple[str, ...] = ()
) -> int:
    """Write the report of a run again (tables, figures, page), and print it.

    Args:
        folder: Run folder.
        out: Folder of the report, such as for a read-only run; if empty, the run
            folder, or FOLDER/partial for an unfinished run.
        partial: Accept an unfinished run, even while it is running; all tables and
            figures are marked.
        figures: Custom figures, separated by commas, such as path/to/file.py:Name. If
            a figure cannot be drawn, the report is written without it, a line states
            the reason, and the exit status is 1.
    """
    if out:
        other_folder(folder, out)
    return _report(Path(folder), Path(out) if out else None, partial, figures)


def compare(
    labels: Labels,
    folders: list[str],
    against: str = "",
    by: str = "",
    points: float = 5.0,
    metric: str = "",
    allow_different: Literal["nothing", "code"] = "nothing",
    out: str = "",
) -> None:
    """Compare conditions on the same maps and draws of λ, with corrected tests.

    Args:
        labels: Labels of the conditions to compare.
        folders: Folders of finished runs, one or more.
        against: Label with which all other conditions are compared, such as mean or
            straight; if empty, all pairs are compared.
        by: Column in which the conditions of a pair differ: risk, planner, model,
            objective, robot, sensor, ground, belief, world or run. If empty, the column
            of `against`; without `against`, run if the runs have common conditions,
            otherwise risk. world also compares the ranking of settings between worlds.
        points: Difference in success rate, in percentage points. A note states the
            number of maps that is required to detect it.
        metric: Name of the metric to compare, such as path_length or energy; if empty,
            success and T_total.
        allow_different: code also compares conditions that were run with different
            code, with a note below the table.
        out: Path without a suffix, to which .csv, .md and .tex are added.
    """
    from benchnav.core.tables import print_table
    from benchnav.eval.between import between_runs
    from benchnav.eval.compare import compare_runs, write_comparison

    if out and (out.endswith(os.sep) or Path(out).name in ("", "..")):
        raise ConfigError(
            "Expected `out` to be a file path without a suffix, got the folder "
            f"{out}. Append a file name."
        )
    runs = [Path(folder) for folder in folders]
    different = allow_different == "code"
    table, shown = compare_runs(
        runs, by, against, labels.selected, points / 100, different, metric
    )
    print_table(shown)
    paths: list[Path] = []
    if out:
        paths = write_comparison(Path(out), table, shown)
    if by == "world":
        between = between_runs(runs, labels.selected)
        print("\n".join(between.findings))
        for between_table in between.tables:
            print_table(between_table)
        if out:
            paths += between.save(f"{out}-worlds")
    if paths:
        print("written:", ", ".join(map(str, paths)))
    else:
        print("columns: --out NAME writes NAME.md, which explains them")


def _run_folder(path: str) -> Path:
    """Return the path of a run folder; reject a path without a name, such as `/`."""
    if not Path(path).resolve().name:
        raise ConfigError(f"Expected the path of a run folder, got {path}.")
    return Path(path)


def _check_workers(jobs: int, backend: str, scheduler: str) -> None:
    check_workers(jobs, backend, scheduler)
    if scheduler and jobs > 1:
        raise ConfigError(
            f"Expected no `jobs` with `backend` dask, got {jobs}. A Dask cluster has "
            "its own workers. Leave `jobs` out."
        )


def _finish(folder: Path) -> int:
    """Write the report of a finished run; return the exit status."""
    from benchnav.eval.report.playback.viewer_file import write_viewer_files

    write_viewer_files(folder)
    status = _report(folder)
    _print_recorded(folder)
    _print_replay(folder)
    return _failed(folder) or status


def _repeats(suite: Suite, planner_limit_s: float, device: str) -> bool:
    """Return whether each condition gives the same rows twice; print which do not."""
    from benchnav.eval.run.determinism import check_determinism

    count, lines = check_determinism(suite, _say, planner_limit_s, device)
    for line in lines:
        _say(f"not deterministic: {line}")
    if lines:
        _say(f"{len(lines)} of {count} conditions differ; nothing was run")
    else:
        _say(f"all {count} conditions repeat")
    return not lines


def _say(line: str) -> None:
    tell(f"benchnav-eval: {line}")


def _is_complete(folder: Path) -> bool:
    """Return whether a run has its table of episodes, or a shard has all its units."""
    from benchnav.eval.folder.results import newest_units
    from benchnav.eval.folder.run_folder import EPISODES, open_run

    run = open_run(folder)
    if run.shard is None:
        return (folder / EPISODES).exists()
    return all(
        finished is not None
        for unit, finished in newest_units(run)
        if unit.shard(run.shard.of) == run.shard
    )


def _report(
    folder: Path,
    out: Path | None = None,
    unfinished: bool = False,
    figures: Sequence[str] = (),
) -> int:
    """Write and print a report; return 1 if a custom figure could not be drawn."""
    from benchnav.core import registry
    from benchnav.eval.folder.results import read_results
    from benchnav.eval.report.write import PAGE, PARTIAL, print_report, write_report
    from benchnav.eval.run.recordings import record_driven

    # Errors are raised before anything is printed.
    mark = read_results(folder, unfinished).mark
    custom = [registry.make("figure", figure) for figure in figures]
    run_target = folder / PARTIAL if mark else folder
    target = out or run_target
    _say(f"writing the report ({mark})" if mark else "writing the report")
    record = partial(record_driven, folder)
    written = write_report(folder, record, target, unfinished, custom)
    print_report(written)
    print(f"report:  {target / PAGE}")
    return 1 if written.faults else 0


def _print_recorded(folder: Path) -> None:
    """Print the number and the size of a run's recordings."""
    playback = folder / "playback"
    recordings = list(playback.glob("*.npz"))
    if recordings:
        files = [*recordings, *playback.glob("*.rrd")]
        size_mb = sum(path.stat().st_size for path in files) / 1e6
        noun = "episode" if len(recordings) == 1 else "episodes"
        print(f"recorded: {len(recordings)} {noun} in {playback}, {size_mb:.1f} MB")


def _print_replay(folder: Path) -> None:
    """Print a command that replays episodes of a run."""
    import yaml

    from benchnav.eval.experiment.condition import NOT_USED
    from benchnav.eval.find_episodes import propose
    from benchnav.eval.folder.run_folder import open_run

    all_labels = [
        condition.labels for condition, _ in open_run(folder).conditions.values()
    ]
    proposed, indices = propose(folder)
    words = ["replay", str(folder)]
    for name, labels in proposed.items():
        values = {labels_[name] for labels_ in all_labels} - {NOT_USED}
        is_needed = name in ("planner", "scenario") or len(values) > 1
        if labels == [NOT_USED] or not is_needed:
            continue
        text = ",".join(labels)
        if yaml.safe_load(f"[{text}]") != labels:  # e.g. if a label has a comma
            text = json.dumps(labels)
        words += [f"--{name}", text]
    for name, value in indices.items():
        if name == "map" or value:
            words += [f"--{name}", str(value)]
    print(f"replay:  {program('benchnav-eval')} {shlex.join(words)}")


def _failed(folder: Path) -> int:
    """Print a warning and return 1 if a part failed in an episode; otherwise return 0."""
    from benchnav.eval.folder.run_folder import EPISODES, ERRORS, read_table
    from benchnav.planning.world.outcome import ERROR_OUTCOMES

    if not (folder / ERRORS).exists():
        return 0
    message = "warning: a planner, model, sensor or belief failed in some episodes"
    if (folder / EPISODES).exists():  # a shard has no table
        rows = read_table(folder, EPISODES)
        faults = rows[rows["outcome"].isin(ERROR_OUTCOMES)]
        counts = faults["outcome"].value_counts()
        counted = " and ".join(f"{count} {kind}" for kind, count in counts.items())
        first = faults["error"].iloc[0]
        message += f" ({counted}); first error: {first}"
    _say(f"{message}; see {folder / ERRORS}")
    return 1


COMMANDS = {
    "run": Command(run_command, configs=SUITES),
    "list": Command(list_command, ("kinds",)),
    "report": Command(report, ("folder",)),
    "compare": Command(compare, ("folders",)),
    "replay": Command(replay, ("folder",)),
    "merge": Command(merge, ("out", "parts")),
    "rerun": Command(rerun, ("folder",)),
    "verify": Command(verify, ("folder",)),
}


def main() -> None:
    """Entry point of `benchnav-eval`."""
    description = (
        "Evaluate planners under risk settings; report, replay, merge, repeat."
    )
    status = run("benchnav-eval", description, COMMANDS)
    if status == INTERRUPTED and sys.argv[1] in ("run", "rerun"):
        overwrites = any(word.startswith("--overwrite") for word in sys.argv)
        options = " without --overwrite" if overwrites else ""
        _say(
            f"finished units are kept; to resume, give the same command{options} again"
        )
    sys.exit(status)


if __name__ == "__main__":
    main()
