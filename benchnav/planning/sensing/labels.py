"""A Potts field of two states on look-alike cells, sampled by 64 chains.

Look-alike classes come in pairs. A cell that may belong to either class of a pair is
coupled to those of its four neighbours to which the same two classes apply. Without an
external field, at strength β:

    P(labels) ∝ exp(β · number of coupled pairs of neighbours with equal labels).

A label is one bit, 1 for the first class. The labels of a cell in the 64 chains are the
bits of one integer, its word, so that a few integer operations sweep all chains
(multi-spin coding). Heat-bath sweeps draw first the cells of one colour of the
checkerboard, then the cells of the other. P(class) is estimated from clusters (Swendsen
and Wang 1987): bonds join coupled neighbours of equal label with the probability 1 −
exp(−β). If no bonds join a cell to evidence, either class has the probability ½ in that
chain, and the cell's bit is ignored. Random numbers depend only on the cell and on its
episode's number of sweeps, not on the other episodes of a batch.
Letters in shapes: B episodes, H×W cells, S chains.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng

CHAINS = 64
_SWEEPS = 64  # number of sweeps with stored random numbers
# Each time all sweeps have been used, the stored numbers shift by these numbers of rows
# and columns, with wrap-around.
_STEP = 11, 29
_NEIGHBOURS = 4
_MAX_LEVEL = 2 * _NEIGHBOURS  # index of the stored bits with log odds 4β

# Masks of alternate bits, pairs of bits and groups of four bits.
_MASKS = (0x5555555555555555, 0x3333333333333333, 0x0F0F0F0F0F0F0F0F)


@dataclass(frozen=True)
class Couplings:
    """Couplings between neighbouring cells.

    Args:
        right: words with all bits set in cells that are coupled to the cell to their
            right, and with no bit set in others, int64, shape [B, H, W].
        down: the same for the cell below, int64, shape [B, H, W].
        strength: β, ≥ 0.
    """

    right: Tensor
    down: Tensor
    strength: float

    @classmethod
    def of(cls, pair: Tensor, strength: float) -> "Couplings":
        """Return the couplings of cells.

        Args:
            pair: index of each cell's pair from 1; 0 without a pair, int64, shape
                [B, H, W].
            strength: β, ≥ 0.
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
        """Return the words of the right, left, lower and upper neighbours.

        The word of a neighbour that is not coupled is 0.
        """
        right = words.roll(-1, -1) & self.right
        left = (words & self.right).roll(1, -1)
        below = words.roll(-1, -2) & self.down
        above = (words & self.down).roll(1, -2)
        return right, left, below, above

    def degree(self) -> Tensor:
        """Return each cell's number of coupled neighbours, int64, shape [B, H, W]."""
        all_bits = torch.full_like(self.right, -1)
        return -sum(self.neighbours(all_bits), torch.zeros_like(all_bits))


@dataclass(frozen=True)
class SweepBits:
    """Random bits of a sweep.

    Args:
        first_bits: new labels of each cell if 0, 1, 2, 3 or 4 of its neighbours have
            the first class, five tensors of int64 and shape [B, H, W].
        right: bonds to the right neighbour, which apply if both cells have the same
            class, int64, shape [B, H, W].
        down: bonds to the lower neighbour, int64, shape [B, H, W].
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
        column: columns of the cells, int64, shape [B, H, W].
        degree: number of coupled neighbours of each cell, int64, shape [B, H, W].
        strength: β, ≥ 0.
        size: number of rows and of columns of stored random numbers, at least those of
            a map.
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
    """Return the stored bits of all sweeps, int64, shape [sweeps, size², 11].

    The first nine words of a cell are labels for log odds of −4β, −3β, …, 4β. The last
    two are bonds to the right and to the lower neighbour.
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
    """Return words of labels, either class with probability ½, int64, shape [H, W]."""
    key = rng.stream_key(0, "labels", "first")
    uniform = rng.uniform(key, np.arange(height * width), (CHAINS,))
    words = _packed(uniform < 0.5)
    return torch.from_numpy(words).view(height, width)


def sweep_labels(
    labels: Tensor, couplings: Couplings, free: Tensor, even: Tensor, bits: SweepBits
) -> Tensor:
    """Return labels resampled given the labels of neighbours, int64, shape [B, H, W].

    Args:
        labels: current labels, int64, shape [B, H, W].
        couplings: couplings of the cells.
        free: words with all bits set in cells whose labels may change, int64, shape
            [B, H, W].
        even: words with all bits set in cells of one colour of the checkerboard, int64,
            shape [B, H, W].
        bits: random bits of the sweep.
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
    """Return a mask of the chains in which bonds join a cell to evidence.

    Args:
        labels: labels of the chains, int64, shape [B, H, W].
        couplings: couplings of the cells.
        evidence: words with all bits set in cells with evidence of their label, int64,
            shape [B, H, W].
        bits: random bits of the sweep.

    Returns:
        Words with a bit set for each such chain, int64, shape [B, H, W].
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
    # Count in each pair of bits, then in each group of four bits, then in each byte.
    words = words - ((words >> 1) & bit_mask)
    words = (words & pair_mask) + ((words >> 2) & pair_mask)
    words = (words + (words >> 4)) & four_mask
    total = words * 0x0101010101010101  # the highest byte is the sum of all bytes
    return (total >> 56) & 0xFF


def unpacked(words: Tensor) -> Tensor:
    """Return the bits of words as bool, shape [*, S].

    Args:
        words: int64, shape [*].
    """
    chain = torch.arange(CHAINS, device=words.device)
    bits = words[..., None] >> chain & 1
    return bits.bool()


def packed(bits: Tensor) -> Tensor:
    """Return words that contain bits, int64, shape [*].

    Args:
        bits: bool, shape [*, S].
    """
    chain = torch.arange(CHAINS, device=bits.device)
    return (bits.long() << chain).sum(-1)
