"""Named random streams: random numbers from a root seed and names, with no state.

A stream is named by a root seed and any strings or integers, for example
`(seed, "test/hs", "elevation")`. An element of a stream, such as a map, has its own
block of counter values of a Philox generator. Its numbers therefore do not depend on
the batch, the order or the worker. This module implements the transforms from raw bits
to numbers, because the transforms of libraries change between versions, whereas the raw
output of the generator is specified.

Source: Salmon et al. (2011), "Parallel random numbers: as easy as 1, 2, 3"
(Philox4x64-10).
Letters in shapes: B or N elements.
"""

import hashlib
import json
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy import ndarray

if TYPE_CHECKING:
    import torch

Name = str | int

_WORDS_PER_COUNT = 4  # Philox4x64 yields four 64-bit words per counter value
# Number of counter values whose words take as long to draw as to skip.
_SHORT_GAP = 64
# Constants of Philox4x64: multipliers, and increments of the two halves of the key in
# each of ten rounds.
_MULTIPLIERS = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
_BUMPS = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B)
_ROUNDS = 10
_HALF, _LOW = np.uint64(32), np.uint64(2**32 - 1)


@lru_cache(maxsize=2**14)
def stream_key(seed: int, *names: Name) -> int:
    """Return the 128-bit key of a stream; streams of different keys are independent."""
    text = json.dumps([int(seed), *names], separators=(",", ":"))
    digest = hashlib.blake2b(text.encode(), digest_size=16).digest()
    return int.from_bytes(digest, "little")


def random_bits(key: int, indices: ndarray, count: int) -> ndarray:
    """Draw the raw bits of elements of a stream.

    Args:
        key: stream key, from `stream_key`.
        indices: indices of the elements, integers ≥ 0, shape [B].
        count: 64-bit words per element; the same at each call for a stream.

    Returns:
        Raw words, uint64, shape [B, count].
    """
    indices = np.asarray(indices, dtype=np.int64)
    if indices.size == 0:
        return np.empty((0, count), dtype=np.uint64)
    n_counts = -(-count // _WORDS_PER_COUNT)  # counter values per element
    gaps = np.diff(indices)
    ends = np.flatnonzero((gaps < 1) | (gaps * n_counts > _SHORT_GAP)) + 1
    generator = np.random.Philox(key=key)
    position = 0
    words = []
    # A single generator is advanced, since the creation of a generator takes as long as
    # drawing two thousand words.
    for run in np.split(indices, ends):
        first = int(run[0]) * n_counts
        size = int(run[-1] - run[0] + 1)
        generator.advance((first - position) % 2**256)
        n_words = size * n_counts * _WORDS_PER_COUNT
        drawn = generator.random_raw(n_words).reshape(size, -1)
        words.append(drawn[run - run[0], :count])
        position = first + size * n_counts
    return np.concatenate(words)


def uniform(key: int, indices: ndarray, shape: tuple[int, ...] = ()) -> ndarray:
    """Draw uniform numbers in the open interval (0, 1), float64, shape [B, *shape]."""
    bits = random_bits(key, indices, int(np.prod(shape, dtype=int)))
    return _uniform_of(bits).reshape(len(bits), *shape)


def _uniform_of(bits: ndarray) -> ndarray:
    """Return uniform numbers in (0, 1), float64, from raw words."""
    numbers = ((bits >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53
    # The largest word would round up to 1, for which the normal quantile is infinite.
    return np.minimum(numbers, 1 - 2.0**-53)


def normal(key: int, indices: ndarray, shape: tuple[int, ...] = ()) -> ndarray:
    """Draw standard normals by inversion, float64, shape [B, *shape]."""
    from scipy.special import ndtri

    return ndtri(uniform(key, indices, shape))


def normal_of_each(
    keys: Sequence[int], stream: ndarray, indices: ndarray, count: int = 1
) -> ndarray:
    """Draw the numbers of `normal` for few elements of many streams at once.

    Args:
        keys: keys of the streams.
        stream: index of each element's stream in `keys`, integers, shape [N].
        indices: index of each element in its stream, integers ≥ 0, shape [N].
        count: numbers per element.

    Returns:
        Standard normals, float64, shape [N, count].
    """
    from scipy.special import ndtri

    pairs = [(key % 2**64, key >> 64) for key in keys]
    halves = np.array(pairs, dtype=np.uint64).reshape(-1, 2)[stream]
    first_half = halves[:, 0, None]
    second_half = halves[:, 1, None]
    n_counts = -(-count // _WORDS_PER_COUNT)  # counter values per element
    offsets = np.arange(1, n_counts + 1, dtype=np.uint64)
    a = indices.astype(np.uint64)[:, None] * np.uint64(n_counts) + offsets
    b, c, d = (np.zeros_like(a) for _ in range(3))
    with np.errstate(over="ignore"):
        for round_index in range(_ROUNDS):
            first_key = first_half + np.uint64(round_index) * _BUMPS[0]
            second_key = second_half + np.uint64(round_index) * _BUMPS[1]
            high_a, low_a = _product(_MULTIPLIERS[0], a)
            high_c, low_c = _product(_MULTIPLIERS[1], c)
            a = high_c ^ b ^ first_key
            b = low_c
            c = high_a ^ d ^ second_key
            d = low_a
    words = np.stack([a, b, c, d], axis=-1)
    bits = words.reshape(len(indices), _WORDS_PER_COUNT * n_counts)[:, :count]
    return ndtri(_uniform_of(bits))


def _product(factor: np.uint64, values: ndarray) -> tuple[ndarray, ndarray]:
    """Return the high and the low 64-bit words of 128-bit products."""
    factor_high = factor >> _HALF
    factor_low = factor & _LOW
    high = values >> _HALF
    low = values & _LOW
    middle = factor_high * low + (factor_low * low >> _HALF)
    carried = factor_low * high + (middle & _LOW)
    upper = factor_high * high + (middle >> _HALF) + (carried >> _HALF)
    return upper, factor * values


def permutation(key: int, indices: ndarray, n: int) -> ndarray:
    """Draw uniformly random permutations of range(n), int64, shape [B, n]."""
    return np.argsort(uniform(key, indices, (n,)), axis=1, kind="stable")


def generator(key: int) -> "torch.Generator":
    """Return a PyTorch generator on the CPU, for large draws of planners.

    PyTorch's CPU generator uses only the low 32 bits of a seed. Obtain the key of each
    draw from `stream_key` instead of incrementing a key.
    """
    import torch

    return torch.Generator().manual_seed(key % 2**63)
