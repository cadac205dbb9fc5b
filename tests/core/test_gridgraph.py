import networkx
import numpy as np
import pytest
from scipy.ndimage import generate_binary_structure, label

from benchnav.core import gridgraph


def networkx_costs(
    costs: np.ndarray, goals: np.ndarray, shape: tuple[int, int]
) -> dict[int, float]:
    source, target, _ = gridgraph.neighbour_pairs(*shape)
    graph = networkx.DiGraph()
    graph.add_nodes_from(range(shape[0] * shape[1]))
    keep = np.isfinite(costs)
    # Turned round, as a search from the goals.
    graph.add_weighted_edges_from(
        zip(
            target[keep].tolist(),
            source[keep].tolist(),
            costs[keep].tolist(),
            strict=True,
        )
    )
    if not goals.any():
        return {}
    return networkx.multi_source_dijkstra_path_length(
        graph, set(np.flatnonzero(goals).tolist())
    )


@pytest.mark.parametrize("seed", range(3))
def test_cost_to_go_equals_networkx_on_each_map_of_a_batch(seed: int) -> None:
    generator = np.random.default_rng(seed)
    shape, batch = (9, 7), 4
    costs = generator.uniform(
        0.1, 3, (batch, len(gridgraph.neighbour_pairs(*shape)[0]))
    )
    costs[generator.random(costs.shape) < 0.45] = np.inf
    # Nothing leaves one cell.
    costs[1:, gridgraph.neighbour_pairs(*shape)[0] == 30] = np.inf
    goals = generator.random((batch, *shape)) < 0.04
    goals[0] = False
    cost, following = gridgraph.cost_to_go(costs, goals, shape)
    for b in range(batch):
        expected = np.full(shape[0] * shape[1], np.inf)
        for cell, value in networkx_costs(costs[b], goals[b], shape).items():
            expected[cell] = value
        np.testing.assert_allclose(cost[b].ravel(), expected)
        # Each pointer leads along an edge that accounts for the difference in cost.
        source, target, _ = gridgraph.neighbour_pairs(*shape)
        edge = {
            (int(s), int(t)): c
            for s, t, c in zip(source, target, costs[b], strict=True)
        }
        for cell in range(len(expected)):
            onward = int(following[b, cell])
            if np.isfinite(expected[cell]) and not goals[b].ravel()[cell]:
                assert expected[cell] == pytest.approx(
                    edge[cell, onward] + expected[onward]
                )
            else:
                assert onward == gridgraph.NO_CELL


def test_a_map_has_the_same_paths_in_any_batch_where_many_cost_the_same() -> None:
    shape = (9, 7)
    length = gridgraph.neighbour_pairs(*shape)[2]
    costs = length * np.array([1.0, 2.0, 1.0])[:, None]
    goals = np.zeros((3, *shape), bool)
    goals[[0, 0, 1, 2, 2], [4, 8, 1, 4, 8], [3, 0, 6, 3, 0]] = True
    cost, following = gridgraph.cost_to_go(costs, goals, shape)
    assert np.array_equal(cost[0], cost[2])
    for b in range(3):
        alone = gridgraph.cost_to_go(costs[b : b + 1], goals[b : b + 1], shape)
        assert np.array_equal(cost[b], alone[0][0])
        assert np.array_equal(following[b], alone[1][0])


def test_every_cell_has_its_neighbours() -> None:
    source, target, length = gridgraph.neighbour_pairs(3, 4)
    assert len(source) == 2 * (3 * 3 + 2 * 4 + 2 * 2 * 3)
    assert len(set(zip(source.tolist(), target.tolist(), strict=True))) == len(source)
    rows, columns = np.divmod(source, 4), np.divmod(target, 4)
    np.testing.assert_allclose(
        np.hypot(rows[0] - columns[0], rows[1] - columns[1]), length
    )


def test_travel_time_is_half_in_each_cell() -> None:
    speed = np.array([[[0.5, 1.0], [0.25, 0.2]]])
    costs = gridgraph.travel_time_costs(speed, speed > 0.2, 2.0)[0]
    source, target, _ = gridgraph.neighbour_pairs(2, 2)
    edge = {(int(s), int(t)): c for s, t, c in zip(source, target, costs, strict=True)}
    assert edge[0, 1] == pytest.approx(1 / 0.5 + 1 / 1.0)
    assert edge[1, 2] == pytest.approx(np.sqrt(2) * (1 / 1.0 + 1 / 0.25))
    assert np.isinf(edge[0, 3])


@pytest.mark.parametrize(("closed_corners", "shared"), [(True, 1), (False, 2)])
def test_steps_join_what_shared_edges_join_and_once_what_corners_do(
    closed_corners: bool, shared: int
) -> None:
    shape, batch = (9, 7), 40
    free = np.random.default_rng(4).random((batch, *shape)) < 0.55
    costs = gridgraph.travel_time_costs(np.ones(free.shape), free, 0.5, closed_corners)
    goals = np.zeros_like(free)
    goals[:, 4, 3] = free[:, 4, 3]
    reached = np.isfinite(gridgraph.cost_to_go(costs, goals, shape)[0])
    for b in range(batch):
        parts, _ = label(free[b], generate_binary_structure(2, shared))
        assert np.array_equal(
            reached[b], (parts == parts[4, 3]) & free[b] & free[b, 4, 3]
        )
