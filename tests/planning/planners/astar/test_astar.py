from dataclasses import replace

import networkx
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from benchnav.core import gridgraph
from benchnav.core.errors import ConfigError
from benchnav.core.grid import Grid
from benchnav.planning.free_space import PENALTY, Rules
from benchnav.planning.objective import GoalDistance, TravelTime
from benchnav.planning.planners.astar import astar
from benchnav.planning.problem import Prediction, Problem, pose_problem
from benchnav.planning.robots import Unicycle
from tests import factories


def random_problem(seed: int, robot: Unicycle, by_time: bool = False) -> Problem:
    generator = torch.Generator().manual_seed(seed)
    maps = 0.15 + torch.rand(3, 16, 12, generator=generator)
    elevation = 2 * torch.rand(3, 16, 12, generator=generator)
    objective = TravelTime(robot, 1.0) if by_time else GoalDistance()
    return factories.problem(
        maps.clamp(max=1), (1.25, 1.25), (4.25, 6.75), robot, objective, None, elevation
    )


def networkx_graph(problem: Problem, member: int, by_time: bool) -> networkx.Graph:
    """Halves of an edge at their own cell's cost; penalties on the flat length.

    A diagonal edge between two free cells is penalised whole where the two cells beside
    it are not free.
    """
    free, height = (
        problem.free[member].numpy(),
        problem.elevation_m[member].double().numpy(),
    )
    pace = (
        1
        / problem.risk_map[member].double().clamp(min=0.3).numpy()
        / problem.robot.top_speed_mps
    )
    graph = networkx.Graph()
    rows, columns = problem.grid.shape
    for i in range(rows):
        for j in range(columns):
            for k, m in ((i, j + 1), (i + 1, j), (i + 1, j + 1), (i + 1, j - 1)):
                if 0 <= k < rows and 0 <= m < columns:
                    half = 0.25 * np.hypot(i - k, j - m)
                    cost = np.hypot(2 * half, height[i, j] - height[k, m])
                    if by_time:
                        cost = half * (pace[i, j] + pace[k, m])
                    penalty = (
                        half * PENALTY * (int(not free[i, j]) + int(not free[k, m]))
                    )
                    if free[i, j] and free[k, m] and not free[i, m] and not free[k, j]:
                        penalty = 2 * half * PENALTY
                    graph.add_edge((i, j), (k, m), weight=cost + penalty)
    return graph


@given(
    seed=st.integers(0, 999),
    fraction=st.sampled_from((0.01, 0.1, 1.0)),
    layer=st.sampled_from(("risk_map", "free", "elevation_m")),
    by_time=st.booleans(),
)
def test_revised_costs_of_edges_are_those_of_the_new_map(
    seed: int, fraction: float, layer: str, by_time: bool
) -> None:
    before, other = (
        random_problem(number, Unicycle(), by_time) for number in (seed, seed + 1)
    )
    changed = (
        torch.rand(3, 16, 12, generator=torch.Generator().manual_seed(seed)) < fraction
    )
    changed[0, 0, 0] = True
    now = torch.where(changed, getattr(other, layer), getattr(before, layer))
    if layer == "elevation_m":
        then = replace(before, observation=replace(before.observation, elevation_m=now))
    else:
        then = replace(before, **{layer: now})
    costs = astar.edge_costs(before)
    kept = costs.clone()
    assert torch.equal(
        astar.revised_edge_costs(then, costs, changed), astar.edge_costs(then)
    )
    assert torch.equal(costs, kept)


@pytest.mark.parametrize("by_time", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_costs_to_go_equal_networkx_on_every_cell(seed: int, by_time: bool) -> None:
    problem = random_problem(seed, Unicycle(speed_mps=(0, 2)), by_time)
    assert not problem.free.all()
    field = astar.search(problem)
    centres = [(i, j) for i in range(16) for j in range(12)]
    goals = {
        (i, j)
        for i, j in centres
        if np.hypot(j / 2 + 0.25 - 4.25, i / 2 + 0.25 - 6.75) < 1
    }
    for b in range(3):
        graph = networkx_graph(problem, b, by_time)
        expected = networkx.multi_source_dijkstra_path_length(graph, goals)
        for cell in centres:
            assert field.cost[b][cell].item() == pytest.approx(expected[cell], rel=1e-5)
        # The path that is followed costs what is said.
        cells = astar.path_cells(field, torch.full((3,), 3), 200)[b].tolist()
        assert len(cells) > cells.index(cells[-1]) + 1
        path = [divmod(cell, 12) for cell in cells[: cells.index(cells[-1]) + 1]]
        assert path[-1] in goals
        assert networkx.path_weight(graph, path, "weight") == pytest.approx(
            expected[0, 3], rel=1e-5
        )


def test_time_cost_prefers_the_quick_way_round() -> None:
    slow = torch.full((1, 16, 20), 1.0)
    slow[0, 6:14, 5:11] = 0.31
    crossing = []
    for objective in (GoalDistance(), TravelTime(Unicycle(), 1.0)):
        problem = factories.problem(
            slow, start=(1.25, 4.0), goal=(6.75, 4.0), objective=objective
        )
        cells = astar.path_cells(astar.search(problem), torch.tensor([8 * 20 + 2]), 40)[
            0
        ]
        crossing.append(bool((problem.traversability[0].flatten()[cells] < 0.5).any()))
    assert crossing == [True, False]


class Climbing(GoalDistance):
    """An objective to which only going up costs much; it is asked for λ̂ and grade by
    name.
    """

    def path_cost(
        self, traversability: torch.Tensor, grade: torch.Tensor
    ) -> torch.Tensor:
        return 1 + 100 * grade.clamp(min=0) / traversability


@pytest.mark.parametrize("cost", [torch.tensor(1.0), torch.ones(3), 1.0])
def test_a_path_cost_that_is_none_for_each_piece_is_refused(cost: object) -> None:
    class Same(GoalDistance):
        def path_cost(
            self, traversability: torch.Tensor, grade: torch.Tensor
        ) -> torch.Tensor:
            return cost  # type: ignore[return-value]

    with pytest.raises(ConfigError, match=r"path_cost.*Same.*a cost for each segment"):
        astar.search(
            factories.problem(
                torch.full((1, 8, 8), 0.8), goal=(2.75, 2.75), objective=Same()
            )
        )


def test_a_users_path_cost_is_given_the_ground_and_the_rise_of_each_edge() -> None:
    # A ramp along x, at 0.4 m a cell, ends in a plateau; λ̂ is 0.5 on it and 0.8 on the
    # ground above.
    elevation = 0.4 * torch.arange(12).clamp(max=6).expand(1, 16, 12).float()
    ground = torch.where(torch.arange(12) < 6, 0.5, 0.8).expand(1, 16, 12)
    problem = factories.problem(
        ground,
        goal=(5.75, 4.25),
        objective=Climbing(),
        rules=Rules(goal_radius_m=0.1),
        elevation_m=elevation,
    )
    up = astar.search(problem).cost[0, 8]
    # From column 3 to 6 each half metre rises 0.8 m a metre, on the half edges of its
    # own cell.
    steps = [0.5 * (1 + 80 / 0.5)] * 2 + [0.25 * (1 + 80 / 0.5) + 0.25 * (1 + 80 / 0.8)]
    assert up[3].item() == pytest.approx(sum(steps) + 5 * 0.5, rel=1e-5)
    # Downhill it costs its length alone.
    problem = replace(problem, goal_m=torch.tensor([[0.25, 4.25]]))
    assert astar.search(problem).cost[0, 8, 11].item() == pytest.approx(
        11 * 0.5, rel=1e-5
    )


@pytest.mark.parametrize("cost", [0.0, -1.0, float("inf"), float("nan")])
def test_a_path_cost_that_no_search_can_use_is_refused(cost: float) -> None:
    class Bad(GoalDistance):
        def path_cost(
            self, traversability: torch.Tensor, grade: torch.Tensor
        ) -> torch.Tensor:
            return torch.where(traversability < 0.5, cost, 1.0)

    ground = torch.full((1, 8, 8), 0.9)
    astar.search(factories.problem(ground, objective=Bad()))
    ground[0, 3, 3] = 0.4
    with pytest.raises(ConfigError, match=r"path_cost.*Bad"):
        astar.search(factories.problem(ground, objective=Bad()))


def test_a_path_leaves_ground_that_is_not_free_by_the_shortest_way_and_enters_none() -> (
    None
):
    open_map = torch.full((1, 16, 16), 0.9)
    open_map[0, 6:10, 6:10] = 0.0
    problem = factories.problem(open_map)
    field = astar.search(problem)
    cells = astar.path_cells(field, torch.tensor([8 * 16 + 8]), 40)[0]
    free = problem.free[0].flatten()[cells]
    first = int(free.int().argmax())
    assert 1 <= first <= 2
    assert free[first:].all()
    outside = [
        c
        for i in range(16)
        for c in astar.path_cells(field, torch.tensor([i * 16]), 40)[0].tolist()
    ]
    assert problem.free[0].flatten()[outside].all()


def test_a_wall_without_a_gap_is_crossed_where_it_is_thinnest() -> None:
    walled = torch.full((2, 16, 16), 0.9)
    walled[0, :, 7:10] = 0.1
    walled[0, 13, 7:9] = 0.9
    problem = factories.problem(walled)
    field = astar.search(problem)
    assert field.cost.isfinite().all()
    assert gridgraph.NO_CELL not in field.following
    cells = astar.path_cells(field, torch.tensor([2 * 16 + 2] * 2), 60)
    blocked = [~problem.free[b].flatten()[cells[b]] for b in range(2)]
    assert blocked[0].sum() == 1
    # Half an edge before its centre and half an edge behind, straight or across a
    # corner.
    assert 0.5 * PENALTY <= field.cost[0, 2, 2] <= 0.75 * PENALTY
    assert blocked[1].sum() == 0
    assert field.cost[1, 2, 2] < 100


@pytest.mark.parametrize("gap", [False, True])
def test_a_wall_of_cells_that_touch_at_corners_is_a_wall(gap: bool) -> None:
    wall = torch.full((1, 16, 16), 0.9)
    wall[0, torch.arange(16), 15 - torch.arange(16)] = 0.0
    wall[0, 15, 0] = 0.9 if gap else 0.0
    problem = factories.problem(wall, (2.25, 2.25), (6.75, 6.75))
    field = astar.search(problem)
    cells = astar.path_cells(field, torch.tensor([4 * 16 + 4]), 60)[0]
    blocked = (~problem.free[0].flatten()[cells]).sum()
    assert blocked == (0 if gap else 1)
    # From both sides of a corner the way to the goal is as long as from the cells'
    # centres.
    beside = torch.tensor([[[3.99, 3.99], [4.01, 4.01]]])
    near, far = astar.cost_at(
        problem.grid, astar.pad_costs(problem, field), *beside.unbind(-1)
    )[0].tolist()
    assert near > far + (2 if gap else 0.3 * PENALTY)


def test_a_goal_in_a_ring_that_is_not_free_is_reached_through_its_disc() -> None:
    closed = torch.full((1, 16, 16), 0.9)
    closed[0, 10:, 10:] = 0.0
    problem = factories.problem(closed)
    assert problem.free[0, 13, 13]
    cells = astar.path_cells(astar.search(problem), torch.tensor([2 * 16 + 2]), 60)[0]
    assert (~problem.free[0].flatten()[cells]).sum() == 1


def test_a_goal_at_a_corner_of_coarse_cells_is_reached() -> None:
    made = factories.problem(torch.full((1, 8, 8), 0.9))
    observation = replace(made.observation, grid=Grid(8, 8, 2.0))
    start, goal = torch.tensor([[3.0, 3.0]]), torch.tensor([[12.0, 12.0]])
    prediction = Prediction(observation, made.distribution, made.risk_map)
    problem = pose_problem(made.task, prediction, start, goal, 100.0)
    field = astar.search(problem)
    assert field.following[0, 6 * 8 + 6] == 6 * 8 + 6
    # Five diagonal steps of 2√2 m.
    assert field.cost[0, 1, 1].item() == pytest.approx(10 * 2**0.5)


def test_points_begin_at_the_robot_and_end_at_the_goal() -> None:
    problem = factories.problem(
        torch.full((2, 16, 20), 0.9), start=(3.1, 3.4), goal=(8.1, 3.3)
    )
    points = astar.path_points(problem, astar.search(problem), problem.start, 20)
    assert points.shape == (2, 20, 2)
    expected = [(3.1, 3.4), (3.75, 3.25), (4.25, 3.25)]
    torch.testing.assert_close(points[1, :3], torch.tensor(expected))
    torch.testing.assert_close(points[1, -1], torch.tensor([8.1, 3.3]))
    assert (points[0].diff(dim=0)[:, 0] >= 0).all()


def everywhere(problem: Problem, count: int, seed: int = 3) -> torch.Tensor:
    """Positions (x, y) on the maps, shape [B, count, 2]."""
    extent = torch.tensor(problem.grid.extent_m)
    return extent * torch.rand(
        len(problem), count, 2, generator=torch.Generator().manual_seed(seed)
    )


def test_the_cost_at_a_centre_is_that_of_its_cell() -> None:
    problem = random_problem(1, Unicycle(), by_time=True)
    assert not problem.free.all()
    field = astar.search(problem)
    centres = astar.cell_centres(problem.grid, torch.arange(16 * 12)).expand(3, -1, -1)
    found = astar.cost_at(
        problem.grid, astar.pad_costs(problem, field), centres[..., 0], centres[..., 1]
    )
    torch.testing.assert_close(found, field.cost.flatten(1), rtol=1e-5, atol=1e-4)


def test_the_cost_between_centres_is_the_least_of_lines_to_those_near() -> None:
    problem = random_problem(2, Unicycle(), by_time=True)
    field, points = astar.search(problem), everywhere(problem, 60)
    found = astar.cost_at(
        problem.grid, astar.pad_costs(problem, field), points[..., 0], points[..., 1]
    )
    per_m, free = (
        1 / problem.risk_map.clamp(min=0.3) + PENALTY * ~problem.free,
        problem.free,
    )

    def squeezed(b: int, i: int, j: int, k: int, m: int) -> torch.Tensor:
        return free[b, i, j] & free[b, k, m] & ~free[b, i, m] & ~free[b, k, j]

    assert sum(
        squeezed(b, i, j, i + 1, j + 1).item()
        for b in range(3)
        for i in range(15)
        for j in range(11)
    )
    for b, each in enumerate(points):
        for (x, y), value in zip(each.tolist(), found[b].tolist(), strict=True):
            row, column = int(y // 0.5), int(x // 0.5)
            if field.cost[b, row, column] == 0:
                assert value == 0
                continue
            wanted = min(
                field.cost[b, i, j].item()
                + np.hypot(x - 0.5 * j - 0.25, y - 0.5 * i - 0.25)
                * 0.5
                * (
                    per_m[b, row, column]
                    + per_m[b, i, j]
                    + 2 * PENALTY * squeezed(b, row, column, i, j)
                ).item()
                for i in range(max(row - 1, 0), min(row + 2, 16))
                for j in range(max(column - 1, 0), min(column + 2, 12))
            )
            assert value == pytest.approx(wanted, rel=1e-4)


def test_off_the_map_the_cost_is_above_all_on_it() -> None:
    problem = random_problem(2, Unicycle(), by_time=True)
    costs = astar.pad_costs(problem, astar.search(problem))
    outside = torch.tensor([-3.0, 20.0]).expand(3, 2)
    on_map = costs[:, 0].unflatten(1, (18, 14))[:, 1:-1, 1:-1]
    assert float(astar.cost_at(problem.grid, costs, outside, outside).min()) > float(
        on_map.max()
    )


def test_a_robot_of_twice_the_speed_has_half_the_time_to_go() -> None:
    found = []
    for speed in (1.0, 2.0):
        problem = random_problem(1, Unicycle(speed_mps=(0, speed)), by_time=True)
        problem = replace(problem, free=torch.ones_like(problem.free))
        points = everywhere(problem, 40)
        costs = astar.pad_costs(problem, astar.search(problem))
        found.append(astar.cost_at(problem.grid, costs, points[..., 0], points[..., 1]))
    torch.testing.assert_close(found[0], 2 * found[1])
