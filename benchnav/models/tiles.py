"""Tile-by-tile prediction of maps that are too large to be predicted whole.

A tile is predicted with a margin on each side as wide as the model's receptive field;
the margin is then cut off. The result differs from the prediction of the whole map by at
most 1e-5. A network that pools by 2, 4, …, 32 cells has the same pools if tiles start at
multiples of 32. The receptive field need not be known: it is measured by predictions.
Letters in shapes: B maps, H×W cells of a map, h×w cells of a tile.
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

_STRIDE = 32  # tiles with their margins start at multiples of this number of cells
_PROBES = (256, 512, 1024)  # sides of the maps on which a model is probed
_NEGLIGIBLE = 1e-6  # a tenth of the error bound of tiles


class Window(NamedTuple):
    """A rectangle of cells; `values[..., *window]` cuts it out of an array [*B, H, W].

    Attributes:
        rows: rows of the map.
        columns: columns of the map.
    """

    rows: slice
    columns: slice


def predict_tiles(
    model: TraversabilityModel,
    observation: Observation,
    tile: int = 1024,
    margin: int | None = None,
) -> Iterator[tuple[Window, TraversabilityDistribution]]:
    """Predict maps tile by tile; each tile is predicted when the iterator reaches it.

    Args:
        model: any model that is not privileged.
        observation: B maps of any size.
        tile: maximum side of a tile without its margin, in cells, at least 64.
        margin: width of the margin in cells, at least 0; None to measure it with
            `measure_margin`.

    Returns:
        Windows that cover the map without overlap, row by row, each with its
        distribution of shape [B, h, w].

    Raises:
        ConfigError: If a setting is invalid, the receptive field of the model is too
            large, or its prediction has the wrong type or shape.
    """
    expect(tile >= 2 * _STRIDE, f"`tile` of at least {2 * _STRIDE} cells, got {tile}.")
    expect(
        margin is None or margin >= 0, f"`margin` of at least 0 cells, got {margin}."
    )
    height, width = observation.grid.shape
    rows = _cut_side(height, tile)
    columns = _cut_side(width, tile)
    if margin is None:
        is_single = len(rows) == len(columns) == 1
        margin = 0 if is_single else measure_margin(model, observation)
    windows = (Window(*sides) for sides in product(rows, columns))
    return (
        (window, _predict_window(model, observation, window, margin))
        for window in windows
    )


def write_risk_maps(
    model: TraversabilityModel,
    observation: Observation,
    measures: Mapping[str, Callable[[Any], Tensor]],
    folder: str | Path,
    tile: int = 1024,
    margin: int | None = None,
) -> dict[str, Path]:
    """Write one map per measure of a prediction, tile by tile, for other programs.

    `numpy.load(path, mmap_mode="r")` opens a map without reading all of it. Existing
    files of the same names are replaced when all maps are complete.

    Args:
        model: any model that is not privileged.
        observation: B maps of any size.
        measures: functions of the predicted distribution, of shape [B, h, w], by name;
            for example `{"cvar:0.9": lambda distribution: distribution.cvar(0.9)}`, or
            a risk measure of `benchnav.planning.risk`.
        folder: output folder, which need not exist.
        tile: maximum side of a tile, as in `predict_tiles`.
        margin: width of the margin, as in `predict_tiles`.

    Returns:
        Path of the file of each measure by name: `NAME.npy` with `-` for `:`, float32,
        shape [B, H, W].

    Raises:
        ConfigError: As in `predict_tiles`, or if a measure returns a tensor of the wrong
            shape.
    """
    paths = {name: Path(folder) / f"{name.replace(':', '-')}.npy" for name in measures}
    expect(
        len(set(paths.values())) == len(paths),
        f"`measures` with different file names, got {list(measures)}. In file names, "
        "`:` becomes `-`. Rename one of the measures.",
    )
    tiles = predict_tiles(model, observation, tile, margin)
    shape = (len(observation.rgb), *observation.grid.shape)
    with ExitStack() as files:
        maps = {}
        for name, path in paths.items():
            partial = files.enter_context(replacing(path))
            maps[name] = np.lib.format.open_memmap(
                partial, mode="w+", dtype=np.float32, shape=shape
            )
        for window, distribution in tiles:
            for name, measure in measures.items():
                target = maps[name][:, *window]
                values = measure(distribution)
                result: Any = type(values).__name__
                if isinstance(values, Tensor):
                    result = list(values.shape)
                expect(
                    result == list(target.shape),
                    f"measure {name!r} to return a tensor of shape "
                    f"{list(target.shape)}, got {result}.",
                )
                target[...] = values.cpu()
        for risk_map in maps.values():
            risk_map.flush()
    return paths


def measure_margin(model: TraversabilityModel, observation: Observation) -> int:
    """Measure how far around a cell a model's prediction depends on the map.

    A probe map is predicted whole, then without its first 32 rows and columns, and then
    without its last 32. The receptive field is the distance from the cropped edge of the
    farthest cell whose parameters differ by more than rounding. There are two probe maps:
    the centre of the first map, and cells drawn at random from the first map. Their side
    doubles from 256 to 1024 until the cells farthest from the edge differ by at most 1e-6
    (relatively, for parameters above 1).

    Args:
        model: any model that is not privileged.
        observation: maps similar to those to predict.

    Returns:
        Width in cells, a multiple of 32; 0 for a model that predicts each cell
        independently.

    Raises:
        ConfigError: If the receptive field exceeds 960 cells, or the model pools by
            more than 32.
    """
    for side in _PROBES:
        margins = []
        for probe in _probes(observation, side):
            distance = _max_changed_distance(model, probe)
            if distance is None:
                break
            margins.append(-(-distance // _STRIDE) * _STRIDE)
        else:
            return max(margins)
    raise ConfigError(
        "Expected a model whose receptive field extends at most "
        f"{_PROBES[-1] - 2 * _STRIDE} cells around a cell and that pools by at most "
        f"{_STRIDE}, got {type(model).__name__}, whose predictions of tiles differ "
        "from the prediction of the whole map. Predict the whole map at once, or give "
        "`margin`."
    )


def _cut_side(size: int, tile: int) -> list[slice]:
    """Cut a side of a map at multiples of the stride into few parts of similar size."""
    blocks = -(-size // _STRIDE)
    parts = -(-blocks // (tile // _STRIDE))
    edges = [blocks * part // parts * _STRIDE for part in range(parts)]
    return [slice(*part) for part in pairwise([*edges, size])]


def _predict_window(
    model: TraversabilityModel, observation: Observation, window: Window, margin: int
) -> TraversabilityDistribution:
    """Return the prediction of a window, computed with a margin."""
    outer = []
    inner = []
    for part, size in zip(window, observation.grid.shape, strict=True):
        start = max(part.start - margin, 0) // _STRIDE * _STRIDE
        stop = min(-(-(part.stop + margin) // _STRIDE) * _STRIDE, size)
        outer.append(slice(start, stop))
        inner.append(slice(part.start - start, part.stop - start))
    distribution = predict_observation(model, take_cells(observation, *outer))
    return map_tensors(distribution, lambda values: values[..., *inner])


def _probes(observation: Observation, side: int) -> Iterator[Observation]:
    """Yield the centre of the first map, repeated if it is smaller, and random cells."""
    height, width = observation.grid.shape
    first_map = observation.select(torch.tensor([0]))
    rows = (height - side) // 2 + torch.arange(side)
    columns = (width - side) // 2 + torch.arange(side)
    yield take_cells(first_map, rows[:, None] % height, columns % width)
    key = rng.stream_key(0, "models", "margin")
    uniform = rng.uniform(key, np.arange(2), (side, side))
    random_rows = torch.from_numpy((height * uniform[0]).astype(int))
    random_columns = torch.from_numpy((width * uniform[1]).astype(int))
    yield take_cells(first_map, random_rows, random_columns)


def _max_changed_distance(model: TraversabilityModel, probe: Observation) -> int | None:
    """Return the distance from an edge up to which cropping changes a prediction.

    Differences of at most 1e-6 in the farthest cells count as rounding, which depends on
    the size of a map.

    Returns:
        Distance in cells; None if even the farthest cells change by more than rounding.
    """
    prediction = predict_observation(model, probe)
    side = probe.grid.height
    row = torch.arange(side - _STRIDE, device=probe.rgb.device)
    distance = torch.minimum(row[:, None], row).flatten()
    worst = torch.zeros(len(row), dtype=torch.float64, device=row.device)
    without_first: tuple[slice, list[int]] = (slice(_STRIDE, side), [])
    without_last = (slice(0, side - _STRIDE), [-2, -1])
    for part, flip in (without_first, without_last):
        cropped = predict_observation(model, take_cells(probe, part, part))
        expected = map_tensors(
            prediction, lambda values, part=part: values[..., part, part]
        )
        difference = _difference(cropped, expected).flip(flip).flatten()
        worst = worst.scatter_reduce(0, distance, difference, "amax")
    rounding = worst[-_STRIDE:].max()
    if rounding > _NEGLIGIBLE:
        return None
    return int(((worst > rounding) * (row + 1)).max())


def _difference(a: TraversabilityDistribution, b: TraversabilityDistribution) -> Tensor:
    """Return the largest difference between two distributions' parameters in each cell.

    Differences are relative for parameters above 1.

    Returns:
        float64, shape [H, W].
    """
    differences: list[Tensor] = []

    def compare(values: Tensor, expected: Tensor) -> Tensor:
        first = values.double().flatten(0, -3)
        second = expected.double().flatten(0, -3)
        same = (first == second) | (first.isnan() & second.isnan())
        difference = (first - second).abs() / second.abs().clamp(min=1)
        finite = difference.nan_to_num(torch.inf, torch.inf)
        differences.append(torch.where(same, 0, finite).amax(0))
        return values

    map_tensors(a, compare, b)
    return torch.stack(differences).amax(0)
