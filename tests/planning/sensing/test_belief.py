from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from benchnav.core.chosen import ChosenDistribution, choose
from benchnav.core.copula import correlations
from benchnav.core.errors import ConfigError
from benchnav.core.pooled import pool
from benchnav.planning.sensing.belief import (
    CovarianceModel,
    Predicted,
    Static,
    draw_scores,
    fields_of,
)
from benchnav.planning.sensing.score_table import VALUES, value_at
from benchnav.planning.sensing.sensor import Measurement
from tests.planning.sensing import made

COVARIANCE = made.covariance(10, 12, 1.5)
KEYS = (5, 6)


def test_static_gives_the_prediction_whatever_is_sensed() -> None:
    prior, other = made.mixture(2, 10, 12), made.mixture(2, 10, 12, seed=1)
    belief = Static()
    state = belief.init(prior, COVARIANCE)
    seen = Measurement(traversability=torch.zeros(2, 10, 12), std=torch.ones(2, 10, 12))
    assert belief.distribution(belief.update(state, seen)) is prior
    assert belief.distribution(belief.update(state, seen, other)) is other
    assert not belief.learns
    kept = belief.select(state, torch.tensor([1]))
    assert torch.equal(belief.distribution(kept).mean(), prior.mean()[1:])


def test_static_believes_something_else_where_the_prediction_is_another() -> None:
    prior, belief = made.mixture(2, 10, 12), Static()
    state = belief.init(prior, COVARIANCE)
    cells = torch.zeros(2, 10, 12, dtype=torch.bool)
    cells[1, 3, 4:7] = True
    other = replace(
        prior, means=torch.where(cells[:, None], 1 - prior.means, prior.means)
    )
    nothing = Measurement(
        traversability=torch.full((2, 10, 12), torch.nan), std=torch.ones(2, 10, 12)
    )
    assert torch.equal(
        belief.changed(state, belief.update(state, nothing, other)), cells
    )
    assert not belief.changed(state, belief.update(state, nothing)).any()


def test_episodes_take_the_places_of_others() -> None:
    prior, other = made.mixture(3, 10, 12), made.mixture(2, 10, 12, seed=1)
    belief = Static()
    state = belief.init(prior, COVARIANCE)
    whole = belief.put(state, torch.tensor([2, 0]), belief.init(other, COVARIANCE))
    wanted = torch.stack((other.mean()[1], prior.mean()[1], other.mean()[0]))
    assert torch.equal(belief.distribution(whole).mean(), wanted)
    assert torch.equal(belief.distribution(state).mean(), prior.mean())


@pytest.mark.parametrize("correlated", [True, False])
def test_fields_have_the_marginals_and_the_laws_correlation(correlated: bool) -> None:
    prior = made.mixture(2, 10, 12)
    belief = Static(correlated)
    fields = belief.sample_fields(belief.init(prior, COVARIANCE), 800, KEYS)
    assert fields.shape == (2, 800, 10, 12)
    for own, row, column in ((0, 0, 0), (1, 9, 11), (0, 4, 5)):
        drawn = fields[own, :, row, column].numpy()
        for level in (0.05, 0.3, 0.8):
            expected = float(prior.cdf(level)[own, row, column])
            assert (drawn <= level).mean() == pytest.approx(expected, abs=0.07)
    rank = stats.spearmanr(fields[0, :, 4, 5], fields[0, :, 4, 6])[0]
    # Spearman's ρ of normal numbers of correlation r is 6/π asin(r/2); atoms make it a
    # little less.
    expected = 6 / np.pi * np.arcsin(np.exp(-1 / 18) / 2) if correlated else 0
    assert rank == pytest.approx(expected, abs=0.1)


def test_an_episodes_fields_are_its_own_keys() -> None:
    prior = made.mixture(2, 10, 12)
    belief = Static()
    both = belief.sample_fields(belief.init(prior, COVARIANCE), 4, KEYS)
    one = belief.sample_fields(
        belief.init(prior.select(torch.tensor([1])), COVARIANCE), 4, KEYS[1:]
    )
    assert torch.equal(both[1:], one)
    more = belief.sample_fields(belief.init(prior, COVARIANCE), 6, KEYS)
    assert torch.equal(more[:, :4], both)


def test_a_length_that_is_none_is_refused() -> None:
    with pytest.raises(ConfigError, match="correlation_m"):
        CovarianceModel(grid=COVARIANCE.grid, correlation_m=-1.0)


def test_fields_that_are_drawn_have_the_laws_nugget() -> None:
    covariance = replace(made.covariance(4, 6, 1.5), nugget=0.3)
    drawn = draw_scores(covariance, 4000, (7,))[0].flatten(1)
    found = np.corrcoef(drawn.numpy().T)[0, 1:3]
    np.testing.assert_allclose(drawn.std(0), 1, atol=0.04)
    np.testing.assert_allclose(found, 0.7 * np.exp(-np.array([1, 4]) / 18), atol=0.04)


@pytest.mark.parametrize("correlation_m", [0.4, 1.5])
def test_scores_are_correlated_as_those_of_the_world_along_both_axes(
    correlation_m: float,
) -> None:
    covariance = made.covariance(5, 7, correlation_m)
    drawn = draw_scores(covariance, 20000, (7,))[0].flatten(1).double()
    down, across = (
        correlations(size, covariance.correlation_cells)
        for size in covariance.grid.shape
    )
    row, column = np.divmod(np.arange(35), 7)
    wanted = down[abs(row[:, None] - row)] * across[abs(column[:, None] - column)]
    np.testing.assert_allclose(drawn.T @ drawn / 20000, wanted, atol=0.035)
    assert float(drawn.mean(0).abs().max()) < 0.035


def test_fields_that_are_told_from_a_table_have_the_ranks_of_their_scores() -> None:
    prior, covariance = made.mixture(3, 10, 12), made.covariance(10, 12)
    scores = draw_scores(covariance, 200, (1, 2, 3)).double()
    assert prior.searched
    found, wanted = (
        Predicted(prior=prior, covariance=covariance).fields(scores),
        fields_of(prior, scores),
    )
    assert float((found - wanted).abs().max()) < 0.01
    assert float((found - wanted).abs().mean()) < 0.0005
    for end in (0.0, 1.0):  # atoms are whole
        assert torch.equal(found == end, wanted == end)
        assert float((wanted == end).double().mean()) > 0.02
    known = (
        Predicted(prior=prior, covariance=covariance)
        .select(torch.tensor([2, 0]))
        .fields(scores[[2, 0]])
    )
    assert torch.equal(known, found[[2, 0]])


def test_of_ground_that_is_known_for_sure_fields_are_exact() -> None:
    mixed, covariance = made.mixture(1, 10, 12), made.covariance(10, 12)
    sure = replace(mixed, stds=torch.zeros_like(mixed.stds))
    scores = draw_scores(covariance, 20, (1,)).double()
    both = torch.rand(mixed.shape, generator=torch.Generator().manual_seed(0)) < 0.5
    for prior in (sure, choose(both, mixed, sure), pool([mixed, sure])):
        assert not prior.searched
        found = Predicted(prior=prior, covariance=covariance).fields(scores)
        assert torch.equal(found, fields_of(prior, scores))
    away = fields_of(sure, scores)[:, :, None] - mixed.means[:, None]
    assert float(away.abs().amin(2).max()) < 1e-6
    assert pool([mixed, mixed]).searched
    assert ChosenDistribution(mixed, mixed, both).searched
    for parts in ((mixed, sure), (sure, mixed)):
        assert not ChosenDistribution(*parts, both).searched


def test_beyond_the_ends_of_a_row_values_are_0_and_1() -> None:
    rows = torch.linspace(-1, 1, len(VALUES))[None].clone()
    rows[:, -3:], rows[:, :3] = 1.0, -1.0
    assert value_at(rows, torch.tensor([[-1.2, 1.2]])).tolist() == [[0.0, 1.0]]
