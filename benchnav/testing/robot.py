"""The contract of robots, tried on random states and actions. Letters in shapes: *B leading, S state, A action."""

import math
from typing import Any

import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.planning.robots import Robot
from benchnav.testing.breaches import NOTHING, Breaches, close, same

LEADING = ((6,), (6, 5), (6, 5, 2))

_SEED = 20240229


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
    for dtype in (torch.float32, torch.float64):
        for leading in LEADING:
            breaches.place = f"*B = {list(leading)}, {dtype}"
            _drive(made, leading, torch.zeros(1, dtype=dtype, device=device), stands_at_zero, breaches)
    breaches.refuse()


def draw(low: Any, high: Any, leading: tuple[int, ...], like: Tensor, generator: torch.Generator) -> Tensor:
    """Uniform numbers between bounds of length N, shape [*B, N], in the dtype and on the device of a tensor."""
    least, most = like.new_tensor(low), like.new_tensor(high)
    return least + (most - least) * torch.rand(*leading, len(least), generator=generator).to(like)


def _drive(
    robot: Robot, leading: tuple[int, ...], like: Tensor, stands_at_zero: bool, breaches: Breaches
) -> None:
    generator, expect = torch.Generator().manual_seed(_SEED), breaches.expect
    pose = draw((0, 0, -3), (9, 9, 3), (math.prod(leading),), like, generator)
    state = breaches.watch("initial_state", lambda: robot.initial_state(pose), pose=pose)
    begins = isinstance(state, Tensor) and same(state[..., :3], pose)
    if not expect(
        begins, f"Expected initial states in {like.dtype} that begin with the pose (x, y, θ), got others."
    ):
        return
    state = state.reshape(*leading, -1)
    for _ in range(3):
        action = draw(robot.action_low, robot.action_high, leading, like, generator)
        ground = draw([0], [1], leading, like, generator)[..., 0]
        given = {"state": state, "action": action, "traversability": ground}
        moved = breaches.try_function("F", robot, given, state.shape)
        if moved is NOTHING:
            return
        way = torch.linalg.vector_norm((moved - state)[..., :2], dim=-1)
        reach = 1.001 * robot.top_speed_mps * robot.dt_s
        expect(bool((way <= reach).all()), "Expected no step longer than `top_speed_mps` allows, got one.")
        stood = robot(state, action, torch.zeros_like(ground))
        held = not stands_at_zero or close(stood[..., :2], state[..., :2], 1e-6)
        expect(held, "Expected no way made on ground of λ = 0, got some. Say so with `stands_at_zero=False`.")
        state = moved
