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
from benchnav.core.store import replacing
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.folder.folder import DamageError, damaged, metadata, open_run, with_metadata

STEPS = "steps"

LAST_COLUMN = "traversability"
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
    with replacing(folder / unit.steps_path) as partial:
        pq.write_table(with_metadata(table, {"key": key}), partial, compression="zstd")


def align_steps(folder: Path, finished: Iterable[Unit]) -> None:
    """Gives all files of steps the same columns, whatever actions their robots have.

    Readers of many files take the columns of the first.

    Args:
        folder: the run folder.
        finished: units of the run.
    """
    paths = [path for unit in finished if (path := folder / unit.steps_path).exists()]
    with damaged(folder / STEPS, _REMEDY):
        _align(paths)


def _align(paths: Sequence[Path]) -> None:
    fields = {field.name: field for path in paths for field in pq.read_schema(path)}
    names = [name for name in fields if name != LAST_COLUMN] + [LAST_COLUMN]
    for path in paths:
        if pq.read_schema(path).names == names:
            continue
        table = pq.read_table(path, partitioning=None)
        none = pa.array(np.full(len(table), np.nan, np.float32))
        full = {name: table[name] if name in table.column_names else none for name in names}
        with replacing(path) as partial:
            pq.write_table(with_metadata(pa.table(full), metadata(path)), partial, compression="zstd")


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
        return ds.dataset(folder / STEPS, partitioning=parts)


def rows_of(
    folder: Path, source: ds.Dataset, columns: Sequence[str] | None, chosen: pc.Expression | None
) -> pd.DataFrame:
    """Reads steps.

    Args:
        folder: the run folder.
        source: its steps.
        columns: which; None for all.
        chosen: of which rows; None for all.

    Raises:
        ConfigError: a file of them is damaged.
    """
    with damaged(folder / STEPS, _REMEDY):
        for name in columns or _KEYS:
            if name not in source.schema.names:
                raise DamageError(f"no column {name}")
        for field in source.schema:
            fits = pa.types.is_integer if field.name in _KEYS else pa.types.is_floating
            if field.name in (*_KEYS, *_VALUES) and not fits(field.type):
                raise DamageError(f"{field.name} holds {field.type}")
        return source.to_table(columns=columns and list(columns), filter=chosen).to_pandas()


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
    run = open_run(folder)
    wanted = {name: _several(value) for name, value in filters.items()}
    wanted = _by_condition({i: condition.labels for i, (condition, _) in run.conditions.items()}, wanted)
    source = open_steps(folder)
    if source is None:
        raise ConfigError(
            f"Expected a run with steps, got {folder} without any. Make them with `--record steps`."
        )
    unknown = [name for name in wanted if name not in source.schema.names]
    if unknown:
        raise ConfigError(f"Expected filters among {', '.join(source.schema.names)}, got {unknown[0]!r}.")
    chosen = None
    for name, values in wanted.items():
        own = ds.field(name).isin(pa.array(values, source.schema.field(name).type))
        chosen = own if chosen is None else chosen & own
    rows = rows_of(folder, source, None, chosen)
    order = [name for name in _ORDER if name in rows]
    rows = rows.sort_values(order, kind="stable", ignore_index=True)
    return rows[[*order, *(name for name in rows if name not in order)]]


def _several(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | tuple | set | range | np.ndarray) else [value]


def _by_condition(
    labels: Mapping[str, Mapping[str, str]], wanted: Mapping[str, list[Any]]
) -> dict[str, list[Any]]:
    """Turns filters by labels into one by the conditions' ids."""
    names = next(iter(labels.values()))
    asked = {name: values for name, values in wanted.items() if name in names}
    rest = {name: values for name, values in wanted.items() if name not in names}
    fitting = [i for i, own in labels.items() if all(own[name] in values for name, values in asked.items())]
    if asked:
        rest["condition"] = [i for i in fitting if i in rest.get("condition", fitting)]
    return rest
