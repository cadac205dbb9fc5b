"""Closed-loop rapidly-exploring random trees (CL-RRT).

A tree is not grown by steering states but by simulating the robot with its controller.
A node is chosen for a sampled point, and a Dubins reference is drawn from the node to
the point. The closed loop of pure pursuit and a PID on speed (`pursuit`) drives along
it through F with predicted traversability. An edge is kept as far as it is free of
collision. The robot then executes the same controller on the same references. The best
path is that of minimum simulated time; J is not used. Source: Kuwata et al. (2009),
"Real-time motion planning with applications to autonomous urban driving"; paper IV-A2.

See also `tree`, whose `search` is one plan, and `edges`, which simulates. This module
is the execution loop of the source, algorithm 2: when to plan, and from which state.

- The source grows one tree all the time, simulates its best path again from the latest
  state, and stops if no path is safe. Here a tree is grown only when a plan is due, at
  the path's end or when the robot has strayed or stalled (paper IV-A2), and is not
  kept. Nodes need not be safe to stop at.
- References are Dubins paths; the source draws straight lines and uses Dubins lengths
  for its heuristics.
- If λ̂ decreases along a path to the goal, so that the remaining path costs over a tenth
  more than on the map on which it was chosen, a new tree is grown and the cheaper of
  both paths is driven. Both costs are times along the predicted positions under the new
  λ̂. Without a new path the next steps try again, up to `most_failures` times. A partial
  path is left at once. Hence a constant map costs no tree, and one that changes slowly
  only a few.
- Sampled points have no heading, so references are the shortest paths to a point with
  free heading: the minimum over all end headings of the Dubins length. No random
  heading causes a detour.
- A plan without a path to the goal follows the best partial path. The next steps plan
  again, each time with references of half the radius, down to the robot's own tightest
  turn or the spacing of their points: at full radius a robot that faces non-free cells
  may have no path, and one that can slow down can turn tighter. After `most_failures`
  such plans a partial path is driven to its end. It is left slightly before its end,
  and there is no further plan from non-free cells: a robot that slid into a wall could
  leave it on the other side.
- If `most_failures` consecutive plans found no partial path either, the next ones may
  cross: their edges continue over non-free cells, at their penalty per metre, and the
  cheapest path is driven as a partial one. Before that the tree stays in free cells, so
  that a free path is used wherever one is found; once the robot is across, it looks for
  one again. The planner never gives up.
- Expansions are in rounds: all samples of a round, of all episodes, are simulated at
  once. Samples are a pure function of the plan state's seed and step, the same for each
  episode of a batch.
- A path has at most one edge per round, so that a plan reaches as far as `rounds` edges
  do (100 m by default); a goal farther away is approached along partial paths.

Letters in shapes: B episodes, M of which plan, D edges of a path, R edges of a round.
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
from benchnav.planning.planners.planner import (
    Plan,
    Planner,
    PlanStatus,
    check_steers,
)
from benchnav.planning.problem import Problem, Task, motion_traversability
from benchnav.planning.robots import SPEED, TURN_RATE
from benchnav.planning.sensing.sensor import Step

_STALL_M = 0.25  # minimum progress within `stall_s`
# Fraction by which the cost of the remaining path rises before it is compared with a
# new one.
_RISE = 0.1


@dataclass(frozen=True, kw_only=True)
class CLRRTState(Batch):
    """Plan state of CL-RRT.

    Args:
        problem: the problem.
        route: route that is followed.
        edge: index of the current edge of the path, int64, shape [B].
        tracking: state of the controller.
        progress_m: arc length along the reference of that edge in metres, shape [B].
        failures: consecutive plans without a path to the goal, int64, shape [B].
        mark_m: progress along the path at the last mark, shape [B].
        mark_step: step of that mark, int64, shape [B].
        ground: `Problem.padded_ground` on which the path was chosen, shape [B, N].
        doubted: mask of paths that have become more expensive, and are to be compared
            with new ones, bool, shape [B].
        follower: the controller.
        seed: root of the samples.
        step: number of steps planned so far.
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
        """Return λ̂ and the input of free space; see `Planner`."""
        return frozenset({"risk_map", task.rules.free_space.source})

    def follows(self, task: Task) -> str:
        """Return what the tree minimises instead of J; see `Planner`."""
        if isinstance(task.objective, TravelTime):
            return ""
        return "simulated time to the goal"

    def remarks(self, task: Task) -> tuple[str, ...]:
        """Return notes for tables; see `Planner`."""
        config, robot = self.config.follower, task.robot
        follower = PathFollower(config, robot)
        remarks = []
        if follower.wanted_mps < robot.top_speed_mps:
            remarks.append(
                f"CL-RRT drives at {follower.wanted_mps:g} m/s at most; the robot's "
                "top speed is "
                f"{robot.top_speed_mps:g} m/s"
            )
        if follower.lookahead_m > max(
            config.lookahead_m, config.lookahead_s * follower.wanted_mps
        ):
            remarks.append(
                f"CL-RRT looks {follower.lookahead_m:g} m ahead, the way of the robot "
                "while its turn rate builds up"
            )
        return tuple(remarks)

    def init(self, problem: Problem, generator: torch.Generator) -> CLRRTState:
        """Return a plan state without a path, so that the first step plans.

        Raises:
            ConfigError: If the robot cannot follow references, or not of the turning
                radius.
        """
        config = self.config
        check_steers(self, problem.robot, "cl_rrt")
        follower = PathFollower(config.follower, problem.robot)
        expect(
            config.turning_radius_m >= follower.tightest_m,
            f"`turning_radius_m` ≥ {follower.tightest_m:g}, the radius of the robot's "
            "tightest turn, for CL-RRT, got "
            f"{config.turning_radius_m}.",
        )
        none = torch.zeros(len(problem), dtype=torch.int64, device=problem.start.device)
        zero = torch.zeros_like(problem.start[:, 0])
        return CLRRTState(
            problem=problem,
            route=no_route(
                self._closed_loop(problem, follower, none),
                config.rounds,
                config.expansions,
            ),
            edge=none,
            tracking=Tracking.standing(problem.start),
            progress_m=zero,
            failures=none,
            mark_m=zero,
            mark_step=none,
            ground=problem.padded_ground,
            doubted=none.bool(),
            follower=follower,
            seed=int(torch.randint(2**62, (), generator=generator)),
            step=0,
        )

    def plan(
        self, step: Step, plan_state: CLRRTState
    ) -> tuple[Tensor, CLRRTState, Plan]:
        """Return actions along the path, after a new plan if one is due; see `Planner`."""
        config, problem, state = self.config, plan_state.problem, step.state
        now = self._follow(state, plan_state)
        ground = problem.ground_at(state)
        arrived = distance(state, problem.goal_m) < problem.goal_radius_m
        lost = self._off_route(state, now)
        partial = now.route.status == PlanStatus.PARTIAL
        again = ((partial & (now.failures < config.most_failures)) | now.doubted) & (
            ground > 0
        )
        # not off the map
        due = ((lost | again) & ~arrived & (ground != 0)).nonzero()[:, 0]
        if len(due):
            now = self._replan(state, now, due, lost[due])
        route, follower = now.route, now.follower
        reference = _reference(route, now.edge)
        progress = now.progress_m  # moved already, but on references that begin now
        progress = torch.where(
            progress > 0, progress, follower.advance(reference, state, progress)
        )
        action, tracking = follower.act(reference, state, now.tracking, progress)
        driving = (route.depth > 0) & ~arrived
        action = torch.where(driving[:, None], action, 0).clamp(*problem.action_bounds)
        layers = (
            {"path": route.path, "reference": route.line, "tree": route.tree}
            if step.draw
            else {}
        )
        plan = Plan.empty(len(state), state.device, status=route.status, **layers)
        return (
            action,
            replace(now, tracking=tracking, progress_m=progress, step=now.step + 1),
            plan,
        )

    def select(self, plan_state: CLRRTState, members: Tensor) -> CLRRTState:
        """Return the plan state of some episodes; see `Planner`."""
        return plan_state.select(members)

    def revise(self, plan_state: CLRRTState, problem: Problem) -> CLRRTState:
        """Return the plan state under another λ̂; see `Planner`.

        Paths of unchanged cost are kept, more expensive ones are doubted, and those
        that are no longer free are left.
        """
        route, before = plan_state.route, plan_state.problem
        points, length_m = self._ahead(route, problem, problem.start)
        was, now = (problem_of.ground_at(points) for problem_of in (before, problem))
        closed = ((was > 0) & (now < 0) & (length_m > 0)).any(dim=1)
        judged = problem.grid.lookup(plan_state.ground, points[..., 0], points[..., 1])
        cost, judged_cost = (
            self._cost(plan_state, ground, length_m) for ground in (now, judged)
        )
        dearer = cost > (1 + _RISE) * judged_cost
        leads = route.status == PlanStatus.OK
        # At the end of its path a robot looks for another.
        edge = torch.where(closed | (dearer & ~leads), route.depth, plan_state.edge)
        return replace(
            plan_state,
            problem=problem,
            edge=edge,
            doubted=plan_state.doubted | (dearer & leads),
        )

    def _ahead(
        self, route: Route, problem: Problem, state: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return pieces of paths as `Route.pieces`; those behind robots have length 0."""
        points, length_m = route.pieces(0.5 * problem.grid.resolution_m)
        away = distance(points, state[:, None, :2]).masked_fill(length_m == 0, math.inf)
        ahead = (
            torch.arange(away.shape[1], device=away.device)
            >= away.argmin(dim=1)[:, None]
        )
        return points, torch.where(ahead, length_m, 0)

    def _cost(self, now: CLRRTState, ground: Tensor, length_m: Tensor) -> Tensor:
        """Return costs of pieces in seconds, [B], as those of a tree's edges.

        Pieces are given by values of `padded_ground` and lengths, [B, K].
        """
        robot, rules = now.problem.robot, now.problem.task.rules
        reach_mps = (
            motion_traversability(ground, rules.min_traversability)
            * robot.action_high[0]
        )
        pace = 1 / reach_mps.clamp(max=now.follower.wanted_mps) + PENALTY * (
            ground <= 0
        )
        return torch.where(length_m > 0, pace * length_m, 0).sum(dim=1)

    def _cost_ahead(self, now: CLRRTState, route: Route, state: Tensor) -> Tensor:
        """Cost of what is left of paths from states [B, S] on, shape [B]."""
        points, length_m = self._ahead(route, now.problem, state)
        return self._cost(now, now.problem.ground_at(points), length_m)

    def _follow(self, state: Tensor, now: CLRRTState) -> CLRRTState:
        """Moves the progress to where the robots are, on to the next edge where one is
        done.
        """
        reference = _reference(now.route, now.edge)
        progress = now.follower.advance(reference, state, now.progress_m)
        last = now.route.end_m.shape[1] - 1
        done = (
            progress
            >= now.route.end_m.gather(1, now.edge.clamp(max=last)[:, None])[:, 0]
        )
        edge = torch.minimum(now.edge + done, now.route.depth)
        progress = torch.where(done, 0, progress)
        along = edge * self.config.step_m + progress
        moved = along >= now.mark_m + _STALL_M
        # A robot that drives over ground that is not free looks for a free way when it
        # is across.
        astray = (now.route.depth > 0) & ~now.problem.free_at(state)
        return replace(
            now,
            edge=edge,
            progress_m=progress,
            failures=torch.where(astray, 0, now.failures),
            mark_m=torch.where(moved, along, now.mark_m),
            mark_step=torch.where(moved, now.step, now.mark_step),
        )

    def _off_route(self, state: Tensor, now: CLRRTState) -> Tensor:
        """Return a mask of robots that need a plan, bool, [B].

        They are at the end of the path, too far from it, or stalled.
        """
        offset = now.route.path - state[:, None, :2]
        square = (offset * offset).sum(dim=-1).nan_to_num(nan=math.inf).amin(dim=1)
        stalled = (now.step - now.mark_step) * now.problem.dt_s > self.config.stall_s
        return (
            (now.edge >= now.route.depth)
            | (square > self.config.replan_distance_m**2)
            | stalled
        )

    def _replan(
        self, state: Tensor, now: CLRRTState, due: Tensor, lost: Tensor
    ) -> CLRRTState:
        """Plan for some episodes, indices [M].

        Those not lost, bool [M], change only for a path to the goal, and from one in
        doubt only for a cheaper one.
        """
        used_up = lost & (now.route.depth[due] > 0)
        failures = torch.where(used_up, 0, now.failures[due])
        route = self._search(state[due], now, due, failures)
        reaches_goal = route.status == PlanStatus.OK
        crosses = (failures >= self.config.most_failures) & (route.depth > 0)
        failures = torch.where(reaches_goal | crosses, 0, failures + 1)
        compared = now.doubted[due] & ~lost
        better = ~compared
        if bool((compared & reaches_goal).any()):
            costs = [
                self._cost_ahead(now, candidate, state)[due]
                for candidate in (now.route.put(due, route), now.route)
            ]
            better = better | (costs[0] < costs[1])
        taken = (lost | (reaches_goal & better)).nonzero()[:, 0]
        members = due[taken]
        # A path that nothing better is found for is kept as it is.
        stays = compared & (failures >= self.config.most_failures)
        failures = torch.where(stays, 0, failures)
        return replace(
            now,
            ground=now.ground.index_copy(0, due, now.problem.padded_ground[due]),
            doubted=now.doubted.index_copy(0, due, compared & ~reaches_goal & ~stays),
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
        """Return the best paths of trees grown from root states [M, S]."""
        config, problem = self.config, now.problem
        if len(members) < len(problem):
            problem = problem.select(members)
        loop = self._closed_loop(problem, now.follower, failures)
        key = rng.stream_key(now.seed, "cl_rrt", now.step)
        draws = rng.uniform(
            key,
            np.zeros(1, dtype=np.int64),
            (config.rounds, config.expansions_per_round, 3),
        )
        chance = torch.from_numpy(draws[0]).to(root)
        sample_m = chance[..., :2] * root.new_tensor(problem.grid.extent_m)
        goal_edges = math.ceil(config.goal_bias * config.expansions_per_round)
        return search(
            loop,
            root,
            now.tracking.select(members),
            sample_m,
            chance[..., 2],
            goal_edges,
        )

    def _closed_loop(
        self, problem: Problem, follower: PathFollower, failures: Tensor
    ) -> ClosedLoop:
        """Return the closed loop of trees after a number of failed plans, int64 [B]."""
        config = self.config
        least_m = max(follower.tightest_m, min(config.turning_radius_m, SPACING_M))
        tries = failures % config.most_failures
        return ClosedLoop(
            problem=problem,
            follower=follower,
            radius_m=(config.turning_radius_m * 0.5 ** tries.to(problem.start)).clamp(
                min=least_m
            ),
            crossing=failures >= config.most_failures,
            step_m=config.step_m,
            edge_time_s=config.edge_time_s,
        )


def _reference(route: Route, edge: Tensor) -> Reference:
    """Return the references of one edge [B] of each path."""
    batch, depth, count, _ = route.rows.shape
    path = torch.arange(batch, device=edge.device) * depth + edge.clamp(max=depth - 1)
    return Reference(route.rows.reshape(-1, 4), path * count, count)
