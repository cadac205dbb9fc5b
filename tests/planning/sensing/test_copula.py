import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from torch import Tensor

from benchnav.core import registry, rng
from benchnav.core.conditioned import ConditionedDistribution
from benchnav.core.copula import correlations
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.quantiles import LEVELS, QuantileDistribution
from benchnav.planning.sensing.belief import CovarianceModel
from benchnav.planning.sensing.copula import Copula
from benchnav.planning.sensing.copula_state import CopulaState
from benchnav.planning.sensing.gaussian import Observed, condition, predict
from benchnav.planning.sensing.lattice import Lattice
from benchnav.planning.sensing.sensor import (
    MIN_STD,
    Contact,
    Measurement,
    NoiseKey,
    Probe,
)
from tests.planning.sensing import made

HEIGHT, WIDTH = 14, 16
COVARIANCE = made.covariance(HEIGHT, WIDTH, 1.5)
INF = float("inf")
FILE = "benchnav.planning.sensing.copula:Copula"


def looked(
    values: dict[tuple[int, int], float], std: float = MIN_STD, batch: int = 1
) -> Measurement:
    found = torch.full((batch, HEIGHT, WIDTH), torch.nan, dtype=torch.float64)
    for (row, column), value in values.items():
        found[:, row, column] = value
    return Measurement(traversability=found, std=torch.full_like(found, std))


def after(
    belief: Copula,
    prior: TraversabilityDistribution,
    *looks: Measurement,
    covariance: CovarianceModel = COVARIANCE,
) -> CopulaState:
    state = belief.init(prior, covariance)
    for sensed in looks:
        state = belief.update(state, sensed)
    return state


def cov_between(
    one: list[tuple[int, int]], other: list[tuple[int, int]], length: float = 3.0
) -> np.ndarray:
    away = ((np.array(one)[:, None] - np.array(other)[None]) ** 2).sum(-1)
    return np.exp(-away / (2 * length**2))


EVERY = [(row, column) for row in range(HEIGHT) for column in range(WIDTH)]


def test_before_anything_is_sensed_it_is_the_prediction() -> None:
    prior = made.mixture(2, HEIGHT, WIDTH)
    found = Copula().distribution(Copula().init(prior, COVARIANCE))
    for level in (0.1, 0.5, 0.9):
        torch.testing.assert_close(
            found.quantile(level), prior.quantile(level), atol=1e-9, rtol=0
        )


def test_scores_that_are_observed_condition_the_field_as_linear_algebra_says() -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    places = {(4, 4): 0.55, (5, 6): 0.3, (12, 15): 0.8}
    state = after(Copula(), prior, looked(places, std=0.2))
    where = list(places)
    values = torch.tensor([list(places.values())], dtype=torch.float64)
    mask = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.bool)
    for place in where:
        mask[0][place] = True
    score = prior.at(mask).to_normal(values[None])[0].numpy().ravel()
    inner = cov_between(where, where) + 0.04 * np.eye(3)
    across = cov_between(where, EVERY)
    mean = (across.T @ np.linalg.solve(inner, score)).reshape(HEIGHT, WIDTH)
    variance = 1 - (across * np.linalg.solve(inner, across)).sum(0).reshape(
        HEIGHT, WIDTH
    )
    np.testing.assert_allclose(state.mean[0], mean, atol=6e-3)
    np.testing.assert_allclose(state.std[0], np.sqrt(variance), atol=6e-3)
    found = Copula().distribution(state)
    assert isinstance(found, ConditionedDistribution)
    assert found.base is state.prior


@pytest.mark.parametrize("by_law", [True, False])
def test_of_a_nugget_neighbours_know_nothing_and_a_cell_that_was_sensed_all(
    by_law: bool,
) -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    places = {(4, 4): 0.55, (4, 5): 0.3}
    told = looked(places, std=0.01)
    belief, covariance = (
        (Copula(), replace(COVARIANCE, nugget=0.4))
        if by_law
        else (Copula(nugget=0.4), COVARIANCE)
    )
    state = after(belief, prior, told, covariance=covariance)
    where = list(places)
    mask = told.mask
    score = prior.at(mask).to_normal(told.traversability[mask][None])[0].numpy().ravel()
    same = np.eye(HEIGHT * WIDTH)[[EVERY.index(place) for place in where]]
    inner = 0.6 * cov_between(where, where) + (0.4 + 1e-4) * np.eye(2)
    across = 0.6 * cov_between(where, EVERY) + 0.4 * same
    mean = (across.T @ np.linalg.solve(inner, score)).reshape(HEIGHT, WIDTH)
    variance = 1 - (across * np.linalg.solve(inner, across)).sum(0).reshape(
        HEIGHT, WIDTH
    )
    np.testing.assert_allclose(state.mean[0], mean, atol=6e-3)
    np.testing.assert_allclose(state.std[0], np.sqrt(variance.clip(0)), atol=6e-3)
    assert state.std[0, 4, 4] < 0.011 < 0.5 < state.std[0, 4, 6]
    drawn = belief.sample_fields(state, 4000, [3])[0]
    wanted = belief.distribution(state)
    for level in (0.2, 0.5, 0.8):
        below = (drawn <= wanted.quantile(level)[0] + 1e-6).double().mean(0)[4, 6:9]
        assert ((below - level).abs() < 0.04).all()


@pytest.mark.parametrize("nugget", [-0.1, 1.0])
def test_nuggets_that_are_no_share_are_refused(nugget: float) -> None:
    with pytest.raises(ConfigError, match="nugget"):
        Copula(nugget=nugget)
    with pytest.raises(ConfigError, match="nugget"):
        replace(COVARIANCE, nugget=nugget)


def test_ground_at_zero_is_an_interval_up_to_the_atoms_end() -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    state = after(Copula(), prior, looked({(6, 6): 0.0}))
    assert float(state.lower[0, 6, 6]) == -INF
    end = float(state.upper[0, 6, 6])
    assert (
        float(
            prior.from_normal(torch.full(prior.shape, end - 0.01, dtype=torch.float64))[
                0, 6, 6
            ]
        )
        == 0
    )
    found = Copula().distribution(state)
    assert float(found.cdf(0.1)[0, 6, 6]) > 0.99
    assert float(found.mean()[0, 6, 6]) < 0.005
    assert float(found.mean()[0, 6, 8]) < float(prior.mean()[0, 6, 8])


def test_λ_that_the_prediction_holds_impossible_is_at_its_end() -> None:
    flat = torch.linspace(0.3, 0.7, len(LEVELS), dtype=torch.float64)[:, None, None]
    prior = QuantileDistribution(flat.expand(1, len(LEVELS), HEIGHT, WIDTH))
    for value, side in ((0.0, -1), (0.1, -1), (0.9, 1), (1.0, 1)):
        state = after(Copula(), prior, looked({(6, 6): value}, 0.1))
        assert state.mean.isfinite().all()
        assert side * float(state.mean[0, 6, 6]) > 2
        assert side * float(state.mean[0, 6, 8]) > 1


def test_two_looks_with_noise_are_averaged_and_an_interval_is_told_by_the_sharpest() -> (
    None
):
    prior = made.mixture(1, HEIGHT, WIDTH)
    once, twice = (
        after(Copula(), prior, *[looked({(6, 6): 0.5}, 0.4)] * n) for n in (1, 2)
    )
    assert float(twice.noise_std[0, 6, 6]) == pytest.approx(0.4 / np.sqrt(2))
    assert float(twice.std[0, 6, 6]) < float(once.std[0, 6, 6])
    apart = after(
        Copula(), prior, looked({(6, 6): 0.4}, 0.4), looked({(6, 6): 0.6}, 0.2)
    )
    scores = [
        float(after(Copula(), prior, looked({(6, 6): v})).lower[0, 6, 6])
        for v in (0.4, 0.6)
    ]
    assert float(apart.lower[0, 6, 6]) == pytest.approx(
        0.2 * scores[0] + 0.8 * scores[1]
    )
    held, again = (
        after(Copula(), prior, *[looked({(6, 6): 0.0}, 0.4)] * n) for n in (1, 2)
    )
    assert torch.equal(held.mean, again.mean)
    sharp, noisy = looked({(6, 6): 0.0}, 0.01), looked({(6, 6): 0.0}, 0.8)
    for looks in ((sharp, noisy), (noisy, sharp)):
        wanted = after(Copula(), prior, sharp).mean
        torch.testing.assert_close(
            after(Copula(), prior, *looks).mean, wanted, atol=0.006, rtol=0
        )
    # A number says more than an interval, whichever comes first.
    for looks in ((0.0, 0.3), (0.3, 0.0)):
        state = after(
            Copula(), prior, *(looked({(6, 6): value}, 0.4) for value in looks)
        )
        wanted = after(Copula(), prior, looked({(6, 6): 0.3}, 0.4)).mean
        torch.testing.assert_close(state.mean, wanted, atol=0.006, rtol=0)


def test_the_same_look_without_noise_changes_nothing() -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    state = after(Copula(), prior, looked({(6, 6): 0.5}))
    again = Copula().update(state, looked({(6, 6): 0.5}))
    assert again.mean is state.mean or torch.equal(again.mean, state.mean)
    assert float(again.noise_std[0, 6, 6]) == MIN_STD


def test_the_order_of_looks_and_the_other_episodes_do_not_matter() -> None:
    prior = made.mixture(2, HEIGHT, WIDTH)
    looks = [
        looked({(4, 4): 0.55, (4, 5): 0.0}, 0.1),
        looked({(6, 6): 0.3}, 0.1),
        looked({(5, 9): 1.0}, 0.1),
    ]
    first = prior.select(torch.tensor([0]))
    forward, backward = (
        after(Copula(), first, *looks),
        after(Copula(), first, *looks[::-1]),
    )
    torch.testing.assert_close(forward.mean, backward.mean, atol=0.012, rtol=0)
    torch.testing.assert_close(forward.std, backward.std, atol=0.012, rtol=0)
    state = Copula().init(prior, COVARIANCE)
    for place, sensed in enumerate(looks):
        both = sensed.traversability.repeat(2, 1, 1)
        both[1] = torch.nan
        both[1, 2 : 4 + 4 * place, 2 + 3 * place] = 0.4
        state = Copula().update(
            state, Measurement(traversability=both, std=torch.full_like(both, 0.1))
        )
    assert torch.equal(state.mean[:1], forward.mean)
    assert torch.equal(state.std[:1], forward.std)
    kept = Copula().select(state, torch.tensor([1]))
    assert torch.equal(kept.mean, state.mean[1:])


def test_nothing_is_told_beyond_four_lengths() -> None:
    covariance = made.covariance(40, 40, 1.0)
    prior = made.mixture(1, 40, 40)
    found = torch.full((1, 40, 40), torch.nan, dtype=torch.float64)
    found[0, 20, 20] = 0.2
    state = after(
        Copula(),
        prior,
        Measurement(traversability=found, std=torch.full_like(found, 0.01)),
        covariance=covariance,
    )
    told = (state.mean != 0).nonzero()[:, 1:] - 20
    assert 5 <= int(told.abs().max()) <= 8
    # Nor is anything noted that is under the least change: a correlation of 0.004 here.
    score = float(state.lower[0, 20, 20])
    assert float(state.mean[0, 20, 26]) == pytest.approx(
        score * np.exp(-36 / 8), abs=0.006
    )


def test_the_reach_is_of_an_episodes_own_cells_whatever_others_sense() -> None:
    covariance, prior = (
        made.covariance(HEIGHT, WIDTH, 0.5),
        made.mixture(2, HEIGHT, WIDTH),
    )
    sensed = looked({(6, 6): 0.5}, 0.1, batch=2)
    sensed.traversability[1, 0, 0] = sensed.traversability[1, 13, 15] = 0.4
    both = after(Copula(), prior, sensed, covariance=covariance)
    first = torch.tensor([0])
    alone = after(
        Copula(), prior.select(first), sensed.select(first), covariance=covariance
    )
    assert torch.equal(both.mean[:1] != 0, alone.mean != 0)
    assert torch.equal(both.std[:1] != 1, alone.std != 1)


def simulated(
    length: float, batch: int = 15, size: int = 24
) -> tuple[TraversabilityMixture, Tensor, Measurement]:
    """Ground of some ℓ in metres, of which the cells along a winding way are observed
    with noise.
    """
    covariance = made.covariance(size, size, length)
    prior, score = made.mixture(batch, size, size), made.scores(covariance, batch)
    noise = torch.from_numpy(np.random.default_rng(0).normal(0, 0.1, score.shape))
    row = np.arange(size)
    way = abs(row[:, None] - size / 2 - 6 * np.sin(row / 4)) <= 3.0
    field = prior.from_normal(score + noise).masked_fill(
        ~torch.from_numpy(way), torch.nan
    )
    assert 140 <= way.sum() <= 170
    return (
        prior,
        field,
        Measurement(traversability=field, std=torch.full_like(field, 0.1)),
    )


@pytest.mark.parametrize("length", [0.6, 1.0, 1.5, 2.5])
def test_the_length_that_is_estimated_is_that_of_the_ground(length: float) -> None:
    prior, _, sensed = simulated(length)
    covariance = made.covariance(24, 24, 99.0)
    for window in (256, 64):
        state = after(Copula("estimated", window), prior, sensed, covariance=covariance)
        found = state.field.length * covariance.grid.resolution_m
        assert float(found.median()) == pytest.approx(length, rel=0.2)


def test_an_estimate_is_the_mode_of_the_posterior_by_brute_force() -> None:
    """Against the likelihood of numbers and intervals by SciPy, with the prior of the
    logarithm.
    """
    prior = made.mixture(1, HEIGHT, WIDTH)
    said = {
        (2, 2): 0.5,
        (2, 4): 0.55,
        (3, 3): 0.52,
        (4, 5): 0.3,
        (6, 5): 0.2,
        (6, 7): 0.25,
        (9, 3): 0.8,
        (9, 4): 0.0,
    }
    for wrong in ({}, {(9, 5): 0.7, (7, 7): 0.9, (3, 4): 0.2}):
        places = said | wrong
        state = after(Copula("estimated"), prior, looked(places, 0.1))
        where = list(places)
        low, high = (
            np.array([float(side[0][place]) for place in where])
            for side in (state.lower, state.upper)
        )
        held = high > low
        modes = []
        grid = 1.5 * 2 ** (np.arange(-8, 9) / 4)
        for length in grid / COVARIANCE.grid.resolution_m:
            along = correlations(WIDTH, length)
            away = abs(np.array(where)[:, None] - np.array(where)[None])
            inner = along[away[..., 0]] * along[away[..., 1]] + 0.01 * np.eye(
                len(where)
            )
            numbers = stats.multivariate_normal(cov=inner[np.ix_(~held, ~held)]).logpdf(
                low[~held]
            )
            gain = inner[np.ix_(held, ~held)] @ np.linalg.inv(
                inner[np.ix_(~held, ~held)]
            )
            spread = inner[np.ix_(held, held)] - gain @ inner[np.ix_(~held, held)]
            end = (high[held] - gain @ low[~held]) / np.sqrt(np.diag(spread))
            assert len(end) == 1
            away_from_median = np.log(
                length * COVARIANCE.grid.resolution_m / 1.5
            ) / np.log(2)
            modes.append(numbers + stats.norm.logcdf(end)[0] - away_from_median**2 / 2)
        expected = grid[int(np.argmax(modes))]
        assert float(
            state.field.length
        ) * COVARIANCE.grid.resolution_m == pytest.approx(expected)
        assert expected != 1.5


def test_a_length_is_estimated_each_time_that_observations_have_doubled() -> None:
    prior, field, _ = simulated(0.6, batch=2)
    belief, covariance = Copula("estimated", window=40), made.covariance(24, 24)
    places = (~field[0].isnan()).nonzero().tolist()
    state, found = belief.init(prior, covariance), []
    assert state.field.length.tolist() == [3.0, 3.0]
    for row, column in places[:100]:
        value = torch.full_like(field, torch.nan)
        value[0, row, column] = field[0, row, column]
        state = belief.update(
            state, Measurement(traversability=value, std=torch.full_like(value, 0.1))
        )
        found.append(int(state.estimated_from[0]))
    assert sorted(set(found)) == [0, 8, 16, 32, 64]
    assert state.estimated_from[1] == 0
    assert float(state.field.length[0]) < 2.0
    assert float(state.field.length[1]) == 3.0
    # All cells are then as if that length had been believed from the beginning.
    short, _, sensed = simulated(0.6)
    state = after(belief, short, sensed, covariance=covariance)
    for own, length in enumerate(
        (state.field.length * covariance.grid.resolution_m).tolist()[:3]
    ):
        own_ = torch.tensor([own])
        one = after(
            Copula(length, window=40),
            short.select(own_),
            sensed.select(own_),
            covariance=covariance,
        )
        torch.testing.assert_close(state.mean[own_], one.mean, atol=1e-6, rtol=0)
        alone = after(
            belief, short.select(own_), sensed.select(own_), covariance=covariance
        )
        assert torch.equal(alone.mean, state.mean[own_])
        drawn = belief.sample_fields(state, 2, tuple(range(15)))[own_]
        assert torch.equal(belief.sample_fields(alone, 2, (own,)), drawn)


@pytest.mark.parametrize("correlation_m", [0.0, 0.5])
def test_the_length_that_is_believed_takes_the_worlds_place(
    correlation_m: float,
) -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    state = after(Copula(correlation_m), prior, looked({(6, 6): 0.2}))
    other = after(
        Copula(),
        prior,
        looked({(6, 6): 0.2}),
        covariance=made.covariance(HEIGHT, WIDTH, correlation_m),
    )
    assert torch.equal(state.mean, other.mean)
    if correlation_m == 0:
        assert (state.mean != 0).nonzero().tolist() == [[0, 6, 6]]


def test_many_observations_of_a_smooth_field_are_taken_by_a_lattice(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    used = []
    around = Lattice.around
    monkeypatch.setattr(
        Lattice,
        "around",
        lambda *given: used.append(len(given[2][0])) or around(*given),
    )
    for length_m, window in ((1.5, 8), (2.5, 64), (2.5, 8)):
        covariance = made.covariance(HEIGHT, WIDTH, length_m)
        after(
            Copula(window=window),
            made.mixture(1, HEIGHT, WIDTH),
            looked(dict.fromkeys(EVERY[:20], 0.5), 0.1),
            covariance=covariance,
        )
    assert used == [20]  # where ℓ is five cells and there is room for eight alone


@pytest.mark.parametrize("wider", [1.002, 1.2])
def test_an_approximation_that_errs_makes_no_cell_less_sure(
    wider: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = after(Copula(), made.mixture(1, HEIGHT, WIDTH), looked({(4, 4): 0.5}, 0.1))

    def errs(*given: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        mean, variance, skew = predict(*given)
        return mean + 0.1, wider * variance, skew

    monkeypatch.setattr("benchnav.planning.sensing.conditioning.predict", errs)
    found = Copula().update(before, looked({(4, 5): 0.5}, 0.1))
    assert float((found.std - before.std).max()) <= 0
    # A variance that is off by little takes the new mean along.
    assert bool((found.mean != before.mean)[0, 11, 11]) == (wider < 1.1)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    count=st.integers(2, 60),
    parts=st.integers(2, 6),
    length_m=st.sampled_from([1.0, 1.5, 2.5]),
    window=st.sampled_from([8, 256]),
)
def test_numbers_make_no_cell_less_sure_and_tell_the_same_one_by_one(
    seed: int, count: int, parts: int, length_m: float, window: int
) -> None:
    """With the dense equations, and where the window is small and ℓ long with the
    lattice.
    """
    generator, covariance = (
        np.random.default_rng(seed),
        made.covariance(HEIGHT, WIDTH, length_m),
    )
    prior = TraversabilityMixture(
        *(torch.full((1, 1, HEIGHT, WIDTH), one).double() for one in (1.0, 0.5, 0.1))
    )
    field = prior.from_normal(made.scores(covariance, 1, seed))[0]
    places = generator.choice(EVERY, count, replace=False, axis=0)
    looks = [
        looked({(row, column): float(field[row, column]) for row, column in some}, 0.2)
        for some in np.array_split(places, parts)
    ]
    belief = Copula(window=window)
    state = belief.init(prior, covariance)
    for sensed in looks:
        before, state = state, belief.update(state, sensed)
        assert float((state.std - before.std).max()) <= 0
    once = belief.update(
        belief.init(prior, covariance),
        looked({tuple(p): float(field[tuple(p)]) for p in places}, 0.2),
    )
    for name in ("mean", "std"):
        torch.testing.assert_close(
            getattr(state, name), getattr(once, name), atol=0.02, rtol=0
        )
    exact = looked({tuple(places[0]): float(field[tuple(places[0])])})
    sure = belief.update(state, exact)
    again = belief.update(sure, exact)
    assert not belief.changed(sure, again).any()


def way(turns: bool, steps: int = 121) -> Tensor:
    """12 m of driving in steps of 0.1 m, straight or turning until it crosses itself,
    shape [N, 3].
    """
    turn = torch.zeros(steps)
    if turns:
        turn[40:] = 0.1 * 2 * math.pi / 7.0  # a circle of 7 m
    heading = turn.cumsum(0)
    moves = 0.1 * torch.stack((heading.cos(), heading.sin()), 1)
    start = torch.tensor([1.5, 3.0 if turns else 5.0])
    return torch.cat((start + moves.cumsum(0) - moves[0], heading[:, None]), 1)


@pytest.mark.parametrize(("resolution_m", "radius_m"), [(0.25, 2.0), (0.5, 4.0)])
@pytest.mark.parametrize("turns", [False, True])
def test_what_was_learnt_is_never_forgotten(
    resolution_m: float, radius_m: float, turns: bool
) -> None:
    """Against all observations at once, in the cells within ℓ of what was sensed."""
    height, width = round(10 / resolution_m), round(16 / resolution_m)
    covariance = made.covariance(height, width, 1.5, resolution_m)
    shape = (1, 2, height, width)
    weights, means, stds = (
        torch.tensor(pair).view(1, 2, 1, 1).expand(shape)
        for pair in ((0.1, 0.9), (0.05, 0.66), (0.05, 0.1))
    )
    prior = TraversabilityMixture(
        weights.contiguous(), means.contiguous(), stds.contiguous()
    )
    field = prior.from_normal(made.scores(covariance, 1, 7).float())
    terrain, sensor, belief = (
        made.terrain(prior, field, resolution_m),
        Probe(radius_m),
        Copula(),
    )
    state = belief.init(prior, covariance)
    for step, pose in enumerate(way(turns)):
        if step % 5 == 0:
            state = belief.update(
                state, sensor.sense(terrain, field, pose[None], NoiseKey((1,), step))
            )
    cells = state.observed[0].nonzero(as_tuple=True)
    known = Observed(
        *(
            getattr(state, name)[0][cells].numpy()
            for name in ("lower", "upper", "noise_std", "precision", "shift")
        )
    )
    column, row = way(turns)[:, :2].T / resolution_m - 0.5
    lines = torch.arange(height)[:, None, None], torch.arange(width)[None, :, None]
    away = torch.hypot(lines[0] - row, lines[1] - column).amin(-1) * resolution_m
    wanted = (~state.observed[0] & (away < radius_m + 1.5)).nonzero(as_tuple=True)
    among, across = (
        state.field.covariance(
            0, cells[0][:, None] - other[0], cells[1][:, None] - other[1]
        ).numpy()
        for other in (cells, wanted)
    )
    mean, variance, skew = predict(condition(among, known), among, known, across)
    std = np.sqrt(variance)
    assert len(std) > 100
    assert 0.05 < std.mean() < 0.5
    assert abs(state.std[0][wanted].numpy() - std).mean() < 0.02
    place = torch.zeros(1, height, width, dtype=torch.bool)
    place[0][wanted] = True
    found = belief.distribution(state).at(place)
    moments = (
        torch.from_numpy(values)[None, :, None].float() for values in (mean, std, skew)
    )
    whole = ConditionedDistribution(
        prior.at(place), *(values.view(prior.at(place).shape) for values in moments)
    )
    scores = [
        one.log_prob(field[place].view(prior.at(place).shape)).clamp(min=-10).mean()
        for one in (found, whole)
    ]
    assert abs(float(scores[0] - scores[1])) < 0.05


def test_what_was_observed_at_a_cell_is_kept_where_there_is_no_room_for_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    field = prior.from_normal(made.scores(COVARIANCE, 1))
    told = {
        place: 0.0 if place % 3 == 1 else max(float(field[0, 6, place]), 0.2)
        for place in range(2, 12)
    }
    for room in (1, 2, 256):
        monkeypatch.setattr("benchnav.planning.sensing.conditioning._MAX_EXACT", room)
        state = Copula().init(prior, COVARIANCE)
        for place, value in told.items():
            before, state = (
                state,
                Copula().update(state, looked({(6, place): value}, 0.05)),
            )
            # An interval may widen when its neighbours are told.
            number = before.lower == before.upper
            assert float((state.std - before.std)[number].clamp(min=0).sum()) < 0.02


def test_a_look_at_more_cells_than_the_window_tells_of_all() -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    field = prior.from_normal(made.scores(COVARIANCE, 1))
    sensed = Measurement(traversability=field, std=torch.full_like(field, 0.1))
    state = after(Copula(window=16), prior, sensed)
    assert (state.std < 0.5).all()
    held = field < 0.02
    assert float(Copula().distribution(state).mean()[held].max()) < 0.1


@pytest.mark.parametrize("part", [1.0, 0.4, 0.0])
def test_another_prediction_of_some_cells_is_conditioned_on_the_same_λ(
    part: float,
) -> None:
    prior, other = (
        made.mixture(2, HEIGHT, WIDTH),
        made.mixture(2, HEIGHT, WIDTH, seed=3),
    )
    anew = torch.arange(WIDTH).expand(2, HEIGHT, WIDTH) < part * WIDTH
    other = prior.replaced(anew, other)
    looks = [
        looked({(4, 4): 0.5, (6, 6): 0.0}, 0.1, 2),
        looked({(10, 12): 0.4, (4, 4): 0.45}, 0.1, 2),
    ]
    state = after(Copula(), prior, *looks)
    state = replace(state, table=state.table.with_rows(prior, torch.ones_like(anew)))
    found, wanted = (
        Copula().update(state, looked({}, batch=2), other),
        after(Copula(), other, *looks),
    )
    # λ̂ is another everywhere there, also where the score stayed.
    changed = Copula().changed(state, found)
    assert (changed | ~anew).all()
    assert changed.any() == (part > 0)
    torch.testing.assert_close(found.mean, wanted.mean, atol=0.02, rtol=0)
    torch.testing.assert_close(found.std, wanted.std, atol=0.02, rtol=0)
    every = torch.ones_like(anew)
    torch.testing.assert_close(
        Copula().at(found, every).mean(),
        Copula().at(wanted, every).mean(),
        atol=0.01,
        rtol=0,
    )
    assert torch.equal(
        Copula().distribution(found).at(every).mean() > 0,
        wanted.prior.at(every).mean() > 0,
    )
    if part == 0:
        assert found.mean is state.mean or torch.equal(found.mean, state.mean)
        assert found.prior is state.prior


def test_λ_that_one_prediction_holds_impossible_is_remembered_for_the_next() -> None:
    sure = torch.ones(1, 1, HEIGHT, WIDTH, dtype=torch.float64)
    wrong, right = (
        TraversabilityMixture(sure, mean * sure, 0.05 * sure) for mean in (0.8, 0.2)
    )
    state = after(Copula(), wrong, looked({(6, 6): 0.15}))
    found = Copula().update(state, looked({}), right)
    assert float(found.lower[0, 6, 6]) == pytest.approx(-1.0)
    assert float(Copula().distribution(found).mean()[0, 6, 6]) == pytest.approx(
        0.15, abs=0.01
    )


def test_a_prediction_that_drifts_is_taken_when_it_has_moved() -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    state = after(Copula(), prior, looked({(6, 6): 0.5}))
    for step in range(1, 11):
        moved = replace(prior, means=prior.means + 4e-4 * step)
        state = Copula().update(state, looked({}), moved)
        assert float((state.prior.mean() - moved.mean()).abs().max()) < 1e-3  # type: ignore[attr-defined]
    assert state.prior is not prior


def test_fields_that_are_drawn_have_what_is_believed_and_what_was_observed() -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    state = after(
        Copula(), prior, looked({(4, 4): 0.5, (4, 7): 0.0, (9, 9): 0.85}, 0.05)
    )
    fields = Copula().sample_fields(state, 800, (9,))[0]
    found = Copula().distribution(state)
    for place in ((4, 4), (4, 5), (6, 7), (9, 9), (13, 0)):
        drawn = fields[:, *place].numpy()
        for level in (0.1, 0.3, 0.6, 0.9):
            assert (drawn <= level).mean() == pytest.approx(
                float(found.cdf(level)[0][place]), abs=0.07
            )
    # Cells between are drawn together: their scores keep the correlation that is left.
    left = cov_between([(6, 7)], [(6, 8)]) - (
        cov_between([(6, 7)], [(4, 4), (9, 9)])
        @ np.linalg.inv(
            cov_between([(4, 4), (9, 9)], [(4, 4), (9, 9)]) + 0.0025 * np.eye(2)
        )
        @ cov_between([(4, 4), (9, 9)], [(6, 8)])
    )
    assert left > 0.3
    ranks = (
        fields[:, 6, 7].argsort().argsort().double(),
        fields[:, 6, 8].argsort().argsort().double(),
    )
    assert float(torch.corrcoef(torch.stack(ranks))[0, 1]) > 0.5
    # Two batches of one key are the same fields.
    again = Copula().sample_fields(state, 40, (9,))[0]
    assert torch.equal(again, Copula().sample_fields(state, 40, (9,))[0])


@pytest.mark.parametrize("sensor", [Contact(), Probe(1.0, 0.1)])
def test_nine_of_ten_cells_near_the_robot_lie_in_the_90_percent_interval(
    sensor: Contact | Probe,
) -> None:
    """Randomised PIT of cells not yet observed, within 2ℓ of a robot on a straight way,
    by maps.
    """
    batch, steps = 150, 10
    covariance = made.covariance(20, 20, 1.5)
    prior = made.mixture(batch, 20, 20)
    field = prior.from_normal(made.scores(covariance, batch))
    terrain, keys = made.terrain(prior, field), list(range(batch))
    belief = Copula()
    state = belief.init(prior, covariance)
    for step in range(steps):
        where = torch.tensor(
            [[1.25 + 0.6 * step, 5.1, 0.0]], dtype=torch.float64
        ).repeat(batch, 1)
        state = belief.update(
            state, sensor.sense(terrain, field, where, NoiseKey(keys, step))
        )
    row, column = torch.arange(20)[:, None] * 0.5 + 0.25, torch.arange(20) * 0.5 + 0.25
    near = torch.hypot(row - 5.1, column - float(where[0, 0])) <= 3.0
    asked = near[None] & ~state.observed
    low, high = belief.distribution(state).cdf_limits(field)
    draw = torch.from_numpy(rng.uniform(1, np.arange(batch), (20, 20)))
    pit = torch.lerp(low, high, draw)
    inside = ((pit > 0.05) & (pit < 0.95)) & asked
    by_map = inside.flatten(1).sum(1) / asked.flatten(1).sum(1)
    share, error = (
        float(inside.sum() / asked.sum()),
        float(by_map.std() / np.sqrt(batch)),
    )
    assert abs(share - 0.9) < 2.5 * error
    assert error < 0.012
    # And the belief is narrower than the prediction.
    gain = (
        prior.log_prob(field)[asked].mean()
        - belief.distribution(state).log_prob(field)[asked].mean()
    )
    assert float(gain) < -0.05


@pytest.mark.parametrize("base", ["mixture", "quantiles"])
def test_of_some_cells_it_is_told_quickly_what_is_believed(base: str) -> None:
    prior: TraversabilityDistribution = made.mixture(2, HEIGHT, WIDTH)
    if base == "quantiles":
        values = torch.stack([prior.quantile(level) for level in LEVELS], 1)
        prior = QuantileDistribution(values)
    state = Copula().init(prior, COVARIANCE)
    for sensed in (
        looked({(4, 4): 0.5, (4, 7): 0.0}, 0.05, 2),
        looked({(9, 9): 1.0}, 0.2, 2),
    ):
        state = Copula().update(state, sensed)
    cells = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool)
    cells[0, 3:10, 3:10] = cells[1, 8:, 5] = True
    found, exact = Copula().at(state, cells), Copula().distribution(state).at(cells)
    assert found.shape == exact.shape == (1, 49 + 6)
    for measure in (
        lambda one: one.mean(), lambda one: one.cvar(0.8), lambda one: one.cvar(0.95), lambda one: one.var(0.9),
        lambda one: 1 / one.expected_time(0.05), lambda one: one.chance(0.1),
    ):  # fmt: skip
        torch.testing.assert_close(
            measure(found),
            measure(exact),
            atol=0.005 if base == "mixture" else 0.01,
            rtol=0,
        )


def test_cells_are_told_that_have_changed() -> None:
    prior = made.mixture(2, HEIGHT, WIDTH)
    before = Copula().init(prior, COVARIANCE)
    sensed = looked({(6, 6): 0.2}, 0.1, 2)
    sensed.traversability[1] = torch.nan
    after = Copula().update(before, sensed)
    changed = Copula().changed(before, after)
    assert not changed[1].any()
    assert torch.equal(changed[0], (after.mean[0] != 0) | (after.std[0] != 1))
    assert changed[0, 6, 6]
    assert (
        not Copula()
        .changed(after, Copula().update(after, sensed.select(torch.tensor([1, 1]))))
        .any()
    )


@pytest.mark.parametrize("noise_std", [MIN_STD, 0.1])
def test_beside_ground_at_zero_risk_is_that_of_all_fields_that_match(
    noise_std: float,
) -> None:
    """Against a million pairs of scores; a Gaussian posterior of the score would be off
    by 0.02 right beside it.
    """
    prior = made.mixture(1, HEIGHT, WIDTH)
    state = after(Copula(), prior, looked({(6, 6): 0.0}, noise_std))
    found, end = Copula().distribution(state), float(state.upper[0, 6, 6])
    here, other, noise = np.random.default_rng(0).standard_normal((3, 1_000_000))
    held = here + noise_std * noise < end
    for away in (0, 1, 2, 4):
        r = np.exp(-(away**2) / 18)
        score = torch.from_numpy((r * here + np.sqrt(1 - r * r) * other)[held][:40_000])
        place = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.bool)
        place[0, 6, 6 + away] = True
        one = prior.at(place)
        wide = [
            getattr(one, name).expand(*one.weights.shape[:-1], len(score))
            for name in ("weights", "means", "stds")
        ]
        matching = TraversabilityMixture(*wide).from_normal(score[None])[0]
        assert len(matching) == 40_000
        believed = found.at(place)
        worst = matching.sort()[0][:8000].mean()
        assert float(believed.mean()) == pytest.approx(
            float(matching.mean()), abs=0.004
        )
        assert float(believed.cvar(0.8)) == pytest.approx(float(worst), abs=0.003)
        assert float(believed.cdf(0.1)) == pytest.approx(
            float((matching <= 0.1).double().mean()), abs=0.007
        )


def test_the_length_is_a_number_or_a_word_in_a_suite() -> None:
    def of(value: Any) -> Copula:
        return registry.make(
            "belief", {"part": FILE, "options": {"correlation_m": value}}
        )

    assert [of(value).correlation_m for value in (0.75, 2, "world", "estimated")] == [
        0.75,
        2.0,
        "world",
        "estimated",
    ]
    for value in ("guessed", None):
        with pytest.raises(
            ConfigError,
            match=r"`correlation_m` of belief .* as a number or 'world' or 'estimated'",
        ):
            of(value)


@pytest.mark.parametrize(
    "wrong", [{"correlation_m": -1.0}, {"correlation_m": "guessed"}, {"window": 0}]
)
def test_what_cannot_be_believed_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        Copula(**wrong)


def test_a_state_is_not_changed_by_an_update() -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    state = after(Copula(), prior, looked({(4, 4): 0.5}))
    before = state.clone()
    Copula().update(state, looked({(6, 6): 0.0}))
    for name in ("lower", "upper", "noise_std", "precision", "shift", "mean", "std"):
        one: Tensor = getattr(state, name)
        torch.testing.assert_close(
            one, getattr(before, name), rtol=0, atol=0, equal_nan=True
        )


def test_episodes_that_take_the_places_of_others_are_what_they_were_alone() -> None:
    belief, looks = (
        Copula(),
        (looked({(4, 4): 0.5, (9, 2): 0.0}, batch=3), looked({(6, 6): 0.3}, batch=2)),
    )
    prior, other = (
        made.mixture(3, HEIGHT, WIDTH),
        made.mixture(2, HEIGHT, WIDTH, seed=1),
    )
    one, two = after(belief, prior, looks[0]), after(belief, other, looks[1])
    whole = belief.put(one, torch.tensor([2, 0]), two)
    more = looked({(7, 5): 0.6}, batch=3)
    for state, alone, now in (
        (whole, (one, two), whole),
        (
            belief.update(whole, more),
            tuple(
                belief.update(each, more.select(torch.arange(len(each.mean))))
                for each in (one, two)
            ),
            whole,
        ),
    ):
        cells = torch.ones(3, HEIGHT, WIDTH, dtype=torch.bool)
        found = belief.at(state, cells).mean().view(3, HEIGHT, WIDTH)
        first, second = (
            belief.at(each, cells[: len(each.mean)]).mean().view(-1, HEIGHT, WIDTH)
            for each in alone
        )
        torch.testing.assert_close(
            found, torch.stack((second[1], first[1], second[0])), atol=1e-9, rtol=0
        )
        assert belief.changed(now, state).any() == (state is not now)
