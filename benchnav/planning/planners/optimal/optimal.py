"""The optimal planner: value iteration over the poses of a map.

Value iteration computes the minimum cost to go of every pose once, and the robot
descends it. `Optimal` uses λ̂ as if it were λ. Its time is the minimum under the
predicted map, and no bound for the true terrain. `NearOptimal` receives λ itself, from
the model `clairvoyant`, and considers the dwell time after which the world immobilises
a robot. It is the near-optimal reference, and no lower bound: its drives are feasible,
so the minimum time is at most its time. Both plan only for the paper's unicycle, which
drives forward, and reject maps that change. Letters in shapes: B episodes, H×W cells, Q
headings, K primitives, N points, L levels of dwell time.
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
from benchnav.planning.planners.optimal.primitives import (
    OptimalState,
    path_of,
    primitives_from,
)
from benchnav.planning.planners.optimal.value import (
    UNREACHED,
    Costs,
    Moves,
    value_iteration,
)
from benchnav.planning.planners.planner import Plan, Planner, PlanStatus, check_steers
from benchnav.planning.planners.straight import Straight, steer_toward
from benchnav.planning.problem import Problem, Task
from benchnav.planning.robots import SPEED, TURN_RATE, Robot, Unicycle
from benchnav.planning.sensing.sensor import Step

_MIN_TRAVERSABILITY = 1e-3  # A smaller λ is replaced by this value.
_MAX_DEVIATION = 1e-4  # maximum deviation from a simulated drive, in m and rad
_MAX_LEVELS = 5


@dataclass(frozen=True, kw_only=True)
class OptimalConfig:
    """Settings of the optimal planner.

    Args:
        headings: number of headings Q, 8 to 256.
        refine: number of cells of value iteration along each side of a map cell, 1 to
            4.
        hazard: whether to minimise the expected time under each cell's distribution,
            with the time budget as the cost of an immobilised robot, instead of the
            time under λ̂.
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
        headings: number of headings Q, 8 to 256.
        refine: number of cells of value iteration along each side of a map cell, 1 to
            4.
        levels: number of levels of dwell time L, 0 to 5, each with a cost to go; 0
            makes immobilising terrain impassable.
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
    is_valid = 8 <= headings <= 256
    expect(is_valid, f"`headings` from 8 to 256 for {name}, got {headings}.")
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
        """Return the names of the predicted inputs; see `Planner`."""
        if self.config.hazard:
            return frozenset({"distribution"})
        return frozenset({"risk_map", task.rules.free_space.source})

    def follows(self, task: Task) -> str:
        """Return the cost that the planner minimises; see `Planner`."""
        if self.config.hazard:
            return "expected time, a loss as the time limit"
        return "time under λ̂"

    def init(self, problem: Problem, generator: torch.Generator) -> OptimalState:
        """Return the plan state with the cost to go; see `Planner`.

        Raises:
            ConfigError: If the robot, the goal radius or the world is not supported;
                see the message.
        """
        robot = problem.robot
        headings = self.config.headings
        self._check_robot(robot)
        assert isinstance(robot, Unicycle)
        grid = _refined(problem.grid, self.config.refine)
        min_radius = grid.resolution_m / math.sqrt(2)
        radius = problem.goal_radius_m
        expect(
            radius >= min_radius,
            f"`goal_radius_m` ≥ {min_radius:.2f} m (half a cell's diagonal) for planner "
            f"{self.name!r}, got {radius:g} m. Raise the radius or `refine`.",
        )
        costs = self.costs_of(problem, grid)
        moves = Moves.of(robot, grid.resolution_m, headings)
        to_go = value_iteration(costs, moves, grid, headings)
        no_dwell = problem.start.new_zeros(len(problem))
        return OptimalState(
            problem=problem,
            grid=grid,
            costs=costs,
            to_go=to_go,
            dwell_s=no_dwell,
            n_steps=torch.zeros_like(no_dwell).long(),
        )

    def _check_robot(self, robot: Robot) -> None:
        check_steers(self, robot, self.name)
        min_speed, low = robot.action_low
        _, high = robot.action_high
        expect(
            low == -high,
            "the same maximum of `turn_rate_radps` for left and right turns with "
            f"planner {self.name!r}, got a range of {low:g} to {high:g}.",
        )
        expect(
            min_speed == 0,
            f"`speed_mps` with minimum 0 for planner {self.name!r}, got minimum "
            f"{min_speed:g}.",
        )

    def plan(
        self, step: Step, plan_state: OptimalState
    ) -> tuple[Tensor, OptimalState, Plan]:
        """Return actions along the motion primitives of minimum cost; see `Planner`."""
        plan_state = self.observe(step, plan_state)
        problem = plan_state.problem
        dwell_s = plan_state.dwell_s
        pose = step.state[:, :3]
        member = torch.arange(len(dwell_s), device=dwell_s.device)
        primitives = primitives_from(pose, dwell_s, plan_state)
        cost, best = primitives.cost.min(1)
        # `rate` is the turn rate that completes the turn in this step.
        turning = self.turning_at(pose, plan_state).clamp(min=_MIN_TRAVERSABILITY)
        rate = primitives.turn[member, best] / (turning * problem.dt_s)
        low, high = problem.action_bounds
        drives = primitives.rolls[member, best] | (rate.abs() <= high[1])
        speed = torch.where(drives, high[0], 0.0)
        action = torch.stack((speed, rate.clamp(low[1], high[1])), 1)
        # Without a path to the goal, the robot drives straight to the goal.
        is_stranded = cost >= self.no_path_cost(plan_state.costs)
        straight = steer_toward(step.state, problem.goal_m, problem.robot)
        action = torch.where(is_stranded[:, None], straight, action)
        status = PlanStatus.PARTIAL * is_stranded.long()
        drawn = {"path": path_of(plan_state, pose, dwell_s)} if step.draw else {}
        plan = Plan.empty(len(dwell_s), dwell_s.device, **drawn)
        return action, plan_state, replace(plan, status=status)

    def observe(self, step: Step, plan_state: OptimalState) -> OptimalState:
        """Return the plan state after a step, with dwell times from the observed λ."""
        problem = plan_state.problem
        dwell_s = plan_state.dwell_s
        if problem.immobile is not None:
            immobilises = step.traversability < problem.immobile.below
            dwell_s = torch.where(immobilises, dwell_s + problem.dt_s, 0.0)
        return replace(plan_state, dwell_s=dwell_s, n_steps=plan_state.n_steps + 1)

    def select(self, plan_state: OptimalState, members: Tensor) -> OptimalState:
        """Return the plan state of some episodes; see `Planner`."""
        return plan_state.select(members)

    def revise(self, plan_state: OptimalState, problem: Problem) -> OptimalState:
        """Raise an error, since the planner plans only once.

        Raises:
            ConfigError: Always.
        """
        raise ConfigError(
            f"Expected a constant map for planner {self.name!r}, got an updated map. "
            "This planner plans only once. Use belief 'static' and sensor 'full'."
        )

    def no_path_cost(self, costs: Costs) -> Tensor:
        """Return the cost from which on a pose has no path to the goal, shape [B]."""
        return torch.full_like(costs.loss, UNREACHED / 2)

    def turning_at(self, pose: Tensor, plan_state: OptimalState) -> Tensor:
        """Return the λ that scales turns in place at poses [B, 3], shape [B]."""
        grid = plan_state.grid
        costs = plan_state.costs
        if costs.hazard is None:
            return plan_state.problem.traversability_at(pose)
        rate = grid.pad(costs.rate, UNREACHED)
        return 1 / grid.lookup(rate, pose[:, 0], pose[:, 1])

    def costs_of(self, problem: Problem, grid: Grid) -> Costs:
        """Return the costs of driving on the cells of value iteration."""
        if not self.config.hazard:
            penalty_rate = PENALTY * problem.robot.top_speed_mps
            rate = 1 / problem.traversability + penalty_rate * ~problem.free
            return _on_grid(problem, grid, rate, problem.free)
        immobile = problem.immobile
        if immobile is None:
            raise ConfigError(
                f"Expected option `hazard` of planner {self.name!r} only in a world "
                "that immobilises robots, got a world without `immobile`."
            )
        below = immobile.below
        distribution = problem.distribution
        lost, _ = distribution.cdf_limits(below)
        lost = lost.clamp(max=1 - 1e-6)
        # Expected rate, given that the terrain does not immobilise the robot.
        total_time = distribution.expected_time(below)
        rate = (total_time - lost / below) / (1 - lost)
        rate = rate.clamp(min=1)
        hazard = -torch.log1p(-lost) / problem.grid.resolution_m
        all_open = torch.ones_like(problem.free)
        return _on_grid(problem, grid, rate, all_open, hazard=hazard)


class NearOptimal(Optimal):
    """Near-optimal reference, which follows a fast drive on λ itself.

    Three drives are simulated to their ends by the rules of the world: by value
    iteration, by A*+DWA with its default settings, and by `straight`. The robot follows
    the drive that reaches the goal first. Hence it succeeds whenever A*+DWA or
    `straight` succeeds on the same problem, and at least as early. Planners that draw
    samples may be faster. Value iteration steers a robot that has left the drive.

    Args:
        config: settings.
    """

    given_truth = True
    name = "near_optimal"

    def __init__(self, config: NearOptimalConfig | None = None) -> None:
        """Store the settings."""
        self.config = config or NearOptimalConfig()

    def uses(self, task: Task) -> frozenset[str]:
        """Return the names of the predicted inputs; see `Planner`."""
        return frozenset({"risk_map", "distribution"})

    def follows(self, task: Task) -> str:
        """Return the cost that the planner minimises; see `Planner`."""
        return "time on λ itself"

    def init(self, problem: Problem, generator: torch.Generator) -> OptimalState:
        """Return the plan state with the simulated drive; see `Planner`.

        Raises:
            ConfigError: If the robot is not supported, or the prediction is not λ
                itself.
        """
        plan_state = super().init(problem, generator)
        field = problem.distribution.mean()
        drive = simulate(super().plan, OptimalState.select, plan_state, problem, field)
        planners: tuple[Planner[Any], ...] = (AStarDWA(), Straight())
        for planner in planners:
            first_state = planner.init(problem, generator)
            rival = simulate(
                planner.plan, planner.select, first_state, problem, field, drive
            )
            drive = earlier(drive, rival)
        return replace(plan_state, drive=drive)

    def plan(
        self, step: Step, plan_state: OptimalState
    ) -> tuple[Tensor, OptimalState, Plan]:
        """Return the drive's actions; off the drive, those of value iteration."""
        drive = plan_state.drive
        n_steps = plan_state.n_steps
        assert drive is not None
        action, follows = _follow(drive, n_steps, step.state)
        index = torch.arange(drive.states.shape[1], device=action.device)
        is_ahead = (index >= n_steps[:, None]) & follows[:, None]
        path = torch.where(is_ahead[..., None], drive.states[..., :2], torch.nan)
        status = PlanStatus.PARTIAL * drive.steps.isinf().long()
        if bool(follows.all()):
            drawn = {"path": path} if step.draw else {}
            plan = Plan.empty(len(action), action.device, **drawn)
            plan = replace(plan, status=status)
            return action, self.observe(step, plan_state), plan
        steered, following, plan = super().plan(step, plan_state)
        plan = replace(plan, status=torch.where(follows, status, plan.status))
        if step.draw:
            steered_path = torch.where(follows[:, None, None], torch.nan, plan.path)
            path = torch.cat((path, steered_path), 1)
            plan = replace(plan, path=path)
        return torch.where(follows[:, None], action, steered), following, plan

    def no_path_cost(self, costs: Costs) -> Tensor:
        """Return twice the time budget T, shape [B]; see `Optimal`.

        The costs of poses without a path are interpolated with those of neighbouring
        poses, and may then be below `UNREACHED`. T itself would be too low: on the
        grid, times are slightly too long, so a path with a cost just above T may
        succeed.
        """
        return 2 * costs.loss

    def costs_of(self, problem: Problem, grid: Grid) -> Costs:
        """Return the costs of driving; see `Optimal`."""
        distribution = problem.distribution
        immobile = problem.immobile
        is_certain = False
        if isinstance(distribution, TraversabilityMixture):
            is_certain = bool((distribution.stds == 0).all())
        if not is_certain:
            raise ConfigError(
                f"Expected model 'clairvoyant' for planner {self.name!r}, got a model "
                "that predicts uncertain λ. This planner needs the true λ."
            )
        field = distribution.mean()
        rate = 1 / field.clamp(min=_MIN_TRAVERSABILITY)
        if immobile is None:
            return _on_grid(problem, grid, rate, torch.ones_like(problem.free))
        immobilises = field < immobile.below
        if self.config.levels == 0:
            rate = torch.where(immobilises, UNREACHED, rate)
            return _on_grid(problem, grid, rate, ~immobilises)
        immobile_s = torch.where(immobilises, rate, 0.0)
        costs = _on_grid(problem, grid, rate, ~immobilises, immobile_s=immobile_s)
        return replace(costs, lost_after_s=immobile.for_s, levels=self.config.levels)


def _follow(drive: Drive, n_steps: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
    """Return the next actions of drives, and a mask of robots that are on them.

    Args:
        drive: simulated drives.
        n_steps: number of steps taken, int64, shape [B].
        state: states of the robots, shape [B, S].

    Returns:
        Actions, 0 off the drive, shape [B, A]; and the mask, bool, shape [B].
    """
    member = torch.arange(len(n_steps), device=n_steps.device)
    index = n_steps.clamp(max=drive.actions.shape[1] - 1)
    action = drive.actions[member, index]
    deviation = (state - drive.states[member, index]).abs().amax(1)
    # After the end of a drive its states are NaN, so that the comparison is false.
    is_on = (n_steps == index) & (deviation < _MAX_DEVIATION)
    follows = is_on & ~action.isnan().any(1)
    return torch.where(follows[:, None], action, 0.0), follows


def _refined(grid: Grid, times: int) -> Grid:
    """Return a grid with each cell divided into several along each side."""
    return Grid(grid.height * times, grid.width * times, grid.resolution_m / times)


def _on_grid(
    problem: Problem,
    grid: Grid,
    rate: Tensor,
    open_: Tensor,
    hazard: Tensor | None = None,
    immobile_s: Tensor | None = None,
) -> Costs:
    """Return costs on a grid that divides the map's cells.

    Args:
        problem: B problems.
        grid: grid of value iteration.
        rate: `Costs.rate` on the cells of the map; the other maps are also on these
            cells, shape [B, H, W].
        open_: `Costs.open` on these cells.
        hazard: `Costs.hazard` on these cells.
        immobile_s: `Costs.immobile_s` on these cells.
    """
    times = grid.height // problem.grid.height
    dtype = problem.start.dtype

    def fine(values: Tensor) -> Tensor:
        return values.repeat_interleave(times, 1).repeat_interleave(times, 2)

    def outside_goal(values: Tensor | None) -> Tensor | None:
        """Return values on the fine grid, 0 within the goal's disc."""
        if values is None:
            return None
        return fine(values).to(dtype).masked_fill(ends, 0)

    rate = fine(rate).to(dtype)
    row = torch.arange(grid.height, device=rate.device)
    column = torch.arange(grid.width, device=rate.device)
    x, y = grid.centre_of(row[:, None], column)
    goal_x, goal_y = problem.goal_m.T[:, :, None, None]
    distance_m = torch.hypot(x - goal_x, y - goal_y)
    # All cells within the goal's disc have the same rate, so that `final` can subtract
    # the cost of a path within the disc. Terrain there does not immobilise a robot.
    ends = distance_m <= problem.goal_radius_m
    goal_rate = torch.where(ends, rate, UNREACHED).amin((1, 2), keepdim=True)
    rate = torch.where(ends, goal_rate, rate)
    outside_m = distance_m - problem.goal_radius_m
    remaining_s = outside_m / problem.robot.top_speed_mps * rate
    return Costs(
        rate=rate,
        open=fine(open_) | ends,
        final=torch.where(ends, remaining_s, torch.nan).to(dtype),
        loss=problem.time_budget_s.to(dtype),
        hazard=outside_goal(hazard),
        immobile_s=outside_goal(immobile_s),
    )
