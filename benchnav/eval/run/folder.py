"""Run folders, format version 2: what lies where, and how it is read.

A run folder holds `run.json` (trials, and where everything came from), `units/` (what is finished: one
Parquet file a unit, with rows, steps and, in its metadata, what else is known of it), `playback/`, and,
when all is done, `episodes.parquet`, `steps.parquet`, `errors.txt` where a planner or model failed, and the
report. Every file is written under another name first.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from benchnav.errors import ConfigError
from benchnav.eval.run.unit import Extent, Unit
from benchnav.eval.trial import Trial, trial_from
from benchnav.files import replacing, write_text

FORMAT, FORMAT_VERSION = "benchnav-run", 2
RUN, EPISODES, STEPS, ERRORS = "run.json", "episodes.parquet", "steps.parquet", "errors.txt"

_METADATA = b"benchnav"
_STEP_COLUMN = "step:"


@dataclass(frozen=True, kw_only=True)
class Run:
    """A run folder that was found.

    Args:
        folder: where.
        about: all of `run.json`.
        version: of its format; 1 is that of benchnav 0.1.
        trials: by id, with how often each is run; none in version 1.
    """

    folder: Path
    about: dict[str, Any]
    version: int
    trials: dict[str, tuple[Trial, Extent]]


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
        if not isinstance(about["suite"], dict):
            raise TypeError("no suite")
    except ConfigError:
        raise
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ConfigError(
            f"Expected a run folder with {RUN}, got {folder}. Make one with `benchnav-eval run`."
        ) from error
    return Run(folder=folder, about=about, version=version, trials=trials)


def read_table(folder: Path, name: str) -> pd.DataFrame:
    """Reads a table of a finished run.

    Raises:
        ConfigError: the run is not finished.
    """
    path = folder / name
    if not path.exists():
        raise ConfigError(
            f"Expected a finished run, got {folder} without {name}. Give its `benchnav-eval run` command again to "
            "finish it."
        )
    try:
        return pd.read_parquet(path)
    except (ValueError, OSError) as error:
        raise ConfigError(f"{path} is damaged: {error}. Remove it and run the same command again.") from error


def write_unit(
    folder: Path,
    unit: Unit,
    rows: pd.DataFrame,
    steps: Sequence[dict[str, np.ndarray]],
    about: dict[str, Any],
) -> None:
    """Writes a finished unit.

    Args:
        folder: the run folder.
        unit: what was run.
        rows: a row an episode.
        steps: of each episode its columns; empty where none began.
        about: what else is known; `run_id` and `traceback` among it.
    """
    table = pa.Table.from_pandas(rows, preserve_index=False)
    for name in steps[0] if steps else ():
        values = pa.array([columns[name] for columns in steps])
        table = table.append_column(_STEP_COLUMN + name, values)
    text = json.dumps({**about, "instances": list(unit.instances)})
    table = table.replace_schema_metadata({**(table.schema.metadata or {}), _METADATA: text.encode()})
    with replacing(folder / unit.path) as partial:
        pq.write_table(table, partial)


def about_unit(folder: Path, unit: Unit, run_id: str) -> dict[str, Any] | None:
    """What is known of a unit; None where this run has not finished it for the instances it now has."""
    try:
        metadata = pq.read_schema(folder / unit.path).metadata or {}
    except (OSError, ValueError):
        return None
    about = json.loads(metadata.get(_METADATA, b"{}"))
    own = about.get("run_id") == run_id and about.get("instances") == list(unit.instances)
    return about if own else None


def merge_tables(folder: Path, finished: Iterable[Unit], run_id: str) -> None:
    """Writes `episodes.parquet` and `steps.parquet` of all units, a unit at a time, and `errors.txt`.

    Raises:
        ConfigError: a unit is missing, or of another run.
    """
    finished = list(finished)
    abouts = [about_unit(folder, unit, run_id) for unit in finished]
    for unit, about in zip(finished, abouts, strict=True):
        if about is None:
            raise ConfigError(
                f"{folder / unit.path} is not of this run. Give its `benchnav-eval run` command again."
            )
    schemas = [pq.read_schema(folder / unit.path) for unit in finished]
    names = dict.fromkeys(name for schema in schemas for name in schema.names)
    layers = [name.removeprefix(_STEP_COLUMN) for name in names if name.startswith(_STEP_COLUMN)]
    # `traversability` last, whatever actions the robots of the run have.
    layers = [name for name in layers if name != "traversability"] + ["traversability"]
    _merge(folder / EPISODES, (_episode_table(folder, unit) for unit in finished))
    _merge(folder / STEPS, (_step_table(folder, unit, layers) for unit in finished))
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


def _episode_table(folder: Path, unit: Unit) -> pa.Table:
    table = pq.read_table(folder / unit.path, partitioning=None)
    rows = table.select([name for name in table.column_names if not name.startswith(_STEP_COLUMN)])
    return pa.Table.from_pandas(rows.to_pandas(), preserve_index=False).replace_schema_metadata(None)


def _step_table(folder: Path, unit: Unit, layers: Sequence[str]) -> pa.Table:
    table = pq.read_table(folder / unit.path, partitioning=None)
    keys = ["trial", "seed", "realisation", "instance"]
    there = _STEP_COLUMN + "time_s" in table.column_names
    counts = [len(values) for values in table.column(_STEP_COLUMN + "time_s")] if there else [0] * len(table)
    columns: dict[str, Any] = {
        name: np.repeat(table.column(name).to_numpy(zero_copy_only=False), counts) for name in keys
    }
    columns["step"] = np.concatenate([np.arange(count) for count in counts]).astype(np.int64)
    for name in layers:
        full, kind = _STEP_COLUMN + name, np.float64 if name == "time_s" else np.float32
        column = table.column(full).combine_chunks().flatten() if full in table.column_names else None
        values = np.full(sum(counts), np.nan) if column is None else column.to_numpy(zero_copy_only=False)
        columns[name] = values.astype(kind)
    columns["trial"] = pa.array(columns["trial"].tolist(), pa.string())
    return pa.table(columns)


def _trace(unit: Unit, about: dict[str, Any]) -> str:
    if not about.get("traceback") and not about.get("errors"):
        return ""
    labels = ", ".join(f"{name} {label}" for name, label in unit.trial.labels.items())
    instances = f"instances {unit.instances[0]}–{unit.instances[-1]}"
    heading = f"{labels}, seed {unit.seed}, realisation {unit.realisation}, {instances} ({unit.path})"
    return "\n".join([heading, *about.get("errors", []), about.get("traceback", "")])
