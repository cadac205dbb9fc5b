"""What a planner is, what it returns, and how it is found by name.

A planner is stateless: `init` makes a plan state, `plan` takes one and returns the next. Both are
pure: the same arguments give the same result. A planner's own is registered with `register` or by
an entry point of the group `benchnav.planners`. Letters in shapes: B episodes, N points, M samples,
E edges, S state and A action dimensions.
"""

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from enum import IntEnum
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from benchnav.errors import ConfigError
from benchnav.planning.problem import Problem


class PlanStatus(IntEnum):
    """How planning went for an episode."""

    OK = 0
    PARTIAL = 1  # no way to the goal was found yet; the action leads along the best way so far
    FAILED = 2  # there is none to be found; the episode ends as a planner failure


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What playback draws. Unused points are NaN; a planner leaves at size 0 what it does not have.

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


State = TypeVar("State")


class Planner(Protocol[State]):
    """The contract of a planner."""

    def init(self, problem: Problem, generator: torch.Generator) -> State:
        """Prepares to plan.

        Args:
            problem: B problems with predicted traversability.
            generator: source of randomness, on the CPU; only drawn from here.

        Returns:
            The first plan state.
        """
        ...

    def plan(self, state: Tensor, plan_state: State) -> tuple[Tensor, State, Plan]:
        """Chooses the next action of every episode.

        Args:
            state: where the robots are, shape [B, S].
            plan_state: from `init` or the previous call; not changed.

        Returns:
            Actions within the bounds, shape [B, A]; the next plan state; what was planned.
        """
        ...


Factory = Callable[[Mapping[str, Any]], Planner[Any]]

_FACTORIES: dict[str, Factory] = {}
_BUILT_IN = {
    "astar_dwa": ("benchnav.planning.astar_dwa", "AStarDWA", "AStarDWAConfig"),
    "cl_rrt": ("benchnav.planning.cl_rrt", "CLRRT", "CLRRTConfig"),
    "mppi": ("benchnav.planning.mppi", "MPPI", "MPPIConfig"),
}


def register(name: str, factory: Factory) -> None:
    """Makes a planner known by name in this process.

    Args:
        name: what suites call it.
        factory: makes the planner from a mapping of options.
    """
    _FACTORIES[name] = factory


def planner_names() -> list[str]:
    """Names that `make_planner` knows."""
    return sorted(
        {*_BUILT_IN, *_FACTORIES, *(point.name for point in entry_points(group="benchnav.planners"))}
    )


def make_planner(name: str, options: Mapping[str, Any] | None = None) -> Planner[Any]:
    """Makes a planner by name.

    Args:
        name: a built-in, registered, or entry-point name.
        options: fields of its config that differ from their defaults.

    Raises:
        ConfigError: there is no such planner or option.
    """
    options = options or {}
    if name in _FACTORIES:
        return _FACTORIES[name](options)
    if name in _BUILT_IN:
        module_name, planner_name, config_name = _BUILT_IN[name]
        module = import_module(module_name)
        return getattr(module, planner_name)(_configure(name, getattr(module, config_name), options))
    for point in entry_points(group="benchnav.planners", name=name):
        return point.load()(options)
    raise ConfigError(
        f"Expected a planner among {', '.join(planner_names())}, got {name!r}.{_hint(name, planner_names())}"
    )


def _configure(name: str, config: type, options: Mapping[str, Any]) -> Any:
    known = {field.name: field for field in fields(config)}
    options = {
        option: tuple(value) if isinstance(value, list) else value for option, value in options.items()
    }
    for option, value in options.items():
        if option not in known:
            raise ConfigError(
                f"Expected options of planner {name!r} among {', '.join(known)}, got {option!r}."
                f"{_hint(option, list(known))}"
            )
        default = known[option].default
        wanted = (int, float) if isinstance(default, float) else type(default)
        if not isinstance(value, wanted) or isinstance(value, bool) != isinstance(default, bool):
            raise ConfigError(
                f"Expected option {option!r} of planner {name!r} like {default!r}, got {value!r}."
            )
    return config(**options)


def _hint(name: str, known: list[str]) -> str:
    close = difflib.get_close_matches(name, known, n=1)
    return f" Did you mean {close[0]!r}?" if close else ""
