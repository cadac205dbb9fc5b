"""Steps of episodes: one Parquet file a unit, one partition a condition.

The files are `steps/condition=ID/SEED-REALISATION-BLOCK.parquet`.

Any reader of partitioned Parquet takes them: `pandas.read_parquet(run / "steps",
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
# RMSE of E[λ] and mean log score of what is believed of the ground ahead of a robot.
AHEAD_COLUMNS = ("ahead_rmse", "ahead_log_score")
# how far, and how far to either side, ground is ahead of a robot
AHEAD_M, AHEAD_DEG = (
    5.0,
    45.0,
)
_ORDER = ["condition", *DRAW, "step"]
_REMEDY = (
    "Remove the steps, which the report can do without, or run it again with "
    "another `--out`."
)


def write_steps(folder: Path, unit: Unit, key: str, table: pa.Table) -> None:
    """Writes the steps of a unit, whole or not at all.

    Args:
        folder: the run folder.
        unit: what was run.
        key: of the unit.
        table: from `step_table`.
    """
    _write(folder / unit.steps_path, table, {"key": key})


def _write(path: Path, table: pa.Table, about: Mapping[str, Any]) -> None:
    with replacing(path) as partial:
        pq.write_table(with_metadata(table, about), partial, compression="zstd")


def align_steps(folder: Path, finished: Iterable[Unit]) -> None:
    """Gives all files of steps the same columns, whatever actions their robots have.

    Readers of many files take the columns of the first.

    Args:
        folder: the run folder.
        finished: units of the run.
    """
    paths = [path for unit in finished if (path := folder / unit.steps_path).exists()]
    with damaged(folder / STEPS, _REMEDY):
        held = {path: pq.read_schema(path).names for path in paths}
        every = dict.fromkeys(
            name for names in held.values() for name in names if name != LAST_COLUMN
        )
        for path, names in held.items():
            if names == [*every, LAST_COLUMN]:
                continue
            table = read_sealed(path)
            none = pa.array(np.full(len(table), np.nan, np.float32))
            full = {
                name: table[name] if name in names else none
                for name in [*every, LAST_COLUMN]
            }
            _write(path, pa.table(full), metadata(path))


def has_steps(folder: Path) -> bool:
    """Return whether steps of a run were kept."""
    return any((folder / STEPS).glob("*/*.parquet"))


def step_files(
    folder: Path, conditions: Collection[str] | None = None
) -> Iterator[pd.DataFrame]:
    """Yield the steps of a run, a file at a time, whose digest is of all that it holds.

    Args:
        folder: the run folder.
        conditions: ids of those that are read; None for all.

    Yields:
        Columns as of `step_table`, and `condition`. Files of a run that is not finished
        may differ in their columns.

    Raises:
        ConfigError: a file is damaged.
    """
    for path in sorted((folder / STEPS).glob("*/*.parquet")):
        condition = path.parent.name.removeprefix("condition=")
        if conditions is None or condition in conditions:
            with damaged(folder / STEPS, _REMEDY):
                rows = read_sealed(path).to_pandas()
            yield rows.assign(condition=condition)


def read_steps(folder: Path, **filters: Any) -> pd.DataFrame:
    """Reads steps of a run.

    Args:
        folder: a run folder.
        **filters: which; `condition` by its id or by its labels (`planner="mppi"`,
            `risk="mean"`, …), and `seed`, `realisation`, `map`, `step`. A list takes
            any of several.

    Returns:
        A row a state, in the order of condition, seed, realisation, map and step;
        columns as of `step_table`, and `condition`.

    Raises:
        ConfigError: the run has no steps, or nothing by that filter's name.
    """
    run = open_run(folder)
    if not has_steps(folder):
        raise ConfigError(
            f"Expected a run with steps, got {folder} without any. Make them with "
            "`--record steps`."
        )
    conditions = set(run.conditions)
    chosen = {}
    for name, value in filters.items():
        check_known("filters", name, (*LABELS, *_ORDER))
        values = (
            list(value)
            if isinstance(value, list | tuple | set | range | np.ndarray)
            else [value]
        )
        if name in LABELS:
            conditions &= {
                i
                for i, (known, _) in run.conditions.items()
                if known.labels[name] in values
            }
        elif name == "condition":
            conditions &= set(values)
        else:
            chosen[name] = values
    files = []
    for rows in step_files(folder, conditions):
        for name, values in chosen.items():
            rows = rows[rows[name].isin(values)]
        files.append(rows)
    rows = pd.concat(files) if files else next(step_files(folder)).head(0)
    rows = rows.sort_values(_ORDER, kind="stable", ignore_index=True)
    return rows[[*_ORDER, *(name for name in rows if name not in _ORDER)]]
