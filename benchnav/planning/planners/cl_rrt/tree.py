"""The tree of CL-RRT and the search that grows it.

`search` computes a whole plan. It begins with a root and grows the tree in rounds. A
round chooses nodes and a target for each node, simulates the robot along references to
the targets (`edges`), and adds the ends of the edges as nodes. Finally the best route
is selected. A tree is an immutable table of nodes; each round returns a longer table.

- For each sampled point, a node is chosen by Kuwata's mix of two heuristics: the node
  with the shortest Dubins path to the point (explore), or the node through which the
  robot reaches the point soonest (optimise). 70 % of the choices explore before a path
  to the goal is found, and 30 % afterwards. Nodes that cannot improve on the best path
  are excluded.
- Edges to the goal start from nodes without such an edge, the most promising nodes
  first. A simulation is deterministic, so a second edge from the same node would be a
  copy. Kuwata et al. instead try an edge to the goal from each new node.
- The cost of a path is its simulated time, plus `PENALTY` for each metre in non-free
  cells.

Source: Kuwata et al. (2009), section IV and algorithm 1. Letters in shapes: B episodes,
R edges of a round, V nodes, E edges of a finished tree, D edges of a path, K segments
of a path, N points of a reference, Q stored points of a reference, P stored points of
an edge, S state dimensions.
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

# Fraction of choices that explore, before and after a path to the goal is found.
_EXPLORE = (0.7, 0.3)
_PARTIAL_GAIN_M = 0.5  # minimum gain of a partial path toward the goal, in metres
# Distance in metres before the end of a partial path at which the robot stops following
# it, since the end may be close to non-free cells.
_MARGIN_M = 0.3
_FAR_M = 1e4  # length in metres; every path on a map is shorter


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Edges that a round tries.

    Args:
        parent: index of the node at which each edge begins, int64, shape [B, R].
        target_m: end point (x, y) of each edge's reference in metres, shape [B, R, 2].
        aimed: mask of edges whose target is the goal, bool, shape [B, R].
    """

    parent: Tensor
    target_m: Tensor
    aimed: Tensor


@dataclass(frozen=True, kw_only=True)
class Tree(Choice, Edges):
    """Trees of B episodes, as tables of nodes.

    Node 0 is the root, and each other node is the end of the edge that leads to it. The
    inherited fields describe these edges, with V instead of R in their shapes. Times,
    and distances in non-free cells, are measured from the root; the time of a rejected
    edge is inf.

    Args:
        to_goal_m: Dubins length from each node to the goal in metres, inf for rejected
            edges, shape [B, V].
    """

    to_goal_m: Tensor

    @property
    def cost(self) -> Tensor:
        """Cost of the path to each node, shape [B, V]."""
        return self.time_s + PENALTY * self.blocked_m

    @property
    def best(self) -> tuple[Tensor, Tensor]:
        """Cost of the best path to the goal, inf without a path, and its last node."""
        cost_to_goal = torch.where(self.arrived, self.cost, math.inf)
        return cost_to_goal.min(dim=1)


@dataclass(frozen=True, kw_only=True)
class Route(Batch):
    """Plan of each episode.

    Args:
        status: `PlanStatus` of each episode, shape [B]: OK if the path leads to the
            goal over free cells only, else PARTIAL.
        depth: number of edges of the path, 0 without a path, int64, shape [B].
        rows: references of the edges, as rows of `Reference`, shape [B, D, N, 4].
        end_m: arc length in metres at which each reference is left for the next, shape
            [B, D].
        path: predicted positions (x, y) along the path in metres, shape [B, D·P, 2]; NaN
            after its end.
        tree: predicted positions (x, y) along all edges in metres, shape [B, E, P, 2];
            unused positions are NaN.
    """

    status: Tensor
    depth: Tensor
    rows: Tensor
    end_m: Tensor
    path: Tensor
    tree: Tensor

    def segments(self, max_m: float) -> tuple[Tensor, Tensor]:
        """Split paths into short straight segments.

        Args:
            max_m: maximum length of a segment in metres, if the points of the path are
                at most `DRAWN_M` apart.

        Returns:
            Midpoints (x, y), shape [B, K, 2], and lengths, shape [B, K], in metres.
            Segments past the end of a path have length 0 at (0, 0).
        """
        count = math.ceil(DRAWN_M / max_m)
        offset = self.path.diff(dim=1)[:, :, None]
        fraction = (torch.arange(count, device=offset.device) + 0.5) / count
        points = self.path[:, :-1, None] + fraction[:, None] * offset
        points = points.flatten(1, 2).nan_to_num(nan=0.0)
        distance_m = torch.linalg.vector_norm(offset, dim=-1)
        length_m = distance_m.expand(-1, -1, count) / count
        return points, length_m.flatten(1, 2).nan_to_num(nan=0.0)

    @property
    def line(self) -> Tensor:
        """Points of the references up to their ends, shape [B, D·Q, 2].

        Unused points are NaN.
        """
        stride = round(DRAWN_M / SPACING_M)
        points = self.rows[:, :, ::stride, :2]
        device = points.device
        arc_m = torch.arange(points.shape[2], device=device) * DRAWN_M
        edge = torch.arange(points.shape[1], device=device)
        is_used = edge < self.depth[:, None]
        is_driven = is_used[..., None] & (arc_m <= self.end_m[..., None])
        driven_points = torch.where(is_driven[..., None], points, math.nan)
        return _pack(driven_points.flatten(1, 2))


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
        loop: robots, controller and terrain.
        root: states to plan from, shape [B, S].
        tracking: state of the controllers at the root, shape [B].
        sample_m: sampled points (x, y) that the edges of each round aim at, in metres,
            for D rounds, shape [D, R, 2].
        chance: uniform draws in [0, 1) that select the heuristic of each choice, shape
            [D, R].
        goal_edges: number of edges of a round that aim at the goal.
    """
    tree = plant(loop, root, tracking)
    for points_m, chances in zip(sample_m, chance, strict=True):
        choice = choose(loop, tree, points_m, chances, goal_edges)
        begin = states_at(tree, choice.parent)
        pose = begin.state[..., :3]
        reference, length_m = draw_references(loop, pose, choice.target_m)
        edges = drive(loop, begin, reference, length_m)
        tree = add(loop, tree, choice, edges)
    return best_route(loop, tree, len(sample_m))


def plant(loop: ClosedLoop, root: Tensor, tracking: Tracking) -> Tree:
    """Return a tree with only the root; the arguments are those of `search`."""
    free = loop.problem.free_at(root)
    begin = LoopState(state=root, tracking=tracking, free=free)
    at = map_tensors(begin, lambda values: values[:, None])
    zero = torch.zeros_like(root[:, :1])
    false = zero.bool()
    drawn_shape = len(root), 1, loop.drawn_points, 2
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
        drawn=zero.new_full(drawn_shape, math.nan),
        to_goal_m=_to_goal_m(loop, at.state),
    )


def choose(
    loop: ClosedLoop, tree: Tree, sample_m: Tensor, chance: Tensor, goal_edges: int
) -> Choice:
    """Choose nodes, and targets of edges from them.

    Args:
        loop: robots, controller and terrain.
        tree: tree of the previous rounds.
        sample_m: sampled points (x, y) to reach, in metres, shape [R, 2].
        chance: uniform draws in [0, 1) that select the heuristics, shape [R].
        goal_edges: maximum number of the R edges whose target is the goal instead of a
            point; only nodes without an edge to the goal are used.
    """
    problem = loop.problem
    goal_m = problem.goal_m[:, None]
    best_cost, _ = tree.best
    best_cost = best_cost[:, None]
    is_reached = best_cost < math.inf
    center_m = distance(tree.at.state, goal_m)
    straight_m = (center_m - problem.goal_radius_m).clamp(min=0)
    _, top_mps = loop.follower.speed_mps
    # These nodes cannot improve on the best path.
    closed = tree.cost + straight_m / top_mps >= best_cost
    closed_m = torch.where(closed, math.inf, 0.0)
    # Time from the root, as the distance driven in this time at the target speed.
    spent_m = loop.follower.wanted_mps * tree.time_s
    spent_m = torch.where(closed, 0, spent_m)

    # Line 2 of algorithm 1: the node with the shortest Dubins length to the point
    # (explore), or with the shortest path from the root through the node to the point
    # (optimise).
    explore_fraction = torch.where(is_reached, _EXPLORE[1], _EXPLORE[0])
    explore = chance < explore_fraction  # [B, R]
    pose = tree.at.state[:, None, :, :3]
    radius_m = loop.radius_m[:, None, None]
    length_m = dubins_length_to_point(pose, sample_m[:, None], radius_m)
    before_m = torch.where(explore[..., None], 0, spent_m[:, None])
    before_m = before_m + closed_m[:, None]
    node = (length_m + before_m).argmin(dim=-1)
    target_m = sample_m.expand(len(node), -1, -1)

    # Lines 13–20 of algorithm 1: edges to the goal.
    n_aimed = min(goal_edges, tree.parent.shape[1])
    no_attempts = torch.zeros_like(tree.time_s)
    aimed = tree.aimed.to(tree.time_s)
    tried = no_attempts.scatter_add(1, tree.parent, aimed) > 0
    promise_m = tree.to_goal_m + closed_m + torch.where(is_reached, spent_m, 0)
    promise_m = torch.where(tried, math.inf, promise_m)
    promise_m, promising = promise_m.topk(n_aimed, dim=1, largest=False)
    padding = (0, node.shape[1] - n_aimed)
    aimed = pad(promise_m < math.inf, padding)
    promising = pad(promising, padding)
    return Choice(
        parent=torch.where(aimed, promising, node),
        target_m=torch.where(aimed[..., None], goal_m, target_m),
        aimed=aimed,
    )


def states_at(tree: Tree, node: Tensor) -> LoopState:
    """Return the closed-loop states at nodes, int64, shape [B, R]."""
    return map_tensors(tree.at, lambda values: _take(values, node))


def add(loop: ClosedLoop, tree: Tree, choice: Choice, edges: Edges) -> Tree:
    """Return the tree with the ends of edges as further nodes.

    Rejected edges are also added, so that the tables of all episodes have the same
    size.
    """
    exists = edges.exists
    time_s = tree.time_s.gather(1, choice.parent) + edges.time_s
    blocked_m = tree.blocked_m.gather(1, choice.parent) + edges.blocked_m
    edges = replace(
        edges,
        time_s=torch.where(exists, time_s, math.inf),
        blocked_m=blocked_m,
        arrived=edges.arrived & exists,
    )
    to_goal_m = _to_goal_m(loop, edges.at.state)
    to_goal_m = torch.where(exists, to_goal_m, math.inf)
    new = Tree(**vars(choice), **vars(edges), to_goal_m=to_goal_m)
    return map_tensors(tree, lambda old, added: torch.cat((old, added), dim=1), new)


def best_route(loop: ClosedLoop, tree: Tree, rounds: int) -> Route:
    """Return the cheapest path to the goal, or else the best partial path.

    Args:
        loop: robots, controller and terrain.
        tree: finished tree.
        rounds: number of rounds of the tree, and maximum number of edges of a path, D.
    """
    cost, cheapest = tree.best
    is_reached = cost < math.inf
    last_node = torch.where(is_reached, cheapest, _best_partial(tree))[:, None]
    chain = [last_node]
    for _ in range(rounds):
        parent = tree.parent.gather(1, chain[-1])
        chain.append(parent)
    backward = torch.cat(chain, dim=1)  # The last entries are 0, the root.
    depth = (backward > 0).sum(dim=1)
    order = depth[:, None] - 1 - torch.arange(rounds, device=depth.device)
    forward = backward.gather(1, order.clamp(min=0))
    nodes = torch.where(order >= 0, forward, 0)
    end_m = tree.end_m.gather(1, nodes)
    is_last_partial = (order == 0) & ~is_reached[:, None]
    blocked_m = tree.blocked_m.gather(1, last_node)[:, 0]
    is_crossed = loop.crossing & (blocked_m > 0)
    is_ok = is_reached & ~is_crossed

    parents = tree.parent.gather(1, nodes)
    pose = states_at(tree, parents).state[..., :3]
    target_m = _take(tree.target_m, nodes)
    reference, _ = draw_references(loop, pose, target_m)
    path = _take(tree.drawn.flatten(2), nodes).unflatten(-1, (-1, 2))
    is_edge = (nodes > 0)[..., None, None]
    path = torch.where(is_edge, path, math.nan)
    exists = tree.exists[:, 1:, None, None]
    return Route(
        status=torch.where(is_ok, PlanStatus.OK, PlanStatus.PARTIAL),
        depth=depth,
        rows=reference.rows.reshape(*nodes.shape, -1, 4),
        end_m=torch.where(is_last_partial, end_m - _MARGIN_M, end_m),
        path=_pack(path.flatten(1, 2)),
        tree=torch.where(exists, tree.drawn[:, 1:], math.nan),
    )


def no_route(loop: ClosedLoop, rounds: int, edges: int) -> Route:
    """Return routes without a path, with the same shapes as routes from `search`."""
    start = loop.problem.start
    tracking = Tracking.standing(start)
    root = plant(loop, start, tracking)
    tree = map_tensors(root, lambda values: values.repeat_interleave(1 + edges, dim=1))
    return best_route(loop, tree, rounds)


def _best_partial(tree: Tree) -> Tensor:
    """Return the node of each tree that is nearest to the goal, int64, shape [B].

    Nodes in free cells take precedence. The root, 0, is returned if the gain is at most
    `_PARTIAL_GAIN_M`.
    """
    penalty_m = torch.where(tree.at.free, 0.0, _FAR_M)
    remaining_m = tree.to_goal_m + penalty_m
    min_m, node = remaining_m.min(dim=1)
    gain_m = remaining_m[:, 0] - min_m
    return torch.where(gain_m > _PARTIAL_GAIN_M, node, 0)


def _to_goal_m(loop: ClosedLoop, state: Tensor) -> Tensor:
    """Return Dubins lengths from states [B, V, S] to the goals, shape [B, V]."""
    goal_m = loop.problem.goal_m[:, None]
    return dubins_length_to_point(state[..., :3], goal_m, loop.radius_m[:, None])


def _take(values: Tensor, index: Tensor) -> Tensor:
    """Return values [B, V, *F] at indices [B, R] of dimension 1, shape [B, R, *F]."""
    return values.take_along_dim(index if values.dim() == 2 else index[..., None], 1)


def _pack(points: Tensor) -> Tensor:
    """Return points [B, N, 2] in the same order, but with all NaN points at the end."""
    is_nan = points[..., 0].isnan().to(torch.uint8)
    order = is_nan.argsort(dim=1, stable=True)
    return _take(points, order)
