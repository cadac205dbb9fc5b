from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from benchnav.eval.report.failures import failures_table
from tests.eval.report import made


def steps(condition: str, map_index: int, met: list[float], **changes: Any) -> pd.DataFrame:
    """An episode of steps of half a second; the last state has no λ."""
    count = len(met) + 1
    columns = {
        "condition": condition, "seed": 0, "realisation": 0, "map": map_index, "step": np.arange(count),
        "time_s": 0.5 * np.arange(count), "x_m": np.float32(1) * np.arange(count), "y_m": 10.0 + map_index,
        "traversability": np.float32([*met, np.nan]),
    }  # fmt: skip
    return pd.DataFrame(columns | changes)


def keep(folder: Path, *episodes: pd.DataFrame) -> None:
    for condition, rows in pd.concat(episodes).groupby("condition"):
        place = folder / "steps" / f"condition={condition}"
        place.mkdir(parents=True)
        table = pa.Table.from_pandas(rows.drop(columns="condition"), preserve_index=False)
        pq.write_table(table, place / "0-0-00000.parquet")


def test_where_and_on_what_failures_ended(tmp_path: Path) -> None:
    a, b = made.condition("mppi"), made.condition("cl_rrt")
    rows = made.rows(
        made.row(a, 0), made.row(a, 1, None, outcome="immobilised", end_time_s=3.0), made.row(b, 1, None)
    )
    rows["condition"] = rows["condition"].where(
        rows["condition"] != rows["condition"].iloc[0], "0123456789012345"
    )  # not a number
    names = list(dict.fromkeys(rows["condition"]))
    keep(
        tmp_path,
        steps(names[0], 0, [0.7] * 4),
        steps(names[0], 1, [0.9, 0.8, 0.1, 0.2, 0.3, 0.4]),
        steps(names[1], 1, [0.5], x_m=7.0),
    )
    table = failures_table(tmp_path, rows)
    assert list(table["condition"]) == names
    assert list(table["outcome"]) == ["immobilised", "timeout"]
    assert list(table["end_time_s"]) == [3, 100]
    assert table[["x_m", "y_m"]].to_numpy().tolist() == [[6, 11], [7, 11]]
    # Of six steps the last four lie in the last 2 s.
    np.testing.assert_allclose(table["end_traversability"], [0.4, 0.5])
    np.testing.assert_allclose(table["last_traversability"], [0.25, 0.5])


def test_episodes_are_distinguished_by_seed_and_realisation(tmp_path: Path) -> None:
    labels = made.condition()
    rows = made.rows(made.row(labels, 0, None, seed=s, realisation=r) for s in (0, 1) for r in (0, 1))
    condition = rows["condition"][0]
    keep(
        tmp_path,
        *(steps(condition, 0, [0.1 * (2 * s + r)], seed=s, realisation=r) for s in (0, 1) for r in (0, 1)),
    )
    np.testing.assert_allclose(
        failures_table(tmp_path, rows)["end_traversability"], [0, 0.1, 0.2, 0.3], atol=1e-7
    )


def test_without_steps_there_is_no_place(tmp_path: Path) -> None:
    rows = made.rows(made.row(made.condition(), 0), made.row(made.condition(), 1, None))
    (failure,) = failures_table(tmp_path, rows).to_dict("records")
    assert (failure["map"], failure["outcome"]) == (1, "timeout")
    assert all(
        np.isnan(failure[name]) for name in ("x_m", "y_m", "end_traversability", "last_traversability")
    )


def test_a_run_without_failures_has_an_empty_table(tmp_path: Path) -> None:
    rows = made.rows(made.row(made.condition(), 0))
    keep(tmp_path, steps(rows["condition"][0], 0, [0.5]))
    table = failures_table(tmp_path, rows)
    assert table.empty
    assert {"outcome", "x_m", "last_traversability"} <= set(table.columns)
