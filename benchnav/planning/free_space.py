"""Rules of free space and of immobilisation, the same for all planners.

A cell is free if the value of a map in the cell exceeds a threshold, or if the cell is
within the goal radius. Other cells have a high finite penalty, whereas the paper's
equation 2e forbids them. Hence a path always exists, even if no free path is predicted.
A planner with a short horizon, such as MPPI, may still wait in front of non-free cells.

Motion and path costs use a λ̂ of at least `min_traversability`. Hence a robot can plan
a path out of terrain that is predicted to immobilise it.
"""

from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import expect
from benchnav.core.grid import Grid

PENALTY = 1e4
"""Penalty of each step, or of each metre, in non-free cells.

It exceeds the cost of any path over free terrain. The paper has the same penalty of a
step.
"""
IMMOBILE_BY = ("cell", "observed")
INFLATIONS = ("disc", "none")
UNSEEN = ("prior", "optimistic", "pessimistic")
_LATER = {"unseen": "prior", "replan_every_s": 0.5, "inflation": "disc"}


@dataclass(frozen=True, kw_only=True)
class FreeSpace:
    """Rule for free cells.

    Args:
        by: map that is compared with the threshold: `risk` for λ̂ of the risk setting,
            or `mean` for E[λ] of the prediction.
        above: threshold in [0, 1) that the map exceeds in free cells; λ_stuck in the
            paper.
    """

    by: str = "risk"
    above: float = 0.3

    def __post_init__(self) -> None:
        """Validate the rule."""
        expect(
            self.by in ("risk", "mean"),
            f"`free_space.by` 'risk' or 'mean', got {self.by!r}.",
        )
        expect(0 <= self.above < 1, f"`free_space.above` in [0, 1), got {self.above}.")

    @property
    def source(self) -> str:
        """Name of the field of a `Problem` from which free cells are derived."""
        return "risk_map" if self.by == "risk" else "distribution"

    def mask(
        self, risk_map: Tensor, distribution: TraversabilityDistribution
    ) -> Tensor:
        """Return the mask of free cells, bool, shape [B, H, W].

        Args:
            risk_map: λ̂ of the risk setting, shape [B, H, W].
            distribution: predicted distribution of λ, shape [B, H, W].
        """
        values = risk_map if self.by == "risk" else distribution.mean()
        return values > self.above


@dataclass(frozen=True, kw_only=True)
class Rules:
    """Rules of a task; the defaults are the paper's.

    Args:
        free_space: rule for free cells.
        min_traversability: minimum λ̂ of motion and path costs, in (0, 1].
        goal_radius_m: distance to the goal in metres below which a robot has reached
            it.
        unseen: assumption about λ of unobserved terrain. `prior`: the distribution of λ
            over all training maps. `optimistic`: λ = 1. `pessimistic`: the mean of the
            worst fifth of the prior; unobserved cells are nevertheless free.
        replan_every_s: time between two updates of a robot's belief, in seconds.
        inflation: how planners allow for the footprint of a robot. `disc`: λ̂ of a cell
            is the minimum of λ̂, and a cell is free if all cells are free, within the
            disc of the footprint around it. `none`: planners plan for a point.
    """

    free_space: FreeSpace = FreeSpace()
    min_traversability: float = 0.3
    goal_radius_m: float = 1.0
    unseen: str = "prior"
    replan_every_s: float = 0.5
    inflation: str = INFLATIONS[0]

    def __post_init__(self) -> None:
        """Validate the rules."""
        expect(
            0 < self.min_traversability <= 1,
            f"`min_traversability` in (0, 1], got {self.min_traversability}.",
        )
        expect(
            0 < self.goal_radius_m < float("inf"),
            f"`goal_radius_m` > 0 and finite, got {self.goal_radius_m}.",
        )
        expect(
            self.unseen in UNSEEN,
            f"`unseen` {', '.join(map(repr, UNSEEN[:-1]))} or {UNSEEN[-1]!r}, got "
            f"{self.unseen!r}.",
        )
        expect(
            0 < self.replan_every_s < float("inf"),
            f"`replan_every_s` > 0 and finite, got {self.replan_every_s}.",
        )
        expect(
            self.inflation in INFLATIONS,
            f"`inflation` {' or '.join(map(repr, INFLATIONS))}, got "
            f"{self.inflation!r}.",
        )

    def free(
        self,
        risk_map: Tensor,
        distribution: TraversabilityDistribution,
        seen: Tensor | None = None,
    ) -> Tensor:
        """Return the mask of free cells, before the cells at the goal are set free.

        Args:
            risk_map: λ̂, shape [B, H, W].
            distribution: distribution of λ, shape [B, H, W].
            seen: mask of observed cells, bool, shape [B, H, W]; None if all cells are
                observed. With `pessimistic`, all unobserved cells are free.

        Returns:
            Mask, bool, shape [B, H, W].
        """
        free = self.free_space.mask(risk_map, distribution)
        if seen is not None and self.unseen == "pessimistic":
            free = free | ~seen
        return free

    def to_dict(self) -> dict[str, Any]:
        """Return the rules as plain data for JSON.

        Settings that version 1 did not have are omitted if they have their defaults.
        """
        rules = asdict(self)
        for name, default in _LATER.items():
            if rules[name] == default:
                del rules[name]
        return rules


@dataclass(frozen=True, kw_only=True)
class Immobile:
    """Rule of immobilisation.

    Args:
        below: observed λ below which terrain immobilises a robot, in (0, 1].
        for_s: consecutive time in seconds on such terrain after which a robot is
            immobilised and its episode ends.
        by: `cell`, λ of the cell at the robot's position, whatever the robot commands;
            or `observed`, the achieved fraction of the commanded motion of its wheels.
            With `observed`, only steps that command wheel motion count.
    """

    below: float = 0.1
    for_s: float = 2.0
    by: str = "cell"

    def __post_init__(self) -> None:
        """Validate the rule."""
        expect(0 < self.below <= 1, f"`immobile.below` in (0, 1], got {self.below}.")
        expect(
            0 < self.for_s < float("inf"),
            f"`immobile.for_s` > 0 and finite, got {self.for_s}.",
        )
        expect(
            self.by in IMMOBILE_BY,
            f"`immobile.by` {' or '.join(map(repr, IMMOBILE_BY))}, got {self.by!r}.",
        )


def cells_at_goal(grid: Grid, goal_m: Tensor, radius_m: float) -> Tensor:
    """Return a mask of cells with a point nearer to the goal than a radius.

    Args:
        grid: grid of the maps.
        goal_m: goals (x, y) in metres, shape [B, 2].
        radius_m: radius in metres.

    Returns:
        Mask, bool, shape [B, H, W].
    """
    rows = torch.arange(grid.height, device=goal_m.device)
    columns = torch.arange(grid.width, device=goal_m.device)
    x, y = grid.centre_of(rows, columns)
    half = grid.resolution_m / 2
    gap_x = ((x - goal_m[:, :1]).abs() - half).clamp(min=0)
    gap_y = ((y - goal_m[:, 1:]).abs() - half).clamp(min=0)
    distance_m = torch.hypot(gap_x[:, None, :], gap_y[:, :, None])
    return distance_m < radius_m
