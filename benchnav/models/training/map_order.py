"""Order of the maps in an epoch of training, and the random numbers of each map.

With thousands of shards, consecutive maps of a fully random order would nearly always
be in different files, and each file would be opened many times. Therefore the shards
are shuffled and divided into windows, and the maps within a window are shuffled, so
that each file is opened once.
Letters in shapes: B maps in total, b maps in a batch.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Sampler

from benchnav.core import rng

# Below the number of files that a reader keeps open, so that few files are opened twice.
WINDOW_SHARDS = 100


def map_order(shards: Sequence[int], seed: int, epoch: int) -> np.ndarray:
    """Return the random order of the maps in an epoch, by seed and epoch.

    Windows have nearly equal numbers of shards, at most 100. Shards that fit into one
    window are shuffled as if all their maps were in one file.

    Args:
        shards: number of maps in each shard, in the order of the shards.
        seed: root seed of the order.
        epoch: index of the epoch.

    Returns:
        Indices of the maps, int64, shape [B].
    """
    epochs = np.array([epoch])
    shard_key = rng.stream_key(seed, "models", "shard order")
    rank = rng.permutation(shard_key, epochs, len(shards))[0]
    n_windows = -(-len(shards) // WINDOW_SHARDS)
    window = rank * n_windows // len(shards)
    map_key = rng.stream_key(seed, "models", "map order")
    uniform = rng.uniform(map_key, epochs, (sum(shards),))[0]
    return np.lexsort((uniform, np.repeat(window, shards)))


class MapKey(NamedTuple):
    """Indices of the maps of a batch, and the augmentation of each map.

    Args:
        maps: indices of the maps, int64, shape [b].
        symmetry: symmetry of each map, see `apply_symmetry`, int64, shape [b].
        factors: factors of `apply_jitter`, shape [b, 3].
        origin: first row and column of the square cut from each map, int64, shape [b, 2].
        visibility: uniform random numbers of `RandomMasks`, float64, shape [b, 8].
    """

    maps: Tensor
    symmetry: Tensor
    factors: Tensor
    origin: Tensor
    visibility: Tensor


def crop_origins(
    shape: tuple[int, int], crop: int, seed: int, epoch: int, count: int
) -> np.ndarray:
    """Draw the origins of squares cut from maps, by seed, epoch and index.

    Args:
        shape: (H, W) of the maps.
        crop: side of the squares in cells; 0 for whole maps, whose origin is 0.
        seed: root seed of the squares.
        epoch: index of the epoch.
        count: number of squares in the epoch.

    Returns:
        First rows and columns, int64, shape [count, 2].
    """
    if not crop:
        return np.zeros((count, 2), dtype=np.int64)
    key = rng.stream_key(seed, "models", "map crop")
    uniform = rng.uniform(key, np.array([epoch]), (count, 2))[0]
    return (uniform * (np.array(shape) - crop + 1)).astype(np.int64)


def draw_visibility(seed: int, epoch: int, count: int) -> np.ndarray:
    """Draw the random numbers of `RandomMasks`, by seed, epoch and index.

    Args:
        seed: root seed of the random numbers.
        epoch: index of the epoch.
        count: number of maps in the epoch.

    Returns:
        Uniform random numbers in (0, 1), float64, shape [count, 8].
    """
    key = rng.stream_key(seed, "models", "map look")
    return rng.uniform(key, np.array([epoch]), (count, 8))[0]


def squares_per_map(shape: tuple[int, int], crop: int) -> int:
    """Return the number of squares per training map and epoch; 1 for whole maps."""
    return (shape[0] // crop) * (shape[1] // crop) if crop else 1


@dataclass(eq=False)
class MapSampler(Sampler[MapKey]):
    """Batches of nearly equal size, in an order keyed by seed and epoch.

    Args:
        maps: number of maps.
        batch_size: maximum number of maps per batch.
        seed: root seed of order and augmentation.
        symmetries: indices of the symmetries to draw from; (0,) leaves maps unchanged.
        jitter: maximum relative change of brightness, contrast and saturation.
        shuffle: whether order, symmetries and squares change each epoch.
        process: (i, n) for the i-th of n processes that train together: every n-th map of a
            batch is used, starting with map i.
        crop: side in cells of the squares cut from maps; 0 for whole maps.
        shape: (H, W) of the maps.
        epoch: index of the epoch of the next iteration.
        shards: number of maps in each file of the dataset, in the order of the files;
            empty for a single file.
    """

    maps: int
    batch_size: int
    seed: int = 0
    symmetries: tuple[int, ...] = (0,)
    jitter: float = 0.0
    shuffle: bool = False
    process: tuple[int, int] = (0, 1)
    crop: int = 0
    shape: tuple[int, int] = (0, 0)
    epoch: int = 0
    shards: tuple[int, ...] = ()

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch of the next iteration; the trainer calls this."""
        self.epoch = epoch

    @property
    def length(self) -> int:
        """Number of maps per epoch, or of squares if maps are cut."""
        if not self.shuffle:
            return self.maps
        return self.maps * squares_per_map(self.shape, self.crop)

    def __len__(self) -> int:
        """Return the number of batches per epoch."""
        return -(-self.length // self.batch_size)

    def __iter__(self) -> Iterator[MapKey]:
        """Yield the batches of the epoch."""
        count = self.length
        epoch = self.epoch if self.shuffle else 0
        epochs = np.array([epoch])
        order = np.arange(count)
        if self.shuffle:
            n_squares = count // self.maps
            shards = tuple(n_squares * n_maps for n_maps in self.shards or (self.maps,))
            order = map_order(shards, self.seed, self.epoch) // n_squares
        symmetry_key = rng.stream_key(self.seed, "models", "map symmetry")
        uniform = rng.uniform(symmetry_key, epochs, (count,))[0]
        index = (uniform * len(self.symmetries)).astype(np.int64)
        symmetry = np.array(self.symmetries)[index]
        jitter_key = rng.stream_key(self.seed, "models", "map jitter")
        uniform = rng.uniform(jitter_key, epochs, (count, 3))[0]
        factors = 1 + self.jitter * (2 * uniform - 1)
        origins = crop_origins(self.shape, self.crop, self.seed, epoch, count)
        visibility = draw_visibility(self.seed, epoch, count)
        arrays = (order, symmetry, factors, origins, visibility)
        batches = zip(*(np.array_split(v, len(self)) for v in arrays), strict=True)
        first, step = self.process
        for batch in batches:
            start = min(first, len(batch[0]) - 1)  # each process gets at least one map
            yield MapKey(*(torch.from_numpy(values[start::step]) for values in batch))
