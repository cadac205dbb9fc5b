"""A stranger's network goes the whole way by commands alone: trained, calibrated,
compared with ours, driven with.
"""

import json
import shutil
from pathlib import Path

import pandas as pd
import pytest

from tests.commands import call

STRANGER = Path(__file__).parent / "data" / "stranger.py"


# each step by itself: tests/models/training/test_own_model.py, tests/test_examples.py
@pytest.mark.slow
def test_from_one_file_of_under_80_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(STRANGER, "stranger.py")
    assert len(STRANGER.read_text().splitlines()) < 80
    small = (
        "id=small",
        "splits.train.maps=8",
        "splits.valid.maps=4",
        "splits.test/std.maps=4",
    )
    splits = ("--splits", "[train,valid,test/std]")
    assert (
        call("datagen", "create", "vegetation-v1", *small, *splits, "--out", "d.h5")
        == 0
    )
    quick = (
        "--data",
        "d.h5",
        "--trainer.max_epochs",
        "2",
        "--settings.batch_size",
        "4",
    )
    fit = ("fit", "stranger.py:Evidential", "--out", "theirs", "--members", "2", *quick)
    assert call("train", *fit) == 0
    assert "pool of 2 networks: temperature" in capfd.readouterr().out
    ours = ("fit", "mean_variance", "--out", "ours", "--settings.encoder_depth", "3")
    assert (
        call(
            "train",
            *ours,
            *quick,
            "--settings.inputs",
            "[rgb, slope_deg, vegetation_m]",
        )
        == 0
    )
    model = "stranger.py:Evidential@theirs"
    assert (
        call("train", "compare", model, "ours", "--data", "d.h5", "--out", "compared")
        == 0
    )
    found = json.loads((tmp_path / "compared" / "compare.json").read_text())
    assert "Evidential" in json.dumps(found)
    drive = (
        "--data",
        "d.h5",
        "--planners",
        "[astar_dwa]",
        "--risks",
        "[cvar:0.9,expected-time]",
    )
    suite = (
        "--maps",
        "2",
        "--record",
        "none",
        "--world.time_budget_s",
        "40",
        "--scenarios",
        "[std]",
    )
    assert call("eval", "run", "--model", model, *drive, *suite, "--out", "run") == 0
    rows = pd.read_parquet(Path("run", "episodes.parquet"))
    assert set(rows["model"]) == {"theirs"}
    assert len(rows) == 4
    assert not rows["outcome"].isin(["model_error", "planner_error"]).any()
