"""Checks of robots, objectives and risk measures on random arguments.

All three are pure functions of a batch. Letters in shapes: *B leading dimensions, S
state and A action dimensions; of distributions, B maps, H×W cells, K components and Q
quantiles.
"""

import itertools
import math
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.core.batch import map_tensors
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.quantiles import LEVELS, QuantileDistribution
from benchnav.planning import risk
from benchnav.planning.footprint import Footprint
from benchnav.planning.free_space import Rules
from benchnav.planning.robots import Robot, Unicycle
from benchnav.testing.breaches import NOTHING, Breaches, Draws, same

_CONSTANT_STEPS = 60  # steps in which accelerating robots come close to top speed


def check_robot(
    robot: Any, device: torch.device | str = "cpu", stands_at_zero: bool = True
) -> None:
    """Check that a robot fulfils its contract.

    The contract:

    - `dt_s` and `top_speed_mps` are above 0;
    - each action dimension has a name, finite bounds and, if there are rates, a rate
      above 0;
    - states of shape [*B, S] begin with the pose, and are finite, in the dtype and on
      the device of the arguments;
    - a step is the same when repeated, and for a single robot as in a batch, for any
      leading dimensions;
    - arguments and global generators are unchanged;
    - in each step the robot moves at most `top_speed_mps` · `dt_s`;
    - the robot does not move on terrain of λ = 0.

    Args:
        robot: a robot, or its name, file or mapping as in suites.
        device: device of the states.
        stands_at_zero: whether the robot must stand still at λ = 0. Pass False for a
            robot whose docstring explains why it moves.

    Raises:
        ConfigError: If the robot breaks the contract; the message lists all breaches.
    """
    new_robot = registry.take("robot", robot)
    breaches = Breaches("robot", type(new_robot).__name__)
    for name in ("dt_s", "top_speed_mps"):
        value = getattr(new_robot, name)
        is_valid = 0 < value < math.inf
        breaches.expect(is_valid, f"Expected `{name}` > 0 and finite, got {value}.")
    low = new_robot.action_low
    high = new_robot.action_high
    rates = new_robot.action_rates
    n_actions = len(new_robot.action_names)
    bounds = zip(low, high, strict=False)
    is_ordered = all(-math.inf < lower < upper < math.inf for lower, upper in bounds)
    is_complete = len(low) == len(high) == n_actions
    breaches.expect(
        is_ordered and is_complete,
        f"Expected finite `action_low` below finite `action_high`, for {n_actions} "
        f"actions, got {low} and {high}.",
    )
    are_rates = rates is None or (len(rates) == n_actions and min(rates) > 0)
    breaches.expect(
        are_rates,
        f"Expected `action_rates` > 0 for {n_actions} actions, or None, got {rates}.",
    )
    breaches.raise_any()
    for draws in breaches.batches(device):
        _try_robot(new_robot, draws, stands_at_zero, breaches)
    breaches.raise_any()


def _try_robot(
    robot: Robot, draws: Draws, stands_at_zero: bool, breaches: Breaches
) -> None:
    expect = breaches.expect
    footprint = robot.footprint
    expect(
        footprint is None or isinstance(footprint, Footprint),
        "Expected `footprint` to be a `Footprint`, or None for a point, got "
        f"{footprint!r}.",
    )
    pose = draws.uniform((0, 0, -3), (9, 9, 3)).reshape(-1, 3)
    state = breaches.watch(
        "initial_state", lambda: robot.initial_state(pose), pose=pose
    )
    has_pose = expect(
        isinstance(state, Tensor) and same(state[..., :3], pose),
        f"Expected `initial_state` to return states in {pose.dtype} that begin with the "
        "pose (x, y, θ), got other values.",
    )
    if not has_pose:
        return
    state = state.reshape(*draws.leading, -1)
    max_length = 1.001 * robot.top_speed_mps * robot.dt_s
    too_long_breach = (
        "Expected steps of at most `top_speed_mps` · `dt_s`, got a longer step."
    )
    for _ in range(3):
        action = draws.uniform(robot.action_low, robot.action_high)
        traversability = draws.uniform([0], [1])[..., 0]
        arguments = {"state": state, "action": action, "traversability": traversability}
        is_state = breaches.is_tensor("results of `F`", draws.like, state.shape)
        next_state = breaches.try_function("F", robot, arguments, is_state)
        if next_state is NOTHING:
            return
        is_short = _lengths(state, next_state) <= max_length
        expect(bool(is_short.all()), too_long_breach)
        state_at_zero = robot(state, action, torch.zeros_like(traversability))
        stands_still = not stands_at_zero or same(
            state_at_zero[..., :2], state[..., :2], 1e-6
        )
        expect(
            stands_still,
            "Expected no motion on terrain of λ = 0, got a change of position. Pass "
            "`stands_at_zero=False` to allow it.",
        )
        state = next_state
    # A robot that accelerates reaches its top speed only after several steps with
    # actions at their bounds.
    bounds = zip(robot.action_low, robot.action_high, strict=True)
    for corner in itertools.product(*bounds):
        action = state.new_tensor(corner).expand(*draws.leading, -1)
        full = torch.ones_like(traversability)
        state = robot.initial_state(pose).reshape(state.shape)
        for _ in range(_CONSTANT_STEPS):
            previous = state
            state = robot(state, action, full)
        is_short = _lengths(previous, state) <= max_length
        expect(bool(is_short.all()), too_long_breach)


def _lengths(state: Tensor, next_state: Tensor) -> Tensor:
    motion = (next_state - state)[..., :2]
    return torch.linalg.vector_norm(motion, dim=-1)


def check_objective(
    objective: Any, robot: Any = None, device: torch.device | str = "cpu"
) -> None:
    """Check that an objective fulfils its contract.

    The contract:

    - `stage` and `terminal` return finite costs of shape [*B] for any leading
      dimensions and λ̂ from 0 to 1;
    - `path_cost` returns finite costs above 0 for λ̂ of at least
      `Rules.min_traversability`, and for positive and negative grades;
    - costs are in the dtype and on the device of the states, the same when repeated,
      and the same for a single episode as in a batch;
    - arguments and global generators are unchanged.

    Args:
        objective: an objective, or its name, file or mapping as in suites.
        robot: robot of the states and actions, or its name, file or mapping; if None, a
            unicycle.
        device: device of the states.

    Raises:
        ConfigError: If the objective breaks the contract; the message lists all
            breaches.
    """
    new_robot = registry.take("robot", robot or Unicycle())
    rules = Rules()
    new_objective = registry.take(
        "objective", objective, robot=new_robot, goal_radius_m=rules.goal_radius_m
    )
    breaches = Breaches("objective", type(new_objective).__name__)
    for draws in breaches.batches(device):
        pose = draws.uniform((0, 0, -3), (9, 9, 3)).reshape(-1, 3)
        state = new_robot.initial_state(pose).reshape(*draws.leading, -1)
        levels = torch.linspace(0, 1, len(pose)).to(pose)
        traversability = levels.reshape(draws.leading)
        n_inner = len(draws.leading) - 1
        target_shape = (draws.leading[0], *[1] * n_inner)
        target_draws = replace(draws, leading=target_shape)
        target = target_draws.uniform((0, 0), (9, 9))
        action = draws.uniform(new_robot.action_low, new_robot.action_high)
        grade = draws.uniform([-1], [1])[..., 0]
        other_arguments = {"traversability": traversability, "target": target}
        motion_traversability = traversability.clamp(min=rules.min_traversability)
        calls = {
            "stage": {"state": state, "action": action, **other_arguments},
            "terminal": {"state": state, **other_arguments},
            "path_cost": {"traversability": motion_traversability, "grade": grade},
        }
        for method, arguments in calls.items():
            description = f"results of `{method}`"
            is_cost = breaches.is_tensor(description, draws.like, draws.leading)
            function = getattr(new_objective, method)
            cost = breaches.try_function(method, function, arguments, is_cost)
        is_positive = cost is NOTHING or bool((cost > 0).all())
        breaches.expect(
            is_positive,
            "Expected costs above 0 from `path_cost`, got costs of 0 or below. Return a "
            "cost > 0 per metre.",
        )
    breaches.raise_any()


def check_risk(
    measure: Any, device: torch.device | str = "cpu", tolerance: float = 1e-4
) -> None:
    """Check that a risk measure fulfils its contract.

    The measure is applied to mixtures of one and of three components, and to quantiles.
    The contract:

    - λ̂ is in [0, 1], of shape [B, H, W], floating-point, and on the distribution's
      device;
    - λ̂ is the same when repeated, and for a single map as in a batch;
    - λ̂ of selected cells equals λ̂ of the same cells in the whole map, since a robot
      that learns updates only the cells whose belief changed;
    - the distribution and the global generators are unchanged.

    A measure that requires a mixture, or classes, rejects other distributions with a
    ConfigError that names their class.

    Args:
        measure: a function of a distribution, or its name, file or mapping as in
            suites, such as `cvar:0.9`.
        device: device of the distributions.
        tolerance: tolerance between λ̂ of a single map and of a batch.

    Raises:
        ConfigError: If the measure breaks the contract; the message lists all breaches.
    """
    new_measure = registry.take("risk", measure)
    name = measure
    if not isinstance(measure, str):
        name = getattr(measure, "__name__", type(measure).__name__)
    breaches = Breaches("risk", name)
    for group in ((0,), (0, 1, 0)):
        breaches.location = f"K = {len(group)}"
        mixture = _create_mixture(group, torch.device(device))
        _try_measure(new_measure, mixture, tolerance, breaches)
    breaches.location = "quantiles"
    quantiles = _create_quantiles(torch.device(device))
    if not _rejects_by_name(new_measure, quantiles):
        _try_measure(new_measure, quantiles, tolerance, breaches)
    breaches.raise_any()


def _try_measure(
    measure: Any,
    distribution: TraversabilityDistribution,
    tolerance: float,
    breaches: Breaches,
) -> None:
    like = torch.zeros(1, dtype=distribution.dtype, device=distribution.device)
    is_map = breaches.is_tensor("λ̂", like, distribution.shape)
    arguments = {"distribution": distribution}
    apply_risk = partial(risk.apply, measure)
    breaches.try_function("risk", apply_risk, arguments, is_map, tolerance)
    cells = torch.zeros(
        distribution.shape, dtype=torch.bool, device=distribution.device
    )
    cells[0, ::2] = True
    cells[2, 1] = True
    whole_map = breaches.watch("risk", lambda: measure(distribution))
    is_map_of_shape = (
        isinstance(whole_map, Tensor) and whole_map.shape == distribution.shape
    )
    if not is_map_of_shape:
        return  # `try_function` has noted it
    selected = map_tensors(distribution.at(cells), lambda values: values[None])
    selected_map = breaches.watch("risk", lambda: measure(selected))
    expected = whole_map[cells][None, None]
    is_same = selected_map is NOTHING or same(selected_map, expected, tolerance)
    breaches.expect(
        is_same,
        "Expected λ̂ of selected cells to equal λ̂ of the same cells in the whole map, "
        "got a different λ̂.",
    )


def _rejects_by_name(measure: Any, distribution: TraversabilityDistribution) -> bool:
    try:
        measure(distribution)
    except ConfigError as error:
        return type(distribution).__name__ in str(error)
    except Exception:
        return False  # noted by `_try_measure`
    return False


def _create_mixture(
    group: tuple[int, ...], device: torch.device
) -> TraversabilityMixture:
    """Return mixtures of shape [3, K, 8, 11], some with std 0 or means beyond [0, 1]."""
    generator = torch.Generator().manual_seed(0)
    uniform = torch.rand(3, 3, len(group), 8, 11, generator=generator).to(device)
    weights = uniform[0] / uniform[0].sum(1, keepdim=True)
    means = 1.4 * uniform[1] - 0.2
    stds = 0.3 * uniform[2]
    stds[:, :, :2] = 0
    return TraversabilityMixture(weights, means, stds, group)


def _create_quantiles(device: torch.device) -> QuantileDistribution:
    """Return quantiles of shape [3, Q, 8, 11] with atoms at 0, at 1 and in between."""
    generator = torch.Generator().manual_seed(0)
    a, b = torch.rand(2, 3, 1, 8, 11, generator=generator)
    levels = torch.tensor(LEVELS).view(-1, 1, 1)
    ascending = torch.lerp(a.minimum(b), a.maximum(b), levels)
    values = (1.4 * ascending - 0.2).clamp(0, 1)
    values[:, 30:40] = values[:, 30:31]
    return QuantileDistribution(values.to(device))
