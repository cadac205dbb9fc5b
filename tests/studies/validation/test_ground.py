import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm, truncnorm

from studies.validation.ground import DIRT, VEGETATION, Ground

BOTH = pytest.mark.parametrize("ground", [DIRT, VEGETATION])


def truncated_cdf(ground: Ground, value: float) -> float:
    """By truncated Gaussians, each weighed by how often its draws are kept."""
    kept = [
        weight * (norm.cdf(1, mean, std) - norm.cdf(0, mean, std))
        for weight, mean, std in zip(
            ground.weights, ground.means, ground.stds, strict=True
        )
    ]
    parts = [
        truncnorm.cdf(value, -mean / std, (1 - mean) / std, loc=mean, scale=std)
        for mean, std in zip(ground.means, ground.stds, strict=True)
    ]
    return float(np.average(parts, weights=kept))


@BOTH
def test_cdf_is_that_of_truncated_gaussians(ground: Ground) -> None:
    values = np.linspace(0, 1, 41)
    expected = [truncated_cdf(ground, value) for value in values]
    np.testing.assert_allclose(ground.cdf(values), expected, atol=1e-12)


@BOTH
def test_quantile_inverts_the_cdf(ground: Ground) -> None:
    probability = np.array([[0.001, 0.2], [0.43, 0.99]])
    np.testing.assert_allclose(
        ground.cdf(ground.quantile(probability)), probability, atol=1e-10
    )


@BOTH
@pytest.mark.parametrize("tail", [0.01, 0.2, 0.4, 0.6, 1.0])
def test_slices_have_every_tail_mean(ground: Ground, tail: float) -> None:
    exact = (
        quad(lambda u: float(ground.quantile(np.array(u))), 0, tail, epsabs=1e-8)[0]
        / tail
    )
    slices = ground.slices()
    assert slices[: round(100 * tail)].mean() == pytest.approx(exact, abs=1e-5)


def sampled_as_they_do(ground: Ground, draws: np.ndarray) -> list[int]:
    """Values in hundredths, one draw after the other."""
    edges = np.linspace(0, 1, 21)
    percents = [
        int(100 * mass + 1e-9)
        for mass in np.diff([truncated_cdf(ground, edge) for edge in edges])
    ]
    bins = [(0, 0), *zip(range(20), percents, strict=True), (20, 100 - sum(percents))]
    sampled = []
    for draw in draws:
        total = 0
        for index, (place, percent) in enumerate(bins):
            total += percent
            if round(100 * draw) <= total:
                sampled.append(
                    0
                    if index == 0
                    else 100
                    if place == 20
                    else int(100 * (place + 0.5) / 20 + 1e-9)
                )
                break
    return sampled


@BOTH
def test_atoms_of_sampled_fields_are_those_of_their_sampler(ground: Ground) -> None:
    draws = (np.arange(10_000) + 0.5) / 10_000  # 50 draws an atom
    sampled = np.bincount(sampled_as_they_do(ground, draws), minlength=101)
    atoms = np.bincount(
        np.round(100 * ground.histogram_atoms()).astype(int), minlength=101
    )
    np.testing.assert_allclose(sampled / 10_000, atoms / 200, atol=1e-9)
    assert atoms.sum() == 200
