"""The tree of CL-RRT and the search that grows it.

`search` is the whole of a plan and reads top-down: plant a root; in each round choose
nodes and where to go from them, draw references, drive along them (`edges`), and add
their ends as nodes; at last take the best
route. A tree is a value: a table of nodes, of which every round makes a longer one.

- Nodes are chosen by Kuwata's mix of two heuristics: the nearest in Dubins length
  (explore), or the one through which the point is reached soonest (optimise). Before a
  way to the goal is known 70 % of the choices explore, afterwards 30 %, and nodes that
  cannot improve on the best way are left out.
- The goal's share of the edges goes to nodes that have not tried it yet, the most
  promising first: an attempt is deterministic, so a second one from the same node would
  be a copy. The source tries the goal from every new node.
- A way costs its simulated time, and `PENALTY` for each metre of it on ground that is
  not free.

Source: Kuwata et al. (2009), section IV and algorithm 1. Letters in shapes: B episodes,
R edges of a round, V nodes, E edges of a finished tree, D edges of a path, N points of
a reference, of which Q are drawn, P drawn points of an edge.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from benchnav.core.batch import Batch, map_tensors
from benchnav.planning.free_space import PENALTY
from benchnav.planning.objective import distance
from benchnav.planning.planners.cl_rrt.edges import (
    DRAWN_M,
    ClosedLoop,
    Edges,
    LoopState,
    draw_references,
    drive,
)
from benchnav.planning.planners.cl_rrt.pursuit import SPACING_M, Tracking
from benchnav.planning.planners.dubins import dubins_length_to_point
from benchnav.planning.planners.planner import PlanStatus

# Fraction of choices that explore, before and after a path to the goal is known.
_EXPLORE = (0.7, 0.3)
_PARTIAL_GAIN_M = 0.5  # minimum gain toward the goal of a partial path
# Distance before its end at which a partial path is left, since the end may be close to
# non-free cells.
_MARGIN_M = 0.3
_FAR_M = 1e4  # longer than any path on a map


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Edges that a round tries.

    Args:
        parent: node at which each begins, int64, shape [B, R].
        target_m: end point (x, y) of its reference in metres, shape [B, R, 2].
        aimed: mask of edges to the goal, bool, shape [B, R].
    """

    parent: Tensor
    target_m: Tensor
    aimed: Tensor


@dataclass(frozen=True, kw_only=True)
class Tree(Choice, Edges):
    """Trees of B episodes. Node 0 is the root; every other is the end of the edge that
    leads to it.

    Edges are as they were chosen and driven, V in place of R, but that their times, inf
    where nothing is left of one, and metres that are not free count from the root.

    Args:
        to_goal_m: Dubins length on to the goal, inf where nothing is left of the edge,
            shape [B, V].
    """

    to_goal_m: Tensor

    @property
    def cost(self) -> Tensor:
        """Cost of the path to each node, shape [B, V]."""
        return self.time_s + PENALTY * self.blocked_m

    @property
    def best(self) -> tuple[Tensor, Tensor]:
        """Cost of the best path to the goal, inf without one, and its node, each [B]."""
        return torch.where(self.arrived, self.cost, math.inf).min(dim=1)


@dataclass(frozen=True, kw_only=True)
class Route(Batch):
    """Plan of each episode.

    Args:
        status: `PlanStatus`: OK where the path leads to the goal and enters free ground
            alone, else PARTIAL.
        depth: edges of the path, 0 without a path, int64, shape [B].
        rows: references of the edges, as `Reference` keeps them, shape [B, D, N, 4].
        end_m: arc length at which each reference is left for the next, shape [B, D].
        path: predicted positions, NaN where unused, shape [B, D·P, 2].
        tree: predicted positions along all edges, NaN where unused, shape [B, E, P, 2].
    """

    status: Tensor
    depth: Tensor
    rows: Tensor
    end_m: Tensor
    path: Tensor
    tree: Tensor

    def pieces(self, most_m: float) -> tuple[Tensor, Tensor]:
        """Split paths into short straight pieces.

        Args:
            most_m: maximum length of a piece, where the drawn points are `DRAWN_M`
                apart.

        Returns:
            Midpoints (x, y), shape [B, K, 2], and lengths, shape [B, K]; 0 m at (0, 0)
            past the end of a path.
        """
        count = math.ceil(DRAWN_M / most_m)
        offset = self.path.diff(dim=1)[:, :, None]
        at = (torch.arange(count, device=offset.device) + 0.5) / count
        points = (
            (self.path[:, :-1, None] + at[:, None] * offset)
            .flatten(1, 2)
            .nan_to_num(nan=0.0)
        )
        length_m = (
            torch.linalg.vector_norm(offset, dim=-1).expand(-1, -1, count) / count
        )
        return points, length_m.flatten(1, 2).nan_to_num(nan=0.0)

    @property
    def line(self) -> Tensor:
        """Points of the references as far as they are driven, shape [B, D·Q, 2].

        Unused points are NaN.
        """
        points = self.rows[:, :, :: round(DRAWN_M / SPACING_M), :2]
        arc_m = torch.arange(points.shape[2], device=points.device) * DRAWN_M
        used = (
            torch.arange(self.rows.shape[1], device=points.device) < self.depth[:, None]
        )
        driven = used[..., None] & (arc_m <= self.end_m[..., None])
        return _pack(torch.where(driven[..., None], points, math.nan).flatten(1, 2))


def search(
    loop: ClosedLoop,
    root: Tensor,
    tracking: Tracking,
    sample_m: Tensor,
    chance: Tensor,
    goal_edges: int,
) -> Route:
    """Return the best route of a tree grown for each episode.

    Args:
        loop: robots, controller and ground.
        root: states to plan from, shape [B, S].
        tracking: of the controllers there, shape [B].
        sample_m: points to reach, D rounds of them, shape [D, R, 2].
        chance: uniform in [0, 1), decides by which heuristic each node is chosen, shape
            [D, R].
        goal_edges: edges of a round that aim at the goal.
    """
    tree = plant(loop, root, tracking)
    for points_m, chances in zip(sample_m, chance, strict=True):
        choice = choose(loop, tree, points_m, chances, goal_edges)
        begin = stand(tree, choice.parent)
        reference, length_m = draw_references(
            loop, begin.state[..., :3], choice.target_m
        )
        tree = add(loop, tree, choice, drive(loop, begin, reference, length_m))
    return best_route(loop, tree, len(sample_m))


def plant(loop: ClosedLoop, root: Tensor, tracking: Tracking) -> Tree:
    """Return a tree of only the root; arguments as for `search`."""
    begin = LoopState(state=root, tracking=tracking, free=loop.problem.free_at(root))
    at = map_tensors(begin, lambda values: values[:, None])
    zero = torch.zeros_like(root[:, :1])
    false = zero.bool()
    return Tree(
        parent=zero.long(),
        target_m=at.state[..., :2],
        aimed=false,
        at=at,
        exists=~false,
        time_s=zero,
        blocked_m=zero,
        arrived=false,
        end_m=zero,
        drawn=zero.new_full((len(root), 1, loop.drawn_points, 2), math.nan),
        to_goal_m=_to_goal_m(loop, at.state),
    )


def choose(
    loop: ClosedLoop, tree: Tree, sample_m: Tensor, chance: Tensor, goal_edges: int
) -> Choice:
    """Choose nodes, and targets of edges from them.

    Args:
        loop: robots, controller and ground.
        tree: so far.
        sample_m: points to reach, shape [R, 2].
        chance: uniform in [0, 1), shape [R].
        goal_edges: how many of the R edges go to the goal instead, while there are
            nodes that have not.
    """
    best = tree.best[0][:, None]
    is_reached = best < math.inf
    straight_m = (
        distance(tree.at.state, loop.problem.goal_m[:, None])
        - loop.problem.goal_radius_m
    ).clamp(min=0)
    # cannot improve on the best way
    closed = tree.cost + straight_m / loop.follower.speed_mps[1] >= best
    closed_m = torch.where(closed, math.inf, 0.0)
    # The time of the way to each node, as the length driven in it at the wanted speed.
    spent_m = torch.where(closed, 0, loop.follower.wanted_mps * tree.time_s)

    # Line 2 of algorithm 1: the first node by length alone (explore), or by the whole
    # way (optimise).
    explore = chance < torch.where(is_reached, _EXPLORE[1], _EXPLORE[0])  # [B, R]
    length_m = dubins_length_to_point(
        tree.at.state[:, None, :, :3], sample_m[:, None], loop.radius_m[:, None, None]
    )
    before_m = torch.where(explore[..., None], 0, spent_m[:, None]) + closed_m[:, None]
    node = (length_m + before_m).argmin(dim=-1)
    target_m = sample_m.expand(len(node), -1, -1)

    # Lines 13–20: the goal.
    lanes = min(goal_edges, tree.parent.shape[1])
    tried = (
        torch.zeros_like(tree.time_s).scatter_add(
            1, tree.parent, tree.aimed.to(tree.time_s)
        )
        > 0
    )
    promise_m = tree.to_goal_m + closed_m + torch.where(is_reached, spent_m, 0)
    promise_m, promising = torch.where(tried, math.inf, promise_m).topk(
        lanes, dim=1, largest=False
    )
    others = (0, node.shape[1] - lanes)
    aimed, promising = pad(promise_m < math.inf, others), pad(promising, others)
    return Choice(
        parent=torch.where(aimed, promising, node),
        target_m=torch.where(aimed[..., None], loop.problem.goal_m[:, None], target_m),
        aimed=aimed,
    )


def stand(tree: Tree, node: Tensor) -> LoopState:
    """Return the closed-loop state at nodes, int64 [B, R]."""
    return map_tensors(tree.at, lambda values: _take(values, node))


def add(loop: ClosedLoop, tree: Tree, choice: Choice, edges: Edges) -> Tree:
    """Return the tree with the ends of edges as its next nodes.

    Rejected edges are added too, so that the size of tables is constant.
    """
    exists, parent = edges.exists, choice.parent
    edges = replace(
        edges,
        time_s=torch.where(
            exists, tree.time_s.gather(1, parent) + edges.time_s, math.inf
        ),
        blocked_m=tree.blocked_m.gather(1, parent) + edges.blocked_m,
        arrived=edges.arrived & exists,
    )
    to_goal_m = torch.where(exists, _to_goal_m(loop, edges.at.state), math.inf)
    new = Tree(**vars(choice), **vars(edges), to_goal_m=to_goal_m)
    return map_tensors(tree, lambda old, added: torch.cat((old, added), dim=1), new)


def best_route(loop: ClosedLoop, tree: Tree, rounds: int) -> Route:
    """Return the cheapest path to the goal or, without one, the best partial path.

    Args:
        loop: robots, controller and ground.
        tree: grown.
        rounds: in which it was grown, so that no path has more edges: D.
    """
    cost, cheapest = tree.best
    is_reached = cost < math.inf
    chain = [torch.where(is_reached, cheapest, _best_partial(tree))[:, None]]
    for _ in range(rounds):
        chain.append(tree.parent.gather(1, chain[-1]))
    backward = torch.cat(chain, dim=1)  # ends in zeros
    depth = (backward > 0).sum(dim=1)
    order = depth[:, None] - 1 - torch.arange(rounds, device=depth.device)
    nodes = torch.where(order >= 0, backward.gather(1, order.clamp(min=0)), 0)
    end_m = tree.end_m.gather(1, nodes)
    early = (order == 0) & ~is_reached[:, None]
    crossed = loop.crossing & (tree.blocked_m.gather(1, chain[0])[:, 0] > 0)

    pose = stand(tree, tree.parent.gather(1, nodes)).state[..., :3]
    reference, _ = draw_references(loop, pose, _take(tree.target_m, nodes))
    drawn = _take(tree.drawn.flatten(2), nodes).unflatten(-1, (-1, 2))
    return Route(
        status=torch.where(is_reached & ~crossed, PlanStatus.OK, PlanStatus.PARTIAL),
        depth=depth,
        rows=reference.rows.reshape(*nodes.shape, -1, 4),
        end_m=torch.where(early, end_m - _MARGIN_M, end_m),
        path=_pack(
            torch.where((nodes > 0)[..., None, None], drawn, math.nan).flatten(1, 2)
        ),
        tree=torch.where(tree.exists[:, 1:, None, None], tree.drawn[:, 1:], math.nan),
    )


def no_route(loop: ClosedLoop, rounds: int, edges: int) -> Route:
    """Return routes without a path, of the shapes of searched ones."""
    root = plant(loop, loop.problem.start, Tracking.standing(loop.problem.start))
    tree = map_tensors(root, lambda values: values.repeat_interleave(1 + edges, dim=1))
    return best_route(loop, tree, rounds)


def _best_partial(tree: Tree) -> Tensor:
    """Return nodes nearest to the goal, those in free cells first.

    It is the root unless the gain is sufficient.
    """
    remaining_m = tree.to_goal_m + torch.where(tree.at.free, 0.0, _FAR_M)
    least_m, node = remaining_m.min(dim=1)
    return torch.where(remaining_m[:, 0] - least_m > _PARTIAL_GAIN_M, node, 0)


def _to_goal_m(loop: ClosedLoop, state: Tensor) -> Tensor:
    """Return Dubins lengths from states [B, V, S] to the goals, shape [B, V]."""
    return dubins_length_to_point(
        state[..., :3], loop.problem.goal_m[:, None], loop.radius_m[:, None]
    )


def _take(values: Tensor, index: Tensor) -> Tensor:
    """Return values [B, V, *F] at indices [B, R] of the second dimension, [B, R, *F]."""
    return values.take_along_dim(index if values.dim() == 2 else index[..., None], 1)


def _pack(points: Tensor) -> Tensor:
    """Return points [B, N, 2] with those that are not NaN first, in their order."""
    order = points[..., 0].isnan().to(torch.uint8).argsort(dim=1, stable=True)
    return _take(points, order)
