"""Training data in whole maps, read as they are asked for, or held in memory.

What a batch holds is a pure function of (seed, epoch, place in the epoch): order and augmentation
come from named random streams, so a training that is resumed sees what it would have seen, however many
processes read for it. Letters in shapes: B maps in all, b maps in a batch, H×W cells.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import lightning
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Sampler
from torchvision.transforms.v2 import functional as photometry

from benchnav.core import rng
from benchnav.core.device import CPU
from benchnav.core.errors import DatasetError
from benchnav.datagen.files.maps import TerrainMaps
from benchnav.datagen.files.reader import TerrainDataset, find_dataset
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.nets.trainable import MapScale
from benchnav.models.training.map_order import map_order

TRAIN, VALID = "train", "valid"

_SYMMETRIES = tuple(range(8))  # of the square: four rotations, each as it is or mirrored
_SYMMETRIES_OF_RECTANGLE = (0, 1, 4, 5)  # those that leave height and width as they are

MapKey = tuple[Tensor, Tensor, Tensor]
Batch = dict[str, Tensor]


class MapDataset(TerrainMaps):
    """Maps by field, `rgb` (uint8, [b, 3, H, W]) among them; indexed by a whole batch at a time."""

    def __getitem__(self, key: MapKey) -> Batch:  # type: ignore[override]
        """Gives every field of the maps in `key`, shape [b, *, H, W].

        Args:
            key: indices of maps and the symmetry to apply to each, both int64 of shape [b], and the
                factors of `apply_jitter`, shape [b, 3].
        """
        index, symmetry, factors = key
        batch = {
            name: torch.stack(
                [apply_symmetry(layer, which) for layer, which in zip(values, symmetry.tolist(), strict=True)]
            )
            for name, values in self.read(index.tolist()).items()
        }
        return {**batch, "rgb": apply_jitter(batch["rgb"], factors)}

    def chunks(self, device: torch.device = CPU) -> Iterator[tuple[range, Batch]]:
        """All maps as they are, in order, some at a time, with their indices; on a device."""
        for indices, maps in self.dataset.chunks(self.split, self.fields):
            yield indices, {name: torch.from_numpy(values).to(device) for name, values in maps.items()}


def apply_jitter(rgb: Tensor, factors: Tensor) -> Tensor:
    """Changes brightness, contrast and saturation of each image, in this order.

    Args:
        rgb: uint8, shape [b, 3, H, W].
        factors: of the three, each 1 where nothing is to change, shape [b, 3].
    """
    if bool((factors == 1).all()):
        return rgb
    changed = []
    for image, (brightness, contrast, saturation) in zip(rgb, factors.tolist(), strict=True):
        image = photometry.adjust_brightness(image, brightness)
        image = photometry.adjust_contrast(image, contrast)
        changed.append(photometry.adjust_saturation(image, saturation))
    return torch.stack(changed)


def apply_symmetry(maps: Tensor, which: int) -> Tensor:
    """Turns maps by 90° `which // 2` times and then, if `which` is odd, mirrors them left to right.

    Args:
        maps: shape [*B, H, W].
        which: 0–7; 0 changes nothing.
    """
    turned = torch.rot90(maps, which // 2, (-2, -1))
    return turned.flip(-1) if which % 2 else turned


@dataclass(eq=False)
class MapSampler(Sampler[MapKey]):
    """Cuts the maps into batches of nearly equal size, in an order keyed by (seed, epoch).

    Args:
        maps: how many there are.
        batch_size: most maps a batch.
        seed: root seed.
        symmetries: which symmetries to draw from; (0,) leaves maps as they are.
        jitter: largest relative change of brightness, contrast and saturation.
        shuffle: whether to change the order each epoch.
        share: (i, n): of every batch take the i-th of n interleaved parts, for one of n processes.
        epoch: that the next iteration gives.
        shards: how many maps each file of the dataset holds, in order; none where one holds them all.
    """

    maps: int
    batch_size: int
    seed: int = 0
    symmetries: tuple[int, ...] = (0,)
    jitter: float = 0.0
    shuffle: bool = False
    share: tuple[int, int] = (0, 1)
    epoch: int = 0
    shards: tuple[int, ...] = ()

    def set_epoch(self, epoch: int) -> None:
        """Chooses the epoch that the next iteration gives; the trainer calls this."""
        self.epoch = epoch

    def __len__(self) -> int:
        """Batches an epoch."""
        return -(-self.maps // self.batch_size)

    def __iter__(self) -> Iterator[MapKey]:
        """Yields the batches of the epoch."""
        order, epoch = np.arange(self.maps), np.array([self.epoch])
        if self.shuffle:
            order = map_order(self.shards or (self.maps,), self.seed, self.epoch)
        drawn = rng.uniform(rng.stream_key(self.seed, "models", "map symmetry"), epoch, (self.maps,))[0]
        symmetry = np.array(self.symmetries)[(drawn * len(self.symmetries)).astype(np.int64)]
        drawn = rng.uniform(rng.stream_key(self.seed, "models", "map jitter"), epoch, (self.maps, 3))[0]
        factors = 1 + self.jitter * (2 * drawn - 1)
        first, step = self.share
        pieces = (np.array_split(values, len(self)) for values in (order, symmetry, factors))
        for batch in zip(*pieces, strict=True):
            start = min(first, len(batch[0]) - 1)  # no process is left without a map
            index, which, how = (torch.from_numpy(values[start::step]) for values in batch)
            yield index, which, how


class MapData(lightning.LightningDataModule):
    """The maps of the splits `train` and `valid`.

    Training maps are turned and mirrored at random, all fields alike. Of synthetic maps that stays
    physical: the light comes from a random direction. A photo's light comes from one. Where processes train
    together, each takes its part of every batch.

    Args:
        dataset: where they are.
        batch_size: most maps a batch.
        seed: root seed of order and augmentation.
        jitter: largest relative change of brightness, contrast and saturation of a training map.
        fields: which fields to read beside `rgb`.
        in_memory: hold all maps in memory.
        workers: processes that read ahead; 0 reads in this one.

    Raises:
        DatasetError: a split is missing.
    """

    def __init__(
        self,
        dataset: TerrainDataset,
        batch_size: int,
        seed: int,
        jitter: float = 0.0,
        fields: tuple[str, ...] = ("class_id",),
        in_memory: bool = False,
        workers: int = 0,
    ) -> None:
        """Opens the splits."""
        super().__init__()
        self.batch_size, self.seed, self.jitter, self.workers = batch_size, seed, jitter, workers
        read = ("rgb", *fields)
        self.train, self.valid = (
            MapDataset(dataset.path, split, read, in_memory) for split in (TRAIN, VALID)
        )

    def scale(self) -> MapScale:
        """What the training maps' colours and slopes are scaled by; 1 of slopes that are not read."""
        counts, squares = torch.zeros(3, 256, dtype=torch.int64), torch.zeros((), dtype=torch.float64)
        for _, maps in self.train.chunks():
            channels = maps["rgb"].unbind(1)
            counts += torch.stack([channel.flatten().bincount(minlength=256) for channel in channels])
            if "slope_deg" in maps:
                squares += maps["slope_deg"].double().square().sum()
        share, level = counts.double() / counts.sum(1, keepdim=True), torch.arange(256.0, dtype=torch.float64)
        mean = (share * level).sum(1)
        variance = (share * level**2).sum(1) - mean**2
        # Ground of one colour, or flat, would have no scale.
        std, slope_deg = (
            value.clamp(min=1).sqrt().float() for value in (variance, squares / counts[0].sum())
        )
        return MapScale(mean.float(), std, slope_deg)

    def train_dataloader(self) -> DataLoader[Batch]:
        """Augmented batches in random order."""
        height, width = self.train.dataset.grid.shape
        symmetries = _SYMMETRIES if height == width else _SYMMETRIES_OF_RECTANGLE
        return self._load(self.train, symmetries=symmetries, jitter=self.jitter, shuffle=True)

    def val_dataloader(self) -> DataLoader[Batch]:
        """Batches as stored, in order."""
        return self._load(self.valid)

    def _load(self, maps: MapDataset, **order: Any) -> DataLoader[Batch]:
        share = (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)
        shards = tuple(piece.maps for piece in maps.dataset.pieces[maps.split])
        sampler = MapSampler(len(maps), self.batch_size, self.seed, share=share, shards=shards, **order)
        # A generator of its own keeps the loader from drawing on PyTorch's global one.
        return DataLoader(
            maps, batch_size=None, sampler=sampler, generator=torch.Generator(),
            num_workers=self.workers, persistent_workers=self.workers > 0,
        )  # fmt: skip


def open_dataset(data: str) -> TerrainDataset:
    """Opens a dataset to train on, by path or id.

    Raises:
        DatasetError: it has no splits to train and to measure on.
    """
    dataset = TerrainDataset(find_dataset(data))
    if not {TRAIN, VALID} <= set(dataset.splits):
        raise DatasetError(
            f"Expected splits train and valid in {dataset.path} to train on, got {sorted(dataset.splits)}. "
            "Make a dataset with them, for example `benchnav-datagen create paper-v1`."
        )
    return dataset


def check_maps(dataset: TerrainDataset, field: str) -> None:
    """Refuses a dataset that a network cannot learn from.

    Args:
        dataset: the maps.
        field: `class_id` or `traversability`, which is to be learned.

    Raises:
        DatasetError: there are fewer than two maps to train on, or none to measure on; or in one of these splits no
            cell has what is learned.
    """
    what = {"class_id": "cells with a class", "traversability": "observed traversability"}[field]
    for split, least in ((TRAIN, 2), (VALID, 1)):
        place, count = f"split {split} of {dataset.path}", dataset.map_count(split)
        if count < least:
            raise DatasetError(f"Expected at least {least} maps in {place}, got {count}.")
        chunks = (maps[field] for _, maps in dataset.chunks(split, (field,)))
        if not any(bool((np.isfinite(values) & (values != UNLABELLED)).any()) for values in chunks):
            raise DatasetError(f"Expected {what} in {place} to learn from, got none.")


def training_digest(dataset: TerrainDataset) -> str:
    """Digest of what of a dataset is trained on, and of what its maps mean."""
    return ",".join(f"{name}:{dataset.split_digest(name)}" for name in (TRAIN, VALID))
