"""Statistics of the ground of all training maps together: how they are fitted, and
where they are found.

They say what is known of a cell that nobody has seen: one mixture of λ, never keyed by
environment, and the mean of every layer; and how strongly two classes of one colour
hang together. Letters in shapes: B maps, H×W cells, N bins, K components, P pairs of
classes.

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
from benchnav.datagen.recipe.recipe import Recipe, load_recipe
from benchnav.datagen.recipe.scenario import RECIPES
from benchnav.datagen.schema import Maps

TRAIN = "train"

# which an `Observation` has beside those of the dataset
_SEEN_LAYERS = (
    "rgb",
    "elevation_m",
    "slope_deg",
)
_BINS = 1024  # of λ between 0 and 1
_COMPONENTS = 8
_STEPS = 1000  # of EM
_LEAST_STD = 2 / _BINS
# What lies at 0 and 1 beyond the tails of the others is of two components far outside,
# which are clipped whole.
_ATOMS = ((-1.0, 0.1), (2.0, 0.1))
_DIGITS = 6
# Settings of recipes that say which ground there is; the scenario of `train` is std in
# all that are shipped.
_OF_GROUND = (
    "synthesis",
    "classes",
    "occupancy",
    "environments",
    "class_periods_m",
    "resolution_m",
    "correlation_m",
    "layers",
)
# of fields and strength, so that both are finite where classes are never mixed
_PRIOR_STD = 10.0


def fit_ground(dataset: TerrainDataset) -> GroundStatistics:
    """Fits the statistics of a dataset's split `train`, some maps at a time.

    Args:
        dataset: the maps.

    Raises:
        DatasetError: there is no such split, or λ of none of its cells is known.
    """
    pairs = look_alike_pairs(dataset.recipe)
    inner, ends = np.zeros(_BINS), np.zeros(2)
    neighbours = np.zeros((len(pairs), 9, 2))
    for _, maps in dataset.chunks(TRAIN, ("traversability", "class_id")):
        value = maps["traversability"]
        inside = value[(value > 0) & (value < 1)]
        inner += np.histogram(inside, _BINS, (0, 1))[0]
        ends += (value == 0).sum(), (value == 1).sum()
        for place, pair in enumerate(pairs):
            neighbours[place] += count_neighbours(maps["class_id"], pair)
    if not inner.sum() + ends.sum():
        raise DatasetError(
            f"Expected cells of known traversability in split {TRAIN} of "
            f"{dataset.path}, got none. "
            "Statistics of the ground need them."
        )
    weights, means, stds = (_rounded(values) for values in fit_mixture(inner, ends))
    names = [item.name for item in dataset.recipe.classes]
    return GroundStatistics(
        weights=weights,
        means=means,
        stds=stds,
        layer_means=layer_means(dataset),
        look_alikes=tuple((names[one], names[other]) for one, other in pairs),
        potts_strength=round(fit_potts_strength(neighbours), _DIGITS) if pairs else 0.0,
    )


def layer_means(dataset: TerrainDataset) -> dict[str, tuple[float, ...]]:
    """Means of the layers of the split `train` over their known cells, by name; of
    directions the mean direction.

    Returns:
        Of `rgb` three numbers, of any other layer one, in its unit.
    """
    names = (*_SEEN_LAYERS, *dataset.layer_names)
    sums = {name: np.zeros(4 if name == "rgb" else 3) for name in names}
    for _, maps in dataset.chunks(TRAIN, names):
        for name in names:
            sums[name] += _sums_of(name, maps)
    return {name: _rounded(_mean_of(name, found)) for name, found in sums.items()}


def look_alike_pairs(recipe: Recipe) -> list[tuple[int, int]]:
    """Pairs of classes of one colour, by their ids."""
    units = dict.fromkeys(look_alike_classes(recipe.classes))
    return [pair for unit in units for pair in combinations(unit, 2)]


def fit_mixture(inner: ndarray, ends: ndarray) -> tuple[ndarray, ndarray, ndarray]:
    """Fits a Gaussian mixture clipped to [0, 1] to counts of λ, by expectation and
    maximisation.

    What is at 0 or 1 is clipped: it counts by the moments of the components beyond the
    end. Two more components, far outside, take what the others do not explain there.

    Args:
        inner: counts of bins of equal width between 0 and 1, shape [N].
        ends: counts of λ = 0 and λ = 1, shape [2].

    Returns:
        Weights, means and standard deviations before clipping, each of shape [K + 2].
    """
    total, share = (
        inner.sum() + ends.sum(),
        (np.arange(_COMPONENTS) + 0.5) / _COMPONENTS,
    )
    centre = (np.arange(len(inner)) + 0.5) / len(inner)
    order = inner.cumsum() / max(inner.sum(), 1)
    means = centre[np.searchsorted(order, share).clip(max=len(inner) - 1)]
    stds = np.full(_COMPONENTS, 0.1)
    weights = np.full(_COMPONENTS + 2, 1 / (_COMPONENTS + 2))
    atoms = weights[-2:]
    for _ in range(_STEPS):
        own = weights[:_COMPONENTS, None]
        z = (centre - means[:, None]) / stds[:, None]
        density = own * _density(z) / stds[:, None]
        # counts that belong to each component
        inside = inner * density / density.sum(0).clip(min=1e-300)
        # Beyond each end, by its distance in standard deviations outwards.
        reach = np.stack([means, 1 - means], 1) / stds[:, None]
        tail = ndtr(-reach)
        clipped = own * tail
        beyond = ends * clipped / (clipped.sum(0) + atoms).clip(min=1e-300)
        left = ends - beyond.sum(0)
        # E[Z] and E[Z²] of what is clipped, Z outwards.
        first = _density(reach) / tail.clip(min=1e-300)
        second = 1 + reach * first
        counts = inside.sum(1) + beyond.sum(1)
        outward = np.array([-1, 1])
        shift = ((inside * z).sum(1) + (beyond * first * outward).sum(1)) / counts.clip(
            min=1e-300
        )
        square = ((inside * z**2).sum(1) + (beyond * second).sum(1)) / counts.clip(
            min=1e-300
        )
        means, stds = (
            means + stds * shift,
            stds * np.sqrt((square - shift**2).clip(min=0)),
        )
        stds = stds.clip(min=_LEAST_STD)
        weights = np.concatenate([counts, left]) / total
        atoms = weights[-2:]
    far_means, far_stds = np.transpose(_ATOMS)
    return weights, np.concatenate([means, far_means]), np.concatenate([stds, far_stds])


def count_neighbours(class_id: ndarray, pair: tuple[int, int]) -> ndarray:
    """Counts cells of two classes by their four neighbours.

    Args:
        class_id: shape [B, H, W].
        pair: ids of the classes a and b.

    Returns:
        How many cells there are by n_a − n_b + 4, the neighbours of the pair alone
        counted, and by whether they are of a; shape [9, 2].
    """
    sign = (class_id == pair[0]).astype(np.int8) - (class_id == pair[1]).astype(np.int8)
    framed = np.pad(sign, ((0, 0), (1, 1), (1, 1)))
    around = (
        framed[:, :-2, 1:-1]
        + framed[:, 2:, 1:-1]
        + framed[:, 1:-1, :-2]
        + framed[:, 1:-1, 2:]
    )
    own = sign != 0
    return np.bincount(2 * (around[own] + 4) + (sign[own] > 0), minlength=18).reshape(
        9, 2
    )


def fit_potts_strength(neighbours: ndarray) -> float:
    """Fits β of P(cell is a | its neighbours) = σ(h + β·(n_a − n_b)) by maximum
    pseudo-likelihood, by Newton's method.

    Args:
        neighbours: counts of each pair, as `count_neighbours` gives them, shape [P, 9,
            2]. Each pair has a field h of its own, for the shares of its classes.
    """
    pairs, difference = len(neighbours), np.arange(-4, 5)
    design = np.zeros((pairs, 9, pairs + 1))
    design[..., -1] = difference
    for place in range(pairs):
        design[place, :, place] = 1
    rows, of_a, count = (
        design.reshape(-1, pairs + 1),
        neighbours[..., 1].ravel(),
        neighbours.sum(-1).ravel(),
    )
    found, precision = np.zeros(pairs + 1), 1 / _PRIOR_STD**2

    def loss(at: ndarray) -> float:
        logit = rows @ at
        return float(
            (count * np.logaddexp(0, logit) - of_a * logit).sum()
            + precision * at @ at / 2
        )

    for _ in range(100):
        chance = expit(rows @ found)
        slope = rows.T @ (of_a - count * chance) - precision * found
        curvature = (
            rows.T * (count * chance * (1 - chance))
        ) @ rows + precision * np.eye(pairs + 1)
        step = np.linalg.solve(curvature, slope)
        while loss(found + step) > loss(found) and np.abs(step).max() > 1e-12:
            step = step / 2
        found = found + step
        if np.abs(step).max() < 1e-9:
            break
    return float(found[-1])


def ground_file(path: Path) -> Path:
    """Where the statistics of a dataset's ground are kept: beside its file or folder."""
    return path.with_name(
        f"{path.stem if path.suffix == '.h5' else path.name}.ground.json"
    )


def find_ground(dataset: TerrainDataset) -> GroundStatistics | None:
    """Finds statistics of a dataset's ground: those beside it, else those of the
    shipped recipe of its maps.

    Args:
        dataset: of any splits, of which `train` need not be one.

    Returns:
        None where there are none.
    """
    beside = ground_file(dataset.path)
    if beside.is_file():
        return GroundStatistics.from_json(beside.read_text())
    for path in sorted((RECIPES / "ground").glob("*.json")):
        if _is_ground_of(load_recipe(path.stem), dataset.recipe):
            return GroundStatistics.from_json(path.read_text())
    return None


def _is_ground_of(shipped: Recipe, recipe: Recipe) -> bool:
    """Tells whether maps of a recipe are on the ground of a shipped one, whatever their
    size, number and light.
    """
    return all(getattr(recipe, name) == getattr(shipped, name) for name in _OF_GROUND)


def _sums_of(name: str, maps: Maps) -> ndarray:
    """Sums of the channels of a layer over its known cells, and how many these are."""
    values = maps[name]
    if name == "rgb":
        return np.array([*values.sum((0, 2, 3), dtype=np.float64), values[:, 0].size])
    known = values[np.isfinite(values)].astype(np.float64)
    if is_azimuth(name):
        return np.array(
            [
                np.cos(np.deg2rad(known)).sum(),
                np.sin(np.deg2rad(known)).sum(),
                known.size,
            ]
        )
    return np.array([known.sum(), 0, known.size])


def _mean_of(name: str, sums: ndarray) -> ndarray:
    """Means of a layer from `_sums_of`."""
    count = max(sums[-1], 1)
    if name == "rgb":
        return sums[:3] / count
    if is_azimuth(name):
        return np.rad2deg(np.arctan2(sums[1:2], sums[:1])) % 360
    return sums[:1] / count


def _density(z: ndarray) -> ndarray:
    return np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)


def _rounded(values: Sequence[float] | ndarray) -> tuple[float, ...]:
    return tuple(round(float(value), _DIGITS) for value in values)
