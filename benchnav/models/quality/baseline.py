"""What colour alone tells of classes: the measure of what a trained classifier adds.

Letters in shapes: B maps, H×W cells, C classes.
"""

import torch
from torch import Tensor

from benchnav.datagen.files.reader import TerrainDataset


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
    """Share of a split's cells whose class `nearest_colour` tells."""
    colours = torch.tensor([item.colour for item in dataset.recipe.classes])
    right = 0.0
    for _, maps in dataset.chunks(split, ("rgb", "class_id")):
        found = nearest_colour(torch.from_numpy(maps["rgb"]), colours)
        right += float((found == torch.from_numpy(maps["class_id"]).long()).double().mean((1, 2)).sum())
    return right / dataset.map_count(split)
