"""What the base makes of a CDF alone, against exact forms of the same distributions."""

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from torch import Tensor

from benchnav.core.batch import map_tensors
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.pooled import PooledDistribution
from benchnav.core.quantiles import QuantileDistribution
from tests import factories
from tests.core.distributions import Hidden, mixture, quantiles

LAWS = {
    "wide": mixture(1, 0.1, 0.5),
    "several wide": mixture(3, 0.1, 0.5),
    "narrow": mixture(3, 0.001, 0.02),
    "wide and narrow": mixture(3, 0.0005, 0.5, seed=1),
    "points": mixture(3, 1e-9, 1e-8),
    "many": mixture(6, 0.01, 0.3),
    "20 needles": mixture(20, 1e-3, 2e-3),
    "20 points": mixture(20, 1e-9, 1e-8),
    "50 points": mixture(50, 1e-9, 1e-8),
    "quantiles": quantiles(),
    "other quantiles": quantiles(1),
}
EACH = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS.keys())


def these(*names: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("law", [LAWS[name] for name in names], ids=names)


def close(found: Tensor, wanted: Tensor, relative: float = 0.0) -> None:
    assert found.dtype == wanted.dtype
    torch.testing.assert_close(
        found, wanted, rtol=relative, atol=0 if relative else 1e-4
    )


@EACH
@pytest.mark.parametrize("level", [0.0, 0.5, 0.9, 0.99])
def test_the_tail_of_a_cdf_is_that_of_the_exact_form(
    law: TraversabilityDistribution, level: float
) -> None:
    close(Hidden(law).cvar(level), law.cvar(level))
    torch.testing.assert_close(
        Hidden(law).var(level), law.var(level), rtol=0, atol=1e-9
    )


@EACH
@pytest.mark.parametrize("floor", [0.01, 0.05, 0.5, 1.0])
def test_the_expected_time_of_a_cdf_is_that_of_the_exact_form(
    law: TraversabilityDistribution, floor: float
) -> None:
    close(Hidden(law).expected_time(floor), law.expected_time(floor), relative=1e-4)


@EACH
@pytest.mark.parametrize("level", [0.0, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("floor", [0.01, 0.3])
def test_the_tail_of_the_time_of_a_cdf_is_that_of_the_exact_form(
    law: TraversabilityDistribution, level: float, floor: float
) -> None:
    close(
        Hidden(law).time_cvar(level, floor), law.time_cvar(level, floor), relative=1e-4
    )
    if level == 0:
        close(law.time_cvar(level, floor), law.expected_time(floor), relative=1e-6)


@EACH
@pytest.mark.parametrize("bound", [0.0, 0.1, 0.35, 1.0])
def test_the_chance_of_a_cdf_is_that_of_the_exact_form(
    law: TraversabilityDistribution, bound: float
) -> None:
    close(Hidden(law).chance(bound), law.chance(bound))


@these("wide", "narrow", "wide and narrow", "points", "many", "quantiles")
def test_the_crps_of_a_cdf_is_the_integral_that_defines_it(
    law: TraversabilityDistribution,
) -> None:
    observed = torch.rand(
        law.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64
    )
    observed[0, 0, :2] = torch.tensor([0.0, 1.0])
    if isinstance(law, QuantileDistribution):  # whose form is exact
        close(Hidden(law).crps(observed), law.crps(observed))
        return
    # a midpoint rule, off by half a step times all rises of a monotone function
    count = 20_000
    total, many = (
        torch.zeros_like(observed),
        law.select(torch.arange(len(observed)).repeat(500)),
    )
    for points in ((torch.arange(count, dtype=torch.float64) + 0.5) / count).view(
        -1, 500, 1, 1, 1
    ):
        x = points.expand(-1, *observed.shape)
        below = many.cdf(x.flatten(0, 1)).view_as(x)
        total += (below - (observed <= x).double()).square().sum(0)
    close(Hidden(law).crps(observed), total / count)


def test_what_is_certain_is_scored_by_its_distance_also_within_an_atom() -> None:
    ones = torch.ones(1, 1, 1, 3, dtype=torch.float64)
    law = Hidden(TraversabilityMixture(ones, 0.3 * ones, 0 * ones))
    observed = torch.tensor([[[0.0, 0.3, 1.0]]], dtype=torch.float64)
    close(law.crps(observed), torch.tensor([[[0.3, 0.0, 0.7]]], dtype=torch.float64))


@settings(max_examples=30, deadline=None)
@given(
    means=st.lists(st.floats(-0.5, 1.5), min_size=3, max_size=3),
    stds=st.lists(st.sampled_from([0.0, 1e-4, 0.01, 0.1, 1.0]), min_size=3, max_size=3),
    share=st.floats(0, 1),
    level=st.sampled_from([0.0, 0.5, 0.9, 0.99]),
)
def test_any_cdf_has_the_integrals_of_its_exact_form(
    means: list[float], stds: list[float], share: float, level: float
) -> None:
    weights = [share, (1 - share) / 3, 2 * (1 - share) / 3]
    law = TraversabilityMixture(
        *torch.tensor([weights, means, stds], dtype=torch.float64)[..., None, None]
    )
    close(Hidden(law).cvar(level), law.cvar(level))
    close(Hidden(law).expected_time(0.05), law.expected_time(0.05), relative=1e-4)


@EACH
def test_normal_numbers_and_traversability_are_of_one_rank(
    law: TraversabilityDistribution,
) -> None:
    hidden, normal = (
        Hidden(law),
        torch.linspace(-2, 2, law.shape.numel(), dtype=torch.float64).view(law.shape),
    )
    value = hidden.from_normal(normal)
    share = torch.from_numpy(stats.norm.cdf(normal.numpy()))
    torch.testing.assert_close(law.quantile(share), value, rtol=0, atol=1e-9)
    lower, upper = hidden.to_normal(value - 1e-7)[0], hidden.to_normal(value + 1e-7)[1]
    assert (lower <= normal + 1e-6).all()
    assert (normal <= upper + 1e-6).all()


def test_the_interval_of_normal_numbers_is_that_of_an_atom() -> None:
    law = mixture(1, 0.1, 0.2)
    mean, std = law.means.squeeze(1), law.stds.squeeze(1)
    for own in (law, Hidden(law)):
        for value, lower, upper in (
            (0.0, -math.inf, -mean / std),
            (1.0, (1 - mean) / std, math.inf),
        ):
            found = own.to_normal(value)
            for side, wanted in zip(found, (lower, upper), strict=True):
                wanted = torch.as_tensor(wanted, dtype=torch.float64).expand(law.shape)
                # Of a CDF near 1 not all figures are left.
                known = (wanted.abs() < 4) | wanted.isinf()
                torch.testing.assert_close(
                    side[known], wanted[known], atol=1e-6, rtol=0
                )
    below, above = Hidden(law).to_normal(-0.1), Hidden(law).to_normal(1.1)
    assert bool((below[1] == -math.inf).all())
    assert bool((above[0] == math.inf).all())


def test_the_spread_of_a_normal_law_is_its_standard_deviation() -> None:
    mean = torch.full((1, 3, 3), 0.5)
    spread = factories.normal(mean, torch.full_like(mean, 0.1)).spread()
    torch.testing.assert_close(
        spread, torch.full_like(mean, 0.99446 * 0.1), rtol=0, atol=5e-5
    )
    assert factories.certain(mean).spread().abs().max() == 0


def test_what_a_cdf_alone_cannot_tell_is_not_a_number_or_refused_by_name() -> None:
    law = Hidden(mixture(2, 0.1, 0.2))
    assert bool(law.log_prob(torch.full(law.shape, 0.5)).isnan().all())
    for ask in (law.most_likely, lambda: law.class_probabilities(2)):
        with pytest.raises(ConfigError, match="got Hidden"):
            ask()


@pytest.mark.parametrize("value", [-0.1, 1.0, math.nan])
def test_levels_and_floors_out_of_range_are_refused(value: float) -> None:
    with pytest.raises(ConfigError, match="level"):
        Hidden(mixture(1, 0.1, 0.2)).cvar(value)
    with pytest.raises(ConfigError, match="minimum speed"):
        Hidden(mixture(1, 0.1, 0.2)).expected_time(value + 0.5 if value == 1 else value)


@these("wide and narrow", "20 points", "quantiles")
def test_the_integrals_of_a_cell_are_its_own_however_many_others_there_are(
    law: TraversabilityDistribution, monkeypatch: pytest.MonkeyPatch
) -> None:
    law, observed = Hidden(law), torch.full(law.shape, 0.4, dtype=torch.float64)
    whole = law.cvar(0.9), law.mean(), law.expected_time(0.05), law.crps(observed)
    for cells in (1, 14, 40):  # of rows, of a few rows, and of more than a map
        monkeypatch.setattr("benchnav.core.distribution._CHUNK_CELLS_ON_CPU", cells)
        pieces = law.cvar(0.9), law.mean(), law.expected_time(0.05), law.crps(observed)
        for found, wanted in zip(pieces, whole, strict=True):
            torch.testing.assert_close(found, wanted, rtol=0, atol=1e-12)
    alone = law.select(torch.tensor([1]))
    torch.testing.assert_close(alone.cvar(0.9), whole[0][1:], rtol=0, atol=1e-12)


@pytest.mark.parametrize("leading", [(), (3,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_leading_dimensions_and_dtype_are_kept(
    leading: tuple[int, ...], dtype: torch.dtype
) -> None:
    generator = torch.Generator().manual_seed(0)
    weights, means, stds = torch.rand(
        3, *leading, 2, 4, 3, generator=generator, dtype=dtype
    )
    law = TraversabilityMixture(
        weights / weights.sum(-3, keepdim=True), means, 0.1 + stds
    )
    hidden, value = Hidden(law), torch.full(law.shape, 0.4, dtype=dtype)
    assert hidden.shape == (*leading, 4, 3)
    assert hidden.dtype == dtype
    assert hidden.device == value.device
    for name, arguments in (
        ("mean", ()), ("var", (0.0,)), ("var", (0.9,)), ("cvar", (0.8,)), ("expected_time", (0.1,)), ("chance", (0.3,)),
        ("from_normal", (value,)), ("crps", (value,)), ("log_prob", (value,)),
    ):  # fmt: skip
        for own in (law, hidden):
            found = getattr(own, name)(*arguments)
            assert (found.shape, found.dtype) == (law.shape, dtype), name
    torch.testing.assert_close(hidden.cvar(0.8), law.cvar(0.8), rtol=0, atol=1e-4)
    for side in (
        *law.to_normal(0.4),
        *hidden.to_normal(value),
        *hidden.cdf_limits(0.4),
    ):
        assert (side.shape, side.dtype) == (law.shape, dtype)


def test_cells_and_members_are_taken_out_of_what_a_distribution_is_made_of() -> None:
    law = Hidden(mixture(2, 0.1, 0.3))
    which = torch.rand(law.shape, generator=torch.Generator().manual_seed(0)) > 0.5
    assert torch.equal(law.at(which).quantile(0.3), law.quantile(0.3)[which][None])
    assert torch.equal(
        law.select(torch.tensor([1, 0, 1])).cdf(0.4), law.cdf(0.4)[[1, 0, 1]]
    )
    assert law.to("meta").device.type == "meta"
    copied = law.clone()
    assert isinstance(copied.own, TraversabilityMixture)
    copied.own.means.zero_()
    assert not torch.equal(copied.cdf(0.4), law.cdf(0.4))


@pytest.mark.parametrize("kind", ["mixture", "quantiles", "pooled"])
def test_cells_are_told_in_which_two_predictions_differ(kind: str) -> None:
    base: Any = quantiles() if kind == "quantiles" else mixture(3, 0.1, 0.4)
    base = (
        PooledDistribution((base, mixture(2, 0.1, 0.4))) if kind == "pooled" else base
    )
    cells = torch.zeros(base.shape, dtype=torch.bool)
    cells[0, 2, 3] = cells[1, 4] = True
    moved = map_tensors(base, lambda values: values + 1e-3)
    found = base.replaced(cells, moved)
    assert torch.equal(base.differs(found), cells)
    assert not base.differs(found, 2e-3).any()
    assert base.differs(mixture(5, 0.1, 0.4)).all()
