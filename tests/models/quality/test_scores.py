import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import ndtr
from torchmetrics.functional.classification import multiclass_calibration_error

from benchnav.core.mixture import TraversabilityMixture
from benchnav.models.quality.scores import (
    BrierScore,
    ReliabilityCurve,
    calibration_error,
    coverage,
    crps,
    pit,
    pit_counts,
    tail_rate,
)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def single(mean: float, std: float, shape: tuple[int, int] = (200, 200)) -> TraversabilityMixture:
    ones = torch.ones(1, *shape, dtype=torch.float64)
    return TraversabilityMixture(ones, mean * ones, std * ones)


def random_probabilities(maps: int = 3, classes: int = 4, size: int = 20) -> torch.Tensor:
    return (3 * torch.randn(maps, classes, size, size, generator=generator(), dtype=torch.float64)).softmax(1)


def test_crps_is_the_closed_form_of_a_gaussian_far_from_the_bounds() -> None:
    mixture = single(0.5, 0.05, (1, 101))
    observed = torch.linspace(0.3, 0.7, 101, dtype=torch.float64)[None]
    z = ((observed - 0.5) / 0.05).numpy()
    density = torch.exp(-0.5 * torch.from_numpy(z) ** 2) / math.sqrt(2 * math.pi)
    exact = 0.05 * (torch.from_numpy(z * (2 * ndtr(z) - 1)) + 2 * density - 1 / math.sqrt(math.pi))
    torch.testing.assert_close(crps(mixture, observed), exact, rtol=0, atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(
    means=st.lists(st.floats(-0.5, 1.5), min_size=3, max_size=3),
    stds=st.lists(st.floats(0.03, 0.5), min_size=3, max_size=3),
    weight=st.floats(0, 1),
    observed=st.floats(0, 1),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_crps_is_the_integral_that_defines_it(
    means: list[float], stds: list[float], weight: float, observed: float, dtype: torch.dtype
) -> None:
    weights = [weight, (1 - weight) / 2, (1 - weight) / 2]
    values = torch.tensor([weights, means, stds], dtype=dtype)
    mixture = TraversabilityMixture(*values[:, :, None, None])

    def gap(x: float) -> float:
        below = sum(w * ndtr((x - m) / s) for w, m, s in zip(*values.double().tolist(), strict=True))
        return float(below - (observed <= x)) ** 2

    points = sorted({observed, *(m for m in means if 0 < m < 1)})
    exact = quad(gap, 0, 1, points=points, limit=200, epsabs=1e-8)[0]
    score = crps(mixture, torch.tensor([[observed]], dtype=torch.float64))
    assert float(score) == pytest.approx(exact, abs=1e-5)


def test_crps_of_certain_predictions_is_their_distance() -> None:
    mixture, observed = single(0.3, 0.0, (1, 3)), torch.tensor([[0.0, 0.3, 1.0]], dtype=torch.float64)
    expected = torch.tensor([[0.3, 0.0, 0.7]], dtype=torch.float64)
    torch.testing.assert_close(crps(mixture, observed), expected, rtol=0, atol=0.02)


@pytest.mark.parametrize("mean", [0.5, 0.95, 0.05, 1.2])
def test_what_is_drawn_from_the_prediction_is_calibrated(mean: float) -> None:
    mixture = single(mean, 0.15)
    transformed = pit(mixture, mixture.sample(1, generator())[0], generator(1))
    assert coverage(transformed) == pytest.approx(0.9, abs=0.006)
    assert tail_rate(transformed) == pytest.approx(0.1, abs=0.006)
    counts = pit_counts(transformed)
    assert int(counts.sum()) == transformed.numel()
    # Twenty binomial counts of mean 2000 and standard deviation 44.
    assert 1800 < int(counts.min()) <= int(counts.max()) < 2200


def test_pit_is_the_cdf_inside_and_within_the_atoms_at_the_ends() -> None:
    mixture, observed = single(0.5, 0.4, (1, 2000)), torch.zeros(1, 2000, dtype=torch.float64)
    atom = float(ndtr(-0.5 / 0.4))
    for value, low, high in ((0.0, 0.0, atom), (1.0, 1 - atom, 1.0)):
        drawn = pit(mixture, observed + value, generator())
        assert low <= float(drawn.min()) < low + 0.01
        assert high - 0.01 < float(drawn.max()) <= high
    inside = pit(mixture, observed + 0.7, generator())
    torch.testing.assert_close(inside, torch.full_like(inside, ndtr(0.5)))


def test_tail_rate_counts_what_lies_under_the_var() -> None:
    mixture = single(0.5, 0.15)
    observed = single(0.45, 0.25).sample(1, generator())[0]
    share = float((observed < mixture.var(0.9)).double().mean())
    assert tail_rate(pit(mixture, observed, generator(1))) == pytest.approx(share, abs=1e-9)
    assert share > 0.2


def test_a_prediction_too_narrow_covers_too_little() -> None:
    transformed = pit(single(0.5, 0.05), single(0.5, 0.15).sample(1, generator())[0], generator(1))
    assert coverage(transformed) < 0.5


def test_pit_counts_place_both_ends() -> None:
    counts = pit_counts(torch.tensor([0.0, 0.049, 0.051, 0.999, 1.0]))
    assert counts.tolist() == [2, 1, *[0] * 16, 0, 2]


def test_the_calibration_error_of_the_curve_is_that_of_torchmetrics() -> None:
    probabilities = random_probabilities()
    classes = torch.randint(0, 4, (3, 20, 20), generator=generator(1))
    curve = ReliabilityCurve()
    for one, truth in zip(probabilities.split(2), classes.split(2), strict=True):
        curve.update(one, truth)
    cells, confidence, accuracy = curve.compute()
    expected = multiclass_calibration_error(probabilities, classes, num_classes=4, n_bins=15, norm="l1")
    assert calibration_error(curve.compute()) == pytest.approx(float(expected), abs=1e-6)
    assert int(cells.sum()) == classes.numel()
    edges = torch.arange(16) / 15
    filled = cells > 0
    assert bool(((confidence >= edges[:-1]) & (confidence < edges[1:]))[filled].all())
    assert float((cells * accuracy).sum()) == float((probabilities.argmax(1) == classes).sum())


def test_certainty_falls_in_the_last_bin() -> None:
    curve = ReliabilityCurve()
    curve.update(torch.tensor([1.0, 0.0]).view(1, 2, 1, 1), torch.zeros(1, 1, 1, dtype=torch.int64))
    assert curve.compute()[:, -1].tolist() == [1, 1, 1]


def test_the_brier_score_is_the_squared_distance_to_the_truth() -> None:
    probabilities = random_probabilities()
    classes = torch.randint(0, 4, (3, 20, 20), generator=generator(1))
    score = BrierScore()
    for one, truth in zip(probabilities.split(2), classes.split(2), strict=True):
        score.update(one, truth)
    there = torch.nn.functional.one_hot(classes, 4).movedim(-1, 1)
    assert float(score.compute()) == pytest.approx(float((probabilities - there).square().sum(1).mean()))
