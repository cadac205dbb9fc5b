"""What colour alone tells of classes: the measure of what a trained classifier adds.

Letters in shapes: B maps, H×W cells, C classes.
"""

import torch
from torch import Tensor

from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.schema import UNLABELLED


def nearest_colour(rgb: Tensor, colours: Tensor) -> Tensor:
    """Takes for each cell the class whose colour in full light is nearest, by Euclidean distance.

    Args:
        rgb: 0–255, shape [B, 3, H, W].
        colours: of the classes, 0–255, shape [C, 3].

    Returns:
        Class indices, int64, shape [B, H, W]; of classes equally near the first.
    """
    pixels = rgb.movedim(1, -1).float()
    return (
        torch.cdist(pixels.flatten(1, 2), colours.float().expand(len(rgb), -1, -1))
        .argmin(-1)
        .view(len(rgb), *rgb.shape[-2:])
    )


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
