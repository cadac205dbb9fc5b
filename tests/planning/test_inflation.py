"""Problems, sensors and draws of robots with a footprint."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from benchnav.core.grid import Grid
from benchnav.planning.footprint import minimum_over_footprint
from benchnav.planning.free_space import FreeSpace, Rules, cells_at_goal
from benchnav.planning.problem import Prediction, Problem, pose_problem
from benchnav.planning.robots import Ackermann, SkidSteer, Unicycle
from benchnav.planning.sensing.sensor import Contact, NoiseKey, Probe
from tests import factories

ROBOT = SkidSteer(track_m=0.5, wheelbase_m=0.5)
GRID = Grid(16, 16, 0.5)
RULES = Rules(free_space=FreeSpace(by="mean", above=0.1), min_traversability=0.05)


def problem_of(robot: Any, rules: Rules = RULES) -> Problem:
    """A problem whose λ̂ of the risk setting and whose means differ."""
    generator = torch.Generator().manual_seed(0)
    means, risk_map = torch.rand(2, 2, 16, 16, generator=generator)
    base = factories.problem(means, robot=robot, rules=rules)
    distribution = factories.certain(means)
    prediction = Prediction(base.observation, distribution, risk_map, fields=Drawn())
    start_m = base.start[:, :2]
    return pose_problem(base.task, prediction, start_m, base.goal_m, 60.0)


class Drawn:
    """Fields that are defined only in the requested cells."""

    def sample(self, count: int, key: int, cells: Tensor | None = None) -> Tensor:
        generator = torch.Generator().manual_seed(key)
        fields = torch.rand(2, count, 16, 16, generator=generator)
        if cells is None:
            return fields
        return fields.masked_fill(~cells[:, None], -1.0)

    def select(self, members: Tensor) -> "Drawn":
        return self


def test_a_problem_has_the_minimum_over_the_footprint() -> None:
    point = problem_of(Unicycle())
    inflated = problem_of(ROBOT)
    radius_m = ROBOT.footprint.radius_m
    expected = minimum_over_footprint(point.risk_map, GRID, radius_m)
    assert torch.equal(inflated.risk_map, expected)
    means = point.distribution.mean()
    is_free = minimum_over_footprint(means, GRID, radius_m) > 0.1
    at_goal = cells_at_goal(GRID, point.goal_m, RULES.goal_radius_m)
    assert torch.equal(inflated.free, is_free | at_goal)
    assert torch.equal(inflated.distribution.mean(), means)


def test_planners_can_plan_for_a_point() -> None:
    point = problem_of(Unicycle())
    chosen = problem_of(ROBOT, replace(RULES, inflation="none"))
    assert torch.equal(chosen.risk_map, point.risk_map)
    assert torch.equal(chosen.free, point.free)
    assert torch.equal(chosen.sample_fields(3, 5), point.sample_fields(3, 5))


def test_drawn_fields_are_inflated_also_at_the_edge_of_the_needed_cells() -> None:
    point = problem_of(Unicycle())
    inflated = problem_of(ROBOT)
    radius_m = ROBOT.footprint.radius_m
    expected = minimum_over_footprint(point.sample_fields(3, 5), GRID, radius_m)
    assert torch.equal(inflated.sample_fields(3, 5), expected)
    needed = torch.zeros(2, 16, 16, dtype=torch.bool)
    needed[0, 3:6, 4:9] = True
    needed[1, 0, 15] = True
    fields = inflated.sample_fields(3, 5, needed)
    is_needed = needed[:, None].expand_as(fields)
    assert torch.equal(fields[is_needed], expected[is_needed])


@pytest.mark.parametrize(
    ("robot", "columns", "columns_at_edge"),
    [
        (Unicycle(), [4], [0]),
        (SkidSteer(track_m=1.0, wheelbase_m=2.0), [2, 6], [2]),
        (Ackermann(track_m=1.0, wheelbase_m=2.0), [4, 8], [0, 4]),
    ],
)
def test_the_contact_sensor_measures_what_the_contacts_meet(
    robot: Any, columns: list[int], columns_at_edge: list[int]
) -> None:
    field = torch.rand(1, 16, 16)
    terrain = factories.terrain(field)
    state = torch.tensor([[2.25, 2.25, 0.0]])  # the centre of cell (4, 4), facing +x
    sensor = Contact().mounted(robot)
    measured = sensor.sense(terrain, field, state, NoiseKey((0,), 0))
    rows = [4] if len(columns) == 1 else [3, 5]
    cells = [[row, column] for row in rows for column in columns]
    assert measured.mask[0].nonzero().tolist() == cells
    assert torch.equal(measured.traversability[measured.mask], field[measured.mask])
    # Contacts off the map measure nothing.
    at_edge = torch.tensor([[0.05, 2.25, 0.0]])
    mask = sensor.sense(terrain, field, at_edge, NoiseKey((0,), 0)).mask
    cells = [[row, column] for row in rows for column in columns_at_edge]
    assert mask[0].nonzero().tolist() == cells


def test_sensors_other_than_contact_do_not_depend_on_the_robot() -> None:
    sensor = Probe()
    assert sensor.mounted(ROBOT) is sensor
