"""The contracts of robots, objectives and risk measures, pure functions of a batch,
tried on random arguments.

Letters in shapes: *B leading, S state and A action dimensions; of maps B, H×W cells, K
components.
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
from benchnav.planning.free_space import Rules
from benchnav.planning.robots import Robot, Unicycle
from benchnav.testing.breaches import NOTHING, Breaches, Draws, same

_HELD_STEPS = 60  # in which robots that gather speed come near their top speed


def check_robot(
    robot: Any, device: torch.device | str = "cpu", stands_at_zero: bool = True
) -> None:
    """Tries whether a robot keeps the contract.

    The contract: `dt_s` and `top_speed_mps` > 0; for each action a name and finite
    bounds, the least under the greatest, and, where there are rates, one > 0; states of
    shape [*B, S] that begin with the pose, finite, in the dtype and on the device of
    what they are made from; for any leading dimensions the same step alone and in a
    batch, and when asked again; arguments and global generators left as they were; no
    step longer than `top_speed_mps` allows; and no way made on ground of λ = 0.

    Args:
        robot: any robot, or the name, file or mapping of one as suites have it.
        device: where the states are.
        stands_at_zero: whether λ = 0 has to hold it; false for a robot whose docstring
            says why it does not.

    Raises:
        ConfigError: the robot breaks the contract; every breach is named.
    """
    made = registry.take("robot", robot)
    breaches = Breaches("robot", type(made).__name__)
    for name, value in (("dt_s", made.dt_s), ("top_speed_mps", made.top_speed_mps)):
        breaches.expect(
            0 < value < math.inf, f"Expected `{name}` > 0 and finite, got {value}."
        )
    low, high, rates, count = (
        made.action_low,
        made.action_high,
        made.action_rates,
        len(made.action_names),
    )
    ordered = all(
        -math.inf < least < most < math.inf
        for least, most in zip(low, high, strict=False)
    )
    breaches.expect(
        ordered and len(low) == len(high) == count,
        f"Expected finite bounds, low under high, of {count} actions, got {low} and "
        f"{high}.",
    )
    breaches.expect(
        rates is None or (len(rates) == count and min(rates) > 0),
        f"Expected `action_rates` > 0 of {count} actions, got {rates}.",
    )
    breaches.refuse()
    for draws in breaches.batches(device):
        _drive(made, draws, stands_at_zero, breaches)
    breaches.refuse()


def _drive(
    robot: Robot, draws: Draws, stands_at_zero: bool, breaches: Breaches
) -> None:
    expect = breaches.expect
    pose = draws.uniform((0, 0, -3), (9, 9, 3)).reshape(-1, 3)
    state = breaches.watch(
        "initial_state", lambda: robot.initial_state(pose), pose=pose
    )
    if not expect(
        isinstance(state, Tensor) and same(state[..., :3], pose),
        f"Expected initial states in {pose.dtype} that begin with the pose (x, y, θ), "
        "got others.",
    ):
        return
    state = state.reshape(*draws.leading, -1)
    for _ in range(3):
        action, ground = (
            draws.uniform(robot.action_low, robot.action_high),
            draws.uniform([0], [1])[..., 0],
        )
        given = {"state": state, "action": action, "traversability": ground}
        is_state = breaches.is_tensor("what `F` gives", draws.like, state.shape)
        moved = breaches.try_function("F", robot, given, is_state)
        if moved is NOTHING:
            return
        way = torch.linalg.vector_norm((moved - state)[..., :2], dim=-1)
        reach = 1.001 * robot.top_speed_mps * robot.dt_s
        expect(
            bool((way <= reach).all()),
            "Expected no step longer than `top_speed_mps` allows, got one.",
        )
        stood = robot(state, action, torch.zeros_like(ground))
        held = not stands_at_zero or same(stood[..., :2], state[..., :2], 1e-6)
        expect(
            held,
            "Expected no way made on ground of λ = 0, got some. Say so with "
            "`stands_at_zero=False`.",
        )
        state = moved
    # A robot that gathers speed shows its top speed after a while, and with its actions
    # at their bounds.
    for corner in itertools.product(
        *zip(robot.action_low, robot.action_high, strict=True)
    ):
        action, firm = (
            state.new_tensor(corner).expand(*draws.leading, -1),
            torch.ones_like(ground),
        )
        driven = robot.initial_state(pose).reshape(state.shape)
        for _ in range(_HELD_STEPS):
            before, driven = driven, robot(driven, action, firm)
        way = torch.linalg.vector_norm((driven - before)[..., :2], dim=-1)
        expect(
            bool((way <= reach).all()),
            "Expected no step longer than `top_speed_mps` allows, got one.",
        )


def check_objective(
    objective: Any, robot: Any = None, device: torch.device | str = "cpu"
) -> None:
    """Tries whether an objective keeps the contract.

    The contract: `stage` and `terminal` give finite costs of shape [*B] for any leading
    dimensions and λ̂ from 0 to 1, `path_cost` costs above 0 for λ̂ that motion may have
    and grades up and down; all in the dtype and on the device of the states, the same
    when asked again, and for an episode alone what it is in a batch; arguments and
    global generators left as they were.

    Args:
        objective: any objective, or the name, file or mapping of one as suites have it.
        robot: likewise, whose states and actions it is given; a unicycle when not
            given.
        device: where the states are.

    Raises:
        ConfigError: the objective breaks the contract; every breach is named.
    """
    driven, rules = registry.take("robot", robot or Unicycle()), Rules()
    made = registry.take(
        "objective", objective, robot=driven, goal_radius_m=rules.goal_radius_m
    )
    breaches = Breaches("objective", type(made).__name__)
    for draws in breaches.batches(device):
        pose = draws.uniform((0, 0, -3), (9, 9, 3)).reshape(-1, 3)
        state = driven.initial_state(pose).reshape(*draws.leading, -1)
        ground = torch.linspace(0, 1, len(pose)).to(pose).reshape(draws.leading)
        one_each = replace(
            draws, leading=(draws.leading[0], *[1] * (len(draws.leading) - 1))
        )
        target = one_each.uniform((0, 0), (9, 9))
        action = draws.uniform(driven.action_low, driven.action_high)
        grade = draws.uniform([-1], [1])[..., 0]
        at = {"traversability": ground, "target": target}
        slowed = ground.clamp(min=rules.min_traversability)
        for method, given in (
            ("stage", {"state": state, "action": action, **at}),
            ("terminal", {"state": state, **at}),
            ("path_cost", {"traversability": slowed, "grade": grade}),
        ):
            is_cost = breaches.is_tensor(
                f"what `{method}` gives", draws.like, draws.leading
            )
            cost = breaches.try_function(method, getattr(made, method), given, is_cost)
        breaches.expect(
            cost is NOTHING or bool((cost > 0).all()),
            "Expected costs above 0 from `path_cost`, got others. Return a cost > 0 "
            "per metre.",
        )
    breaches.refuse()


def check_risk(
    measure: Any, device: torch.device | str = "cpu", tolerance: float = 1e-4
) -> None:
    """Tries whether a risk measure keeps the contract, on mixtures of one component and
    of three, and on quantiles.

    The contract: λ̂ in [0, 1] of shape [B, H, W], floating-point, on the distribution's
    device; the same when asked again, for a map alone what it is in a batch, and for
    some cells what it is on the map, since robots that learn ask for those alone of
    which something else is believed; the distribution and the global generators left as
    they were. A measure that needs a mixture, or classes, refuses other distributions
    by a ConfigError that names their class.

    Args:
        measure: a function of a distribution, or the name, file or mapping of one as
            suites have it: `cvar:0.9`.
        device: where the distributions are.
        tolerance: by how much λ̂ of a map alone and in a batch may differ.

    Raises:
        ConfigError: the measure breaks the contract; every breach is named.
    """
    made = registry.take("risk", measure)
    name = (
        measure
        if isinstance(measure, str)
        else getattr(measure, "__name__", type(measure).__name__)
    )
    breaches = Breaches("risk", name)
    for group in ((0,), (0, 1, 0)):
        breaches.place = f"K = {len(group)}"
        _try_measure(
            made, _make_mixture(group, torch.device(device)), tolerance, breaches
        )
    breaches.place = "quantiles"
    quantiles = _make_quantiles(torch.device(device))
    if not _refuses_by_name(made, quantiles):
        _try_measure(made, quantiles, tolerance, breaches)
    breaches.refuse()


def _try_measure(
    measure: Any,
    distribution: TraversabilityDistribution,
    tolerance: float,
    breaches: Breaches,
) -> None:
    like = torch.zeros(1, dtype=distribution.dtype, device=distribution.device)
    is_map, given = (
        breaches.is_tensor("λ̂", like, distribution.shape),
        {"distribution": distribution},
    )
    breaches.try_function(
        "risk", partial(risk.apply, measure), given, is_map, tolerance
    )
    cells = torch.zeros(
        distribution.shape, dtype=torch.bool, device=distribution.device
    )
    cells[0, ::2], cells[2, 1] = True, True
    whole = breaches.watch("risk", lambda: measure(distribution))
    if not (isinstance(whole, Tensor) and whole.shape == distribution.shape):
        return  # which is noted above
    some = map_tensors(distribution.at(cells), lambda values: values[None])
    alone = breaches.watch("risk", lambda: measure(some))
    breaches.expect(
        alone is NOTHING or same(alone, whole[cells][None, None], tolerance),
        "Expected for some cells alone what λ̂ is on the map, got another.",
    )


def _refuses_by_name(measure: Any, distribution: TraversabilityDistribution) -> bool:
    try:
        measure(distribution)
    except ConfigError as error:
        return type(distribution).__name__ in str(error)
    except Exception:
        return False  # which is noted where it is tried
    return False


def _make_mixture(
    group: tuple[int, ...], device: torch.device
) -> TraversabilityMixture:
    """Mixtures with means beyond [0, 1] and, in part, without spread, shape [B, K, 8,
    11].
    """
    generator = torch.Generator().manual_seed(0)
    drawn = torch.rand(3, 3, len(group), 8, 11, generator=generator).to(device)
    weights, means, stds = (
        drawn / drawn.sum(2, keepdim=True),
        1.4 * drawn - 0.2,
        0.3 * drawn,
    )
    stds[2, :, :, :2] = 0
    return TraversabilityMixture(weights[0], means[1], stds[2], group)


def _make_quantiles(device: torch.device) -> QuantileDistribution:
    """Quantiles with atoms at 0, inside and at 1, shape [3, Q, 8, 11]."""
    generator = torch.Generator().manual_seed(0)
    least, most = torch.rand(2, 3, 1, 8, 11, generator=generator)
    levels = torch.tensor(LEVELS).view(-1, 1, 1)
    values = (
        1.4 * torch.lerp(least.minimum(most), least.maximum(most), levels) - 0.2
    ).clamp(0, 1)
    values[:, 30:40] = values[:, 30:31]
    return QuantileDistribution(values.to(device))
