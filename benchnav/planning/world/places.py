"""Places: where episodes begin and end, and whether ground joins the two.

Letters in shapes: B episodes, H×W cells.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import label
from torch import Tensor

from benchnav.core.grid import Grid
from benchnav.planning.problem import Batch


@dataclass(frozen=True, kw_only=True)
class Places(Batch):
    """Where episodes begin and end.

    Args:
        start_m: (x, y), shape [B, 2].
        goal_m: (x, y), shape [B, 2].
        reference_time_s: grid reference times at 1 m/s, NaN where there is none, shape [B].
    """

    start_m: Tensor
    goal_m: Tensor
    reference_time_s: Tensor


def joined(ground: Tensor, grid: Grid, places: Places) -> Tensor:
    """Tells in which episodes ground joins start and goal, from cell to cell over shared edges.

    Cells that touch at a corner alone are no way for a robot.

    Args:
        ground: where a robot can go, bool, shape [B, H, W].
        grid: size and resolution.
        places: starts and goals.

    Returns:
        bool, shape [B].
    """
    answers = np.zeros(len(ground), dtype=bool)
    starts, goals = _cells(grid, places.start_m), _cells(grid, places.goal_m)
    for b, (start, goal) in enumerate(zip(starts, goals, strict=True)):
        parts, _ = label(ground[b].cpu().numpy())
        answers[b] = parts[start] > 0 and parts[start] == parts[goal]
    return torch.from_numpy(answers).to(ground.device)


def _cells(grid: Grid, position_m: Tensor) -> list[tuple[int, int]]:
    row, column = grid.cell_of(position_m[:, 0], position_m[:, 1])
    return list(zip(row.tolist(), column.tolist(), strict=True))
