"""Finished episodes, and the base class of their metrics.

Letters in shapes: N steps, S state and A action dimensions. A state begins with
(x, y, θ) in metres and radians.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from numbers import Real

import numpy as np

from benchnav.core.errors import BenchnavError, out_of_memory_error
from benchnav.core.quantity import Better, Quantity
from benchnav.core.settings import fault
from benchnav.core.specified import Specified
from benchnav.planning.robots import Robot


@dataclass(frozen=True, kw_only=True, eq=False)
class LearningRecord:
    """Record of a robot's learning during an episode.

    Args:
        revisions: number of times that the planner received an updated map.
        seen_cells: number of cells whose appearance was observed.
        sensed_cells: number of cells whose λ was measured.
        ahead: RMSE of the posterior mean E[λ] and mean log score of the belief at each
            step, over the cells ahead of the robot, shape [N, 2]; NaN at steps without
            an update.
        step_s: mean wall time per step of sensing and belief update, in seconds; NaN if
            no step was planned.
    """

    revisions: int
    seen_cells: int
    sensed_cells: int
    ahead: np.ndarray
    step_s: float


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Episode:
    """A finished episode: the input of a metric. Arrays are float64 and read-only.

    Args:
        states: states of the robot from the start to the end, shape [N + 1, S].
        actions: commanded action of each step, shape [N, A].
        action_names: names of the A action dimensions, such as `speed_mps`.
        speed_mps: speed that each action would give on terrain with λ = 1, in m/s,
            shape [N].
        turn_rate_radps: turn rate that each action would give on terrain with λ = 1, in
            rad/s, shape [N].
        traversability: observed λ of each step, in [0, 1], shape [N].
        outcome: name of the outcome, such as `success` or `immobilised`.
        dt_s: time step in seconds.
        time_budget_s: time budget T in seconds.
        reference_time_s: minimum travel time over the grid at 1 m/s, in seconds; NaN if
            the dataset does not contain it.
        goal_m: position of the goal (x, y) in metres, shape [2].
        goal_radius_m: distance in metres within which a robot has reached the goal.
        stuck_traversability: λ_stuck; a step with λ ≤ λ_stuck counts as stuck.
        robot: transition function F.
        planning_s: wall time of planning in each step, in seconds: the time of a batch
            divided by its number of episodes, shape [N].
        preparing_s: wall time of the planner's preparation, in seconds: the time of a
            batch divided by its number of episodes.
        learning: record of learning; None if the robot does not learn.
        rejected_draws: number of λ fields that were rejected before the λ field of this
            episode was drawn, because they had no feasible path.
        lower_bound_s: lower bound of the time to the goal, in seconds; infinite if the
            goal is unreachable, NaN if unknown.
    """

    states: np.ndarray
    actions: np.ndarray
    action_names: tuple[str, ...]
    speed_mps: np.ndarray
    turn_rate_radps: np.ndarray
    traversability: np.ndarray
    outcome: str
    dt_s: float
    time_budget_s: float
    reference_time_s: float
    goal_m: np.ndarray
    goal_radius_m: float
    stuck_traversability: float
    robot: Robot
    planning_s: np.ndarray
    preparing_s: float
    learning: LearningRecord | None = None
    rejected_draws: int = 0
    lower_bound_s: float = math.nan

    def __post_init__(self) -> None:
        """Make the arrays read-only, so that no metric changes another metric's input."""
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    def __repr__(self) -> str:
        """Return one line with the outcome and the end time."""
        robot = type(self.robot).__name__
        return (
            f"Episode(outcome={self.outcome!r}, steps={self.steps}, "
            f"end_time_s={self.end_time_s:g}, robot={robot})"
        )

    @property
    def steps(self) -> int:
        """Number of steps N."""
        return len(self.traversability)

    @property
    def success(self) -> bool:
        """Whether the robot reached the goal."""
        return self.outcome == "success"

    @property
    def end_time_s(self) -> float:
        """Duration of the episode in seconds."""
        return self.steps * self.dt_s

    @property
    def positions_m(self) -> np.ndarray:
        """Positions (x, y) in metres, shape [N + 1, 2]."""
        return self.states[:, :2]

    @property
    def reference_at_top_speed_s(self) -> float:
        """Reference time at the robot's top speed, in seconds; NaN if it is missing."""
        return self.reference_time_s / self.robot.top_speed_mps


class MetricError(BenchnavError):
    """A metric raised an exception, or returned an invalid value."""


class Metric(Specified, ABC):
    """A number for each episode: one column of the table of episodes.

    The attributes below are class attributes, or properties if they depend on options.
    Options are keyword parameters of the constructor.

    Attributes:
        name: identifier in suites and commands.
        column: column in tables of episodes. Columns of wall times must begin with
            `planning_` or `learning_`; comparisons of repeated runs ignore these
            columns.
        suffix: unit at the end of the column's name, such as `_s`; may be empty.
        words: name in sentences; if empty, `name` with spaces instead of underscores.
        unit: unit of differences, margins and tables; may be empty.
        scale: factor from the column's unit to `unit`.
        heading: heading of the metric's column in the report; if empty, `words` and
            `unit`.
        meaning: phrase that defines one value, without a full stop.
        better: better direction, `higher`, `lower` or `neither`.
        of_arrivals: whether conditions are compared only over the episodes in which
            both reached the goal.
        min_steps: minimum number of steps, ≥ 0; the value of a shorter episode is NaN.
    """

    name: str
    column: str
    suffix: str = ""
    words: str = ""
    unit: str = ""
    scale: float = 1
    heading: str = ""
    meaning: str
    better: Better = "neither"
    of_arrivals: bool = False
    min_steps: int = 1

    @abstractmethod
    def compute(self, episode: Episode) -> float:
        """Compute the value of one episode, in the column's unit.

        Args:
            episode: a finished episode with at least `min_steps` steps.

        Returns:
            A finite number, or NaN if the value is undefined for this episode.
        """

    def value(self, episode: Episode) -> float:
        """Compute the value of one episode; NaN if it has fewer than `min_steps` steps."""
        return self.compute(episode) if episode.steps >= self.min_steps else math.nan

    @property
    def quantity(self) -> Quantity:
        """Column, unit and texts for tables, tests and figures."""
        words = self.words or str(self.name).replace("_", " ")
        unit = f" [{self.unit}]" if self.unit else ""
        values = {field.name: getattr(self, field.name) for field in fields(Quantity)}
        values["words"] = words
        values["heading"] = self.heading or f"{words}{unit}"
        return Quantity(**values)


class Recorded(Metric):
    """A metric whose value is the episode's attribute with the name of the column."""

    min_steps = 0

    def compute(self, episode: Episode) -> float:
        """Return the value of the attribute."""
        value: float = getattr(episode, self.column)
        return value


def measure(metric: Metric, episode: Episode) -> float:
    """Compute a metric, which may be custom, for an episode, and check the value.

    Args:
        metric: metric, shipped or custom.
        episode: finished episode.

    Returns:
        A finite number, or NaN if the episode has fewer than `metric.min_steps` steps
        or the metric returns NaN.

    Raises:
        MetricError: If the metric raises an exception, or returns an invalid value.
    """
    try:
        value = (
            metric.compute(episode) if episode.steps >= metric.min_steps else math.nan
        )
    except Exception as error:
        metric_error = _invalid_value(metric, fault(error))
        raise out_of_memory_error(error) or metric_error from error
    if not isinstance(value, Real | np.bool_) or math.isinf(value):
        raise _invalid_value(metric, repr(value))
    return float(value)


def _invalid_value(metric: Metric, got: str) -> MetricError:
    return MetricError(
        f"Expected a finite number or NaN from metric {metric.name!r}, got {got}. "
        "Return NaN where the value is undefined."
    )
