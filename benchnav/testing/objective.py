"""The contract of objectives, tried on random states, actions and ground. Letters in shapes: *B leading."""

from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.planning.free_space import Rules
from benchnav.planning.robots import Unicycle
from benchnav.testing.breaches import NOTHING, Breaches, Draws


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
    for draws in breaches.batches(device):

        def trial(method: str, draws: Draws = draws, **given: Tensor) -> Any:
            is_cost = partial(
                breaches.expect_tensor, f"what `{method}` gives", like=draws.like, shape=draws.leading
            )
            return breaches.try_function(method, getattr(made, method), given, is_cost)

        pose = draws.uniform((0, 0, -3), (9, 9, 3)).reshape(-1, 3)
        state = driven.initial_state(pose).reshape(*draws.leading, -1)
        ground = torch.linspace(0, 1, len(pose)).to(pose).reshape(draws.leading)
        one_each = replace(draws, leading=(draws.leading[0], *[1] * (len(draws.leading) - 1)))
        target = one_each.uniform((0, 0), (9, 9))
        action = draws.uniform(driven.action_low, driven.action_high)
        trial("stage", state=state, action=action, traversability=ground, target=target)
        trial("terminal", state=state, traversability=ground, target=target)
        grade = draws.uniform([-1], [1])[..., 0]
        cost = trial("path_cost", traversability=ground.clamp(min=rules.min_traversability), grade=grade)
        breaches.expect(
            cost is NOTHING or bool((cost > 0).all()),
            "Expected costs above 0 from `path_cost`, got others. Let no metre of a path be free.",
        )
    breaches.refuse()
