"""Training data in memory: whole maps for the classifier, tables of cells for the class-wise GPs.

What a batch holds is a pure function of (seed, epoch, place in the epoch): order, augmentation and
subsampling come from named random streams. Letters in shapes: B maps, H×W cells, C classes, N cells
a class.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import lightning
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from benchnav import rng
from benchnav.datagen.store import TerrainDataset
from benchnav.errors import ConfigError, DatasetError

TRAIN, VALID = "train", "valid"

_SYMMETRIES = tuple(range(8))  # of the square: four rotations, each as it is or mirrored
_SYMMETRIES_OF_RECTANGLE = (0, 1, 4, 5)  # those that leave height and width as they are

MapKey = tuple[Tensor, Tensor]
Batch = dict[str, Tensor]


class MapDataset(Dataset[Batch]):
    """Maps and their classes; indexed by a whole batch at a time.

    Args:
        rgb: uint8, shape [B, 3, H, W].
        class_id: uint8, shape [B, H, W].
    """

    def __init__(self, rgb: Tensor, class_id: Tensor) -> None:
        """Keeps the tensors."""
        self.rgb, self.class_id = rgb, class_id

    def __len__(self) -> int:
        """Number of maps."""
        return len(self.rgb)

    def __getitem__(self, key: MapKey) -> Batch:
        """Gives `rgb` (uint8, [b, 3, H, W]) and `class_id` (int64, [b, H, W]) of the maps in `key`.

        Args:
            key: indices of maps, and the symmetry to apply to each, both int64 of shape [b].
        """
        index, symmetry = key
        rgb, class_id = self.rgb[index], self.class_id[index]
        turned_rgb, turned_class = torch.empty_like(rgb), torch.empty_like(class_id)
        for which in symmetry.unique().tolist():
            chosen = symmetry == which
            turned_rgb[chosen] = apply_symmetry(rgb[chosen], which)
            turned_class[chosen] = apply_symmetry(class_id[chosen], which)
        return {"rgb": turned_rgb, "class_id": turned_class.long()}


def apply_symmetry(maps: Tensor, which: int) -> Tensor:
    """Turns maps by 90° `which // 2` times and then, if `which` is odd, mirrors them left to right.

    Args:
        maps: shape [*B, H, W].
        which: 0–7; 0 changes nothing.
    """
    turned = torch.rot90(maps, which // 2, (-2, -1))
    return turned.flip(-1) if which % 2 else turned


class MapSampler(Sampler[MapKey]):
    """Cuts the maps into batches of nearly equal size, in an order keyed by (seed, epoch).

    Args:
        maps: how many there are.
        batch_size: most maps a batch.
        seed: root seed.
        symmetries: which symmetries to draw from; (0,) leaves maps as they are.
        shuffle: whether to change the order each epoch.
    """

    def __init__(
        self, maps: int, batch_size: int, seed: int, symmetries: tuple[int, ...], shuffle: bool
    ) -> None:
        """Starts at epoch 0."""
        self.maps, self.batch_size, self.seed = maps, batch_size, seed
        self.symmetries, self.shuffle = symmetries, shuffle
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Chooses the epoch that the next iteration gives; the trainer calls this."""
        self.epoch = epoch

    def __len__(self) -> int:
        """Batches an epoch."""
        return -(-self.maps // self.batch_size)

    def __iter__(self) -> Iterator[MapKey]:
        """Yields the batches of the epoch."""
        epoch = np.array([self.epoch])
        order, symmetry = np.arange(self.maps), np.zeros(self.maps, dtype=np.int64)
        if self.shuffle:
            order = rng.permutation(rng.stream_key(self.seed, "models", "map order"), epoch, self.maps)[0]
            drawn = rng.uniform(rng.stream_key(self.seed, "models", "map symmetry"), epoch, (self.maps,))[0]
            symmetry = np.array(self.symmetries)[(drawn * len(self.symmetries)).astype(np.int64)]
        pieces = (np.array_split(values, len(self)) for values in (order, symmetry))
        for index, which in zip(*pieces, strict=True):
            yield torch.from_numpy(index), torch.from_numpy(which)


class MapData(lightning.LightningDataModule):
    """The maps of the splits `train` and `valid`, for the classifier.

    Training maps are turned and mirrored at random together with their classes. That stays physical:
    the light comes from a random direction.

    Args:
        dataset: where they are.
        batch_size: most maps a batch.
        seed: root seed of order and augmentation.

    Raises:
        DatasetError: a split is missing, or there are fewer than two maps to train on.
    """

    def __init__(self, dataset: TerrainDataset, batch_size: int, seed: int) -> None:
        """Reads the maps into memory."""
        super().__init__()
        if batch_size < 2:
            raise ConfigError(f"Expected `batch_size` ≥ 2, got {batch_size}.")
        self.batch_size, self.seed = batch_size, seed
        self.train, self.valid = (_read_maps(dataset, split) for split in (TRAIN, VALID))
        if len(self.train) < 2:
            raise DatasetError(f"Expected at least 2 training maps in {dataset.path}, got {len(self.train)}.")

    def colour_statistics(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the training maps' colours, 0–255, each of shape [3]."""
        counts = torch.stack(
            [channel.flatten().bincount(minlength=256) for channel in self.train.rgb.unbind(1)]
        )
        share, level = counts.double() / counts.sum(1, keepdim=True), torch.arange(256.0, dtype=torch.float64)
        mean = (share * level).sum(1)
        variance = (share * level**2).sum(1) - mean**2
        return mean.float(), variance.clamp(min=1).sqrt().float()

    def train_dataloader(self) -> DataLoader[Batch]:
        """Augmented batches in random order."""
        square = self.train.rgb.shape[-1] == self.train.rgb.shape[-2]
        symmetries = _SYMMETRIES if square else _SYMMETRIES_OF_RECTANGLE
        return _load(self.train, MapSampler(len(self.train), self.batch_size, self.seed, symmetries, True))

    def val_dataloader(self) -> DataLoader[Batch]:
        """Batches as stored, in order."""
        return _load(self.valid, MapSampler(len(self.valid), self.batch_size, self.seed, (0,), False))


@dataclass(frozen=True, kw_only=True)
class PixelTable:
    """Cells by class: what the GPs learn from. Rows are padded with zeros to one length.

    Args:
        slope_deg: float32, shape [C, N].
        traversability: observed λ in [0, 1], float32, shape [C, N].
        count: how many of a row's entries hold data, int64, shape [C].
    """

    slope_deg: Tensor
    traversability: Tensor
    count: Tensor

    @classmethod
    def group(
        cls,
        class_id: Tensor,
        slope_deg: Tensor,
        traversability: Tensor,
        class_count: int,
        max_points: int = 10_000,
        seed: int = 0,
    ) -> "PixelTable":
        """Groups logged cells by class, keeping at most some of each, drawn without replacement.

        Args:
            class_id: integers in [0, C), any shape.
            slope_deg: slopes in [0, 90], shape of `class_id`.
            traversability: observed λ in [0, 1], shape of `class_id`.
            class_count: C.
            max_points: most cells to keep of a class.
            seed: root seed of the draw.

        Raises:
            ConfigError: the columns differ in length or hold values out of range.
        """
        ids, slopes, observed = (column.flatten() for column in (class_id, slope_deg, traversability))
        _check_columns(ids, slopes, observed, class_count, max_points)
        key = rng.stream_key(seed, "models", "pixels")
        rows = [_draw_rows(ids, c, key, max_points) for c in range(class_count)]
        count = torch.tensor([len(row) for row in rows])
        table = torch.zeros(2, class_count, int(count.max()))
        for c, row in enumerate(rows):
            table[0, c, : len(row)], table[1, c, : len(row)] = slopes[row], observed[row]
        return cls(slope_deg=table[0], traversability=table[1], count=count)


def read_pixels(dataset: TerrainDataset, split: str, max_points: int = 10_000, seed: int = 0) -> PixelTable:
    """Reads the cells of a split, by class.

    Args:
        dataset: where they are.
        split: name of a split.
        max_points: most cells to keep of a class.
        seed: root seed of the draw.

    Raises:
        DatasetError: there is no such split.
    """
    names = ("class_id", "slope_deg", "traversability")
    maps = dataset.read(split, fields=names)
    class_id, slope_deg, traversability = (torch.from_numpy(maps[name]) for name in names)
    classes = len(dataset.recipe.classes)
    return PixelTable.group(class_id, slope_deg, traversability, classes, max_points, seed)


def _read_maps(dataset: TerrainDataset, split: str) -> MapDataset:
    maps = dataset.read(split, fields=("rgb", "class_id"))
    return MapDataset(torch.from_numpy(maps["rgb"]), torch.from_numpy(maps["class_id"]))


def _load(maps: MapDataset, sampler: MapSampler) -> DataLoader[Batch]:
    # A generator of its own keeps the loader from drawing on PyTorch's global one.
    return DataLoader(maps, batch_size=None, sampler=sampler, generator=torch.Generator())


def _draw_rows(ids: Tensor, class_id: int, key: int, most: int) -> Tensor:
    rows = (ids == class_id).nonzero().flatten()
    if len(rows) <= most:
        return rows
    drawn = np.argpartition(rng.uniform(key, np.array([class_id]), (len(rows),))[0], most)[:most]
    return rows[torch.from_numpy(np.sort(drawn))]


def _check_columns(ids: Tensor, slopes: Tensor, observed: Tensor, class_count: int, max_points: int) -> None:
    if not len(ids) == len(slopes) == len(observed) > 0:
        raise ConfigError(
            "Expected `class_id`, `slope_deg` and `traversability` of one length > 0, "
            f"got {len(ids)}, {len(slopes)} and {len(observed)}."
        )
    if max_points < 1:
        raise ConfigError(f"Expected `max_points` ≥ 1, got {max_points}.")
    limits = {"class_id": (ids, class_count - 1), "slope_deg": (slopes, 90), "traversability": (observed, 1)}
    for name, (column, most) in limits.items():
        if not bool(((column >= 0) & (column <= most)).all()):
            raise ConfigError(f"Expected `{name}` within [0, {most}], got values outside it.")
