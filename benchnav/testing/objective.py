"""The contract of objectives, tried on random states, actions and ground. Letters in shapes: *B leading."""

import math
from typing import Any

import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.planning.free_space import Rules
from benchnav.planning.objective import Objective
from benchnav.planning.robots import Robot, Unicycle
from benchnav.testing.breaches import NOTHING, Breaches
from benchnav.testing.robot import LEADING, draw

_SEED = 20240229


def check_objective(objective: Any, robot: Any = None, device: torch.device | str = "cpu") -> None:
    """Tries whether an objective keeps the contract.

    The contract: `stage` and `terminal` give finite costs of shape [*B] for any leading dimensions and λ̂ from 0 to 1,
    `path_cost` costs above 0 for λ̂ that motion may have and grades up and down; all in the dtype and on the device
    of the states, the same when asked again, and for an episode alone what it is in a batch; arguments and global
    generators left as they were.

    Args:
        objective: any objective, or the name, file or mapping of one as suites have it.
        robot: likewise, whose states and actions it is given; a unicycle when not given.
        device: where the states are.

    Raises:
        ConfigError: the objective breaks the contract; every breach is named.
    """
    driven, rules = registry.take("robot", robot or Unicycle()), Rules()
    made = registry.take("objective", objective, robot=driven, goal_radius_m=rules.goal_radius_m)
    breaches = Breaches("objective", type(made).__name__)
    for dtype in (torch.float32, torch.float64):
        for leading in LEADING:
            breaches.place = f"*B = {list(leading)}, {dtype}"
            like = torch.zeros(1, dtype=dtype, device=device)
            _try(made, driven, leading, rules.min_traversability, like, breaches)
    breaches.refuse()


def _try(
    objective: Objective,
    robot: Robot,
    leading: tuple[int, ...],
    least: float,
    like: Tensor,
    breaches: Breaches,
) -> None:
    generator = torch.Generator().manual_seed(_SEED)
    pose = draw((0, 0, -3), (9, 9, 3), (math.prod(leading),), like, generator)
    state = robot.initial_state(pose).reshape(*leading, -1)
    ground = torch.linspace(0, 1, len(pose)).to(like).reshape(leading)
    target = draw((0, 0), (9, 9), (leading[0], *[1] * (len(leading) - 1)), like, generator)
    ended = {"state": state, "traversability": ground, "target": target}
    action = draw(robot.action_low, robot.action_high, leading, like, generator)
    breaches.try_function("stage", objective.stage, {**ended, "action": action}, leading)
    breaches.try_function("terminal", objective.terminal, ended, leading)
    grade = draw([-1], [1], leading, like, generator)[..., 0]
    metre = {"traversability": ground.clamp(min=least), "grade": grade}
    cost = breaches.try_function("path_cost", objective.path_cost, metre, leading)
    above = cost is NOTHING or bool((cost > 0).all())
    breaches.expect(
        above, "Expected costs above 0 from `path_cost`, got others. Let no metre of a path be free."
    )
