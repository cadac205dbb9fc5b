"""The dynamic window approach (DWA): the best constant (v, ω) within reach of the accelerations.

Source: Fox, Burgard and Thrun (1997), "The dynamic window approach to collision avoidance"; paper
IV-A1. Trajectories are rolled out through F under λ̂ and judged by J toward a waypoint. Letters in
shapes: B episodes, M velocity pairs, T horizon steps, S state dimensions.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.errors import ConfigError
from benchnav.planning.problem import Problem


@dataclass(frozen=True, kw_only=True)
class DWAConfig:
    """Settings of DWA; the defaults are the paper's.

    Args:
        speeds: linear velocities in the window.
        turn_rates: angular velocities in the window.
        horizon: steps T.
        acceleration: greatest change of linear velocity, m/s².
        turn_acceleration: greatest change of angular velocity, rad/s².
        heading_weight: cost of a radian between the last heading and the waypoint; it lets a robot
            turn on the spot, which changes no distance.
        arrival_m: a trajectory this near to the waypoint has arrived and costs no more, so that a
            near waypoint does not slow the robot.
    """

    speeds: int = 10
    turn_rates: int = 10
    horizon: int = 50
    acceleration: float = 0.5
    turn_acceleration: float = 0.5
    heading_weight: float = 2.0
    arrival_m: float = 0.2

    def __post_init__(self) -> None:
        """Refuses an empty window."""
        for name in ("speeds", "turn_rates", "horizon", "acceleration", "turn_acceleration"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"Expected `{name}` > 0 for DWA, got {getattr(self, name)}.")


def velocity_window(problem: Problem, velocity: Tensor, config: DWAConfig) -> Tensor:
    """Velocity pairs that the robot can reach within one step.

    Args:
        problem: for its action bounds and time step.
        velocity: current (v, ω), shape [B, 2].
        config: settings.

    Returns:
        Pairs (v, ω) within the bounds, shape [B, M, 2].
    """
    low, high = (velocity.new_tensor(b) for b in (problem.dynamics.action_low, problem.dynamics.action_high))
    reach = problem.dt_s * velocity.new_tensor((config.acceleration, config.turn_acceleration))
    least, most = (velocity - reach).clamp(low, high), (velocity + reach).clamp(low, high)

    def spread(axis: int, count: int) -> Tensor:
        share = torch.linspace(0, 1, count, device=velocity.device, dtype=velocity.dtype)
        return least[:, axis, None] + (most - least)[:, axis, None] * share

    speeds, rates = spread(0, config.speeds), spread(1, config.turn_rates)
    pairs = torch.stack(torch.broadcast_tensors(speeds[:, :, None], rates[:, None, :]), dim=-1)
    return pairs.flatten(1, 2)


def choose_velocity(
    problem: Problem, state: Tensor, velocity: Tensor, waypoint_m: Tensor, config: DWAConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Picks the window's best velocity pair.

    Args:
        problem: B problems.
        state: shape [B, S].
        velocity: current (v, ω), shape [B, 2].
        waypoint_m: (x, y) to head for, shape [B, 2].
        config: settings.

    Returns:
        The best pair, shape [B, 2]; positions of all trajectories, shape [B, M, T + 1, 2]; index of
        the best, shape [B].
    """
    window = velocity_window(problem, velocity, config)
    target = waypoint_m[:, None]
    states = state[:, None].expand(-1, window.shape[1], -1)
    positions = [states[..., :2]]
    cost = torch.zeros_like(window[..., 0])
    under_way = torch.ones_like(cost, dtype=torch.bool)
    for _ in range(config.horizon):
        traversability = problem.traversability_at(states)
        cost = cost + problem.objective.stage(states, window, traversability, target) * under_way
        states = problem.dynamics(states, window, traversability)
        positions.append(states[..., :2])
        offset = states[..., :2] - target
        under_way = under_way & ((offset * offset).sum(-1) > config.arrival_m**2)
    last = problem.objective.terminal(states, problem.traversability_at(states), target)
    cost = cost + (last + config.heading_weight * _turn_left(state, states, target)) * under_way
    best = cost.argmin(dim=1)
    chosen = window.gather(1, best[:, None, None].expand(-1, 1, 2))[:, 0]
    return chosen, torch.stack(positions, dim=2), best


def _turn_left(state: Tensor, last: Tensor, target: Tensor) -> Tensor:
    """Angle by which the last heading misses the waypoint, shape [B, M].

    It is not wrapped: a turn past the waypoint counts as such, else a robot that spins would find
    another round as good as stopping.
    """
    offset = target - state[:, None, :2]
    missing = torch.atan2(offset[..., 1], offset[..., 0]) - state[:, None, 2]
    missing = torch.remainder(missing + math.pi, 2 * math.pi) - math.pi
    return (missing - (last[..., 2] - state[:, None, 2])).abs()
