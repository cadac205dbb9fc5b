"""What is drawn of a plan, once for figures and playback.

Letters in shapes: N points.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

DRAW_EVERY_S = 0.5


@dataclass(frozen=True, kw_only=True)
class DrawnPlan:
    """What a planner had in mind at one step of one episode.

    Args:
        step: the step.
        lines: by layer its polylines, (x, y) in metres, each of shape [N, 2] with N ≥ 2.
    """

    step: int
    lines: Mapping[str, Sequence[np.ndarray]]


@dataclass(frozen=True, kw_only=True)
class LayerStyle:
    """How a layer is drawn.

    Args:
        label: what a legend calls it.
        colour: red, green, blue, opacity, in [0, 255].
        width: over the thinnest line's.
        dashed: where lines can be.
    """

    label: str
    colour: tuple[int, int, int, int]
    width: float
    dashed: bool = False


# From the undermost layer to the topmost.
STYLES: Mapping[str, LayerStyle] = {
    "tree": LayerStyle(label="tree", colour=(60, 60, 60, 140), width=1),
    "samples": LayerStyle(label="samples", colour=(120, 180, 255, 110), width=1),
    "reference": LayerStyle(label="reference path", colour=(40, 90, 255, 255), width=3, dashed=True),
    "path": LayerStyle(label="planned", colour=(0, 0, 140, 255), width=3),
}


def drawn_plan(step: int, layers: Mapping[str, Tensor]) -> DrawnPlan:
    """Keeps of a plan what can be drawn: points that are numbers, lines of at least two of them.

    Args:
        step: when it was planned.
        layers: from `Plan.lines`, polylines of shape [lines, N, 2] by layer; unused points are NaN.
    """
    lines = {}
    for name, layer in layers.items():
        kept = [line[np.isfinite(line).all(axis=1)] for line in layer.detach().cpu().numpy()]
        lines[name] = [line for line in kept if len(line) > 1]
    return DrawnPlan(step=step, lines=lines)


def drawing_interval(dt_s: float) -> int:
    """Steps from one plan that is drawn to the next."""
    return max(1, round(DRAW_EVERY_S / dt_s))
