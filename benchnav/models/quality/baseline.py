"""What colour alone tells of classes: the measure of what a trained classifier adds.

Letters in shapes: B maps, H×W cells, C classes.
"""

import torch
from torch import Tensor

from benchnav.datagen.files.reader import TerrainDataset

_CHUNK_MAPS = 32


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
    maps, right = dataset.map_count(split), 0.0
    for start in range(0, maps, _CHUNK_MAPS):
        read = dataset.read(split, range(start, min(start + _CHUNK_MAPS, maps)), ("rgb", "class_id"))
        found = nearest_colour(torch.from_numpy(read["rgb"]), colours)
        right += float((found == torch.from_numpy(read["class_id"]).long()).double().mean((1, 2)).sum())
    return right / maps
