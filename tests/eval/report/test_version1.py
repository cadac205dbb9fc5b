import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from benchnav.eval.report.version1 import convert_about, convert_rows
from tests.eval.report import made

FOLDER = Path(__file__).parent.parent.parent / "data" / "run-1"


def old(**suite: Any) -> tuple[pd.DataFrame, dict[str, Any]]:
    about = json.loads((FOLDER / "run.json").read_text())
    about["suite"] |= suite
    return pd.read_parquet(FOLDER / "episodes.parquet"), about


def test_rows_have_the_columns_of_version_2_and_keep_the_rest() -> None:
    rows, about = old(seed=3)
    before = rows.copy()
    converted = convert_rows(rows, about)
    pd.testing.assert_frame_equal(rows, before)
    assert set(converted.columns) == set(made.row(made.trial()))
    same = [name for name in rows.columns if name != "roughness"]
    pd.testing.assert_frame_equal(converted[same], rows[same])
    assert converted["seed"].tolist() == [3, 3]
    assert converted["trial"].tolist() == ["mppi+mean+std"] * 2


@pytest.mark.parametrize(
    ("suite", "label", "noise"),
    [
        ({"time_budget_s": 100.0}, "paper", "resampled"),
        ({"noise": "frozen", "time_budget_s": 100.0}, "paper noise=stored", "stored"),
        ({"time_budget_s": 12.5}, "paper time_budget_s=12.5", "resampled"),
    ],
)
def test_the_world_is_told_by_todays_names(suite: dict[str, Any], label: str, noise: str) -> None:
    rows, about = old(**suite)
    converted = convert_rows(rows, about)
    assert set(converted["world"]) == {label}
    trials = convert_about(about, converted)["trials"]
    assert set(trials) == set(converted["trial"])
    (trial,) = trials.values()
    assert trial["labels"]["world"] == label
    assert trial["value"]["world"] == {"noise": noise, "time_budget_s": about["suite"]["time_budget_s"]}
