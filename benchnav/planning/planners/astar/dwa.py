"""The dynamic window approach (DWA): the best constant (v, ω) that is reachable.

The window consists of the velocity pairs (v, ω) that a robot can reach within one step,
by its acceleration limits. DWA chooses the pair with the best arc. A robot without
acceleration limits can reach all pairs within its bounds. Source: Fox, Burgard and
Thrun (1997), "The dynamic window approach to collision avoidance".

The cost of an arc differs from the source. Each pair is rolled out for the whole
horizon through F under λ̂. Its cost is J toward a waypoint plus a cost of its final
heading. Each step in a non-free cell before the waypoint has a penalty. Braking
distance, clearance and speed are not considered. DWA is therefore slow in narrow
passages, and needs a recovery when it stalls.

Letters in shapes: B episodes, M velocity pairs, N cells of a padded map, T horizon
steps, S state dimensions.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.planning.planners.compilation import Fused
from benchnav.planning.planners.planner import (
    LocalPlanner,
    Plan,
    check_finite,
    rollout_path,
)
from benchnav.planning.planners.straight import turn_toward
from benchnav.planning.problem import (
    Dynamics,
    Problem,
    Task,
    motion_traversability,
    predicted_traversability,
    stage_cost,
)
from benchnav.planning.robots import component_wise, steps_in
from benchnav.planning.sensing.sensor import Step

_CHUNK_STEPS = 10  # number of steps that are compiled together
_MIN_COMPILED_PAIRS = 100  # minimum number of pairs for which rollouts are compiled
_PLOT_STRIDE = 5  # number of steps between the positions of a trajectory in figures


@dataclass(frozen=True, kw_only=True)
class DWAConfig:
    """Settings of DWA; the defaults are this project's, since the paper has no values.

    Args:
        speeds: number of linear velocities in the window.
        turn_rates: number of angular velocities in the window; an odd number includes
            straight driving.
        horizon_s: duration of a rollout in seconds, rounded to a number of steps T ≥ 1.
        heading_weight: cost per radian between the final heading and the direction of
            the waypoint, as a fraction of J of standing for the horizon. This cost
            makes a robot turn in place, although a turn does not change the distance.
        arrival_m: distance to the waypoint in metres within which a rollout has no
            further costs, so that a near waypoint does not slow the robot.
    """

    speeds: int = 10
    turn_rates: int = 21
    horizon_s: float = 5.0
    heading_weight: float = 0.05
    arrival_m: float = 0.2

    def __post_init__(self) -> None:
        """Validate the window and the weights."""
        above_zero = "speeds", "turn_rates", "horizon_s"
        at_least_zero = "heading_weight", "arrival_m"
        check_finite("DWA", self, above_zero, at_least_zero)


@dataclass(frozen=True)
class DWAState(Batch):
    """Plan state of DWA.

    Args:
        problem: problems of B episodes.
        velocity: current (v, ω) of the robots, shape [B, 2].
    """

    problem: Problem
    velocity: Tensor


class DWA(LocalPlanner[DWAState]):
    """DWA as a local planner, for robots with actions (v, ω).

    Args:
        config: settings.
    """

    name = "DWA"

    def __init__(self, config: DWAConfig | None = None) -> None:
        """Store the settings."""
        self.config = config or DWAConfig()
        pairs = self.config.speeds * self.config.turn_rates
        # These arguments have an episode dimension: states, cost, under_way, pairs,
        # padded_ground and target.
        batched = (0, 1, 2, 3, 4, 5)
        self._rollout = Fused(rollout, pairs, _MIN_COMPILED_PAIRS, batched=batched)

    @property
    def compiled(self) -> bool | None:
        """Whether rollouts run compiled; None before the first step."""
        return self._rollout.compiled

    def uses(self, task: Task) -> frozenset[str]:
        """Return the names of λ̂ and of the input of free space; see `Planner`."""
        return frozenset({"risk_map", task.rules.free_space.source})

    def init(self, problem: Problem, generator: torch.Generator) -> DWAState:
        """Return the plan state of standing robots; see `LocalPlanner`."""
        no_velocity = problem.start.new_zeros(len(problem), 2)
        return DWAState(problem, no_velocity)

    def plan_toward(
        self, step: Step, plan_state: DWAState, target_m: Tensor
    ) -> tuple[Tensor, DWAState, Plan]:
        """Return the pair of the window with the minimum cost; see `LocalPlanner`."""
        config = self.config
        problem = plan_state.problem
        state = step.state
        window = velocity_window(problem, plan_state.velocity, config)
        cost = score(problem, state, window, target_m, config, self._rollout)
        best = cost.argmin(dim=1)[:, None, None]
        action = window.take_along_dim(best, 1)[:, 0]
        layers = {}
        if step.draw:
            horizon = steps_in(config.horizon_s, problem.dt_s)
            actions = window.mT[:, None].expand(-1, horizon, -1, -1)
            paths = rollout_path(problem, state, actions)
            path = paths.take_along_dim(best[..., None], 1)[:, 0]
            layers = {"path": path, "samples": paths[:, :, ::_PLOT_STRIDE]}
        plan = Plan.empty(len(problem), state.device, **layers)
        return action, plan_state, plan

    def commit_action(self, plan_state: DWAState, action: Tensor) -> DWAState:
        """Return the plan state with the robots' new velocities; see `LocalPlanner`."""
        problem = plan_state.problem
        low, high = reachable(problem, plan_state.velocity)
        return DWAState(problem, action.clamp(low, high))


def reachable(problem: Problem, velocity: Tensor) -> tuple[Tensor, Tensor]:
    """Return minimum and maximum velocities that are reachable within one step.

    Args:
        problem: problem with the robot's limits.
        velocity: current (v, ω), shape [B, 2].
    """
    speed, turn_rate = velocity.unbind(1)
    rates = problem.robot.action_rates or (math.inf, math.inf)
    # The limits are floats, since a tensor would be copied to the device at each step.
    max_change = rates[0] * problem.dt_s
    max_turn_change = rates[1] * problem.dt_s
    low = torch.stack((speed - max_change, turn_rate - max_turn_change), dim=1)
    high = torch.stack((speed + max_change, turn_rate + max_turn_change), dim=1)
    bounds = problem.action_bounds
    return low.clamp(*bounds), high.clamp(*bounds)


def velocity_window(problem: Problem, velocity: Tensor, config: DWAConfig) -> Tensor:
    """Return the velocity pairs that the robot can reach within one step.

    Args:
        problem: problem with the robot's bounds, limits and time step.
        velocity: current (v, ω), shape [B, 2].
        config: settings.

    Returns:
        Pairs (v, ω) within the bounds, shape [B, M, 2].
    """
    low, high = reachable(problem, velocity)
    fractions = []
    for count in (config.speeds, config.turn_rates):
        steps = torch.linspace(
            0, 1, count, device=velocity.device, dtype=velocity.dtype
        )
        fractions.append(steps)
    low = low[:, None]
    span = high[:, None] - low
    return low + span * torch.cartesian_prod(*fractions)


class Arcs(NamedTuple):
    """Rollouts of velocity pairs.

    Args:
        states: robot states, shape [B, M, S].
        cost: cost of the previous steps, shape [B, M].
        under_way: mask of pairs that have not reached the target, bool, shape [B, M].
    """

    states: Tensor
    cost: Tensor
    under_way: Tensor


def rollout(
    arcs: Arcs,
    pairs: Tensor,
    padded_ground: Tensor,
    target: Tensor,
    dynamics: Dynamics,
    arrival_m: float,
    steps: int,
) -> Arcs:
    """Roll out each pair, and add the costs of pairs that have not reached the target.

    Args:
        arcs: rollouts up to this step.
        pairs: pairs (v, ω), shape [B, M, 2].
        padded_ground: maps as in `Problem.padded_ground`, shape [B, N].
        target: waypoints (x, y) in metres, shape [B, 1, 2].
        dynamics: grid, robot and objective.
        arrival_m: distance in metres within which a pair has reached the target.
        steps: number of steps to roll out.
    """
    states, cost, under_way = arcs
    grid, robot, objective, min_traversability = dynamics
    for _ in range(steps):
        ground = grid.lookup(padded_ground, states[..., 0], states[..., 1])
        step_cost = stage_cost(objective, states, pairs, ground, target)
        cost = cost + step_cost * under_way
        traversability = motion_traversability(ground, min_traversability)
        states = robot(states, pairs, traversability)
        offset = states[..., :2] - target
        square = (offset * offset).sum(-1)
        under_way = under_way & (square > arrival_m**2)
    return Arcs(component_wise(states), cost, under_way)


def score(
    problem: Problem,
    state: Tensor,
    window: Tensor,
    target_m: Tensor,
    config: DWAConfig,
    advance: Callable[..., Arcs] = rollout,
) -> Tensor:
    """Return the costs of the window's pairs over the horizon.

    Args:
        problem: B problems.
        state: robot states, shape [B, S].
        window: pairs (v, ω), shape [B, M, 2].
        target_m: waypoints (x, y) in metres, shape [B, 2].
        config: settings.
        advance: `rollout`, which may be compiled.

    Returns:
        Cost of each pair, shape [B, M].
    """
    target = target_m[:, None].contiguous()
    begin = state[:, None]
    states = component_wise(begin.expand(-1, window.shape[1], -1))
    pairs = component_wise(window)
    cost = torch.zeros_like(window[..., 0])
    under_way = torch.ones_like(cost, dtype=torch.bool)
    arcs = Arcs(states, cost, under_way)
    ground = problem.padded_ground
    dynamics = problem.dynamics
    arrival_m = config.arrival_m
    steps = steps_in(config.horizon_s, problem.dt_s)
    for first in range(0, steps, _CHUNK_STEPS):
        count = min(_CHUNK_STEPS, steps - first)
        arcs = advance(arcs, pairs, ground, target, dynamics, arrival_m, count)
    states, cost, under_way = arcs
    # The unit of the heading weight is J, without penalties, of a robot that stands for
    # the horizon.
    no_action = problem.start.new_zeros(len(problem), 2)
    standing = no_action.clamp(*problem.action_bounds)
    traversability = predicted_traversability(problem.ground_at(state))
    stage = problem.objective.stage(state, standing, traversability, target_m)
    terminal = problem.objective.terminal(state, traversability, target_m)
    unit = (steps * stage + terminal).abs()
    # The error is the angle from the final heading to the direction of the waypoint, as
    # seen from the current position. It is not wrapped. Otherwise an additional full
    # turn would have no cost.
    turned = states[..., 2] - begin[..., 2]
    heading_error = (turn_toward(begin, target) - turned).abs()
    weight = config.heading_weight * unit
    terminal = problem.terminal_cost(states, target)
    final_cost = terminal + weight[:, None] * heading_error
    return cost + final_cost * under_way
