"""A Potts field of two states on look-alike cells, sampled by 64 chains of one bit.

A cell that may belong to either class of a pair is coupled to those of its four
neighbours that may belong to the same pair. Without an outer field, at strength β:

    P(labels) ∝ exp(β · number of coupled neighbours with equal labels).

A cell's 64 labels are the bits of one integer, so that a few integer operations sweep
all chains (multi-spin coding). Heat-bath sweeps alternate between the two colours of
the checkerboard. P(class) is estimated from clusters (Swendsen and Wang 1987): bonds
join coupled neighbours of equal label with the probability 1 − exp(−β). A cell that no
bonds join to evidence has either class with probability ½, whatever its bit. Random
numbers are keyed by cell and by the number of sweeps of an episode, so that they do not
depend on the other episodes of a batch.
Letters in shapes: B episodes, H×W cells, S chains.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng

CHAINS = 64
_SWEEPS = 64  # with stored random numbers; later sweeps use those of other cells
_STEP = 11, 29  # offset of these cells in rows and columns, on the torus
_NEIGHBOURS = 4
_MAX_LEVEL = 2 * _NEIGHBOURS  # of stored bits by log odds; bonds follow

# Masks of alternate bits, pairs of bits and groups of four bits.
_MASKS = (0x5555555555555555, 0x3333333333333333, 0x0F0F0F0F0F0F0F0F)


@dataclass(frozen=True)
class Couplings:
    """Couplings between neighbouring cells.

    Args:
        right: all bits set where a cell is coupled to the one to its right, int64,
            shape [B, H, W].
        down: likewise for the cell below.
        strength: β.
    """

    right: Tensor
    down: Tensor
    strength: float

    @classmethod
    def of(cls, pair: Tensor, strength: float) -> "Couplings":
        """Return the couplings of cells.

        Args:
            pair: index of each cell's pair from 1; 0 without one, int64, [B, H, W].
            strength: β.
        """
        right = torch.zeros_like(pair)
        down = torch.zeros_like(pair)
        right_pair = pair[..., 1:]
        same_right = (pair[..., :-1] == right_pair) & (right_pair > 0)
        right[..., :-1] = -same_right.long()
        lower_pair = pair[..., 1:, :]
        same_down = (pair[..., :-1, :] == lower_pair) & (lower_pair > 0)
        down[..., :-1, :] = -same_down.long()
        return cls(right, down, strength)

    def neighbours(self, words: Tensor) -> tuple[Tensor, ...]:
        """Return words of the right, left, lower and upper neighbours; 0 if uncoupled."""
        right = words.roll(-1, -1) & self.right
        left = (words & self.right).roll(1, -1)
        below = words.roll(-1, -2) & self.down
        above = (words & self.down).roll(1, -2)
        return right, left, below, above

    def degree(self) -> Tensor:
        """Return the number of coupled neighbours, int64, shape [B, H, W]."""
        all_bits = torch.full_like(self.right, -1)
        return -sum(self.neighbours(all_bits), torch.zeros_like(all_bits))


@dataclass(frozen=True)
class SweepBits:
    """Random bits of a sweep.

    Args:
        first_bits: bits of the chains in which a cell takes the first class, for 0 to 4
            neighbours of that class, int64, five of shape [B, H, W].
        right: bonds to the right neighbour, effective if both have the same class.
        down: likewise for the cell below.
    """

    first_bits: tuple[Tensor, ...]
    right: Tensor
    down: Tensor


def sweep_bits(
    sweep: Tensor,
    row: Tensor,
    column: Tensor,
    degree: Tensor,
    strength: float,
    size: int,
) -> SweepBits:
    """Return the random bits of each episode's next sweep.

    Args:
        sweep: number of sweeps of each episode so far, int64, shape [B].
        row: rows of the cells, int64, shape [B, H, W].
        column: columns of the cells.
        degree: number of coupled neighbours of the cells.
        strength: β.
        size: side of the torus of stored random numbers, at least that of a map.
    """
    bank = _bank(strength, size).to(row.device)
    uses = sweep[:, None, None] // _SWEEPS
    bank_sweep = sweep[:, None, None] % _SWEEPS
    bank_row = (row + uses * _STEP[0]) % size
    bank_column = (column + uses * _STEP[1]) % size
    index = bank_row * size + bank_column
    first_bits = []
    for n_first in range(_NEIGHBOURS + 1):
        level = (2 * n_first - degree + _NEIGHBOURS).clamp(0, _MAX_LEVEL)
        first_bits.append(bank[bank_sweep, index, level])
    right = bank[bank_sweep, index, _MAX_LEVEL + 1]
    down = bank[bank_sweep, index, _MAX_LEVEL + 2]
    return SweepBits(tuple(first_bits), right, down)


@lru_cache(maxsize=4)
def _bank(strength: float, size: int) -> Tensor:
    """Return the bits of all sweeps, int64, shape [sweeps, size², 11].

    The first nine are for log odds of −4β to 4β, the other two are bonds.
    """
    key = rng.stream_key(0, "labels", "sweeps")
    log_odds = strength * np.arange(-_NEIGHBOURS, _NEIGHBOURS + 1)
    probabilities = 1 / (1 + np.exp(-log_odds))
    bond_probability = -np.expm1(-strength)
    n_cells = size * size
    bits = np.empty((_SWEEPS, n_cells, _MAX_LEVEL + 3), dtype=np.int64)
    for sweep in range(_SWEEPS):
        uniform = rng.uniform(key, np.array([sweep]), (3, n_cells, CHAINS))[0]
        for level, probability in enumerate(probabilities):
            bits[sweep, :, level] = _packed(uniform[0] < probability)
        for direction in (1, 2):
            bonds = _packed(uniform[direction] < bond_probability)
            bits[sweep, :, _MAX_LEVEL + direction] = bonds
    return torch.from_numpy(bits)


def _packed(bits: np.ndarray) -> np.ndarray:
    octets = np.packbits(bits, axis=-1, bitorder="little")
    return octets.view("<i8")[:, 0]


def fair_labels(height: int, width: int) -> Tensor:
    """Return labels of probability ½, int64, shape [H, W]."""
    key = rng.stream_key(0, "labels", "first")
    uniform = rng.uniform(key, np.arange(height * width), (CHAINS,))
    words = _packed(uniform < 0.5)
    return torch.from_numpy(words).view(height, width)


def sweep_labels(
    labels: Tensor, couplings: Couplings, free: Tensor, even: Tensor, bits: SweepBits
) -> Tensor:
    """Resample labels given their neighbours', int64, shape [B, H, W].

    Args:
        labels: current labels, int64, shape [B, H, W].
        couplings: couplings of these cells.
        free: all bits set where a label may change, int64.
        even: all bits set on the cells of one colour of the checkerboard, int64.
        bits: random bits.
    """
    for colour in (free & even, free & ~even):
        right, left, below, above = couplings.neighbours(labels)
        # Binary digits of the number of neighbours of the first class.
        odd_row = right ^ left
        pair_row = right & left
        odd_column = below ^ above
        pair_column = below & above
        ones = odd_row ^ odd_column
        carry = odd_row & odd_column
        twos = pair_row ^ pair_column ^ carry
        fours = pair_row & pair_column
        is_zero = ~(ones | twos | fours)
        is_one = ones & ~twos
        is_two = twos & ~ones
        is_three = ones & twos
        counts = (is_zero, is_one, is_two, is_three, fours)
        new = torch.zeros_like(labels)
        for has_count, first_bits in zip(counts, bits.first_bits, strict=True):
            new |= has_count & first_bits
        labels = (labels & ~colour) | (new & colour)
    return labels


def connected_to_evidence(
    labels: Tensor, couplings: Couplings, evidence: Tensor, bits: SweepBits
) -> Tensor:
    """Return bits of chains in which bonds join a cell to evidence, int64, [B, H, W].

    Args:
        labels: labels of the chains, int64, shape [B, H, W].
        couplings: couplings of these cells.
        evidence: all bits set on cells with evidence of their label, int64.
        bits: random bits.
    """
    same_right = ~(labels ^ labels.roll(-1, -1))
    same_below = ~(labels ^ labels.roll(-1, -2))
    right = couplings.right & bits.right & same_right
    down = couplings.down & bits.down & same_below
    bonds = Couplings(right, down, couplings.strength)
    connected = evidence
    while True:
        before = connected
        for _ in range(4):  # a check for convergence takes as long as a step
            for neighbours in bonds.neighbours(connected):
                connected = connected | neighbours
        if torch.equal(connected, before):
            return connected


def count_bits(words: Tensor) -> Tensor:
    """Return the number of set bits, int64."""
    bit_mask, pair_mask, four_mask = _MASKS
    # Counts in each pair of bits, then in each four, then in each byte.
    words = words - ((words >> 1) & bit_mask)
    words = (words & pair_mask) + ((words >> 2) & pair_mask)
    words = (words + (words >> 4)) & four_mask
    total = words * 0x0101010101010101  # the sum of all bytes is in the highest
    return (total >> 56) & 0xFF


def unpacked(words: Tensor) -> Tensor:
    """Return the bits of words of shape [*], bool, shape [*, S]."""
    chain = torch.arange(CHAINS, device=words.device)
    bits = words[..., None] >> chain & 1
    return bits.bool()


def packed(bits: Tensor) -> Tensor:
    """Return words of bits of shape [*, S], int64, shape [*]."""
    chain = torch.arange(CHAINS, device=bits.device)
    return (bits.long() << chain).sum(-1)
