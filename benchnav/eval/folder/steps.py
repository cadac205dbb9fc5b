"""Steps of episodes: one Parquet file a unit, one partition a condition.

The files are `steps/condition=ID/SEED-REALISATION-BLOCK.parquet`.

Any reader of partitioned Parquet takes them: `pandas.read_parquet(run / "steps", filters=[("condition", "==", id)])`.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from benchnav.core.errors import ConfigError
from benchnav.core.settings import check_known
from benchnav.core.store import replacing
from benchnav.eval.experiment.condition import LABELS
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.folder.run_folder import EPISODES, damaged, open_run
from benchnav.eval.folder.sealed import DamageError, metadata, read_sealed, with_metadata

STEPS = "steps"

LAST_COLUMN = "traversability"
# RMSE of E[λ] and mean log score of what is believed of the ground ahead of a robot.
AHEAD_COLUMNS = ("ahead_rmse", "ahead_log_score")
AHEAD_M, AHEAD_DEG = 5.0, 45.0  # how far, and how far to either side, ground is ahead of a robot
_KEYS = ("seed", "realisation", "map")
_VALUES = ("time_s", "x_m", "y_m", LAST_COLUMN)
_ORDER = ["condition", *_KEYS, "step"]
_REMEDY = "Remove the steps, which the report can do without, or run it again with another `--out`."


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
        every = dict.fromkeys(name for names in held.values() for name in names if name != LAST_COLUMN)
        for path, names in held.items():
            if names == [*every, LAST_COLUMN]:
                continue
            table = read_sealed(path)
            none = pa.array(np.full(len(table), np.nan, np.float32))
            full = {name: table[name] if name in names else none for name in [*every, LAST_COLUMN]}
            _write(path, pa.table(full), metadata(path))


def open_steps(folder: Path) -> ds.Dataset | None:
    """Opens the steps of a run; None where none were kept.

    Args:
        folder: the run folder.

    Raises:
        ConfigError: a file of them is damaged.
    """
    if not any((folder / STEPS).glob("*/*.parquet")):
        return None
    with damaged(folder / STEPS, _REMEDY):
        # By its type, since an id of digits alone would be taken for a number.
        parts = ds.partitioning(pa.schema([("condition", pa.string())]), flavor="hive")
        source = ds.dataset(folder / STEPS, partitioning=parts)
        # Files of a run that is not finished may differ in their columns.
        if not (folder / EPISODES).exists():
            schemas = [fragment.physical_schema for fragment in source.get_fragments()]
            source = source.replace_schema(pa.unify_schemas([source.schema, *schemas]).remove_metadata())
        return source


def rows_of(
    folder: Path, source: ds.Dataset, columns: Sequence[str] | None, chosen: pc.Expression
) -> pd.DataFrame:
    """Reads steps.

    Args:
        folder: the run folder.
        source: its steps.
        columns: which; None for all.
        chosen: of which rows.

    Raises:
        ConfigError: a file of them is damaged.
    """
    # Whole files, since their digests are of all that they hold.
    tables = []
    with damaged(folder / STEPS, _REMEDY):
        for field in source.schema:
            fits = pa.types.is_integer if field.name in _KEYS else pa.types.is_floating
            if field.name in (*_KEYS, *_VALUES) and not fits(field.type):
                raise DamageError(f"{field.name} holds {field.type}")
        for fragment in source.get_fragments(filter=chosen):
            table = read_sealed(Path(fragment.path))
            condition = ds.get_partition_keys(fragment.partition_expression)["condition"]
            table = table.append_column("condition", pa.array([condition] * len(table), pa.string()))
            table = table.filter(chosen)
            tables.append(table.select(columns) if columns else table)
        if not tables:
            return source.schema.empty_table().select(columns or source.schema.names).to_pandas()
        return pa.concat_tables(tables, promote_options="default").to_pandas()


def read_steps(folder: Path, **filters: Any) -> pd.DataFrame:
    """Reads steps of a run.

    Args:
        folder: a run folder.
        **filters: which; `condition` by its id or by its labels (`planner="mppi"`, `risk="mean"`, …), and `seed`,
            `realisation`, `map`, `step`. A list takes any of several.

    Returns:
        A row a state, in the order of condition, seed, realisation, map and step; columns as of `step_table`,
        and `condition`.

    Raises:
        ConfigError: the run has no steps, or nothing by that filter's name.
    """
    run, source = open_run(folder), open_steps(folder)
    if source is None:
        raise ConfigError(
            f"Expected a run with steps, got {folder} without any. Make them with `--record steps`."
        )
    chosen = pc.scalar(True)
    for name, value in filters.items():
        values = list(value) if isinstance(value, list | tuple | set | range | np.ndarray) else [value]
        if name in LABELS:
            values = [i for i, (condition, _) in run.conditions.items() if condition.labels[name] in values]
            name = "condition"
        check_known("filters", name, source.schema.names)
        chosen &= ds.field(name).isin(pa.array(values, source.schema.field(name).type))
    rows = rows_of(folder, source, None, chosen)
    order = [name for name in _ORDER if name in rows]
    rows = rows.sort_values(order, kind="stable", ignore_index=True)
    return rows[[*order, *(name for name in rows if name not in order)]]
