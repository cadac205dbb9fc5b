"""Run folders, format version 3: what lies where, and how it is read.

A run folder holds `run.json` (trials, and where everything came from), `units/` (what is finished: one
Parquet file a unit, with rows and, in its metadata, what else is known of it), `steps/`, `playback/`, and,
when all is done, `episodes.parquet`, `errors.txt` where a planner or model failed, and the report. Every file
is written under another name first. Version 2 had all steps within the files of units and in one table.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from benchnav.errors import ConfigError
from benchnav.eval.keep import Keep
from benchnav.eval.trial import Trial, trial_from
from benchnav.eval.unit import Extent, Unit
from benchnav.files import replacing, write_text
from benchnav.share import Share

FORMAT, FORMAT_VERSION = "benchnav-run", 3
RUN, EPISODES, ERRORS = "run.json", "episodes.parquet", "errors.txt"

_METADATA = b"benchnav"


@dataclass(frozen=True, kw_only=True)
class Run:
    """A run folder that was found.

    Args:
        folder: where.
        about: all of `run.json`.
        version: of its format; 1 is that of benchnav 0.1.
        trials: by id, with how often each is run; none in version 1.
        shard: which share of the run the folder holds; None where it holds all.
    """

    folder: Path
    about: dict[str, Any]
    version: int
    trials: dict[str, tuple[Trial, Extent]]
    shard: Share | None = None


def open_run(folder: Path) -> Run:
    """Reads what a run folder is about.

    Raises:
        ConfigError: the folder is no run folder, or of a newer format.
    """
    try:
        about = json.loads((folder / RUN).read_text())
        version = about["format_version"] if "format" in about else 1
        if version > FORMAT_VERSION:
            raise ConfigError(
                f"Expected a run folder of format version at most {FORMAT_VERSION}, got {folder} of version "
                f"{version}. Read it with a newer benchnav: pip install --upgrade benchnav."
            )
        known = {} if version == 1 else about["trials"]
        trials = {i: (trial_from(entry), Extent.from_dict(entry)) for i, entry in known.items()}
        shard = Share(**about["shard"]) if "shard" in about else None
        if not isinstance(about["suite"], dict):
            raise TypeError("no suite")
    except ConfigError:
        raise
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ConfigError(
            f"Expected a run folder with {RUN}, got {folder}. Make one with `benchnav-eval run`."
        ) from error
    return Run(folder=folder, about=about, version=version, trials=trials, shard=shard)


def read_table(folder: Path, name: str) -> pd.DataFrame:
    """Reads a table of a finished run.

    Raises:
        ConfigError: the run is not finished, or the folder holds a shard of it.
    """
    path = folder / name
    if not path.exists():
        shard = open_run(folder).shard
        if shard is not None:
            raise ConfigError(
                f"Expected a whole run, got {folder}, which is shard {shard} of one and has no tables. Put all "
                "shards together with `benchnav-eval merge OUT PART …`."
            )
        raise ConfigError(
            f"Expected a finished run, got {folder} without {name}. Give its `benchnav-eval run` command again to "
            "finish it."
        )
    try:
        return pd.read_parquet(path)
    except (ValueError, OSError) as error:
        raise ConfigError(f"{path} is damaged: {error}. Remove it and run the same command again.") from error


def write_unit(folder: Path, unit: Unit, rows: pd.DataFrame, about: dict[str, Any]) -> None:
    """Writes a finished unit.

    Args:
        folder: the run folder.
        unit: what was run.
        rows: a row an episode.
        about: what else is known; `run_id` and `traceback` among it.
    """
    table = pa.Table.from_pandas(rows, preserve_index=False)
    text = json.dumps({**about, "instances": list(unit.instances), "keep": unit.keep.to_dict()})
    table = table.replace_schema_metadata({**(table.schema.metadata or {}), _METADATA: text.encode()})
    with replacing(folder / unit.path) as partial:
        pq.write_table(table, partial)


def about_unit(folder: Path, unit: Unit, run_id: str) -> dict[str, Any] | None:
    """What is known of a unit; None where this run has not finished it for the instances it now has."""
    about = _about(folder, unit, run_id)
    return about if about and about.get("instances") == list(unit.instances) else None


def kept(folder: Path, unit: Unit, run_id: str) -> Keep:
    """What this run has kept of a unit beside its rows, perhaps of fewer instances; nothing where it has not run."""
    about = _about(folder, unit, run_id)
    return Keep(**about["keep"]) if about else Keep()


def _about(folder: Path, unit: Unit, run_id: str) -> dict[str, Any] | None:
    try:
        metadata = pq.read_schema(folder / unit.path).metadata or {}
    except (OSError, ValueError):
        return None
    about: dict[str, Any] = json.loads(metadata.get(_METADATA, b"{}"))
    return about if about.get("run_id") == run_id else None


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


def merge_tables(folder: Path, finished: Iterable[Unit], run_id: str) -> None:
    """Writes `episodes.parquet` of all units, a unit at a time, and `errors.txt`.

    Raises:
        ConfigError: a unit is missing, or of another run.
    """
    finished = list(finished)
    write_errors(folder, finished, run_id)
    _merge(folder / EPISODES, (_episode_table(folder, unit) for unit in finished))


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
    labels = ", ".join(f"{name} {label}" for name, label in unit.trial.labels.items())
    instances = f"instances {unit.instances[0]}–{unit.instances[-1]}"
    heading = f"{labels}, seed {unit.seed}, realisation {unit.realisation}, {instances} ({unit.path})"
    return "\n".join([heading, *about.get("errors", []), about.get("traceback", "")])
