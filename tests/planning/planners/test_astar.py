from contextlib import suppress
from dataclasses import replace

import networkx
import numpy as np
import pytest
import torch

from benchnav import gridgraph
from benchnav.planning import astar
from benchnav.terrain import Grid
from tests import factories


def random_problem(seed: int):  # type: ignore[no-untyped-def]
    generator = torch.Generator().manual_seed(seed)
    made = factories.problem(0.15 + torch.rand(3, 16, 16, generator=generator))

    return replace(made, elevation_m=2 * torch.rand(3, 16, 16, generator=generator))


@pytest.mark.parametrize("seed", range(4))
def test_path_cost_equals_networkx_astar_in_3d_length(seed: int) -> None:
    problem = random_problem(seed)
    field = astar.search(problem)
    reached = 0
    for b in range(3):
        free = problem.free[b].numpy()
        height = problem.elevation_m[b].double().numpy()
        graph = networkx.Graph()
        graph.add_nodes_from((i, j) for i in range(16) for j in range(16) if free[i, j])
        for i, j in list(graph.nodes):
            for k, m in ((i, j + 1), (i + 1, j), (i + 1, j + 1), (i + 1, j - 1)):
                if graph.has_node((k, m)):
                    length = np.sqrt(
                        (0.5 * (i - k)) ** 2 + (0.5 * (j - m)) ** 2 + (height[i, j] - height[k, m]) ** 2
                    )
                    graph.add_edge((i, j), (k, m), weight=length)
        centre = [((j + 0.5) / 2, (i + 0.5) / 2) for i, j in graph.nodes]
        goals = [n for n, (x, y) in zip(graph.nodes, centre, strict=True) if np.hypot(x - 6.75, y - 6.75) < 1]
        for start in ((2, 2), (2, 9), (14, 1)):
            if not free[start]:
                continue
            costs = []
            for goal in goals:
                with suppress(networkx.NetworkXNoPath):
                    costs.append(networkx.astar_path_length(graph, start, goal))
            expected = min(costs, default=np.inf)
            reached += np.isfinite(expected)
            assert field.cost[b][start].item() == pytest.approx(expected)
            cells = astar.path_cells(field, torch.tensor([start[0] * 16 + start[1]] * 3), 200)[b]
            rows, columns = cells // 16, cells % 16
            if np.isfinite(expected):
                assert free[rows, columns].all()
                assert cells[-1] == cells[-2]
    assert reached >= 3


def test_time_cost_prefers_the_quick_way_round() -> None:
    slow = torch.full((1, 16, 16), 1.0)
    slow[0, 6:14, 5:11] = 0.31
    problem = factories.problem(slow, start=(1.25, 4.0), goal=(6.75, 4.0))
    crossing = {}
    for by_time in (False, True):
        field = astar.search(problem, by_time)
        cells = astar.path_cells(field, torch.tensor([8 * 16 + 2]), 40)[0]
        crossing[by_time] = bool((problem.traversability[0].flatten()[cells] < 0.5).any())
    assert crossing == {False: True, True: False}


def test_a_robot_may_leave_blocked_cells_but_not_enter_them() -> None:
    open_map = torch.full((1, 16, 16), 0.9)
    open_map[0, 6:10, 6:10] = 0.1
    problem = factories.problem(open_map)
    field = astar.search(problem)
    assert field.cost[0, 8, 8].isfinite()
    cells = astar.path_cells(field, torch.tensor([8 * 16 + 8]), 40)[0]
    free = problem.free[0].flatten()[cells]
    first = int(free.int().argmax())
    assert 1 <= first <= 2
    assert free[first:].all()
    outside = [c for i in range(16) for c in astar.path_cells(field, torch.tensor([i * 16]), 40)[0].tolist()]
    assert problem.free[0].flatten()[outside].all()


def test_no_way_is_an_infinite_cost() -> None:
    walled = torch.full((2, 16, 16), 0.9)
    walled[0, :, 8] = 0.1
    field = astar.search(factories.problem(walled))
    assert field.cost[0, 2, 2].isinf()
    assert field.cost[1, 2, 2].isfinite()
    assert gridgraph.NO_CELL not in field.following


def test_a_goal_at_a_corner_of_coarse_cells_is_reached() -> None:
    problem = factories.problem(torch.full((1, 8, 8), 0.9), start=(3.0, 3.0), goal=(12.0, 12.0))
    coarse = replace(problem, grid=Grid(8, 8, 2.0))
    assert astar.search(coarse).cost[0, 1, 1].isfinite()
