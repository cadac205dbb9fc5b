"""Probabilities of classes against all labellings of small patches, and on simulated
maps.
"""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from benchnav.core.copula import correlations
from benchnav.core.mixture import TraversabilityMixture
from benchnav.planning.sensing.belief import CovarianceModel
from benchnav.planning.sensing.classes import Classes
from benchnav.planning.sensing.labels import unpacked
from benchnav.planning.sensing.sensor import Measurement
from tests.planning.sensing import made
from tests.planning.sensing.made_classes import (
    MEANS,
    STDS,
    covariance_of,
    even,
    prediction,
)

PLACES = [(row, column) for row in (0, 4, 8) for column in (0, 4, 8)] * 8


def islands() -> TraversabilityMixture:
    """A patch of 3×3 of the first pair in each episode's map, with a tenth of rock."""
    weights = torch.zeros(len(PLACES), 5, 12, 12, dtype=torch.float64)
    weights[:, 2] = 1
    for own, (row, column) in enumerate(PLACES):
        patch = torch.tensor([0.45, 0.45, 0.1]).view(3, 1, 1).double()
        weights[own, :3, row : row + 3, column : column + 3] = patch
    return prediction(weights)


def enumerated(
    values: dict[tuple[int, int], float], covariance: CovarianceModel, std: float
) -> np.ndarray:
    """Probability of the first class, over all labellings; at most one value is 0 or 1."""
    places, seen = list(values), np.array(list(values.values()))
    at = np.array(places)
    across = correlations(12, covariance.correlation_cells)
    away = np.abs(at[:, None] - at[None])
    matrix = across[away[..., 0]] * across[away[..., 1]] + std**2 * np.eye(len(at))
    inside = (seen > 0) & (seen < 1)

    def shares(label: int, value: float, name: str) -> float:
        own, rock = (
            getattr(stats.norm(MEANS[label], STDS[label]), name),
            getattr(stats.norm(0.3, 0.2), name),
        )
        return float(0.9 * own(value) + 0.1 * rock(value))

    def likelihood(labels: tuple[int, ...]) -> float:
        scores = np.array([
            stats.norm.ppf(shares(own, value, "cdf")) if value < 1 else stats.norm.isf(shares(own, 1.0, "sf"))
            for own, value in zip(labels, seen, strict=True)
        ])  # fmt: skip
        known, inner = scores[inside], matrix[np.ix_(inside, inside)]
        found = (
            stats.multivariate_normal(np.zeros(len(known)), inner).pdf(known)
            if len(known)
            else 1.0
        )
        for own, value, score in zip(
            np.array(labels)[inside], seen[inside], known, strict=True
        ):
            found *= shares(own, value, "pdf") / stats.norm.pdf(score)
        for place in np.flatnonzero(~inside):
            pull = (
                np.linalg.solve(inner, matrix[inside, place])
                if len(known)
                else np.zeros(0)
            )
            mean, spread = (
                pull @ known,
                matrix[place, place] - pull @ matrix[inside, place],
            )
            off = (scores[place] - mean) / np.sqrt(spread)
            found *= stats.norm.cdf(off) if seen[place] <= 0 else stats.norm.sf(off)
        return float(found)

    known = {
        labels: likelihood(labels)
        for labels in itertools.product((0, 1), repeat=len(places))
    }
    total, first = 0.0, np.zeros((3, 3))
    assert covariance.statistics is not None
    for bits in itertools.product((0, 1), repeat=9):
        field = np.array(bits).reshape(3, 3)
        alike = (field[1:] == field[:-1]).sum() + (field[:, 1:] == field[:, :-1]).sum()
        weight = (
            np.exp(covariance.statistics.potts_strength * alike)
            * known[tuple(field[place] for place in places)]
        )
        total, first = total + weight, first + weight * (field == 0)
    return first / total


@pytest.mark.parametrize(
    ("looks", "std"),
    [
        ([{(0, 0): 0.62, (0, 1): 0.6, (1, 1): 0.58, (1, 0): 0.66}], 0.1),
        ([{(0, 0): 0.62}, {(0, 1): 0.6}, {(1, 1): 0.56, (2, 2): 0.8}], 1e-3),
        ([{(0, 0): 0.0}, {(0, 1): 0.3}, {(1, 1): 0.55}], 0.1),
        ([{(0, 0): 1.0, (1, 1): 0.55}], 0.3),
    ],
)
def test_probabilities_are_those_of_all_labellings(
    looks: list[dict[tuple[int, int], float]], std: float
) -> None:
    covariance, prior = covariance_of(12, 12), islands()
    state = Classes().init(prior, covariance)
    # Random numbers of its own for each patch.
    labels = torch.randint(
        -(2**62), 2**62, state.labels.shape, generator=torch.Generator().manual_seed(2)
    )
    state = replace(
        state, sweeps=6 * torch.arange(len(PLACES)), labels=2 * labels + (labels & 1)
    )
    for values in looks:
        found = torch.full(prior.shape, torch.nan, dtype=torch.float64)
        for own, (top, left) in enumerate(PLACES):
            for (row, column), value in values.items():
                found[own, top + row, left + column] = value
        state = Classes().update(
            state, Measurement(traversability=found, std=torch.full_like(found, std))
        )
    p_first = state.probability()
    patches = [
        p_first[own, row : row + 3, column : column + 3]
        for own, (row, column) in enumerate(PLACES)
    ]
    values = {place: value for each in looks for place, value in each.items()}
    # Each patch has 64 chains of its own.
    np.testing.assert_allclose(
        torch.stack(patches).mean(0), enumerated(values, covariance, std), atol=0.025
    )
    assert float(torch.stack(patches).std(0).max()) < 0.1


def potts(count: int, size: int, strength: float, seed: int) -> Tensor:
    """Labels of maps after long heat-bath sweeps from even, and from all-alike, ones;
    bool, [count, size, size].
    """
    generator = np.random.default_rng(seed)
    labels = generator.choice([-1, 1], (count, size, size))
    labels[count // 2 :] = generator.choice([-1, 1], (count - count // 2, 1, 1))
    even = np.add.outer(np.arange(size), np.arange(size)) % 2
    for step in range(800):
        ring = np.pad(labels, ((0, 0), (1, 1), (1, 1)))
        around = (
            ring[:, :-2, 1:-1]
            + ring[:, 2:, 1:-1]
            + ring[:, 1:-1, :-2]
            + ring[:, 1:-1, 2:]
        )
        drawn = np.where(
            generator.random(labels.shape) < 1 / (1 + np.exp(-strength * around)), 1, -1
        )
        labels = np.where(even == step % 2, drawn, labels)
    return torch.from_numpy(labels > 0)


@pytest.mark.parametrize("count", [20, pytest.param(400, marks=pytest.mark.slow)])
def test_probabilities_of_classes_are_calibrated_on_simulated_maps(count: int) -> None:
    size, std, strength = 24, 0.1, 0.85
    covariance, prior = (
        covariance_of(size, size, 1.5, strength),
        even(count, size, size),
    )
    first, scores = potts(count, size, strength, 1), made.scores(covariance, count, 3)
    mean, deviation = (
        torch.where(first, own[0], own[1]).double() for own in (MEANS, STDS)
    )
    generator, line = np.random.default_rng(5), torch.arange(size)
    state = Classes().init(prior, covariance)
    for step in range(12):
        near = (
            (line[:, None] - 5 - step) ** 2 + (line - 5 - 0.5 * step) ** 2 <= 4
        ).expand(count, size, size)
        noise = torch.from_numpy(generator.normal(size=first.shape)) * std
        found = torch.where(
            near, (mean + deviation * (scores + noise)).clamp(0, 1), torch.nan
        )
        state = Classes().update(
            state, Measurement(traversability=found, std=torch.full_like(found, std))
        )
    p_first, seen = state.probability(), state.copula.observed
    reach = torch.nn.functional.max_pool2d(seen[:, None].double(), 9, 1, 4)[:, 0] > 0
    own = (first & seen).flatten(1).sum(1) / seen.flatten(1).sum(1)
    touching = ((own > 0.1) & (own < 0.9))[:, None, None].expand_as(seen)
    for cells in (seen, reach & ~seen, reach & ~seen & touching):
        told, truth = p_first[cells], first[cells].double()
        score = -torch.where(first[cells], told, 1 - told).log().mean()
        assert float(score) < np.log(2) - 0.05
        # The map is the unit: cells of one hang together.
        member = torch.arange(count)[:, None, None].expand_as(cells)[cells]
        for low, high in ((0, 0.2), (0.2, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 1.0)):
            within = (told >= low) & (told <= high)
            off = torch.zeros(count, dtype=torch.float64).index_add(
                0, member[within], (truth - told)[within]
            )
            # By chance, and by what 64 chains, some of them alike, leave.
            allowed = 3.5 * off.square().sum().sqrt() + 0.03 * within.sum() + 1
            assert float(off.sum().abs()) < float(allowed)
    # λ itself, by the rank that it has in what is believed.
    lower, upper = (
        Classes()
        .distribution(state)
        .cdf_limits((mean + deviation * scores).clamp(0, 1))
    )
    rank = lower + (upper - lower) * torch.from_numpy(generator.random(lower.shape))
    inner = ((rank > 0.05) & (rank < 0.95))[reach & ~seen].double().mean()
    assert float(inner) == pytest.approx(0.9, abs=0.03)


def test_where_a_label_is_settled_all_chains_hold_it() -> None:
    """Also where scores that fit together badly have turned a patch."""
    covariance, prior = covariance_of(6, 8), even(40, 6, 8)
    generator, state = (
        torch.Generator().manual_seed(0),
        Classes().init(prior, covariance),
    )
    for step in range(4):
        found = torch.full(prior.shape, torch.nan, dtype=torch.float64)
        found[:, 2:4, 2 * step : 2 * step + 2] = torch.rand(
            40, 2, 2, generator=generator
        ).double()
        state = Classes().update(
            state, Measurement(traversability=found, std=torch.full_like(found, 0.1))
        )
        share = unpacked(state.labels).double().mean(-1)
        settled = state.copula.observed & ((state.p_first - 0.5).abs() > 0.4999)
        assert settled.any()
        assert float((share - state.p_first)[settled].abs().max()) < 0.1
