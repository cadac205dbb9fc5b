"""Training data: maps or squares cut from them, read as they are asked for, or held in
memory.

What a batch holds is a pure function of (seed, epoch, place in the epoch): order and
augmentation come from named random streams, so a training that is resumed sees what it
would have seen, however many
processes read for it. Letters in shapes: B maps in all, b maps in a batch, H×W cells.
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
    draw_looks,
    squares_a_map,
)
from benchnav.models.training.masks import RandomMasks

TRAIN, VALID = "train", "valid"

# of the square: four rotations, each as it is or mirrored
_SYMMETRIES = tuple(range(8))
_SYMMETRIES_OF_RECTANGLE = (0, 1, 4, 5)  # those that leave height and width as they are
_LEAST_VARIANCE = 1e-4

Batch = dict[str, Tensor]


class MapDataset(TerrainMaps):
    """Maps by field, indexed by a whole batch at a time.

    Args:
        path: of the dataset.
        split: name of one of its splits.
        fields: which to give; `rgb` is uint8, [b, 3, H, W], and `seen` 1 where a cell
            was seen.
        in_memory: read all maps at once.
        crop: cells of a side of the squares that are cut from maps; 0 takes whole maps.
        seed: root seed of the squares that `chunks` cuts.
        every: n where it is every n-th map that counts, the first among them; the
            others are never given.
        masks: what of the maps is seen; all where there are none.
    """

    def __init__(
        self,
        path: str | Path,
        split: str,
        fields: Sequence[str] = ("rgb", "class_id"),
        in_memory: bool = False,
        crop: int = 0,
        seed: int = 0,
        every: int = 1,
        masks: RandomMasks | None = None,
    ) -> None:
        """Checks split and fields, and reads the maps where that is asked for."""
        stored = [name for name in fields if name != SEEN]
        if masks and "slope_deg" in fields and "elevation_m" not in fields:
            # slopes are those of the elevation that is seen
            stored.append("elevation_m")
        super().__init__(path, split, stored)
        self.crop, self.seed, self.every = crop, seed, every
        self.given, self.masks = tuple(fields), masks
        if in_memory:
            self._memory = super().read(range(self._maps))

    def __len__(self) -> int:
        """Number of maps that count."""
        return len(range(0, self._maps, self.every))

    def read(self, indices: Sequence[int]) -> Batch:
        """Reads maps by their indices among those that count, all of which are seen."""
        return self._with_seen(super().read([self.every * index for index in indices]))

    def __getitem__(self, key: MapKey) -> Batch:  # type: ignore[override]
        """Gives every field of the maps in `key`, shape [b, *, H, W]."""
        # squares of one map are cut from one reading
        which, place = key.maps.unique(return_inverse=True)
        read = self.read(which.tolist())
        batch = {}
        for name, values in read.items():
            cut = (
                self._cut(values[at], origin)
                for at, origin in zip(place, key.origin.tolist(), strict=True)
            )
            turned = zip(cut, key.symmetry.tolist(), strict=True)
            batch[name] = torch.stack(
                [apply_symmetry(layer, symmetry, name) for layer, symmetry in turned]
            )
        if "rgb" in batch:
            batch["rgb"] = apply_jitter(batch["rgb"], key.factors)
        return self._masked(batch, key.look)

    def chunks(self, device: torch.device = CPU) -> Iterator[tuple[range, Batch]]:
        """All maps neither turned nor jittered, in order, some at a time, with their
        indices; on a device.
        """
        origins = crop_origins(
            self.dataset.grid.shape, self.crop, self.seed, 0, len(self)
        )
        looks = torch.from_numpy(draw_looks(self.seed, 0, len(self)))
        size = self.dataset.grid.maps_in(CHUNK_CELLS)
        for first in range(0, len(self), size):
            indices = range(len(self))[first : first + size]
            maps = self.dataset.read(
                self.split, [self.every * index for index in indices], self.fields
            )
            batch = self._with_seen(
                {name: torch.from_numpy(values) for name, values in maps.items()}
            )
            if self.crop:
                chosen = origins[indices.start : indices.stop].tolist()
                batch = {
                    name: torch.stack(
                        [self._cut(*pair) for pair in zip(values, chosen, strict=True)]
                    )
                    for name, values in batch.items()
                }
            batch = self._masked(batch, looks[indices.start : indices.stop])
            yield indices, {name: values.to(device) for name, values in batch.items()}

    def _with_seen(self, maps: Batch) -> Batch:
        """Adds the layer `seen` where it is to be given."""
        shape = next(iter(maps.values())).shape
        return (
            {**maps, SEEN: torch.ones(shape[0], *shape[-2:])}
            if SEEN in self.given
            else maps
        )

    def _masked(self, batch: Batch, look: Tensor) -> Batch:
        """Masks a batch, and leaves out what was read for that alone."""
        if self.masks is None:
            return batch
        seen = self.masks.apply(batch, look)
        return {name: seen[name] for name in self.given}

    def _cut(self, layer: Tensor, origin: Sequence[int]) -> Tensor:
        """The square of a layer, [*, H, W], from a cell on; the layer itself where none
        is asked for.
        """
        row, column = origin
        return (
            layer[..., row : row + self.crop, column : column + self.crop]
            if self.crop
            else layer
        )


def apply_jitter(rgb: Tensor, factors: Tensor) -> Tensor:
    """Changes brightness, contrast and saturation of each image, in this order.

    Args:
        rgb: uint8, shape [b, 3, H, W].
        factors: of the three, each 1 where nothing is to change, shape [b, 3].
    """
    if bool((factors == 1).all()):
        return rgb
    changed = []
    for image, (brightness, contrast, saturation) in zip(
        rgb, factors.tolist(), strict=True
    ):
        image = photometry.adjust_brightness(image, brightness)
        image = photometry.adjust_contrast(image, contrast)
        changed.append(photometry.adjust_saturation(image, saturation))
    return torch.stack(changed)


def apply_symmetry(maps: Tensor, which: int, name: str = "") -> Tensor:
    """Turns maps by 90° `which // 2` times and then, if `which` is odd, mirrors them
    left to right.

    Args:
        maps: shape [*B, H, W].
        which: 0–7; 0 changes nothing.
        name: of the field; directions turn with the map.
    """
    turned = torch.rot90(maps, which // 2, (-2, -1))
    turned = turned.flip(-1) if which % 2 else turned
    if which and is_azimuth(name):
        turned = turned - 90 * (which // 2)
        turned = (180 - turned if which % 2 else turned) % 360
    return turned


@dataclass(frozen=True, kw_only=True)
class Augmentation:
    """How training maps are varied.

    Args:
        jitter: largest relative change of brightness, contrast and saturation.
        symmetries: whether maps are turned and mirrored.
    """

    jitter: float = 0.0
    symmetries: bool = True


@dataclass(frozen=True, kw_only=True)
class Loading:
    """How maps are read.

    Args:
        in_memory: hold all maps in memory.
        workers: processes that read ahead; 0 reads in this one.
        valid_every: n if only every n-th map of `valid` counts.
    """

    in_memory: bool = False
    workers: int = 0
    valid_every: int = 1


class MapData(lightning.LightningDataModule):
    """The maps of the splits `train` and `valid`.

    Training maps are turned and mirrored at random, all fields alike. Of synthetic maps
    that stays
    physical: the light comes from a random direction. A photo's light comes from one.
    Where processes train together, each takes its part of every batch.

    Args:
        dataset: where they are.
        batch_size: most maps a batch.
        seed: root seed of order and augmentation.
        fields: which to read.
        augmentation: how training maps are varied.
        crop: cells of a side of the squares to train and to measure on; 0 takes whole
            maps.
        loading: how maps are read.
        masks: what of the maps is seen; all where there are none.

    Raises:
        DatasetError: a split is missing.
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
        """Opens the splits."""
        super().__init__()
        self.batch_size, self.seed, self.workers = batch_size, seed, loading.workers
        self.augmentation = augmentation
        self.train, self.valid = (
            MapDataset(
                dataset.path, split, fields, loading.in_memory, crop, seed, every, masks
            )
            for split, every in ((TRAIN, 1), (VALID, loading.valid_every))
        )

    def scale(self, inputs: Sequence[str]) -> dict[str, LayerScale]:
        """What layers of the training maps are scaled by, from all their cells that are
        known; `seen` by nothing.
        """
        told = (
            {SEEN: LayerScale(torch.zeros(1), torch.ones(1), torch.ones(()))}
            if SEEN in inputs
            else {}
        )
        inputs = [name for name in inputs if name != SEEN]
        counts = torch.zeros(3, 256, dtype=torch.int64)
        sums: dict[str, Tensor] = {
            name: torch.zeros(2, dtype=torch.float64) for name in inputs
        }
        cells = dict.fromkeys(inputs, 0)
        for _, maps in self.train.dataset.chunks(TRAIN, inputs):
            for name in inputs:
                values = torch.from_numpy(maps[name])
                if name == "rgb":
                    channels = values.unbind(1)
                    counts += torch.stack(
                        [
                            channel.flatten().bincount(minlength=256)
                            for channel in channels
                        ]
                    )
                    continue
                known = torch.where(values.isfinite(), values, 0).double()
                sums[name] += torch.stack([known.sum(), known.square().sum()])
                cells[name] += int(values.isfinite().sum())
        scale = {
            name: _layer_scale(name, sums[name], cells[name])
            for name in inputs
            if name != "rgb"
        }
        if "rgb" in inputs:
            share = counts.double() / counts.sum(1, keepdim=True)
            level = torch.arange(256.0, dtype=torch.float64)
            mean = (share * level).sum(1)
            variance = (share * level**2).sum(1) - mean**2
            # Ground of one colour would have no scale.
            scale["rgb"] = LayerScale(
                mean.float(), variance.clamp(min=1).sqrt().float(), torch.ones(())
            )
        return scale | told

    def train_dataloader(self) -> DataLoader[Batch]:
        """Augmented batches in random order."""
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
        """Batches as stored, in order."""
        return self._load(self.valid)

    def _load(self, maps: MapDataset, **order: Any) -> DataLoader[Batch]:
        share = (
            (self.trainer.global_rank, self.trainer.world_size)
            if self.trainer
            else (0, 1)
        )
        sampler = MapSampler(
            len(maps),
            self.batch_size,
            self.seed,
            share=share,
            crop=maps.crop,
            shape=maps.dataset.grid.shape,
            shards=tuple(piece.maps for piece in maps.dataset.pieces[maps.split]),
            **order,
        )
        # A generator of its own keeps the loader from drawing on PyTorch's global one.
        return DataLoader(
            maps,
            batch_size=None,
            sampler=sampler,
            generator=torch.Generator(),
            num_workers=self.workers,
            persistent_workers=self.workers > 0,
        )


def _layer_scale(name: str, sums: Tensor, cells: int) -> LayerScale:
    """The scale of a layer from its sum and its sum of squares over so many known
    cells; directions keep theirs.
    """
    if is_azimuth(name):
        return LayerScale(torch.zeros(2), torch.ones(2), torch.ones(()))
    mean, square = (sums / max(1, cells)).unbind()
    # A layer that is the same everywhere would have no scale.
    std = (square - mean**2).clamp(min=_LEAST_VARIANCE).sqrt()
    return LayerScale(
        mean.float().view(1), std.float().view(1), square.clamp(min=1).sqrt().float()
    )


def open_dataset(data: str) -> TerrainDataset:
    """Opens a dataset to train on, by path or id.

    Raises:
        DatasetError: it has no splits to train and to measure on.
    """
    dataset = TerrainDataset(find_dataset(data))
    if not {TRAIN, VALID} <= set(dataset.splits):
        raise DatasetError(
            f"Expected splits train and valid in {dataset.path} to train on, got "
            f"{sorted(dataset.splits)}. "
            "Make a dataset with them, for example `benchnav-datagen create paper-v1`."
        )
    return dataset


def check_maps(dataset: TerrainDataset, field: str, crop: int = 0) -> None:
    """Refuses a dataset that a network cannot learn from.

    Args:
        dataset: the maps.
        field: `class_id` or `traversability`, which is to be learned.
        crop: cells of a side of the squares that are cut from maps; 0 takes whole maps.

    Raises:
        ConfigError: the squares are larger than the maps.
        DatasetError: there are fewer than two maps or squares to train on, or none to
            measure on; or in one of these splits no cell has what is learned.
    """
    height, width = dataset.grid.shape
    expect(
        crop == 0 or 8 <= crop <= min(height, width),
        f"`crop` in 8–{min(height, width)} cells, the shorter side of the maps, or 0, "
        f"got {crop}.",
    )
    what = {
        "class_id": "cells with a class",
        "traversability": "observed traversability",
    }[field]
    for split, least in ((TRAIN, 2), (VALID, 1)):
        place, count = f"split {split} of {dataset.path}", dataset.map_count(split)
        if count * squares_a_map((height, width), crop) < least:
            raise DatasetError(
                f"Expected at least {least} maps in {place}, got {count}."
            )
        chunks = (maps[field] for _, maps in dataset.chunks(split, (field,)))
        if not any(
            bool((np.isfinite(values) & (values != UNLABELLED)).any())
            for values in chunks
        ):
            raise DatasetError(f"Expected {what} in {place} to learn from, got none.")


def training_digest(dataset: TerrainDataset) -> str:
    """Digest of what of a dataset is trained on, and of what its maps mean."""
    return ",".join(f"{name}:{dataset.split_digest(name)}" for name in (TRAIN, VALID))
