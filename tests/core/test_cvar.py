"""VaR and CVaR of hard mixtures, against plain bisection with SciPy's normal
distribution.
"""

import numpy as np
import pytest
import torch
from scipy.special import ndtr, ndtri

from benchnav.core import cvar
from benchnav.core.mixture import TraversabilityMixture

LEVELS = [0.01, 0.5, 0.9, 0.99, 0.9999, 1 - 1e-8]
Parameters = tuple[np.ndarray, np.ndarray, np.ndarray]


def hard_cells(cells: int = 600, components: int = 7, seed: int = 0) -> Parameters:
    """Few heavy components and many light ones, from steps to planes, within [0, 1] and
    beyond; shape [K, N].
    """
    generator = np.random.default_rng(seed)
    weights = np.exp(4 * generator.standard_normal((components, cells)))
    means = generator.uniform(-0.5, 1.5, (components, cells))
    stds = 10 ** generator.uniform(-9, 0.5, (components, cells))
    return weights / weights.sum(0), means, stds


def integral(parameters: Parameters, value: np.ndarray) -> np.ndarray:
    weights, means, stds = parameters
    z = (value - means) / stds
    return (
        weights * stds * (z * ndtr(z) + np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi))
    ).sum(0)


def bisected(parameters: Parameters, tail: float) -> tuple[np.ndarray, np.ndarray]:
    """VaR and CVaR."""
    weights, means, stds = parameters

    def share(value: np.ndarray) -> np.ndarray:
        return (weights * ndtr((value - means) / stds)).sum(0)

    low, high = np.zeros(weights.shape[1]), np.ones(weights.shape[1])
    for _ in range(60):
        middle = (low + high) / 2
        under = share(middle) < tail
        low, high = np.where(under, middle, low), np.where(under, high, middle)
    value = np.where(
        share(0 * low) >= tail, 0, np.where(share(0 * low + 1) <= tail, 1, low)
    )
    return value, value - (
        integral(parameters, value) - integral(parameters, 0 * value)
    ) / tail


def mixture_of(
    parameters: Parameters, dtype: torch.dtype = torch.float64
) -> TraversabilityMixture:
    """A map of 20 columns."""
    layers = (
        torch.from_numpy(values).to(dtype).unflatten(1, (-1, 20))
        for values in parameters
    )
    return TraversabilityMixture(*layers)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("waits", [True, False])
def test_hard_cells_are_as_bisection_has_them(
    level: float, waits: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As on the CPU, where cells leave the search when they are done, and as elsewhere,
    # where none does.
    monkeypatch.setattr(cvar, "_may_wait", lambda values: waits)
    parameters = hard_cells()
    mixture = mixture_of(parameters)
    value, mean = bisected(parameters, 1 - level)
    found = mixture.var(level).flatten().numpy()
    inside = (value > 0) & (value < 1)
    assert inside.sum() > 20
    np.testing.assert_array_equal(found[~inside], value[~inside])
    # Where F is flat, F tells the root no better than to within its own last bits.
    weights, means, stds = parameters
    z = (value - means) / stds
    density = (weights / stds * np.exp(-0.5 * z * z)).sum(0) / np.sqrt(2 * np.pi)
    told = inside & (density > 1e-3)
    np.testing.assert_allclose(found[told], value[told], atol=2e-9)
    shares = (weights * ndtr((found - means) / stds)).sum(0)[inside & ~told]
    np.testing.assert_allclose(shares, 1 - level, rtol=0, atol=1e-9)
    # CVaR divides what is lost by the tail.
    atol = max(1e-8, 4e-16 / (1 - level))
    np.testing.assert_allclose(
        mixture.cvar(level).flatten().numpy(), mean, rtol=0, atol=atol
    )


@pytest.mark.parametrize("std", [0.0, 1e-8, 1e-7, 1e-6, 1e-4])
@pytest.mark.parametrize("level", [0.1, 0.5, 0.9, 0.99])
def test_points_and_spikes_are_weighed_as_they_are(std: float, level: float) -> None:
    # Three points of which one is at an end, where the sorted weights tell both
    # measures.
    generator = np.random.default_rng(1)
    cells = 4000
    weights = generator.dirichlet((0.7, 0.7, 0.7), cells).T
    means = np.sort(generator.integers(0, 33, (3, cells)) / 32, axis=0)
    parameters = weights, means, np.full_like(means, std)
    mixture, tail = mixture_of(parameters), 1 - level
    taken = np.diff(np.minimum(weights.cumsum(0), tail), axis=0, prepend=0)
    wanted = (taken * means).sum(0) / tail
    # A normal spike that is cut at 0 or 1, or by the tail, is off its middle by a part
    # of its width.
    np.testing.assert_allclose(
        mixture.cvar(level).flatten().numpy(),
        wanted,
        rtol=0,
        atol=1e-7 + 2 * std / tail,
    )
    places = (weights.cumsum(0) < tail - 1e-6).sum(0)
    sure = (np.abs(weights.cumsum(0) - tail) > 1e-4).all(0)
    value = np.take_along_axis(means, places[None].clip(max=2), axis=0)[0]
    found = mixture.var(level).flatten().numpy()
    np.testing.assert_allclose(found[sure], value[sure], rtol=0, atol=1e-7 + 5 * std)


def test_far_down_in_the_tail_cvar_is_that_of_the_closed_form() -> None:
    level = 1 - 1e-13
    mixture = mixture_of(
        (np.ones((1, 20)), np.full((1, 20), 0.5), np.full((1, 20), 0.05))
    )
    normal = ndtri(1 - level)
    wanted = 0.5 - 0.05 * np.exp(-0.5 * normal**2) / np.sqrt(2 * np.pi) / (1 - level)
    torch.testing.assert_close(
        mixture.cvar(level),
        torch.full((1, 20), wanted, dtype=torch.float64),
        atol=1e-6,
        rtol=0,
    )


def test_levels_near_0_and_1_give_numbers() -> None:
    parameters = (np.ones((1, 20)), np.full((1, 20), 0.5), np.full((1, 20), 1e-6))
    mixture = mixture_of(parameters)
    for level in (1e-16, 1e-12, 1e-9, 1e-8, 1 - 1e-12, 1 - 1e-15):
        for found in (mixture.cvar(level), mixture.var(level)):
            torch.testing.assert_close(
                found, torch.full_like(found, 0.5), atol=1e-5, rtol=0
            )


def test_cells_that_are_not_known_stay_so_and_hold_up_no_others() -> None:
    weights, means, stds = hard_cells()
    means[:, 7] = np.nan
    unknown, known = mixture_of((weights, means, stds)), mixture_of(hard_cells())
    for level in LEVELS:
        for measure in ("cvar", "var"):
            found, wanted = (
                getattr(one, measure)(level).flatten() for one in (unknown, known)
            )
            assert found[7].isnan()
            others = torch.arange(len(found)) != 7
            assert torch.equal(found[others], wanted[others])


def test_a_map_is_the_same_however_many_there_are_beside_it() -> None:
    maps = [mixture_of(hard_cells(seed=seed), torch.float32) for seed in range(3)]
    together = TraversabilityMixture(
        *(
            torch.stack([getattr(one, name) for one in maps])
            for name in ("weights", "means", "stds")
        )
    )
    for level in LEVELS:
        for place, one in enumerate(maps):
            assert torch.equal(together.cvar(level)[place], one.cvar(level))
            assert torch.equal(together.var(level)[place], one.var(level))
    assert torch.equal(together.mean()[1], maps[1].mean())


def test_large_maps_are_worked_on_in_pieces_without_seams(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mixture = mixture_of(hard_cells())
    noise = torch.randn(
        mixture.mean().shape,
        generator=torch.Generator().manual_seed(0),
        dtype=torch.float64,
    )

    def maps() -> tuple[torch.Tensor, ...]:
        return (
            mixture.cvar(0.7), mixture.var(0.7), mixture.mean(), mixture.expected_time(0.05), mixture.from_normal(noise)
        )  # fmt: skip

    whole = maps()
    # four rows
    monkeypatch.setattr("benchnav.core.mixture._CHUNK_NUMBERS_ON_CPU", 7 * 20 * 4)
    pieces = maps()
    for one, other in zip(whole, pieces, strict=True):
        torch.testing.assert_close(one, other, atol=2e-7, rtol=0)
