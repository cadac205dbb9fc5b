"""The contract of robots, tried on random states and actions. Letters in shapes: *B leading, S state, A action."""

import math
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.planning.robots import Robot
from benchnav.testing.breaches import NOTHING, Breaches, Draws, same


def check_robot(robot: Any, device: torch.device | str = "cpu", stands_at_zero: bool = True) -> None:
    """Tries whether a robot keeps the contract.

    The contract: `dt_s` and `top_speed_mps` > 0; for each action a name and finite bounds, the least under the
    greatest, and, where there are rates, one > 0; states of shape [*B, S] that begin with the pose, finite, in the
    dtype and on the device of what they are made from; for any leading dimensions the same step alone and in a
    batch, and when asked again; arguments and global generators left as they were; no step longer than
    `top_speed_mps` allows; and no way made on ground of λ = 0.

    Args:
        robot: any robot, or the name, file or mapping of one as suites have it.
        device: where the states are.
        stands_at_zero: whether λ = 0 has to hold it; false for a robot whose docstring says why it does not.

    Raises:
        ConfigError: the robot breaks the contract; every breach is named.
    """
    made = registry.take("robot", robot)
    breaches = Breaches("robot", type(made).__name__)
    for name, value in (("dt_s", made.dt_s), ("top_speed_mps", made.top_speed_mps)):
        breaches.expect(0 < value < math.inf, f"Expected `{name}` > 0 and finite, got {value}.")
    low, high, rates, count = made.action_low, made.action_high, made.action_rates, len(made.action_names)
    ordered = all(-math.inf < least < most < math.inf for least, most in zip(low, high, strict=False))
    bounded = ordered and len(low) == len(high) == count
    breaches.expect(
        bounded, f"Expected finite bounds, low under high, of {count} actions, got {low} and {high}."
    )
    limited = rates is None or (len(rates) == count and min(rates) > 0)
    breaches.expect(limited, f"Expected `action_rates` > 0 of {count} actions, got {rates}.")
    breaches.refuse()
    for draws in breaches.batches(device):
        _drive(made, draws, stands_at_zero, breaches)
    breaches.refuse()


def _drive(robot: Robot, draws: Draws, stands_at_zero: bool, breaches: Breaches) -> None:
    expect, dtype = breaches.expect, draws.like.dtype
    pose = draws.uniform((0, 0, -3), (9, 9, 3)).reshape(-1, 3)
    state = breaches.watch("initial_state", lambda: robot.initial_state(pose), pose=pose)
    begins = isinstance(state, Tensor) and same(state[..., :3], pose)
    breach = f"Expected initial states in {dtype} that begin with the pose (x, y, θ), got others."
    if not expect(begins, breach):
        return
    state = state.reshape(*draws.leading, -1)
    for _ in range(3):
        action, ground = draws.uniform(robot.action_low, robot.action_high), draws.uniform([0], [1])[..., 0]
        moved = breaches.try_function(
            "F",
            robot,
            {"state": state, "action": action, "traversability": ground},
            partial(breaches.expect_tensor, "what `F` gives", like=draws.like, shape=state.shape),
        )
        if moved is NOTHING:
            return
        way = torch.linalg.vector_norm((moved - state)[..., :2], dim=-1)
        reach = 1.001 * robot.top_speed_mps * robot.dt_s
        expect(bool((way <= reach).all()), "Expected no step longer than `top_speed_mps` allows, got one.")
        stood = robot(state, action, torch.zeros_like(ground))
        held = not stands_at_zero or same(stood[..., :2], state[..., :2], 1e-6)
        expect(held, "Expected no way made on ground of λ = 0, got some. Say so with `stands_at_zero=False`.")
        state = moved
