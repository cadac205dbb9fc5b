"""The tree of CL-RRT and the search that grows it.

`search` is the whole of a plan and reads top-down: plant a root; in each round choose nodes and where to go
from them, draw references, drive along them (`edges`), and add their ends as nodes; at last take the best
route. A tree is a value: a table of nodes, of which every round makes a longer one.

- Nodes are chosen by Kuwata's mix of two heuristics: the nearest in Dubins length (explore), or the one
  through which the point is reached soonest (optimise). Before a way to the goal is known 70 % of the
  choices explore, afterwards 30 %, and nodes that cannot improve on the best way are left out.
- The goal's share of the edges goes to nodes that have not tried it yet, the most promising first: a condition
  has no chance in it, so that a second one from the same node would be a copy. The source tries the goal from
  every new node.
- A way costs its simulated time, and `PENALTY` for each metre of it on ground that is not free.

Source: Kuwata et al. (2009), section IV and algorithm 1. Letters in shapes: B episodes, R edges of a round,
V nodes, E edges of a finished tree, D edges of a path, N points of a reference, of which Q are drawn, P drawn
points of an edge.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor

from benchnav.planning.free_space import PENALTY
from benchnav.planning.objective import distance
from benchnav.planning.planners.cl_rrt.dubins import dubins_length_to_point
from benchnav.planning.planners.cl_rrt.edges import (
    DRAWN_M,
    SPACING_M,
    ClosedLoop,
    Edges,
    LoopState,
    draw_references,
    drive,
)
from benchnav.planning.planners.cl_rrt.pursuit import Tracking
from benchnav.planning.planners.planner import PlanStatus

T = TypeVar("T")

_EXPLORE = (0.7, 0.3)  # share of choices that explore, before and after a way to the goal is known
_PARTIAL_GAIN_M = 0.5  # a partial path that leads no further than this toward the goal is none
_MARGIN_M = 0.3  # a partial path is left so far before its end, which may lie close to what is not free
_FAR_M = 1e4  # longer than any way on a map


@dataclass(frozen=True, kw_only=True)
class Tree:
    """Trees of B episodes. Node 0 is the root; every other is the end of the edge that leads to it.

    Args:
        at: where the closed loop stands at each node, shapes [B, V, …].
        time_s: simulated time from the root, inf for what is left of rejected edges, shape [B, V].
        blocked_m: metres on ground that is not free from the root, shape [B, V].
        to_goal_m: Dubins length on to the goal, inf where rejected, shape [B, V].
        arrived: the node is at the goal, bool, shape [B, V].
        parent: node at which the edge begins, int64, shape [B, V].
        target_m: point that its reference leads to, shape [B, V, 2].
        aimed: that point is the goal, bool, shape [B, V].
        end_m: arc length along the reference at which the edge ends, shape [B, V].
        drawn: positions along the edge, NaN past its end, shape [B, V, P, 2].
    """

    at: LoopState
    time_s: Tensor
    blocked_m: Tensor
    to_goal_m: Tensor
    arrived: Tensor
    parent: Tensor
    target_m: Tensor
    aimed: Tensor
    end_m: Tensor
    drawn: Tensor

    @property
    def cost(self) -> Tensor:
        """What the way to each node costs, shape [B, V]."""
        return self.time_s + PENALTY * self.blocked_m

    @property
    def best_cost(self) -> Tensor:
        """What the best way to the goal costs, inf where none is known, shape [B]."""
        return torch.where(self.arrived, self.cost, math.inf).amin(dim=1)


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Which edges a round tries.

    Args:
        node: where each begins, int64, shape [B, R].
        target_m: point that it is to reach, shape [B, R, 2].
        aimed: that point is the goal, bool, shape [B, R].
    """

    node: Tensor
    target_m: Tensor
    aimed: Tensor


@dataclass(frozen=True, kw_only=True)
class Route:
    """What was planned for each episode.

    Args:
        status: `PlanStatus`: OK where the path leads to the goal and enters free ground alone, else PARTIAL.
        depth: edges of the path, 0 where there is none, int64, shape [B].
        rows: references of the edges, as `Reference` keeps them, shape [B, D, N, 4].
        end_m: arc length at which each reference is left for the next, shape [B, D].
        path: predicted positions, NaN where unused, shape [B, D·P, 2].
        line: points of those references as far as they are driven, NaN where unused, shape [B, D·Q, 2].
        tree: predicted positions along all edges, NaN where unused, shape [B, E, P, 2].
    """

    status: Tensor
    depth: Tensor
    rows: Tensor
    end_m: Tensor
    path: Tensor
    line: Tensor
    tree: Tensor


def search(
    loop: ClosedLoop, root: Tensor, tracking: Tracking, sample_m: Tensor, chance: Tensor, goal_edges: int
) -> Route:
    """Grows a tree for each episode and takes the best route of each.

    Args:
        loop: robots, controller and ground.
        root: states to plan from, shape [B, S].
        tracking: of the controllers there, shape [B].
        sample_m: points to reach, D rounds of them, shape [D, R, 2].
        chance: uniform in [0, 1), decides by which heuristic each node is chosen, shape [D, R].
        goal_edges: edges of a round that aim at the goal.
    """
    tree = plant(loop, root, tracking)
    for points_m, chances in zip(sample_m, chance, strict=True):
        choice = choose(loop, tree, points_m, chances, goal_edges)
        begin = stand(tree, choice.node)
        reference, length_m = draw_references(loop, begin.state[..., :3], choice.target_m)
        tree = add(loop, tree, choice, drive(loop, begin, reference, length_m))
    return best_route(loop, tree, len(sample_m))


def plant(loop: ClosedLoop, root: Tensor, tracking: Tracking) -> Tree:
    """A tree of the root alone; arguments as for `search`."""
    zero = torch.zeros_like(root[:, :1])
    false = torch.zeros_like(zero, dtype=torch.bool)
    free = loop.problem.free_at(root)
    begin = LoopState(state=root, tracking=tracking, free=free)
    at = map_tensors(lambda values: values[:, None], begin)
    return Tree(
        at=at,
        time_s=zero,
        blocked_m=zero,
        to_goal_m=_to_goal_m(loop, at.state),
        arrived=false,
        parent=torch.zeros_like(zero, dtype=torch.int64),
        target_m=root[:, None, :2],
        aimed=false,
        end_m=zero,
        drawn=root.new_full((len(root), 1, loop.drawn_points, 2), math.nan),
    )


def choose(loop: ClosedLoop, tree: Tree, sample_m: Tensor, chance: Tensor, goal_edges: int) -> Choice:
    """Chooses nodes, and where to go from them.

    Args:
        loop: robots, controller and ground.
        tree: so far.
        sample_m: points to reach, shape [R, 2].
        chance: uniform in [0, 1), shape [R].
        goal_edges: how many of the R edges go to the goal instead, while there are nodes that have not.
    """
    best = tree.best_cost[:, None]
    found = best < math.inf
    straight_m = (distance(tree.at.state, loop.problem.goal_m[:, None]) - loop.problem.goal_radius_m).clamp(
        min=0
    )
    closed = tree.cost + straight_m / loop.follower.speed_mps[1] >= best  # cannot improve on the best way
    closed_m = torch.where(closed, math.inf, 0.0)
    # The time of the way to each node, as the length driven in it at the wanted speed.
    spent_m = torch.where(closed, 0, loop.follower.wanted_mps * tree.time_s)

    # Line 2 of algorithm 1: the first node by length alone (explore), or by the whole way (optimise).
    explore = chance < torch.where(found, _EXPLORE[1], _EXPLORE[0])  # [B, R]
    length_m = dubins_length_to_point(
        tree.at.state[:, None, :, :3], sample_m[:, None], loop.radius_m[:, None, None]
    )
    before_m = torch.where(explore[..., None], 0, spent_m[:, None]) + closed_m[:, None]
    node = (length_m + before_m).argmin(dim=-1)
    target_m = sample_m.expand(len(node), -1, -1)
    lanes = min(goal_edges, tree.parent.shape[1])
    if not lanes:
        return Choice(node=node, target_m=target_m, aimed=torch.zeros_like(node, dtype=torch.bool))

    # Lines 13–20: the goal.
    tried = torch.zeros_like(tree.time_s).scatter_add(1, tree.parent, tree.aimed.to(tree.time_s)) > 0
    promise_m = tree.to_goal_m + closed_m + torch.where(found, spent_m, 0)
    promise_m, promising = torch.where(tried, math.inf, promise_m).topk(lanes, dim=1, largest=False)
    aimed = torch.nn.functional.pad(promise_m < math.inf, (0, node.shape[1] - lanes))
    promising = torch.nn.functional.pad(promising, (0, node.shape[1] - lanes))
    return Choice(
        node=torch.where(aimed, promising, node),
        target_m=torch.where(aimed[..., None], loop.problem.goal_m[:, None], target_m),
        aimed=aimed,
    )


def stand(tree: Tree, node: Tensor) -> LoopState:
    """Where the closed loop stands at nodes, int64 [B, R]."""
    return map_tensors(lambda values: _take(values, node), tree.at)


def add(loop: ClosedLoop, tree: Tree, choice: Choice, edges: Edges) -> Tree:
    """The tree with the ends of edges as its next nodes, rejected ones too, so that tables stay of a size."""
    time_s = torch.where(edges.kept, tree.time_s.gather(1, choice.node) + edges.time_s, math.inf)
    new = Tree(
        at=edges.end,
        time_s=time_s,
        blocked_m=tree.blocked_m.gather(1, choice.node) + edges.blocked_m,
        to_goal_m=torch.where(edges.kept, _to_goal_m(loop, edges.end.state), math.inf),
        arrived=edges.arrived & edges.kept,
        parent=choice.node,
        target_m=choice.target_m,
        aimed=choice.aimed,
        end_m=edges.end_m,
        drawn=edges.drawn,
    )
    return map_tensors(lambda old, added: torch.cat((old, added), dim=1), tree, new)


def best_route(loop: ClosedLoop, tree: Tree, rounds: int) -> Route:
    """Takes the cheapest path to the goal or, where there is none, the best partial one.

    Args:
        loop: robots, controller and ground.
        tree: grown.
        rounds: in which it was grown, so that no path has more edges: D.
    """
    found = tree.best_cost < math.inf
    cheapest = torch.where(tree.arrived, tree.cost, math.inf).argmin(dim=1)
    chain = [torch.where(found, cheapest, _best_partial(tree))]
    for _ in range(rounds):
        chain.append(tree.parent.gather(1, chain[-1][:, None])[:, 0])
    backward = torch.stack(chain, dim=1)  # ends in zeros
    depth = (backward > 0).sum(dim=1)
    order = depth[:, None] - 1 - torch.arange(rounds, device=depth.device)
    nodes = torch.where(order >= 0, backward.gather(1, order.clamp(min=0)), 0)
    end_m = tree.end_m.gather(1, nodes)
    early = (order == 0) & ~found[:, None]
    crossed = loop.crossing & (tree.blocked_m.gather(1, chain[0][:, None])[:, 0] > 0)
    status = torch.where(found & ~crossed, PlanStatus.OK, PlanStatus.PARTIAL)
    return _describe(loop, tree, status, nodes, torch.where(early, end_m - _MARGIN_M, end_m))


def no_route(loop: ClosedLoop, rounds: int, edges: int) -> Route:
    """Routes without a path, of the shapes that searched ones have."""
    batch, start = len(loop.problem), loop.problem.start
    points = rounds * len(range(0, loop.reference_points, round(DRAWN_M / SPACING_M)))
    return Route(
        status=torch.full((batch,), PlanStatus.PARTIAL, device=start.device),
        depth=torch.zeros(batch, dtype=torch.int64, device=start.device),
        rows=start.new_zeros(batch, rounds, loop.reference_points, 4),
        end_m=start.new_zeros(batch, rounds),
        path=start.new_full((batch, rounds * loop.drawn_points, 2), math.nan),
        line=start.new_full((batch, points, 2), math.nan),
        tree=start.new_full((batch, edges, loop.drawn_points, 2), math.nan),
    )


def map_tensors(change: Callable[..., Tensor], *values: T) -> T:
    """Applies a function to the tensors that have the same place in dataclasses of one kind."""
    changed: dict[str, Any] = {}
    for field in fields(values[0]):  # type: ignore[arg-type]
        items = [getattr(value, field.name) for value in values]
        changed[field.name] = map_tensors(change, *items) if is_dataclass(items[0]) else change(*items)
    return type(values[0])(**changed)


def _best_partial(tree: Tree) -> Tensor:
    """Nodes nearest to the goal, those on free ground first; the root unless that gains enough."""
    remaining_m = tree.to_goal_m + torch.where(tree.at.free, 0.0, _FAR_M)
    least_m, node = remaining_m.min(dim=1)
    return torch.where(remaining_m[:, 0] - least_m > _PARTIAL_GAIN_M, node, 0)


def _describe(loop: ClosedLoop, tree: Tree, status: Tensor, nodes: Tensor, end_m: Tensor) -> Route:
    """Describes paths through nodes, int64 [B, D], 0 past the end of each."""
    used = (nodes > 0)[..., None]
    pose = stand(tree, tree.parent.gather(1, nodes)).state[..., :3]
    reference, _ = draw_references(loop, pose, _take(tree.target_m, nodes))
    rows = reference.rows.reshape(*nodes.shape, -1, 4)
    points = rows[:, :, :: round(DRAWN_M / SPACING_M), :2]
    arc_m = torch.arange(points.shape[2], device=rows.device) * DRAWN_M
    driven = used & (arc_m <= end_m[..., None])
    drawn = _take(tree.drawn.flatten(2), nodes).reshape(*nodes.shape, -1, 2)
    return Route(
        status=status,
        depth=(nodes > 0).sum(dim=1),
        rows=rows,
        end_m=end_m,
        path=_pack(torch.where(used[..., None], drawn, math.nan).flatten(1, 2)),
        line=_pack(torch.where(driven[..., None], points, math.nan).flatten(1, 2)),
        tree=torch.where(tree.time_s[:, 1:, None, None] < math.inf, tree.drawn[:, 1:], math.nan),
    )


def _to_goal_m(loop: ClosedLoop, state: Tensor) -> Tensor:
    """Dubins lengths from states [B, V, S] to the goals, shape [B, V]."""
    return dubins_length_to_point(state[..., :3], loop.problem.goal_m[:, None], loop.radius_m[:, None])


def _take(values: Tensor, index: Tensor) -> Tensor:
    """Picks from the second dimension: values [B, V, *F] at indices [B, R] give [B, R, *F]."""
    if values.dim() == 2:
        return values.gather(1, index)
    return values.gather(1, index[..., None].expand(-1, -1, values.shape[-1]))


def _pack(points: Tensor) -> Tensor:
    """Moves points that are not NaN to the front, in their order, shape [B, N, 2]."""
    order = points[..., 0].isnan().to(torch.uint8).argsort(dim=1, stable=True)
    return _take(points, order)
