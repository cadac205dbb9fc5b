"""A stranger's network goes the whole way by commands alone: trained, calibrated, compared with ours, driven with."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd

STRANGER = Path(__file__).parent / "data" / "stranger.py"


def run(folder: Path, command: str, *arguments: object) -> str:
    program = Path(sys.executable).with_name(command)
    done = subprocess.run(
        [program, *map(str, arguments)], cwd=folder, capture_output=True, text=True, timeout=400
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_from_one_file_of_under_80_lines(tmp_path: Path) -> None:
    shutil.copy(STRANGER, tmp_path / "stranger.py")
    assert len(STRANGER.read_text().splitlines()) < 80
    small = ("id=small", "splits.train.maps=8", "splits.valid.maps=4", "splits.test/std.maps=4")
    splits = ("--splits", "[train,valid,test/std]")
    run(tmp_path, "benchnav-datagen", "create", "vegetation-v1", *small, *splits, "--out", "d.h5")
    quick = ("--data", "d.h5", "--trainer.max_epochs", "2", "--settings.batch_size", "4")
    fit = ("fit", "stranger.py:Evidential", "--out", "theirs", "--members", "2", *quick)
    said = run(tmp_path, "benchnav-train", *fit)
    assert "pool of 2 networks: temperature" in said
    ours = ("fit", "mean_variance", "--out", "ours", "--settings.encoder_depth", "3")
    run(tmp_path, "benchnav-train", *ours, *quick, "--settings.inputs", "[rgb, slope_deg, vegetation_m]")
    model = "stranger.py:Evidential@theirs"
    run(tmp_path, "benchnav-train", "compare", model, "ours", "--data", "d.h5", "--out", "compared")
    found = json.loads((tmp_path / "compared" / "compare.json").read_text())
    assert "Evidential" in json.dumps(found)
    drive = ("--data", "d.h5", "--planners", "[astar_dwa]", "--risks", "[cvar:0.9,expected-time]")
    suite = ("--maps", "2", "--record", "none", "--world.time_budget_s", "40", "--scenarios", "[std]")
    run(tmp_path, "benchnav-eval", "run", "--model", model, *drive, *suite, "--out", "run")
    rows = pd.read_parquet(tmp_path / "run" / "episodes.parquet")
    assert set(rows["model"]) == {"theirs"}
    assert len(rows) == 4
    assert not rows["outcome"].isin(["model_error", "planner_error"]).any()
