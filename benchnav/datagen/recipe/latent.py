"""Latent traversability (LT) functions: λ of a class as a function of slope.

f_c(ψ) = clip(1 − (a_c·10⁻³·ψ^b_c + o_c), 0, 1), ψ in degrees; observed λ = clip(f_c(ψ)
+ ε_c, 0, 1) with ε_c zero-mean Gaussian of standard deviation σ_c. Source: paper III-A.

Beyond the paper, a class may have soft spots, a second mode of λ that neither colour
nor slope shows, and classes may share a colour. Letters in shapes: B maps, H×W cells, K
components.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy import ndarray

from benchnav.datagen.layers.layer import DrawnMaps, Layer
from benchnav.datagen.layers.stack import Parameters, affect_layers, weigh_layers
from benchnav.datagen.recipe.classes import ClassTable, look_alike_classes
from benchnav.datagen.schema import TRUTH, UNLABELLED, Maps

_BISECTIONS = 24  # leave an error of at most 2⁻²⁵


def latent_mean(class_id: ndarray, slope_deg: ndarray, classes: ClassTable) -> ndarray:
    """Return f_c(ψ) of each cell, in [0, 1], shape of `class_id`."""
    numbers = np.array([(c.scale, c.exponent, c.offset) for c in classes])
    scale, exponent, offset = np.take(numbers.T, class_id, axis=1)
    loss = slope_deg**exponent * (scale * 1e-3)
    return np.clip(1 - (loss + offset), 0, 1)


def latent_std(class_id: ndarray, classes: ClassTable) -> ndarray:
    """Return σ_c of each cell, shape of `class_id`."""
    return np.take(np.array([c.noise for c in classes]), class_id)


def truth(class_id: ndarray, slope_deg: ndarray, classes: ClassTable) -> Parameters:
    """Return the true distribution of λ, as a Gaussian mixture before clipping.

    Args:
        class_id: index into the class table; 255 is unlabelled; shape [B, H, W].
        slope_deg: slope in degrees, shape [B, H, W].
        classes: the class table.

    Returns:
        Weights, means and standard deviations, each of shape [B, K, H, W]. K is 2 if
        the table has soft spots, which have weight 0 in other classes; else K is 1.
        Means of unlabelled cells are NaN.
    """
    labelled = class_id != UNLABELLED
    class_id = np.where(labelled, class_id, 0)
    mean = latent_mean(class_id, slope_deg, classes)
    std = latent_std(class_id, classes)
    components: list[tuple[ndarray, ...]] = [(np.ones(mean.shape), mean, std)]
    if any(c.soft for c in classes):
        spots = [
            (c.soft.weight, c.soft.mean, c.soft.std) if c.soft else (0.0, 0.0, 1.0)
            for c in classes
        ]
        soft = tuple(np.take(np.transpose(spots), class_id, axis=1))
        components = [(1 - soft[0], mean, std), soft]
    weights, means, stds = (
        np.stack(values, axis=1) for values in zip(*components, strict=True)
    )
    return weights, np.where(labelled[:, None], means, np.nan), stds


def stored_truth(maps: Maps, classes: ClassTable) -> Parameters:
    """Return the true distribution of λ of stored maps, as `truth` does.

    Args:
        maps: `class_id`, `slope_deg` and, where layers change λ, the fields of
            `schema.TRUTH`.
        classes: the class table.
    """
    weights, means, stds = truth(
        maps["class_id"], maps["slope_deg"].astype(np.float64), classes
    )
    if all(name in maps for name in TRUTH):
        means, stds = (maps[name].astype(np.float64) for name in TRUTH)
    return weights, means, stds


def look_alikes(
    maps: DrawnMaps,
    layers: Sequence[Layer] = (),
    values: Mapping[str, ndarray] | None = None,
) -> Parameters:
    """Return the best prediction of λ from colours: a mixture over look-alike classes.

    Classes of one colour are shown together and exchange their cells at random from map
    to map, so each has the same weight. Layers may change these weights, and λ of each
    class; their values are taken as observed.

    Args:
        maps: classes and slopes of B maps.
        layers: layers that hide colours or affect λ, in their order.
        values: values by layer, each of shape [B, H, W].

    Returns:
        Mixture as from `truth`, with the components of each class in turn; classes with
        soft spots have two.
    """
    values = values or {}
    labelled = maps.class_id != UNLABELLED
    alike = look_alike_classes(maps.classes)
    class_given_true = np.zeros((len(alike), len(alike)))  # weights by true class
    for true_id, members in enumerate(alike):
        class_given_true[list(members), true_id] = 1 / len(members)
    true_ids = np.where(labelled, maps.class_id, 0)
    colour_weights = np.moveaxis(np.take(class_given_true, true_ids, axis=1), 0, 1)
    class_weights = weigh_layers(layers, colour_weights, values, maps)
    class_weights = np.where(labelled[:, None], class_weights, colour_weights)
    components = []
    for class_id, item in enumerate(maps.classes):
        uniform = replace(maps, class_id=np.where(labelled, class_id, UNLABELLED))
        parameters = truth(uniform.class_id, maps.slope_deg, maps.classes)
        parameters = affect_layers(layers, parameters, values, uniform)
        n_components = 2 if item.soft else 1
        weights, means, stds = (array[:, :n_components] for array in parameters)
        components.append((weights * class_weights[:, class_id, None], means, stds))
    weights, means, stds = (
        np.concatenate(arrays, axis=1) for arrays in zip(*components, strict=True)
    )
    return weights, means, stds


def expected_of(parameters: Parameters) -> ndarray:
    """Return E[λ] of the clipped mixture.

    Args:
        parameters: weights, means and standard deviations, each of shape [B, K, H, W].

    Returns:
        float64, shape [B, H, W].
    """
    weights, means, stds = parameters
    return (weights * expected_traversability(means, stds)).sum(1)


def expected_traversability(mean: ndarray, std: ndarray) -> ndarray:
    """Return E[λ] of the clipped Gaussian N(mean, std), shape of `mean`.

    It is the integral of 1 − Φ from 0 to 1. `TraversabilityMixture.mean` computes the
    same for mixtures of tensors.
    """
    z = (np.array([[1.0], [0.0]]) - mean.ravel()) / std.ravel()
    density = np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
    integral = z * _probability(z) + density
    return 1 - std * (integral[0] - integral[1]).reshape(mean.shape)


def quantile_of(parameters: Parameters, normal: ndarray) -> ndarray:
    """Return λ = clip(F⁻¹(Φ(z)), 0, 1), where F is the mixture's CDF.

    In closed form if one component has all the weight, else by bisection to within
    2⁻²⁵. `TraversabilityMixture.from_normal` computes the same for tensors.

    Args:
        parameters: weights, means and standard deviations, each of shape [B, K, H, W].
        normal: z, shape [B, H, W].

    Returns:
        λ in [0, 1], shape [B, H, W].
    """
    weights, means, stds = parameters
    heaviest = weights.argmax(axis=1)[:, None]
    mean, std = (
        np.take_along_axis(values, heaviest, axis=1)[:, 0] for values in (means, stds)
    )
    value = np.clip(mean + std * normal, 0, 1)
    mixed = weights.max(axis=1) < 1
    if mixed.any():
        selected = tuple(np.moveaxis(values, 1, 0)[:, mixed] for values in parameters)
        value[mixed] = _bisected_quantile(selected, _probability(normal[mixed]))
    return value


def _bisected_quantile(parameters: tuple[ndarray, ...], rank: ndarray) -> ndarray:
    """Return clip(F⁻¹(rank), 0, 1), shape [N], from parameters of shape [K, N]."""
    weights, means, stds = parameters

    def cdf(value: ndarray | float) -> ndarray:
        return (weights * _probability((value - means) / stds)).sum(axis=0)

    low = np.zeros_like(rank)
    width = 1.0
    for _ in range(_BISECTIONS):
        width /= 2
        low = np.where(cdf(low + width) < rank, low + width, low)
    quantile = np.where(cdf(1.0) <= rank, 1.0, low + width / 2)
    return np.where(cdf(0.0) >= rank, 0.0, quantile)


def _probability(z: ndarray) -> ndarray:
    """Return Φ(z)."""
    # Imported here, since listing and showing datasets do not need it.
    from scipy.special import ndtr

    return ndtr(z)
