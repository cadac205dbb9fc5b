"""The shipped maps and model, as users meet them."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchnav import rng
from benchnav.datagen.store import TerrainDataset, find_dataset
from benchnav.datagen.validate import find_faults
from benchnav.eval.runner import run_suite
from benchnav.eval.suite import Suite
from benchnav.models.calibration import evaluate
from benchnav.models.predictor import load_model


@pytest.mark.parametrize("planner", ["astar_dwa", "astar_mppi", "cl_rrt", "mppi"])
def test_knowing_the_truth_each_planner_succeeds_on_nearly_every_std_map(
    planner: str, tmp_path: Path
) -> None:
    suite = Suite(
        model="oracle",
        planners=(planner,),
        risks=("mean",),
        scenarios=("std",),
        planner_options={"mppi": {"samples": 1024}} if planner == "mppi" else {},
        recorded=0,
    )
    for _ in run_suite(suite, tmp_path / "run"):
        pass
    assert pd.read_parquet(tmp_path / "run" / "episodes.parquet")["success"].sum() >= 18


# `straight` with the oracle on the first maps of std, in the world `paper`, seed 0: total time, path length, λ̄.
STRAIGHT = [(25.1, 21.664, 0.8631), (29.0, 21.662, 0.7470), (26.4, 21.642, 0.8198), (27.9, 21.649, 0.7760)]


def test_golden_rows_of_the_blind_straight_line(tmp_path: Path) -> None:
    suite = Suite(model="oracle", planners=("straight",), scenarios=("std",), instances=4, recorded=0)
    for _ in run_suite(suite, tmp_path / "run"):
        pass
    rows = pd.read_parquet(tmp_path / "run" / "episodes.parquet")
    measures = rows[["total_time_s", "path_length_m", "traversability"]].to_numpy()
    assert (np.abs(measures - STRAIGHT) < [1e-6, 1e-3, 1e-4]).all()
    assert rows["outcome"].tolist() == ["success"] * 4
    np.testing.assert_allclose(measures, [drive_straight(instance) for instance in range(4)], atol=1e-3)


def drive_straight(instance: int) -> tuple[float, float, float]:
    """The same episode in a loop of its own: who heads at the goal moves 0.1 λ m a step along the line."""
    dataset = TerrainDataset(find_dataset("paper-v1"))
    terrain = dataset.terrain("test/std", [instance])
    places = dataset.read("test/std", [instance], ["start_m", "goal_m"])
    start, goal = (places[name][0].astype(float) for name in ("start_m", "goal_m"))
    key = rng.stream_key(rng.stream_key(0, "simulation", "test/std"), instance)
    luck = rng.normal(key, np.zeros(1, np.int64), (1000,))[0]
    direction, place, met = (goal - start) / np.linalg.norm(goal - start), start, []
    while np.linalg.norm(goal - place) >= 1:
        column, row = (place // 0.5).astype(int)
        mean, std = (float(t[0, 0, row, column]) for t in (terrain.truth.means, terrain.truth.stds))
        met.append(float(np.clip(mean + std * luck[len(met)], 0, 1)))
        place = place + 0.1 * met[-1] * direction
    return 0.1 * len(met), 0.1 * sum(met), float(np.mean(met))


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["std", "hg", "hs"])
def test_astar_dwa_never_stalls_under_any_risk_setting(scenario: str, tmp_path: Path) -> None:
    suite = Suite(planners=("astar_dwa",), scenarios=(scenario,), recorded=0)
    for _ in run_suite(suite, tmp_path / "run", jobs=2):
        pass
    rows = pd.read_parquet(tmp_path / "run" / "episodes.parquet")
    assert len(rows) == 4 * 20
    assert not rows["outcome"].isin(["stalled", "planner_failure", "planner_error"]).any()
    assert rows.groupby("risk")["success"].sum().min() >= 19


def test_the_shipped_maps_are_sound_and_of_the_recipe() -> None:
    path = find_dataset("paper-v1")
    assert find_faults(path) == []
    assert {name: split["maps"] for name, split in TerrainDataset(path).splits.items()} == {
        "test/std": 20,
        "test/hg": 20,
        "test/hs": 20,
    }


def test_the_shipped_model_is_as_good_as_its_readme_says() -> None:
    dataset = TerrainDataset(find_dataset("paper-v1"))
    quality = dict(evaluate(load_model("paper-v1"), dataset))
    assert quality["test/std"].classes[0].accuracy == pytest.approx(0.9950, abs=2e-3)
    assert quality["test/hs"].classes[0].accuracy == pytest.approx(0.5289, abs=1e-2)
    assert quality["test/std"].traversability.coverage == pytest.approx(0.8996, abs=5e-3)
