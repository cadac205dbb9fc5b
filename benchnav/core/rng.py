"""Named random streams: from a root seed and names to random numbers, with no global
state.

A stream is named by a root seed and any strings or integers, for example
`(seed, "test/hs", "elevation")`. Element `i` of a stream (a map) owns a block of its
own in the counter of a Philox generator, so its numbers are the same whatever batch,
order or worker asks for them. The transforms from raw bits are ours: libraries change
theirs between versions, while a bit generator's raw output is specified.

Source: Salmon et al. (2011), "Parallel random numbers: as easy as 1, 2, 3"
(Philox4x64-10).
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

_WORDS_PER_COUNT = 4  # Philox4x64 yields four 64-bit words at each count
_SHORT_GAP = 64  # counts that are as soon drawn as skipped
# Philox4x64: multipliers of both halves, and what is added to both halves of the key in
# each of ten rounds.
_MULTIPLIERS = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
_BUMPS = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B)
_ROUNDS = 10
_HALF, _LOW = np.uint64(32), np.uint64(2**32 - 1)


@lru_cache(maxsize=2**14)
def stream_key(seed: int, *names: Name) -> int:
    """Hashes a root seed and names to a 128-bit key; distinct names give independent
    streams.
    """
    text = json.dumps([int(seed), *names], separators=(",", ":"))
    return int.from_bytes(
        hashlib.blake2b(text.encode(), digest_size=16).digest(), "little"
    )


def random_bits(key: int, indices: ndarray, count: int) -> ndarray:
    """Draws the raw bits of some elements of a stream.

    Args:
        key: stream key, from `stream_key`.
        indices: which elements, integers ≥ 0, shape [B].
        count: 64-bit words an element; a property of the stream, the same at every
            call.

    Returns:
        Raw words, uint64, shape [B, count].
    """
    indices = np.asarray(indices, dtype=np.int64)
    if indices.size == 0:
        return np.empty((0, count), dtype=np.uint64)
    counts = -(-count // _WORDS_PER_COUNT)
    gaps = np.diff(indices)
    ends = np.flatnonzero((gaps < 1) | (gaps * counts > _SHORT_GAP)) + 1
    generator, at, words = np.random.Philox(key=key), 0, []
    # One generator that is moved on, as making one takes as long as drawing two
    # thousand words.
    for run in np.split(indices, ends):
        first, size = int(run[0]) * counts, int(run[-1] - run[0] + 1)
        generator.advance((first - at) % 2**256)
        drawn = generator.random_raw(size * counts * _WORDS_PER_COUNT).reshape(size, -1)
        words.append(drawn[run - run[0], :count])
        at = first + size * counts
    return np.concatenate(words)


def uniform(key: int, indices: ndarray, shape: tuple[int, ...] = ()) -> ndarray:
    """Draws uniforms in the open interval (0, 1), float64, shape [B, *shape]."""
    bits = random_bits(key, indices, int(np.prod(shape, dtype=int)))
    return _uniform_of(bits).reshape(len(bits), *shape)


def _uniform_of(bits: ndarray) -> ndarray:
    """Uniforms in (0, 1) of raw words."""
    drawn = ((bits >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53
    # The largest of the words rounds up to 1, of which the inverse normal is infinite.
    return np.minimum(drawn, 1 - 2.0**-53)


def normal(key: int, indices: ndarray, shape: tuple[int, ...] = ()) -> ndarray:
    """Draws standard normals by inversion, float64, shape [B, *shape]."""
    from scipy.special import ndtri

    return ndtri(uniform(key, indices, shape))


def normal_of_each(
    keys: Sequence[int], stream: ndarray, indices: ndarray, count: int = 1
) -> ndarray:
    """Draws what `normal` draws, of few elements of many streams at once.

    Args:
        keys: of the streams.
        stream: which of them each element is of, integers, shape [N].
        indices: which of its elements, integers ≥ 0, shape [N].
        count: how many numbers an element.

    Returns:
        Standard normals, float64, shape [N, count].
    """
    from scipy.special import ndtri

    halves = np.array(
        [(key % 2**64, key >> 64) for key in keys], dtype=np.uint64
    ).reshape(-1, 2)[stream]
    counts = -(-count // _WORDS_PER_COUNT)
    at = indices.astype(np.uint64)[:, None] * np.uint64(counts) + np.arange(
        1, counts + 1, dtype=np.uint64
    )
    words = [at, *(np.zeros_like(at) for _ in range(3))]
    halves = halves[:, :, None]
    with np.errstate(over="ignore"):
        for turn in range(_ROUNDS):
            first, second = (
                halves[:, place] + np.uint64(turn) * _BUMPS[place] for place in (0, 1)
            )
            high, low = _product(_MULTIPLIERS[0], words[0])
            other_high, other_low = _product(_MULTIPLIERS[1], words[2])
            words = [
                other_high ^ words[1] ^ first,
                other_low,
                high ^ words[3] ^ second,
                low,
            ]
    bits = np.stack(words, axis=-1).reshape(len(indices), _WORDS_PER_COUNT * counts)[
        :, :count
    ]
    return ndtri(_uniform_of(bits))


def _product(one: np.uint64, other: ndarray) -> tuple[ndarray, ndarray]:
    """High and low words of a product of 128 bits."""
    one_high, one_low, high, low = (
        one >> _HALF,
        one & _LOW,
        other >> _HALF,
        other & _LOW,
    )
    middle = one_high * low + (one_low * low >> _HALF)
    carried = one_low * high + (middle & _LOW)
    return one_high * high + (middle >> _HALF) + (carried >> _HALF), one * other


def permutation(key: int, indices: ndarray, n: int) -> ndarray:
    """Draws uniformly random permutations of range(n), int64, shape [B, n]."""
    return np.argsort(uniform(key, indices, (n,)), axis=1, kind="stable")


def generator(key: int) -> "torch.Generator":
    """Makes a PyTorch generator for the stream `key` on the CPU, for bulk draws of
    planners.

    PyTorch's generator on the CPU keeps the low 32 bits of a seed: hash a key for every
    draw, as `stream_key` does, rather than count on from one.
    """
    import torch

    return torch.Generator().manual_seed(key % 2**63)
