"""Run folders, format version 6: layout, reading and writing.

A run folder contains `run.json` (conditions and provenance), `units/` (one Parquet file
for each finished unit, by condition and key, with rows and metadata), `steps/`,
`playback/` and, when the run is finished, `episodes.parquet`, `errors.txt` if a
planner, model, sensor or belief failed, and the report. All files are written
atomically. `run.json` contains its own digest and those of the run's tables, so that an
edit of either is detected.
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

from benchnav.core.errors import ConfigError, out_of_memory
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
    touches,
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
KEYS = ["condition", *DRAW]  # of a row


@dataclass(frozen=True, kw_only=True)
class Run:
    """An opened run folder.

    Args:
        folder: path of the folder.
        about: contents of `run.json`.
        conditions: conditions by id, each with its extent.
        shard: shard of the run that the folder contains; None for a whole run.
    """

    folder: Path
    about: dict[str, Any]
    conditions: dict[str, tuple[Condition, Extent]]
    shard: Shard | None = None


def open_run(folder: Path) -> Run:
    """Open a run folder.

    Raises:
        ConfigError: If the folder is no run folder, or has another format version.
    """
    if not (folder / RUN).is_file():
        raise ConfigError(
            f"Expected a run folder with {RUN}, got {folder}. Make one with "
            "`benchnav-eval run`."
        )
    with damaged(
        folder / RUN, "Take it from a copy, or run the suite again into another folder."
    ):
        text = (folder / RUN).read_text()
        version = _format_version(json.loads(text))
        if version == FORMAT_VERSION:
            manifest = unseal(text)
            conditions = {}
            for i, entry in manifest["conditions"].items():
                draws = tuple(tuple(draw) for draw in entry["draws"])
                conditions[i] = condition_from(entry), Extent(draws=draws)
            shard = Shard(**manifest["shard"]) if "shard" in manifest else None
            return Run(
                folder=folder, about=manifest, conditions=conditions, shard=shard
            )
    remedy = "Read it with a newer benchnav: pip install --upgrade benchnav"
    if version < FORMAT_VERSION:
        remedy = "Run its suite again, or read it with benchnav 1.3"
    raise ConfigError(
        f"Expected a run folder of format version {FORMAT_VERSION}, got {folder} of "
        f"version {version}. {remedy}."
    )


def _format_version(manifest: Any) -> int:
    """Return the format version of `run.json`."""
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise DamageError("it does not say that it is a run")
    return int(manifest["format_version"])


def is_taken(folder: Path) -> bool:
    """Return whether a path is not an empty folder, so that no run can begin there."""
    return folder.exists() and (not folder.is_dir() or any(folder.iterdir()))


def write_run(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write `run.json`."""
    write_text(folder / RUN, seal(manifest))


def caveats(manifest: Mapping[str, Any]) -> list[str]:
    """Return warnings and left-out combinations, for readers of a run's tables.

    Args:
        manifest: contents of `run.json`, at least `warnings` and `dropped`.
    """
    left_out = [f"left out: {_in_words(entry)}" for entry in manifest["dropped"]]
    warnings = [
        *manifest["warnings"],
        *([manifest["reused"]] if manifest.get("reused") else []),
    ]
    return [*(f"warning: {line}" for line in warnings), *left_out]


def dropped_labels(entry: Mapping[str, str]) -> dict[str, str]:
    """Return the incompatible labels of an entry of `dropped`, by column."""
    return {column: label for column, label in entry.items() if column != "reason"}


def _in_words(entry: Mapping[str, str]) -> str:
    """Return a combination that was left out, and why, in words."""
    labels = dropped_labels(entry).items()
    words = ", ".join(
        f"{column} {label}" for column, label in labels if label != NOT_USED
    )
    return f"{words}: {entry['reason']}"


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
                f"Expected a whole run, got {folder}, which is shard {run.shard} of a "
                "run and has no tables. Merge all "
                "shards with `benchnav-eval merge OUT PART …`."
            )
        raise ConfigError(
            f"Expected a finished run, got {folder} without {name}. Give its "
            "`benchnav-eval run` command again to "
            "finish it; `benchnav-eval report --partial` and `replay` read what is "
            "there."
        )
    with damaged(path, "Remove it and give the run's command again."):
        if run.about.get("tables", {}).get(name) != digest_of_path(path):
            raise DamageError("it was changed after benchnav wrote it")
        return pd.read_parquet(path)


@contextmanager
def damaged(path: Path, remedy: str) -> Iterator[None]:
    """Convert any error of reading a file into a ConfigError of one line."""
    try:
        yield
    except PermissionError:
        raise
    except Exception as error:  # of the table's library, or of a rule for suites
        is_ours = isinstance(error, DamageError | ConfigError)
        reason = error if is_ours else one_line(error)
        message = f"{path} is damaged: {reason}. {remedy}"
        raise out_of_memory(error) or ConfigError(message) from error


@dataclass(frozen=True, kw_only=True)
class Finished:
    """A finished unit in a run folder.

    Args:
        path: file of the unit.
        about: metadata of the file: `unit` (identity), `key`, `code`, `digests` of the
            maps, `record`, `made` (a random token, which copies retain), `traceback`,
            `errors`, `touched` (what custom parts read), and the digests `content` of
            its rows, `steps` of its steps and `recordings` of its recordings by path.
    """

    path: Path
    about: Mapping[str, Any]

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.path.parents[2]

    @property
    def metrics(self) -> set[str]:
        """Columns of its rows in addition to the built-in ones."""
        return set(self.about["code"].get(METRICS, ()))

    def has(self, unit: Unit) -> bool:
        """Return whether the recordings that `unit` requests exist and are its own."""
        if RECORDS.index(self.about["record"]) < RECORDS.index(unit.record):
            return False
        steps = self.folder / unit.steps_path
        has_own_steps = metadata(steps).get("key") == self.about["key"]
        return self.about["record"] == "none" or has_own_steps

    def damage(self) -> list[str]:
        """Return a line for each damaged file of the unit, starting with its path.

        Steps and recordings count if they belong to this making of the unit; a missing
        file is no damage.
        """
        lines = damage_of(self.path, str(self.path.relative_to(self.folder)))
        steps = steps_path(self.about["unit"][0], self.path.name.rpartition("-")[0])
        steps_metadata = metadata(self.folder / steps)
        if steps_metadata and steps_metadata.get("key") != self.about["key"]:
            return lines
        if self.about.get("steps") and (self.folder / steps).exists():
            is_own = steps_metadata.get(CONTENT) == self.about["steps"]
            damage = damage_of(self.folder / steps, str(steps))
            if not damage and not is_own:
                damage = [f"{steps}: it holds the steps of another run"]
            lines += damage
        for name, digest in self.about.get("recordings", {}).items():
            if digest_of_path(self.folder / name) not in ("", digest):
                lines.append(f"{name}: it was changed after benchnav wrote it")
        return lines


def find_units(folder: Path, unit: Unit) -> list[Finished]:
    """Find all makings of a unit, of any code and maps, newest first."""
    files = sorted(
        (folder / "units" / unit.condition.id).glob(f"{unit.name}-*.parquet"),
        key=lambda path: path.stat().st_mtime,
        reverse=True,
    )
    makings = [Finished(path=path, about=metadata(path)) for path in files]
    return [
        finished
        for finished in makings
        if finished.about.get("unit") == _identity(unit)
    ]


def unit_path(unit: Unit, key: str) -> Path:
    """Return the path of a unit with a key in a run folder."""
    return Path("units", unit.condition.id, f"{unit.name}-{key}.parquet")


def _identity(unit: Unit) -> list[Any]:
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
        unit: the unit.
        origin: origin of its rows.
        rows: a row an episode.
        errors: messages of faults, a line each.
        traceback: traceback of the first fault.
    """
    key = origin.key(unit)
    recordings = [unit.recording_path(member) for member in range(len(unit.maps))]
    unit_metadata = {
        "unit": _identity(unit),
        "key": key,
        "code": origin.code,
        "digests": list(origin.maps),
        "record": unit.record,
        "made": secrets.token_hex(8),
        "traceback": traceback,
        "errors": list(errors),
        TOUCHED: touches(unit.condition, unit.metrics),
        "steps": metadata(folder / unit.steps_path).get(CONTENT, ""),
        "recordings": {
            path.as_posix(): digest
            for path in recordings
            if (digest := digest_of_path(folder / path))
        },
    }
    table = pa.Table.from_pandas(
        rows.assign(code=code_digest(origin.code)), preserve_index=False
    )
    with replacing(folder / unit_path(unit, key)) as partial:
        pq.write_table(with_metadata(table, unit_metadata), partial)


def clear_unit(folder: Path, unit: Unit) -> None:
    """Remove steps and recordings of an earlier making of a unit, but not its rows."""
    (folder / unit.steps_path).unlink(missing_ok=True)
    for member in range(len(unit.maps)):
        for suffix in (".npz", ".rrd"):
            (folder / unit.recording_path(member, suffix)).unlink(missing_ok=True)


def finish_run(
    folder: Path, finished: Sequence[tuple[Unit, Finished]], reused: str = ""
) -> None:
    """Write `episodes.parquet` and `errors.txt`, and update `run.json`.

    Args:
        folder: the run folder.
        finished: all units of the run, in the order of the table.
        reused: a line on units of other code; empty without such units.
    """
    manifest = open_run(folder).about
    write_errors(folder, finished)
    rows = pd.concat(
        [labelled_rows(unit, making) for unit, making in finished], ignore_index=True
    )
    table = pa.Table.from_pandas(rows, preserve_index=False).replace_schema_metadata(
        None
    )
    with replacing(folder / EPISODES) as partial:
        pq.write_table(table, partial)
    codes: dict[str, Any] = {}
    for _, making in finished:
        code = codes.setdefault(
            code_digest(making.about["code"]), {**making.about["code"], TOUCHED: {}}
        )
        code[TOUCHED] |= making.about.get(TOUCHED, {})
    results = {
        "codes": codes,
        "reused": reused,
        "tables": {EPISODES: digest_of_path(folder / EPISODES)},
    }
    if {name: manifest.get(name) for name in results} != results:
        write_run(folder, {**manifest, **results})


def write_errors(folder: Path, finished: Iterable[tuple[Unit, Finished]]) -> None:
    """Write `errors.txt` of all units, or remove it if nothing failed."""
    traces = [
        text for unit, making in finished if (text := _trace(unit, making, folder))
    ]
    if traces:
        write_text(folder / ERRORS, "\n".join(traces))
    else:
        (folder / ERRORS).unlink(missing_ok=True)


def unit_rows(finished: Finished) -> pd.DataFrame:
    """Read the rows of a finished unit.

    Raises:
        ConfigError: If its file is damaged.
    """
    with damaged(
        finished.path, "Give the run's command again, which runs the unit again."
    ):
        return read_sealed(finished.path).to_pandas()


def labelled_rows(unit: Unit, finished: Finished) -> pd.DataFrame:
    """Read the rows of a finished unit, with the current labels of its condition."""
    return unit_rows(finished).assign(**unit.condition.labels)


def differences(
    first: pd.DataFrame, second: pd.DataFrame
) -> tuple[pd.DataFrame, pd.Index]:
    """Compare two tables of episodes bit for bit, in result columns that both have.

    Args:
        first: rows of episodes, in any order.
        second: likewise.

    Returns:
        The cells that differ, in the order of the first: `first`, `second`, by `KEYS`
        and column; and the keys of episodes that are in only one table.
    """
    columns = sorted(_results(first) & _results(second), key=list(first).index)
    first_rows = first.set_index(KEYS)[columns]
    second_rows = second.set_index(KEYS)[columns]
    common = first_rows.index.intersection(second_rows.index, sort=False)
    cells = first_rows.loc[common].compare(
        second_rows.loc[common], result_names=("first", "second")
    )
    lacking = first_rows.index.symmetric_difference(second_rows.index, sort=False)
    cells = cells.stack(level=0, future_stack=True).dropna(how="all")
    return cells.reindex(columns=["first", "second"]), lacking


def differing_columns(first: pd.DataFrame, second: pd.DataFrame) -> list[str]:
    """Return result columns that are in only one of two tables."""
    return sorted(_results(first) ^ _results(second))


def _results(rows: pd.DataFrame) -> set[str]:
    """Return columns of results, without wall times and the digest of the code."""
    others = (*KEYS, "code", "learning_ms")
    return {
        name for name in rows if name not in others and not name.startswith("planning_")
    }


def _trace(unit: Unit, finished: Finished, folder: Path) -> str:
    unit_metadata = finished.about
    if not unit_metadata["traceback"] and not unit_metadata["errors"]:
        return ""
    maps = f"maps {unit.maps[0]}–{unit.maps[-1]}"
    path = finished.path.relative_to(folder)
    heading = (
        f"{unit.condition.description}, seed {unit.seed}, realisation "
        f"{unit.realisation}, {maps} ({path})"
    )
    return "\n".join([heading, *unit_metadata["errors"], unit_metadata["traceback"]])
