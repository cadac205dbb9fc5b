"""Suites of robots with a footprint, in several worlds."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from benchnav.eval.experiment.condition import Condition, conditions_of
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.run.check import check_suite
from benchnav.eval.run.knowledge import KnowledgeTracker
from benchnav.eval.run.runner import run_suite
from benchnav.eval.run.unit import Settings, UnitInputs, build, read_block, simulate
from benchnav.eval.stats.pairs import drawn_field
from benchnav.planning.footprint import minimum_over_footprint
from benchnav.planning.robots import SkidSteer
from benchnav.planning.sensing.sensor import Contact
from benchnav.planning.world.realisation import are_connected
from benchnav.planning.world.simulation import Simulation
from benchnav.planning.world.tracks import TrackSimulation

ROBOTS = (
    "unicycle",
    {"part": "skid_steer", "label": "wide", "options": {"track_m": 0.7}},
)
KINEMATIC = {"preset": "stakes", "time_budget_s": 20.0}
WORLDS = (KINEMATIC, KINEMATIC | {"backend": "tracks"})
RADIUS_M = SkidSteer(track_m=0.7).footprint.radius_m


def suite_of(dataset_path: Path, **changes: object) -> Suite:
    options: dict[str, object] = {
        "data": str(dataset_path),
        "scenarios": ("std",),
        "model": "oracle",
        "planners": ("straight",),
        "robots": ROBOTS,
        "world": WORLDS,
        "maps": 2,
    }
    return Suite(**(options | changes))  # type: ignore[arg-type]


def inputs_of(condition: Condition) -> UnitInputs:
    unit = Unit(condition=condition, seed=0, realisation=0, maps=(0, 1))
    return build(unit, Settings().origins().of(unit))


@pytest.fixture(scope="module")
def conditions(dataset_path: Path) -> list[Condition]:
    checked = check_suite(suite_of(dataset_path), uses_workers=False)
    return [condition for condition, _ in checked.conditions.values()]


def test_a_point_is_left_out_where_sides_slip_apart(dataset_path: Path) -> None:
    checked = check_suite(suite_of(dataset_path), uses_workers=False)
    (dropped,) = checked.dropped
    assert dropped["robot"] == "unicycle"
    assert "backend=tracks" in dropped["world"]
    assert "a robot with a footprint, such as skid_steer" in dropped["reason"]
    assert len(checked.conditions) == 3


def test_a_point_that_is_not_inflated_is_left_out(dataset_path: Path) -> None:
    suite = suite_of(
        dataset_path, world=(KINEMATIC,), task={"inflation": ["disc", "none"]}
    )
    checked = check_suite(suite, uses_workers=False)
    (dropped,) = checked.dropped
    assert dropped["robot"] == "unicycle"
    assert "a robot with a footprint for `task.inflation` 'none'" in dropped["reason"]
    assert len(checked.conditions) == 3


def test_all_conditions_have_the_fields_of_the_largest_footprint(
    conditions: list[Condition],
) -> None:
    kinds = {TrackSimulation: 0, Simulation: 0}
    first = inputs_of(conditions[0])
    field = first.simulation.field
    assert field is not None
    for condition in conditions:
        assert condition.world.clearance_m == pytest.approx(RADIUS_M)
        assert "clearance_m=0.43" in condition.world_label
        inputs = inputs_of(condition)
        kinds[type(inputs.simulation)] += 1
        assert torch.equal(inputs.simulation.field, field)
        assert torch.equal(inputs.problem.start, first.problem.start)
        assert torch.equal(
            inputs.simulation.time_budget_s, first.simulation.time_budget_s
        )
    assert kinds == {TrackSimulation: 1, Simulation: 2}


def test_the_clearance_is_that_of_the_largest_footprint(dataset_path: Path) -> None:
    robots = (*ROBOTS, "skid_steer")
    conditions = conditions_of(suite_of(dataset_path, robots=robots))
    for condition in conditions:
        assert condition.world.clearance_m == pytest.approx(RADIUS_M)
    clearances = {"clearance_m": 0.6}
    worlds = tuple(world | clearances for world in WORLDS)
    for condition in conditions_of(suite_of(dataset_path, world=worlds)):
        assert condition.world.clearance_m == 0.6
    for condition in conditions_of(
        suite_of(dataset_path, task={"inflation": "none", "goal_radius_m": 1.5})
    ):
        # Changes of rules come last, so that worlds are compared without them.
        assert condition.world_label.endswith(
            " clearance_m=0.43 goal_radius_m=1.5 inflation=none"
        )
    assert drawn_field(conditions[0].value["world"])["clearance_m"] == RADIUS_M
    paper = conditions_of(suite_of(dataset_path, world=("paper",)))
    assert {condition.world.clearance_m for condition in paper} == {None}


def test_accepted_draws_have_a_way_for_the_footprint(
    conditions: list[Condition], dataset_path: Path
) -> None:
    below = 0.5  # so that a way is rare
    strict = {**KINEMATIC, "immobile": {"below": below}}
    wide, *_ = conditions_of(suite_of(dataset_path, world=(strict,)))
    inputs = inputs_of(wide)
    field = inputs.simulation.field
    assert field is not None
    grid = inputs.problem.grid
    is_firm = minimum_over_footprint(field >= below, grid, RADIUS_M)
    unit = Unit(condition=wide, seed=0, realisation=0, maps=(0, 1))
    endpoints = read_block(unit, Settings().origins().of(unit)).endpoints
    assert bool(are_connected(is_firm, grid, endpoints).all())
    point = suite_of(dataset_path, robots=("unicycle",), world=(strict,))
    (narrow,) = conditions_of(point)
    fewer = inputs_of(narrow).simulation.attempts
    assert bool((inputs.simulation.attempts > fewer).any())


def test_a_shifted_start_changes_start_and_samples_only(dataset_path: Path) -> None:
    shifted = KINEMATIC | {"start_shift_m": 0.01}
    suite = suite_of(
        dataset_path,
        robots=("unicycle",),
        world=(KINEMATIC, shifted),
        planners=("mppi",),
    )
    first, second = (
        condition for condition in conditions_of(suite) if condition.risk.part == "mean"
    )
    assert "start_shift_m=0.01" in second.world_label
    one, other = inputs_of(first), inputs_of(second)
    moved = other.problem.start[:, :2] - one.problem.start[:, :2]
    assert torch.allclose(moved, torch.tensor([0.01, 0.0]), atol=1e-6)
    field = one.simulation.field
    assert field is not None
    assert torch.equal(other.simulation.field, field)
    assert torch.equal(other.simulation.steps, one.simulation.steps)
    keys: list[int] = []

    def note(*arguments: Any, **options: object) -> None:
        keys.append(arguments[3].initial_seed())
        raise KeyboardInterrupt

    for condition, inputs in ((first, one), (second, other)):
        unit = Unit(condition=condition, seed=0, realisation=0, maps=(0, 1))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("benchnav.eval.run.unit.run_episodes", note)
            with pytest.raises(KeyboardInterrupt):
                simulate(unit, inputs, Settings())
    assert keys[0] != keys[1]


def test_point_robots_alone_have_the_ids_of_before(dataset_path: Path) -> None:
    (condition,) = conditions_of(
        suite_of(dataset_path, robots=("unicycle",), world=(KINEMATIC,))
    )
    world = condition.value["world"]
    assert "clearance_m" not in world
    assert "backend" not in world
    assert "inflation" not in condition.value["rules"]


def test_updated_maps_are_inflated(dataset_path: Path) -> None:
    suite = suite_of(
        dataset_path,
        planners=("astar_dwa",),
        robots=("skid_steer",),
        sensors=("near",),
        beliefs=("copula",),
        world=(KINEMATIC,),
        risks=("mean",),
    )
    (condition,) = conditions_of(suite)
    inputs = inputs_of(condition)
    learning = inputs.learning
    assert learning is not None
    assert learning.learner.ground == Contact().mounted(SkidSteer())
    tracker = KnowledgeTracker(learning, inputs.problem)
    state = inputs.problem.start.clone()
    state[:, :2] += 3.0  # far enough to see new terrain
    updated = tracker.learn(5, state, torch.ones(2, dtype=torch.bool))
    assert updated is not None
    raw = tracker.known
    radius_m = SkidSteer().footprint.radius_m
    expected = minimum_over_footprint(raw.risk_map, updated.grid, radius_m)
    assert not torch.equal(expected, raw.risk_map)
    assert torch.equal(updated.risk_map, expected)
    is_free = minimum_over_footprint(raw.free, updated.grid, radius_m)
    assert torch.equal(updated.free, is_free | tracker._at_goal)
    (known_map,) = tracker.maps_of(5, [1]).values()
    assert np.array_equal(known_map.predicted, expected[1].numpy())
    assert np.array_equal(known_map.free, updated.free[1].numpy())


def test_a_run_has_rows_of_each_world(dataset_path: Path, tmp_path: Path) -> None:
    suite = suite_of(dataset_path, record="none")
    for _ in run_suite(suite, tmp_path / "run", jobs=1):
        pass
    rows = pd.read_parquet(tmp_path / "run" / "episodes.parquet")
    assert rows.groupby(["robot", "world"]).size().tolist() == [2, 2, 2]
    assert set(rows["robot"]) == {"unicycle", "wide"}
