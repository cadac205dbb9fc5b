"""Recipes, weights, predictions and rows are those of version 1.3, bit for bit."""

import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import yaml

from tests.commands import call
from tests.golden import rows, values

STORED = json.loads(values.STORED.read_text())
ROWS = json.loads(rows.STORED.read_text())

# A few conditions of each suite of rows, of planners whose bits depend neither on the
# number of maps of a batch nor on whether they are compiled.
CONDITIONS: dict[str, dict[str, Any]] = {
    "paper": {
        "model": "paper-v1",
        "planners": ["straight", "astar_dwa"],
        "risks": ["cvar", "mean"],
    },
    "risk": {
        "model": "stakes-v1",
        "world": "stakes",
        "objectives": ["travel_time"],
        "realisations": 3,
        "planners": ["straight", "astar_dwa"],
        "risks": ["cvar:0.9"],
    },
    "knowledge": {
        "model": "oracle",
        "world": "stakes",
        "objectives": ["travel_time"],
        "realisations": 2,
        "seed": 2026,
        "planners": ["astar_dwa"],
        "risks": ["expected-time"],
        "grounds": ["contact"],
        "beliefs": ["copula"],
    },
}
# Maps that are generated; those of `paper` are shipped.
DATA = {"risk": "stakes-v1", "knowledge": "stakes-v1-400-seed2026"}


@pytest.mark.parametrize(
    ("kind", "compute"),
    [
        ("recipes", values.recipe_digests),
        ("weights", values.weight_digests),
        ("predictions", values.prediction_digests),
    ],
)
def test_digests_stay(kind: str, compute: object) -> None:
    if kind == "predictions" and STORED["machine"] != rows.machine():
        pytest.skip(
            f"predictions were frozen on {STORED['machine']}, this is {rows.machine()}"
        )
    assert compute() == STORED[kind]  # type: ignore[operator]


@pytest.mark.skipif(
    ROWS["machine"] != rows.machine(),
    reason=f"rows were frozen on {ROWS['machine']}, this is {rows.machine()}",
)
@pytest.mark.parametrize("name", CONDITIONS)
def test_rows_of_the_first_maps_stay(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    data = "paper-v1"
    if name in DATA:
        data = "maps.h5"
        words = [
            word for word in rows.DATASETS[DATA[name]] if not word.startswith("splits")
        ]
        words += [f"splits.test/std.maps={rows.FIRST_MAPS}", "--splits", "[test/std]"]
        assert call("datagen", "create", *words, "--out", data) == 0
    suite = {
        "data": data,
        "scenarios": ["std"],
        "maps": rows.FIRST_MAPS,
        "record": "none",
    }
    Path("suite.yaml").write_text(yaml.safe_dump(suite | CONDITIONS[name]))
    assert call("eval", "run", "--config", "suite.yaml", "--out", "run") == 0
    episodes = pd.read_parquet("run/episodes.parquet")
    lines = rows.differences(ROWS["suites"][name], episodes, first_maps=True)
    # Scores of beliefs are sums over a batch, whose rounding depends on its size.
    assert [line for line in lines if " ahead_" not in line] == []
