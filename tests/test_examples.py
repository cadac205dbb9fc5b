"""Every example runs as a user runs it, and does what it says."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from benchnav.testing import check_objective, check_planner, check_risk, check_robot

EXAMPLES = Path(__file__).parent.parent / "examples"


def run(name: str, folder: Path) -> str:
    """Runs an example in an empty folder and returns what it printed."""
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / name)], cwd=folder, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert list(folder.iterdir()) == []
    return done.stdout


def test_a_model_of_ones_own_beats_a_constant_and_the_oracle_beats_both(tmp_path: Path) -> None:
    lines = run("own_model.py", tmp_path).splitlines()
    assert lines[:2] == ["saved a checkpoint of 'pixel'", "kept the contract"]
    assert lines[2].split() == ["model", "split", "RMSE", "E[λ]", "NLL", "CRPS"]
    rows = {tuple(line.split()[:2]): [float(value) for value in line.split()[2:]] for line in lines[3:]}
    for split in ("test/std", "test/hg", "test/hs"):
        constant, own, oracle = (rows[model, split] for model in ("constant", "own", "oracle"))
        assert own[0] < 0.75 * constant[0]
        assert own[1] < constant[1] - 0.1
        assert all(best < better < worse for best, better, worse in zip(oracle, own, constant, strict=True))


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
    assert "Fan" in done.stdout or "–" in done.stdout
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
