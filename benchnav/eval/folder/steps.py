"""Steps of episodes: one Parquet file per unit, one partition per condition.

The files are `steps/condition=ID/SEED-REALISATION-BLOCK.parquet`. Any reader of
partitioned Parquet reads them, for example `pandas.read_parquet(run / "steps",
filters=[("condition", "==", id)])`.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from benchnav.core.errors import ConfigError
from benchnav.core.settings import check_known
from benchnav.core.store import replacing
from benchnav.eval.experiment.condition import LABELS
from benchnav.eval.experiment.unit import DRAW, Unit
from benchnav.eval.folder.run_folder import damaged, open_run
from benchnav.eval.folder.sealed import metadata, read_sealed, with_metadata

STEPS = "steps"

LAST_COLUMN = "traversability"
# RMSE of E[λ], and mean log score of the belief, over the terrain ahead of a robot.
AHEAD_COLUMNS = ("ahead_rmse", "ahead_log_score")
AHEAD_M = 5.0  # range of the terrain ahead of a robot, in metres
AHEAD_DEG = 45.0  # maximum angle between this terrain and the heading, in degrees
_ORDER = ["condition", *DRAW, "step"]
_REMEDY = (
    "Remove the folder of steps, which the report does not need, or run the suite "
    "again with another `--out`."
)


def write_steps(folder: Path, unit: Unit, key: str, table: pa.Table) -> None:
    """Write the steps of a unit atomically.

    Args:
        folder: the run folder.
        unit: unit that was run.
        key: key of the unit.
        table: table from `step_table`.
    """
    _write(folder / unit.steps_path, table, {"key": key})


def _write(path: Path, table: pa.Table, file_metadata: Mapping[str, Any]) -> None:
    with replacing(path) as partial:
        pq.write_table(with_metadata(table, file_metadata), partial, compression="zstd")


def align_steps(folder: Path, finished: Iterable[Unit]) -> None:
    """Give all files of steps the same columns, even if action dimensions differ.

    Readers of several files use the columns of the first file.

    Args:
        folder: the run folder.
        finished: units of the run.
    """
    paths = [folder / unit.steps_path for unit in finished]
    with damaged(folder / STEPS, _REMEDY):
        names_by_path = {}
        all_names: dict[str, None] = {}
        for path in paths:
            if path.exists():
                names_by_path[path] = pq.read_schema(path).names
                all_names |= dict.fromkeys(names_by_path[path])
        all_names.pop(LAST_COLUMN, None)
        aligned = [*all_names, LAST_COLUMN]
        for path, names in names_by_path.items():
            if names == aligned:
                continue
            table = read_sealed(path)
            missing = pa.array(np.full(len(table), np.nan, np.float32))
            columns = {}
            for name in aligned:
                columns[name] = table[name] if name in names else missing
            _write(path, pa.table(columns), metadata(path))


def has_steps(folder: Path) -> bool:
    """Return whether a run has steps."""
    return any((folder / STEPS).glob("*/*.parquet"))


def step_files(
    folder: Path, conditions: Collection[str] | None = None
) -> Iterator[pd.DataFrame]:
    """Yield the steps of a run, one file at a time, after checking its digest.

    Args:
        folder: the run folder.
        conditions: ids of conditions; None for all conditions.

    Yields:
        Columns of `step_table`, and `condition`. If the run is not finished, its files
        may have different columns.

    Raises:
        ConfigError: If a file is damaged.
    """
    for path in sorted((folder / STEPS).glob("*/*.parquet")):
        condition = path.parent.name.removeprefix("condition=")
        if conditions is None or condition in conditions:
            with damaged(folder / STEPS, _REMEDY):
                rows = read_sealed(path).to_pandas()
            yield rows.assign(condition=condition)


def read_steps(folder: Path, **filters: Any) -> pd.DataFrame:
    """Read steps of a run.

    Args:
        folder: a run folder.
        **filters: `condition` by its id or by labels (`planner="mppi"`, `risk="mean"`,
            …), and `seed`, `realisation`, `map`, `step`. A list selects several values.

    Returns:
        One row per state, ordered by condition, seed, realisation, map and step;
        columns of `step_table`, and `condition`.

    Raises:
        ConfigError: If the run has no steps, or a filter is unknown.
    """
    run = open_run(folder)
    if not has_steps(folder):
        raise ConfigError(
            f"Expected a run with steps, got {folder} without any. Run its suite with "
            "`--record steps`."
        )
    conditions = set(run.conditions)
    chosen = {}
    for name, value in filters.items():
        check_known("filters", name, (*LABELS, *_ORDER))
        is_several = isinstance(value, list | tuple | set | range | np.ndarray)
        values = list(value) if is_several else [value]
        if name in LABELS:
            for condition_id, (condition, _) in run.conditions.items():
                if condition.labels[name] not in values:
                    conditions.discard(condition_id)
        elif name == "condition":
            conditions &= set(values)
        else:
            chosen[name] = values
    files = []
    for rows in step_files(folder, conditions):
        for name, values in chosen.items():
            rows = rows[rows[name].isin(values)]
        files.append(rows)
    if not files:
        files = [next(step_files(folder)).head(0)]
    rows = pd.concat(files)
    rows = rows.sort_values(_ORDER, kind="stable", ignore_index=True)
    further = [name for name in rows if name not in _ORDER]
    return rows[[*_ORDER, *further]]
