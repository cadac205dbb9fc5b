"""What a planner is and what it returns.

A planner is stateless: `init` makes a plan state, `plan` takes one and returns the next. Both are
pure: the same arguments give the same result. Letters in shapes: B episodes, N points, M samples, E edges,
S state and A action dimensions.
"""

from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from benchnav.core.errors import ConfigError
from benchnav.planning.problem import Problem, Task
from benchnav.planning.robots import Robot


class PlanStatus(IntEnum):
    """How planning went for an episode."""

    OK = 0
    PARTIAL = 1  # no way to the goal was found yet; the action leads along the best way so far
    FAILED = 2  # the planner gives up; the episode ends as a planner failure


@dataclass(frozen=True, kw_only=True)
class Step:
    """What a planner is told at each step.

    Args:
        state: where the robots are, shape [B, S].
        traversability: the λ that each met in the last step, NaN at first, shape [B].
        time_s: time since the episodes began.
        draw: what is planned will be drawn; a planner may leave the layers of its `Plan` out otherwise.
    """

    state: Tensor
    traversability: Tensor
    time_s: float
    draw: bool = False


@dataclass(frozen=True, kw_only=True)
class Plan:
    """How planning went, and what playback draws.

    Unused points are NaN; a planner leaves at size 0 what it does not have.

    Args:
        status: `PlanStatus` of each episode, int64, shape [B].
        path: predicted positions, shape [B, N, 2].
        samples: positions of sampled trajectories, shape [B, M, N, 2].
        reference: reference path, shape [B, N, 2].
        tree: edges of a search tree as polylines, shape [B, E, N, 2].
    """

    status: Tensor
    path: Tensor
    samples: Tensor
    reference: Tensor
    tree: Tensor

    @classmethod
    def empty(cls, batch: int, device: torch.device | str = "cpu", **known: Tensor) -> "Plan":
        """Makes a plan with status OK and nothing to draw but what is given."""
        blank: dict[str, Tensor] = {
            "status": torch.zeros(batch, dtype=torch.int64, device=device),
            "path": torch.empty(batch, 0, 2, device=device),
            "samples": torch.empty(batch, 0, 0, 2, device=device),
            "reference": torch.empty(batch, 0, 2, device=device),
            "tree": torch.empty(batch, 0, 0, 2, device=device),
        }
        return cls(**{**blank, **known})

    def lines(self, member: int) -> dict[str, Tensor]:
        """What is drawn of one episode, by layer: polylines, shape [lines, N, 2]."""
        layers = {f.name: getattr(self, f.name)[member] for f in fields(self) if f.name != "status"}
        return {name: layer if layer.dim() == 3 else layer[None] for name, layer in layers.items()}


State = TypeVar("State")


class Planner(Protocol[State]):
    """The contract of a planner, which `benchnav.testing.planner.check_planner` tries.

    It may also have these attributes:

    - `steers`: tuples of action names; a robot of other actions is refused before anything runs. Without
      it any robot is accepted.
    - `follows(task)`: a line on what it minimises, for tables, where that is not the task's J alone; empty where it
      is.
    - `blind`: on the class, true where it is blind, so that one run stands for every
      model and risk setting.
    - `remarks(task)`: a tuple of one-line notes that tables show, such as limits that are not the robot's.
    - `compiled`: whether it runs compiled; None before its first plan.
    - `select(plan_state, members)`: the plan state of some of the episodes, int64 [M], which then are planned
      for alone. With it episodes leave the batch when they have ended, and cost no more.
    """

    def init(self, problem: Problem, generator: torch.Generator) -> State:
        """Prepares to plan.

        Args:
            problem: B problems, with what is predicted.
            generator: source of randomness, on the CPU; only drawn from here.

        Returns:
            The first plan state.
        """
        ...

    def plan(self, step: Step, plan_state: State) -> tuple[Tensor, State, Plan]:
        """Chooses the next action of every episode.

        Args:
            step: where the robots are, and the λ that they observed.
            plan_state: from `init` or the previous call; not changed.

        Returns:
            Actions within the bounds, shape [B, A]; the next plan state; what was planned.
        """
        ...


def what_it_follows(planner: Any, task: Task) -> str:
    """What a planner minimises in place of the task's J, in words; empty where it minimises J alone.

    Raises:
        ConfigError: its `follows` is no function, as it was in earlier versions.
    """
    follows = getattr(planner, "follows", None)
    if follows is None:
        return ""
    if not callable(follows):
        raise ConfigError(
            f"Expected `follows` of planner {type(planner).__name__} as a function of the task, got {follows!r}. "
            "Write `def follows(self, task)`."
        )
    return str(follows(task))


def check_steers(planner: Any, robot: Robot, name: str) -> None:
    """Refuses a robot that a planner cannot steer.

    Args:
        planner: any planner.
        robot: any robot.
        name: of the planner, for the message.

    Raises:
        ConfigError: the names of the robot's actions are none that the planner knows.
    """
    known = getattr(planner, "steers", None)
    if known is not None and tuple(robot.action_names) not in known:
        actions = " or ".join(f"({', '.join(names)})" for names in known)
        raise ConfigError(
            f"Expected a robot with actions {actions} for planner {name!r}, got {type(robot).__name__} with "
            f"({', '.join(robot.action_names)}). Take a planner that samples actions, such as mppi."
        )
