"""Metrics of episodes: what is computed of one finished episode, and what tables, tests
and reports say of it.

Letters in shapes: N steps, S state and A action dimensions. A state begins with (x, y,
θ) in metres and radians.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from numbers import Real

import numpy as np

from benchnav.core.errors import BenchnavError, out_of_memory
from benchnav.core.quantity import Better, Quantity
from benchnav.core.settings import fault
from benchnav.core.specified import Specified
from benchnav.planning.robots import Robot


@dataclass(frozen=True, kw_only=True, eq=False)
class Learnt:
    """What a robot learnt during an episode.

    Args:
        revisions: how often its planner was given another map.
        seen_cells: cells whose appearance it saw.
        sensed_cells: cells whose λ it sensed.
        ahead: RMSE of the believed E[λ], and mean log score of the belief, over the
            cells ahead of the robot; NaN at steps without an update, shape [N, 2].
        step_s: wall time of sensing and belief for one step, in seconds; NaN if no step
            was planned.
    """

    revisions: int
    seen_cells: int
    sensed_cells: int
    ahead: np.ndarray
    step_s: float


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Episode:
    """A finished episode: all that a metric may look at. Arrays are float64 and cannot
    be written to.

    Args:
        states: of the robot, the first at the start and the last where it ended, shape
            [N + 1, S].
        actions: commanded in each step, shape [N, A].
        action_names: what each of the A actions is, such as `speed_mps`.
        speed_mps: speed that each action would have given on ground of λ = 1, shape
            [N].
        turn_rate_radps: turn rate, likewise, shape [N].
        traversability: observed λ of each step, in [0, 1], shape [N].
        outcome: how it ended, such as `success` or `immobilised`.
        dt_s: time step in seconds.
        time_budget_s: time budget T in seconds.
        reference_time_s: least travel time over the grid at 1 m/s, in seconds; NaN if
            there is none.
        goal_m: position of the goal (x, y) in metres, shape [2].
        goal_radius_m: a robot this near to the goal has reached it.
        stuck_traversability: λ_stuck, at or under which a step counts as stuck.
        robot: F.
        planning_s: wall time of planning of each step, a batch's over its episodes,
            shape [N].
        preparing_s: wall time of what the planner prepared, likewise, in seconds.
        learnt: what the robot learnt; None if it learnt nothing.
        rejected_draws: draws of λ without a feasible path, before the one that was met.
        lower_bound_s: time to the goal that no trajectory undercuts, infinite if none
            reaches it; NaN if unknown.
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
    learnt: Learnt | None = None
    rejected_draws: int = 0
    lower_bound_s: float = math.nan

    def __post_init__(self) -> None:
        """Makes the arrays read-only, so that no metric changes what the next one is
        given.
        """
        for own in fields(self):
            value = getattr(self, own.name)
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    def __repr__(self) -> str:
        """One line: how it ended, and when."""
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
        """When it ended, in seconds."""
        return self.steps * self.dt_s

    @property
    def positions_m(self) -> np.ndarray:
        """Positions (x, y) in metres, shape [N + 1, 2]."""
        return self.states[:, :2]

    @property
    def reference_at_top_speed_s(self) -> float:
        """Reference time at the robot's top speed, in seconds; NaN if there is none."""
        return self.reference_time_s / self.robot.top_speed_mps


class MetricError(BenchnavError):
    """A metric failed, or returned what is no number."""


class Metric(Specified, ABC):
    """A number for each episode: one column of the episodes' table, and what is said of
    it.

    What is listed below is a class attribute, or a property of an object with options.
    Whatever else a metric needs are keyword parameters of its constructor, its options.

    Attributes:
        name: word by which suites and commands name it.
        column: its column in tables of episodes. A wall time begins with `planning_` or
            `learning_`, so that repeated runs are not compared by it.
        suffix: the unit that ends the column's name, such as `_s`.
        words: what sentences call it; if empty, its name with spaces.
        unit: unit of differences, margins and tables.
        scale: that unit over the column's.
        heading: of its column in the report; if empty, its words and unit.
        meaning: what one value is, a phrase.
        better: `higher`, `lower` or `neither`.
        of_arrivals: conditions are compared only over the episodes in which both
            reached the goal.
        min_steps: steps that an episode must have; of a shorter one the value is NaN.
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
        """Computes the value of one episode, in the column's unit.

        Args:
            episode: a finished episode with at least `min_steps` steps.

        Returns:
            A finite number, or NaN if the value is undefined for this episode.
        """

    def value(self, episode: Episode) -> float:
        """Returns what `compute` returns, or NaN for an episode with fewer than
        `min_steps` steps.
        """
        return self.compute(episode) if episode.steps >= self.min_steps else math.nan

    @property
    def quantity(self) -> Quantity:
        """What tables, tests and figures say of the values."""
        words = self.words or str(self.name).replace("_", " ")
        unit = f" [{self.unit}]" if self.unit else ""
        known = {own.name: getattr(self, own.name) for own in fields(Quantity)}
        return Quantity(
            **known | {"words": words, "heading": self.heading or f"{words}{unit}"}
        )


class Recorded(Metric):
    """A number that the episode holds under the name of the column."""

    min_steps = 0

    def compute(self, episode: Episode) -> float:
        """Return the number."""
        value: float = getattr(episode, self.column)
        return value


def measure(metric: Metric, episode: Episode) -> float:
    """Computes a metric that may be a user's.

    Args:
        metric: any metric.
        episode: what it is computed of.

    Returns:
        A finite number or NaN.

    Raises:
        MetricError: If the metric raises, or returns anything else.
    """
    try:
        value = (
            metric.compute(episode) if episode.steps >= metric.min_steps else math.nan
        )
    except Exception as error:
        raise out_of_memory(error) or _no_number(metric, fault(error)) from error
    if not isinstance(value, Real | np.bool_) or math.isinf(value):
        raise _no_number(metric, repr(value))
    return float(value)


def _no_number(metric: Metric, got: str) -> MetricError:
    return MetricError(
        f"Expected a finite number or NaN from metric {metric.name!r}, got {got}. "
        "Return NaN for an episode that "
        "has no such value."
    )
