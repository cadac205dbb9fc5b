from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.planning import DifferentialDrive, GoalDistance, Objective
from benchnav.testing import check_objective
from tests.testing.refusal import refusal

METHODS = ("stage", "terminal", "path_cost")


def changed(method: str, change: Callable[..., Any]) -> Objective:
    """The goal distance, but for what one method gives: made of what it should be and
    of its arguments.
    """
    own = getattr(GoalDistance, method)

    def bad(self: Objective, *given: Tensor, **named: Tensor) -> Any:
        return change(own(self, *given, **named), *given, *named.values())

    return type("Bad", (GoalDistance,), {method: bad})()


class Forgetful(GoalDistance):
    """Costs more each time."""

    asked = 0

    def stage(
        self, state: Tensor, action: Tensor, traversability: Tensor, target: Tensor
    ) -> Tensor:
        self.asked += 1
        return super().stage(state, action, traversability, target) + self.asked


BAD: dict[str, tuple[Any, str]] = {
    "no objective": (object(), "Expected the objective to be an instance of benchnav.planning.Objective, got object"),
    "another cost": (Forgetful(), "Expected the same result from `stage` when called again"),
    "a path that is free": (changed("path_cost", lambda cost, *_: cost - 1), "Expected costs above 0 from `path_cost`"),
    "a path that pays": (changed("path_cost", lambda cost, *_: -cost), "Expected costs above 0 from `path_cost`"),
    "writes into the target": (changed("stage", lambda cost, *g: g[-1].zero_() is None or cost), "got changes in"),
    "of λ̂ = 0 infinite": (changed("stage", lambda cost, *g: cost / g[2]), "Expected finite results of `stage`"),
    **{
        f"{method}: {name}": (changed(method, change), expected.format(method))
        for method in METHODS
        for name, change, expected in (
            ("raises", lambda cost, *_: cost[99, 99, 99, 99], "Expected a result from `{}`, got IndexError"),
            ("one cost for all", lambda cost, *_: cost.mean(), "results of `{}` as torch.float32 of shape [6] on cpu"),
            ("knows [B] alone", lambda cost, *_: cost.flatten(), "[*B = [6, 5], torch.float32"),
            ("single precision", lambda cost, *_: cost.float(), "[*B = [6], torch.float64"),
            ("no number", lambda cost, *_: cost * torch.nan, "Expected finite results of `{}`"),
            ("a cost of the batch", lambda cost, *_: cost + cost.mean(), "same result from `{}` for a single"),
            ("PyTorch's generator", lambda cost, *_: cost + 0 * torch.rand(1).to(cost), "PyTorch's global generator"),
            ("writes into λ̂", lambda cost, *g: [v.mul_(0.5) for v in g] and cost, "got changes in"),
        )
    },
}  # fmt: skip


@pytest.mark.parametrize(("objective", "expected"), BAD.values(), ids=BAD.keys())
def test_a_breach_is_caught_and_named(objective: Any, expected: str) -> None:
    assert expected in refusal(check_objective, objective)


@pytest.mark.parametrize("robot", registry.names("robot"))
@pytest.mark.parametrize("name", registry.names("objective"))
def test_every_registered_objective_keeps_the_contract_with_every_robot(
    name: str, robot: str
) -> None:
    check_objective(name, robot)


def test_it_is_given_the_states_of_its_robot() -> None:
    seen: list[int] = []
    check_objective(
        changed("stage", lambda cost, state, *_: seen.append(state.shape[-1]) or cost),
        DifferentialDrive(),
    )
    assert set(seen) == {5}
