"""The order in which an epoch of training takes the maps: shuffled within windows of shards.

To take maps from thousands of shards in any order would open a file for nearly every map. So the shards are put in a
random order and cut into windows, and the maps of a window are shuffled: a window's files are opened once. Letters in
shapes: B maps.
"""

from collections.abc import Sequence

import numpy as np

from benchnav.core import rng

WINDOW_SHARDS = 100  # fewer than the files that a reader keeps open, so that hardly any is opened twice


def map_order(shards: Sequence[int], seed: int, epoch: int) -> np.ndarray:
    """Draws the order of an epoch, a pure function of its arguments.

    Windows have nearly the same number of shards, 100 at most. So many shards as fit into one window are shuffled as
    one file with all their maps would be.

    Args:
        shards: how many maps each holds, in order.
        seed: root seed.
        epoch: of the training.

    Returns:
        Indices of the maps, int64, shape [B].
    """
    which = np.array([epoch])
    turn = rng.permutation(rng.stream_key(seed, "models", "shard order"), which, len(shards))[0]
    windows = -(-len(shards) // WINDOW_SHARDS)
    window = turn * windows // len(shards)
    drawn = rng.uniform(rng.stream_key(seed, "models", "map order"), which, (sum(shards),))[0]
    return np.lexsort((drawn, np.repeat(window, shards)))
