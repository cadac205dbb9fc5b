from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchnav.core.errors import BenchnavError
from benchnav.eval.failures import Sheets, collect_sheets, failures_table
from benchnav.eval.recording import Recording
from tests.eval.forged import forge_steps
from tests.eval.report import made


def steps(
    condition: str, map_index: int, met: list[float], **changes: Any
) -> pd.DataFrame:
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
        path = folder / "steps" / f"condition={condition}" / "0-0-00000.parquet"
        forge_steps(path, rows.drop(columns="condition"))


def test_where_and_on_what_failures_ended(tmp_path: Path) -> None:
    a, b = made.condition("mppi"), made.condition("cl_rrt")
    rows = made.rows(
        made.row(a, 0),
        made.row(a, 1, None, outcome="immobilised", end_time_s=3.0),
        made.row(b, 1, None),
    )
    # not a number
    rows["condition"] = rows["condition"].where(
        rows["condition"] != rows["condition"].iloc[0], "0123456789012345"
    )
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
    rows = made.rows(
        made.row(labels, 0, None, seed=s, realisation=r) for s in (0, 1) for r in (0, 1)
    )
    condition = rows["condition"][0]
    keep(
        tmp_path,
        *(
            steps(condition, 0, [0.1 * (2 * s + r)], seed=s, realisation=r)
            for s in (0, 1)
            for r in (0, 1)
        ),
    )
    np.testing.assert_allclose(
        failures_table(tmp_path, rows)["end_traversability"],
        [0, 0.1, 0.2, 0.3],
        atol=1e-7,
    )


def test_without_steps_there_is_no_place(tmp_path: Path) -> None:
    rows = made.rows(made.row(made.condition(), 0), made.row(made.condition(), 1, None))
    (failure,) = failures_table(tmp_path, rows).to_dict("records")
    assert (failure["map"], failure["outcome"]) == (1, "timeout")
    assert all(
        np.isnan(failure[name])
        for name in ("x_m", "y_m", "end_traversability", "last_traversability")
    )


RATES = {"mean": 2, "var": 5, "cvar": 8}


def recorded(failures: pd.DataFrame) -> list[Recording]:
    """λ̂ is a hundredth of the map; the goal's x is the map."""
    return [
        replace(
            made.recording(1),
            predicted=np.full((40, 60), map_index / 100),
            goal_m=np.array([map_index, map_index]),
            states=np.array([[0.5, 0.1 * map_index], [1, 0.1 * map_index]]),
        )
        for map_index in failures["map"]
    ]


def collected(
    folder: Path, record: Any, steps: bool = True
) -> tuple[Sheets, dict[str, str]]:
    """Ten maps; robots fail on the last ones, and end at x = 1."""
    blind = made.condition("straight", "–", model="–")
    rows = made.rows(
        *(
            [
                made.row(made.condition(risk=r), i, 20.0 if i < n else None)
                for i in range(10)
            ]
            for r, n in RATES.items()
        ),
        (made.row(blind, i, None) for i in range(10)),
    )
    if steps:
        same = {
            "seed": 0,
            "realisation": 0,
            "step": [0, 1],
            "time_s": [0.0, 0.1],
            "x_m": [0.5, 1.0],
        }
        parts = [
            pd.DataFrame(
                {
                    "condition": row["condition"],
                    "map": row["map"],
                    "y_m": 0.1 * row["map"],
                    **same,
                }
            ).assign(traversability=[0.2, np.nan])
            for row in rows.to_dict("records")
        ]
        for place, part in enumerate(parts):
            path = (
                folder
                / "steps"
                / f"condition={part['condition'].iloc[0]}"
                / f"{place}.parquet"
            )
            forge_steps(path, part.drop(columns="condition"))
    summary = made.summary(rows)
    sheets = collect_sheets(summary, failures_table(folder, rows), record)
    return sheets, dict(zip(summary["risk"], summary["condition"], strict=True))


def test_the_best_and_the_worst_that_sees_are_shown(tmp_path: Path) -> None:
    sheets, conditions = collected(tmp_path, recorded)
    ((title, (best, worst)),) = sheets.shown
    assert title == "std"
    assert (best.name, best.total, list(best.failures["map"])) == (
        "MPPI, CVaR",
        2,
        [8, 9],
    )
    assert (worst.name, worst.total, list(worst.failures["map"])) == (
        "MPPI, mean",
        8,
        [2, 3, 4, 5],
    )
    assert sheets.left_out == ""
    for line in (best, worst):
        assert [recording.goal_m[0] for recording in line.recordings] == line.failures[
            "map"
        ].tolist()
    # What was predicted is that of all failures, shown or not.
    assert set(sheets.predicted) == {conditions["cvar"], conditions["mean"]}
    np.testing.assert_allclose(
        sheets.predicted[conditions["mean"]], np.arange(2, 10) / 100
    )


def test_it_is_left_out_with_a_reason(tmp_path: Path) -> None:
    def gone(failures: pd.DataFrame) -> list[Recording]:
        raise BenchnavError("Expected a dataset, got none.")

    sheets, _ = collected(tmp_path, gone)
    assert (sheets.shown, sheets.predicted) == ((), {})
    assert (
        sheets.left_out
        == "a figure of failures is missing: Expected a dataset, got none."
    )
    assert collected(tmp_path, None)[0].left_out == ""


def test_without_steps_there_is_no_sheet(tmp_path: Path) -> None:
    sheets, _ = collected(tmp_path, recorded, steps=False)
    assert sheets.shown == ()
    assert (
        sheets.left_out
        == "there is no figure of failures, since the run stored no steps"
    )
