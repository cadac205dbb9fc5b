from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchnav.core.errors import BenchnavError
from benchnav.eval.recording import Recording
from benchnav.eval.report.failures import Sheets, collect_sheets, failures_table
from tests.eval.report import made

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


def collected(folder: Path, record: Any, steps: bool = True) -> tuple[Sheets, dict[str, str]]:
    """Ten maps; robots fail on the last ones, and end at x = 1."""
    blind = made.condition("straight", "–", model="–")
    rows = made.rows(
        *(
            [made.row(made.condition(risk=r), i, 20.0 if i < n else None) for i in range(10)]
            for r, n in RATES.items()
        ),
        (made.row(blind, i, None) for i in range(10)),
    )
    if steps:
        same = {"seed": 0, "realisation": 0, "step": [0, 1], "time_s": [0.0, 0.1], "x_m": [0.5, 1.0]}
        parts = [
            pd.DataFrame(
                {"condition": row["condition"], "map": row["map"], "y_m": 0.1 * row["map"], **same}
            ).assign(traversability=[0.2, np.nan])
            for row in rows.to_dict("records")
        ]
        for place, part in enumerate(parts):
            path = folder / "steps" / f"condition={part['condition'].iloc[0]}" / f"{place}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            part.drop(columns="condition").to_parquet(path, index=False)
    summary = made.summary(rows)
    sheets = collect_sheets(summary, failures_table(folder, rows), record)
    return sheets, dict(zip(summary["risk"], summary["condition"], strict=True))


def test_the_best_and_the_worst_that_sees_are_shown(tmp_path: Path) -> None:
    sheets, conditions = collected(tmp_path, recorded)
    ((title, (best, worst)),) = sheets.shown
    assert title == "std"
    assert (best.name, best.among, list(best.failures["map"])) == ("MPPI, cvar", 2, [8, 9])
    assert (worst.name, worst.among, list(worst.failures["map"])) == ("MPPI, mean", 8, [2, 3, 4, 5])
    assert sheets.left_out == ""
    for line in (best, worst):
        assert [recording.goal_m[0] for recording in line.recordings] == line.failures["map"].tolist()
    # What was predicted is that of all failures, shown or not.
    assert set(sheets.predicted) == {conditions["cvar"], conditions["mean"]}
    np.testing.assert_allclose(sheets.predicted[conditions["mean"]], np.arange(2, 10) / 100)


def test_a_planner_that_is_told_nothing_has_no_sheet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in RATES:  # the blind line, which fails on all, is then as good
        monkeypatch.setitem(RATES, name, 0)
    sheets, conditions = collected(tmp_path, recorded)
    assert conditions["–"] not in sheets.predicted
    assert all("straight" not in line.name for _, lines in sheets.shown for line in lines)


def test_it_is_left_out_with_a_reason(tmp_path: Path) -> None:
    def gone(failures: pd.DataFrame) -> list[Recording]:
        raise BenchnavError("Expected a dataset, got none.")

    sheets, _ = collected(tmp_path, gone)
    assert (sheets.shown, sheets.predicted) == ((), {})
    assert sheets.left_out == "No sheet of failures: Expected a dataset, got none."
    assert collected(tmp_path, None)[0].left_out == ""


def test_without_steps_there_is_no_sheet(tmp_path: Path) -> None:
    sheets, _ = collected(tmp_path, recorded, steps=False)
    assert sheets.shown == ()
    assert sheets.left_out == "No sheet of failures: the run kept no steps of them."
