"""What a planner is and what it returns, and what a local planner is.

A planner is stateless: `init` makes a plan state, `plan` takes one and returns the
next. Both are
pure: the same arguments give the same result. Letters in shapes: B episodes, N points,
M samples, E edges, S state and A action dimensions.
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

# What a `Plan` draws, with the dimensions of each layer between that of the episodes
# and (x, y).
LAYERS = {"path": "N", "samples": "MN", "reference": "N", "tree": "EN"}

# Remedies for a robot that a planner does not steer.
_SAMPLED = "Take a planner that samples actions, such as mppi."
_STEERED = (
    "The planner commands a turn rate; this robot is steered by an angle, and turns "
    "only while it drives. "
    "Take mppi, astar_mppi or straight."
)

# Fields of a `Problem` that a prediction decides; free space comes from one of the
# first two, as the rules say.
INPUTS = frozenset({"risk_map", "distribution", "fields"})


class PlanStatus(IntEnum):
    """How planning went for an episode."""

    OK = 0
    # no way to the goal was found yet; the action leads along the best way so far
    PARTIAL = 1
    FAILED = 2  # the planner gives up; the episode ends as a planner failure


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

    __repr__ = short_repr

    status: Tensor
    path: Tensor
    samples: Tensor
    reference: Tensor
    tree: Tensor

    @classmethod
    def empty(
        cls, batch: int, device: torch.device | str = "cpu", **known: Tensor
    ) -> "Plan":
        """Makes a plan with status OK and nothing to draw but what is given."""
        blank = {
            name: torch.empty(batch, *[0] * len(inner), 2, device=device)
            for name, inner in LAYERS.items()
        }
        status = torch.zeros(batch, dtype=torch.int64, device=device)
        return cls(**{"status": status, **blank, **known})

    def lines(self, member: int) -> dict[str, Tensor]:
        """What is drawn of one episode, by layer: polylines, shape [lines, N, 2]."""
        layers = {name: getattr(self, name)[member] for name in LAYERS}
        return {
            name: layer if layer.dim() == 3 else layer[None]
            for name, layer in layers.items()
        }


State = TypeVar("State")


class Planner(Specified, ABC, Generic[State]):
    """The base class of planners; `benchnav.testing.check_planner` tries whether one
    keeps its contract.

    `init` and `plan` are to be written, all else has a default. A planner holds its
    settings alone: whatever evolves is in the plan state, so that one planner serves
    any batch in any order.
    """

    steers: tuple[tuple[str, ...], ...] | None = None
    """Action names of the robots that it steers; a robot of other actions is refused.
    None: any robot.
    """

    robots: tuple[type[Robot], ...] | None = None
    """Kinds of robots that it plans for, of those that it steers; None: all."""

    blind: bool = False
    """On the class: it uses no map, so that one run stands for every model and risk
    setting. See `uses`.
    """

    plans_once: bool = False
    """It plans at the start alone; a robot that learns on its way is refused."""

    given_truth: bool = False
    """It is given λ itself; another model than `clairvoyant` is refused."""

    @property
    def compiled(self) -> bool | None:
        """Whether it runs compiled; None before its first plan, and where nothing is
        ever compiled.
        """
        return None

    @abstractmethod
    def init(self, problem: Problem, generator: torch.Generator) -> State:
        """Prepares to plan.

        Args:
            problem: B problems, with what is predicted.
            generator: source of randomness, on the CPU; only drawn from here.

        Returns:
            The first plan state.
        """

    @abstractmethod
    def plan(self, step: Step, plan_state: State) -> tuple[Tensor, State, Plan]:
        """Chooses the next action of every episode.

        Args:
            step: where the robots are, and the λ that they observed.
            plan_state: from `init` or the previous call; not changed.

        Returns:
            Actions within the bounds, shape [B, A]; the next plan state; what was
            planned.
        """

    def select(self, plan_state: State, members: Tensor) -> State:
        """Keeps some episodes, which then are planned for alone, so that those that
        have ended cost no more.

        Args:
            plan_state: of all episodes; not changed.
            members: which are kept, int64, shape [M].

        Returns:
            Their plan state; `NotImplemented`, the default, where ended episodes have
            to stay in the batch.
        """
        return NotImplemented

    def revise(self, plan_state: State, problem: Problem) -> State:
        """Replan for an updated λ̂ map.

        Args:
            plan_state: from the last call; not changed.
            problem: of the same episodes, which starts where the robots are now;
                prediction, λ̂ and free ground may be others than before, all else is as
                it was.

        Returns:
            A plan state under the new problem; `NotImplemented`, the default, where the
            planner has to begin anew by `init`.
        """
        return NotImplemented

    def uses(self, task: Task) -> frozenset[str]:
        """Names the predicted inputs that bear on its actions; conditions that differ
        only in the others run once.

        Args:
            task: what is to be done. Its rules say from which input free space comes,
                see `FreeSpace.source`.

        Returns:
            Some of `INPUTS`; by default all of them, of a blind planner none.
        """
        return frozenset() if self.blind else INPUTS

    def follows(self, task: Task) -> str:
        """What it minimises in place of the task's J, in one line for tables; empty
        where that is J alone.
        """
        return ""

    def remarks(self, task: Task) -> tuple[str, ...]:
        """Notes that tables show, a line each, such as limits that are not the robot's."""
        return ()


class LocalPlanner(Planner[State]):
    """The base class of local planners: planners that are told where to go at each
    step.

    Its plan states are a `Batch` with a `problem`; by itself it plans toward the goal.
    """

    name: str
    """What tables call it."""

    @property
    def seeks_goal(self) -> bool:
        """Whether it minimises a cost that runs to the goal, whatever target it is
        given.
        """
        return False

    def plan(self, step: Step, plan_state: Any) -> tuple[Tensor, State, Plan]:
        """Plans toward the goal; see `Planner`."""
        return self.plan_toward(step, plan_state, plan_state.problem.goal_m)

    @abstractmethod
    def plan_toward(
        self, step: Step, plan_state: State, target_m: Tensor
    ) -> tuple[Tensor, State, Plan]:
        """Chooses actions toward a target (x, y), shape [B, 2]; else as `Planner.plan`."""

    def commit_action(self, plan_state: State, action: Tensor) -> State:
        """Notes the actions that are taken, which may be others than it chose, shape
        [B, A].
        """
        return plan_state

    def select(self, plan_state: Any, members: Tensor) -> State:
        """Keeps some episodes; see `Planner`."""
        return plan_state.select(members)

    def revise(self, plan_state: Any, problem: Problem) -> State:
        """Keeps all but the problem; see `Planner`."""
        return replace(plan_state, problem=problem)


def check_finite(
    owner: str, settings: Any, above: tuple[str, ...], least: tuple[str, ...] = ()
) -> None:
    """Refuses settings that are not finite, or under 0; None stands for a setting that
    is not given.

    Args:
        owner: whose settings they are, for the message.
        settings: a dataclass.
        above: fields that may not be 0 either.
        least: fields that may.

    Raises:
        ConfigError: there are such.
    """
    for name in (*above, *least):
        value, sign = getattr(settings, name), ">" if name in above else "≥"
        fits = value is None or (0 <= value < math.inf and (value or sign == "≥"))
        expect(fits, f"`{name}` {sign} 0 and finite for {owner}, got {value}.")


def check_steers(planner: Planner[Any], robot: Robot, name: str) -> None:
    """Refuses a robot that a planner cannot steer.

    Args:
        planner: any planner.
        robot: any robot.
        name: of the planner, for the message.

    Raises:
        ConfigError: the names of the robot's actions are none that the planner knows,
            or it is of another kind.
    """
    if planner.robots is not None and type(robot) not in planner.robots:
        kinds = " or ".join(kind.__name__ for kind in planner.robots)
        raise ConfigError(
            f"Expected robot {kinds} for planner {name!r}, got {type(robot).__name__}."
        )
    names = tuple(robot.action_names)
    known = (names,) if planner.steers is None else planner.steers
    actions = " or ".join(f"({', '.join(each)})" for each in known)
    steered = STEERING in names and not any(STEERING in each for each in known)
    expect(
        names in known,
        f"a robot with actions {actions} for planner {name!r}, got "
        f"{type(robot).__name__} with "
        f"({', '.join(names)}). {_STEERED if steered else _SAMPLED}",
    )


def rollout_path(problem: Problem, state: Tensor, actions: Tensor) -> Tensor:
    """Positions along action sequences, the first included.

    Args:
        problem: B problems.
        state: initial states, shape [B, S].
        actions: shape [B, T, A, K].

    Returns:
        Shape [B, K, T + 1, 2].
    """
    states = state[:, None].expand(-1, actions.shape[-1], -1)
    positions = [states[..., :2]]
    for action in actions.movedim(-1, 2).unbind(1):
        states = problem.robot(states, action, problem.traversability_at(states))
        positions.append(states[..., :2])
    return torch.stack(positions, dim=2)
