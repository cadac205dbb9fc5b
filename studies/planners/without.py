"""Ablations of A\\*+DWA and CL-RRT, for the suite `without.yaml`."""

from dataclasses import replace
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from benchnav.planning import CLRRT, AStarDWA
from benchnav.planning.planners.astar import guided


def farthest(ground: Any, points: Tensor, lookahead_m: float) -> tuple[Tensor, Tensor]:
    """Return the farthest waypoint within the look-ahead, without a check of the line.

    The second value says that the line to it is free, for all episodes.
    """
    along_m = torch.linalg.vector_norm(points.diff(dim=1), dim=2).cumsum(dim=1)
    index = torch.where(along_m <= lookahead_m, torch.arange(along_m.shape[1]), 0).amax(
        dim=1
    )
    target = points[:, 1:].gather(1, index[:, None, None].expand(-1, 1, 2))[:, 0]
    return target, torch.ones(len(points), dtype=torch.bool)


class NoLines(AStarDWA):
    """A\\*+DWA that follows the farthest point of its path within the look-ahead."""

    def plan(self, step: Any, plan_state: Any) -> Any:
        with patch.object(guided, "choose_waypoint", farthest):
            return super().plan(step, plan_state)


class NoHalving(CLRRT):
    """CL-RRT that does not halve its turning radius after a failure."""

    def _closed_loop(self, *arguments: Any) -> Any:
        loop = super()._closed_loop(*arguments)
        return replace(
            loop, radius_m=torch.full_like(loop.radius_m, self.config.turning_radius_m)
        )
