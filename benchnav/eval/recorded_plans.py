"""Plans and known maps of a recording, and their packing into few arrays.

Letters in shapes: H×W cells, P points.
"""

from collections.abc import Iterable, Mapping, Sequence, Sized
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from benchnav.core.grid import outline

# Maximum number of points in a layer of a plan; a recording of a long episode then has
# at most 3 MB.
MAX_POINTS = 160
# Fields of `KnownMap`. Files store numbers in steps of 1/255, and masks as bits.
NUMBERS = ("predicted", "mean", "spread")
_MASKS = ("free", "seen", "sensed")
_LEVELS = 255


@dataclass(frozen=True, kw_only=True)
class DrawnPlan:
    """The drawable plan of one step of an episode.

    Args:
        step: index of the step.
        lines: polylines by layer, (x, y) in metres, each of shape [P, 2] with P ≥ 2.
    """

    step: int
    lines: Mapping[str, Sequence[np.ndarray]]


@dataclass(frozen=True, kw_only=True)
class KnownMap:
    """Belief of a robot about its map from a step on.

    Args:
        step: first step at which the belief is valid.
        predicted: λ̂ by the risk setting, shape [H, W].
        free: free mask S_free, bool, shape [H, W].
        mean: E[λ] of the belief, shape [H, W].
        spread: half of the range from the 16 % to the 84 % quantile of λ, shape [H, W].
        seen: cells whose appearance has been observed, bool, shape [H, W].
        sensed: cells whose λ has been measured, bool, shape [H, W].
        outline: outline of the sensors' footprint at `step`, (x, y) in metres, shape
            [P, 2]; rows of NaN separate lines.
    """

    step: int
    predicted: np.ndarray
    free: np.ndarray
    mean: np.ndarray
    spread: np.ndarray
    seen: np.ndarray
    sensed: np.ndarray
    outline: np.ndarray

    @property
    def outlines(self) -> list[np.ndarray]:
        """The lines of the outline, each of shape [P, 2]."""
        is_separator = np.isnan(self.outline[:, 0])
        lines = []
        for line in np.split(self.outline, np.flatnonzero(is_separator)):
            points = line[~np.isnan(line[:, 0])]
            if len(points) > 1:
                lines.append(points)
        return lines


def footprint_outline(cells: np.ndarray, resolution_m: float) -> np.ndarray:
    """Return the outline of the sensors' footprint, as in `KnownMap.outline`.

    Args:
        cells: mask of cells in the footprint, bool, shape [H, W].
        resolution_m: edge length of a cell in metres.
    """
    edges = outline(cells, resolution_m)
    one_separator = ((0, 0), (0, 1), (0, 0))
    separated = np.pad(edges, one_separator, constant_values=np.nan)
    return separated.reshape(-1, 2)


def under(prefix: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values whose names start with a prefix; remove it from the names."""
    chosen = {}
    for name, value in values.items():
        if name.startswith(prefix):
            chosen[name.removeprefix(prefix)] = value
    return chosen


def drawn_plan(step: int, layers: Mapping[str, Tensor]) -> DrawnPlan:
    """Return the drawable part of a plan: finite points, on lines of at least two.

    Args:
        step: index of the step.
        layers: polylines by layer, as in `Plan.lines`, (x, y) in metres, each layer of
            shape [lines, P, 2]; unused points are NaN.
    """
    lines: dict[str, list[np.ndarray]] = {}
    for name, layer in layers.items():
        lines[name] = []
        for line in layer.detach().cpu().numpy():
            points = line[np.isfinite(line).all(axis=1)]
            if len(points) > 1:
                lines[name].append(points)
    return DrawnPlan(step=step, lines=lines)


def thinned(plan: DrawnPlan) -> DrawnPlan:
    """Return a plan with at most about `MAX_POINTS` points in each layer."""
    layers = {}
    for name, lines in plan.lines.items():
        shown = [lines[index] for index in _spread(len(lines), MAX_POINTS // 2)]
        max_points = MAX_POINTS // max(len(shown), 1)
        layers[name] = [line[_spread(len(line), max_points)] for line in shown]
    return DrawnPlan(step=plan.step, lines=layers)


def _spread(count: int, max_count: int) -> np.ndarray:
    """Return up to `max_count` evenly spread indices in [0, count - 1]."""
    n_indices = min(count, max_count)
    return np.linspace(0, count - 1, n_indices).round().astype(int)


def pack_plans(plans: Sequence[DrawnPlan]) -> dict[str, np.ndarray]:
    """Pack plans, in order of steps, into few arrays, which `unpack_plans` reads.

    Returns:
        Arrays by name: `plans:steps`, and for each layer `plans:points/LAYER` (all
        points), `plans:sizes/LAYER` (number of points of each line) and
        `plans:counts/LAYER` (number of lines of each plan).
    """
    arrays: dict[str, np.ndarray] = {}
    arrays["plans:steps"] = np.array([plan.step for plan in plans], np.int64)
    names = dict.fromkeys(name for plan in plans for name in plan.lines)
    no_points = np.empty((0, 2), np.float32)
    for name in names:
        layers = [plan.lines.get(name, ()) for plan in plans]
        lines = [line for layer in layers for line in layer]
        arrays[f"plans:points/{name}"] = np.concatenate([no_points, *lines])
        arrays[f"plans:sizes/{name}"] = _lengths(lines)
        arrays[f"plans:counts/{name}"] = _lengths(layers)
    return arrays


def _lengths(sequences: Iterable[Sized]) -> np.ndarray:
    return np.array([len(sequence) for sequence in sequences], np.int64)


def unpack_plans(arrays: Mapping[str, np.ndarray]) -> list[DrawnPlan]:
    """Return the plans that `pack_plans` packed; names have no prefix `plans:`."""
    layers = {}
    for name, points in under("points/", arrays).items():
        lines = _cut(points, arrays[f"sizes/{name}"])
        layers[name] = _cut(lines, arrays[f"counts/{name}"])
    plans = []
    for index, step in enumerate(arrays["steps"]):
        lines_by_layer = {name: lines[index] for name, lines in layers.items()}
        plans.append(DrawnPlan(step=int(step), lines=lines_by_layer))
    return plans


def _cut(values: Any, sizes: np.ndarray) -> list[Any]:
    """Split a sequence into consecutive slices of the given sizes."""
    ends = sizes.cumsum()
    starts = ends - sizes
    return [values[start:end] for start, end in zip(starts, ends, strict=True)]


def pack_known(known_maps: Sequence[KnownMap]) -> dict[str, np.ndarray]:
    """Pack known maps into few arrays, which `unpack_known` reads.

    Each map is stored as its difference from the previous map, which compresses well:
    most cells do not change.

    Returns:
        Arrays by name: `known:steps`; `known:NAME` for each name in `NUMBERS` (uint8)
        and each mask (bits); `known:outline` (points of all outlines) and `known:sizes`
        (number of points of each outline). Empty if there are no maps.
    """
    if not known_maps:
        return {}
    arrays: dict[str, np.ndarray] = {}
    arrays["known:steps"] = np.array([item.step for item in known_maps], np.int64)
    for name in NUMBERS:
        numbers = np.stack([getattr(item, name) for item in known_maps])
        levels = numbers.astype(np.float32).clip(0, 1) * _LEVELS
        bytes_ = levels.round().astype(np.uint8)
        # Differences are modulo 256; cumulative sums modulo 256 invert them.
        arrays[f"known:{name}"] = np.diff(bytes_, axis=0, prepend=np.uint8(0))
    for name in _MASKS:
        masks = np.stack([getattr(item, name) for item in known_maps])
        changed = np.diff(masks, axis=0, prepend=False)
        arrays[f"known:{name}"] = np.packbits(changed, axis=-1)
    outlines = [item.outline for item in known_maps]
    arrays["known:outline"] = np.concatenate(outlines).astype(np.float32)
    arrays["known:sizes"] = _lengths(outlines)
    return arrays


def unpack_known(arrays: Mapping[str, np.ndarray]) -> tuple[KnownMap, ...]:
    """Return the maps that `pack_known` packed; names have no prefix `known:`."""
    values = dict(arrays)
    width = values[NUMBERS[0]].shape[-1]
    for name in NUMBERS:
        levels = values[name].cumsum(axis=0, dtype=np.uint8)
        values[name] = levels.astype(np.float32) / _LEVELS
    for name in _MASKS:
        changed = np.unpackbits(values[name], axis=-1, count=width)
        values[name] = np.logical_xor.accumulate(changed.astype(bool), axis=0)
    outlines = _cut(values["outline"], values["sizes"])
    known_maps = []
    for index, (step, lines) in enumerate(zip(values["steps"], outlines, strict=True)):
        maps = {name: values[name][index] for name in (*NUMBERS, *_MASKS)}
        known_maps.append(KnownMap(step=int(step), outline=lines, **maps))
    return tuple(known_maps)
