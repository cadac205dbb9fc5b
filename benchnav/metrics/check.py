"""Validation of a metric before a run: check of its attributes, and sample episodes."""

import math
from typing import get_args

import numpy as np
import torch

from benchnav.core.quantity import Better
from benchnav.metrics.base import Episode, LearningRecord, Metric
from benchnav.planning.robots import Robot

_STEPS = 12


def attribute_faults(metric: Metric) -> list[str]:
    """Return one message for each invalid attribute of a metric."""
    faults = []

    def expect(is_valid: bool, name: str, expectation: str) -> None:
        if not is_valid:
            value = getattr(metric, name, None)
            faults.append(f"Expected `{name}` {expectation}, got {value!r}.")

    for name in ("name", "column", "meaning"):
        value = getattr(metric, name, None)
        is_line = isinstance(value, str) and value.isprintable()
        is_empty = isinstance(value, str) and not value.strip()
        expect(is_line and not is_empty, name, "as text on one line")
    for name in ("suffix", "words", "unit", "heading"):
        value = getattr(metric, name)
        is_line = isinstance(value, str) and value.isprintable()
        expect(is_line, name, "as text on one line, or empty")
    if faults:
        return faults
    expect(metric.column.isidentifier(), "column", "of letters, digits and _")
    expect(
        metric.column.endswith(metric.suffix),
        "suffix",
        f"as the end of column {metric.column!r}",
    )
    is_direction = metric.better in get_args(Better)
    expect(is_direction, "better", "as 'higher', 'lower' or 'neither'")
    expect(0 < metric.scale < math.inf, "scale", "above 0 and finite")
    is_count = isinstance(metric.min_steps, int) and metric.min_steps >= 0
    expect(is_count, "min_steps", "as a whole number ≥ 0")
    return faults


def sample_episodes(robot: Robot) -> list[Episode]:
    """Simulate sample episodes of a robot without a planner.

    Args:
        robot: transition function F.

    Returns:
        A success of a robot that learns, a failure without motion, and a failure after
        one step.
    """
    traversability = 0.5 + 0.4 * np.sin(np.arange(_STEPS))
    learning = LearningRecord(
        revisions=1,
        seen_cells=40,
        sensed_cells=7,
        ahead=np.full((_STEPS, 2), np.nan),
        step_s=0.001,
    )
    return [
        _simulate(robot, traversability, "success", learning),
        _simulate(robot, np.zeros(_STEPS), "immobilised", None),
        _simulate(robot, traversability[:1], "timeout", None),
    ]


def _simulate(
    robot: Robot,
    traversability: np.ndarray,
    outcome: str,
    learning: LearningRecord | None,
) -> Episode:
    steps = len(traversability)
    low = torch.tensor(robot.action_low)
    high = torch.tensor(robot.action_high)
    actions = low + (high - low) * torch.linspace(0.9, 0.4, steps)[:, None]
    fractions = torch.tensor(traversability, dtype=actions.dtype)
    states = [robot.initial_state(torch.tensor([[2.0, 3.0, 0.1]]))]
    commanded = []  # change of the state in each step on terrain with λ = 1
    for action, fraction in zip(actions, fractions, strict=True):
        state = states[-1]
        commanded.append(robot(state, action[None], torch.ones(1)) - state)
        states.append(robot(state, action[None], fraction[None]))
    velocity = torch.cat(commanded).double().numpy() / robot.dt_s
    track = torch.cat(states).double().numpy()
    return Episode(
        states=track,
        actions=actions.double().numpy(),
        action_names=robot.action_names,
        speed_mps=np.hypot(velocity[:, 0], velocity[:, 1]),
        turn_rate_radps=velocity[:, 2].copy(),
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
        learning=learning,
    )
