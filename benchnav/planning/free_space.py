"""Ground that is not free, one rule for every planner; and what immobilises a robot.

S_free is where a map exceeds a threshold, and around the goal. A planner may cross
other ground at a high finite penalty, so that all planners face the same question and
there is a way where no free way is predicted. A planner that looks no farther than a
horizon, as MPPI does, may still wait before such ground. The λ̂ that motion and path
costs are given is at least `min_traversability`, so that a robot on ground predicted to
immobilise it can plan its way out. Beyond the paper, whose equation 2e forbids such
ground.
"""

from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import expect
from benchnav.core.grid import Grid

# Of a step, and of a metre, on ground that is not free; the paper's penalty a step.
# Higher than what any way over free ground costs.
PENALTY = 1e4
UNSEEN = ("prior", "optimistic", "pessimistic")
_LATER = {"unseen": "prior", "replan_every_s": 0.5}


@dataclass(frozen=True, kw_only=True)
class FreeSpace:
    """Which ground is free.

    Args:
        by: `risk`, the map λ̂ of the risk setting, or `mean`, E[λ] of the prediction.
        above: a cell is free where that map exceeds this; the paper's λ_stuck.
    """

    by: str = "risk"
    above: float = 0.3

    def __post_init__(self) -> None:
        """Refuses rules that mean nothing."""
        expect(
            self.by in ("risk", "mean"),
            f"`free_space.by` 'risk' or 'mean', got {self.by!r}.",
        )
        expect(0 <= self.above < 1, f"`free_space.above` in [0, 1), got {self.above}.")

    @property
    def source(self) -> str:
        """Field of a `Problem` that decides which cells are free."""
        return "risk_map" if self.by == "risk" else "distribution"

    def mask(
        self, risk_map: Tensor, distribution: TraversabilityDistribution
    ) -> Tensor:
        """Tells which cells are free, bool [B, H, W], from λ̂ [B, H, W] and the
        prediction.
        """
        return (risk_map if self.by == "risk" else distribution.mean()) > self.above


@dataclass(frozen=True, kw_only=True)
class Rules:
    """The rules of a task that are neither robot nor objective; the defaults are the
    paper's.

    Args:
        free_space: which ground is free.
        min_traversability: least λ̂ that motion and path costs are given.
        goal_radius_m: a robot this near to the goal has arrived.
        unseen: what is believed of ground that was not seen yet: `prior`, the λ of all
            training maps; `optimistic`, λ of 1; `pessimistic`, the mean of the worst
            fifth of the prior, never closed.
        replan_every_s: time between two updates of what a robot knows.
    """

    free_space: FreeSpace = FreeSpace()
    min_traversability: float = 0.3
    goal_radius_m: float = 1.0
    unseen: str = "prior"
    replan_every_s: float = 0.5

    def __post_init__(self) -> None:
        """Refuses rules under which nothing moves or arrives."""
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

    def free(
        self,
        risk_map: Tensor,
        distribution: TraversabilityDistribution,
        seen: Tensor | None = None,
    ) -> Tensor:
        """Tells which cells are free, bool [B, H, W], without those at the goal.

        Args:
            risk_map: λ̂, shape [B, H, W].
            distribution: what is believed of λ, shape [B, H, W].
            seen: which cells were seen, bool, shape [B, H, W]; None for all.
                `pessimistic` closes no other.
        """
        free = self.free_space.mask(risk_map, distribution)
        return free if seen is None or self.unseen != "pessimistic" else free | ~seen

    def to_dict(self) -> dict[str, Any]:
        """As plain data for JSON; what came with later versions is left out where it
        stands at its default.
        """
        later = {
            name: value
            for name, value in _LATER.items()
            if getattr(self, name) == value
        }
        return {
            name: value for name, value in asdict(self).items() if name not in later
        }


@dataclass(frozen=True, kw_only=True)
class Immobile:
    """What immobilises a robot.

    Args:
        below: observed λ under this immobilises a robot.
        for_s: an episode ends after so many seconds in a row on such ground, whatever
            was commanded.
    """

    below: float = 0.1
    for_s: float = 2.0

    def __post_init__(self) -> None:
        """Refuses rules that always or never immobilise."""
        expect(0 < self.below <= 1, f"`immobile.below` in (0, 1], got {self.below}.")
        expect(
            0 < self.for_s < float("inf"),
            f"`immobile.for_s` > 0 and finite, got {self.for_s}.",
        )


def cells_at_goal(grid: Grid, goal_m: Tensor, radius_m: float) -> Tensor:
    """Cells that the goal's disc touches, bool [B, H, W], from goals (x, y) [B, 2]."""
    rows = torch.arange(grid.height, device=goal_m.device)
    columns = torch.arange(grid.width, device=goal_m.device)
    x, y = grid.centre_of(rows, columns)
    half = grid.resolution_m / 2
    beside_x = ((x - goal_m[:, :1]).abs() - half).clamp(min=0)
    beside_y = ((y - goal_m[:, 1:]).abs() - half).clamp(min=0)
    return torch.hypot(beside_x[:, None, :], beside_y[:, :, None]) < radius_m
