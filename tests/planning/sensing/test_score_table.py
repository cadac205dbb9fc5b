"""Distributions by a table of their CDF: their functions agree with each other, with
integrals of it and with draws.
"""

import pytest
import torch

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.planning.sensing import score_table
from benchnav.planning.sensing.score_table import (
    VALUES,
    ScoreTable,
    TabulatedDistribution,
    scores_of,
)
from benchnav.testing.breaches import Breaches
from benchnav.testing.distribution import check_functions
from tests.core.distributions import Hidden, mixture, quantiles


def table() -> TabulatedDistribution:
    """Steep, flat, and with atoms at both ends, a cell each."""
    values = torch.tensor(VALUES, dtype=torch.float64)
    smooth = 0.15 + 0.7 * values**2
    steep = (values >= 0.3).double()
    even = values.clone()
    sure = torch.ones_like(values)
    never = torch.zeros_like(values)
    return TabulatedDistribution(
        torch.stack((smooth, steep, even, sure, never), -1)[None, :, None]
    )


def test_functions_are_those_of_a_distribution_and_agree_with_integrals_of_its_cdf() -> (
    None
):
    breaches = Breaches("distribution", "table")
    check_functions(table(), 1e-6, breaches)
    breaches.raise_any()


@pytest.mark.parametrize("floor", [0.03, 0.05, 0.5])
def test_means_of_all_kinds_are_those_of_draws(floor: float) -> None:
    law = table()
    shares = (torch.arange(5000, dtype=torch.float64) + 0.5) / 5000
    drawn = torch.stack([law.quantile(share)[0, 0] for share in shares])
    assert torch.allclose(law.mean()[0, 0], drawn.mean(0), atol=2e-4, rtol=0)
    worst = drawn[: len(drawn) // 5].mean(0)
    assert torch.allclose(law.cvar(0.8)[0, 0], worst, atol=5e-4, rtol=0)
    times = (1 / drawn.clamp(min=floor)).mean(0)
    assert torch.allclose(law.expected_time(floor)[0, 0], times, rtol=2e-3, atol=0)
    for level in (0.5, 0.8):
        least = drawn[: round(len(drawn) * (1 - level))].clamp(min=floor)
        assert torch.allclose(
            law.time_cvar(level, floor)[0, 0], (1 / least).mean(0), rtol=2e-3, atol=0
        )
    assert torch.allclose(
        law.time_cvar(0.0, floor), law.expected_time(floor), rtol=1e-9, atol=0
    )


@pytest.mark.parametrize("level", [0.0, 0.3, 0.5, 0.8, 0.9, 0.95])
def test_rounding_leaves_λ_between_0_and_1(level: float) -> None:
    generator = torch.Generator().manual_seed(0)
    shares = torch.rand(len(VALUES), 3000, generator=generator).sort(0).values
    shares[:, :1000] = 0  # sure of 1
    shares[:-1, 1000:2000] *= 1e-6
    law = TabulatedDistribution(shares[None, :, None])
    for found in (law.cvar(level), law.mean()):
        assert found.dtype == torch.float32
        assert float(found.min()) >= 0
        assert float(found.max()) <= 1


@pytest.mark.parametrize("cells", [1, 12, 512])
@pytest.mark.parametrize(
    "prior",
    [
        mixture(3, 0.05, 0.3),
        mixture(1, 0.001, 0.2),
        quantiles(dtype=torch.float32),
        Hidden(mixture(2, 0.1, 0.2)),
    ],
)
def test_a_row_has_the_scores_of_its_own_cell(
    prior: TraversabilityDistribution, cells: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(score_table, "_CHUNK_SIZE", cells)
    row = prior.at(torch.ones(prior.shape, dtype=torch.bool))
    found = scores_of(row)
    for place, value in enumerate(VALUES):
        low, high = row.to_normal(value)
        wanted = (high if value < 1 else low)[0].float().clamp(-9, 9)
        torch.testing.assert_close(found[:, place], wanted, rtol=0, atol=1e-5)
    assert scores_of(prior.at(torch.zeros(prior.shape, dtype=torch.bool))).shape == (
        0,
        len(VALUES),
    )


def test_a_table_that_grows_by_parts_has_the_row_of_each_cell() -> None:
    prior = mixture(3, 0.05, 0.3)
    every = torch.ones(prior.shape, dtype=torch.bool)
    number = torch.arange(every.numel()).view(prior.shape)
    table = ScoreTable.empty(prior).with_rows(prior, number % 3 == 1)
    table = table.without_rows(number % 2 == 0).with_rows(prior, every)
    found = table.rows.scores[table.row_index[every]]
    wanted = scores_of(prior.at(every))
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-5)
