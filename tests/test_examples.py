"""Every example runs as a user runs it, and does what it says."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from benchnav.datagen import TerrainDataset
from benchnav.testing import check_objective, check_planner, check_risk, check_robot

EXAMPLES = Path(__file__).parent.parent / "examples"


def run(folder: Path, command: str, *arguments: object) -> str:
    """Runs a command in a folder and returns what it printed."""
    program = Path(sys.executable).with_name(command)
    done = subprocess.run(
        [program, *map(str, arguments)], cwd=folder, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_model_of_ones_own_is_trained_calibrated_measured_and_driven_with(
    dataset_path: Path, tmp_path: Path
) -> None:
    os.symlink(EXAMPLES / "own_model.py", tmp_path / "own_model.py")
    run(tmp_path, "benchnav-datagen", "create", "tiny-v1", "--out", "tiny.h5")
    quick = ("--settings.batch_size", "2", "--settings.learning_rate", "0.02")
    said = run(
        tmp_path, "benchnav-train", "fit", "own_model.py:CellModel", "--data", "tiny.h5", "--out", "mine",
        "--members", "2", *quick,
    )  # fmt: skip
    assert "pool of 2 networks" in said
    assert len((tmp_path / "own_model.py").read_text().splitlines()) < 60
    model = "own_model.py:CellModel@mine"
    measured = {}
    for name in (model, "oracle"):
        run(tmp_path, "benchnav-train", "evaluate", name, "--data", "tiny.h5", "--json", "q.json")
        measured[name] = json.loads((tmp_path / "q.json").read_text())["splits"]
    dataset = TerrainDataset(tmp_path / "tiny.h5")
    observed = dataset.read("train", fields=["traversability"])["traversability"]
    for split, own in measured[model].items():
        true = dataset.terrain(split).truth.mean()
        constant = float((true - float(observed.mean())).square().mean().sqrt())
        oracle = measured["oracle"][split]
        assert own["rmse_expected"] < 0.7 * constant
        assert oracle["crps"] < own["crps"]
    rows = evaluate(dataset_path, tmp_path, "--model", model, "--planners", "[astar_dwa]")
    assert set(rows["model"]) == {"mine"}
    assert set(rows["outcome"]) <= {"success", "timeout", "stuck", "stalled"}


def evaluate(dataset: Path, folder: Path, *flags: str) -> pd.DataFrame:
    """Runs `benchnav-eval run` with two jobs, as a user does, and gives the rows."""
    command = [
        Path(sys.executable).with_name("benchnav-eval"), "run", "--data", dataset, "--model", "oracle",
        "--maps", "2", "--scenarios", "[std]", "--record", "none", "--jobs", "2", "--out", "run",
        "--world.time_budget_s", "60",
    ]  # fmt: skip
    done = subprocess.run(
        [*map(str, command), *flags], cwd=folder, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return pd.read_parquet(folder / "run" / "episodes.parquet")


def test_a_planner_and_a_risk_measure_of_ones_own_by_file(dataset_path: Path, tmp_path: Path) -> None:
    # Given by a path that begins where the command is run.
    for name in ("own_planner.py", "own_risk.py"):
        os.symlink(EXAMPLES / name, tmp_path / name)
    rows = evaluate(
        dataset_path,
        tmp_path,
        "--planners",
        "[straight,./own_planner.py:Fan]",
        "--risks",
        "[mean,./own_risk.py:worst]",
    )
    cells = rows.groupby(["planner", "risk"]).size()
    assert dict(cells) == {("straight", "–"): 2, ("Fan", "mean"): 2, ("Fan", "worst"): 2}
    assert rows["success"].all()
    check_planner(f"{EXAMPLES / 'own_planner.py'}:Fan")
    for name in ("worst", "cautious"):
        check_risk(f"{EXAMPLES / 'own_risk.py'}:{name}")


def test_a_robot_and_an_objective_of_ones_own_by_file(dataset_path: Path, tmp_path: Path) -> None:
    path = EXAMPLES / "own_robot.py"
    assert len(path.read_text().splitlines()) < 40
    rows = evaluate(
        dataset_path, tmp_path, "--robots", f"[{path}:Tracked]", "--objectives", f"[{path}:Energy]",
        "--planners", "[straight,astar_dwa,{part: mppi, options: {samples: 128}}]", "--risks", "[mean]",
    )  # fmt: skip
    assert set(rows["robot"]) == {"Tracked"}
    assert set(rows["objective"]) == {"Energy"}
    assert rows["success"].all()
    # 0.8 m/s at most.
    assert (rows["path_length_m"] / rows["end_time_s"]).max() < 0.81
    check_robot(f"{path}:Tracked")
    check_objective(f"{path}:Energy", f"{path}:Tracked")


@pytest.mark.parametrize("name", ["own_planner.py", "own_risk.py", "own_robot.py"])
def test_the_command_in_an_examples_docstring_names_what_is_there(name: str) -> None:
    text = (EXAMPLES / name).read_text()
    named = re.findall(r"(examples/\w+\.py):(\w+)", text.split('"""')[1])
    assert named
    for file, part in named:
        assert re.search(rf"^(class|def) {part}\b", (EXAMPLES.parent / file).read_text(), re.MULTILINE)


def test_a_sweep_finds_the_best_of_its_trials(tmp_path: Path) -> None:
    pytest.importorskip("optuna", reason="Optuna, which the example alone needs, is not installed")
    run(tmp_path, "benchnav-datagen", "create", "tiny-v1", "--out", "tiny.h5")
    done = subprocess.run(
        [sys.executable, EXAMPLES / "sweep.py", "tiny.h5", "trials", "3"],
        cwd=tmp_path, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert re.search(r"best: trial \d, validation loss -?\d\.\d+, \{'learning_rate'", done.stdout)
    assert (tmp_path / "trials" / "trial-0" / "config.json").is_file()
