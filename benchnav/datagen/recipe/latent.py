"""Latent traversability (LT) functions: λ of a class as a function of slope.

For a class c and a slope of ψ degrees, f_c(ψ) = clip(1 − (a_c·10⁻³·ψ^b_c + o_c), 0, 1).
Observed λ is clip(f_c(ψ) + ε_c, 0, 1), where ε_c is Gaussian with mean 0 and standard
deviation σ_c. Source: Endo et al. (2024), "BenchNav: Simulation Platform for
Benchmarking Off-road Navigation Algorithms with Probabilistic Traversability", III-A.

In addition to the paper, a class may have soft spots, a second mode of λ that neither
colour nor slope shows, and several classes may have the same colour. Letters in shapes:
B maps, H×W cells, K components.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy import ndarray

from benchnav.datagen.layers.layer import DrawnMaps, Layer
from benchnav.datagen.layers.stack import Parameters, affect_layers, weigh_layers
from benchnav.datagen.recipe.classes import ClassTable, look_alike_classes
from benchnav.datagen.schema import TRUTH, UNLABELLED, Maps

_BISECTIONS = 24  # number of bisections, for an error of at most 2⁻²⁵


def latent_mean(class_id: ndarray, slope_deg: ndarray, classes: ClassTable) -> ndarray:
    """Return f_c(ψ) of each cell, in [0, 1], shape of `class_id`."""
    numbers = np.array([(item.scale, item.exponent, item.offset) for item in classes])
    scale, exponent, offset = np.take(numbers.T, class_id, axis=1)
    loss = slope_deg**exponent * (scale * 1e-3)
    return np.clip(1 - (loss + offset), 0, 1)


def latent_std(class_id: ndarray, classes: ClassTable) -> ndarray:
    """Return σ_c of each cell, shape of `class_id`."""
    noise = np.array([item.noise for item in classes])
    return np.take(noise, class_id)


def truth(class_id: ndarray, slope_deg: ndarray, classes: ClassTable) -> Parameters:
    """Return the true distribution of λ, as a Gaussian mixture before clipping.

    Args:
        class_id: index into the class table, 255 for unlabelled cells, shape [B, H, W].
        slope_deg: slope in degrees, shape [B, H, W].
        classes: class table.

    Returns:
        Weights, means and standard deviations, each of shape [B, K, H, W]. K is 2 if
        the table has soft spots, else 1. In a class without soft spots, the second
        component has weight 0. Means of unlabelled cells are NaN.
    """
    labelled = class_id != UNLABELLED
    class_id = np.where(labelled, class_id, 0)
    mean = latent_mean(class_id, slope_deg, classes)
    std = latent_std(class_id, classes)
    all_weights = [np.ones(mean.shape)]
    all_means = [mean]
    all_stds = [std]
    if any(item.soft for item in classes):
        spots = []
        for item in classes:
            soft = item.soft
            spot = (soft.weight, soft.mean, soft.std) if soft else (0.0, 0.0, 1.0)
            spots.append(spot)
        soft_weight, soft_mean, soft_std = np.take(
            np.transpose(spots), class_id, axis=1
        )
        all_weights = [1 - soft_weight, soft_weight]
        all_means = [mean, soft_mean]
        all_stds = [std, soft_std]
    weights = np.stack(all_weights, axis=1)
    means = np.stack(all_means, axis=1)
    stds = np.stack(all_stds, axis=1)
    means = np.where(labelled[:, None], means, np.nan)
    return weights, means, stds


def stored_truth(maps: Maps, classes: ClassTable) -> Parameters:
    """Return the true distribution of λ of stored maps, in the form of `truth`.

    Args:
        maps: stored fields `class_id` and `slope_deg`, and, if layers change λ, the
            fields of `schema.TRUTH`.
        classes: class table.
    """
    slope_deg = maps["slope_deg"].astype(np.float64)
    weights, means, stds = truth(maps["class_id"], slope_deg, classes)
    if all(name in maps for name in TRUTH):
        means, stds = (maps[name].astype(np.float64) for name in TRUTH)
    return weights, means, stds


def look_alikes(
    maps: DrawnMaps,
    layers: Sequence[Layer] = (),
    values: Mapping[str, ndarray] | None = None,
) -> Parameters:
    """Return the best prediction of λ from colours: a mixture over look-alike classes.

    Look-alike classes occur on the same maps, in random cells with equal probability,
    so they have equal weights. Layers may change these weights, and λ of each class;
    the values of layers are assumed to be observed.

    Args:
        maps: classes and slopes of B maps.
        layers: layers that hide colours or change λ, in the recipe's order.
        values: values of layers by name, each of shape [B, H, W].

    Returns:
        Weights, means and standard deviations as in `truth`. The components are ordered
        by class: two for a class with soft spots, one for any other class.
    """
    values = values or {}
    labelled = maps.class_id != UNLABELLED
    alike = look_alike_classes(maps.classes)
    n_classes = len(alike)
    # Weight of each class, given the true class of a cell.
    class_given_true = np.zeros((n_classes, n_classes))
    for true_id, members in enumerate(alike):
        class_given_true[list(members), true_id] = 1 / len(members)
    true_ids = np.where(labelled, maps.class_id, 0)
    colour_weights = np.take(class_given_true, true_ids, axis=1)
    colour_weights = np.moveaxis(colour_weights, 0, 1)
    class_weights = weigh_layers(layers, colour_weights, values, maps)
    class_weights = np.where(labelled[:, None], class_weights, colour_weights)
    all_weights = []
    all_means = []
    all_stds = []
    for class_id, item in enumerate(maps.classes):
        uniform_id = np.where(labelled, class_id, UNLABELLED)
        uniform = replace(maps, class_id=uniform_id)
        parameters = truth(uniform_id, maps.slope_deg, maps.classes)
        parameters = affect_layers(layers, parameters, values, uniform)
        n_components = 2 if item.soft else 1
        weights, means, stds = (array[:, :n_components] for array in parameters)
        class_weight = class_weights[:, class_id, None]
        all_weights.append(weights * class_weight)
        all_means.append(means)
        all_stds.append(stds)
    weights = np.concatenate(all_weights, axis=1)
    means = np.concatenate(all_means, axis=1)
    stds = np.concatenate(all_stds, axis=1)
    return weights, means, stds


def expected_of(parameters: Parameters) -> ndarray:
    """Return E[λ] of the clipped mixture.

    Args:
        parameters: weights, means and standard deviations, each of shape [B, K, H, W].

    Returns:
        float64, shape [B, H, W].
    """
    weights, means, stds = parameters
    expected = expected_traversability(means, stds)
    return (weights * expected).sum(1)


def expected_traversability(mean: ndarray, std: ndarray) -> ndarray:
    """Return E[λ] of the clipped Gaussian N(mean, std), shape of `mean`.

    The result is the integral of 1 − F from 0 to 1, where F is the Gaussian's CDF.
    `TraversabilityMixture.mean` computes it for mixtures of tensors.
    """
    limits = np.array([[1.0], [0.0]])
    z = (limits - mean.ravel()) / std.ravel()
    density = np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
    at_1, at_0 = z * _probability(z) + density
    integral = (at_1 - at_0).reshape(mean.shape)
    return 1 - std * integral


def quantile_of(parameters: Parameters, normal: ndarray) -> ndarray:
    """Return λ = clip(F⁻¹(Φ(z)), 0, 1), where F is the mixture's CDF.

    If one component has all the weight, the result is in closed form. Otherwise, it is
    from bisection, with an error of at most 2⁻²⁵. `TraversabilityMixture.from_normal`
    computes it for tensors.

    Args:
        parameters: weights, means and standard deviations, each of shape [B, K, H, W].
        normal: standard normal variable z, shape [B, H, W].

    Returns:
        λ in [0, 1], shape [B, H, W].
    """
    weights, means, stds = parameters
    heaviest = weights.argmax(axis=1)[:, None]
    mean = np.take_along_axis(means, heaviest, axis=1)[:, 0]
    std = np.take_along_axis(stds, heaviest, axis=1)[:, 0]
    value = np.clip(mean + std * normal, 0, 1)
    mixed = weights.max(axis=1) < 1
    if mixed.any():
        selected = tuple(np.moveaxis(values, 1, 0)[:, mixed] for values in parameters)
        rank = _probability(normal[mixed])
        value[mixed] = _bisected_quantile(selected, rank)
    return value


def _bisected_quantile(parameters: tuple[ndarray, ...], rank: ndarray) -> ndarray:
    """Return clip(F⁻¹(rank), 0, 1), shape [N], from parameters of shape [K, N]."""
    weights, means, stds = parameters

    def cdf(value: ndarray | float) -> ndarray:
        z = (value - means) / stds
        return (weights * _probability(z)).sum(axis=0)

    low = np.zeros_like(rank)
    width = 1.0
    for _ in range(_BISECTIONS):
        width /= 2
        middle = low + width
        low = np.where(cdf(middle) < rank, middle, low)
    quantile = np.where(cdf(1.0) <= rank, 1.0, low + width / 2)
    return np.where(cdf(0.0) >= rank, 0.0, quantile)


def _probability(z: ndarray) -> ndarray:
    """Return Φ(z), the CDF of the standard normal distribution."""
    # SciPy is slow to import, and commands that list and show datasets do not need it.
    from scipy.special import ndtr

    return ndtr(z)
