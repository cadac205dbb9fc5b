"""What recordings tell of the ground, against what robots met on it and against the dataset."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchnav.datagen.latent import SoftSpots
from benchnav.datagen.store import TerrainDataset
from benchnav.eval.recorder import record_episode
from benchnav.eval.report.snapshot import Snapshot
from benchnav.eval.runner import run_suite
from benchnav.eval.suite import Suite
from tests import factories

BELOW, HELD_S, SEEDS, RECORDED = 0.45, 0.4, (3, 4), 3
SOFT = (1, 3, 4)  # classes with soft spots


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recipe = factories.tiny_recipe(train=1, valid=1, test_std=4, test_hg=1, test_hs=1)
    spots = SoftSpots(weight=0.2, mean=0.05, std=0.05)
    classes = tuple(
        replace(item, soft=spots) if number in SOFT else item for number, item in enumerate(recipe.classes)
    )
    recipe = replace(recipe, synthesis=2, classes=classes)
    return factories.tiny_dataset(tmp_path_factory.mktemp("data") / "soft.h5", recipe)


def run(dataset: Path, folder: Path, **changes: Any) -> Path:
    stakes = {"preset": "stakes", "immobile": {"below": BELOW, "for_s": HELD_S}, "time_budget_ratio": 2.0}
    given: dict[str, Any] = {"world": stakes, "instances": 4, "seeds": SEEDS, "recorded": RECORDED} | changes
    suite = Suite(data=str(dataset), scenarios=("std",), model="oracle", planners=("straight",), **given)
    for _ in run_suite(suite, folder):
        pass
    return folder


def snapshots(folder: Path) -> list[Snapshot]:
    return [Snapshot.load(path) for path in sorted((folder / "playback").glob("*.npz"))]


@pytest.fixture(scope="module")
def stakes(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(dataset, tmp_path_factory.mktemp("stakes") / "run")


def cells(snapshot: Snapshot) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns in which a robot stood at each step."""
    column, row = np.floor(snapshot.track[:-1] / 0.5).astype(int).T
    return row, column


def test_a_recorded_field_is_what_the_robot_met_in_its_own_episode(stakes: Path) -> None:
    taken = snapshots(stakes)
    assert len(taken) == RECORDED
    for snapshot in taken:
        assert snapshot.field is not None
        assert snapshot.field.shape == (32, 32)
        np.testing.assert_array_equal(snapshot.field[cells(snapshot)], snapshot.traversability)
    # The others' fields are others.
    for snapshot, other in zip(taken, taken[1:] + taken[:1], strict=True):
        assert not np.array_equal(other.field[cells(snapshot)], snapshot.traversability)  # type: ignore[index]


def test_cells_that_hold_a_robot_are_those_under_the_worlds_own_limit(stakes: Path) -> None:
    ends = []
    for snapshot in snapshots(stakes):
        assert snapshot.field is not None
        np.testing.assert_array_equal(snapshot.holding, snapshot.field < np.float32(BELOW))
        assert snapshot.holding.any()
        held = snapshot.holding[cells(snapshot)]
        last = round(HELD_S / snapshot.dt_s)
        assert held[-last:].all() == (snapshot.about["outcome"] == "immobilised")
        ends.append(snapshot.about["outcome"])
    assert "immobilised" in ends


def test_soft_ground_is_that_of_classes_with_soft_spots_on_the_episodes_own_map(
    dataset: Path, stakes: Path
) -> None:
    assert len(snapshots(stakes)) > 2
    for snapshot in snapshots(stakes):
        classes = TerrainDataset(dataset).read("test/std", [int(snapshot.about["instance"])], ["class_id"])
        np.testing.assert_array_equal(snapshot.soft, np.isin(classes["class_id"][0], SOFT))
        assert 0 < snapshot.soft.mean() < 1


def test_an_episode_that_is_run_again_is_recorded_on_its_own_ground(
    dataset: Path, stakes: Path, tmp_path: Path
) -> None:
    folder = run(dataset, tmp_path / "run", recorded=0)
    record_episode(folder, {}, SEEDS[0], 0, 1)
    (again,) = snapshots(folder)
    (first,) = [s for s in snapshots(stakes) if s.about["instance"] == "1"]
    for name in ("field", "soft", "holding", "track"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    record_episode(folder, {}, SEEDS[1], 0, 1)
    (other,) = [s for s in snapshots(folder) if s.about["seed"] == str(SEEDS[1])]
    assert not np.array_equal(other.field, again.field)  # type: ignore[arg-type]
    np.testing.assert_array_equal(other.field[cells(other)], other.traversability)  # type: ignore[index]


@pytest.mark.parametrize(
    ("world", "stays"),
    [("paper", False), ({"noise": "stored"}, True), ({"preset": "stakes", "immobile": None}, True)],
)
def test_where_nothing_holds_a_robot_no_cell_does(
    world: Any, stays: bool, dataset: Path, tmp_path: Path
) -> None:
    recorded = snapshots(run(dataset, tmp_path / "run", world=world, seeds=(), recorded=1))
    assert recorded
    for snapshot in recorded:
        assert (snapshot.field is not None) == stays
        assert not snapshot.holding.any()
        assert snapshot.soft.any()


def test_ground_without_soft_spots_is_not_soft(dataset_path: Path, tmp_path: Path) -> None:
    (snapshot,) = snapshots(
        run(dataset_path, tmp_path / "run", world="paper", seeds=(), instances=2, recorded=1)
    )
    assert snapshot.soft.shape == (32, 32)
    assert not snapshot.soft.any()
