"""Comparison of all files of a run folder with their digests."""

from pathlib import Path

from benchnav.core.errors import BenchnavError
from benchnav.core.sources import digest_of_path
from benchnav.eval.experiment.unit import units
from benchnav.eval.folder.checksums import SUMS, read_checksums
from benchnav.eval.folder.run_folder import (
    EPISODES,
    RUN,
    Finished,
    find_units,
    open_run,
    read_table,
)
from benchnav.eval.folder.sealed import damage_of, metadata
from benchnav.eval.folder.steps import STEPS


def verify_run(folder: Path) -> tuple[list[str], list[str]]:
    """Compare all files of a run folder with their digests.

    Args:
        folder: a run folder, finished or not; nothing is written.

    Returns:
        Lines on damage, each starting with the path of the file, and notes on missing
        units and files.

    Raises:
        ConfigError: If the folder has no `run.json`.
    """
    damage = []
    notes = []
    try:
        run = open_run(folder)
    except BenchnavError as error:
        if not (folder / RUN).is_file():
            raise
        return [f"{RUN}: {error}"], []
    files = sorted((folder / "units").glob("*/*.parquet"))
    for path in files:
        finished = Finished(path=path, metadata=metadata(path))
        if "key" not in finished.metadata:
            damage.append(f"{path.relative_to(folder)}: it cannot be read")
            continue
        damage += finished.damage()
    for path in sorted((folder / STEPS).glob("*/*.parquet")):
        damage += damage_of(path, str(path.relative_to(folder)))
    if (folder / EPISODES).exists():
        try:
            read_table(folder, EPISODES)
        except BenchnavError as error:
            damage.append(f"{EPISODES}: {error}")
    checksums = read_checksums(folder)
    removed = []
    for name, digest in checksums.items():
        if not digest:
            damage.append(
                f"{SUMS}: {name[:60]!r} does not consist of a checksum and a path"
            )
        elif not (folder / name).is_file():
            removed.append(name)
        elif digest_of_path(folder / name) != digest:
            damage.append(f"{name}: it was changed after benchnav wrote it")
    run_units = units(run.conditions)
    if run.shard is not None:
        of = run.shard.of
        run_units = [unit for unit in run_units if unit.shard(of) == run.shard]
    n_missing = sum(not find_units(folder, unit) for unit in run_units)
    if n_missing:
        notes.append(f"{n_missing} of {len(run_units)} units are not finished")
    if removed:
        notes.append(
            f"{len(removed)} of {len(checksums)} files in {SUMS} are missing; the "
            f"first is {removed[0]}"
        )
    return list(dict.fromkeys(damage)), notes
