"""The order in which an epoch of training takes the maps, and what is done to each.

To take maps from thousands of shards in any order would open a file for nearly every
map. So the shards are put in a random order and cut into windows, and the maps of a
window are shuffled: a window's files are opened once. Letters in
shapes: B maps in all, b maps in a batch.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Sampler

from benchnav.core import rng

# fewer than the files that a reader keeps open, so that hardly any is opened twice
WINDOW_SHARDS = 100


def map_order(shards: Sequence[int], seed: int, epoch: int) -> np.ndarray:
    """Draws the order of an epoch, a pure function of its arguments.

    Windows have nearly the same number of shards, 100 at most. So many shards as fit
    into one window are shuffled as one file with all their maps would be.

    Args:
        shards: how many maps each holds, in order.
        seed: root seed.
        epoch: of the training.

    Returns:
        Indices of the maps, int64, shape [B].
    """
    which = np.array([epoch])
    turn = rng.permutation(
        rng.stream_key(seed, "models", "shard order"), which, len(shards)
    )[0]
    windows = -(-len(shards) // WINDOW_SHARDS)
    window = turn * windows // len(shards)
    drawn = rng.uniform(
        rng.stream_key(seed, "models", "map order"), which, (sum(shards),)
    )[0]
    return np.lexsort((drawn, np.repeat(window, shards)))


class MapKey(NamedTuple):
    """Which maps a batch holds, and what is done to each.

    Args:
        maps: indices of the maps, int64, shape [b].
        symmetry: that each is turned by, int64, shape [b].
        factors: of `apply_jitter`, shape [b, 3].
        origin: first row and column of the square that is cut from each, int64, shape
            [b, 2].
        look: uniform numbers that decide what of each is seen, see `RandomMasks`,
            float64, shape [b, 8].
    """

    maps: Tensor
    symmetry: Tensor
    factors: Tensor
    origin: Tensor
    look: Tensor


def crop_origins(
    shape: tuple[int, int], crop: int, seed: int, epoch: int, count: int
) -> np.ndarray:
    """Draws where squares are cut from maps, by (seed, epoch, place).

    Args:
        shape: (H, W) of the maps.
        crop: cells of a side; 0 takes whole maps, which begin at 0.
        seed: root seed.
        epoch: of the training.
        count: places in the epoch.

    Returns:
        First rows and columns, int64, shape [count, 2].
    """
    if not crop:
        return np.zeros((count, 2), dtype=np.int64)
    drawn = rng.uniform(
        rng.stream_key(seed, "models", "map crop"), np.array([epoch]), (count, 2)
    )[0]
    return (drawn * (np.array(shape) - crop + 1)).astype(np.int64)


def draw_looks(seed: int, epoch: int, count: int) -> np.ndarray:
    """Draws what decides what of maps is seen, by (seed, epoch, place); see `MapKey`.

    Args:
        seed: root seed.
        epoch: of the training.
        count: places in the epoch.

    Returns:
        Uniform in (0, 1), float64, shape [count, 8].
    """
    return rng.uniform(
        rng.stream_key(seed, "models", "map look"), np.array([epoch]), (count, 8)
    )[0]


def squares_a_map(shape: tuple[int, int], crop: int) -> int:
    """Squares that a training map gives an epoch: as many as it has room for; 1 of
    whole maps.
    """
    return (shape[0] // crop) * (shape[1] // crop) if crop else 1


@dataclass(eq=False)
class MapSampler(Sampler[MapKey]):
    """Cuts the maps into batches of nearly equal size, in an order keyed by (seed,
    epoch).

    Args:
        maps: how many there are.
        batch_size: most maps a batch.
        seed: root seed.
        symmetries: which symmetries to draw from; (0,) leaves maps as they are.
        jitter: largest relative change of brightness, contrast and saturation.
        shuffle: whether order, symmetries and squares change each epoch.
        share: (i, n): of every batch take the i-th of n interleaved parts, for one of n
            processes.
        crop: cells of a side of the squares that are cut from maps; 0 takes whole maps.
        shape: (H, W) of the maps that squares are cut from.
        epoch: that the next iteration gives.
        shards: how many maps each file of the dataset holds, in order; none where one
            holds them all.
    """

    maps: int
    batch_size: int
    seed: int = 0
    symmetries: tuple[int, ...] = (0,)
    jitter: float = 0.0
    shuffle: bool = False
    share: tuple[int, int] = (0, 1)
    crop: int = 0
    shape: tuple[int, int] = (0, 0)
    epoch: int = 0
    shards: tuple[int, ...] = ()

    def set_epoch(self, epoch: int) -> None:
        """Chooses the epoch that the next iteration gives; the trainer calls this."""
        self.epoch = epoch

    @property
    def places(self) -> int:
        """Maps an epoch, or squares of them."""
        return self.maps * (squares_a_map(self.shape, self.crop) if self.shuffle else 1)

    def __len__(self) -> int:
        """Batches an epoch."""
        return -(-self.places // self.batch_size)

    def __iter__(self) -> Iterator[MapKey]:
        """Yields the batches of the epoch."""
        count, number = self.places, self.epoch if self.shuffle else 0
        order, epoch = np.arange(count), np.array([number])
        if self.shuffle:
            squares = count // self.maps
            shards = tuple(squares * maps for maps in self.shards or (self.maps,))
            order = map_order(shards, self.seed, self.epoch) // squares
        drawn = rng.uniform(
            rng.stream_key(self.seed, "models", "map symmetry"), epoch, (count,)
        )[0]
        symmetry = np.array(self.symmetries)[
            (drawn * len(self.symmetries)).astype(np.int64)
        ]
        drawn = rng.uniform(
            rng.stream_key(self.seed, "models", "map jitter"), epoch, (count, 3)
        )[0]
        factors = 1 + self.jitter * (2 * drawn - 1)
        origins = crop_origins(self.shape, self.crop, self.seed, number, count)
        looks = draw_looks(self.seed, number, count)
        first, step = self.share
        pieces = (
            np.array_split(v, len(self))
            for v in (order, symmetry, factors, origins, looks)
        )
        for batch in zip(*pieces, strict=True):
            start = min(first, len(batch[0]) - 1)  # no process is left without a map
            yield MapKey(*(torch.from_numpy(values[start::step]) for values in batch))
