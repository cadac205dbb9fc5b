"""What can be said without a model: the class of the nearest colour, and one
distribution of λ for all cells.

A model that is worse than these is worse than none. Letters in shapes: B maps, H×W
cells, C classes.
"""

import numpy as np
import torch
from torch import Tensor

from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.schema import UNLABELLED

_BINS = 2**12


def nearest_colour(rgb: Tensor, colours: Tensor) -> Tensor:
    """Takes for each cell the class whose colour in full light is nearest, by Euclidean
    distance.

    Args:
        rgb: 0–255, shape [B, 3, H, W].
        colours: of the classes, 0–255, shape [C, 3].

    Returns:
        Class indices, int64, shape [B, H, W]; of classes equally near the first.
    """
    pixels = rgb.movedim(1, -1).float().flatten(1, 2)
    distance = torch.cdist(pixels, colours.float().expand(len(rgb), -1, -1))
    return distance.argmin(-1).view_as(rgb[:, 0])


def nearest_colour_accuracy(dataset: TerrainDataset, split: str) -> float:
    """Share of a split's labelled cells whose class `nearest_colour` tells."""
    colours = torch.tensor([item.colour for item in dataset.recipe.classes])
    right, cells = 0, 0
    for _, maps in dataset.chunks(split, ("rgb", "class_id")):
        found = nearest_colour(torch.from_numpy(maps["rgb"]), colours)
        class_id = torch.from_numpy(maps["class_id"])
        right += int((found == class_id).sum())
        cells += int((class_id != UNLABELLED).sum())
    return right / max(1, cells)


def climatology_crps(dataset: TerrainDataset, split: str) -> float:
    """CRPS of one distribution of λ for all cells: that of the split's own observed λ.

    It is ∫ F·(1 − F), with F the share of cells up to a value, read off a histogram:
    off by 1e-4 at most. Not a number
    where no λ was observed. Source: Gneiting and Raftery (2007), 4.2.
    """
    counts = np.zeros(_BINS)
    for _, maps in dataset.chunks(split, ("traversability",)):
        observed = maps["traversability"]
        counts += np.histogram(observed[np.isfinite(observed)], _BINS, (0.0, 1.0))[0]
    if not counts.any():
        return float("nan")
    below = np.cumsum(counts) / counts.sum()
    return float((below * (1 - below)).mean())
