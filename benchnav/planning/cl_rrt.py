"""Closed-loop rapidly-exploring random trees (CL-RRT).

A tree is grown not by steering states but by simulating the robot with its controller: a node is
chosen for a sampled point, a Dubins reference is drawn from the node to the point, and the closed loop
of pure pursuit and a PID on speed (`pure_pursuit`) drives along it through F with predicted
traversability. The edge stays if every state of it is free; what the robot then executes is the same
controller on the same references. The best path is the one of least simulated time; J is not read.
Source: Kuwata et al. (2009), "Real-time motion planning with applications to autonomous urban
driving"; paper IV-A2.

- Sampled points carry no heading, so references are the shortest paths to a point with free heading:
  the least over all end headings of the Dubins length, and no random heading makes a detour.
- Nodes are chosen by Kuwata's mix of two heuristics: the nearest in Dubins length (explore), or the
  one through which the point is reached soonest (optimise). Before a way to the goal is known 70 % of
  the choices explore, afterwards 30 %, and nodes that cannot improve on the best way are left out.
- The goal's share of the samples goes to nodes that have not tried it yet, the most promising first:
  a trial has no chance in it, so that a second one from the same node would be a copy.
- A robot may stand where λ̂ says it is stuck, since the truth differs from the prediction. An edge thus
  collides where it *enters* ground that is not free, off the map included; a robot that begins on such
  ground is simulated there with λ̂ = λ_stuck, so that it is seen to leave, slowly, and among partial
  paths one that gets it out is preferred.
- Of an edge that collides the nearer half of its free part stays, as the source keeps the safe nodes
  along the way: in tight places no edge of full length is free.
- A plan without a way to the goal leads along the best partial path, and is tried anew at the next
  steps with references of half the radius each time, down to the robot's own tightest turn: at full
  radius a robot that faces ground that is not free has no way at all, and one that can slow down can
  turn tighter. After `most_failures` such plans a partial path is driven to its end; where there is none
  either, the planner gives up. A partial path is left a little before its end, and not tried anew from
  ground that is not free: a robot that slid into a wall could leave it on the other side.
- Expansions go in rounds: all samples of a round, of all episodes, are simulated at once. Samples are
  shared by the episodes of a batch, a pure function of the plan state's seed and step.

Letters in shapes: B episodes, R expansions of a round, V nodes, E edges of a tree, D edges of a path,
N points of a reference, of which Q are drawn, P drawn points of an edge, S state dimensions.
"""

import math
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from benchnav.errors import ConfigError
from benchnav.planning.planner import Plan, PlanStatus
from benchnav.planning.problem import Problem
from benchnav.planning.pure_pursuit import PathFollower, Reference, Tracking
from benchnav.planning.rrt_tree import SPACING_M, CLRRTConfig, Route, Tree, distance

__all__ = ["CLRRT", "CLRRTConfig", "CLRRTState"]

_STALL_M = 0.25  # progress less than this in `stall_s` is none


@dataclass(frozen=True)
class CLRRTState:
    """What CL-RRT carries from step to step.

    Args:
        problem: what is being solved.
        route: what is being followed.
        edge: which edge of the path, int64, shape [B].
        tracking: of the controller, along that edge.
        failures: plans in a row without a way to the goal, int64, shape [B].
        mark_m: progress along the path when last some was seen, shape [B].
        mark_step: the step of it, int64, shape [B].
        seed: root of the samples.
        step: steps planned so far.
    """

    problem: Problem
    route: Route
    edge: Tensor
    tracking: Tracking
    failures: Tensor
    mark_m: Tensor
    mark_step: Tensor
    seed: int
    step: int


class CLRRT:
    """CL-RRT as a planner.

    Args:
        config: settings.
    """

    def __init__(self, config: CLRRTConfig | None = None) -> None:
        """Keeps the settings; all else is in the plan state."""
        self.config = config or CLRRTConfig()

    def init(self, problem: Problem, generator: torch.Generator) -> CLRRTState:
        """Starts with no path, so that the first step plans; see `Planner`.

        Raises:
            ConfigError: the robot cannot follow references of the turning radius.
        """
        follower = PathFollower(self.config.follower(), problem.dynamics)
        tightest = follower.speed_mps[0] / follower.turn_rate_radps
        if self.config.turning_radius_m < tightest:
            raise ConfigError(
                f"Expected `turning_radius_m` ≥ {tightest:g}, the radius of the robot's tightest turn, "
                f"for CL-RRT, got {self.config.turning_radius_m}."
            )
        seed = int(torch.randint(2**62, (), generator=generator))
        none = torch.zeros(len(problem), dtype=torch.int64, device=problem.start.device)
        tracking = Tracking.standing(problem.start)
        route = _blank_route(problem, self.config)
        return CLRRTState(problem, route, none, tracking, none, tracking.progress_m, none, seed, 0)

    def plan(self, state: Tensor, plan_state: CLRRTState) -> tuple[Tensor, CLRRTState, Plan]:
        """Follows the path, planning anew where that is due; see `Planner`."""
        now = self._follow(state, plan_state)
        arrived = distance(state, now.problem.goal_m) < now.problem.goal_radius_m
        lost = self._off_route(state, now)
        again = (now.route.status == PlanStatus.PARTIAL) & (now.failures < self.config.most_failures)
        again = again & (now.problem.traversability_at(state) > now.problem.stuck_threshold)
        due = ((lost | again) & ~arrived & (now.route.status != PlanStatus.FAILED)).nonzero()[:, 0]
        if len(due):
            now = self._replan(state, now, due, lost[due])
        route, follower = now.route, self._follower(now.problem)
        reference = _reference(route, now.edge)
        progress = now.tracking.progress_m  # moved already, but on references that begin now
        progress = torch.where(progress > 0, progress, follower.advance(reference, state, progress))
        action, tracking = follower.act(reference, state, now.tracking, progress)
        dynamics = now.problem.dynamics
        low, high = state.new_tensor(dynamics.action_low), state.new_tensor(dynamics.action_high)
        action = torch.where((route.depth > 0)[:, None] & ~arrived[:, None], action, 0).clamp(low, high)
        drawn = {"status": route.status, "path": route.path, "reference": route.line, "tree": route.tree}
        plan = Plan.empty(len(state), state.device, **drawn)
        return action, replace(now, tracking=tracking, step=now.step + 1), plan

    def _follower(self, problem: Problem) -> PathFollower:
        return PathFollower(self.config.follower(), problem.dynamics)

    def _follow(self, state: Tensor, now: CLRRTState) -> CLRRTState:
        """Moves the progress to where the robots are, on to the next edge where one is done."""
        tracking = now.tracking
        reference = _reference(now.route, now.edge)
        progress = self._follower(now.problem).advance(reference, state, tracking.progress_m)
        last = now.route.end_m.shape[1] - 1
        done = progress >= now.route.end_m.gather(1, now.edge.clamp(max=last)[:, None])[:, 0]
        edge = torch.minimum(now.edge + done, now.route.depth)
        progress = torch.where(done, 0, progress)
        along = edge * self.config.step_m + progress
        moved = along >= now.mark_m + _STALL_M
        return replace(
            now,
            edge=edge,
            tracking=replace(tracking, progress_m=progress),
            mark_m=torch.where(moved, along, now.mark_m),
            mark_step=torch.where(moved, now.step, now.mark_step),
        )

    def _off_route(self, state: Tensor, now: CLRRTState) -> Tensor:
        """Tells who needs a plan: at the end of the path, too far from it, or stalled; bool [B]."""
        offset = now.route.path - state[:, None, :2]
        square = (offset * offset).sum(dim=-1).nan_to_num(nan=math.inf).amin(dim=1)
        stalled = (now.step - now.mark_step) * now.problem.dt_s > self.config.stall_s
        return (now.edge >= now.route.depth) | (square > self.config.replan_distance_m**2) | stalled

    def _replan(self, state: Tensor, now: CLRRTState, due: Tensor, lost: Tensor) -> CLRRTState:
        """Plans for some episodes, indices [M]; those not lost, bool [M], change for a way to the goal alone."""
        config = self.config
        used_up = lost & (now.route.depth[due] > 0)
        failures = torch.where(used_up, 0, now.failures[due])
        route = self._search(now, state[due], due, failures)
        found = route.status == PlanStatus.OK
        failures = torch.where(found, 0, failures + 1)
        failed = (route.depth == 0) & (failures >= config.most_failures)
        route = replace(route, status=torch.where(failed, PlanStatus.FAILED, route.status))
        taken = (found | lost).nonzero()[:, 0]
        members = due[taken]
        tracking = now.tracking
        return replace(
            now,
            route=now.route.update(members, route.select(taken)),
            edge=now.edge.index_fill(0, members, 0),
            tracking=replace(tracking, progress_m=tracking.progress_m.index_fill(0, members, 0)),
            failures=now.failures.index_copy(0, due, failures),
            mark_m=now.mark_m.index_fill(0, members, 0),
            mark_step=now.mark_step.index_fill(0, members, now.step),
        )

    def _search(self, now: CLRRTState, root: Tensor, members: Tensor, failures: Tensor) -> Route:
        """Grows trees from root states [M, S] of some episodes and takes the best path of each."""
        config, problem = self.config, now.problem.select(members)
        tracking = Tracking(*(getattr(now.tracking, f.name)[members] for f in fields(Tracking)))
        follower = self._follower(problem)
        tightest = follower.speed_mps[0] / follower.turn_rate_radps
        least = max(tightest, min(config.turning_radius_m, SPACING_M))
        radius = (config.turning_radius_m * 0.5 ** failures.to(root)).clamp(min=least)
        tree = Tree(problem, config, root, tracking, radius)
        generator = torch.Generator().manual_seed((now.seed + now.step) % 2**63)
        shape = config.rounds, config.expansions_per_round, 3
        draws = torch.rand(shape, generator=generator, dtype=torch.float64).to(root)
        samples = draws[..., :2] * root.new_tensor(problem.grid.extent_m)
        for sample, chance in zip(samples, draws[..., 2], strict=True):
            tree.expand(sample, chance)
        return tree.best_route()


def _blank_route(problem: Problem, config: CLRRTConfig) -> Route:
    """Routes without a path, of the shapes that planned ones have."""
    radius = problem.start.new_full((len(problem),), config.turning_radius_m)
    tree = Tree(problem, config, problem.start, Tracking.standing(problem.start), radius)
    return tree.best_route()


def _reference(route: Route, edge: Tensor) -> Reference:
    """References of one edge [B] of each path."""
    batch, depth, count, _ = route.rows.shape
    path = torch.arange(batch, device=edge.device) * depth + edge.clamp(max=depth - 1)
    return Reference(route.rows.reshape(-1, 4), path * count, count, SPACING_M)
