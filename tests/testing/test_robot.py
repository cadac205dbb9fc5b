import random
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from benchnav import ConfigError
from benchnav.core import registry
from benchnav.planning import Unicycle
from benchnav.testing import check_robot
from tests.testing.refusal import refusal


def moving(change: Callable[[Tensor, Tensor, Tensor, Tensor], Any]) -> Unicycle:
    """A unicycle, but for what F gives: made of what it should be, the state, the
    action and λ.
    """

    class Bad(Unicycle):
        def __call__(
            self, state: Tensor, action: Tensor, traversability: Tensor
        ) -> Tensor:
            return change(
                super().__call__(state, action, traversability),
                state,
                action,
                traversability,
            )

    return Bad()


def meddling(act: Callable[[Tensor, Tensor, Tensor], object]) -> Unicycle:
    return moving(lambda moved, *given: [act(*given)] and moved)


def standing(change: Callable[[Tensor], Any]) -> Unicycle:
    class Bad(Unicycle):
        def initial_state(self, pose: Tensor) -> Tensor:
            return change(pose)

    return Bad()


def having(**attributes: Any) -> Unicycle:
    made = type("Bad", (Unicycle,), attributes)()
    for name, value in attributes.items():
        # also where it is a field of the frozen robot
        object.__setattr__(made, name, value)
    return made


class Forgetful(Unicycle):
    """Moves otherwise each time."""

    asked: ClassVar[list[int]] = []

    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        self.asked.append(1)
        return super().__call__(state, action, traversability) * (
            1 - 1e-4 * len(self.asked)
        )


class Gathering(Unicycle):
    """Gathers speed from step to step, beyond what it says."""

    def initial_state(self, pose: Tensor) -> Tensor:
        return torch.cat((pose, torch.zeros_like(pose[..., :1])), dim=-1)

    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        # up to 1.6 times what is commanded
        speed = 0.95 * state[..., 3:] + 0.08 * action[..., :1]
        moved = super().__call__(
            state[..., :3], torch.cat((speed, action[..., 1:]), dim=-1), traversability
        )
        return torch.cat((moved, speed), dim=-1)


BAD: dict[str, tuple[Any, str]] = {
    "no robot": (object(), "Expected the robot to be an instance of benchnav.planning.Robot, got object"),
    "no time step": (having(dt_s=0.0), "Expected `dt_s` > 0 and finite, got 0.0"),
    "no speed": (having(top_speed_mps=0.0), "Expected `top_speed_mps` > 0 and finite, got 0.0"),
    "bounds the wrong way round": (having(action_low=(1.0, 1.0)), "below finite `action_high`, for 2 actions"),
    "too few bounds": (having(action_high=(1.0,)), "below finite `action_high`, for 2 actions"),
    "an infinite bound": (having(action_high=(1.0, float("inf"))), "Expected finite `action_low`"),
    "too few names": (having(action_names=("speed_mps",)), "for 1 actions"),
    "a rate for one": (having(action_rates=(1.0,)), "Expected `action_rates` > 0 for 2 actions"),
    "a rate of 0": (having(action_rates=(1.0, 0.0)), "Expected `action_rates` > 0 for 2 actions"),
    "states without a heading": (standing(lambda pose: pose[:, :2]), "in torch.float32 that begin with the pose"),
    "states elsewhere": (standing(lambda pose: pose + 1), "begin with the pose"),
    "states in doubles": (standing(lambda pose: pose.double()), "in torch.float32 that begin with the pose"),
    "states by writing into the pose": (standing(lambda pose: pose.add_(0.5)), "got changes in pose"),
    "raises": (moving(lambda moved, *_: moved[99, 99, 99, 99, 99]), "Expected a result from `F`, got IndexError"),
    "a vector for all": (moving(lambda moved, *_: moved.reshape(-1, 3)[:1]), "of shape [6, 3] on cpu, got"),
    "knows [B, S] alone": (moving(lambda moved, *_: moved.reshape(-1, 3)), "[*B = [6, 5], torch.float32"),
    "single precision alone": (moving(lambda moved, *_: moved.float()), "[*B = [6], torch.float64"),
    "no number": (moving(lambda moved, *_: moved * torch.nan), "Expected finite results of `F`"),
    "writes into the state": (meddling(lambda state, *_: state.add_(0.1)), "got changes in state"),
    "writes into the action": (meddling(lambda s, action, _: action.zero_()), "got changes in action"),
    "writes into λ": (meddling(lambda s, a, ground: ground.zero_()), "got changes in traversability"),
    "PyTorch's generator": (meddling(lambda *_: torch.rand(1)), "PyTorch's global generator"),
    "NumPy's generator": (meddling(lambda *_: np.random.rand()), "NumPy's global generator"),  # noqa: NPY002
    "Python's generator": (meddling(lambda *_: random.random()), "Python's global generator"),
    "another step": (Forgetful(), "Expected the same result from `F` when called again"),
    "a step of the batch": (moving(lambda moved, *_: moved + 0.01 * moved.mean(0)), "for a single element"),
    "faster than it says": (moving(lambda m, state, *_: state + 1.2 * (m - state)), "at most `top_speed_mps` · `dt_s`"),
    "faster than it says after a while": (Gathering(), "at most `top_speed_mps` · `dt_s`"),
    "drives on ground of 0": (
        moving(lambda m, state, action, _: torch.cat((m[..., :1] + 0.01 * action[..., :1], m[..., 1:]), -1)),
        "no motion on terrain of λ = 0",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("robot", "expected"), BAD.values(), ids=BAD.keys())
def test_a_breach_is_caught_and_named(robot: Any, expected: str) -> None:
    assert expected in refusal(check_robot, robot)


@pytest.mark.parametrize("name", registry.names("robot"))
def test_every_registered_robot_keeps_the_contract(name: str) -> None:
    check_robot(name)


def test_a_robot_may_say_that_ground_does_not_hold_it() -> None:
    rolling = moving(lambda moved, state, *_: 0.9 * moved + 0.1 * state + 1e-3)
    with pytest.raises(ConfigError, match="stands_at_zero=False"):
        check_robot(rolling)
    check_robot(rolling, stands_at_zero=False)


def test_a_robot_is_taken_by_mapping_or_as_an_object() -> None:
    check_robot({"part": "unicycle", "options": {"dt_s": 0.5}})
    check_robot(replace(Unicycle(), speed_mps=(-2.0, 1.0)))
