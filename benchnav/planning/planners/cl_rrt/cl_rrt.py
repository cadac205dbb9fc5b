"""Closed-loop rapidly-exploring random trees (CL-RRT).

A tree grows by simulations of the robot with its controller. For a sampled point, a
node of the tree is chosen, and a Dubins path leads from the node to the point: the
reference. The controller, pure pursuit and a PID on speed (`pursuit`), follows the
reference through F with predicted traversability. The simulated motion is an edge,
which is kept up to a collision. The robot later runs the same controller on the same
references. The best path has the minimum simulated time; J is not used. Source: Kuwata
et al. (2009), "Real-time motion planning with applications to autonomous urban
driving"; paper IV-A2.

`tree.search` computes one plan, and `edges` simulates. This module is the execution
loop, algorithm 2 of Kuwata et al., which decides when to plan, and from which state.

- Kuwata et al. grow one tree all the time, simulate its best path again from the latest
  state, and stop if no path is safe. Here a tree is grown only when a plan is due (at
  the end of the path, or when the robot has strayed or stalled; paper IV-A2), and is
  then discarded. A node need not be a state at which the robot can stop safely.
- References are Dubins paths; Kuwata et al. draw straight lines and use Dubins lengths
  only in their heuristics.
- λ̂ may decrease along a path to the goal. If the remaining path then costs over a
  tenth more than on the map on which it was chosen, the path is doubted: a new tree is
  grown, and the robot drives the cheaper of the old and the new path. Both costs are
  times along the predicted positions under the new λ̂. If no new path is found, the
  next steps try again, up to `most_failures` times. The robot leaves a partial path at
  once. Hence a constant map needs no further tree, and a slowly changing map only a
  few.
- Sampled points have no heading, so a reference is the shortest path to a point with
  any final heading. Hence no random heading causes a detour.
- After a plan without a path to the goal, the robot follows the best partial path. The
  next steps plan again. Each plan halves the radius of the references, down to the
  robot's tightest turn or the spacing of their points. With the full radius, a robot
  that faces non-free cells may have no path, whereas at a lower speed it can turn more
  tightly. After `most_failures` such plans, the partial path is driven until slightly
  before its end. A robot in a non-free cell does not plan again, because a robot that
  slid into a wall could leave the wall on the other side.
- If `most_failures` consecutive plans found no partial path either, the edges of the
  next plans may cross non-free cells, with a penalty per metre, and the cheapest path
  is driven as a partial path. Until then the tree stays in free cells, so that a free
  path is used if one is found. After the crossing, the robot searches for a free path
  again. The planner never gives up.
- Edges are added in rounds: all edges of a round, in all episodes, are simulated at
  once. Samples are a pure function of the plan state's seed and step, and the same for
  all episodes of a batch.
- A path has at most one edge per round, so its maximum length is the length of `rounds`
  edges (100 m by default). A goal farther away is approached along partial paths.

Letters in shapes: B episodes, M episodes that plan, D edges of a path, K segments of a
path, N cells of a padded map, R edges of a round, S state dimensions.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.batch import Batch
from benchnav.core.errors import expect
from benchnav.planning.free_space import PENALTY
from benchnav.planning.objective import TravelTime, distance
from benchnav.planning.planners.cl_rrt.config import CLRRTConfig
from benchnav.planning.planners.cl_rrt.edges import ClosedLoop
from benchnav.planning.planners.cl_rrt.pursuit import (
    SPACING_M,
    PathFollower,
    Reference,
    Tracking,
)
from benchnav.planning.planners.cl_rrt.tree import Route, no_route, search
from benchnav.planning.planners.planner import Plan, Planner, PlanStatus, check_steers
from benchnav.planning.problem import Problem, Task, motion_traversability
from benchnav.planning.robots import SPEED, TURN_RATE
from benchnav.planning.sensing.sensor import Step

_STALL_M = 0.25  # minimum progress within `stall_s`, in metres
# Minimum relative increase in the cost of the remaining path by which it is doubted.
_RISE = 0.1


@dataclass(frozen=True, kw_only=True)
class CLRRTState(Batch):
    """Plan state of CL-RRT.

    Args:
        problem: problems of B episodes.
        route: routes that the robots follow.
        edge: index of the current edge of each path, int64, shape [B].
        tracking: state of the controller.
        progress_m: arc length along the reference of the current edge in metres, shape
            [B].
        failures: number of consecutive plans without a path to the goal, int64, shape
            [B].
        mark_m: distance along the path in metres at which the robot last had advanced
            by `_STALL_M`, shape [B].
        mark_step: step at which the robot was there, int64, shape [B].
        ground: `Problem.padded_ground` when the path was chosen, shape [B, N].
        doubted: mask of paths that have become more expensive and must be compared with
            new paths, bool, shape [B].
        follower: the controller.
        seed: seed of the samples.
        step: number of planned steps.
    """

    problem: Problem
    route: Route
    edge: Tensor
    tracking: Tracking
    progress_m: Tensor
    failures: Tensor
    mark_m: Tensor
    mark_step: Tensor
    ground: Tensor
    doubted: Tensor
    follower: PathFollower
    seed: int
    step: int


class CLRRT(Planner[CLRRTState]):
    """Planner that grows a tree of closed-loop simulations and follows its best branch.

    Args:
        config: settings.
    """

    steers = ((SPEED, TURN_RATE),)

    def __init__(self, config: CLRRTConfig | None = None) -> None:
        """Store the settings."""
        self.config = config or CLRRTConfig()

    def uses(self, task: Task) -> frozenset[str]:
        """Return the names of λ̂ and of the input of free space; see `Planner`."""
        return frozenset({"risk_map", task.rules.free_space.source})

    def follows(self, task: Task) -> str:
        """Return the cost that the tree minimises instead of J; see `Planner`."""
        if isinstance(task.objective, TravelTime):
            return ""
        return "simulated time to the goal"

    def remarks(self, task: Task) -> tuple[str, ...]:
        """Return notes for tables; see `Planner`."""
        config = self.config.follower
        robot = task.robot
        follower = PathFollower(config, robot)
        remarks = []
        if follower.wanted_mps < robot.top_speed_mps:
            remarks.append(
                f"CL-RRT drives at {follower.wanted_mps:g} m/s at most; the robot's "
                f"top speed is {robot.top_speed_mps:g} m/s"
            )
        timed_m = config.lookahead_s * follower.wanted_mps
        if follower.lookahead_m > max(config.lookahead_m, timed_m):
            remarks.append(
                f"CL-RRT looks {follower.lookahead_m:g} m ahead, the distance that the "
                "robot drives while its turn rate builds up"
            )
        return tuple(remarks)

    def init(self, problem: Problem, generator: torch.Generator) -> CLRRTState:
        """Return a plan state without a path, so that the first step plans.

        Raises:
            ConfigError: If the robot cannot follow references, or cannot turn as
                tightly as `turning_radius_m`.
        """
        config = self.config
        check_steers(self, problem.robot, "cl_rrt")
        follower = PathFollower(config.follower, problem.robot)
        expect(
            config.turning_radius_m >= follower.tightest_m,
            f"`turning_radius_m` ≥ {follower.tightest_m:g} (the radius of the robot's "
            f"tightest turn) for CL-RRT, got {config.turning_radius_m}.",
        )
        zero_m = torch.zeros_like(problem.start[:, 0])
        zero = torch.zeros_like(zero_m, dtype=torch.int64)
        loop = self._closed_loop(problem, follower, zero)
        seed = torch.randint(2**62, (), generator=generator)
        return CLRRTState(
            problem=problem,
            route=no_route(loop, config.rounds, config.expansions),
            edge=zero,
            tracking=Tracking.standing(problem.start),
            progress_m=zero_m,
            failures=zero,
            mark_m=zero_m,
            mark_step=zero,
            ground=problem.padded_ground,
            doubted=zero.bool(),
            follower=follower,
            seed=int(seed),
            step=0,
        )

    def plan(
        self, step: Step, plan_state: CLRRTState
    ) -> tuple[Tensor, CLRRTState, Plan]:
        """Return actions along the path, with new plans where necessary."""
        problem = plan_state.problem
        state = step.state
        now = self._follow(state, plan_state)
        ground = problem.ground_at(state)
        on_map = ground != 0
        arrived = distance(state, problem.goal_m) < problem.goal_radius_m
        lost = self._off_route(state, now)
        partial = now.route.status == PlanStatus.PARTIAL
        retries = partial & (now.failures < self.config.most_failures)
        again = (retries | now.doubted) & (ground > 0)
        is_due = (lost | again) & ~arrived & on_map
        due = is_due.nonzero()[:, 0]
        if len(due):
            now = self._replan(state, now, due, lost[due])
        route = now.route
        follower = now.follower
        reference = _reference(route, now.edge)
        # A progress of 0 means that the reference begins in this step.
        progress = now.progress_m
        advanced = follower.advance(reference, state, progress)
        progress = torch.where(progress > 0, progress, advanced)
        action, tracking = follower.act(reference, state, now.tracking, progress)
        driving = (route.depth > 0) & ~arrived
        action = torch.where(driving[:, None], action, 0)
        action = action.clamp(*problem.action_bounds)
        layers = {}
        if step.draw:
            layers = {"path": route.path, "reference": route.line, "tree": route.tree}
        plan = Plan.empty(len(state), state.device, status=route.status, **layers)
        next_step = now.step + 1
        now = replace(now, tracking=tracking, progress_m=progress, step=next_step)
        return action, now, plan

    def select(self, plan_state: CLRRTState, members: Tensor) -> CLRRTState:
        """Return the plan state of some episodes; see `Planner`."""
        return plan_state.select(members)

    def revise(self, plan_state: CLRRTState, problem: Problem) -> CLRRTState:
        """Return the plan state under an updated λ̂; see `Planner`.

        The robot leaves a path that is no longer free, and a partial path that has
        become more expensive. A path to the goal that has become more expensive is
        doubted.
        """
        route = plan_state.route
        points, length_m = self._ahead(route, problem, problem.start)
        old_ground = plan_state.problem.ground_at(points)
        new_ground = problem.ground_at(points)
        is_blocked = (old_ground > 0) & (new_ground < 0) & (length_m > 0)
        closed = is_blocked.any(dim=1)
        x, y = points[..., 0], points[..., 1]
        chosen_ground = problem.grid.lookup(plan_state.ground, x, y)
        cost = self._cost(plan_state, new_ground, length_m)
        chosen_cost = self._cost(plan_state, chosen_ground, length_m)
        dearer = cost > (1 + _RISE) * chosen_cost
        leads = route.status == PlanStatus.OK
        # A robot at the end of its path searches for another path.
        is_left = closed | (dearer & ~leads)
        edge = torch.where(is_left, route.depth, plan_state.edge)
        doubted = plan_state.doubted | (dearer & leads)
        return replace(plan_state, problem=problem, edge=edge, doubted=doubted)

    def _ahead(
        self, route: Route, problem: Problem, state: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the segments of paths; those behind the robots have length 0.

        Returns:
            Midpoints and lengths of all segments, as `Route.segments` returns them.
        """
        points, length_m = route.segments(0.5 * problem.grid.resolution_m)
        distance_m = distance(points, state[:, None, :2])
        distance_m = distance_m.masked_fill(length_m == 0, math.inf)
        nearest = distance_m.argmin(dim=1)[:, None]
        index = torch.arange(distance_m.shape[1], device=distance_m.device)
        return points, torch.where(index >= nearest, length_m, 0)

    def _cost(self, now: CLRRTState, ground: Tensor, length_m: Tensor) -> Tensor:
        """Return the costs of paths in seconds, as for edges of a tree, shape [B].

        Args:
            now: plan state with the robot and its follower.
            ground: values of `padded_ground` at the segments, shape [B, K].
            length_m: lengths of the segments in metres, shape [B, K].
        """
        problem = now.problem
        min_traversability = problem.task.rules.min_traversability
        traversability = motion_traversability(ground, min_traversability)
        reach_mps = traversability * problem.robot.action_high[0]
        speed_mps = reach_mps.clamp(max=now.follower.wanted_mps)
        pace = 1 / speed_mps + PENALTY * (ground <= 0)
        return torch.where(length_m > 0, pace * length_m, 0).sum(dim=1)

    def _cost_ahead(self, now: CLRRTState, route: Route, state: Tensor) -> Tensor:
        """Return the cost of the remaining paths from states [B, S], shape [B]."""
        points, length_m = self._ahead(route, now.problem, state)
        ground = now.problem.ground_at(points)
        return self._cost(now, ground, length_m)

    def _follow(self, state: Tensor, now: CLRRTState) -> CLRRTState:
        """Return the plan state with the robots' progress; at an end, the next edge."""
        route = now.route
        reference = _reference(route, now.edge)
        progress = now.follower.advance(reference, state, now.progress_m)
        last = route.end_m.shape[1] - 1
        current = now.edge.clamp(max=last)
        end_m = route.end_m.gather(1, current[:, None])[:, 0]
        done = progress >= end_m
        edge = torch.minimum(now.edge + done, route.depth)
        progress = torch.where(done, 0, progress)
        along_m = edge * self.config.step_m + progress
        passed = along_m >= now.mark_m + _STALL_M
        # After a robot has crossed non-free cells, it searches for a free path.
        astray = (route.depth > 0) & ~now.problem.free_at(state)
        return replace(
            now,
            edge=edge,
            progress_m=progress,
            failures=torch.where(astray, 0, now.failures),
            mark_m=torch.where(passed, along_m, now.mark_m),
            mark_step=torch.where(passed, now.step, now.mark_step),
        )

    def _off_route(self, state: Tensor, now: CLRRTState) -> Tensor:
        """Return a mask of robots that need a plan, bool, shape [B].

        Such a robot is at the end of its path, too far from the path, or stalled.
        """
        config = self.config
        offset = now.route.path - state[:, None, :2]
        square = (offset * offset).sum(dim=-1)
        min_square = square.nan_to_num(nan=math.inf).amin(dim=1)
        is_far = min_square > config.replan_distance_m**2
        idle_s = (now.step - now.mark_step) * now.problem.dt_s
        stalled = idle_s > config.stall_s
        at_end = now.edge >= now.route.depth
        return at_end | is_far | stalled

    def _replan(
        self, state: Tensor, now: CLRRTState, due: Tensor, lost: Tensor
    ) -> CLRRTState:
        """Return the plan state after new plans for some episodes.

        A robot that needs a plan follows the new path. Another robot changes to the new
        path only if it leads to the goal; if its old path is doubted, the new path must
        also be cheaper.

        Args:
            state: states of all robots, shape [B, S].
            now: plan state.
            due: indices of the episodes to plan for, int64, shape [M].
            lost: mask of robots that need a plan (`_off_route`), bool, shape [M].
        """
        most_failures = self.config.most_failures
        used_up = lost & (now.route.depth[due] > 0)
        failures = torch.where(used_up, 0, now.failures[due])
        route = self._search(state[due], now, due, failures)
        reaches_goal = route.status == PlanStatus.OK
        crosses = (failures >= most_failures) & (route.depth > 0)
        failures = torch.where(reaches_goal | crosses, 0, failures + 1)
        compared = now.doubted[due] & ~lost
        better = ~compared
        if bool((compared & reaches_goal).any()):
            new_routes = now.route.put(due, route)
            new_cost = self._cost_ahead(now, new_routes, state)[due]
            old_cost = self._cost_ahead(now, now.route, state)[due]
            better = better | (new_cost < old_cost)
        changes = lost | (reaches_goal & better)
        taken = changes.nonzero()[:, 0]
        members = due[taken]
        # After the last attempt, a doubted path is kept and no longer doubted.
        stays = compared & (failures >= most_failures)
        failures = torch.where(stays, 0, failures)
        ground = now.problem.padded_ground[due]
        doubted = compared & ~reaches_goal & ~stays
        return replace(
            now,
            ground=now.ground.index_copy(0, due, ground),
            doubted=now.doubted.index_copy(0, due, doubted),
            route=now.route.put(members, route.select(taken)),
            edge=now.edge.index_fill(0, members, 0),
            progress_m=now.progress_m.index_fill(0, members, 0),
            failures=now.failures.index_copy(0, due, failures),
            mark_m=now.mark_m.index_fill(0, members, 0),
            mark_step=now.mark_step.index_fill(0, members, now.step),
        )

    def _search(
        self, root: Tensor, now: CLRRTState, members: Tensor, failures: Tensor
    ) -> Route:
        """Return the best routes of trees whose roots are states [M, S]."""
        config = self.config
        problem = now.problem
        if len(members) < len(problem):
            problem = problem.select(members)
        loop = self._closed_loop(problem, now.follower, failures)
        key = rng.stream_key(now.seed, "cl_rrt", now.step)
        shape = config.rounds, config.expansions_per_round, 3
        draws = rng.uniform(key, np.zeros(1, dtype=np.int64), shape)
        uniform = torch.from_numpy(draws[0]).to(root)
        extent_m = root.new_tensor(problem.grid.extent_m)
        sample_m = uniform[..., :2] * extent_m
        chance = uniform[..., 2]
        tracking = now.tracking.select(members)
        goal_edges = math.ceil(config.goal_bias * config.expansions_per_round)
        return search(loop, root, tracking, sample_m, chance, goal_edges)

    def _closed_loop(
        self, problem: Problem, follower: PathFollower, failures: Tensor
    ) -> ClosedLoop:
        """Return the closed loop of trees, given numbers of failed plans, int64 [B]."""
        config = self.config
        full_m = config.turning_radius_m
        min_m = max(follower.tightest_m, min(full_m, SPACING_M))
        n_halvings = (failures % config.most_failures).to(problem.start)
        radius_m = full_m * 0.5**n_halvings
        return ClosedLoop(
            problem=problem,
            follower=follower,
            radius_m=radius_m.clamp(min=min_m),
            crossing=failures >= config.most_failures,
            step_m=config.step_m,
            edge_time_s=config.edge_time_s,
        )


def _reference(route: Route, edge: Tensor) -> Reference:
    """Return the reference of an edge of each path, from indices of edges [B]."""
    n_paths, depth, count, _ = route.rows.shape
    first = torch.arange(n_paths, device=edge.device) * depth
    row = first + edge.clamp(max=depth - 1)
    return Reference(route.rows.reshape(-1, 4), row * count, count)
