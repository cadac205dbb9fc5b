"""The optimal planner: follows the minimum cost to go of every pose on a map, computed
once by value iteration.

`Optimal` takes λ̂ for λ: its time is the minimum under that map, "certainty-equivalent",
and no bound for the true terrain. `NearOptimal` receives λ itself, by the model
`clairvoyant`, and uses the dwell time after which the world immobilises a robot. Its
drives are feasible, so the minimum time is at most its time: it is the near-optimal
reference, and no bound. Both plan only for the paper's unicycle, which drives forward,
and plan once: maps that change are rejected.
Letters in shapes: B episodes, H×W cells, Q headings, K primitives, N points, L levels
of dwell time.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from benchnav.core.errors import ConfigError, expect
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.planning.free_space import PENALTY
from benchnav.planning.planners.astar.astar_dwa import AStarDWA
from benchnav.planning.planners.optimal.drive import Drive, earlier, simulate
from benchnav.planning.planners.optimal.value import (
    UNREACHED,
    Costs,
    Moves,
    value_iteration,
)
from benchnav.planning.planners.optimal.ways import OptimalState, path_of, ways_from
from benchnav.planning.planners.planner import Plan, Planner, PlanStatus, check_steers
from benchnav.planning.planners.straight import Straight, steer_toward
from benchnav.planning.problem import Problem, Task
from benchnav.planning.robots import SPEED, TURN_RATE, Unicycle
from benchnav.planning.sensing.sensor import Step

_MIN_TRAVERSABILITY = 1e-3  # minimum λ that is planned for
_ON_DRIVE = 1e-4  # m and rad: maximum distance of a robot on a simulated drive
_MAX_LEVELS = 5


@dataclass(frozen=True, kw_only=True)
class OptimalConfig:
    """Settings of the optimal planner.

    Args:
        headings: number Q of headings.
        refine: cells of value iteration along each side of a cell of the map.
        hazard: whether it plans for the expected time under each cell's own
            distribution, in which an immobilised robot costs the whole time limit,
            instead of the time under λ̂.
    """

    headings: int = 32
    refine: int = 1
    hazard: bool = False

    def __post_init__(self) -> None:
        """Validate the grid."""
        _check_grid("optimal", self.headings, self.refine)


@dataclass(frozen=True, kw_only=True)
class NearOptimalConfig:
    """Settings of the near-optimal reference.

    Args:
        headings: number Q of headings.
        refine: cells of value iteration along each side of a cell of the map.
        levels: number L of levels of dwell time between which costs to go are
            distinguished; with 0 immobilising terrain is impassable.
    """

    headings: int = 32
    refine: int = 1
    levels: int = 3

    def __post_init__(self) -> None:
        """Validate the grid and the levels."""
        _check_grid(NearOptimal.name, self.headings, self.refine)
        expect(
            0 <= self.levels <= _MAX_LEVELS,
            f"`levels` from 0 to {_MAX_LEVELS} for {NearOptimal.name}, got "
            f"{self.levels}.",
        )


def _check_grid(name: str, headings: int, refine: int) -> None:
    expect(
        8 <= headings <= 256, f"`headings` from 8 to 256 for {name}, got {headings}."
    )
    expect(1 <= refine <= 4, f"`refine` from 1 to 4 for {name}, got {refine}.")


class Optimal(Planner[OptimalState]):
    """Planner of minimum time under the risk map, with the penalty of non-free cells.

    Args:
        config: settings.
    """

    steers = ((SPEED, TURN_RATE),)
    robots = (Unicycle,)
    plans_once = True
    name = "optimal"

    def __init__(self, config: OptimalConfig | None = None) -> None:
        """Store the settings."""
        self.config: Any = config or OptimalConfig()

    def uses(self, task: Task) -> frozenset[str]:
        """Return the distribution with `hazard`, else λ̂ and free space."""
        if self.config.hazard:
            return frozenset({"distribution"})
        return frozenset({"risk_map", task.rules.free_space.source})

    def follows(self, task: Task) -> str:
        """Return what it minimises; see `Planner`."""
        if self.config.hazard:
            return "expected time, a loss as the time limit"
        return "time under λ̂"

    def init(self, problem: Problem, generator: torch.Generator) -> OptimalState:
        """Return the plan state with the cost to go; draws nothing. See `Planner`.

        Raises:
            ConfigError: If the robot is another, or a required input is missing.
        """
        robot, times = problem.robot, self.config.refine
        check_steers(self, robot, self.name)
        low, high = robot.action_low[1], robot.action_high[1]
        expect(
            low == -high,
            f"`turn_rate_radps` alike to both sides for planner {self.name!r}, got "
            f"{low:g} to {high:g}.",
        )
        min_speed = robot.action_low[0]
        expect(
            min_speed == 0,
            f"`speed_mps` from 0 on for planner {self.name!r}, got from "
            f"{min_speed:g} on.",
        )
        assert isinstance(robot, Unicycle)
        grid = problem.grid
        grid = Grid(grid.height * times, grid.width * times, grid.resolution_m / times)
        min_radius, radius = grid.resolution_m / math.sqrt(2), problem.goal_radius_m
        expect(
            radius >= min_radius,
            f"`goal_radius_m` of at least {min_radius:.2f}, half of a cell's diagonal, for "
            f"planner {self.name!r}, got "
            f"{radius:g}.",
        )
        costs = self.costs_of(problem, grid)
        moves = Moves.of(robot, grid.resolution_m, self.config.headings)
        to_go = value_iteration(costs, moves, grid, self.config.headings)
        no_dwell = problem.start.new_zeros(len(problem))
        return OptimalState(
            problem=problem,
            grid=grid,
            costs=costs,
            to_go=to_go,
            dwell_s=no_dwell,
            taken=torch.zeros_like(no_dwell).long(),
        )

    def plan(
        self, step: Step, plan_state: OptimalState
    ) -> tuple[Tensor, OptimalState, Plan]:
        """Return actions of the motion primitive of minimum cost; see `Planner`."""
        plan_state = self.observe(step, plan_state)
        problem, dwell_s = plan_state.problem, plan_state.dwell_s
        pose, member = (
            step.state[:, :3],
            torch.arange(len(dwell_s), device=dwell_s.device),
        )
        ways = ways_from(pose, dwell_s, plan_state)
        cost, best = ways.cost.min(1)
        # The turn rate that completes the turn in this step.
        turning = self.turning_at(pose, plan_state).clamp(min=_MIN_TRAVERSABILITY)
        rate = ways.turn[member, best] / (turning * problem.dt_s)
        low, high = problem.action_bounds
        drives = ways.rolls[member, best] | (rate.abs() <= high[1])
        action = torch.stack(
            (torch.where(drives, high[0], 0.0), rate.clamp(low[1], high[1])), 1
        )
        # Without a path the robot drives straight, as other planners do, and the world
        # decides how that ends.
        is_stranded = cost >= self.no_way(plan_state.costs)
        straight = steer_toward(step.state, problem.goal_m, problem.robot)
        action = torch.where(is_stranded[:, None], straight, action)
        status = PlanStatus.PARTIAL * is_stranded.long()
        drawn = {"path": path_of(plan_state, pose, dwell_s)} if step.draw else {}
        plan = replace(Plan.empty(len(dwell_s), dwell_s.device, **drawn), status=status)
        return action, plan_state, plan

    def observe(self, step: Step, plan_state: OptimalState) -> OptimalState:
        """Return the plan state after a step, with dwell times from the observed λ."""
        immobile, dwell_s = plan_state.problem.immobile, plan_state.dwell_s
        if immobile is not None:
            immobilises = step.traversability < immobile.below
            dwell_s = torch.where(immobilises, dwell_s + plan_state.problem.dt_s, 0.0)
        return replace(plan_state, dwell_s=dwell_s, taken=plan_state.taken + 1)

    def select(self, plan_state: OptimalState, members: Tensor) -> OptimalState:
        """Return the plan state of some episodes; see `Planner`."""
        return plan_state.select(members)

    def revise(self, plan_state: OptimalState, problem: Problem) -> OptimalState:
        """Raise an error, since it plans once.

        Raises:
            ConfigError: Always.
        """
        raise ConfigError(
            f"Expected a fixed map for planner {self.name!r}, which plans once, got "
            "one that changes. "
            "Take belief 'static' and sensor 'full'."
        )

    def no_way(self, costs: Costs) -> Tensor:
        """Return the cost from which on there is no path, shape [B]."""
        return torch.full_like(costs.loss, UNREACHED / 2)

    def turning_at(self, pose: Tensor, plan_state: OptimalState) -> Tensor:
        """Return λ that scales turns at the robots' poses [B, 3], shape [B]."""
        if plan_state.costs.hazard is None:
            return plan_state.problem.traversability_at(pose)
        padded = plan_state.grid.pad(plan_state.costs.rate, UNREACHED)
        return 1 / plan_state.grid.lookup(padded, pose[:, 0], pose[:, 1])

    def costs_of(self, problem: Problem, grid: Grid) -> Costs:
        """Return the costs of driving, on the cells of value iteration."""
        if not self.config.hazard:
            penalty_rate = PENALTY * problem.robot.top_speed_mps
            rate = 1 / problem.traversability + penalty_rate * ~problem.free
            return _on_grid(problem, grid, rate, problem.free)
        immobile = problem.immobile
        if immobile is None:
            raise ConfigError(
                "Expected a world that immobilises robots for `hazard` of "
                f"{self.name!r}, got none."
            )
        lost = problem.distribution.cdf_limits(immobile.below)[0].clamp(max=1 - 1e-6)
        # The expected rate, conditional on terrain that does not immobilise.
        total_time = problem.distribution.expected_time(immobile.below)
        rate = ((total_time - lost / immobile.below) / (1 - lost)).clamp(min=1)
        hazard = -torch.log1p(-lost) / problem.grid.resolution_m
        all_open = torch.ones_like(problem.free)
        return _on_grid(problem, grid, rate, all_open, hazard=hazard)


class NearOptimal(Optimal):
    """The near-optimal reference: a fast drive on λ itself, in a world that immobilises
    robots.

    Three drives are simulated to their end as in the world: by value iteration, by
    A*+DWA with its default settings, and by `straight`. The robot follows the first
    that reaches the goal. Hence it succeeds wherever A*+DWA or `straight` does on the
    same problem, and not later. Planners that draw samples are not included: whether
    they are faster, or the only ones to succeed, is a matter of
    measurement. A robot that has left the drive is steered by value iteration.

    Args:
        config: settings.
    """

    given_truth = True
    name = "near_optimal"

    def __init__(self, config: NearOptimalConfig | None = None) -> None:
        """Store the settings."""
        self.config = config or NearOptimalConfig()

    def uses(self, task: Task) -> frozenset[str]:
        """Return the distribution and λ̂, which both are λ itself; see `Planner`."""
        return frozenset({"risk_map", "distribution"})

    def follows(self, task: Task) -> str:
        """Return what it minimises; see `Planner`."""
        return "time on λ itself"

    def init(self, problem: Problem, generator: torch.Generator) -> OptimalState:
        """Return the plan state with simulated drives; draws nothing. See `Planner`.

        Raises:
            ConfigError: If the robot is another, or the prediction is not λ itself.
        """
        plan_state = super().init(problem, generator)
        field = problem.distribution.mean()
        drive = simulate(super().plan, OptimalState.select, plan_state, problem, field)
        planners: tuple[Planner[Any], ...] = (AStarDWA(), Straight())
        for planner in planners:
            planner_state = planner.init(problem, generator)
            drive = earlier(
                drive,
                simulate(
                    planner.plan, planner.select, planner_state, problem, field, drive
                ),
            )
        return replace(plan_state, drive=drive)

    def plan(
        self, step: Step, plan_state: OptimalState
    ) -> tuple[Tensor, OptimalState, Plan]:
        """Return actions on the drive, or by value iteration off it; see `Planner`."""
        drive, taken = plan_state.drive, plan_state.taken
        assert drive is not None
        action, follows = _follow(drive, taken, step.state)
        index = torch.arange(drive.states.shape[1], device=action.device)
        is_ahead = (index >= taken[:, None]) & follows[:, None]
        path = torch.where(is_ahead[..., None], drive.states[..., :2], torch.nan)
        status = PlanStatus.PARTIAL * drive.steps.isinf().long()
        if bool(follows.all()):
            drawn = {"path": path} if step.draw else {}
            plan = replace(
                Plan.empty(len(action), action.device, **drawn), status=status
            )
            return action, self.observe(step, plan_state), plan
        steered, following, plan = super().plan(step, plan_state)
        plan = replace(plan, status=torch.where(follows, status, plan.status))
        if step.draw:
            steered_path = torch.where(follows[:, None, None], torch.nan, plan.path)
            plan = replace(plan, path=torch.cat((path, steered_path), 1))
        return torch.where(follows[:, None], action, steered), following, plan

    def no_way(self, costs: Costs) -> Tensor:
        """Return twice T, since unreached values are interpolated into cells near them.

        Not T itself: the grid makes times slightly too long, and a path of little more
        than T may succeed. See `Optimal`.
        """
        return 2 * costs.loss

    def costs_of(self, problem: Problem, grid: Grid) -> Costs:
        """Return the costs of driving; see `Optimal`."""
        distribution, immobile = problem.distribution, problem.immobile
        if not (
            isinstance(distribution, TraversabilityMixture)
            and bool((distribution.stds == 0).all())
        ):
            raise ConfigError(
                f"Expected model 'clairvoyant' for planner {self.name!r}, which is "
                "given λ itself, got a prediction that is not certain."
            )
        field = distribution.mean()
        rate = 1 / field.clamp(min=_MIN_TRAVERSABILITY)
        immobilises = (
            torch.zeros_like(problem.free)
            if immobile is None
            else field < immobile.below
        )
        if immobile is None or self.config.levels == 0:
            return _on_grid(
                problem, grid, torch.where(immobilises, UNREACHED, rate), ~immobilises
            )
        costs = _on_grid(
            problem,
            grid,
            rate,
            ~immobilises,
            immobile_s=torch.where(immobilises, rate, 0.0),
        )
        return replace(costs, lost_after_s=immobile.for_s, levels=self.config.levels)


def _follow(drive: Drive, taken: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
    """Return the next action of drives, shape [B, A], and which robots are on them,
    bool, shape [B].
    """
    member = torch.arange(len(taken), device=taken.device)
    index = taken.clamp(max=drive.actions.shape[1] - 1)
    action = drive.actions[member, index]
    off = (state - drive.states[member, index]).abs().amax(1)
    # Of an ended drive both are NaN, which is no nearer.
    follows = (taken == index) & (off < _ON_DRIVE) & ~action.isnan().any(1)
    return torch.where(follows[:, None], action, 0.0), follows


def _on_grid(
    problem: Problem,
    grid: Grid,
    rate: Tensor,
    open_: Tensor,
    hazard: Tensor | None = None,
    immobile_s: Tensor | None = None,
) -> Costs:
    """Costs on a grid that divides the map's cells, from maps of `Costs`, each of shape
    [B, H, W].
    """
    times = grid.height // problem.grid.height

    def fine(values: Tensor) -> Tensor:
        return values.repeat_interleave(times, 1).repeat_interleave(times, 2)

    dtype = problem.start.dtype
    rate = fine(rate).to(dtype)
    row, column = (torch.arange(size, device=rate.device) for size in grid.shape)
    x, y = grid.centre_of(row[:, None], column)
    goal_x, goal_y = problem.goal_m.T[:, :, None, None]
    distance_m = torch.hypot(x - goal_x, y - goal_y)
    # One rate in all of them: what a way costs within the disc is taken off again;
    # nothing immobilises a robot there.
    ends = distance_m <= problem.goal_radius_m
    goal_rate = torch.where(ends, rate, UNREACHED).amin((1, 2), keepdim=True)
    rate = torch.where(ends, goal_rate, rate)
    remaining_s = (
        (distance_m - problem.goal_radius_m) / problem.robot.top_speed_mps * rate
    )
    return Costs(
        rate=rate,
        open=fine(open_) | ends,
        final=torch.where(ends, remaining_s, torch.nan).to(dtype),
        loss=problem.time_budget_s.to(dtype),
        hazard=None if hazard is None else fine(hazard).to(dtype).masked_fill(ends, 0),
        immobile_s=None
        if immobile_s is None
        else fine(immobile_s).to(dtype).masked_fill(ends, 0),
    )
