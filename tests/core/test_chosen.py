"""One of two distributions in each cell, against what each of them says."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from benchnav.core.chosen import NO_CLASS, ChosenDistribution, choose
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.mixture import TraversabilityMixture
from tests.core.distributions import Hidden, mixture, quantiles

SHAPE = (2, 5, 7)
CHOSEN = torch.rand(SHAPE, generator=torch.Generator().manual_seed(4)) < 0.5
VALUES = torch.rand(
    SHAPE, generator=torch.Generator().manual_seed(5), dtype=torch.float64
)
ASKED: dict[str, Callable[[TraversabilityDistribution], Tensor]] = {
    "mean": lambda own: own.mean(),
    "cdf": lambda own: own.cdf(0.3),
    "cdf of a map": lambda own: own.cdf(VALUES),
    "below": lambda own: own.cdf_limits(0.0)[0],
    "at most": lambda own: own.cdf_limits(0.0)[1],
    "quantile": lambda own: own.quantile(0.2),
    "var": lambda own: own.var(0.9),
    "cvar": lambda own: own.cvar(0.8),
    "expected time": lambda own: own.expected_time(0.05),
    "time CVaR": lambda own: own.time_cvar(0.8, 0.05),
    "chance": lambda own: own.chance(0.1),
    "log density": lambda own: own.log_prob(VALUES),
    "log mass": lambda own: own.log_prob(torch.zeros_like(VALUES)),
    "from normal": lambda own: own.from_normal(2 * VALUES - 1),
    "least score": lambda own: own.to_normal(VALUES)[0],
    "most score": lambda own: own.to_normal(1.0)[0],
}
PAIRS = {
    "of mixtures": (mixture(3, 0.02, 0.3), mixture(2, 0.05, 0.2, seed=1)),
    "of unlike kinds": (quantiles(), mixture(2, 0.05, 0.2, seed=1)),
    "of the other order": (mixture(2, 0.05, 0.2, seed=1), quantiles()),
    "of hidden ones": (Hidden(mixture(3, 0.02, 0.3)), Hidden(quantiles())),
}


@pytest.mark.parametrize("asked", ASKED)
@pytest.mark.parametrize("pair", PAIRS)
def test_each_cell_has_the_one_or_the_other(pair: str, asked: str) -> None:
    first, second = PAIRS[pair]
    found, ask = choose(CHOSEN, first, second), ASKED[asked]
    assert found.shape == SHAPE
    torch.testing.assert_close(
        ask(found),
        torch.where(CHOSEN, ask(first), ask(second)),
        rtol=1e-6,
        atol=1e-6,
        equal_nan=True,
    )


@pytest.mark.parametrize("pair", PAIRS)
def test_batches_and_cells_of_it_are_those_of_the_two(pair: str) -> None:
    first, second = PAIRS[pair]
    found, last = choose(CHOSEN, first, second), torch.tensor([1])
    wanted = torch.where(CHOSEN, first.mean(), second.mean())
    assert torch.allclose(found.select(last).mean(), wanted[1:])
    cells = VALUES > 0.6
    assert torch.allclose(found.at(cells).mean()[0], wanted[cells])
    turned = found.put(torch.tensor([0]), found.select(last))
    assert torch.allclose(turned.mean(), wanted[[1, 1]])


def test_two_mixtures_make_one_whose_second_components_belong_to_no_class() -> None:
    first, second = PAIRS["of mixtures"]
    found = choose(CHOSEN, first, second)
    assert isinstance(found, TraversabilityMixture)
    assert found.group == (0, 1, 2, NO_CLASS, NO_CLASS)
    seen = found.class_probabilities(3)
    assert torch.equal(
        seen.movedim(1, -1)[CHOSEN], first.weights.movedim(1, -1)[CHOSEN]
    )
    assert (seen.movedim(1, -1)[~CHOSEN] == 0).all()
    likely = found.most_likely()
    torch.testing.assert_close(
        likely.mean()[CHOSEN], first.most_likely().mean()[CHOSEN]
    )
    # Where nothing is of a class, all that is believed stays.
    torch.testing.assert_close(likely.mean()[~CHOSEN], second.mean()[~CHOSEN])


def test_a_mixture_without_classes_stays_one() -> None:
    first, second = PAIRS["of mixtures"]
    plain = TraversabilityMixture(first.weights, first.means, first.stds)
    found = choose(CHOSEN, plain, second)
    assert isinstance(found, TraversabilityMixture)
    assert found.group is None


@pytest.mark.parametrize("pair", PAIRS)
def test_it_has_the_dtype_of_the_first(pair: str) -> None:
    kinds: dict[str, Any] = {
        "of mixtures": (
            mixture(3, 0.02, 0.3, dtype=torch.float32),
            mixture(2, 0.05, 0.2, seed=1),
        ),
        "of unlike kinds": (
            quantiles(dtype=torch.float32),
            mixture(2, 0.05, 0.2, seed=1),
        ),
        "of the other order": (
            mixture(2, 0.05, 0.2, seed=1, dtype=torch.float32),
            quantiles(),
        ),
        "of hidden ones": (
            Hidden(mixture(3, 0.02, 0.3, dtype=torch.float32)),
            Hidden(quantiles()),
        ),
    }
    found = choose(CHOSEN, *kinds[pair])
    assert found.dtype == found.mean().dtype == found.cvar(0.9).dtype == torch.float32


def test_unlike_kinds_are_kept_beside_each_other() -> None:
    first, second = PAIRS["of unlike kinds"]
    found = choose(CHOSEN, first, second)
    assert isinstance(found, ChosenDistribution)
    assert found.chosen is CHOSEN
