"""Whether a metric keeps its contract, tried before a run on episodes that a robot
drives without a planner.
"""

import math
from typing import get_args

import numpy as np
import torch

from benchnav.core.quantity import Better
from benchnav.metrics.base import Episode, Learnt, Metric
from benchnav.planning.robots import Robot

_STEPS = 12


def attribute_faults(metric: Metric) -> list[str]:
    """Return what of a metric's attributes is invalid, a sentence each.

    Args:
        metric: any metric.
    """
    faults = []

    def expect(holds: bool, name: str, what: str) -> None:
        if not holds:
            faults.append(
                f"Expected `{name}` {what}, got {getattr(metric, name, None)!r}."
            )

    for name in ("name", "column", "meaning"):
        value = getattr(metric, name, None)
        expect(
            isinstance(value, str) and bool(value.strip()) and value.isprintable(),
            name,
            "as text on one line",
        )
    for name in ("suffix", "words", "unit", "heading"):
        value = getattr(metric, name)
        expect(
            isinstance(value, str) and (value.isprintable()),
            name,
            "as text on one line, or empty",
        )
    if faults:
        return faults
    expect(metric.column.isidentifier(), "column", "of letters, digits and _")
    expect(
        metric.column.endswith(metric.suffix),
        "suffix",
        f"as the end of column {metric.column!r}",
    )
    expect(metric.better in get_args(Better), "better", "as higher, lower or neither")
    expect(0 < metric.scale < math.inf, "scale", "above 0 and finite")
    expect(
        isinstance(metric.min_steps, int) and metric.min_steps >= 0, "min_steps", "≥ 0"
    )
    return faults


def sample_episodes(robot: Robot) -> list[Episode]:
    """Drives a robot without a planner: a success, a failure that stood, and a failure
    of one step.

    Args:
        robot: F.

    Returns:
        Episodes of at least one step; in the first the robot also learnt.
    """
    wave = 0.5 + 0.4 * np.sin(np.arange(_STEPS))
    learnt = Learnt(
        revisions=1,
        seen_cells=40,
        sensed_cells=7,
        ahead=np.full((_STEPS, 2), np.nan),
        step_s=0.001,
    )
    return [
        _drive(robot, wave, "success", learnt),
        _drive(robot, np.zeros(_STEPS), "immobilised", None),
        _drive(robot, wave[:1], "timeout", None),
    ]


def _drive(
    robot: Robot, traversability: np.ndarray, outcome: str, learnt: Learnt | None
) -> Episode:
    steps = len(traversability)
    low, high = torch.tensor(robot.action_low), torch.tensor(robot.action_high)
    actions = low + (high - low) * torch.linspace(0.9, 0.4, steps)[:, None]
    states = [robot.initial_state(torch.tensor([[2.0, 3.0, 0.1]]))]
    free = []
    for action, value in zip(
        actions, torch.tensor(traversability, dtype=actions.dtype), strict=True
    ):
        free.append(robot(states[-1], action[None], torch.ones(1)) - states[-1])
        states.append(robot(states[-1], action[None], value[None]))
    moved = torch.cat(free).double().numpy() / robot.dt_s
    track = torch.cat(states).double().numpy()
    return Episode(
        states=track,
        actions=actions.double().numpy(),
        action_names=robot.action_names,
        speed_mps=np.hypot(moved[:, 0], moved[:, 1]),
        turn_rate_radps=moved[:, 2].copy(),
        traversability=traversability.copy(),
        outcome=outcome,
        dt_s=robot.dt_s,
        time_budget_s=100.0,
        reference_time_s=20.0,
        goal_m=track[-1, :2].copy(),
        goal_radius_m=1.0,
        stuck_traversability=0.3,
        robot=robot,
        planning_s=np.full(steps, 0.002),
        preparing_s=0.01,
        learnt=learnt,
    )
