"""Every example runs as a user runs it, and does what it says."""

import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchnav.datagen import TerrainDataset
from benchnav.testing import check_objective, check_planner, check_risk, check_robot
from tests.commands import call

EXAMPLES = Path(__file__).parent.parent / "examples"


def test_a_model_of_ones_own_is_trained_calibrated_measured_and_driven_with(
    dataset_path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    os.symlink(EXAMPLES / "own_model.py", tmp_path / "own_model.py")
    assert call("datagen", "create", "tiny-v1", "--out", "tiny.h5") == 0
    quick = (
        "--settings.batch_size",
        2,
        "--settings.learning_rate",
        0.02,
        "--trainer.precision",
        "32-true",
        "--trainer.max_epochs",
        10,
    )
    fit = (
        "fit",
        "own_model.py:CellModel",
        "--data",
        "tiny.h5",
        "--out",
        "mine",
        "--members",
        2,
        *quick,
    )
    assert call("train", *fit) == 0
    assert "pool of 2 networks" in capfd.readouterr().out
    assert len((tmp_path / "own_model.py").read_text().splitlines()) < 70
    model = "own_model.py:CellModel@mine"
    measured = {}
    for name in (model, "oracle"):
        assert (
            call("train", "evaluate", name, "--data", "tiny.h5", "--json", "q.json")
            == 0
        )
        measured[name] = json.loads((tmp_path / "q.json").read_text())["splits"]
    dataset = TerrainDataset(tmp_path / "tiny.h5")
    observed = dataset.read("train", fields=["traversability"])["traversability"]
    for split, own in measured[model].items():
        true = dataset.terrain(split).truth.mean()
        constant = float((true - float(observed.mean())).square().mean().sqrt())
        oracle = measured["oracle"][split]
        assert own["rmse_expected"] < 0.8 * constant
        assert oracle["crps"] < own["crps"]
    rows = evaluate(
        dataset_path, tmp_path, "--model", model, "--planners", "[astar_dwa]"
    )
    assert set(rows["model"]) == {"mine"}
    assert set(rows["outcome"]) <= {"success", "timeout", "stuck", "stalled"}


@pytest.mark.slow
def test_a_site_of_ones_own_goes_from_drives_to_a_suite(tmp_path: Path) -> None:
    pytest.importorskip("rasterio")
    done = subprocess.run(
        [sys.executable, EXAMPLES / "own_site.py", tmp_path],
        capture_output=True,
        text=True,
        timeout=900,
    )
    said = done.stdout
    assert done.returncode == 0, done.stderr
    assert "rows of drives.csv.gz were used" in said
    assert "against measured λ" in said
    table = re.search(r"^site +A\*\+DWA +CVaR₀.₈ +\d+", said, re.MULTILINE)
    assert table, said


def test_what_robots_log_on_a_site_is_its_ground(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rasterio")
    site = runpy.run_path(str(EXAMPLES / "own_site.py"))
    terrain = site["survey"](tmp_path)
    log = site["drive"](terrain)
    log.to_csv(tmp_path / "drives.csv", index=False)
    rasters = "--dem dem.tif --photo photo.tif --recipe stakes-v1 --splits train:1"
    site["command"](
        f"benchnav-datagen import-drives drives.csv {rasters} --out site.h5",
        tmp_path,
        *site["MAPS"],
    )
    dataset = TerrainDataset(tmp_path / "site.h5")
    assert dataset.truth_of("train") == "unknown"
    source, maps = dataset.splits["train"]["parts"][0]["source"], dataset.read("train")
    west, south = (np.array(source["origin_m"]) - [site["WEST"], site["SOUTH"]]) / site[
        "CELL"
    ]
    ground = terrain.traversability[0].numpy()
    errors = []
    for place, number in enumerate(source["kept"]):
        row, column = divmod(number, source["tiles"][1])
        at_y, at_x = round(south) + 48 * row, round(west) + 48 * column
        own = ground[at_y : at_y + 48, at_x : at_x + 48]
        often = maps["drive_count"][place] >= 3
        errors.append((maps["traversability"][place] - own)[often])
    errors = np.concatenate(errors)
    assert len(errors) > 1000
    # Noise of 0.02 m/s beside 1 m/s, more near a goal, where the robot is slow.
    assert np.abs(np.median(errors)) < 0.005
    assert np.quantile(np.abs(errors), 0.95) < 0.05


ODOMETRY = """
from types import SimpleNamespace as Some
class Stores: ROS2_HUMBLE = 0
def get_typestore(store): pass
class AnyReader:
    types = {"/odom": "nav_msgs/msg/Odometry", "/cmd_vel": "geometry_msgs/msg/Twist", "/imu": "sensor_msgs/msg/Imu"}
    connections = [Some(topic=topic, msgtype=kind) for topic, kind in types.items()]
    def __init__(self, paths, default_typestore): pass
    def __enter__(self): return self
    def __exit__(self, *error): pass
    def messages(self, connections):
        odom, told, _ = self.connections
        assert [one.topic for one in connections] == ["/odom", "/cmd_vel"]
        for step in range(12):
            if step in (1, 3):
                yield told, 10**9 * (100 + step / 10), step
            yield odom, 10**9 * (100 + step / 10), step
    def deserialize(self, step, kind):
        linear = Some(linear=Some(x=step / 2))
        if kind == self.types["/cmd_vel"]:
            return linear
        return Some(pose=Some(pose=Some(position=Some(x=1.0 * step, y=2.0))), twist=Some(twist=linear))
"""


def test_a_bag_becomes_a_log_of_drives(tmp_path: Path) -> None:
    """With a stand-in for the package that reads bags, which is none of ours."""

    def read_bag(*words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, str(EXAMPLES / "read_bag.py"), "one.bag", *words]
        here = os.environ | {"PYTHONPATH": str(tmp_path)}
        return subprocess.run(
            command, cwd=tmp_path, capture_output=True, text=True, timeout=100, env=here
        )

    (tmp_path / "rosbags").mkdir()
    (tmp_path / "rosbags" / "__init__.py").write_text("")
    assert "pip install rosbags" in read_bag().stderr
    for name in ("highlevel", "typesys"):
        (tmp_path / "rosbags" / f"{name}.py").write_text(ODOMETRY)
    assert "Expected an existing bag, got one.bag" in read_bag().stderr
    (tmp_path / "one.bag").touch()
    has = "; the bag has /cmd_vel (geometry_msgs/msg/Twist), /imu (sensor_msgs/msg/Imu), /odom "
    for option, expected in (
        ("--odometry", "nav_msgs/msg/Odometry"),
        ("--command", "geometry_msgs/msg/Twist or"),
    ):
        for topic, kind in (("/no", "none"), ("/imu", "sensor_msgs/msg/Imu")):
            said = read_bag(option, topic).stderr
            assert f"Expected topic {topic} of type {expected}" in said
            assert f"got {kind}. Pass {option} TOPIC{has}" in said
            assert len(said.splitlines()) == 1
    done = read_bag("--origin", "500", "200", "90")
    assert "12 rows, 4 without a command" in done.stdout, done.stderr
    rows = pd.read_csv(tmp_path / "drives.csv")
    assert list(rows) == [
        "time_s",
        "x_m",
        "y_m",
        "measured_m_s",
        "commanded_m_s",
        "drive",
    ]
    np.testing.assert_allclose(rows["time_s"], np.arange(12) / 10)
    np.testing.assert_allclose(rows["x_m"], 498)
    np.testing.assert_allclose(rows["y_m"], 200 + np.arange(12))
    np.testing.assert_allclose(rows["measured_m_s"], np.arange(12) / 2)
    # From the command on, for half a second.
    wanted = [np.nan, 0.5, 0.5, *[1.5] * 6, *[np.nan] * 3]
    np.testing.assert_allclose(rows["commanded_m_s"], wanted)


def evaluate(dataset: Path, folder: Path, *flags: str) -> pd.DataFrame:
    """Run `benchnav-eval run` in this process and return the rows."""
    words = [
        "run", "--data", str(dataset), "--model", "oracle", "--maps", "2", "--scenarios", "[std]", "--record", "none",
        "--out", str(folder / "run"), "--world.time_budget_s", "60", *flags,
    ]  # fmt: skip
    assert call("eval", *words) == 0
    return pd.read_parquet(folder / "run" / "episodes.parquet")


def test_a_planner_and_a_risk_measure_of_ones_own_by_file(
    dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Given by a path that begins where the command is run.
    for name in ("own_planner.py", "own_risk.py"):
        os.symlink(EXAMPLES / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    rows = evaluate(
        dataset_path,
        tmp_path,
        "--planners",
        "[straight,./own_planner.py:Fan]",
        "--risks",
        "[mean,./own_risk.py:worst]",
    )
    cells = rows.groupby(["planner", "risk"]).size()
    assert dict(cells) == {
        ("straight", "–"): 2,
        ("Fan", "mean"): 2,
        ("Fan", "worst"): 2,
    }
    assert rows["success"].all()
    check_planner(f"{EXAMPLES / 'own_planner.py'}:Fan")
    for name in ("worst", "cautious"):
        check_risk(f"{EXAMPLES / 'own_risk.py'}:{name}")


def test_a_robot_and_an_objective_of_ones_own_by_file(
    dataset_path: Path, tmp_path: Path
) -> None:
    path = EXAMPLES / "own_robot.py"
    assert len(path.read_text().splitlines()) < 45
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
        assert re.search(
            rf"^(class|def) {part}\b",
            (EXAMPLES.parent / file).read_text(),
            re.MULTILINE,
        )


def test_a_sweep_finds_the_best_of_its_trials(tmp_path: Path) -> None:
    pytest.importorskip(
        "optuna", reason="Optuna, which the example alone needs, is not installed"
    )
    assert call("datagen", "create", "tiny-v1", "--out", tmp_path / "tiny.h5") == 0
    done = subprocess.run(
        [sys.executable, EXAMPLES / "sweep.py", "tiny.h5", "trials", "3"],
        cwd=tmp_path, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert re.search(
        r"best Optuna trial: \d, validation loss -?\d\.\d+, \{'learning_rate'",
        done.stdout,
    )
    assert (tmp_path / "trials" / "trial-0" / "config.json").is_file()
