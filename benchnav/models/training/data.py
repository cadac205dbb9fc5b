"""Training data: maps or squares cut from them, read on demand or stored in memory.

The content of a batch is a pure function of seed, epoch and index. Order and
augmentation are drawn from named random streams, so a resumed training gets the same
batches, with any number of reading processes. Letters in shapes: b maps in a batch, H×W
cells.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader
from torchvision.transforms.v2 import functional as photometry

from benchnav.core.device import CPU
from benchnav.core.errors import DatasetError, expect
from benchnav.core.grid import is_azimuth
from benchnav.core.ground import SEEN
from benchnav.datagen.files.find import find_dataset
from benchnav.datagen.files.maps import TerrainMaps
from benchnav.datagen.files.reader import CHUNK_CELLS, TerrainDataset
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.nets.inputs import LayerScale
from benchnav.models.training.map_order import (
    MapKey,
    MapSampler,
    crop_origins,
    draw_visibility,
    squares_per_map,
)
from benchnav.models.training.masks import RandomMasks

TRAIN, VALID = "train", "valid"

_SYMMETRIES = tuple(range(8))  # four rotations of a square, each with or without mirror
_SYMMETRIES_OF_RECTANGLE = (0, 1, 4, 5)  # symmetries that preserve height and width
_MIN_VARIANCE = 1e-4

Batch = dict[str, Tensor]


class MapDataset(TerrainMaps):
    """Maps of a split; a `MapKey`, used as an index, selects a whole batch.

    Args:
        path: path of the dataset.
        split: name of a split of the dataset.
        fields: fields to return; `rgb` is uint8, [b, 3, H, W], and `seen` is 1 in observed
            cells, 0 elsewhere.
        in_memory: whether to read all maps at once and store them in memory.
        crop: side in cells of the squares cut from maps; 0 for whole maps.
        seed: root seed of the squares that `chunks` cuts.
        step: n to use only every n-th map, starting with the first.
        masks: masks of the maps; None if all cells are observed.
    """

    def __init__(
        self,
        path: str | Path,
        split: str,
        fields: Sequence[str] = ("rgb", "class_id"),
        in_memory: bool = False,
        crop: int = 0,
        seed: int = 0,
        step: int = 1,
        masks: RandomMasks | None = None,
    ) -> None:
        """Check split and fields, and read the maps if `in_memory`."""
        stored = [name for name in fields if name != SEEN]
        if masks and "slope_deg" in fields and "elevation_m" not in fields:
            stored.append("elevation_m")  # masks compute slopes from noisy elevation
        super().__init__(path, split, stored)
        self.crop = crop
        self.seed = seed
        self.step = step
        self.output_fields = tuple(fields)
        self.masks = masks
        if in_memory:
            self._memory = super().read(range(self._maps))

    def __len__(self) -> int:
        """Return the number of maps that are used."""
        return len(range(0, self._maps, self.step))

    def read(self, indices: Sequence[int]) -> Batch:
        """Read maps without masks, by their indices among the maps that are used."""
        return self._with_seen(super().read([self.step * index for index in indices]))

    def __getitem__(self, key: MapKey) -> Batch:  # type: ignore[override]
        """Return all fields of the maps in `key`, shape [b, *, H, W]."""
        # A map from which several squares are cut is read once.
        map_ids, positions = key.maps.unique(return_inverse=True)
        maps = self.read(map_ids.tolist())
        squares = list(
            zip(positions, key.origin.tolist(), key.symmetry.tolist(), strict=True)
        )
        batch = {}
        for name, layers in maps.items():
            augmented = []
            for position, origin, symmetry in squares:
                square = self._cut(layers[position], origin)
                augmented.append(apply_symmetry(square, symmetry, name))
            batch[name] = torch.stack(augmented)
        if "rgb" in batch:
            batch["rgb"] = apply_jitter(batch["rgb"], key.factors)
        return self._masked(batch, key.visibility)

    def chunks(self, device: torch.device = CPU) -> Iterator[tuple[range, Batch]]:
        """Yield the indices and fields of chunks of maps, in order without augmentation.

        Args:
            device: device of the chunks.
        """
        shape = self.dataset.grid.shape
        origins = crop_origins(shape, self.crop, self.seed, 0, len(self))
        visibility = torch.from_numpy(draw_visibility(self.seed, 0, len(self)))
        size = self.dataset.grid.maps_in(CHUNK_CELLS)
        for start in range(0, len(self), size):
            indices = range(len(self))[start : start + size]
            chunk = slice(indices.start, indices.stop)
            map_ids = [self.step * index for index in indices]
            maps = self.dataset.read(self.split, map_ids, self.fields)
            tensors = {name: torch.from_numpy(values) for name, values in maps.items()}
            batch = self._with_seen(tensors)
            if self.crop:
                batch = {
                    name: self._cut_all(layers, origins[chunk].tolist())
                    for name, layers in batch.items()
                }
            batch = self._masked(batch, visibility[chunk])
            yield indices, {name: values.to(device) for name, values in batch.items()}

    def _with_seen(self, maps: Batch) -> Batch:
        """Add the layer `seen` if it is requested."""
        if SEEN not in self.output_fields:
            return maps
        shape = next(iter(maps.values())).shape
        return {**maps, SEEN: torch.ones(shape[0], *shape[-2:])}

    def _masked(self, batch: Batch, visibility: Tensor) -> Batch:
        """Mask a batch, and drop the fields that were read only for the masks."""
        if self.masks is None:
            return batch
        masked = self.masks.apply(batch, visibility)
        return {name: masked[name] for name in self.output_fields}

    def _cut(self, layer: Tensor, origin: Sequence[int]) -> Tensor:
        """Cut a square out of a layer [*, H, W]; without `crop`, return the layer."""
        if not self.crop:
            return layer
        row, column = origin
        return layer[..., row : row + self.crop, column : column + self.crop]

    def _cut_all(self, layers: Tensor, origins: Sequence[Sequence[int]]) -> Tensor:
        pairs = zip(layers, origins, strict=True)
        return torch.stack([self._cut(layer, origin) for layer, origin in pairs])


def apply_jitter(rgb: Tensor, factors: Tensor) -> Tensor:
    """Change brightness, contrast and saturation of each image, in this order.

    Args:
        rgb: images, uint8, shape [b, 3, H, W].
        factors: factors of brightness, contrast and saturation, 1 for no change, shape
            [b, 3].
    """
    if bool((factors == 1).all()):
        return rgb
    images = []
    for image, image_factors in zip(rgb, factors.tolist(), strict=True):
        brightness, contrast, saturation = image_factors
        image = photometry.adjust_brightness(image, brightness)
        image = photometry.adjust_contrast(image, contrast)
        images.append(photometry.adjust_saturation(image, saturation))
    return torch.stack(images)


def apply_symmetry(maps: Tensor, symmetry: int, name: str = "") -> Tensor:
    """Rotate maps by 90° `symmetry // 2` times, then mirror them if `symmetry` is odd.

    Args:
        maps: values of one field, shape [*, H, W].
        symmetry: index of the symmetry, 0–7; 0 changes nothing.
        name: name of the field; the values of directions are rotated and mirrored too.
    """
    n_turns, is_mirrored = divmod(symmetry, 2)
    result = torch.rot90(maps, n_turns, (-2, -1))
    if is_mirrored:
        result = result.flip(-1)
    if symmetry and is_azimuth(name):
        result = result - 90 * n_turns
        result = (180 - result if is_mirrored else result) % 360
    return result


@dataclass(frozen=True, kw_only=True)
class Augmentation:
    """Settings of the augmentation of training maps.

    Args:
        jitter: maximum relative change of brightness, contrast and saturation, in [0, 1).
        symmetries: whether maps are rotated and mirrored.
    """

    jitter: float = 0.0
    symmetries: bool = True


@dataclass(frozen=True, kw_only=True)
class Loading:
    """Settings for reading maps.

    Args:
        in_memory: whether to store all maps in memory.
        workers: number of processes that read ahead; if 0, this process reads.
        valid_every: n to use only every n-th map of `valid`.
    """

    in_memory: bool = False
    workers: int = 0
    valid_every: int = 1


class MapData(lightning.LightningDataModule):
    """The maps of the splits `train` and `valid`.

    Training maps are rotated and mirrored at random, all fields in the same way.
    Synthetic maps remain realistic, because their light has a random direction; light in
    a photo has a fixed direction. If several processes train together, each of them
    receives a part of every batch.

    Args:
        dataset: dataset of the maps.
        batch_size: maximum number of maps per batch.
        seed: root seed of order and augmentation.
        fields: names of the fields to read.
        augmentation: settings of the augmentation of training maps.
        crop: side in cells of the squares for training and validation; 0 for whole
            maps.
        loading: settings for reading maps.
        masks: masks of the maps; None if all cells are observed.

    Raises:
        DatasetError: If a split is missing.
    """

    def __init__(
        self,
        dataset: TerrainDataset,
        batch_size: int,
        seed: int,
        fields: Sequence[str] = ("rgb", "class_id"),
        augmentation: Augmentation = Augmentation(),
        crop: int = 0,
        loading: Loading = Loading(),
        masks: RandomMasks | None = None,
    ) -> None:
        """Open the splits."""
        super().__init__()
        self.batch_size = batch_size
        self.seed = seed
        self.workers = loading.workers
        self.augmentation = augmentation

        def open_split(split: str, step: int) -> MapDataset:
            return MapDataset(
                dataset.path, split, fields, loading.in_memory, crop, seed, step, masks
            )

        self.train = open_split(TRAIN, 1)
        self.valid = open_split(VALID, loading.valid_every)

    def scale(self, inputs: Sequence[str]) -> dict[str, LayerScale]:
        """Return the scale of each input layer, from all training cells with a value.

        The scale of `seen` has mean 0 and standard deviation 1.
        """
        layers = [name for name in inputs if name not in (SEEN, "rgb")]
        stored = [name for name in inputs if name != SEEN]
        counts = torch.zeros(3, 256, dtype=torch.int64)
        sums = {name: torch.zeros(2, dtype=torch.float64) for name in layers}
        n_cells = dict.fromkeys(layers, 0)
        for _, maps in self.train.dataset.chunks(TRAIN, stored):
            if "rgb" in inputs:
                counts += _colour_counts(torch.from_numpy(maps["rgb"]))
            for name in layers:
                values = torch.from_numpy(maps[name])
                is_finite = values.isfinite()
                finite = torch.where(is_finite, values, 0).double()
                sums[name] += torch.stack([finite.sum(), finite.square().sum()])
                n_cells[name] += int(is_finite.sum())
        scale = {name: _layer_scale(name, sums[name], n_cells[name]) for name in layers}
        if "rgb" in inputs:
            scale["rgb"] = _colour_scale(counts)
        if SEEN in inputs:
            scale[SEEN] = LayerScale(torch.zeros(1), torch.ones(1), torch.ones(()))
        return scale

    def train_dataloader(self) -> DataLoader[Batch]:
        """Return augmented batches in random order."""
        height, width = self.train.dataset.grid.shape
        square = height == width or self.train.crop
        symmetries = _SYMMETRIES if square else _SYMMETRIES_OF_RECTANGLE
        if not self.augmentation.symmetries:
            symmetries = (0,)
        return self._load(
            self.train,
            symmetries=symmetries,
            jitter=self.augmentation.jitter,
            shuffle=True,
        )

    def val_dataloader(self) -> DataLoader[Batch]:
        """Return batches of validation maps in order, without augmentation."""
        return self._load(self.valid)

    def _load(self, maps: MapDataset, **order: Any) -> DataLoader[Batch]:
        process = (0, 1)
        if self.trainer:
            process = (self.trainer.global_rank, self.trainer.world_size)
        shards = maps.dataset.pieces[maps.split]
        sampler = MapSampler(
            len(maps),
            self.batch_size,
            self.seed,
            process=process,
            crop=maps.crop,
            shape=maps.dataset.grid.shape,
            shards=tuple(shard.maps for shard in shards),
            **order,
        )
        # With its own generator, the loader does not draw from PyTorch's global generator.
        return DataLoader(
            maps,
            batch_size=None,
            sampler=sampler,
            generator=torch.Generator(),
            num_workers=self.workers,
            persistent_workers=self.workers > 0,
        )


def _colour_counts(rgb: Tensor) -> Tensor:
    """Count the values 0–255 of each channel of images, int64, shape [3, 256]."""
    channels = rgb.unbind(1)
    return torch.stack(
        [channel.flatten().bincount(minlength=256) for channel in channels]
    )


def _colour_scale(counts: Tensor) -> LayerScale:
    """Return the scale of colours from counts [3, 256] of the values of each channel."""
    fraction = counts.double() / counts.sum(1, keepdim=True)
    level = torch.arange(256.0, dtype=torch.float64)
    mean = (fraction * level).sum(1)
    variance = (fraction * level**2).sum(1) - mean**2
    # Terrain of a single colour has variance 0.
    std = variance.clamp(min=1).sqrt()
    return LayerScale(mean.float(), std.float(), torch.ones(()))


def _layer_scale(name: str, sums: Tensor, n_cells: int) -> LayerScale:
    """Return the scale of a layer; directions are not scaled.

    Args:
        name: name of the layer.
        sums: sum and sum of squares of the layer's values, shape [2].
        n_cells: number of cells with a value.
    """
    if is_azimuth(name):
        return LayerScale(torch.zeros(2), torch.ones(2), torch.ones(()))
    mean, square = (sums / max(1, n_cells)).unbind()
    # A constant layer has variance 0.
    std = (square - mean**2).clamp(min=_MIN_VARIANCE).sqrt()
    rms = square.clamp(min=1).sqrt()
    return LayerScale(mean.float().view(1), std.float().view(1), rms.float())


def open_dataset(data: str) -> TerrainDataset:
    """Open a dataset to train on, by path or id.

    Raises:
        DatasetError: If the dataset has no split `train` or no split `valid`.
    """
    dataset = TerrainDataset(find_dataset(data))
    if not {TRAIN, VALID} <= set(dataset.splits):
        raise DatasetError(
            f"Expected {dataset.path} to have the splits `train` and `valid`, got "
            f"{sorted(dataset.splits)}. Train on a dataset with both splits, for "
            "example one created with `benchnav-datagen create paper-v1`."
        )
    return dataset


def check_maps(dataset: TerrainDataset, field: str, crop: int = 0) -> None:
    """Check that a network can learn from a dataset.

    Args:
        dataset: dataset of the maps.
        field: field to learn, `class_id` or `traversability`.
        crop: side in cells of the squares cut from maps; 0 for whole maps.

    Raises:
        ConfigError: If the squares are larger than the maps or smaller than 8 cells.
        DatasetError: If there are fewer than two maps or squares for training, or no map
            for validation; or if no cell of a split has a value to learn.
    """
    shape = dataset.grid.shape
    expect(
        crop == 0 or 8 <= crop <= min(shape),
        f"`crop` from 8 to {min(shape)} cells (the shorter side of the maps), or 0 for "
        f"whole maps, got {crop}.",
    )
    values_to_learn = {
        "class_id": "cells with a class",
        "traversability": "observed traversability",
    }[field]
    for split, min_maps in ((TRAIN, 2), (VALID, 1)):
        location = f"split {split} of {dataset.path}"
        n_maps = dataset.map_count(split)
        if n_maps * squares_per_map(shape, crop) < min_maps:
            raise DatasetError(
                f"Expected at least {min_maps} maps in {location}, got {n_maps}. Add "
                "maps to this split."
            )
        chunks = (maps[field] for _, maps in dataset.chunks(split, (field,)))
        if not any(map(_has_values, chunks)):
            raise DatasetError(
                f"Expected {values_to_learn} in {location} for training, got none. "
                "Train on another dataset."
            )


def _has_values(values: np.ndarray) -> bool:
    return bool((np.isfinite(values) & (values != UNLABELLED)).any())


def training_digest(dataset: TerrainDataset) -> str:
    """Return the digests of the splits `train` and `valid`, as one text."""
    return ",".join(f"{name}:{dataset.split_digest(name)}" for name in (TRAIN, VALID))
