"""Small terrains and datasets for the tests of the models."""

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Terrain
from benchnav.datagen.files.create import create
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.load import load_recipe
from benchnav.models.config import ClassifierConfig, TrainingConfig
from benchnav.models.nets.inputs import LayerScale
from benchnav.models.slope_gp.cells import Cells, SlopeSums
from benchnav.models.slope_gp.table import SlopeTable, table_slopes
from benchnav.models.training.check import Trainable
from benchnav.models.training.find import find_trainable
from benchnav.models.training.networks import classifier_of

NAMES = ("a", "b", "c")


def names(count: int) -> tuple[str, ...]:
    """Names of so many classes."""
    return tuple(map(str, range(count)))


def scale(mean: Tensor, std: Tensor, slope_deg: float = 1.0) -> dict[str, LayerScale]:
    """Scales of colour and slope."""
    slope = LayerScale(torch.zeros(1), torch.ones(1), torch.tensor(slope_deg))
    return {"rgb": LayerScale(mean, std, torch.ones(())), "slope_deg": slope}


def trainable(config: TrainingConfig) -> Trainable:
    """The classifier or mixture-density network of some settings, to be trained."""
    if isinstance(config, ClassifierConfig):
        return classifier_of(config)
    return find_trainable("mdn", vars(config))


def make_dataset(path: Path, **maps: int) -> TerrainDataset:
    """Makes a dataset of the recipe tiny-v1 with fewer maps; splits not named are left
    out.
    """
    recipe = load_recipe("tiny-v1")
    counts = {name.replace("_", "/"): count for name, count in maps.items()}
    splits = {
        name: replace(recipe.splits[name], maps=count) for name, count in counts.items()
    }
    for _ in create(replace(recipe, splits=splits), path):
        pass
    return TerrainDataset(path)


def make_terrain(
    batch: int = 2, size: int = 16, classes: int = 3, seed: int = 0
) -> Terrain:
    """Makes terrain whose layers are random and whose traversability follows its mean
    and std.
    """
    generator = torch.Generator().manual_seed(seed)
    shape = (batch, size, size)
    mean = torch.rand(shape, generator=generator)
    std = 0.1 + 0.1 * torch.rand(shape, generator=generator)
    return Terrain(
        rgb=torch.randint(
            0, 256, (batch, 3, size, size), generator=generator, dtype=torch.uint8
        ),
        class_id=torch.randint(0, classes, shape, generator=generator),
        elevation_m=torch.rand(shape, generator=generator),
        slope_deg=30 * torch.rand(shape, generator=generator),
        truth=TraversabilityMixture(
            torch.ones_like(mean).unsqueeze(1),
            mean.unsqueeze(1),
            std.unsqueeze(1),
            (0,),
        ),
        traversability=(mean + std * torch.randn(shape, generator=generator)).clamp(
            0, 1
        ),
        grid=Grid(size, size, 0.5),
    )


def linear_table() -> SlopeTable:
    """Three classes with means 1 − ψ/90, 0.5 and ψ/90 and standard deviations 0.1, 0.2
    and 0.3.
    """
    slopes = table_slopes().float()
    noise = torch.tensor([0.1, 0.2, 0.3])
    mean = torch.stack([1 - slopes / 90, torch.full_like(slopes, 0.5), slopes / 90])
    return SlopeTable(
        mean=mean, std=noise[:, None].expand_as(mean).contiguous(), noise_std=noise
    )


NOISE = torch.tensor([0.10, 0.15, 0.20])


def latent(slope_deg: torch.Tensor) -> torch.Tensor:
    """The true latent functions of three classes; the first is near 1, where half is
    clipped.
    """
    return torch.stack(
        [
            1 - 5e-4 * slope_deg**1.5,
            0.95 - 3e-3 * slope_deg**1.6,
            (0.9 - 8e-3 * slope_deg**1.5).clamp(min=0),
        ]
    )


def make_cells(points: int, seed: int = 0, steepest_deg: float = 25) -> Cells:
    """Draws observations of the three classes, so many of each, at random slopes."""
    generator = torch.Generator().manual_seed(seed)
    slope = steepest_deg * torch.rand(points, generator=generator)
    noise = NOISE[:, None] * torch.randn(3, points, generator=generator)
    return Cells(
        class_id=torch.arange(3).repeat_interleave(points),
        slope_deg=slope.repeat(3),
        traversability=(latent(slope) + noise).clamp(0, 1).flatten(),
    )


def make_sums(points: int, seed: int = 0, steepest_deg: float = 25) -> SlopeSums:
    """Sums of `make_cells`."""
    return SlopeSums.of(make_cells(points, seed, steepest_deg), 3)
