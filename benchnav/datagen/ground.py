"""Terrain statistics over all training maps: fitting, and search for files.

The statistics describe unobserved cells by a mixture of λ over all environments, and by
the mean of each layer. They also contain the coupling of neighbouring cells of
look-alike classes. Letters in shapes: B maps, H×W cells, N bins, K components, P pairs
of classes.

Sources: Dempster et al. (1977), "Maximum likelihood from incomplete data via the EM
algorithm"; Besag (1975), "Statistical analysis of non-lattice data"
(pseudo-likelihood).
"""

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy import ndarray
from scipy.special import expit, ndtr

from benchnav.core.errors import DatasetError
from benchnav.core.grid import is_azimuth
from benchnav.core.ground import GroundStatistics
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.classes import look_alike_classes
from benchnav.datagen.recipe.load import shipped_recipe
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.recipe.scenario import RECIPES
from benchnav.datagen.schema import Maps

TRAIN = "train"

# Layers of an `Observation` in addition to those of the dataset.
_OBSERVED_LAYERS = ("rgb", "elevation_m", "slope_deg")
_BINS = 1024  # number of bins of λ between 0 and 1
_COMPONENTS = 8  # number of fitted components
_STEPS = 1000  # number of steps of EM
_MIN_STD = 2 / _BINS
# (mean, std) of two components far outside [0, 1]. They are clipped completely and
# represent atoms at 0 and 1 that the other components do not explain.
_ATOMS = ((-1.0, 0.1), (2.0, 0.1))
_DIGITS = 6  # decimals of stored statistics
# Settings of recipes that determine the terrain. Scenarios are omitted, since the split
# `train` has the scenario `std` in all shipped recipes.
_TERRAIN_SETTINGS = (
    "synthesis",
    "classes",
    "occupancy",
    "environments",
    "class_periods_m",
    "resolution_m",
    "correlation_m",
    "layers",
)
# Standard deviation of the Gaussian prior of h and β in `fit_potts_strength`. With the
# prior, h and β are finite even if look-alike classes are never neighbours.
_PRIOR_STD = 10.0


def fit_ground(dataset: TerrainDataset) -> GroundStatistics:
    """Return the statistics of a dataset's split `train`, which is read in chunks.

    Raises:
        DatasetError: If the dataset has no split `train`, or λ is missing in all cells
            of the split.
    """
    pairs = look_alike_pairs(dataset.recipe)
    inner = np.zeros(_BINS)
    ends = np.zeros(2)
    neighbours = np.zeros((len(pairs), 9, 2))
    for _, maps in dataset.chunks(TRAIN, ("traversability", "class_id")):
        value = maps["traversability"]
        is_inside = (value > 0) & (value < 1)
        counts, _ = np.histogram(value[is_inside], _BINS, (0, 1))
        inner += counts
        ends += (value == 0).sum(), (value == 1).sum()
        for index, pair in enumerate(pairs):
            neighbours[index] += count_neighbours(maps["class_id"], pair)
    if not inner.sum() + ends.sum():
        raise DatasetError(
            f"Expected cells with traversability in split {TRAIN} of {dataset.path}, "
            "got only NaN. Terrain statistics need λ. Use a dataset with "
            "traversability."
        )
    weights, means, stds = fit_mixture(inner, ends)
    potts_strength = 0.0
    if pairs:
        potts_strength = round(fit_potts_strength(neighbours), _DIGITS)
    names = [item.name for item in dataset.recipe.classes]
    look_alikes = [(names[a], names[b]) for a, b in pairs]
    return GroundStatistics(
        weights=_rounded(weights),
        means=_rounded(means),
        stds=_rounded(stds),
        layer_means=layer_means(dataset),
        look_alikes=tuple(look_alikes),
        potts_strength=potts_strength,
    )


def layer_means(dataset: TerrainDataset) -> dict[str, tuple[float, ...]]:
    """Return the means of the layers over all cells of `train` with a value.

    Returns:
        Means by name of the layer, in its unit: three numbers for `rgb`, one number for
        any other layer. The mean of an azimuth is a circular mean.
    """
    names = (*_OBSERVED_LAYERS, *dataset.layer_names)
    sums = {}
    for name in names:
        n_sums = 4 if name == "rgb" else 3
        sums[name] = np.zeros(n_sums)
    for _, maps in dataset.chunks(TRAIN, names):
        for name in names:
            sums[name] += _sums_of(name, maps)
    return {name: _rounded(_mean_of(name, total)) for name, total in sums.items()}


def look_alike_pairs(recipe: Recipe) -> list[tuple[int, int]]:
    """Return the pairs of class indices of the same colour."""
    units = dict.fromkeys(look_alike_classes(recipe.classes))
    pairs: list[tuple[int, int]] = []
    for unit in units:
        pairs += combinations(unit, 2)
    return pairs


def fit_mixture(inner: ndarray, ends: ndarray) -> tuple[ndarray, ndarray, ndarray]:
    """Fit a Gaussian mixture, clipped to [0, 1], to counts of λ by EM.

    Values at 0 and 1 are clipped values of the components' tails below 0 and above 1.
    Two more components, far outside [0, 1], explain the remaining atoms at 0 and 1.

    Args:
        inner: counts of bins of equal width between 0 and 1, shape [N].
        ends: counts of λ = 0 and λ = 1, shape [2].

    Returns:
        Weights, means and standard deviations before clipping, each of shape [K + 2].
    """
    total = inner.sum() + ends.sum()
    n_bins = len(inner)
    centre = (np.arange(n_bins) + 0.5) / n_bins
    # Initial means: quantiles of the counts.
    levels = (np.arange(_COMPONENTS) + 0.5) / _COMPONENTS
    cdf = inner.cumsum() / max(inner.sum(), 1)
    bins = np.searchsorted(cdf, levels).clip(max=n_bins - 1)
    means = centre[bins]
    stds = np.full(_COMPONENTS, 0.1)
    n_weights = _COMPONENTS + 2
    weights = np.full(n_weights, 1 / n_weights)
    atoms = weights[-2:]
    outward = np.array([-1, 1])
    for _ in range(_STEPS):
        inner_weights = weights[:_COMPONENTS, None]
        scale = stds[:, None]
        z = (centre - means[:, None]) / scale
        density = inner_weights * _density(z) / scale
        # Expected counts of each component, inside [0, 1] and beyond each end.
        total_density = density.sum(0).clip(min=1e-300)
        inside = inner * density / total_density
        to_end = np.stack([means, 1 - means], 1) / scale
        tail = ndtr(-to_end)
        clipped = inner_weights * tail
        total_clipped = (clipped.sum(0) + atoms).clip(min=1e-300)
        beyond = ends * clipped / total_clipped
        atom_counts = ends - beyond.sum(0)
        # E[Z] and E[Z²] of a component's standardised variable beyond an end, with Z
        # positive outwards.
        first = _density(to_end) / tail.clip(min=1e-300)
        second = 1 + to_end * first
        counts = inside.sum(1) + beyond.sum(1)
        divisor = counts.clip(min=1e-300)
        inside_shift = (inside * z).sum(1)
        beyond_shift = (beyond * first * outward).sum(1)
        shift = (inside_shift + beyond_shift) / divisor
        inside_square = (inside * z**2).sum(1)
        beyond_square = (beyond * second).sum(1)
        square = (inside_square + beyond_square) / divisor
        variance = (square - shift**2).clip(min=0)
        means = means + stds * shift
        stds = stds * np.sqrt(variance)
        stds = stds.clip(min=_MIN_STD)
        weights = np.concatenate([counts, atom_counts]) / total
        atoms = weights[-2:]
    far_means, far_stds = np.transpose(_ATOMS)
    means = np.concatenate([means, far_means])
    stds = np.concatenate([stds, far_stds])
    return weights, means, stds


def count_neighbours(class_id: ndarray, pair: tuple[int, int]) -> ndarray:
    """Count cells of two classes by their four neighbours.

    Args:
        class_id: class indices, shape [B, H, W].
        pair: indices of the classes a and b.

    Returns:
        Counts, int64, shape [9, 2]. The first index is n_a − n_b + 4, where n_a and n_b
        are the numbers of neighbours of classes a and b. The second index is 1 for
        cells of class a, 0 for cells of class b.
    """
    a, b = pair
    is_a = class_id == a
    is_b = class_id == b
    sign = is_a.astype(np.int8) - is_b.astype(np.int8)
    padded = np.pad(sign, ((0, 0), (1, 1), (1, 1)))
    vertical = padded[:, :-2, 1:-1] + padded[:, 2:, 1:-1]
    horizontal = padded[:, 1:-1, :-2] + padded[:, 1:-1, 2:]
    difference = vertical + horizontal
    in_pair = sign != 0
    row = difference[in_pair] + 4
    column = sign[in_pair] > 0
    counts = np.bincount(2 * row + column, minlength=18)
    return counts.reshape(9, 2)


def fit_potts_strength(neighbours: ndarray) -> float:
    """Fit β of P(cell is a | its neighbours) = σ(h + β·(n_a − n_b)).

    The fit maximises the pseudo-likelihood by Newton's method. Each pair of classes has
    its own h, which fits the frequencies of its classes.

    Args:
        neighbours: counts of each pair from `count_neighbours`, shape [P, 9, 2].
    """
    n_pairs = len(neighbours)
    n_coefficients = n_pairs + 1
    design = np.zeros((n_pairs, 9, n_coefficients))
    design[..., -1] = np.arange(-4, 5)
    for index in range(n_pairs):
        design[index, :, index] = 1
    rows = design.reshape(-1, n_coefficients)
    count_a = neighbours[..., 1].ravel()
    count = neighbours.sum(-1).ravel()
    coefficients = np.zeros(n_coefficients)
    precision = 1 / _PRIOR_STD**2
    prior_hessian = precision * np.eye(n_coefficients)

    def loss(candidate: ndarray) -> float:
        logit = rows @ candidate
        terms = count * np.logaddexp(0, logit) - count_a * logit
        penalty = precision * candidate @ candidate / 2
        return float(terms.sum() + penalty)

    for _ in range(100):
        probability = expit(rows @ coefficients)
        residual = count_a - count * probability
        gradient = rows.T @ residual - precision * coefficients
        variance = count * probability * (1 - probability)
        hessian = (rows.T * variance) @ rows + prior_hessian
        step = np.linalg.solve(hessian, gradient)
        current = loss(coefficients)
        while loss(coefficients + step) > current and np.abs(step).max() > 1e-12:
            step = step / 2
        coefficients = coefficients + step
        if np.abs(step).max() < 1e-9:
            break
    return float(coefficients[-1])


def ground_file(path: Path) -> Path:
    """Return the path of a dataset's terrain statistics, next to its file or folder."""
    name = path.stem if path.suffix == ".h5" else path.name
    return path.with_name(f"{name}.ground.json")


def find_ground(dataset: TerrainDataset) -> GroundStatistics | None:
    """Return terrain statistics for a dataset; None if no file fits.

    The statistics are read from the file next to the dataset. If this file does not
    exist, the statistics of a shipped recipe with the same terrain are used.

    Args:
        dataset: dataset with any splits; it need not have `train`.
    """
    path = ground_file(dataset.path)
    if path.is_file():
        return GroundStatistics.from_json(path.read_text())
    shipped_paths = sorted((RECIPES / "ground").glob("*.json"))
    for path in shipped_paths:
        shipped = shipped_recipe(path.stem)
        if _has_same_terrain(shipped, dataset.recipe):
            return GroundStatistics.from_json(path.read_text())
    return None


def _has_same_terrain(a: Recipe, b: Recipe) -> bool:
    """Return whether all settings that determine the terrain are equal."""
    return all(getattr(a, name) == getattr(b, name) for name in _TERRAIN_SETTINGS)


def _sums_of(name: str, maps: Maps) -> ndarray:
    """Return sums of a layer's channels over cells with a value, then their number.

    An azimuth has two channels, its cosine and sine. Other layers except `rgb` have a
    second sum of 0.
    """
    values = maps[name]
    if name == "rgb":
        sums = values.sum((0, 2, 3), dtype=np.float64)
        n_cells = values[:, 0].size
        return np.array([*sums, n_cells])
    is_finite = np.isfinite(values)
    values = values[is_finite].astype(np.float64)
    if is_azimuth(name):
        angle = np.deg2rad(values)
        x = np.cos(angle).sum()
        y = np.sin(angle).sum()
        return np.array([x, y, values.size])
    return np.array([values.sum(), 0, values.size])


def _mean_of(name: str, sums: ndarray) -> ndarray:
    """Return the means of a layer from its sums by `_sums_of`."""
    count = max(sums[-1], 1)
    if name == "rgb":
        return sums[:3] / count
    if is_azimuth(name):
        mean_angle = np.arctan2(sums[1:2], sums[:1])
        return np.rad2deg(mean_angle) % 360
    return sums[:1] / count


def _density(z: ndarray) -> ndarray:
    return np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)


def _rounded(values: Sequence[float] | ndarray) -> tuple[float, ...]:
    return tuple(round(float(value), _DIGITS) for value in values)
