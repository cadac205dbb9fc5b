"""Interfaces of planners and local planners, and the plans that they return.

A planner is stateless: `init` creates a plan state, and `plan` receives a plan state
and returns the next plan state. Both are pure functions of their arguments and the
planner's settings. Letters in shapes: B episodes, N points, M samples, E edges, T time
steps, K action sequences, S state and A action dimensions.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from benchnav.core.errors import ConfigError, expect
from benchnav.core.short_repr import short_repr
from benchnav.core.specified import Specified
from benchnav.planning.problem import Problem, Task
from benchnav.planning.robots import STEERING, Robot
from benchnav.planning.sensing.sensor import Step

# Layers of a `Plan`, with the dimensions between the first, B, and the last, (x, y).
LAYERS = {"path": "N", "samples": "MN", "reference": "N", "tree": "EN"}

# Remedies in the message for a robot that a planner cannot steer.
_ANY_ACTIONS_REMEDY = "Use a planner that samples actions, such as mppi."
_STEERING_REMEDY = (
    "The planner commands a turn rate, but this robot is steered by an angle, and "
    "turns only while it drives. Use mppi, astar_mppi or straight."
)

# Fields of a `Problem` that depend on a prediction. Free space is derived from
# `risk_map` or `distribution`, as the rules of the task define.
INPUTS = frozenset({"risk_map", "distribution", "fields"})


class PlanStatus(IntEnum):
    """Result of planning for an episode."""

    OK = 0
    # No path to the goal has been found yet; the action follows the best partial path.
    PARTIAL = 1
    FAILED = 2  # The planner gives up; the episode ends as a planner failure.


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Status of planning, and layers of positions that figures and playback show.

    Unused points are NaN. Layers that a planner does not return have size 0.

    Args:
        status: `PlanStatus` of each episode, int64, shape [B].
        path: predicted positions, shape [B, N, 2].
        samples: positions of sampled trajectories, shape [B, M, N, 2].
        reference: reference path, shape [B, N, 2].
        tree: edges of a search tree as polylines, shape [B, E, N, 2].
    """

    __repr__ = short_repr

    status: Tensor
    path: Tensor
    samples: Tensor
    reference: Tensor
    tree: Tensor

    @classmethod
    def empty(
        cls, batch: int, device: torch.device | str = "cpu", **layers: Tensor
    ) -> "Plan":
        """Return a plan with status OK; layers that are not given are empty."""
        values = {"status": torch.zeros(batch, dtype=torch.int64, device=device)}
        for name, inner in LAYERS.items():
            no_points = [0] * len(inner)
            values[name] = torch.empty(batch, *no_points, 2, device=device)
        return cls(**{**values, **layers})

    def lines(self, member: int) -> dict[str, Tensor]:
        """Return the layers of the episode at an index as polylines, [lines, N, 2]."""
        lines = {}
        for name in LAYERS:
            layer = getattr(self, name)[member]
            lines[name] = layer if layer.dim() == 3 else layer[None]
        return lines


State = TypeVar("State")


class Planner(Specified, ABC, Generic[State]):
    """Base class of planners; `benchnav.testing.check_planner` checks the contract.

    `init` and `plan` are required; the other methods and attributes have defaults. A
    planner stores only its settings. All that changes from step to step is in the plan
    state, so that one planner can plan for any batch in any order.
    """

    steers: tuple[tuple[str, ...], ...] | None = None
    """Action names of the robots that the planner can steer; None for any names."""

    robots: tuple[type[Robot], ...] | None = None
    """Classes of the robots that the planner can steer; None for any class."""

    blind: bool = False
    """Whether the planner uses no prediction; a class attribute.

    Its results are then the same under all models and risk settings. See `uses`.
    """

    plans_once: bool = False
    """Whether the planner plans only once; it then rejects beliefs that learn."""

    given_truth: bool = False
    """Whether the planner requires the true λ, from the model `clairvoyant`."""

    @property
    def compiled(self) -> bool | None:
        """Whether the planner runs compiled.

        None before the first plan, and for a planner without compiled functions.
        """
        return None

    @abstractmethod
    def init(self, problem: Problem, generator: torch.Generator) -> State:
        """Return the first plan state.

        Args:
            problem: B problems, with predictions.
            generator: random generator on the CPU, for use in this call only.
        """

    @abstractmethod
    def plan(self, step: Step, plan_state: State) -> tuple[Tensor, State, Plan]:
        """Return the next action of every episode.

        Args:
            step: robot states, and the λ that the robots observed.
            plan_state: plan state from `init` or the last call; not modified.

        Returns:
            Actions within the robot's bounds, shape [B, A]; the next plan state; and
            the plan.
        """

    def select(self, plan_state: State, members: Tensor) -> State:
        """Return the plan state of some episodes, so that ended episodes take no time.

        Args:
            plan_state: plan state of all episodes; not modified.
            members: indices of the episodes to keep, int64, shape [M].

        Returns:
            The plan state of these episodes. The default, `NotImplemented`, means that
            ended episodes must stay in the batch.
        """
        return NotImplemented

    def revise(self, plan_state: State, problem: Problem) -> State:
        """Return a plan state for an updated prediction.

        Args:
            plan_state: plan state from the last call; not modified.
            problem: problems of the same episodes, whose start is the robots' current
                state; only the prediction, λ̂ and the free mask may also differ.

        Returns:
            A plan state for the new problems. The default, `NotImplemented`, means that
            the planner starts again with `init`.
        """
        return NotImplemented

    def uses(self, task: Task) -> frozenset[str]:
        """Return the names of the predicted inputs that affect the planner's actions.

        Conditions that differ only in unused inputs are run only once.

        Args:
            task: the task; its rules define the input of free space, see
                `FreeSpace.source`.

        Returns:
            A subset of `INPUTS`; by default all of them, or the empty set for a blind
            planner.
        """
        return frozenset() if self.blind else INPUTS

    def follows(self, task: Task) -> str:
        """Return the cost that the planner minimises instead of J; empty for J.

        The text is one line for tables.
        """
        return ""

    def remarks(self, task: Task) -> tuple[str, ...]:
        """Return notes for tables, one line each, such as the planner's own limits."""
        return ()


class LocalPlanner(Planner[State]):
    """Base class of local planners: planners that receive a target at each step.

    The plan state is a `Batch` with a field `problem`. Without a global planner, the
    target is the goal.
    """

    name: str
    """Name in tables."""

    @property
    def seeks_goal(self) -> bool:
        """Whether the planner minimises a cost to the goal, whatever the target is."""
        return False

    def plan(self, step: Step, plan_state: Any) -> tuple[Tensor, State, Plan]:
        """Return actions toward the goal; see `Planner`."""
        return self.plan_toward(step, plan_state, plan_state.problem.goal_m)

    @abstractmethod
    def plan_toward(
        self, step: Step, plan_state: State, target_m: Tensor
    ) -> tuple[Tensor, State, Plan]:
        """Return actions toward targets (x, y), shape [B, 2]; see `Planner.plan`."""

    def commit_action(self, plan_state: State, action: Tensor) -> State:
        """Return the plan state after the execution of actions, shape [B, A].

        They may differ from the actions that `plan_toward` returned.
        """
        return plan_state

    def select(self, plan_state: Any, members: Tensor) -> State:
        """Return the plan state of some episodes; see `Planner`."""
        return plan_state.select(members)

    def revise(self, plan_state: Any, problem: Problem) -> State:
        """Return the plan state with the new problem; see `Planner`."""
        return replace(plan_state, problem=problem)


def check_finite(
    owner: str,
    settings: Any,
    above_zero: tuple[str, ...],
    at_least_zero: tuple[str, ...] = (),
) -> None:
    """Check that settings are finite and above 0, or at least 0; None is always valid.

    Args:
        owner: name of the planner or controller, for the message.
        settings: dataclass of settings.
        above_zero: names of fields that must be above 0.
        at_least_zero: names of fields that must be at least 0.

    Raises:
        ConfigError: If a setting is out of its range.
    """
    for name in (*above_zero, *at_least_zero):
        value = getattr(settings, name)
        if value is None:
            continue
        may_be_zero = name in at_least_zero
        fits = 0 <= value < math.inf and (value != 0 or may_be_zero)
        sign = "≥" if may_be_zero else ">"
        expect(fits, f"`{name}` {sign} 0 and finite for {owner}, got {value}.")


def check_steers(planner: Planner[Any], robot: Robot, name: str) -> None:
    """Check that a planner can steer a robot.

    Args:
        planner: any planner.
        robot: any robot.
        name: name of the planner, for the message.

    Raises:
        ConfigError: If the planner cannot steer robots of this class, or with these
            actions.
    """
    robot_name = type(robot).__name__
    if planner.robots is not None and type(robot) not in planner.robots:
        class_list = [robot_class.__name__ for robot_class in planner.robots]
        class_names = " or ".join(class_list)
        raise ConfigError(
            f"Expected robot {class_names} for planner {name!r}, got {robot_name}."
        )
    names = tuple(robot.action_names)
    steered_names = (names,) if planner.steers is None else planner.steers
    options = " or ".join(f"({', '.join(option)})" for option in steered_names)
    can_steer_angle = any(STEERING in option for option in steered_names)
    needs_angle = STEERING in names and not can_steer_angle
    remedy = _STEERING_REMEDY if needs_angle else _ANY_ACTIONS_REMEDY
    expect(
        names in steered_names,
        f"a robot with actions {options} for planner {name!r}, got "
        f"{robot_name} with ({', '.join(names)}). {remedy}",
    )


def rollout_path(problem: Problem, state: Tensor, actions: Tensor) -> Tensor:
    """Return positions along action sequences, including the initial positions.

    Args:
        problem: B problems.
        state: initial states, shape [B, S].
        actions: action sequences, shape [B, T, A, K].

    Returns:
        Positions (x, y), shape [B, K, T + 1, 2].
    """
    states = state[:, None].expand(-1, actions.shape[-1], -1)
    positions = [states[..., :2]]
    for action in actions.movedim(-1, 2).unbind(1):
        traversability = problem.traversability_at(states)
        states = problem.robot(states, action, traversability)
        positions.append(states[..., :2])
    return torch.stack(positions, dim=2)
