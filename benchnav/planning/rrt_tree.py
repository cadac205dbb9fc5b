"""The tree of CL-RRT: grown by closed-loop simulation, edge by edge.

What the search keeps, how a node is chosen, how an edge is drawn, simulated and judged, and how the best
path is taken. `cl_rrt` says what the planner does with it and why it is so; same source, same letters.
"""

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from benchnav.errors import ConfigError
from benchnav.planning.dubins import dubins_length_to_point, dubins_segments_to_point, sample_segments
from benchnav.planning.planner import PlanStatus
from benchnav.planning.problem import Problem
from benchnav.planning.pure_pursuit import FollowerConfig, PathFollower, Reference, Tracking

SPACING_M = 0.1  # between the points of a reference
_DRAWN_M = 0.5  # between the drawn points of an edge
_EXPLORE = (0.7, 0.3)  # share of choices that explore, before and after a way to the goal is known
_CHECK_STEPS = 8  # between looks at whether all edges of a round have ended
_PARTIAL_GAIN_M = 0.5  # a partial path that leads no further than this toward the goal is none
_MARGIN_M = 0.3  # a partial path is left so far before its end, which may lie close to what is not free
_FAR_M = 1e4  # longer than any way on a map


@dataclass(frozen=True, kw_only=True)
class CLRRTConfig:
    """Settings of CL-RRT; the defaults are the paper's where it gives them.

    Args:
        expansions: edges tried in a plan.
        expansions_per_round: edges simulated at once; divides `expansions`.
        step_m: greatest length of an edge along its reference.
        edge_time_s: greatest duration of an edge; one that takes longer ends there.
        goal_bias: share of the expansions that aim at the goal.
        turning_radius_m: of the references, as long as they lead to the goal.
        lookahead_m: of pure pursuit.
        speed_mps: wanted speed over ground.
        speed_kp: proportional gain of the speed.
        speed_ki: integral gain of the speed in 1/s.
        speed_kd: derivative gain of the speed in s.
        replan_distance_m: a robot farther than this from the nearest predicted position plans anew.
        stall_s: so does one that makes no progress for so long.
        most_failures: plans in a row without a way to the goal after which a partial path is driven to its
            end and, without one, the planner gives up.
    """

    expansions: int = 500
    expansions_per_round: int = 25
    step_m: float = 5.0
    edge_time_s: float = 10.0
    goal_bias: float = 0.25
    turning_radius_m: float = 1.0
    lookahead_m: float = 0.6
    speed_mps: float = 1.0
    speed_kp: float = 0.5
    speed_ki: float = 0.5
    speed_kd: float = 0.0
    replan_distance_m: float = 1.0
    stall_s: float = 5.0
    most_failures: int = 5

    def __post_init__(self) -> None:
        """Refuses settings that grow no tree."""
        for name in (
            *("expansions", "expansions_per_round", "step_m", "edge_time_s", "turning_radius_m"),
            *("replan_distance_m", "stall_s", "most_failures"),
        ):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"Expected `{name}` > 0 for CL-RRT, got {getattr(self, name)}.")
        if self.expansions % self.expansions_per_round:
            raise ConfigError(
                f"Expected `expansions` as a multiple of `expansions_per_round` = {self.expansions_per_round} "
                f"for CL-RRT, got {self.expansions}."
            )
        if not 0 <= self.goal_bias <= 1:
            raise ConfigError(f"Expected `goal_bias` in 0–1 for CL-RRT, got {self.goal_bias}.")
        self.follower()

    @property
    def rounds(self) -> int:
        """Rounds of a plan, which is also the most edges that a path can have."""
        return self.expansions // self.expansions_per_round

    def follower(self) -> FollowerConfig:
        """Settings of the controller."""
        names = (field.name for field in fields(FollowerConfig))
        return FollowerConfig(**{name: getattr(self, name) for name in names})


@dataclass(frozen=True)
class Route:
    """What was planned for each episode.

    Args:
        status: `PlanStatus`, int64, shape [B].
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

    def select(self, members: Tensor) -> "Route":
        """Keeps the routes of some episodes, indices of shape [M]."""
        return Route(*(getattr(self, f.name)[members] for f in fields(self)))

    def update(self, members: Tensor, new: "Route") -> "Route":
        """Puts new routes in the place of those of some episodes, indices of shape [M]."""
        if len(members) == len(self.status):
            return new
        return Route(
            *(getattr(self, f.name).index_copy(0, members, getattr(new, f.name)) for f in fields(self))
        )


class Tree:
    """Trees of B episodes while they grow; a buffer of the search that owns all its tensors.

    Node 0 is the root; each round fills the next R nodes, those of rejected edges with cost inf.
    """

    def __init__(
        self, problem: Problem, config: CLRRTConfig, root: Tensor, tracking: Tracking, radius_m: Tensor
    ) -> None:
        """Plants the roots: states [B, S], what the controller carries there, radii of references [B]."""
        self.problem, self.config, self.radius_m = problem, config, radius_m
        self.follower = PathFollower(config.follower(), problem.dynamics)
        # One lookup tells free, not free and off the map apart, and moves a robot that has to leave.
        stuck = problem.stuck_threshold
        self.ground = problem.grid.pad(problem.traversability.clamp(min=stuck), outside=-1.0)
        self.steps = max(1, round(config.edge_time_s / problem.dt_s))
        self.count = 2 + math.ceil((config.step_m + config.lookahead_m) / SPACING_M)
        self.goal_lanes = math.ceil(config.goal_bias * config.expansions_per_round)
        self.filled = 1

        batch, size, drawn = len(root), 1 + config.expansions, 1 + math.ceil(config.step_m / _DRAWN_M)
        self.state = root.new_zeros(batch, size, root.shape[-1])
        self.position_m = root.new_zeros(batch, size, 2)  # a step before
        self.integral = root.new_zeros(batch, size)
        self.error_mps = root.new_zeros(batch, size)
        self.cost_s = root.new_full((batch, size), math.inf)
        self.least_s = root.new_full((batch, size), math.inf)  # lower bound of the time through the node
        self.to_goal_m = root.new_full((batch, size), math.inf)
        self.free = torch.zeros(batch, size, dtype=torch.bool, device=root.device)
        self.tried = torch.zeros(batch, size, dtype=torch.bool, device=root.device)
        self.arrived = torch.zeros(batch, size, dtype=torch.bool, device=root.device)
        self.parent = torch.zeros(batch, size, dtype=torch.int64, device=root.device)
        self.target_m = root.new_zeros(batch, size, 2)
        self.end_m = root.new_zeros(batch, size)
        self.drawn = root.new_full((batch, size, drawn, 2), math.nan)

        self.best_s = root.new_full((batch,), math.inf)
        free = problem.traversability_at(root) > stuck
        self._put(
            slice(0, 1),
            state=root[:, None],
            position_m=tracking.position_m[:, None],
            integral=tracking.integral[:, None],
            error_mps=tracking.error_mps[:, None],
            cost_s=root.new_zeros(batch, 1),
            free=free[:, None],
        )

    def expand(self, sample: Tensor, chance: Tensor) -> None:
        """Tries R edges in each tree.

        Args:
            sample: points to reach, shape [R, 2].
            chance: uniform, decides by which heuristic each node is chosen, shape [R].
        """
        parent, target = self._choose(sample, chance)
        reference, length = self._draw(parent, target)
        self._simulate(parent, target, reference, length.clamp(max=self.config.step_m))

    def _choose(self, sample: Tensor, chance: Tensor) -> tuple[Tensor, Tensor]:
        """Chooses nodes and where to go from them: int64 [B, R], and positions [B, R, 2]."""
        known = slice(0, max(self.filled, self.goal_lanes))
        speed = min(self.config.speed_mps, self.follower.speed_mps[1])
        closed = self.least_s[:, known] >= self.best_s[:, None]
        toll = torch.where(closed, math.inf, 0.0)
        taken_m = torch.where(closed, 0, speed * self.cost_s[:, known])
        found = self.best_s < math.inf
        explore = torch.where(found, _EXPLORE[1], _EXPLORE[0])[:, None]
        weight = (chance >= explore).to(taken_m)
        pose = self.state[:, None, known, :3]
        length = dubins_length_to_point(pose, sample[:, None], self.radius_m[:, None, None])
        node = (length + toll[:, None] + weight[..., None] * taken_m[:, None]).argmin(dim=-1)
        target = sample.expand(len(node), -1, -1)
        if not self.goal_lanes:
            return node, target

        promise = self.to_goal_m[:, known] + toll + torch.where(found[:, None], taken_m, 0)
        promise = torch.where(self.tried[:, known], math.inf, promise)
        promise, promising = promise.topk(self.goal_lanes, dim=1, largest=False)
        fresh = promise < math.inf
        self.tried.scatter_(1, promising, self.tried.gather(1, promising) | fresh)
        aimed = torch.where(fresh, promising, node[:, : self.goal_lanes])
        goal = torch.where(fresh[..., None], self.problem.goal_m[:, None], target[:, : self.goal_lanes])
        node = torch.cat((aimed, node[:, self.goal_lanes :]), dim=1)
        return node, torch.cat((goal, target[:, self.goal_lanes :]), dim=1)

    def _draw(self, node: Tensor, target: Tensor) -> tuple[Reference, Tensor]:
        """Draws references from nodes [B, R] to positions [B, R, 2]; gives their lengths too."""
        pose = _take(self.state, node)[..., :3]
        segments = dubins_segments_to_point(pose, target, self.radius_m[:, None])
        poses = sample_segments(pose, segments, SPACING_M, self.count)
        return Reference.along(poses, segments.total_m, SPACING_M), segments.total_m

    def _simulate(self, parent: Tensor, target: Tensor, reference: Reference, end_m: Tensor) -> None:
        """Drives along references, each from its parent node, and keeps what is free of collision."""
        problem, follower, stuck = self.problem, self.follower, self.problem.stuck_threshold
        state = _take(self.state, parent)
        free = self.free.gather(1, parent)
        progress = torch.zeros_like(end_m)
        position_m = _take(self.position_m, parent)
        integral, error = self.integral.gather(1, parent), self.error_mps.gather(1, parent)
        tracking = Tracking(progress, position_m, integral, error)
        collided = torch.zeros_like(free)
        log: list[tuple[Tensor, ...]] = []
        for step in range(self.steps + 1):
            progress = follower.advance(reference, state, progress)
            traversability = problem.grid.lookup(self.ground, state[..., 0], state[..., 1])
            on_free = traversability > stuck
            collided = collided | (free & ~on_free) | (traversability < 0)
            free = free | on_free
            log.append((state, progress, free, collided, tracking.integral, tracking.error_mps))
            if step % _CHECK_STEPS == 0 and bool(((progress >= end_m) | collided).all()):
                break
            action, tracking = follower.act(reference, state, tracking, progress)
            state = problem.dynamics(state, action, traversability)

        path, along, frees, collision, integrals, errors = (
            torch.stack(values) for values in zip(*log, strict=True)
        )
        at_goal = distance(path, problem.goal_m[:, None]) < problem.goal_radius_m
        over = (along >= end_m) | at_goal
        over[-1] = True
        last = _first(over)  # the step at which each edge ends
        half = (_first(collision) - 1).clamp(min=0) // 2
        last = torch.where(_at(collision, last), half, last)
        kept = last > 0
        span = last.to(path) * problem.dt_s
        cost = torch.where(kept, self.cost_s.gather(1, parent) + span, math.inf)
        self._put(
            slice(self.filled, self.filled + parent.shape[1]),
            state=_at(path, last),
            position_m=_at(path, (last - 1).clamp(min=0))[..., :2],
            integral=_at(integrals, last),
            error_mps=_at(errors, last),
            cost_s=cost,
            free=_at(frees, last),
            arrived=_at(at_goal, last) & kept,
            parent=parent,
            target_m=target,
            end_m=_at(along, last),
            drawn=_thin(path[..., :2], along, last, self.drawn.shape[2]),
        )

    def _put(self, nodes: slice, **values: Tensor) -> None:
        """Writes nodes and what follows from them."""
        for name, value in values.items():
            getattr(self, name)[:, nodes] = value
        state, cost, goal = self.state[:, nodes], self.cost_s[:, nodes], self.problem.goal_m[:, None]
        straight = (distance(state, goal) - self.problem.goal_radius_m).clamp(min=0)
        self.least_s[:, nodes] = cost + straight / self.follower.speed_mps[1]
        to_goal = dubins_length_to_point(state[..., :3], goal, self.radius_m[:, None])
        self.to_goal_m[:, nodes] = torch.where(cost < math.inf, to_goal, math.inf)
        through = torch.where(self.arrived[:, nodes], cost, math.inf)
        self.best_s = torch.minimum(self.best_s, through.amin(dim=1))
        self.filled = nodes.stop

    def best_route(self) -> Route:
        """Takes the quickest path to the goal or, where there is none, the best partial one."""
        found = self.best_s < math.inf
        quickest = torch.where(self.arrived, self.cost_s, math.inf).argmin(dim=1)
        node = torch.where(found, quickest, self._best_partial())
        chain = [node]
        while bool((chain[-1] > 0).any()):
            chain.append(self.parent.gather(1, chain[-1][:, None])[:, 0])
        backward = torch.stack(chain, dim=1)  # ends in zeros
        depth = (backward > 0).sum(dim=1)
        order = depth[:, None] - 1 - torch.arange(self.config.rounds, device=node.device)
        nodes = backward.gather(1, order.clamp(0, len(chain) - 1))
        status = torch.where(found, PlanStatus.OK, PlanStatus.PARTIAL)
        ends = self.end_m.gather(1, node[:, None])
        self.end_m.scatter_(1, node[:, None], torch.where(found[:, None], ends, ends - _MARGIN_M))
        return self._route(torch.where(order >= 0, nodes, 0), depth, status)

    def _best_partial(self) -> Tensor:
        """Nodes nearest to the goal, those on free ground first; the root unless that gains enough."""
        remaining = self.to_goal_m + torch.where(self.free, 0.0, _FAR_M)
        least, node = remaining.min(dim=1)
        return torch.where(remaining[:, 0] - least > _PARTIAL_GAIN_M, node, 0)

    def _route(self, nodes: Tensor, depth: Tensor, status: Tensor) -> Route:
        """Describes paths through nodes, int64 [B, D], 0 past the end of each."""
        used = (nodes > 0)[..., None]
        reference, _ = self._draw(self.parent.gather(1, nodes), _take(self.target_m, nodes))
        rows = reference.rows.reshape(*nodes.shape, self.count, 4)
        end_m = self.end_m.gather(1, nodes)
        points = rows[:, :, :: round(_DRAWN_M / SPACING_M), :2]
        arc = torch.arange(points.shape[2], device=rows.device) * _DRAWN_M
        driven = used & (arc <= end_m[..., None])
        drawn = _take(self.drawn.flatten(2), nodes).reshape(*nodes.shape, -1, 2)
        return Route(
            status=status,
            depth=depth,
            rows=rows,
            end_m=end_m,
            path=_pack(torch.where(used[..., None], drawn, math.nan).flatten(1, 2)),
            line=_pack(torch.where(driven[..., None], points, math.nan).flatten(1, 2)),
            tree=torch.where(self.cost_s[:, 1:, None, None] < math.inf, self.drawn[:, 1:], math.nan),
        )


def distance(state: Tensor, goal_m: Tensor) -> Tensor:
    """Distances of states [*B, S] to positions [*B, 2], shape [*B]."""
    return torch.hypot(state[..., 0] - goal_m[..., 0], state[..., 1] - goal_m[..., 1])


def _take(values: Tensor, index: Tensor) -> Tensor:
    """Picks from the second dimension: values [B, V, F] at indices [B, R] give [B, R, F]."""
    return values.gather(1, index[..., None].expand(-1, -1, values.shape[-1]))


def _first(condition: Tensor) -> Tensor:
    """First step at which a condition [T, B, R] holds, int64, shape [B, R]; 0 where it never does."""
    return condition.to(torch.uint8).argmax(dim=0)


def _at(log: Tensor, step: Tensor) -> Tensor:
    """Picks from the first dimension: a log [T, B, R, *F] at steps [B, R] gives [B, R, *F]."""
    index = step.reshape(1, *step.shape, *[1] * (log.dim() - 3))
    return log.gather(0, index.expand(1, *log.shape[1:]))[0]


def _thin(path: Tensor, along: Tensor, last: Tensor, count: int) -> Tensor:
    """Thins simulated positions to equal progress, the last position kept.

    Args:
        path: positions, shape [T, B, R, 2].
        along: progress, shape [T, B, R].
        last: step at which each path ends, shape [B, R].
        count: points P.

    Returns:
        Positions, NaN past the end, shape [B, R, P, 2].
    """
    level = torch.arange(count, dtype=along.dtype, device=along.device) * _DRAWN_M
    step = torch.searchsorted(along.movedim(0, -1).contiguous(), level.expand(*last.shape, -1).contiguous())
    step = torch.minimum(step, last[..., None])
    thinned = path.movedim(0, 2).gather(2, step[..., None].expand(-1, -1, -1, 2))
    used = torch.nn.functional.pad(step[..., :-1] < last[..., None], (1, 0), value=True)
    return torch.where(used[..., None], thinned, math.nan)


def _pack(points: Tensor) -> Tensor:
    """Moves points that are not NaN to the front, in their order, shape [B, N, 2]."""
    order = points[..., 0].isnan().to(torch.uint8).argsort(dim=1, stable=True)
    return _take(points, order)
