"""The optimal planner: drives by the least cost to go of every pose on a map, found
once by value iteration.

`Optimal` takes λ̂ for λ: its time is the least under that map, "certainty-equivalent",
and no bound on what can be done on the ground. `NearOptimal` is given λ itself, by the
model `clairvoyant`, and knows the dwell time after which the world immobilises a robot.
What it drives is feasible, so the least time is at most its time: it is the
near-optimal reference, and no bound. Both plan for the paper's unicycle only, which
drives forward, and once: a map that changes is refused.
Letters in shapes: B episodes, H×W cells, Q headings, K ways, N points, L levels of
dwell time.
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

_LEAST_KNOWN = 1e-3  # least λ that is planned for
_ON_DRIVE = 1e-4  # m and rad: a robot nearer than that to a simulated drive is on it
_MAX_LEVELS = 5


@dataclass(frozen=True, kw_only=True)
class OptimalConfig:
    """Settings of the optimal planner.

    Args:
        headings: Q, in which a circle is divided.
        refine: cells of value iteration along each side of a cell of the map.
        hazard: plans for the expected time under each cell's own distribution, of which
            an immobilised robot pays the whole limit, in place of the time under λ̂.
    """

    headings: int = 32
    refine: int = 1
    hazard: bool = False

    def __post_init__(self) -> None:
        """Refuses grids that are none."""
        _check_grid("optimal", self.headings, self.refine)


@dataclass(frozen=True, kw_only=True)
class NearOptimalConfig:
    """Settings of the near-optimal reference.

    Args:
        headings: Q, in which a circle is divided.
        refine: cells of value iteration along each side of a cell of the map.
        levels: L, of dwell time, between which costs to go are distinguished; 0 takes a
            robot for lost where it enters immobilising terrain.
    """

    headings: int = 32
    refine: int = 1
    levels: int = 3

    def __post_init__(self) -> None:
        """Refuses grids that are none."""
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
    """Drives by the least time to go under the risk map, with the penalty of ground
    that is not free.

    Args:
        config: settings.
    """

    steers = ((SPEED, TURN_RATE),)
    robots = (Unicycle,)
    plans_once = True
    name = "optimal"

    def __init__(self, config: OptimalConfig | None = None) -> None:
        """Keeps the settings; all else is in the plan state."""
        self.config: Any = config or OptimalConfig()

    def uses(self, task: Task) -> frozenset[str]:
        """With `hazard` the distribution, else λ̂ and free space; see `Planner`."""
        if self.config.hazard:
            return frozenset({"distribution"})
        return frozenset({"risk_map", task.rules.free_space.source})

    def follows(self, task: Task) -> str:
        """What it minimises; see `Planner`."""
        return (
            "expected time, a loss as the time limit"
            if self.config.hazard
            else "time under λ̂"
        )

    def init(self, problem: Problem, generator: torch.Generator) -> OptimalState:
        """Finds the cost to go; draws nothing. See `Planner`.

        Raises:
            ConfigError: the robot is another, or what is asked for is not known.
        """
        robot, times = problem.robot, self.config.refine
        check_steers(self, robot, self.name)
        low, high = robot.action_low[1], robot.action_high[1]
        expect(
            low == -high,
            f"`turn_rate_radps` alike to both sides for planner {self.name!r}, got "
            f"{low:g} to {high:g}.",
        )
        least_speed = robot.action_low[0]
        expect(
            least_speed == 0,
            f"`speed_mps` from 0 on for planner {self.name!r}, got from "
            f"{least_speed:g} on.",
        )
        assert isinstance(robot, Unicycle)
        grid = problem.grid
        grid = Grid(grid.height * times, grid.width * times, grid.resolution_m / times)
        least, radius = grid.resolution_m / math.sqrt(2), problem.goal_radius_m
        expect(
            radius >= least,
            f"`goal_radius_m` of at least {least:.2f}, half of a cell's diagonal, for "
            f"planner {self.name!r}, got "
            f"{radius:g}.",
        )
        costs = self.costs_of(problem, grid)
        moves = Moves.of(robot, grid.resolution_m, self.config.headings)
        to_go = value_iteration(costs, moves, grid, self.config.headings)
        held = problem.start.new_zeros(len(problem))
        return OptimalState(
            problem=problem,
            grid=grid,
            costs=costs,
            to_go=to_go,
            held=held,
            taken=torch.zeros_like(held).long(),
        )

    def plan(
        self, step: Step, plan_state: OptimalState
    ) -> tuple[Tensor, OptimalState, Plan]:
        """Begins the way that leads to the least cost; see `Planner`."""
        plan_state = self.observe(step, plan_state)
        problem, held = plan_state.problem, plan_state.held
        pose, own = step.state[:, :3], torch.arange(len(held), device=held.device)
        ways = ways_from(pose, held, plan_state)
        cost, best = ways.cost.min(1)
        # What a turn takes to be over after this step.
        rate = ways.turn[own, best] / (
            self.turning_at(pose, plan_state).clamp(min=_LEAST_KNOWN) * problem.dt_s
        )
        low, high = problem.action_bounds
        drives = ways.rolls[own, best] | (rate.abs() <= high[1])
        action = torch.stack(
            (torch.where(drives, high[0], 0.0), rate.clamp(low[1], high[1])), 1
        )
        # Without a path the robot drives straight, as other planners do, and the world
        # says how that ends.
        stranded = cost >= self.no_way(plan_state.costs)
        action = torch.where(
            stranded[:, None],
            steer_toward(step.state, problem.goal_m, problem.robot),
            action,
        )
        status = PlanStatus.PARTIAL * stranded.long()
        drawn = {"path": path_of(plan_state, pose, held)} if step.draw else {}
        plan = replace(Plan.empty(len(held), held.device, **drawn), status=status)
        return action, plan_state, plan

    def observe(self, step: Step, plan_state: OptimalState) -> OptimalState:
        """Count the step, and the dwell time by the λ that the robots met in the last
        one.
        """
        immobile, held = plan_state.problem.immobile, plan_state.held
        if immobile is not None:
            holds = step.traversability < immobile.below
            held = torch.where(holds, held + plan_state.problem.dt_s, 0.0)
        return replace(plan_state, held=held, taken=plan_state.taken + 1)

    def select(self, plan_state: OptimalState, members: Tensor) -> OptimalState:
        """Keeps some episodes; see `Planner`."""
        return plan_state.select(members)

    def revise(self, plan_state: OptimalState, problem: Problem) -> OptimalState:
        """Refuses: it plans once.

        Raises:
            ConfigError: always.
        """
        raise ConfigError(
            f"Expected a fixed map for planner {self.name!r}, which plans once, got "
            "one that changes. "
            "Take belief 'static' and sensor 'full'."
        )

    def no_way(self, costs: Costs) -> Tensor:
        """Cost from which on there is no way, shape [B]."""
        return torch.full_like(costs.loss, UNREACHED / 2)

    def turning_at(self, pose: Tensor, plan_state: OptimalState) -> Tensor:
        """λ by which a robot is taken to turn where it stands, shape [B], from poses
        [B, 3].
        """
        if plan_state.costs.hazard is None:
            return plan_state.problem.traversability_at(pose)
        padded = plan_state.grid.pad(plan_state.costs.rate, UNREACHED)
        return 1 / plan_state.grid.lookup(padded, pose[:, 0], pose[:, 1])

    def costs_of(self, problem: Problem, grid: Grid) -> Costs:
        """What driving costs, on the cells of value iteration."""
        if not self.config.hazard:
            rate = (
                1 / problem.traversability
                + PENALTY * problem.robot.top_speed_mps * ~problem.free
            )
            return _on_grid(problem, grid, rate, problem.free)
        immobile = problem.immobile
        if immobile is None:
            raise ConfigError(
                "Expected a world that immobilises robots for `hazard` of "
                f"{self.name!r}, got none."
            )
        lost = problem.distribution.cdf_limits(immobile.below)[0].clamp(max=1 - 1e-6)
        # Of ground that does not hold the robot.
        whole = problem.distribution.expected_time(immobile.below)
        rate = ((whole - lost / immobile.below) / (1 - lost)).clamp(min=1)
        hazard = -torch.log1p(-lost) / problem.grid.resolution_m
        return _on_grid(
            problem, grid, rate, torch.ones_like(problem.free), hazard=hazard
        )


class NearOptimal(Optimal):
    """The near-optimal reference: a quick drive on λ itself, in a world that
    immobilises robots.

    Three drives are simulated to their end as the world does it: by value iteration, by
    A*+DWA with its default settings, and by `straight`. The robot follows the earliest
    to reach the goal. So wherever A*+DWA or `straight` reaches the goal on the same
    problem, this does too, and no later. Planners that draw samples are not among the
    three: where they are quicker, or the only ones to succeed, is a matter of
    measurement. A robot that has left the drive is steered by value iteration.

    Args:
        config: settings.
    """

    given_truth = True
    name = "near_optimal"

    def __init__(self, config: NearOptimalConfig | None = None) -> None:
        """Keeps the settings; all else is in the plan state."""
        self.config = config or NearOptimalConfig()

    def uses(self, task: Task) -> frozenset[str]:
        """λ itself, which both the distribution and λ̂ are; see `Planner`."""
        return frozenset({"risk_map", "distribution"})

    def follows(self, task: Task) -> str:
        """What it minimises; see `Planner`."""
        return "time on λ itself"

    def init(self, problem: Problem, generator: torch.Generator) -> OptimalState:
        """Finds the cost to go and simulates the drives; draws nothing. See `Planner`.

        Raises:
            ConfigError: If the robot is another, or the prediction is not λ itself.
        """
        plan_state = super().init(problem, generator)
        field = problem.distribution.mean()
        drive = simulate(super().plan, OptimalState.select, plan_state, problem, field)
        others: tuple[Planner[Any], ...] = (AStarDWA(), Straight())
        for other in others:
            begun = other.init(problem, generator)
            drive = earlier(
                drive, simulate(other.plan, other.select, begun, problem, field, drive)
            )
        return replace(plan_state, drive=drive)

    def plan(
        self, step: Step, plan_state: OptimalState
    ) -> tuple[Tensor, OptimalState, Plan]:
        """Follows the drive, or value iteration where the robot is not on it; see
        `Planner`.
        """
        drive, taken = plan_state.drive, plan_state.taken
        assert drive is not None
        action, follows = _follow(drive, taken, step.state)
        rest = (
            torch.arange(drive.states.shape[1], device=action.device) >= taken[:, None]
        )
        path = torch.where(
            (rest & follows[:, None])[..., None], drive.states[..., :2], torch.nan
        )
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
        """Twice T, as the value of where there is no way reaches into cells beside it;
        see `Optimal`.

        Not T itself: the grid makes times a little too long, and a path that takes
        little more than T may arrive.
        """
        return 2 * costs.loss

    def costs_of(self, problem: Problem, grid: Grid) -> Costs:
        """What driving costs; see `Optimal`."""
        known, immobile = problem.distribution, problem.immobile
        if not (
            isinstance(known, TraversabilityMixture) and bool((known.stds == 0).all())
        ):
            raise ConfigError(
                f"Expected model 'clairvoyant' for planner {self.name!r}, which is "
                "given λ itself, got a prediction "
                "that is not certain."
            )
        field = known.mean()
        rate = 1 / field.clamp(min=_LEAST_KNOWN)
        holds = (
            torch.zeros_like(problem.free)
            if immobile is None
            else field < immobile.below
        )
        if immobile is None or self.config.levels == 0:
            return _on_grid(problem, grid, torch.where(holds, UNREACHED, rate), ~holds)
        costs = _on_grid(
            problem, grid, rate, ~holds, immobile_s=torch.where(holds, rate, 0.0)
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
    away = torch.hypot(x - goal_x, y - goal_y)
    # One rate in all of them: what a way costs within the disc is taken off again;
    # nothing immobilises a robot there.
    ends = away <= problem.goal_radius_m
    within = torch.where(ends, rate, UNREACHED).amin((1, 2), keepdim=True)
    rate = torch.where(ends, within, rate)
    left = (away - problem.goal_radius_m) / problem.robot.top_speed_mps * rate
    return Costs(
        rate=rate,
        open=fine(open_) | ends,
        final=torch.where(ends, left, torch.nan).to(dtype),
        loss=problem.time_budget_s.to(dtype),
        hazard=None if hazard is None else fine(hazard).to(dtype).masked_fill(ends, 0),
        immobile_s=None
        if immobile_s is None
        else fine(immobile_s).to(dtype).masked_fill(ends, 0),
    )
