"""Simulation of episodes in which two independent λ fields move the robot.

It uses no part of the simulation of `benchnav`. Letters in shapes: B episodes, M pairs
of fields, N cells of a padded map.
"""

from typing import Any

import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.planning import MPPI, MPPIConfig, Problem, Step, distance
from benchnav.planning.free_space import PENALTY
from benchnav.planning.planners.compilation import Fused
from benchnav.planning.planners.cost_risk import pad_fields
from benchnav.planning.planners.mppi import MPPIState
from benchnav.planning.planners.mppi_rollouts import BATCHED_ARGUMENTS
from benchnav.planning.planners.noise_bank import Sampled, perturb
from benchnav.planning.problem import Dynamics, motion_traversability
from benchnav.planning.robots import component_wise
from studies.validation.task import GOAL_M, GOAL_RADIUS_M, STEPS, Setup

# λ off the map if `off_map` is `still`: it is above 0, so the cell is free, and a rollout
# there moves at the `min_traversability` of the setup.
_STILL = 1e-30


class ManyTrialsMPPI(MPPI):
    """MPPI that is compiled even with few samples.

    Compiling pays off, since hundreds of episodes have the same shape.

    Args:
        config: settings of MPPI.
        setup: setup whose `motions` and `off_map` set the fields of rollouts.
    """

    worth_compiling = 0

    def __init__(self, config: MPPIConfig, setup: Setup) -> None:
        super().__init__(config)
        self._is_paired = setup.motions == "two" and config.risk_on == "cost"
        self._is_still = setup.off_map == "still"
        if self._is_paired:
            self._advance = Fused(
                advance_pair,
                config.samples * config.fields,
                self.worth_compiling,
                batched=BATCHED_ARGUMENTS,
            )

    def _padded_ground(self, plan_state: MPPIState, state: Tensor) -> Tensor:
        """Return the padded λ fields of this step's rollouts.

        The shape is [B·M, N], or [B·M, 2·N] with pairs of fields.
        """
        if self._is_paired:
            problem = plan_state.problem
            key = rng.stream_key(plan_state.key, plan_state.step)
            fields = pad_fields(
                problem, problem.sample_fields(2 * self.config.fields, key)
            )
            ground = fields.unflatten(0, (-1, 2)).flatten(1)
        else:
            ground = super()._padded_ground(plan_state, state)
        return torch.where(ground == 0, _STILL, ground) if self._is_still else ground


def advance_pair(
    states: Tensor,
    cost: Tensor,
    sampled: Sampled,
    padded_ground: Tensor,
    target: Tensor,
    dynamics: Dynamics,
) -> tuple[Tensor, Tensor]:
    """Roll out samples as `mppi_rollouts.advance_chunk` does, with a field for v and ω.

    The motion of `ROVER` and the cost of `TimeAndDistance` are written out for separate
    x, y and θ. With `robot` and `objective`, which take stacked states, a step takes
    three times as long.

    Args:
        states: see `advance_chunk`.
        cost: see `advance_chunk`.
        sampled: see `advance_chunk`.
        padded_ground: λ of linear motion followed by λ of angular motion, shape
            [B·M, 2·N].
        target: see `advance_chunk`.
        dynamics: see `advance_chunk`.
    """
    mean, noise, low, high = sampled
    grid, robot, _, min_traversability = dynamics
    objective: Any = dynamics.objective  # a `TimeAndDistance`
    x, y, heading = states.unbind(-1)
    goal_distance = distance(states, target)
    fields, angular = padded_ground.flatten(), padded_ground.shape[1] // 2
    first = torch.arange(len(padded_ground), dtype=torch.int32, device=states.device)[
        :, None
    ] * (2 * angular)
    for step in range(mean.shape[1]):
        speed, turn_rate = perturb(
            mean[:, step, :, None], noise[step], low, high
        ).unbind(1)
        row, column = (
            (position / grid.resolution_m + 1).clamp(0, size + 1).int()
            for position, size in ((y, grid.height), (x, grid.width))
        )
        cell = first + row * (grid.width + 2) + column
        ground = fields[cell]
        going = goal_distance > GOAL_RADIUS_M
        cost = (
            cost
            + torch.where(going, robot.dt_s + goal_distance**objective.power, 0)
            + PENALTY * (ground <= 0)
        )
        advance, turn = (
            going
            * robot.dt_s
            * motion_traversability(traversability, min_traversability)
            for traversability in (ground, fields[cell + angular])
        )
        x = x + advance * speed * torch.cos(heading)
        y = y + advance * speed * torch.sin(heading)
        heading = heading + turn * turn_rate
        goal_distance = torch.sqrt(
            (x - target[..., 0]) ** 2 + (y - target[..., 1]) ** 2
        )
    return component_wise(torch.stack((x, y, heading), dim=-1)), cost


def drive(
    planner: MPPI, problem: Problem, traction: Tensor, generator: torch.Generator
) -> Tensor:
    """Run B episodes until the robots reach the goal or the time limit.

    Args:
        planner: planner, called once per step; planning takes no simulated time.
        problem: planning problem with the prediction.
        traction: true linear and angular λ, shape [B, 2, H, W].
        generator: source of the planner's noise, the same for all B.

    Returns:
        Time to the goal in seconds, infinite if it was not reached, shape [B].
    """
    arrival_s = torch.full((len(problem),), torch.inf)
    state, observed = problem.start, torch.full((len(problem),), torch.nan)
    plan_state = planner.init(problem, generator)
    for step in range(STEPS):
        action, plan_state, _ = planner.plan(
            Step(state=state, traversability=observed, time_s=step * problem.dt_s),
            plan_state,
        )
        observed = traction_at(state, traction)[:, 0]
        running = arrival_s.isinf()
        state = torch.where(
            running[:, None], move(state, action, traction, problem.dt_s), state
        )
        arrival_s[running & has_arrived(state)] = (step + 1) * problem.dt_s
        if not arrival_s.isinf().any():
            break
    return arrival_s


def move(state: Tensor, action: Tensor, traction: Tensor, dt_s: float) -> Tensor:
    """Move robots by one step.

    Args:
        state: (x, y, θ), shape [B, 3].
        action: (v, ω), shape [B, 2].
        traction: linear and angular λ, shape [B, 2, H, W].
        dt_s: time step in seconds.

    Returns:
        The next states, shape [B, 3].
    """
    linear, angular = traction_at(state, traction).unbind(1)
    heading, advance = state[:, 2], dt_s * linear * action[:, 0]
    return torch.stack(
        (
            state[:, 0] + advance * torch.cos(heading),
            state[:, 1] + advance * torch.sin(heading),
            heading + dt_s * angular * action[:, 1],
        ),
        dim=1,
    )


def traction_at(state: Tensor, traction: Tensor) -> Tensor:
    """Return linear and angular λ in the robots' cells of 1 m, 0 off the map, [B, 2]."""
    height, width = traction.shape[2:]
    column, row = state[:, 0].floor().long(), state[:, 1].floor().long()
    on_map = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    cell_traction = traction[
        torch.arange(len(state)),
        :,
        row.clamp(0, height - 1),
        column.clamp(0, width - 1),
    ]
    return torch.where(on_map[:, None], cell_traction, 0.0)


def has_arrived(state: Tensor) -> Tensor:
    """Return which robots are within the goal's radius, bool, shape [B]."""
    return (
        torch.hypot(state[:, 0] - GOAL_M[0], state[:, 1] - GOAL_M[1]) <= GOAL_RADIUS_M
    )
