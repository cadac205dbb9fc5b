"""What is drawn of a plan, once for figures and playback.

Letters in shapes: N points.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

DRAW_EVERY_S = 0.5
# Of a layer of a plan in a recording: keeps long episodes of planners with many thoughts within 3 MB.
MOST_POINTS = 160


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


def thinned(plan: DrawnPlan) -> DrawnPlan:
    """Leaves out lines and points within lines where a layer has too many; what is thin stays as it is."""
    return DrawnPlan(step=plan.step, lines={name: _thinned(lines) for name, lines in plan.lines.items()})


def _thinned(lines: Sequence[np.ndarray]) -> list[np.ndarray]:
    lines = [lines[place] for place in _spread(len(lines), MOST_POINTS // 2)]
    most = MOST_POINTS // max(len(lines), 1)
    return [line[_spread(len(line), most)] for line in lines]


def _spread(count: int, most: int) -> np.ndarray:
    """Indices of so many, evenly spread, the first and the last among them; of all where they are few."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(int)


def join_plans(plans: Sequence[DrawnPlan]) -> dict[str, np.ndarray]:
    """Packs plans into few arrays, which `split_plans` takes apart.

    Args:
        plans: in order of steps.

    Returns:
        `steps`; by layer all points as `points/LAYER`, points of each line as `sizes/LAYER`, and lines of each
        plan as `counts/LAYER`.
    """
    arrays: dict[str, np.ndarray] = {"steps": np.array([plan.step for plan in plans], np.int64)}
    for name in dict.fromkeys(name for plan in plans for name in plan.lines):
        layers = [plan.lines.get(name, ()) for plan in plans]
        lines = [line for layer in layers for line in layer]
        arrays[f"points/{name}"] = np.concatenate([np.empty((0, 2), np.float32), *lines])
        arrays[f"sizes/{name}"] = np.array([len(line) for line in lines], np.int64)
        arrays[f"counts/{name}"] = np.array([len(layer) for layer in layers], np.int64)
    return arrays


def split_plans(arrays: Mapping[str, np.ndarray]) -> list[DrawnPlan]:
    """Takes apart what `join_plans` packed."""
    names = [name.removeprefix("points/") for name in arrays if name.startswith("points/")]
    layers = {
        name: cut(cut(arrays[f"points/{name}"], arrays[f"sizes/{name}"]), arrays[f"counts/{name}"])
        for name in names
    }
    return [
        DrawnPlan(step=int(step), lines={name: layers[name][place] for name in names})
        for place, step in enumerate(arrays["steps"])
    ]


def cut(values: Any, sizes: np.ndarray) -> list[Any]:
    """Cuts a sequence into consecutive pieces of given sizes."""
    ends = sizes.cumsum()
    return [values[end - size : end] for end, size in zip(ends, sizes, strict=True)]


def drawing_interval(dt_s: float) -> int:
    """Steps from one plan that is drawn to the next."""
    return max(1, round(DRAW_EVERY_S / dt_s))
