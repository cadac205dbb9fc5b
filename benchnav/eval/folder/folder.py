"""Run folders, format version 4: what lies where, and how it is read.

A run folder holds `run.json` (conditions, and where everything came from), `units/` (what is finished: one
Parquet file a unit, with rows and, in its metadata, what else is known of it), `steps/`, `playback/`, and,
when all is done, `episodes.parquet`, `errors.txt` where a planner or model failed, and the report. Every file
is written under another name first. `run.json` ends in a seal, the digest of all else in it, and holds the digests
of the run's tables, so that an edit of either is found.
"""

import hashlib
import json
import secrets
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from benchnav.core.errors import ConfigError
from benchnav.core.settings import one_line
from benchnav.core.store import Shard, replacing, write_text
from benchnav.eval.experiment.condition import Condition, condition_from
from benchnav.eval.experiment.keep import Keep
from benchnav.eval.experiment.unit import Extent, Unit

FORMAT, FORMAT_VERSION = "benchnav-run", 4
RUN, EPISODES, ERRORS = "run.json", "episodes.parquet", "errors.txt"
SEAL = "seal"
KEYS = ["condition", "seed", "realisation", "map"]  # of a row

_METADATA = b"benchnav"

# What reading a damaged file raises: of a condition's rules and world what refuses a suite, of a table its library's.
_DAMAGE = (
    *(ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError, MemoryError, OSError),
    *(ConfigError, pa.ArrowException, EOFError, zipfile.BadZipFile, zlib.error),
)


class DamageError(ValueError):
    """A file of a run does not hold what it has to."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """A run folder that was found.

    Args:
        folder: where.
        about: all of `run.json`.
        conditions: by id, with how often each is run.
        shard: which share of the run the folder holds; None where it holds all.
    """

    folder: Path
    about: dict[str, Any]
    conditions: dict[str, tuple[Condition, Extent]]
    shard: Shard | None = None


def open_run(folder: Path) -> Run:
    """Reads what a run folder is about.

    Raises:
        ConfigError: the folder is no run folder, or of another format version.
    """
    if not (folder / RUN).is_file():
        raise ConfigError(
            f"Expected a run folder with {RUN}, got {folder}. Make one with `benchnav-eval run`."
        )
    with damaged(folder / RUN, "Take it from a copy, or run the suite again into another folder."):
        about = json.loads((folder / RUN).read_text())
        version = _format_version(about)
    if version != FORMAT_VERSION:
        reader = (
            "a newer benchnav" if version > FORMAT_VERSION else "benchnav 0.7, which reads versions 1 to 3"
        )
        raise ConfigError(
            f"Expected a run folder of format version {FORMAT_VERSION}, got {folder} of version {version}. Read it "
            f"with {reader}, or run its suite again."
        )
    with damaged(folder / RUN, "Take it from a copy, or run the suite again into another folder."):
        if _sealed(about) != about:
            raise DamageError("it was changed after benchnav wrote it")
        conditions = {
            i: (condition_from(entry), Extent.from_dict(entry)) for i, entry in about["conditions"].items()
        }
        shard = Shard(**about["shard"]) if "shard" in about else None
    return Run(folder=folder, about=about, conditions=conditions, shard=shard)


def _format_version(about: Any) -> int:
    """The version of `run.json`; before there was one it had no format, but the command that made it."""
    if not isinstance(about, dict):
        raise DamageError("it is no mapping")
    if "format" not in about and "command" in about:
        return 1
    version = about.get("format_version")
    if about.get("format") != FORMAT or type(version) is not int:
        raise DamageError("it does not say that it is a run, or of which version")
    return version


def write_run(folder: Path, about: Mapping[str, Any]) -> None:
    """Writes `run.json`, sealed."""
    write_text(folder / RUN, json.dumps(_sealed(about), indent=1))


def _sealed(about: Mapping[str, Any]) -> dict[str, Any]:
    """What `run.json` holds, with the digest of all of it."""
    content = {name: value for name, value in about.items() if name != SEAL}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return {**content, SEAL: hashlib.sha256(text.encode()).hexdigest()}


def _digest_of_file(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def caveats(about: Mapping[str, Any]) -> list[str]:
    """What readers of a run's tables should know: its warnings, and the pairs that it left out.

    Args:
        about: of its `run.json` at least `warnings` and `dropped`.
    """
    left_out = [
        f"left out: planner {pair['planner']} with robot {pair['robot']}, which it cannot steer"
        for pair in about["dropped"]
    ]
    return [*(f"warning: {line}" for line in about["warnings"]), *left_out]


def read_table(folder: Path, name: str) -> pd.DataFrame:
    """Reads a table of episodes of a finished run, which is checked against `run.json`.

    Raises:
        ConfigError: the run is not finished, the folder holds a shard of it, or the table is not the run's.
    """
    path, run = folder / name, open_run(folder)
    if not path.exists():
        if run.shard is not None:
            raise ConfigError(
                f"Expected a whole run, got {folder}, which is shard {run.shard} of one and has no tables. Put all "
                "shards together with `benchnav-eval merge OUT PART …`."
            )
        raise ConfigError(
            f"Expected a finished run, got {folder} without {name}. Give its `benchnav-eval run` command again to "
            "finish it."
        )
    with damaged(path, "Remove it and give the run's command again."):
        if run.about.get("tables", {}).get(name) != _digest_of_file(path):
            raise DamageError("it was changed after benchnav wrote it")
        return pd.read_parquet(path)


@contextmanager
def damaged(path: Path, remedy: str) -> Iterator[None]:
    """Says in one line that a file is not what it has to be, whatever reading it raised."""
    try:
        yield
    except PermissionError:
        raise
    except _DAMAGE as error:
        said = error if isinstance(error, DamageError | ConfigError) else one_line(error)
        raise ConfigError(f"{path} is damaged: {said}. {remedy}") from error


def write_unit(folder: Path, unit: Unit, rows: pd.DataFrame, about: dict[str, Any]) -> None:
    """Writes a finished unit.

    Args:
        folder: the run folder.
        unit: what was run.
        rows: a row an episode.
        about: what else is known; `run_id` and `traceback` among it. With it goes a token of this one making of
            the unit, which copies keep.
    """
    table = pa.Table.from_pandas(rows, preserve_index=False)
    own = {"made": secrets.token_hex(8), "maps": list(unit.maps), "keep": unit.keep.to_dict()}
    text = json.dumps({**about, **own})
    table = table.replace_schema_metadata({**(table.schema.metadata or {}), _METADATA: text.encode()})
    with replacing(folder / unit.path) as partial:
        pq.write_table(table, partial)


def about_unit(folder: Path, unit: Unit, run_id: str) -> dict[str, Any] | None:
    """What is known of a unit; None where this run has not finished it for the maps it now has."""
    about = _about(folder, unit, run_id)
    return about if about and about.get("maps") == list(unit.maps) else None


def kept(folder: Path, unit: Unit, run_id: str) -> Keep:
    """What this run has kept of a unit beside its rows, perhaps of fewer maps; nothing where it has not run."""
    about = _about(folder, unit, run_id)
    return Keep(**about["keep"]) if about else Keep()


def making(folder: Path, unit: Unit) -> str | None:
    """Which making of a unit a folder holds, of any run: the same for copies alone; None where it holds none."""
    made: str | None = _any_about(folder, unit).get("made")
    return made


def _about(folder: Path, unit: Unit, run_id: str) -> dict[str, Any] | None:
    about = _any_about(folder, unit)
    return about if about.get("run_id") == run_id else None


def _any_about(folder: Path, unit: Unit) -> dict[str, Any]:
    try:
        metadata = pq.read_schema(folder / unit.path).metadata or {}
        about: dict[str, Any] = json.loads(metadata.get(_METADATA, b"{}"))
    except (OSError, ValueError):
        return {}
    return about


def has_all(about: Mapping[str, Any] | None, unit: Unit) -> bool:
    """Whether a unit is finished, and was recorded as it is now to be.

    Args:
        about: from `about_unit`.
        unit: as it is now to be run.
    """
    return about is not None and Keep(**about["keep"]).covers(unit.keep)


def copy_unit(source: Path, unit: Unit, folder: Path, run_id: str) -> None:
    """Copies the file of a finished unit into another run folder, as a unit of that run."""
    table = pq.read_table(source / unit.path, partitioning=None)
    metadata = dict(table.schema.metadata)
    metadata[_METADATA] = json.dumps({**json.loads(metadata[_METADATA]), "run_id": run_id}).encode()
    with replacing(folder / unit.path) as partial:
        pq.write_table(table.replace_schema_metadata(metadata), partial)


def finish_run(folder: Path, finished: Iterable[Unit]) -> None:
    """Writes `episodes.parquet` of all units, a unit at a time, its digest into `run.json`, and `errors.txt`.

    Raises:
        ConfigError: a unit is missing, or of another run.
    """
    about, finished = open_run(folder).about, list(finished)
    write_errors(folder, finished, about["run_id"])
    _merge(folder / EPISODES, (_episode_table(folder, unit) for unit in finished))
    tables = {EPISODES: _digest_of_file(folder / EPISODES)}
    if about.get("tables") != tables:
        write_run(folder, {**about, "tables": tables})


def write_errors(folder: Path, finished: Sequence[Unit], run_id: str) -> None:
    """Writes `errors.txt` of all units, or removes it where nothing failed.

    Raises:
        ConfigError: a unit is missing, or of another run.
    """
    abouts = [about_unit(folder, unit, run_id) for unit in finished]
    for unit, about in zip(finished, abouts, strict=True):
        if about is None:
            raise ConfigError(
                f"{folder / unit.path} is not of this run. Give its `benchnav-eval run` command again."
            )
    traces = [
        text for unit, about in zip(finished, abouts, strict=True) if about and (text := _trace(unit, about))
    ]
    if traces:
        write_text(folder / ERRORS, "\n".join(traces))
    else:
        (folder / ERRORS).unlink(missing_ok=True)


def _merge(path: Path, tables: Iterable[pa.Table]) -> None:
    with replacing(path) as partial:
        writer = None
        for table in tables:
            writer = writer or pq.ParquetWriter(partial, table.schema)
            writer.write_table(table.cast(writer.schema))
        if writer is not None:
            writer.close()


def unit_rows(folder: Path, unit: Unit) -> pd.DataFrame:
    """Reads the rows of a finished unit."""
    return _episode_table(folder, unit).to_pandas()


def _episode_table(folder: Path, unit: Unit) -> pa.Table:
    rows = pq.read_table(folder / unit.path, partitioning=None).to_pandas()
    return pa.Table.from_pandas(rows, preserve_index=False).replace_schema_metadata(None)


def _trace(unit: Unit, about: dict[str, Any]) -> str:
    if not about.get("traceback") and not about.get("errors"):
        return ""
    labels = ", ".join(f"{name} {label}" for name, label in unit.condition.labels.items())
    maps = f"maps {unit.maps[0]}–{unit.maps[-1]}"
    heading = f"{labels}, seed {unit.seed}, realisation {unit.realisation}, {maps} ({unit.path})"
    return "\n".join([heading, *about.get("errors", []), about.get("traceback", "")])
