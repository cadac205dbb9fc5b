"""Closed-loop rapidly-exploring random trees (CL-RRT).

A tree is grown not by steering states but by simulating the robot with its controller:
a node is chosen for a sampled point, a Dubins reference is drawn from the node to the
point, and the closed loop of pure pursuit and a PID on speed (`pursuit`) drives along
it through F with predicted traversability. The edge stays as far as it is free of
collision; what the robot then executes is the same controller on the same references.
The best path is the one of least simulated time; J is not read. Source: Kuwata et al.
(2009), "Real-time motion planning with applications to autonomous urban driving"; paper
IV-A2.

Read on in `tree`, whose `search` is one plan, and in `edges`, which simulates and
judges. This module is what the source calls the execution loop, algorithm 2: when to
plan, and from what.

- The source grows one tree all the time, propagates its best path again from the latest
  state, and stops where there is none that is safe. Here a tree is grown where a plan
  is due, at the path's end or when the robot has strayed or stalled (paper IV-A2), and
  not kept. Nodes need not be safe to stop at.
- References are Dubins paths; the source draws straight lines and takes Dubins lengths
  for its heuristics.
- Where λ̂ falls along a path to the goal, so that what is ahead costs over a tenth more
  than by the map that it was chosen on, a new tree is grown and the cheaper of both
  paths is driven. Both costs are times along the predicted positions under the new λ̂.
  Without a new path the next steps try again, up to `most_failures` times. A partial
  path is left at once. So a map that stays as it is costs no tree, and one that changes
  little by little only a few.
- Sampled points carry no heading, so references are the shortest paths to a point with
  free heading: the least over all end headings of the Dubins length, and no random
      heading makes a detour.
- A plan without a way to the goal leads along the best partial path, and is tried anew
  at the next steps with references of half the radius each time, down to the robot's
  own tightest turn or the spacing of their
  points: at full radius a robot that faces ground that is not free has no way at all,
  and one that can slow down can turn tighter. After `most_failures` such plans a
  partial path is driven to its end. It is left a little before its end, and not tried
  anew from ground that is not free: a robot that slid into a wall could leave it on the
      other side.
- Where `most_failures` plans in a row found no partial path either, the next ones may
  cross: their edges go on over ground that is not free, at its penalty a metre, and the
  cheapest path is driven as a partial one. Before that the tree stays on free ground,
  so that a free way is taken wherever one is found; and once the robot is across, it
  looks for one again. The planner never gives up.
- Expansions go in rounds: all samples of a round, of all episodes, are simulated at
  once. Samples are a pure function of the plan state's seed and step, the same for each
  episode of a batch.
- A path has at most one edge a round, so that a plan reaches as far as `rounds` edges
  do (100 m by default); a goal farther off is approached along partial paths.

Letters in shapes: B episodes, M of which plan anew, D edges of a path, R edges of a
round.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.batch import Batch
from benchnav.core.errors import expect
from benchnav.planning.free_space import PENALTY
from benchnav.planning.objective import TravelTime, distance
from benchnav.planning.planners.cl_rrt.edges import ClosedLoop
from benchnav.planning.planners.cl_rrt.pursuit import (
    SPACING_M,
    FollowerConfig,
    PathFollower,
    Reference,
    Tracking,
)
from benchnav.planning.planners.cl_rrt.tree import Route, no_route, search
from benchnav.planning.planners.planner import (
    Plan,
    Planner,
    PlanStatus,
    check_finite,
    check_steers,
)
from benchnav.planning.problem import Problem, Task, motion_traversability
from benchnav.planning.robots import SPEED, TURN_RATE
from benchnav.planning.sensing.sensor import Step

_STALL_M = 0.25  # progress less than this in `stall_s` is none
# fraction by which the cost of the path ahead rises before it is compared with a new
# one
_RISE = 0.1


@dataclass(frozen=True, kw_only=True)
class CLRRTConfig:
    """Settings of CL-RRT. The paper gives none of these numbers; the defaults are ours.

    Args:
        expansions: edges tried in a plan.
        expansions_per_round: edges simulated at once; divides `expansions`.
        step_m: greatest length of an edge along its reference.
        edge_time_s: greatest duration of an edge; one that takes longer ends there.
        goal_bias: share of the expansions that aim at the goal.
        turning_radius_m: of the references, as long as they lead to the goal.
        replan_distance_m: a robot farther than this from the nearest predicted position
            plans anew.
        stall_s: so does one that makes no progress for so long.
        most_failures: plans in a row without a way to the goal after which a partial
            path is driven to its end and, without one, edges may cross ground that is
            not free.
        follower: of the controller, in simulation and on the way.
    """

    expansions: int = 500
    expansions_per_round: int = 25
    step_m: float = 5.0
    edge_time_s: float = 10.0
    goal_bias: float = 0.25
    turning_radius_m: float = 1.0
    replan_distance_m: float = 1.0
    stall_s: float = 5.0
    most_failures: int = 5
    follower: FollowerConfig = field(default_factory=FollowerConfig)

    def __post_init__(self) -> None:
        """Refuses settings that grow no tree."""
        above = (
            "expansions",
            "expansions_per_round",
            "step_m",
            "edge_time_s",
            "turning_radius_m",
        )
        check_finite(
            "CL-RRT", self, (*above, "replan_distance_m", "stall_s", "most_failures")
        )
        expect(
            self.expansions % self.expansions_per_round == 0,
            "`expansions` as a multiple of `expansions_per_round` = "
            f"{self.expansions_per_round} for CL-RRT, got "
            f"{self.expansions}.",
        )
        expect(
            0 <= self.goal_bias <= 1,
            f"`goal_bias` in 0–1 for CL-RRT, got {self.goal_bias}.",
        )

    @property
    def rounds(self) -> int:
        """Rounds of a plan, which is also the most edges that a path can have: D."""
        return self.expansions // self.expansions_per_round


@dataclass(frozen=True, kw_only=True)
class CLRRTState(Batch):
    """What CL-RRT carries from step to step.

    Args:
        problem: what is being solved.
        route: what is being followed.
        edge: which edge of the path, int64, shape [B].
        tracking: of the controller.
        progress_m: arc length along the reference of that edge, shape [B].
        failures: plans in a row without a way to the goal, int64, shape [B].
        mark_m: progress along the path when last some was seen, shape [B].
        mark_step: the step of it, int64, shape [B].
        ground: `Problem.padded_ground` on which the path was chosen, shape [B, N].
        doubted: the path has become dearer since, and is to be compared with a new one,
            bool, shape [B].
        follower: the controller.
        seed: root of the samples.
        step: steps planned so far.
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
    """A tree of closed-loop simulations, and the controller on its quickest branch.

    Args:
        config: settings.
    """

    steers = ((SPEED, TURN_RATE),)

    def __init__(self, config: CLRRTConfig | None = None) -> None:
        """Keeps the settings; all else is in the plan state."""
        self.config = config or CLRRTConfig()

    def uses(self, task: Task) -> frozenset[str]:
        """λ̂ and free space; see `Planner`."""
        return frozenset({"risk_map", task.rules.free_space.source})

    def follows(self, task: Task) -> str:
        """What the tree minimises where that is not J; see `Planner`."""
        return (
            ""
            if isinstance(task.objective, TravelTime)
            else "simulated time to the goal"
        )

    def remarks(self, task: Task) -> tuple[str, ...]:
        """Notes for tables; see `Planner`."""
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
        """Starts with no path, so that the first step plans; see `Planner`.

        Raises:
            ConfigError: the robot cannot follow references, or none of the turning
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
        """Follows the path, planning anew where that is due; see `Planner`."""
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
        """Keeps some episodes, so that trees are grown for them alone; see `Planner`."""
        return plan_state.select(members)

    def revise(self, plan_state: CLRRTState, problem: Problem) -> CLRRTState:
        """Keep paths that cost what they did, doubt dearer ones, leave those that are
        free no more; see `Planner`.
        """
        route, before = plan_state.route, plan_state.problem
        points, length_m = self._ahead(route, problem, problem.start)
        was, now = (own.ground_at(points) for own in (before, problem))
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
        """Pieces of the paths as `Route.pieces`, those behind the robots of length 0."""
        points, length_m = route.pieces(0.5 * problem.grid.resolution_m)
        away = distance(points, state[:, None, :2]).masked_fill(length_m == 0, math.inf)
        ahead = (
            torch.arange(away.shape[1], device=away.device)
            >= away.argmin(dim=1)[:, None]
        )
        return points, torch.where(ahead, length_m, 0)

    def _cost(self, now: CLRRTState, ground: Tensor, length_m: Tensor) -> Tensor:
        """Cost of pieces in seconds, [B], from values of `padded_ground` and lengths
        [B, K], as of a tree's edges.
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
        """Tells who needs a plan: at the end of the path, too far from it, or stalled;
        bool [B].
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
        found = route.status == PlanStatus.OK
        crosses = (failures >= self.config.most_failures) & (route.depth > 0)
        failures = torch.where(found | crosses, 0, failures + 1)
        compared = now.doubted[due] & ~lost
        better = ~compared
        if bool((compared & found).any()):
            costs = [
                self._cost_ahead(now, each, state)[due]
                for each in (now.route.put(due, route), now.route)
            ]
            better = better | (costs[0] < costs[1])
        taken = (lost | (found & better)).nonzero()[:, 0]
        members = due[taken]
        # A path that nothing better is found for is kept as it is.
        kept = compared & (failures >= self.config.most_failures)
        failures = torch.where(kept, 0, failures)
        return replace(
            now,
            ground=now.ground.index_copy(0, due, now.problem.padded_ground[due]),
            doubted=now.doubted.index_copy(0, due, compared & ~found & ~kept),
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
        """Grows trees from root states [M, S] of some episodes and takes the best path
        of each.
        """
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
        """What trees are grown with after so many failed plans, int64 [B]."""
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
    """References of one edge [B] of each path."""
    batch, depth, count, _ = route.rows.shape
    path = torch.arange(batch, device=edge.device) * depth + edge.clamp(max=depth - 1)
    return Reference(route.rows.reshape(-1, 4), path * count, count)
