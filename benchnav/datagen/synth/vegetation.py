"""Where vegetation grows and how high, by one noise for all classes. Letters in shapes: B maps, H×W cells."""

import numpy as np
from numpy import ndarray

from benchnav.datagen.recipe.classes import ClassTable
from benchnav.datagen.schema import quantise


def grow(class_id: ndarray, noise: ndarray, classes: ClassTable) -> ndarray:
    """Grows vegetation where the noise is greatest, the higher the greater it is.

    Of each class on each map it covers the class's share, to within a cell, and takes all heights of the class
    equally often. It goes by ranks within the class, so which of two look-alike classes it grows on does not show in
    where it grows.

    Args:
        class_id: shape [B, H, W].
        noise: shape [B, H, W].
        classes: the class table.

    Returns:
        Height in metres, in steps of 2⁻¹⁰, 0 on bare ground, float64, shape [B, H, W].
    """
    flat_id, height_m = class_id.reshape(len(class_id), -1), np.zeros(noise.shape)
    flat, heights = noise.reshape(len(noise), -1), height_m.reshape(len(noise), -1)
    for number, item in enumerate(classes):
        if item.vegetation is None:
            continue
        own = flat_id == number
        overgrown = np.rint(item.vegetation.cover * own.sum(axis=1, keepdims=True))
        order = np.argsort(np.where(own, -flat, np.inf), axis=1, kind="stable")
        rank = np.empty_like(order)
        np.put_along_axis(rank, order, np.arange(flat.shape[1])[None], axis=1)
        low, high = item.vegetation.height_m
        share = 1 - (rank + 0.5) / np.maximum(overgrown, 1)
        heights[:] = np.where(own & (rank < overgrown), low + (high - low) * share, heights)
    return quantise(height_m, 10)
