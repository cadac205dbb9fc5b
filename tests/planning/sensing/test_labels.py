"""Chains of labels against the enumeration of all labellings."""

import itertools

import numpy as np
import torch
from torch import Tensor

from benchnav.planning.sensing.labels import (
    CHAINS,
    Couplings,
    connected_to_evidence,
    count_bits,
    fair_labels,
    packed,
    sweep_bits,
    sweep_labels,
    unpacked,
)

STRENGTH, SIZE = 0.9, 64
PAIR = np.array([[1, 1, 2], [1, 1, 1], [1, 1, 0]])


def test_bits_are_packed_counted_and_unpacked() -> None:
    bits = torch.rand(50, CHAINS, generator=torch.Generator().manual_seed(1)) < 0.4
    words = packed(bits)
    assert torch.equal(unpacked(words), bits)
    assert torch.equal(count_bits(words), bits.sum(-1))
    whole = torch.tensor([-1, 0])
    assert count_bits(whole).tolist() == [64, 0]
    assert abs(count_bits(fair_labels(20, 20)).double().mean() - 32) < 1


def enumerated() -> np.ndarray:
    """Probability of the first class in each cell, where the upper left one is of it."""
    total, first = 0.0, np.zeros(PAIR.shape)
    for bits in itertools.product((0, 1), repeat=9):
        labels = np.array(bits).reshape(PAIR.shape)
        alike = (labels[1:] == labels[:-1]) & (PAIR[1:] == PAIR[:-1]) & (PAIR[1:] > 0)
        beside = (
            (labels[:, 1:] == labels[:, :-1])
            & (PAIR[:, 1:] == PAIR[:, :-1])
            & (PAIR[:, 1:] > 0)
        )
        weight = labels[0, 0] * np.exp(STRENGTH * (alike.sum() + beside.sum()))
        total, first = total + weight, first + weight * labels
    return np.asarray(first / total)


def sampled(members: Tensor, sweeps: int) -> tuple[Tensor, Tensor, Tensor]:
    """Share of bits, and what clusters tell, over chains at many places of the torus;
    and the labels.
    """
    row, column = (members // 12 * 4)[:, None, None], (members % 12 * 4)[:, None, None]
    row, column = torch.broadcast_tensors(
        row + torch.arange(3)[:, None], column + torch.arange(3) + 0 * row
    )
    couplings = Couplings.of(
        torch.from_numpy(PAIR).expand(len(members), 3, 3), STRENGTH
    )
    known = torch.zeros(len(members), 3, 3, dtype=torch.int64)
    known[:, 0, 0] = -1
    labels, even = fair_labels(SIZE, SIZE)[row, column] | known, -((row + column) % 2)
    shares = clusters = torch.zeros(3, 3, dtype=torch.float64)
    for sweep in range(sweeps):
        bits = sweep_bits(
            torch.full_like(members, sweep),
            row,
            column,
            couplings.degree(),
            STRENGTH,
            SIZE,
        )
        labels = sweep_labels(labels, couplings, ~known, even, bits)
        if sweep >= 10:
            tied = connected_to_evidence(labels, couplings, known, bits)
            shares = shares + count_bits(labels).double().mean(0) / CHAINS / (
                sweeps - 10
            )
            found = count_bits(labels & tied) + 0.5 * (CHAINS - count_bits(tied))
            clusters = clusters + found.mean(0) / CHAINS / (sweeps - 10)
    return shares, clusters, labels


def test_chains_have_the_potts_distribution_given_what_is_known() -> None:
    # More sweeps than random numbers are kept for.
    shares, clusters, _ = sampled(torch.arange(144), 90)
    wanted = enumerated()
    np.testing.assert_allclose(shares, wanted, atol=0.006)
    np.testing.assert_allclose(clusters, wanted, atol=0.004)
    # Of another pair, and of none.
    np.testing.assert_allclose(clusters[(0, 2), (2, 2)], 0.5, atol=1e-6)


def test_an_episodes_labels_do_not_depend_on_the_others() -> None:
    _, _, all_of_them = sampled(torch.arange(20), 12)
    _, _, one = sampled(torch.tensor([7]), 12)
    assert torch.equal(all_of_them[7:8], one)
