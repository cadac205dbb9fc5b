"""Latent traversability (LT) functions: how a class's traversability falls with slope.

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
    """f_c(ψ) of each cell, in [0, 1], shape of `class_id`."""
    numbers = np.array([(c.scale, c.exponent, c.offset) for c in classes])
    scale, exponent, offset = np.take(numbers.T, class_id, axis=1)
    loss = slope_deg**exponent * (scale * 1e-3)
    return np.clip(1 - (loss + offset), 0, 1)


def latent_std(class_id: ndarray, classes: ClassTable) -> ndarray:
    """σ_c of each cell, shape of `class_id`."""
    return np.take(np.array([c.noise for c in classes]), class_id)


def truth(class_id: ndarray, slope_deg: ndarray, classes: ClassTable) -> Parameters:
    """The true distribution of λ in each cell, as a Gaussian mixture before clipping.

    Args:
        class_id: 255 where not known, shape [B, H, W].
        slope_deg: shape [B, H, W].
        classes: the class table.

    Returns:
        Weights, means and standard deviations, each of shape [B, K, H, W]: K = 1, or 2
        where the table has soft spots; a class without them has them at weight 0. Where
        the class is not known, means are NaN.
    """
    labelled = class_id != UNLABELLED
    class_id = np.where(labelled, class_id, 0)
    mean, std = latent_mean(class_id, slope_deg, classes), latent_std(class_id, classes)
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
    """What the colours tell of λ at best: the mixture over all classes that look like a
    cell's own.

    Classes of one colour are shown together, and which of them takes which ground is
    drawn again in each map, so that each weighs the same. Layers may change these
    weights, and λ of each class; their values are taken as known.

    Args:
        maps: classes and slopes.
        layers: those that hide colours or affect λ, in their order.
        values: by layer, shape [B, H, W].

    Returns:
        As `truth`, with the components of each class in turn, a second one where it has
        soft spots.
    """
    values, labelled = values or {}, maps.class_id != UNLABELLED
    alike = look_alike_classes(maps.classes)
    shares = np.zeros((len(alike), len(alike)))  # of each class, by the cell's own
    for number, members in enumerate(alike):
        shares[list(members), number] = 1 / len(members)
    colour_weights = np.moveaxis(
        np.take(shares, np.where(labelled, maps.class_id, 0), axis=1), 0, 1
    )
    class_weights = weigh_layers(layers, colour_weights, values, maps)
    class_weights = np.where(labelled[:, None], class_weights, colour_weights)
    pieces = []
    for number, item in enumerate(maps.classes):
        below = replace(maps, class_id=np.where(labelled, number, UNLABELLED))
        own = affect_layers(
            layers, truth(below.class_id, maps.slope_deg, maps.classes), values, below
        )
        weights, means, stds = (array[:, : 2 if item.soft else 1] for array in own)
        pieces.append((weights * class_weights[:, number, None], means, stds))
    weights, means, stds = (
        np.concatenate(parts, axis=1) for parts in zip(*pieces, strict=True)
    )
    return weights, means, stds


def expected_of(parameters: Parameters) -> ndarray:
    """E[λ] of the clipped mixture, shape [B, H, W], from parameters of shape [B, K, H,
    W].
    """
    weights, means, stds = parameters
    return (weights * expected_traversability(means, stds)).sum(1)


def expected_traversability(mean: ndarray, std: ndarray) -> ndarray:
    """E[λ] of the clipped Gaussian N(mean, std), shape of `mean`.

    The integral of 1 − Φ from 0 to 1; `TraversabilityMixture.mean` says the same for
    mixtures of tensors.
    """
    below = (np.array([[1.0], [0.0]]) - mean.ravel()) / std.ravel()
    integral = below * _probability(below) + np.exp(-0.5 * below * below) / np.sqrt(
        2 * np.pi
    )
    return 1 - std * (integral[0] - integral[1]).reshape(mean.shape)


def quantile_of(parameters: Parameters, normal: ndarray) -> ndarray:
    """λ of the rank that a standard normal number has: clip(F⁻¹(Φ(z)), 0, 1), F the
    mixture's CDF.

    In closed form where one component has all the weight, else by bisection to within
    2⁻²⁵; `TraversabilityMixture.from_normal` says the same of tensors.

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
        own = tuple(np.moveaxis(values, 1, 0)[:, mixed] for values in parameters)
        value[mixed] = _bisected_quantile(own, _probability(normal[mixed]))
    return value


def _bisected_quantile(parameters: tuple[ndarray, ...], rank: ndarray) -> ndarray:
    """clip(F⁻¹(rank), 0, 1) from parameters of shape [K, N], shape [N]."""
    weights, means, stds = parameters

    def below(value: ndarray | float) -> ndarray:
        return (weights * _probability((value - means) / stds)).sum(axis=0)

    low, width = np.zeros_like(rank), 1.0
    for _ in range(_BISECTIONS):
        width /= 2
        low = np.where(below(low + width) < rank, low + width, low)
    return np.where(
        below(0.0) >= rank, 0.0, np.where(below(1.0) <= rank, 1.0, low + width / 2)
    )


def _probability(z: ndarray) -> ndarray:
    """Φ(z)."""
    # imported here: a dataset is listed and shown without
    from scipy.special import (
        ndtr,
    )

    return ndtr(z)
