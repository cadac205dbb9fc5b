"""The search: which nodes are chosen, what a way costs, which route is taken; and that
a tree is a value.
"""

from dataclasses import FrozenInstanceError, fields, replace

import pytest
import torch
from torch import Tensor

from benchnav.core.batch import map_tensors
from benchnav.planning.free_space import PENALTY
from benchnav.planning.planners.cl_rrt.edges import ClosedLoop, draw_references, drive
from benchnav.planning.planners.cl_rrt.pursuit import Tracking
from benchnav.planning.planners.cl_rrt.tree import (
    Choice,
    Tree,
    add,
    best_route,
    choose,
    no_route,
    plant,
    search,
    states_at,
)
from benchnav.planning.planners.dubins import dubins_length_to_point
from benchnav.planning.planners.planner import PlanStatus
from tests.planning.planners.cl_rrt.maps import known, make_loop, open_map, walled_map

GAP = slice(24, 28)


def planted(loop: ClosedLoop) -> Tree:
    return plant(loop, loop.problem.start, Tracking.standing(loop.problem.start))


def extended(
    loop: ClosedLoop, tree: Tree, nodes: list[int], targets: list[tuple[float, float]]
) -> Tree:
    """The tree with an edge from each node to each target."""
    batch = len(loop.problem)
    node, target_m = torch.tensor([nodes] * batch), torch.tensor([targets] * batch)
    begin = states_at(tree, node)
    reference, length_m = draw_references(loop, begin.state, target_m)
    choice = Choice(
        parent=node, target_m=target_m, aimed=torch.zeros_like(node, dtype=torch.bool)
    )
    return add(loop, tree, choice, drive(loop, begin, reference, length_m))


def searched(
    loop: ClosedLoop, rounds: int, count: int, seed: int = 0, goal_edges: int = 4
):  # type: ignore[no-untyped-def]
    generator = torch.Generator().manual_seed(seed)
    sample_m = torch.rand(rounds, count, 2, generator=generator) * 16
    chance = torch.rand(rounds, count, generator=generator)
    tracking = Tracking.standing(loop.problem.start)
    return search(loop, loop.problem.start, tracking, sample_m, chance, goal_edges)


def tensors(value: object) -> list[Tensor]:
    found: list[Tensor] = []

    def keep(tensor: Tensor) -> Tensor:
        found.append(tensor)
        return tensor

    map_tensors(value, keep)
    return found


def two_nodes(loop: ClosedLoop) -> Tree:
    """Root at (3, 8), and a node near (7, 8) to which the way was slow: 60 s for what
    takes 5.
    """
    tree = extended(loop, planted(loop), [0], [(7.0, 8.0)])
    return replace(tree, time_s=torch.tensor([[0.0, 60.0]]))


@pytest.mark.parametrize("known_way", [False, True])
def test_share_of_choices_that_explore(known_way: bool) -> None:
    # To (8, 8) node 1 is nearest, and from the root it is reached soonest.
    loop = make_loop(open_map())
    tree = two_nodes(loop)
    if known_way:  # as an edge elsewhere that takes long
        way = extended(loop, tree, [0], [(3.0, 12.0)])
        arrived, time_s = (
            torch.tensor([[False, False, True]]),
            torch.tensor([[0.0, 60.0, 500.0]]),
        )
        tree = replace(way, arrived=arrived, time_s=time_s)
    chance = (torch.arange(1000) + 0.5) / 1000
    choice = choose(loop, tree, torch.tensor([8.0, 8.0]).expand(1000, 2), chance, 0)
    explored = choice.parent[0] == 1
    assert explored.float().mean().item() == pytest.approx(0.3 if known_way else 0.7)
    assert (choice.parent[0][~explored] == 0).all()


def test_nearest_is_by_dubins_length() -> None:
    # (2.5, 8) is half a metre behind the root, which would have to turn about, and 3.2
    # m before the other.
    loop = make_loop(open_map())
    tree = extended(loop, planted(loop), [0], [(5.5, 8.0)])
    back = tree.at.state.clone()
    back[0, 1, 2] = torch.pi
    tree = replace(tree, at=replace(tree.at, state=back))
    point = torch.tensor([[2.5, 8.0]])
    lengths = dubins_length_to_point(tree.at.state[0], point, 1.0)
    assert lengths[1] < lengths[0]
    assert choose(loop, tree, point, torch.zeros(1), 0).parent.item() == 1


def test_nodes_that_cannot_improve_on_the_best_way_are_left_out() -> None:
    loop = make_loop(open_map())
    tree = extended(loop, planted(loop), [0, 0], [(7.0, 8.0), (3.0, 12.0)])
    arrived, time_s = (
        torch.tensor([[False, False, True]]),
        torch.tensor([[0.0, 18.0, 20.0]]),
    )
    # 5 m to the goal's rim: 18 s + 5 s > 20 s
    tree = replace(tree, arrived=arrived, time_s=time_s)
    chance = torch.linspace(0, 0.99, 20)
    assert (
        choose(loop, tree, torch.tensor([8.0, 8.0]).expand(20, 2), chance, 3).parent
        == 0
    ).all()
    soon = replace(tree, time_s=torch.tensor([[0.0, 14.0, 20.0]]))
    assert (
        choose(loop, soon, torch.tensor([8.0, 8.0]).expand(20, 2), chance, 0).parent
        == 1
    ).any()
    # and the penalty counts
    dear = replace(soon, blocked_m=torch.tensor([[0.0, 0.1, 0.0]]))
    assert (
        choose(loop, dear, torch.tensor([8.0, 8.0]).expand(20, 2), chance, 0).parent
        == 0
    ).all()


def test_the_goals_share_goes_to_nodes_that_have_not_tried_it_the_nearest_first() -> (
    None
):
    loop = make_loop(open_map())
    tree = extended(
        loop, planted(loop), [0, 0, 0], [(5.0, 8.0), (4.0, 8.0), (6.0, 8.0)]
    )
    sample_m, chance = torch.tensor([[15.0, 1.0]]).expand(5, 2), torch.zeros(5)
    first = choose(loop, tree, sample_m, chance, 2)
    assert first.parent[0, :2].tolist() == [3, 1]
    assert first.aimed.tolist() == [[True, True, False, False, False]]
    torch.testing.assert_close(first.target_m[0, :2], loop.problem.goal_m.expand(2, 2))
    torch.testing.assert_close(first.target_m[0, 2:], sample_m[2:])
    begin = states_at(tree, first.parent)
    reference, length_m = draw_references(loop, begin.state, first.target_m)
    larger = add(loop, tree, first, drive(loop, begin, reference, length_m))
    again = choose(loop, larger, sample_m[:1].expand(9, 2), torch.zeros(9), 9)
    left = larger.to_goal_m[0].isfinite()
    left[[1, 3]] = False
    assert (
        sorted(again.parent[0][again.aimed[0]].tolist())
        == left.nonzero()[:, 0].tolist()
    )
    lengths = larger.to_goal_m[0][again.parent[0][again.aimed[0]]]
    assert (lengths.diff() >= 0).all()


@pytest.mark.parametrize(("goal_edges", "aimed"), [(0, 0), (1, 1), (3, 3), (5, 4)])
def test_no_more_edges_aim_at_the_goal_than_are_asked_for_or_there_are_nodes(
    goal_edges: int, aimed: int
) -> None:
    loop = make_loop(open_map())
    tree = extended(
        loop, planted(loop), [0, 0, 0], [(5.0, 8.0), (4.0, 8.0), (6.0, 8.0)]
    )
    choice = choose(
        loop, tree, torch.tensor([[15.0, 1.0]]).expand(8, 2), torch.zeros(8), goal_edges
    )
    assert choice.aimed.sum() == aimed
    assert (choice.target_m == loop.problem.goal_m).all(dim=-1).sum() == aimed


def test_a_way_costs_its_time_and_the_penalty_of_metres_that_are_not_free() -> None:
    loop = make_loop(walled_map(), crossing=True)
    tree = extended(loop, planted(loop), [0], [(7.0, 8.0)])
    tree = extended(loop, tree, [1], [(11.0, 8.0)])
    tree = extended(loop, tree, [2], [(13.0, 8.0)])
    torch.testing.assert_close(
        tree.time_s[0],
        torch.tensor([0, 5, 5 + 3.75 + 3.33, 12.08 + 1.25]),
        rtol=0,
        atol=0.6,
    )
    torch.testing.assert_close(
        tree.blocked_m[0], torch.tensor([0.0, 0.0, 1.0, 1.0]), rtol=0, atol=0.1
    )
    torch.testing.assert_close(tree.cost, tree.time_s + PENALTY * tree.blocked_m)
    torch.testing.assert_close(tree.best[0], tree.cost[:, 3])


def test_cheapest_way_is_taken_and_one_that_crosses_is_partial() -> None:
    loop = make_loop(walled_map(gap=GAP), crossing=True)
    across = extended(loop, planted(loop), [0], [(7.0, 8.0)])
    across = extended(
        loop, extended(loop, across, [1], [(11.0, 8.0)]), [2], [(13.0, 8.0)]
    )
    route = best_route(loop, across, 5)
    assert route.status.tolist() == [PlanStatus.PARTIAL]
    assert route.depth.tolist() == [3]
    assert known(route.path[0])[-1, 0] > 11.9
    around = across
    for node, target in (
        (0, (6.0, 11.5)),
        (4, (8.5, 13.0)),
        (5, (11.0, 11.0)),
        (6, (13.0, 8.0)),
    ):
        around = extended(loop, around, [node], [target])
    assert around.arrived[0].nonzero()[:, 0].tolist() == [3, 7]
    assert around.time_s[0, 7] > around.time_s[0, 3]
    free = best_route(loop, around, 5)
    assert free.status.tolist() == [PlanStatus.OK]
    assert free.depth.tolist() == [4]
    assert loop.problem.free_at(known(free.path[0])[None]).all()


def test_partial_route_leads_nearest_to_the_goal_and_is_left_before_its_end() -> None:
    loop = make_loop(walled_map())
    tree = extended(loop, planted(loop), [0, 0], [(5.0, 8.0), (4.5, 8.0)])
    route = best_route(loop, tree, 4)
    assert route.status.tolist() == [PlanStatus.PARTIAL]
    assert route.depth.tolist() == [1]
    assert known(route.path[0])[-1, 0] == pytest.approx(5.0, abs=0.1)
    assert route.end_m[0, 0].item() == pytest.approx(
        tree.end_m[0, 1].item() - 0.3, abs=1e-5
    )
    assert best_route(
        loop, extended(loop, planted(loop), [0], [(3.4, 8.0)]), 4
    ).depth.tolist() == [0]


def test_partial_route_rather_leads_to_free_ground_than_nearer_to_the_goal() -> None:
    maps = open_map()
    maps[:, 12:20, 4:16] = 0.1  # about the start, to x = 8 m
    loop = make_loop(maps)
    tree = extended(loop, planted(loop), [0, 0], [(7.0, 8.0), (4.0, 11.0)])
    assert tree.at.free.tolist() == [[False, False, True]]
    assert tree.to_goal_m[0, 1] < tree.to_goal_m[0, 2]
    end = known(best_route(loop, tree, 4).path[0])[-1]
    torch.testing.assert_close(end, tree.at.state[0, 2, :2])


def test_best_route_is_a_question_that_changes_nothing() -> None:
    loop = make_loop(walled_map())
    tree = extended(loop, planted(loop), [0, 0], [(5.0, 8.0), (4.5, 8.0)])
    before = [tensor.clone() for tensor in tensors(tree)]
    first, second = best_route(loop, tree, 4), best_route(loop, tree, 4)
    for kept, tensor in zip(before, tensors(tree), strict=True):
        torch.testing.assert_close(tensor, kept, rtol=0, atol=0, equal_nan=True)
    for one, other in zip(tensors(first), tensors(second), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)


def test_tree_is_a_value() -> None:
    loop = make_loop(open_map())
    tree = planted(loop)
    larger = extended(loop, tree, [0, 0], [(5.0, 8.0), (4.5, 8.0)])
    assert tree.time_s.shape == (1, 1)
    assert all(tensor.shape[:2] == (1, 3) for tensor in tensors(larger))
    for old, new in zip(tensors(tree), tensors(larger), strict=True):
        torch.testing.assert_close(new[:, :1], old, equal_nan=True)
    for field in fields(tree):
        with pytest.raises(FrozenInstanceError):
            setattr(tree, field.name, None)


def test_search_grows_one_edge_an_expansion_and_gives_routes_of_one_shape() -> None:
    loop = make_loop(torch.cat((open_map(), walled_map(gap=GAP))))
    route = searched(loop, rounds=8, count=10)
    assert route.tree.shape[:2] == (2, 80)
    blank = no_route(loop, 8, 80)
    for field in fields(route):
        got, expected = getattr(route, field.name), getattr(blank, field.name)
        assert got.shape == expected.shape
        assert got.dtype == expected.dtype
    assert blank.status.tolist() == [PlanStatus.PARTIAL] * 2
