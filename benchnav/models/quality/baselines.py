"""Baselines without a model: nearest colour, and one distribution of λ for all cells.

A useful model scores better than both. Letters in shapes: B maps, H×W cells, C classes.
"""

import numpy as np
import torch
from torch import Tensor

from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.schema import UNLABELLED

_BINS = 2**12


def nearest_colour(rgb: Tensor, colours: Tensor) -> Tensor:
    """Return the class with the nearest fully lit colour (Euclidean) for each cell.

    Args:
        rgb: colours of the cells, 0–255, shape [B, 3, H, W].
        colours: colours of the classes, 0–255, shape [C, 3].

    Returns:
        Class ids, int64, shape [B, H, W]. If several are equally near, the first.
    """
    pixels = rgb.movedim(1, -1).float().flatten(1, 2)
    palette = colours.float().expand(len(rgb), -1, -1)
    distance = torch.cdist(pixels, palette)
    return distance.argmin(-1).view_as(rgb[:, 0])


def nearest_colour_accuracy(dataset: TerrainDataset, split: str) -> float:
    """Return the accuracy of `nearest_colour` in the labelled cells of a split."""
    colours = torch.tensor([item.colour for item in dataset.recipe.classes])
    n_correct = 0
    n_labelled = 0
    for _, maps in dataset.chunks(split, ("rgb", "class_id")):
        rgb = torch.from_numpy(maps["rgb"])
        class_id = torch.from_numpy(maps["class_id"])
        is_correct = nearest_colour(rgb, colours) == class_id
        is_labelled = class_id != UNLABELLED
        n_correct += int(is_correct.sum())
        n_labelled += int(is_labelled.sum())
    return n_correct / max(1, n_labelled)


def climatology_crps(dataset: TerrainDataset, split: str) -> float:
    """Return the CRPS of predicting the distribution of observed λ in every cell.

    The CRPS is ∫ F·(1 − F), where F(x) is the fraction of cells with λ ≤ x, computed from
    a histogram with an error below 1e-4; NaN if λ was not observed. Source: Gneiting and
    Raftery (2007), "Strictly proper scoring rules, prediction, and estimation", 4.2.
    """
    counts = np.zeros(_BINS)
    for _, maps in dataset.chunks(split, ("traversability",)):
        layer = maps["traversability"]
        observed = layer[np.isfinite(layer)]
        chunk_counts, _ = np.histogram(observed, _BINS, (0.0, 1.0))
        counts += chunk_counts
    if not counts.any():
        return float("nan")
    cdf = np.cumsum(counts) / counts.sum()
    return float((cdf * (1 - cdf)).mean())
