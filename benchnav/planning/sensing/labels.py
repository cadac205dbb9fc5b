"""Which of two classes cells are of: a Potts field of two states, sampled by 64 chains
at once, a bit each.

Cells that may be of one of two classes have neighbours, of four, that may be of the
same two. Zero field, strength β:

    P(labels) ∝ exp(β · number of such neighbours with one label).

A cell's 64 labels are the bits of one integer, so that a few operations on integers
sweep all chains (multi-spin coding). Heat-bath sweeps go over one colour of the
checkerboard after the other. P(class) is estimated from clusters (Swendsen and Wang
1987): neighbours of one label are tied with the probability 1 − exp(−β), and cells that
no ties join to evidence are of either class by half, whatever their bit. Random numbers
are keyed by cell and by how many sweeps an episode has had, so that an episode has the
same whoever is beside it.
Letters in shapes: B episodes, H×W cells, S chains.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng

CHAINS = 64
_SWEEPS = 64  # of which random numbers are kept; later ones take them from other cells
_STEP = 11, 29  # by how many rows and columns, of the torus
_MOST = 4  # neighbours

_HALVES = (0x5555555555555555, 0x3333333333333333, 0x0F0F0F0F0F0F0F0F)


@dataclass(frozen=True)
class Lattice:
    """Couplings between neighbouring cells.

    Args:
        right: all bits set where a cell and the one to its right do, int64, shape [B,
            H, W].
        down: as much of the one below.
        strength: β.
    """

    right: Tensor
    down: Tensor
    strength: float

    @classmethod
    def of(cls, pair: Tensor, strength: float) -> "Lattice":
        """The lattice of cells of pairs, by the number of the pair, 0 for none, int64,
        shape [B, H, W].
        """
        right, down = torch.zeros_like(pair), torch.zeros_like(pair)
        right[..., :-1] = -(
            (pair[..., :-1] == pair[..., 1:]) & (pair[..., 1:] > 0)
        ).long()
        down[..., :-1, :] = -(
            (pair[..., :-1, :] == pair[..., 1:, :]) & (pair[..., 1:, :] > 0)
        ).long()
        return cls(right, down, strength)

    def neighbours(self, words: Tensor) -> tuple[Tensor, ...]:
        """Words of the cells to the right, to the left, below and above, 0 where none
        hangs together.
        """
        return (
            words.roll(-1, -1) & self.right,
            (words & self.right).roll(1, -1),
            words.roll(-1, -2) & self.down,
            (words & self.down).roll(1, -2),
        )

    def degree(self) -> Tensor:
        """How many neighbours each cell has, int64, shape [B, H, W]."""
        none = torch.full_like(self.right, -1)
        return -sum(self.neighbours(none), torch.zeros_like(none))


@dataclass(frozen=True)
class Noise:
    """Random bits of a sweep.

    Args:
        chosen: for 0 to 4 neighbours of the first class, whether the cell becomes of
            it, int64, five of [B, H, W].
        right: whether a cell is tied to its right neighbour, if they are of one class.
        down: as much of the one below.
    """

    chosen: tuple[Tensor, ...]
    right: Tensor
    down: Tensor


def noise(
    sweep: Tensor,
    row: Tensor,
    column: Tensor,
    degree: Tensor,
    strength: float,
    size: int,
) -> Noise:
    """The random bits of each episode's next sweep.

    Args:
        sweep: how many each episode has had, int64, shape [B].
        row: of the cells, int64, shape [B, H, W].
        column: of the cells.
        degree: how many neighbours they have.
        strength: β.
        size: of the torus that random numbers are kept for, at least that of a map.
    """
    bank, uses = _bank(strength, size).to(row.device), sweep[:, None, None] // _SWEEPS
    turn = sweep[:, None, None] % _SWEEPS
    place = ((row + uses * _STEP[0]) % size) * size + (column + uses * _STEP[1]) % size
    levels = [
        (2 * many - degree + _MOST).clamp(0, 2 * _MOST) for many in range(_MOST + 1)
    ]
    chosen = tuple(bank[turn, place, level] for level in levels)
    return Noise(
        chosen, bank[turn, place, 2 * _MOST + 1], bank[turn, place, 2 * _MOST + 2]
    )


@lru_cache(maxsize=4)
def _bank(strength: float, size: int) -> Tensor:
    """Bits of all sweeps: for log odds of −4β to 4β, and two ties; int64, shape
    [sweeps, size², 11].
    """
    key = rng.stream_key(0, "labels", "sweeps")
    chances = 1 / (1 + np.exp(-strength * np.arange(-_MOST, _MOST + 1)))
    found = np.empty((_SWEEPS, size * size, 2 * _MOST + 3), dtype=np.int64)
    for sweep in range(_SWEEPS):
        drawn = rng.uniform(key, np.array([sweep]), (3, size * size, CHAINS))[0]
        for level, chance in enumerate(chances):
            found[sweep, :, level] = _packed(drawn[0] < chance)
        for way in (1, 2):
            found[sweep, :, 2 * _MOST + way] = _packed(
                drawn[way] < -np.expm1(-strength)
            )
    return torch.from_numpy(found)


def _packed(bits: np.ndarray) -> np.ndarray:
    return np.packbits(bits, axis=-1, bitorder="little").view("<i8")[:, 0]


def fair(height: int, width: int) -> Tensor:
    """Labels by the toss of a coin, int64, shape [H, W]."""
    bits = (
        rng.uniform(
            rng.stream_key(0, "labels", "first"), np.arange(height * width), (CHAINS,)
        )
        < 0.5
    )
    return torch.from_numpy(_packed(bits)).view(height, width)


def swept(
    labels: Tensor, lattice: Lattice, free: Tensor, even: Tensor, drawn: Noise
) -> Tensor:
    """Draws labels anew given their neighbours', int64, shape [B, H, W].

    Args:
        labels: int64, shape [B, H, W].
        lattice: of these cells.
        free: all bits set where a label may change, int64.
        even: all bits set on the cells of one colour of the checkerboard, int64.
        drawn: random bits.
    """
    for colour in (free & even, free & ~even):
        right, left, below, above = lattice.neighbours(labels)
        # The number of neighbours of the first class, of three binary digits.
        odd, pair, other, second = (
            right ^ left,
            right & left,
            below ^ above,
            below & above,
        )
        ones, carry = odd ^ other, odd & other
        twos, fours = pair ^ second ^ carry, pair & second
        none = ~(ones | twos | fours)
        exactly = (none, ones & ~twos, twos & ~ones, ones & twos, fours)
        new = torch.zeros_like(labels)
        for number, choice in zip(exactly, drawn.chosen, strict=True):
            new |= number & choice
        labels = (labels & ~colour) | (new & colour)
    return labels


def joined(labels: Tensor, lattice: Lattice, evidence: Tensor, drawn: Noise) -> Tensor:
    """In which chains ties join cells to evidence, int64, shape [B, H, W].

    Args:
        labels: int64, shape [B, H, W].
        lattice: of these cells.
        evidence: all bits set on cells of which something is known, int64.
        drawn: random bits.
    """
    right = lattice.right & drawn.right & ~(labels ^ labels.roll(-1, -1))
    down = lattice.down & drawn.down & ~(labels ^ labels.roll(-1, -2))
    ties = Lattice(right, down, lattice.strength)
    found = evidence
    while True:
        before = found
        for _ in range(4):  # to look whether all is found takes as long as a step
            one, two, three, four = ties.neighbours(found)
            found = found | one | two | three | four
        if torch.equal(found, before):
            return found


def tally(words: Tensor) -> Tensor:
    """How many bits are set, int64."""
    pairs, fours, bytes_ = _HALVES
    words = words - ((words >> 1) & pairs)
    words = (words & fours) + ((words >> 2) & fours)
    words = (words + (words >> 4)) & bytes_
    return ((words * 0x0101010101010101) >> 56) & 0xFF


def unpacked(words: Tensor) -> Tensor:
    """Bits of words of shape [*], bool, shape [*, S]."""
    return (words[..., None] >> torch.arange(CHAINS, device=words.device) & 1).bool()


def packed(bits: Tensor) -> Tensor:
    """Words of bits of shape [*, S], int64, shape [*]."""
    return (bits.long() << torch.arange(CHAINS, device=bits.device)).sum(-1)
