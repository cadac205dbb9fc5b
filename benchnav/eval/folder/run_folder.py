"""Run folders, format version 6: layout, reading and writing.

A run folder contains `run.json` (conditions and provenance), `units/` (one Parquet file
for each finished unit, by condition and key, with rows and metadata), `steps/` and
`playback/`. A finished run also has `episodes.parquet`, the report, and `errors.txt` if
a planner, model, sensor or belief failed. All files are written atomically. `run.json`
contains its own digest and the digests of the run's tables, so that a change of any of
these files is detected.
"""

import json
import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from benchnav.core.errors import ConfigError, out_of_memory_error
from benchnav.core.settings import one_line
from benchnav.core.sources import digest_of_path
from benchnav.core.store import Shard, replacing, seal, unseal, write_text
from benchnav.eval.experiment.condition import NOT_USED, Condition, condition_from
from benchnav.eval.experiment.suite import RECORDS
from benchnav.eval.experiment.unit import DRAW, Extent, Unit, steps_path
from benchnav.eval.folder.provenance import (
    METRICS,
    TOUCHED,
    Origin,
    code_digest,
    inputs_read_by_parts,
)
from benchnav.eval.folder.sealed import (
    CONTENT,
    DamageError,
    damage_of,
    metadata,
    read_sealed,
    with_metadata,
)

FORMAT = "benchnav-run"
FORMAT_VERSION = 6
RUN = "run.json"
EPISODES = "episodes.parquet"
ERRORS = "errors.txt"
KEYS = ["condition", *DRAW]  # columns that identify a row


@dataclass(frozen=True, kw_only=True)
class Run:
    """An opened run folder.

    Args:
        folder: path of the folder.
        manifest: contents of `run.json`.
        conditions: conditions by id, each with its extent.
        shard: shard of the run that the folder contains; None for an unsharded run.
    """

    folder: Path
    manifest: dict[str, Any]
    conditions: dict[str, tuple[Condition, Extent]]
    shard: Shard | None = None


def open_run(folder: Path) -> Run:
    """Open a run folder.

    Raises:
        ConfigError: If the folder is no run folder, or has another format version.
    """
    if not (folder / RUN).is_file():
        raise ConfigError(
            f"Expected a run folder with {RUN}, got {folder}. Create one by "
            "`benchnav-eval run`."
        )
    remedy = "Restore it from a copy, or run the suite again with another `--out`."
    with damaged(folder / RUN, remedy):
        text = (folder / RUN).read_text()
        version = _format_version(json.loads(text))
        if version == FORMAT_VERSION:
            return _run_of(folder, unseal(text))
    remedy = "Read it with a newer benchnav: pip install --upgrade benchnav"
    if version < FORMAT_VERSION:
        remedy = "Run its suite again, or read it with benchnav 1.3"
    raise ConfigError(
        f"Expected a run folder of format version {FORMAT_VERSION}, got {folder} of "
        f"version {version}. {remedy}."
    )


def _run_of(folder: Path, manifest: dict[str, Any]) -> Run:
    """Return the run that a `run.json` describes."""
    conditions = {}
    for condition_id, entry in manifest["conditions"].items():
        draws = tuple(tuple(draw) for draw in entry["draws"])
        conditions[condition_id] = condition_from(entry), Extent(draws=draws)
    shard = Shard(**manifest["shard"]) if "shard" in manifest else None
    return Run(folder=folder, manifest=manifest, conditions=conditions, shard=shard)


def _format_version(manifest: Any) -> int:
    """Return the format version of `run.json`."""
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise DamageError(f"its `format` is not {FORMAT!r}")
    return int(manifest["format_version"])


def is_taken(folder: Path) -> bool:
    """Return whether something exists at a path, other than an empty folder."""
    return folder.exists() and (not folder.is_dir() or any(folder.iterdir()))


def write_run(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write `run.json`."""
    write_text(folder / RUN, seal(manifest))


def caveats(manifest: Mapping[str, Any]) -> list[str]:
    """Return lines that state the warnings and the left-out combinations of a run.

    Args:
        manifest: contents of `run.json`, at least `warnings` and `dropped`.
    """
    warnings = list(manifest["warnings"])
    if manifest.get("reused"):
        warnings.append(manifest["reused"])
    lines = [f"warning: {line}" for line in warnings]
    lines += [f"left out: {_in_words(entry)}" for entry in manifest["dropped"]]
    return lines


def dropped_labels(entry: Mapping[str, str]) -> dict[str, str]:
    """Return the incompatible labels of an entry of `dropped`, by column."""
    return {column: label for column, label in entry.items() if column != "reason"}


def _in_words(entry: Mapping[str, str]) -> str:
    """Return a combination that was left out, and the reason, in words."""
    words = []
    for column, label in dropped_labels(entry).items():
        if label != NOT_USED:
            words.append(f"{column} {label}")
    return f"{', '.join(words)}: {entry['reason']}"


def read_table(folder: Path, name: str) -> pd.DataFrame:
    """Read a table of episodes of a finished run, and check its digest.

    Raises:
        ConfigError: If the run is not finished, the folder contains a shard, or the
            table was changed.
    """
    path = folder / name
    run = open_run(folder)
    if not path.exists():
        if run.shard is not None:
            raise ConfigError(
                f"Expected an unsharded run, got {folder}, which is shard {run.shard} "
                "and has no tables. Merge all shards by `benchnav-eval merge OUT PART "
                "…`."
            )
        raise ConfigError(
            f"Expected a finished run, got {folder} without {name}. To finish the run, "
            "repeat its `benchnav-eval run` command. `benchnav-eval report --partial` "
            "and `replay` can read unfinished runs."
        )
    with damaged(path, "Remove it, and repeat the command of the run."):
        digests = run.manifest.get("tables", {})
        if digests.get(name) != digest_of_path(path):
            raise DamageError("it was changed after benchnav wrote it")
        return pd.read_parquet(path)


@contextmanager
def damaged(path: Path, remedy: str) -> Iterator[None]:
    """Convert any error of reading a file into a ConfigError with one line.

    Args:
        path: path of the file, for the message.
        remedy: sentence on how to replace the file.
    """
    try:
        yield
    except PermissionError:
        raise
    except Exception as error:  # raised by pyarrow or by checks of settings
        is_ours = isinstance(error, DamageError | ConfigError)
        reason = error if is_ours else one_line(error)
        message = f"{path} is damaged: {reason}. {remedy}"
        raise out_of_memory_error(error) or ConfigError(message) from error


@dataclass(frozen=True, kw_only=True)
class Finished:
    """A finished unit in a run folder.

    Args:
        path: file of the unit.
        metadata: metadata of the file: `unit` (its identity); `key`; `code`; `digests` of
            the maps; `record`; `made`, a random token, which is the same in copies;
            `traceback`; `errors`; `touched`, the files, packages and environment
            variables that custom parts read; and digests: `content` of the rows, `steps`
            of the steps, and `recordings` of the recordings, by path.
    """

    path: Path
    metadata: Mapping[str, Any]

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.path.parents[2]

    @property
    def metrics(self) -> set[str]:
        """Columns of the metrics in addition to the built-in ones."""
        return set(self.metadata["code"].get(METRICS, ()))

    def has(self, unit: Unit) -> bool:
        """Return whether the steps and recordings that `unit` requests were stored.

        The folder may instead contain the steps of another file of the unit. These are
        not considered.
        """
        record = self.metadata["record"]
        if RECORDS.index(record) < RECORDS.index(unit.record):
            return False
        if record == "none":
            return True
        steps_metadata = metadata(self.folder / unit.steps_path)
        return bool(steps_metadata.get("key") == self.metadata["key"])

    def damage(self) -> list[str]:
        """Return a line for each damaged file of the unit, starting with its path.

        Steps and recordings are checked only if they belong to this file of the unit. A
        missing file is not damage.
        """
        lines = damage_of(self.path, str(self.path.relative_to(self.folder)))
        condition_id, *_ = self.metadata["unit"]
        name, _, _ = self.path.name.rpartition("-")
        steps = steps_path(condition_id, name)
        steps_file = self.folder / steps
        steps_metadata = metadata(steps_file)
        if steps_metadata and steps_metadata.get("key") != self.metadata["key"]:
            return lines
        if self.metadata.get("steps") and steps_file.exists():
            damage = damage_of(steps_file, str(steps))
            if not damage and steps_metadata.get(CONTENT) != self.metadata["steps"]:
                damage = [f"{steps}: it contains the steps of another run"]
            lines += damage
        for path, digest in self.metadata.get("recordings", {}).items():
            if digest_of_path(self.folder / path) not in ("", digest):
                lines.append(f"{path}: it was changed after benchnav wrote it")
        return lines


def find_units(folder: Path, unit: Unit) -> list[Finished]:
    """Find all files of a unit, for any code and maps, newest first."""
    files = (folder / "units" / unit.condition.id).glob(f"{unit.name}-*.parquet")
    newest_first = sorted(files, key=lambda path: path.stat().st_mtime, reverse=True)
    identity = _identity(unit)
    finished_units = []
    for path in newest_first:
        finished = Finished(path=path, metadata=metadata(path))
        if finished.metadata.get("unit") == identity:
            finished_units.append(finished)
    return finished_units


def unit_path(unit: Unit, key: str) -> Path:
    """Return the path of a unit with a key in a run folder."""
    return Path("units", unit.condition.id, f"{unit.name}-{key}.parquet")


def _identity(unit: Unit) -> list[Any]:
    """Return condition, draw and maps of a unit, as its file stores them."""
    return [unit.condition.id, unit.seed, unit.realisation, *unit.maps]


def write_unit(
    folder: Path,
    unit: Unit,
    origin: Origin,
    rows: pd.DataFrame,
    errors: Sequence[str],
    traceback: str,
) -> None:
    """Write a finished unit.

    Args:
        folder: the run folder.
        unit: unit that was run.
        origin: origin of its rows.
        rows: one row per episode.
        errors: messages of failures of parts, one line each.
        traceback: traceback of the first failure; empty if no part failed.
    """
    key = origin.key(unit)
    recordings = {}
    for episode_index in range(len(unit.maps)):
        path = unit.recording_path(episode_index)
        digest = digest_of_path(folder / path)
        if digest:
            recordings[path.as_posix()] = digest
    steps_metadata = metadata(folder / unit.steps_path)
    unit_metadata = {
        "unit": _identity(unit),
        "key": key,
        "code": origin.code,
        "digests": list(origin.maps),
        "record": unit.record,
        "made": secrets.token_hex(8),
        "traceback": traceback,
        "errors": list(errors),
        TOUCHED: inputs_read_by_parts(unit.condition, unit.metrics),
        "steps": steps_metadata.get(CONTENT, ""),
        "recordings": recordings,
    }
    with_code = rows.assign(code=code_digest(origin.code))
    table = pa.Table.from_pandas(with_code, preserve_index=False)
    with replacing(folder / unit_path(unit, key)) as partial:
        pq.write_table(with_metadata(table, unit_metadata), partial)


def clear_unit(folder: Path, unit: Unit) -> None:
    """Remove the steps and recordings of a unit, but not its rows."""
    (folder / unit.steps_path).unlink(missing_ok=True)
    for episode_index in range(len(unit.maps)):
        for suffix in (".npz", ".rrd"):
            path = folder / unit.recording_path(episode_index, suffix)
            path.unlink(missing_ok=True)


def finish_run(
    folder: Path, finished: Sequence[tuple[Unit, Finished]], reused: str = ""
) -> None:
    """Write `episodes.parquet` and `errors.txt`, and update `run.json`.

    Args:
        folder: the run folder.
        finished: all units of the run, in the order of the table.
        reused: line on units that were run with other code; empty without such units.
    """
    manifest = open_run(folder).manifest
    write_errors(folder, finished)
    tables = [labelled_rows(unit, finished_unit) for unit, finished_unit in finished]
    rows = pd.concat(tables, ignore_index=True)
    table = pa.Table.from_pandas(rows, preserve_index=False)
    with replacing(folder / EPISODES) as partial:
        pq.write_table(table.replace_schema_metadata(None), partial)
    codes: dict[str, Any] = {}
    for _, finished_unit in finished:
        code = finished_unit.metadata["code"]
        entry = codes.setdefault(code_digest(code), {**code, TOUCHED: {}})
        entry[TOUCHED] |= finished_unit.metadata.get(TOUCHED, {})
    results = {
        "codes": codes,
        "reused": reused,
        "tables": {EPISODES: digest_of_path(folder / EPISODES)},
    }
    stored = {name: manifest.get(name) for name in results}
    if stored != results:
        write_run(folder, {**manifest, **results})


def write_errors(folder: Path, finished: Iterable[tuple[Unit, Finished]]) -> None:
    """Write the failures of all units to `errors.txt`; remove it if nothing failed."""
    texts = [_trace(unit, finished_unit, folder) for unit, finished_unit in finished]
    traces = [text for text in texts if text]
    if traces:
        write_text(folder / ERRORS, "\n".join(traces))
    else:
        (folder / ERRORS).unlink(missing_ok=True)


def unit_rows(finished: Finished) -> pd.DataFrame:
    """Read the rows of a finished unit.

    Raises:
        ConfigError: If the file is damaged.
    """
    remedy = "Run the run's command again: it runs the unit again."
    with damaged(finished.path, remedy):
        return read_sealed(finished.path).to_pandas()


def labelled_rows(unit: Unit, finished: Finished) -> pd.DataFrame:
    """Read the rows of a finished unit, with the current labels of its condition."""
    return unit_rows(finished).assign(**unit.condition.labels)


def differences(
    first: pd.DataFrame, second: pd.DataFrame
) -> tuple[pd.DataFrame, pd.Index]:
    """Compare two tables of episodes bit for bit, in their common result columns.

    Args:
        first: rows of episodes, in any order.
        second: rows of episodes, in any order.

    Returns:
        The cells that differ, by `KEYS` and column, with both values (columns `first`
        and `second`), in the order of the first table; and the keys of the episodes
        that only one table has.
    """
    common_columns = _results(first) & _results(second)
    columns = [name for name in first if name in common_columns]
    first_rows = first.set_index(KEYS)[columns]
    second_rows = second.set_index(KEYS)[columns]
    common = first_rows.index.intersection(second_rows.index, sort=False)
    unmatched = first_rows.index.symmetric_difference(second_rows.index, sort=False)
    names = ("first", "second")
    compared = first_rows.loc[common].compare(
        second_rows.loc[common], result_names=names
    )
    cells = compared.stack(level=0, future_stack=True).dropna(how="all")
    return cells.reindex(columns=list(names)), unmatched


def differing_columns(first: pd.DataFrame, second: pd.DataFrame) -> list[str]:
    """Return the result columns that only one of two tables has."""
    return sorted(_results(first) ^ _results(second))


def _results(rows: pd.DataFrame) -> set[str]:
    """Return the names of result columns, without keys, wall times and code digests."""
    excluded = (*KEYS, "code", "learning_ms")
    names = {name for name in rows if not name.startswith("planning_")}
    return names.difference(excluded)


def _trace(unit: Unit, finished: Finished, folder: Path) -> str:
    unit_metadata = finished.metadata
    if not unit_metadata["traceback"] and not unit_metadata["errors"]:
        return ""
    maps = f"maps {unit.maps[0]}–{unit.maps[-1]}"
    path = finished.path.relative_to(folder)
    heading = (
        f"{unit.condition.description}, seed {unit.seed}, realisation "
        f"{unit.realisation}, {maps} ({path})"
    )
    return "\n".join([heading, *unit_metadata["errors"], unit_metadata["traceback"]])
