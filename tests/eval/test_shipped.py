"""The shipped maps and model, as users meet them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

from benchnav.core import rng
from benchnav.core.mixture import TraversabilityMixture
from benchnav.datagen.files.check import find_faults
from benchnav.datagen.files.find import find_dataset
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.run.runner import run_suite
from benchnav.models.base import predict
from benchnav.models.checkpoint_folders import find_checkpoint
from benchnav.models.predictor import load_model
from benchnav.models.quality.measure import evaluate

FEW_SAMPLES = {"mppi": {"samples": 1024}, "astar_mppi": {"mppi": {"samples": 1024}}}


@pytest.mark.parametrize("planner", ["astar_dwa", "astar_mppi", "cl_rrt", "mppi"])
def test_knowing_the_truth_each_planner_succeeds_on_nearly_every_std_map(
    planner: str, tmp_path: Path
) -> None:
    suite = Suite(
        model="oracle",
        planners=({"part": planner, "options": FEW_SAMPLES.get(planner, {})},),
        risks=("mean",),
        scenarios=("std",),
        maps=10,
        record="none",
    )
    for _ in run_suite(suite, tmp_path / "run"):
        pass
    assert pd.read_parquet(tmp_path / "run" / "episodes.parquet")["success"].sum() >= 9


# `straight` with the oracle on the first maps of std, in the world `paper`, seed 0:
# total time, path length, λ̄.
STRAIGHT = [
    (25.1, 21.664, 0.8631),
    (29.0, 21.662, 0.7470),
    (26.4, 21.642, 0.8198),
    (27.9, 21.649, 0.7760),
]


def test_golden_rows_of_the_blind_straight_line(tmp_path: Path) -> None:
    suite = Suite(
        model="oracle",
        planners=("straight",),
        scenarios=("std",),
        maps=4,
        record="steps",
    )
    for _ in run_suite(suite, tmp_path / "run"):
        pass
    rows = pd.read_parquet(tmp_path / "run" / "episodes.parquet")
    measures = rows[["total_time_s", "path_length_m", "traversability"]].to_numpy()
    assert (np.abs(measures - STRAIGHT) < [1e-6, 1e-3, 1e-4]).all()
    assert rows["outcome"].tolist() == ["success"] * 4
    np.testing.assert_allclose(
        measures, [drive_straight(map_index) for map_index in range(4)], atol=1e-3
    )


def drive_straight(map_index: int) -> tuple[float, float, float]:
    """The same episode in a loop of its own: who heads at the goal moves 0.1 λ m a step
    along the line.
    """
    dataset = TerrainDataset(find_dataset("paper-v1"))
    terrain = dataset.terrain("test/std", [map_index])
    places = dataset.read("test/std", [map_index], ["start_m", "goal_m"])
    start, goal = (places[name][0].astype(float) for name in ("start_m", "goal_m"))
    key = rng.stream_key(rng.stream_key(0, "simulation", "test/std"), map_index)
    noise = rng.normal(key, np.zeros(1, np.int64), (1000,))[0]
    direction, place, met = (goal - start) / np.linalg.norm(goal - start), start, []
    while np.linalg.norm(goal - place) >= 1:
        column, row = (place // 0.5).astype(int)
        mean, std = (
            float(t[0, 0, row, column])
            for t in (terrain.truth.means, terrain.truth.stds)
        )
        met.append(float(np.clip(mean + std * noise[len(met)], 0, 1)))
        place = place + 0.1 * met[-1] * direction
    return 0.1 * len(met), 0.1 * sum(met), float(np.mean(met))


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["std", "hg", "hs"])
def test_astar_dwa_never_stalls_under_any_risk_setting(
    scenario: str, tmp_path: Path
) -> None:
    risks = ("cvar", "var", "mean", "single-class")
    suite = Suite(
        planners=("astar_dwa",), risks=risks, scenarios=(scenario,), record="steps"
    )
    for _ in run_suite(suite, tmp_path / "run", jobs=2):
        pass
    rows = pd.read_parquet(tmp_path / "run" / "episodes.parquet")
    assert len(rows) == 4 * 20
    assert (
        not rows["outcome"].isin(["stalled", "planner_failure", "planner_error"]).any()
    )
    assert rows.groupby("risk")["success"].sum().min() >= 19


def test_the_shipped_maps_are_sound_and_of_the_recipe() -> None:
    path = find_dataset("paper-v1")
    assert find_faults(path) == []
    assert {
        name: split["maps"] for name, split in TerrainDataset(path).splits.items()
    } == {
        "test/std": 20,
        "test/hg": 20,
        "test/hs": 20,
    }


def test_the_shipped_model_is_as_good_as_its_readme_says() -> None:
    dataset = TerrainDataset(find_dataset("paper-v1"))
    quality = dict(evaluate(load_model("paper-v1"), dataset))
    assert quality["test/std"].classes[0].accuracy == pytest.approx(0.9950, abs=2e-3)
    assert quality["test/hs"].classes[0].accuracy == pytest.approx(0.5289, abs=1e-2)
    assert quality["test/std"].traversability.coverage == pytest.approx(
        0.8996, abs=5e-3
    )


# `straight` on the first maps of stakes-v1's std, in the world `stakes`, seed 0:
# outcome, path length, λ̄.
IN_STAKES = [
    ("success", 22.050, 0.8856), ("immobilised", 21.588, 0.6276), ("success", 23.739, 0.5395),
    ("immobilised", 1.029, 0.1979), ("success", 20.886, 0.9242), ("immobilised", 17.220, 0.6573),
    ("immobilised", 5.899, 0.5958), ("immobilised", 6.892, 0.5941),
]  # fmt: skip


def test_golden_rows_of_the_blind_straight_line_where_soft_ground_ends_an_episode(
    tmp_path: Path,
) -> None:
    suite = Suite(
        data="stakes-v1", world="stakes", model="oracle", planners=("straight",), scenarios=("std",),
        maps=8, record="steps",
    )  # fmt: skip
    for _ in run_suite(suite, tmp_path / "run"):
        pass
    rows = pd.read_parquet(tmp_path / "run" / "episodes.parquet")
    assert rows["outcome"].tolist() == [outcome for outcome, *_ in IN_STAKES]
    measures = rows[["path_length_m", "traversability"]].to_numpy()
    assert (
        np.abs(measures - [numbers for _, *numbers in IN_STAKES]) < [1e-3, 1e-4]
    ).all()
    driven = [drive_straight_on_frozen_ground(map_index) for map_index in range(8)]
    assert rows["outcome"].tolist() == [outcome for outcome, *_ in driven]
    np.testing.assert_allclose(measures, [numbers for _, *numbers in driven], atol=1e-3)


def drive_straight_on_frozen_ground(map_index: int) -> tuple[str, float, float]:
    """The same episode in a loop of its own, on a field by scipy's filter and root
    finder.
    """
    dataset = TerrainDataset(find_dataset("stakes-v1"))
    terrain = dataset.terrain("test/std", [map_index])
    places = dataset.read(
        "test/std", [map_index], ["start_m", "goal_m", "reference_time_s"]
    )
    start, goal = (places[name][0].astype(float) for name in ("start_m", "goal_m"))
    field = frozen_field(terrain.truth, map_index)
    direction, place, met, held = (
        (goal - start) / np.linalg.norm(goal - start),
        start,
        [],
        0,
    )
    for _ in range(round(3 * float(places["reference_time_s"][0]) / 0.1)):
        column, row = (place // 0.5).astype(int)
        met.append(field(row, column))
        held = held + 1 if met[-1] < 0.1 else 0
        place = place + 0.1 * met[-1] * direction
        outcome = (
            "success"
            if np.linalg.norm(goal - place) < 1
            else "immobilised"
            if held == 20
            else ""
        )
        if outcome:
            return outcome, 0.1 * sum(met), float(np.mean(met))
    return "timeout", 0.1 * sum(met), float(np.mean(met))


def frozen_field(
    truth: TraversabilityMixture, map_index: int
) -> Callable[[int, int], float]:
    """λ of a cell of the first draw, by sums over the white noise and bisection in the
    cell's own CDF.
    """
    key = rng.stream_key(
        rng.stream_key(0, "simulation", "test/std"), map_index, "field", 0
    )
    white = rng.normal(key, np.zeros(1, np.int64), (128, 128))[0]
    away = np.minimum(np.arange(128), 128 - np.arange(128))
    weights, means, stds = (
        t[0].double().numpy() for t in (truth.weights, truth.means, truth.stds)
    )

    def met(row: int, column: int) -> float:
        rows, columns = (
            np.exp(-((np.roll(away, n) / 3.0) ** 2)) for n in (row, column)
        )
        kernel = np.outer(rows, columns)
        share = norm.cdf((kernel * white).sum() / np.sqrt((kernel**2).sum()))
        w, m, s = weights[:, row, column], means[:, row, column], stds[:, row, column]
        found = brentq(
            lambda x: float((w * norm.cdf((x - m) / s)).sum() - share), -3, 4
        )
        return float(np.clip(found, 0, 1))

    return met


def test_the_shipped_model_of_ground_with_stakes() -> None:
    folder = find_checkpoint("stakes-v1")
    assert sum(path.stat().st_size for path in folder.iterdir()) < 8e6
    model, dataset = load_model("stakes-v1"), TerrainDataset(find_dataset("stakes-v1"))
    terrain = dataset.terrain("test/std", range(20))
    predicted, ideal = predict(model, terrain), predict(load_model("ideal"), terrain)
    for found, best, most in (
        (predicted.mean(), ideal.mean(), 0.02),
        (predicted.cvar(0.9), ideal.cvar(0.9), 0.02),
        (1 / predicted.expected_time(0.05), 1 / ideal.expected_time(0.05), 0.02),
        (predicted.chance(0.1), ideal.chance(0.1), 0.02),
    ):
        assert (found - best).abs().mean() < most
    soft = model.table.soft
    for name, terrain_class, weight in zip(
        model.class_names, dataset.recipe.classes, soft.weight, strict=True
    ):
        wanted = terrain_class.soft.weight if terrain_class.soft else 0.0
        assert float(weight) == pytest.approx(wanted, abs=0.005), name
