"""The shipped maps and model, as users meet them."""

from pathlib import Path

import pandas as pd
import pytest

from benchnav.datagen.store import TerrainDataset, find_dataset
from benchnav.datagen.validate import find_faults
from benchnav.eval.runner import run_suite
from benchnav.eval.suite import Suite
from benchnav.models.calibration import evaluate
from benchnav.models.predictor import load_model


@pytest.mark.parametrize("planner", ["astar_dwa", "cl_rrt", "mppi"])
def test_knowing_the_truth_each_planner_succeeds_on_nearly_every_std_map(
    planner: str, tmp_path: Path
) -> None:
    suite = Suite(
        model="oracle",
        planners=(planner,),
        risks=("mean",),
        scenarios=("std",),
        planner_options={"mppi": {"samples": 1024}},
        recorded=0,
    )
    for _ in run_suite(suite, tmp_path / "run"):
        pass
    assert pd.read_parquet(tmp_path / "run" / "episodes.parquet")["success"].sum() >= 18


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
