"""The task of Cai et al. as a `Problem`: their robot, cost and rules, and what is
predicted of the ground.

Letters in shapes: B trials, K components, *B any leading dimensions.
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
    """Their unicycle, which stays where it has arrived: a rollout of theirs ends at the
    goal.
    """

    speed_mps: tuple[float, float] = (0.0, 3.0)
    turn_rate_radps: tuple[float, float] = (-np.pi, np.pi)

    def __call__(self, state: Tensor, action: Tensor, traversability: Tensor) -> Tensor:
        """Advances one time step; see `Robot`."""
        away = distance(state, state.new_tensor(GOAL_M)) > GOAL_RADIUS_M
        return super().__call__(state, action, traversability * away)


ROVER = Rover()


@dataclass(frozen=True)
class TimeAndDistance(Objective):
    """Their cost: dt + distance at each step until arrival, and the time for what is
    left at a crawl.

    They count a step by the state after it. Here the state before it is counted, and
    the last one at the end, which differs by what the start costs: the same for all
    rollouts.

    Args:
        power: of the distance in a step's cost.
    """

    power: int = 1

    def stage(
        self, state: Tensor, action: Tensor, traversability: Tensor, target: Tensor
    ) -> Tensor:
        """Cost of one step; see `Objective`."""
        away = distance(state, target)
        return (ROVER.dt_s + away**self.power) * (away > GOAL_RADIUS_M)

    def terminal(self, state: Tensor, traversability: Tensor, target: Tensor) -> Tensor:
        """Cost of the last state; see `Objective`."""
        away = distance(state, target)
        return (
            ROVER.dt_s
            + away**self.power
            + away / _LAST_SPEED_MPS * (away > GOAL_RADIUS_M)
        )


@dataclass(frozen=True)
class CellFields:
    """Draws fields of independent cells from equally likely point masses: a
    `FieldSource`.

    Args:
        atoms: N values of λ for each cell, shape [B, N, 9, 9].
        names: of the trials, by which their fields are drawn; trials of one name have
            the same.
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
        """Keeps some trials, by index, int64."""
        return CellFields(
            self.atoms[members], tuple(self.names[place] for place in members.tolist())
        )


@dataclass(frozen=True, kw_only=True)
class Setup:
    """How it is planned; the defaults are theirs.

    Args:
        mppi: settings of the planner.
        risk_map: `exact`, by our risk settings, or `histogram`, by their binning and
            rounding; fields of λ likewise.
        objective: `theirs`, or one of ours by name.
        distance_power: of the distance in a step's cost.
        min_traversability: least λ̂ that motion is given.
        fields: on which sequences are rolled out where the risk is that of the cost.
        motions: whether `one` field of λ serves both motions of a rollout, or `two`
            independent ones.
        off_map: whether a rollout off the map pays the `penalty` of ground that is not
            free, or is only `still`.
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
        """Refuse two fields under an objective that rollouts on them do not have."""
        expect(
            self.motions == "one" or self.objective == "theirs",
            f"`objective` 'theirs' with `motions` 'two', got {self.objective!r}.",
        )


def predict(vegetation: np.ndarray) -> TraversabilityMixture:
    """The true distribution of traction in each cell, which planners of both sides are
    given.

    Args:
        vegetation: where it grows, bool, shape [B, 9, 9].

    Returns:
        Point masses, parameters of shape [B, 100, 9, 9].
    """
    atoms = atoms_by_cell(vegetation, VEGETATION.slices(), DIRT.slices())
    return TraversabilityMixture(
        torch.full_like(atoms, 1 / SLICES), atoms, torch.zeros_like(atoms)
    )


def atoms_by_cell(
    vegetation: np.ndarray, of_vegetation: np.ndarray, of_dirt: np.ndarray
) -> Tensor:
    """Return the N point masses of each cell's ground, shape [B, N, 9, 9], from
    vegetation [B, 9, 9].
    """
    atoms = np.where(
        vegetation[:, None], of_vegetation[:, None, None], of_dirt[:, None, None]
    )
    return torch.from_numpy(atoms).float()


def planner_config(setting: str, setup: Setup) -> MPPIConfig:
    """Settings of the planner under a risk setting: the setup's own, with risk on the
    cost where that is asked for.
    """
    if not setting.startswith(_COST):
        return setup.mppi
    return replace(
        setup.mppi,
        risk_on="cost",
        level=round(1 - tail_share(setting), 9),
        fields=setup.fields,
    )


def pose(
    vegetation: np.ndarray,
    settings: Sequence[str],
    setup: Setup,
    names: Sequence[int] | None = None,
) -> Problem:
    """Poses the trials of some maps under some risk settings.

    Fields of λ are drawn cell by cell.

    Args:
        vegetation: where it grows on D maps, bool, shape [D, 9, 9].
        settings: S of them, such as `mean` or `cvar:0.8`.
        setup: how it is planned.
        names: of the D maps, by which fields of λ are drawn; their places if they are
            not given.

    Returns:
        D·S trials, all settings of the first map first.
    """
    mixture = predict(vegetation)
    risk_maps = [
        infer_risk(setting, vegetation, mixture, setup) for setting in settings
    ]
    each = torch.arange(len(vegetation)).repeat_interleave(len(settings))
    trials, mixture = len(each), mixture.select(each)
    names = range(len(vegetation)) if names is None else names
    atoms = mixture.means
    if setup.risk_map == "histogram":
        atoms = atoms_by_cell(
            vegetation, VEGETATION.histogram_atoms(), DIRT.histogram_atoms()
        )[each]
    fields = CellFields(atoms, tuple(names[place] for place in each.tolist()))
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
    """λ̂ of one risk setting, shape [D, 9, 9]; the mean where the risk is that of the
    cost.
    """
    setting = "mean" if setting.startswith(_COST) else setting
    if setup.risk_map == "exact":
        return risk.apply(registry.make("risk", setting), mixture)
    share = tail_share(setting)
    risk_map = np.where(
        vegetation, VEGETATION.histogram_cvar(share), DIRT.histogram_cvar(share)
    )
    return torch.from_numpy(risk_map).float()


def tail_share(setting: str) -> float:
    """Return their α: 1 for `mean` and `cost`, 1 − level for `cvar:level` and
    `cost-cvar:level`.
    """
    level = setting.partition(":")[2]
    return round(1 - float(level or 0), 9)


def choose_objective(setup: Setup) -> Objective:
    """J of a setup."""
    if setup.objective == "theirs":
        return TimeAndDistance(setup.distance_power)
    return registry.make(
        "objective", setup.objective, robot=ROVER, goal_radius_m=GOAL_RADIUS_M
    )
