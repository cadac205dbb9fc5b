import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from benchnav.core.grid import Grid
from benchnav.planning.free_space import PENALTY
from benchnav.planning.objective import GoalDistance, TravelTime
from benchnav.planning.planners.astar import astar
from benchnav.planning.planners.astar.waypoint import (
    GroundCosts,
    choose_waypoint,
    ground_costs,
    line_costs,
)
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Unicycle
from tests import factories
from tests.planning.planners.driving import generator

GRID = Grid(10, 14, 0.5)


def problem(seed: int = 0, by_time: bool = False) -> Problem:
    """Maps of 10 × 14 cells, rough and partly not free."""
    maps = 0.1 + torch.rand(3, *GRID.shape, generator=generator(seed))
    elevation = torch.rand(3, *GRID.shape, generator=generator(seed + 1))
    robot = Unicycle(speed_mps=(0, 1.5))
    objective = TravelTime(robot, 1.0) if by_time else GoalDistance()
    return factories.problem(
        maps.clamp(max=1), (1.25, 1.25), (5.25, 3.25), robot, objective, None, elevation
    )


def positions(seed: int, lines: int) -> torch.Tensor:
    extent = torch.tensor(GRID.extent_m)
    return torch.rand(3, lines, 2, generator=generator(seed)) * extent


def sampled(
    given: Problem, member: int, start: torch.Tensor, end: torch.Tensor, by_time: bool
) -> float:
    """The mean cost of a metre at many points of a line, times its length."""
    count = 40_000
    share = (np.arange(count) + 0.5) / count
    offset = (end - start).double().numpy()
    if not offset.any():
        return 0.0
    x, y = (start[axis].item() + share * offset[axis] for axis in (0, 1))
    rows, columns = (y // 0.5).astype(int), (x // 0.5).astype(int)
    height = given.elevation_m[member].double().numpy()
    along_y, along_x = np.gradient(height, 0.5)
    direction = offset / np.hypot(*offset)
    slope = (
        along_x[rows, columns] * direction[0] + along_y[rows, columns] * direction[1]
    )
    cost = np.sqrt(1 + slope**2)
    if by_time:
        cost = (
            1 / given.risk_map[member].double().numpy()[rows, columns].clip(0.3) / 1.5
        )
    cost = cost + PENALTY * ~given.free[member].numpy()[rows, columns]
    return float(cost.mean() * np.hypot(*offset))


@pytest.mark.parametrize("by_time", [False, True])
def test_line_costs_equal_dense_sampling(by_time: bool) -> None:
    given = problem(by_time=by_time)
    start, end = positions(3, 12), positions(4, 12)
    costs = line_costs(ground_costs(given), start, end, 14)
    assert costs.shape == (3, 12)
    for b in range(3):
        for j in range(12):
            expected = sampled(given, b, start[b, j], end[b, j], by_time)
            # A sample is worth PENALTY / 40 000 of a line's length at each edge of a
            # blocked cell.
            assert costs[b, j].item() == pytest.approx(expected, rel=1e-4, abs=3.0)


@pytest.mark.parametrize("by_time", [False, True])
def test_line_costs_on_free_ground_equal_dense_sampling_to_the_digit(
    by_time: bool,
) -> None:
    given = problem(by_time=by_time)
    given = replace(given, free=torch.ones_like(given.free))
    start, end = positions(5, 12), positions(6, 12)
    costs = line_costs(ground_costs(given), start, end, 14)
    for b in range(3):
        for j in range(12):
            expected = sampled(given, b, start[b, j], end[b, j], by_time)
            assert costs[b, j].item() == pytest.approx(expected, rel=2e-4)


def costing(grid: Grid, maps: torch.Tensor) -> GroundCosts:
    """Flat free ground on which a metre costs what maps [B, H, W] say."""
    per_m = grid.pad(maps, outside=0.0)
    none = torch.zeros_like(per_m)
    return GroundCosts(
        grid, lambda traversability, grade: traversability, per_m, none, none, none
    )


def numbered() -> GroundCosts:
    """A metre in cell (i, j) costs 10^j · (i + 1): each cell is told from all others."""
    maps = (10.0 ** torch.arange(4)) * torch.arange(1, 4)[:, None]
    grid = Grid(3, 4, 0.5)
    return costing(grid, maps[None])


def cost_of(ground: GroundCosts, *ends: tuple[float, float]) -> float:
    start, end = torch.tensor([[ends]], dtype=torch.float64).unbind(2)
    return line_costs(ground, start, end, 4).item()


def test_a_line_pays_for_each_cell_it_crosses_as_worked_out_by_hand() -> None:
    # From (0.25, 0.25) with half as much y as x: a quarter each in columns 0 and 1 of
    # row 0, then in columns 1 and 2 of row 1.
    quarter = math.hypot(1.0, 0.5) / 4
    expected = quarter * (1 + 10 + 10 * 2 + 100 * 2)
    assert cost_of(numbered(), (0.25, 0.25), (1.25, 0.75)) == pytest.approx(expected)
    assert cost_of(numbered(), (1.25, 0.75), (0.25, 0.25)) == pytest.approx(expected)


def test_a_corner_that_is_cut_by_a_hair_is_seen() -> None:
    cost = cost_of(numbered(), (0.76, 0.75), (1.26, 0.25))
    root = math.sqrt(2)
    # It passes the corner (1, 0.5): row 1 up to x = 1, a hair of column 2 in it up to y
    # = 0.5, then row 0.
    expected = root * (0.24 * 10 * 2 + 0.01 * 100 * 2 + 0.25 * 100)
    assert cost == pytest.approx(expected)


def test_lines_along_an_axis_or_of_no_length() -> None:
    ground = numbered()
    assert cost_of(ground, (0.25, 0.25), (1.75, 0.25)) == pytest.approx(
        0.25 + 5 + 50 + 250
    )
    assert cost_of(ground, (0.75, 1.25), (0.75, 0.25)) == pytest.approx(
        10 * (0.25 * 3 + 0.5 * 2 + 0.25)
    )
    assert cost_of(ground, (0.75, 0.25), (0.75, 0.25)) == 0.0
    # A line on the edge of two rows lies in the second, as a position on it does.
    assert cost_of(ground, (0.25, 0.5), (0.75, 0.5)) == pytest.approx(2 * (0.25 + 2.5))


def test_the_length_is_that_of_the_slope_along_the_line() -> None:
    rising = 0.75 * 0.5 * torch.arange(14).expand(1, 10, 14)
    given = factories.problem(
        torch.full((1, 10, 14), 0.9), elevation_m=rising, goal=(5.25, 3.25)
    )
    ground = ground_costs(given)
    start, end = (
        torch.tensor([[[1.0, 1.0]] * 2]),
        torch.tensor([[[3.0, 1.0], [1.0, 3.0]]]),
    )
    torch.testing.assert_close(
        line_costs(ground, start, end, 14), torch.tensor([[2 * 1.25, 2.0]])
    )


class Climbing(GoalDistance):
    """Only going up costs; more where λ̂ is low."""

    def path_cost(
        self, traversability: torch.Tensor, grade: torch.Tensor
    ) -> torch.Tensor:
        return 1 + 10 * grade.clamp(min=0) / traversability


def test_a_users_path_cost_is_given_the_ground_and_the_rise_along_the_line() -> None:
    rising = 0.4 * 0.5 * torch.arange(14).expand(1, 10, 14)
    ground = torch.where(torch.arange(14) < 4, 0.5, 0.8).expand(1, 10, 14)
    given = factories.problem(
        ground, goal=(5.25, 3.25), objective=Climbing(), elevation_m=rising
    )
    ends = torch.tensor([[[1.0, 1.0], [3.0, 1.0], [1.0, 3.0]]])
    costs = line_costs(ground_costs(given), ends[:, [0, 1, 0]], ends[:, [1, 0, 2]], 14)
    # Up along x a metre at λ̂ 0.5 and one at 0.8, then down, then along the level.
    expected = torch.tensor([[2 + 4 / 0.5 + 4 / 0.8, 2.0, 2.0]])
    torch.testing.assert_close(costs, expected)


# --- The rule.


def seen(given: Problem, lookahead_m: float = 4.0) -> torch.Tensor:
    """Way-points from the start."""
    points = astar.path_points(given, astar.search(given), given.start, 16)
    return choose_waypoint(ground_costs(given), points, lookahead_m)[0]


def test_on_open_ground_it_is_as_far_as_the_look_ahead() -> None:
    given = factories.problem(
        torch.full((1, 10, 24), 0.9), start=(1.25, 2.25), goal=(11.25, 2.25)
    )
    torch.testing.assert_close(seen(given), torch.tensor([[5.25, 2.25]]))
    torch.testing.assert_close(
        seen(given, lookahead_m=2.1), torch.tensor([[3.25, 2.25]])
    )
    torch.testing.assert_close(
        seen(given, lookahead_m=0.2), torch.tensor([[1.75, 2.25]])
    )


def test_it_is_the_goal_once_that_is_near() -> None:
    given = factories.problem(
        torch.full((1, 10, 24), 0.9), start=(8.35, 2.1), goal=(11.1, 2.3)
    )
    torch.testing.assert_close(seen(given), given.goal_m)


@pytest.mark.parametrize("by_time", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_it_is_the_farthest_point_that_is_worth_it(seed: int, by_time: bool) -> None:
    given = problem(seed, by_time)
    field, ground = astar.search(given), ground_costs(given)
    counted = set()
    for place in ((1.25, 1.25), (3.1, 4.6), (6.8, 0.3), (0.1, 2.4)):
        start = torch.tensor(place)
        state = torch.tensor([[*place, 0.0]] * 3)
        points = astar.path_points(given, field, state, 12)
        chosen, straight = choose_waypoint(ground, points, 3.0)
        for b in range(3):
            line = [sampled(given, b, start, point, by_time) for point in points[b]]
            own = (start // 0.5 + 0.5) * 0.5
            gate = (own + points[b, 1]) / 2
            detour = sampled(given, b, start, gate, by_time) + sampled(
                given, b, gate, points[b, 1], by_time
            )
            path, length, expected = (
                min(line[1], detour),
                (points[b, 1] - start).norm(),
                points[b, 1],
            )
            for k in range(2, 12):
                path += sampled(given, b, points[b, k - 1], points[b, k], by_time)
                length += (points[b, k] - points[b, k - 1]).norm()
                if length <= 3.0 and line[k] <= 1.1 * path:
                    expected = points[b, k]
            torch.testing.assert_close(chosen[b], expected)
            assert straight[b] == (line[1] <= 1.1 * detour)
            counted.add(tuple(expected.tolist()))
    assert len(counted) > 6


def test_no_line_cuts_the_corner_of_ground_that_is_not_free() -> None:
    cornered = torch.full((1, 12, 16), 0.9)
    cornered[0, 4:, 6:8] = 0.1
    given = factories.problem(cornered, start=(1.75, 4.25), goal=(6.25, 4.25))
    points = astar.path_points(given, astar.search(given), given.start, 16)[0]
    waypoint = seen(given, lookahead_m=8.0)[0]
    # Not past the wall's corner at (3, 2), nor does it stop at the next cell.
    at = [bool(torch.equal(point, waypoint)) for point in points].index(True)
    assert at > 1
    ends = torch.stack((given.start[0, :2], waypoint))[None, None]
    assert line_costs(ground_costs(given), ends[:, :, 0], ends[:, :, 1], 20).item() < 20
    beyond = torch.stack((given.start[0, :2], points[at + 1]))[None, None]
    assert (
        line_costs(ground_costs(given), beyond[:, :, 0], beyond[:, :, 1], 20).item()
        > 20
    )


@pytest.mark.parametrize(("factor", "taken"), [(1.08, True), (1.12, False)])
def test_a_short_cut_may_cost_a_tenth_more_than_the_path(
    factor: float, taken: bool
) -> None:
    # A path of 4 m round a square, at 1 a metre; its diagonal leads for 1.5·√2 m
    # through dearer cells.
    maps = torch.ones(1, 10, 14)
    maps[0, 1:4, 1:4] = (4 * factor - 0.5 * math.sqrt(2)) / (1.5 * math.sqrt(2))
    ground = costing(GRID, maps)
    points = torch.tensor([[[0.25, 0.25], [2.25, 0.25], [2.25, 2.25]]])
    line = line_costs(ground, points[:, :1], points[:, 2:], 10).item()
    assert line == pytest.approx(4 * factor, rel=1e-5)
    assert (
        torch.equal(choose_waypoint(ground, points, 5.0)[0][0], points[0, 2]) == taken
    )


def test_by_time_no_line_cuts_through_slow_ground() -> None:
    slow = torch.full((1, 12, 16), 1.0)
    slow[0, 3:9, 5:8] = 0.31
    ends: Any = {"start": (1.75, 3.25), "goal": (6.25, 3.25)}
    by_length = factories.problem(slow, **ends)
    by_time = factories.problem(slow, **ends, objective=TravelTime(Unicycle(), 1.0))
    points = astar.path_points(by_time, astar.search(by_time), by_time.start, 20)
    farthest = [
        choose_waypoint(ground_costs(given), points, 8.0)[0]
        for given in (by_length, by_time)
    ]
    torch.testing.assert_close(farthest[0], by_length.goal_m)
    assert (farthest[1][0] - by_time.goal_m[0]).norm() > 2


def test_it_tells_of_a_line_across_the_corner_of_dearer_ground() -> None:
    maps = torch.ones(4, 10, 14)
    maps[:3, 0, 1] = 100.0
    ground = costing(GRID, maps)
    places = torch.tensor([[0.45, 0.2], [0.2, 0.45], [0.25, 0.25], [0.45, 0.2]])
    onward = torch.tensor([[0.75, 0.75], [1.25, 1.25]]).expand(4, 2, 2)
    _, straight = choose_waypoint(
        ground, torch.cat((places[:, None], onward), dim=1), 4.0
    )
    assert straight.tolist() == [False, True, True, True]


def test_from_ground_that_is_not_free_it_looks_to_where_that_ends() -> None:
    held = torch.full((1, 12, 24), 0.9)
    held[0, 2:6, 2:6] = 0.0
    given = factories.problem(held, start=(2.75, 2.1), goal=(11.25, 2.25))
    torch.testing.assert_close(seen(given)[0, 0], torch.tensor(6.75), atol=0.51, rtol=0)
