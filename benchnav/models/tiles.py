"""Predicts maps that are too large to be predicted whole, tile by tile.

A tile is predicted with a margin on each side that is as wide as the model looks, and
the margin is then cut off. What is left is the prediction of the whole map to within
1e-5. A network that pools by 2, 4, …, 32 cells meets the same pools where tiles begin
at multiples of 32. How far a model looks is measured on itself, so that nothing is to
be known
of it. Letters in shapes: B maps, H×W cells of a map, h×w cells of a tile.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from itertools import pairwise, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.batch import map_tensors
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError, expect
from benchnav.core.store import replacing
from benchnav.core.terrain import Observation, take_cells
from benchnav.models.base import TraversabilityModel, predict_observation

_STRIDE = 32
_PROBES = (256, 512, 1024)  # sides of the maps that a model is tried on
_NEGLIGIBLE = 1e-6  # a tenth of what tiles may be off


class Window(NamedTuple):
    """A rectangle of cells; `values[..., *window]` are those of an array of shape [*B,
    H, W].

    Attributes:
        rows: from the first to behind the last.
        columns: likewise.
    """

    rows: slice
    columns: slice


def predict_tiles(
    model: TraversabilityModel,
    observation: Observation,
    tile: int = 1024,
    margin: int | None = None,
) -> Iterator[tuple[Window, TraversabilityDistribution]]:
    """Predicts a map tile by tile, one more each time the next is asked for.

    Args:
        model: any model that is not privileged.
        observation: B maps of any size.
        tile: most cells along a side of a tile without its margin, at least 64.
        margin: cells that are predicted on each side of a tile and cut off; None
            measures it, see `measure_margin`.

    Returns:
        Windows that cover the map without overlap, row by row, each with the
        distribution in it, of shape [B, h, w].

    Raises:
        ConfigError: the settings are none, the model looks too far, or its answer does
            not fit the maps.
    """
    expect(tile >= 2 * _STRIDE, f"`tile` of at least {2 * _STRIDE} cells, got {tile}.")
    expect(
        margin is None or margin >= 0, f"`margin` of no cells or more, got {margin}."
    )
    rows, columns = (_cut_side(side, tile) for side in observation.grid.shape)
    if margin is None:
        margin = (
            0 if len(rows) == len(columns) == 1 else measure_margin(model, observation)
        )
    return (
        (window, _predict_window(model, observation, window, margin))
        for window in (Window(*sides) for sides in product(rows, columns))
    )


def write_risk_maps(
    model: TraversabilityModel,
    observation: Observation,
    measures: Mapping[str, Callable[[Any], Tensor]],
    folder: str | Path,
    tile: int = 1024,
    margin: int | None = None,
) -> dict[str, Path]:
    """Writes maps of what a model predicts, tile by tile, for planners or other
    programs.

    `numpy.load(path, mmap_mode="r")` reads a part of one without the rest. Files of
    these names are replaced, each when all are whole.

    Args:
        model: any model that is not privileged.
        observation: B maps of any size.
        measures: by name what is to be written of the predicted distribution, of shape
            [B, h, w]; for example `{"cvar:0.9": lambda distribution:
            distribution.cvar(0.9)}`, or a risk measure of `benchnav.planning.risk`.
        folder: where; it is made.
        tile: as in `predict_tiles`.
        margin: as in `predict_tiles`.

    Returns:
        By name the file: `NAME.npy` with `-` for `:`, float32, shape [B, H, W].

    Raises:
        ConfigError: as in `predict_tiles`, or a measure gives something else.
    """
    paths = {name: Path(folder) / f"{name.replace(':', '-')}.npy" for name in measures}
    expect(
        len(set(paths.values())) == len(paths),
        f"names of different files, got {list(measures)}.",
    )
    tiles = predict_tiles(model, observation, tile, margin)
    shape = (len(observation.rgb), *observation.grid.shape)
    with ExitStack() as files:
        maps = {
            name: np.lib.format.open_memmap(
                files.enter_context(replacing(path)),
                mode="w+",
                dtype=np.float32,
                shape=shape,
            )
            for name, path in paths.items()
        }
        for window, distribution in tiles:
            for name, measure in measures.items():
                target, values = maps[name][:, *window], measure(distribution)
                got = (
                    list(values.shape)
                    if isinstance(values, Tensor)
                    else type(values).__name__
                )
                expect(
                    got == list(target.shape),
                    f"measure {name!r} to give a tensor of shape "
                    f"{list(target.shape)}, got {got}.",
                )
                target[...] = values.cpu()
        for written in maps.values():
            written.flush()
    return paths


def measure_margin(model: TraversabilityModel, observation: Observation) -> int:
    """Measures how far a model looks around a cell, by predicting maps with and without
    what lies beyond an edge.

    A map is predicted whole, and again without its first and without its last 32 rows
    and columns. The farthest cell from the edge whose parameters differ by more than
    rounding says how far the model looks. The maps tried are the middle of the first
    map, and cells drawn from all over it; their side doubles from 256 to 1024 until the
    farthest cells differ by no more than 1e-6 (relatively, where parameters are above
    1).

    Args:
        model: any model that is not privileged.
        observation: maps like those that are to be predicted.

    Returns:
        Cells, a multiple of 32; 0 of a model that looks at each cell alone.

    Raises:
        ConfigError: the model looks farther than 960 cells, or pools by more than 32.
    """
    for side in _PROBES:
        margin = 0
        for probe in _probes(observation, side):
            reach = _reach(model, probe)
            if reach is None:
                break
            margin = max(margin, -(-reach // _STRIDE) * _STRIDE)
        else:
            return margin
    raise ConfigError(
        f"Expected a model that looks at most {_PROBES[-1] - 2 * _STRIDE} cells far "
        f"and pools by {_STRIDE} at most, "
        f"got {type(model).__name__}, whose tiles differ from the whole map. Predict "
        "the map whole, or give `margin`."
    )


def _cut_side(size: int, tile: int) -> list[slice]:
    """Cuts a side of a map into as few parts as there can be, of nearly equal length,
    at multiples of the stride.
    """
    blocks = -(-size // _STRIDE)
    parts = -(-blocks // (tile // _STRIDE))
    edges = [blocks * part // parts * _STRIDE for part in range(parts)]
    return [slice(*part) for part in pairwise([*edges, size])]


def _predict_window(
    model: TraversabilityModel, observation: Observation, window: Window, margin: int
) -> TraversabilityDistribution:
    outer = [
        slice(
            max(part.start - margin, 0) // _STRIDE * _STRIDE,
            min(-(-(part.stop + margin) // _STRIDE) * _STRIDE, size),
        )
        for part, size in zip(window, observation.grid.shape, strict=True)
    ]
    distribution = predict_observation(model, take_cells(observation, *outer))
    inner = Window(
        *(
            slice(part.start - edge.start, part.stop - edge.start)
            for part, edge in zip(window, outer, strict=True)
        )
    )
    return map_tensors(distribution, lambda values: values[..., *inner])


def _probes(observation: Observation, side: int) -> Iterator[Observation]:
    """The middle of the first map, repeated where the map is smaller, and cells from
    anywhere in it.
    """
    sizes, one = observation.grid.shape, observation.select(torch.tensor([0]))
    rows, columns = ((size - side) // 2 + torch.arange(side) for size in sizes)
    yield take_cells(one, rows[:, None] % sizes[0], columns % sizes[1])
    drawn = rng.uniform(
        rng.stream_key(0, "models", "margin"), np.arange(2), (side, side)
    )
    yield take_cells(
        one,
        *(
            torch.from_numpy((n * share).astype(int))
            for n, share in zip(sizes, drawn, strict=True)
        ),
    )


def _reach(model: TraversabilityModel, probe: Observation) -> int | None:
    """How many cells from an edge a prediction differs from that of a map that goes on
    there; None where all do.

    What is left in the farthest corner is rounding, which depends on the size of a map.
    """
    whole, side = predict_observation(model, probe), probe.grid.height
    row = torch.arange(side - _STRIDE, device=probe.rgb.device)
    distance = torch.minimum(row[:, None], row).flatten()
    worst = torch.zeros(len(row), dtype=torch.float64, device=row.device)
    for part, flip in (
        (slice(_STRIDE, side), []),
        (slice(0, side - _STRIDE), [-2, -1]),
    ):
        alone = predict_observation(model, take_cells(probe, part, part))
        there = map_tensors(whole, lambda values, part=part: values[..., part, part])
        difference = _difference(alone, there).flip(flip).flatten()
        worst = worst.scatter_reduce(0, distance, difference, "amax")
    rounding = worst[-_STRIDE:].max()
    if rounding > _NEGLIGIBLE:
        return None
    return int(((worst > rounding) * (row + 1)).max())


def _difference(
    one: TraversabilityDistribution, other: TraversabilityDistribution
) -> Tensor:
    """How far the parameters of two distributions of a map differ, relatively where
    above 1, float64 [H, W].
    """
    found: list[Tensor] = []

    def compare(values: Tensor, others: Tensor) -> Tensor:
        first, second = values.double().flatten(0, -3), others.double().flatten(0, -3)
        same = (first == second) | (first.isnan() & second.isnan())
        difference = (first - second).abs() / second.abs().clamp(min=1)
        found.append(
            torch.where(same, 0, difference.nan_to_num(torch.inf, torch.inf)).amax(0)
        )
        return values

    map_tensors(one, compare, other)
    return torch.stack(found).amax(0)
