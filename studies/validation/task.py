"""Task of Cai et al. as a `Problem`: their robot, cost, rules and prediction.

Letters in shapes: B episodes, D maps, N point masses, *B any leading dimensions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from benchnav import Observation, TraversabilityMixture
from benchnav.core import registry, rng
from benchnav.core.errors import expect
from benchnav.planning import (
    FreeSpace,
    MPPIConfig,
    Objective,
    Prediction,
    Problem,
    Rules,
    Task,
    Unicycle,
    distance,
    pose_problem,
    risk,
)
from studies.validation.ground import DIRT, SLICES, VEGETATION
from studies.validation.world import GRID

START_M = (0.5, 0.5)
GOAL_M = (8.5, 8.5)
GOAL_RADIUS_M = 0.5
STEPS = 150
THEIR_MPPI = MPPIConfig(
    horizon_s=10.0, samples=1024, noise=(2.0, 2.0), temperature=1.0, control_cost=1.0
)
_LAST_SPEED_MPS = 0.01 + 1e-6
_COST = "cost"


@dataclass(frozen=True, kw_only=True)
class Rover(Unicycle):
    """Unicycle of Cai et al., which stops at the goal, as their rollouts end there."""

    speed_mps: tuple[float, float] = (0.0, 3.0)
    turn_rate_radps: tuple[float, float] = (-np.pi, np.pi)

    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        """Advance by one time step; see `Robot`."""
        away = distance(state, state.new_tensor(GOAL_M)) > GOAL_RADIUS_M
        return super().__call__(state, action, traversability * away)


ROVER = Rover()


@dataclass(frozen=True)
class TimeAndDistance(Objective):
    """Cost of Cai et al.: dt + distance per step until arrival, and a terminal cost.

    The terminal cost is the time for the remaining distance at a crawl. They evaluate a
    step at its final state. Here a step is evaluated at its initial state, and the last
    state is added at the end. The two differ by the cost of the start, which is the
    same for all rollouts.

    Args:
        power: exponent of the distance in a step's cost.
    """

    power: int = 1

    def stage(
        self, state: Tensor, action: Tensor, traversability: Tensor, target: Tensor
    ) -> Tensor:
        """Return the cost of one step; see `Objective`."""
        away = distance(state, target)
        return (ROVER.dt_s + away**self.power) * (away > GOAL_RADIUS_M)

    def terminal(self, state: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Return the cost of the last state; see `Objective`."""
        away = distance(state, target)
        return (
            ROVER.dt_s
            + away**self.power
            + away / _LAST_SPEED_MPS * (away > GOAL_RADIUS_M)
        )


@dataclass(frozen=True)
class CellFields:
    """`FieldSource` of independent cells with equally likely point masses.

    Args:
        atoms: N values of λ per cell, shape [B, N, 9, 9].
        names: keys of the episodes' fields; episodes with one key have the same fields.
    """

    atoms: Tensor
    names: tuple[int, ...]

    def sample(self, count: int, key: int, cells: Tensor | None = None) -> Tensor:
        """See `Problem.sample_fields`."""
        drawn = []
        for atoms, name in zip(self.atoms, self.names, strict=True):
            generator = rng.generator(rng.stream_key(key, "cai", "fields", name))
            drawn.append(
                atoms.gather(
                    0,
                    torch.randint(
                        len(atoms), (count, *GRID.shape), generator=generator
                    ),
                )
            )
        return torch.stack(drawn)

    def select(self, members: Tensor) -> "CellFields":
        """Return the source of some episodes, given their indices, int64."""
        return CellFields(
            self.atoms[members], tuple(self.names[index] for index in members.tolist())
        )


@dataclass(frozen=True, kw_only=True)
class Setup:
    """Settings of planning; the defaults are those of Cai et al.

    Args:
        mppi: settings of the planner.
        risk_map: `exact` for our risk settings, or `histogram` for their binning and
            rounding; it applies to fields of λ too.
        objective: `theirs`, or the name of one of ours.
        distance_power: exponent of the distance in a step's cost.
        min_traversability: minimum λ̂ of motion.
        fields: number of λ fields of a rollout, with risk on the cost.
        motions: whether `one` field of λ scales both motions of a rollout, or `two`
            independent ones do.
        off_map: whether a rollout off the map incurs the `penalty` of non-free cells,
            or only stands `still`.
    """

    mppi: MPPIConfig = THEIR_MPPI
    risk_map: Literal["exact", "histogram"] = "exact"
    objective: str = "theirs"
    distance_power: int = 1
    min_traversability: float = 0.01
    fields: int = 64
    motions: Literal["one", "two"] = "one"
    off_map: Literal["penalty", "still"] = "penalty"

    def __post_init__(self) -> None:
        """Check that rollouts on two fields have their objective."""
        expect(
            self.motions == "one" or self.objective == "theirs",
            f"`objective` 'theirs' with `motions` 'two', got {self.objective!r}. Set "
            "`motions` to 'one'.",
        )


def predict(vegetation: np.ndarray) -> TraversabilityMixture:
    """Return the true distribution of traction, which their and our planners are given.

    Args:
        vegetation: mask of vegetation, shape [B, 9, 9].

    Returns:
        Point masses, with parameters of shape [B, 100, 9, 9].
    """
    atoms = atoms_by_cell(vegetation, VEGETATION.slices(), DIRT.slices())
    return TraversabilityMixture(
        torch.full_like(atoms, 1 / SLICES), atoms, torch.zeros_like(atoms)
    )


def atoms_by_cell(
    vegetation: np.ndarray, of_vegetation: np.ndarray, of_dirt: np.ndarray
) -> Tensor:
    """Return the point masses of each cell, shape [B, N, 9, 9].

    Args:
        vegetation: mask of vegetation, shape [B, 9, 9].
        of_vegetation: point masses of vegetation, shape [N].
        of_dirt: point masses of dirt, shape [N].
    """
    atoms = np.where(
        vegetation[:, None], of_vegetation[:, None, None], of_dirt[:, None, None]
    )
    return torch.from_numpy(atoms).float()


def planner_config(setting: str, setup: Setup) -> MPPIConfig:
    """Return the setup's planner settings, with risk on the cost if `setting` has it."""
    if not setting.startswith(_COST):
        return setup.mppi
    return replace(
        setup.mppi,
        risk_on="cost",
        level=round(1 - tail_fraction_of(setting), 9),
        fields=setup.fields,
    )


def pose(
    vegetation: np.ndarray,
    settings: Sequence[str],
    setup: Setup,
    names: Sequence[int] | None = None,
) -> Problem:
    """Return the problem of all maps under all risk settings.

    Args:
        vegetation: mask of vegetation, shape [D, 9, 9].
        settings: S risk settings, such as `mean` or `cvar:0.8`.
        setup: settings of planning.
        names: keys of the D maps' λ fields; if None, the indices of the maps.

    Returns:
        A problem of D·S episodes, ordered by map and then by setting.
    """
    mixture = predict(vegetation)
    risk_maps = [
        infer_risk(setting, vegetation, mixture, setup) for setting in settings
    ]
    map_index = torch.arange(len(vegetation)).repeat_interleave(len(settings))
    trials, mixture = len(map_index), mixture.select(map_index)
    names = range(len(vegetation)) if names is None else names
    atoms = mixture.means
    if setup.risk_map == "histogram":
        atoms = atoms_by_cell(
            vegetation, VEGETATION.histogram_atoms(), DIRT.histogram_atoms()
        )[map_index]
    fields = CellFields(atoms, tuple(names[index] for index in map_index.tolist()))
    flat = torch.zeros(trials, *GRID.shape)
    rules = Rules(
        free_space=FreeSpace(by="mean", above=0.0),
        min_traversability=setup.min_traversability,
        goal_radius_m=GOAL_RADIUS_M,
    )
    observation = Observation(
        flat[:, None].expand(-1, 3, -1, -1).to(torch.uint8), flat, flat, GRID
    )
    return pose_problem(
        Task(robot=ROVER, objective=choose_objective(setup), rules=rules),
        Prediction(
            observation,
            mixture,
            torch.stack(risk_maps, dim=1).flatten(0, 1),
            fields=fields,
        ),
        torch.tensor(START_M).expand(trials, 2),
        torch.tensor(GOAL_M).expand(trials, 2),
        STEPS * ROVER.dt_s,
    )


def infer_risk(
    setting: str, vegetation: np.ndarray, mixture: TraversabilityMixture, setup: Setup
) -> Tensor:
    """Return λ̂ of a risk setting, shape [D, 9, 9]; with risk on the cost, the mean."""
    setting = "mean" if setting.startswith(_COST) else setting
    if setup.risk_map == "exact":
        return risk.apply(registry.make("risk", setting), mixture)
    tail_fraction = tail_fraction_of(setting)
    risk_map = np.where(
        vegetation,
        VEGETATION.histogram_cvar(tail_fraction),
        DIRT.histogram_cvar(tail_fraction),
    )
    return torch.from_numpy(risk_map).float()


def tail_fraction_of(setting: str) -> float:
    """Return their α: 1 − level, or 1 for settings without a level."""
    level = setting.partition(":")[2]
    return round(1 - float(level or 0), 9)


def choose_objective(setup: Setup) -> Objective:
    """Return the objective of a setup."""
    if setup.objective == "theirs":
        return TimeAndDistance(setup.distance_power)
    return registry.make(
        "objective", setup.objective, robot=ROVER, goal_radius_m=GOAL_RADIUS_M
    )
