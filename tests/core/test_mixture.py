import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import optimize, stats
from scipy.special import ndtr
from torch._subclasses.fake_tensor import FakeTensorMode

from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from tests.factories import draw

DRAWS = 10**6


def random_mixture(
    components: int = 4, cells: int = 6, seed: int = 0
) -> TraversabilityMixture:
    generator = torch.Generator().manual_seed(seed)
    shape = (2, components, 1, cells)
    weights = torch.rand(shape, generator=generator, dtype=torch.float64)
    means = 1.4 * torch.rand(shape, generator=generator, dtype=torch.float64) - 0.2
    stds = 0.02 + 0.3 * torch.rand(shape, generator=generator, dtype=torch.float64)
    return TraversabilityMixture(
        weights / weights.sum(1, keepdim=True), means, stds, tuple(range(components))
    )


def single(
    mean: float, std: float, dtype: torch.dtype = torch.float64
) -> TraversabilityMixture:
    one = torch.ones(1, 1, 1, dtype=dtype)
    return TraversabilityMixture(one, mean * one, std * one)


@lru_cache
def monte_carlo() -> torch.Tensor:
    return (
        draw(random_mixture(), DRAWS, torch.Generator().manual_seed(1))
        .sort(dim=0)
        .values
    )


@pytest.mark.parametrize("level", [0.0, 0.5, 0.9, 0.99])
def test_risk_measures_match_monte_carlo(level: float) -> None:
    mixture = random_mixture()
    draws = monte_carlo()
    assert draws.shape == (DRAWS, 2, 1, 6)
    torch.testing.assert_close(mixture.mean(), draws.mean(0), atol=2e-3, rtol=0)
    tail = max(1, round((1 - level) * DRAWS))
    torch.testing.assert_close(
        mixture.cvar(level), draws[:tail].mean(0), atol=4e-3, rtol=0
    )
    if level > 0:
        reached = (draws <= mixture.var(level) + 1e-9).double().mean(0)
        atom = (draws <= mixture.var(level) - 1e-9).double().mean(0)
        assert ((atom <= 1 - level + 3e-3) & (reached >= 1 - level - 3e-3)).all()


@pytest.mark.parametrize("mean", [-0.3, 0.0, 0.2, 0.7, 1.0, 1.4])
@pytest.mark.parametrize("std", [0.01, 0.15, 2.0])
@pytest.mark.parametrize("level", [0.0, 0.3, 0.9, 0.999])
def test_single_gaussian_matches_quadrature_of_its_quantiles(
    mean: float, std: float, level: float
) -> None:
    # clip(F⁻¹(u), 0, 1) integrated in u by scipy: neither our root finding nor our
    # closed forms.
    from scipy.integrate import quad

    def quantile(u: float) -> float:
        return float(min(max(stats.norm.ppf(u, mean, std), 0), 1))

    tail = 1 - level
    kinks = [float(stats.norm.cdf((edge - mean) / std)) for edge in (0, 1)]
    inside = sorted(k for k in kinks if 0 < k < tail)
    expected = quad(quantile, 0, tail, points=inside or None, limit=200)[0] / tail
    mixture = single(mean, std)
    assert mixture.cvar(level).item() == pytest.approx(expected, abs=2e-6)
    assert mixture.var(level).item() == pytest.approx(
        1.0 if level == 0 else quantile(tail), abs=1e-7
    )


@pytest.mark.parametrize("level", [1e-6, 0.3, 0.9, 0.99, 1 - 1e-9])
def test_value_at_risk_is_the_root_that_another_library_finds(level: float) -> None:
    generator = torch.Generator().manual_seed(3)
    shape, tail = (5, 60), 1 - level
    weights = torch.rand(shape, generator=generator, dtype=torch.float64) ** 4
    means = 2 * torch.rand(shape, generator=generator, dtype=torch.float64) - 0.5
    # from steps to planes
    stds = 10 ** (-6 * torch.rand(shape, generator=generator, dtype=torch.float64))
    weights = weights / weights.sum(0)
    found = TraversabilityMixture(
        *(values.unsqueeze(1) for values in (weights, means, stds))
    ).var(level)
    inside = 0
    for cell, value in enumerate(found.flatten().tolist()):
        own = [values[:, cell].numpy() for values in (weights, means, stds)]

        def excess(x: float, own: list = own) -> float:
            return float((own[0] * stats.norm.cdf(x, own[1], own[2])).sum()) - tail

        if excess(0) >= 0 or excess(1) <= 0:
            assert value == (0 if excess(0) >= 0 else 1)
        else:
            inside += 1
            assert value == pytest.approx(
                optimize.brentq(excess, 0, 1, xtol=1e-13, rtol=1e-14), abs=1e-9
            )
    assert inside >= 3


def test_clipping_leaves_exact_atoms() -> None:
    mixture = TraversabilityMixture(
        torch.tensor([0.3, 0.7]).view(2, 1, 1),
        torch.tensor([-0.5, 1.5]).view(2, 1, 1),
        torch.full((2, 1, 1), 0.05),
    )
    assert mixture.var(0.71).item() == 0
    assert mixture.cvar(0.71).item() == 0
    assert mixture.var(0.69).item() == 1
    assert mixture.cvar(0.4).item() == pytest.approx(0.5, abs=1e-6)


def test_the_slope_of_cvar_is_that_of_its_differences() -> None:
    mixture, step = random_mixture(), 1e-5
    means = mixture.means.clone().requires_grad_()
    TraversabilityMixture(mixture.weights, means, mixture.stds).cvar(
        0.8
    ).sum().backward()
    for place in ((0, 1, 0, 2), (1, 3, 0, 5)):
        shift = torch.zeros_like(mixture.means)
        shift[place] = step
        up, down = (
            TraversabilityMixture(
                mixture.weights, mixture.means + sign * shift, mixture.stds
            )
            .cvar(0.8)
            .sum()
            for sign in (1, -1)
        )
        assert means.grad[place].item() == pytest.approx(
            (up - down).item() / (2 * step), abs=1e-6
        )


def test_risk_maps_stay_on_their_device_and_wait_for_nothing() -> None:
    # A fake tensor has a device and no values: what asks for a value, or mixes devices,
    # raises.
    with FakeTensorMode():
        weights, means, stds = (
            torch.empty(3, 10, 7, 5, device="cuda") for _ in range(3)
        )
        mixture = TraversabilityMixture(
            weights, means, stds, (0, 1, 1, 2, 3, 4, 5, 6, 7, 7)
        )
        value = torch.empty(3, 7, 5, device="cuda")
        maps = (
            mixture.mean(),
            mixture.var(0.9),
            mixture.cvar(0.9),
            mixture.most_likely().cvar(0.9),
            mixture.expected_time(0.05),
            mixture.chance(0.1),
            mixture.from_normal(value),
            mixture.cdf(0.5),
            mixture.cdf(value),
            mixture.log_prob(value),
        )
        for found in maps:
            assert (found.device.type, found.dtype, found.shape) == (
                "cuda",
                torch.float32,
                (3, 7, 5),
            )


def test_unclipped_gaussian_has_the_textbook_cvar() -> None:
    z = stats.norm.ppf(0.1)
    expected = 0.5 - 0.02 * stats.norm.pdf(z) / 0.1
    assert single(0.5, 0.02).cvar(0.9).item() == pytest.approx(expected, abs=1e-9)


@given(
    weights=st.lists(st.floats(0, 1), min_size=3, max_size=3).filter(
        lambda w: sum(w) > 1e-3
    ),
    means=st.lists(st.floats(-1, 2), min_size=3, max_size=3),
    stds=st.lists(st.floats(0, 1), min_size=3, max_size=3),
    levels=st.tuples(st.floats(0, 1 - 1e-12), st.floats(0, 1 - 1e-12)),
)
@settings(max_examples=300, deadline=None)
def test_risk_measures_are_ordered_finite_and_in_range(
    weights, means, stds, levels
) -> None:
    total = sum(weights)
    shaped = [
        torch.tensor(values, dtype=torch.float64)[:, None, None]
        for values in ([w / total for w in weights], means, stds)
    ]
    mixture = TraversabilityMixture(*shaped)
    low, high = sorted(levels)
    for measure in (mixture.cvar, mixture.var):
        careless, careful = measure(low), measure(high)
        assert careful.isfinite().all()
        assert (careful <= careless + 1e-6).all()
        assert ((careful >= 0) & (careless <= 1)).all()
    assert (mixture.cvar(high) <= mixture.var(high) + 1e-6).all()
    assert (mixture.cvar(high) <= mixture.mean() + 1e-6).all()


@given(
    weights=st.lists(st.floats(0, 1), min_size=1, max_size=5).filter(
        lambda w: sum(w) > 1e-3
    ),
    means=st.lists(
        st.sampled_from([-3.0, -0.1, 0.0, 0.3, 0.5, 1.0, 1.2, 4.0]),
        min_size=5,
        max_size=5,
    ),
    std=st.sampled_from([0.0, 1e-3, 0.2]),
    off=st.floats(-1e-4, 1e-4),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
@example([1.0, 1.0, 0.5, 1.0], [-3.0] * 5, 0.0, 0.0, torch.float64)
@settings(max_examples=200, deadline=None)
def test_weights_that_sum_to_nearly_1_tell_of_what_those_do_that_sum_to_it(
    weights, means, std, off, dtype
) -> None:
    shares = torch.tensor(weights, dtype=torch.float64)
    shares = (shares / shares.sum())[:, None, None]
    places = torch.tensor(means[: len(weights)], dtype=torch.float64)[:, None, None]
    exact = TraversabilityMixture(shares, places, torch.full_like(shares, std))
    mixture = TraversabilityMixture(
        ((1 + off) * shares).to(dtype), places.to(dtype), exact.stds.to(dtype)
    )  # fmt: skip
    seen = torch.tensor([[0.0]], dtype=torch.float64)
    for found, wanted in (
        (mixture.mean(), exact.mean()),
        (mixture.cvar(0.9), exact.cvar(0.9)),
        (1 / mixture.expected_time(0.1), 1 / exact.expected_time(0.1)),
        (mixture.chance(0.45), exact.chance(0.45)),
        (mixture.cdf(0.45), exact.cdf(0.45)),
        (mixture.log_prob(seen).exp(), exact.log_prob(seen).exp()),
    ):
        assert 0 <= found.item() <= 1
        assert found.item() == pytest.approx(wanted.item(), abs=1e-5)
    for level in (0.0, 1e-6, 0.5, 1 - 1e-6):
        assert 0 <= mixture.cvar(level).item() <= mixture.var(level).item() <= 1


@pytest.mark.parametrize(("mean", "value"), [(-3.0, 0.0), (4.0, 1.0)])
@pytest.mark.parametrize("off", [-1e-4, -2e-7, 0.0, 2e-7, 1e-4])
def test_ground_surely_at_an_end_is_there_whatever_the_weights_sum_to(
    mean: float, value: float, off: float
) -> None:
    weights = (1 + off) * torch.tensor([0.3, 0.6, 0.1])[:, None, None]
    mixture = TraversabilityMixture(
        weights, torch.full_like(weights, mean), torch.full_like(weights, 0.01)
    )
    for found in (
        mixture.mean(),
        mixture.var(1e-5),
        mixture.var(1 - 1e-5),
        mixture.cvar(0.9),
        mixture.from_normal(torch.full((1, 1), 4.5)),
        mixture.from_normal(torch.full((1, 1), -4.5)),
        mixture.chance(0.5),
        1 - mixture.cdf(0.5),
    ):
        assert found.item() == pytest.approx(value, abs=1e-7)
        assert 0 <= found.item() <= 1


def test_var_at_level_0_is_the_supremum_whatever_the_weights_sum_to() -> None:
    weights = torch.softmax(
        torch.randn(50, 6, 1, 1, generator=torch.Generator().manual_seed(0)), dim=1
    )
    mixture = TraversabilityMixture(
        weights, torch.full_like(weights, 0.2), torch.full_like(weights, 0.01)
    )
    assert (mixture.var(0.0) == 1).all()
    torch.testing.assert_close(
        mixture.mean(), torch.full((50, 1, 1), 0.2), atol=1e-6, rtol=0
    )


def test_float32_keeps_its_dtype_and_agrees_with_float64() -> None:
    exact = random_mixture()
    short = TraversabilityMixture(
        exact.weights.float(), exact.means.float(), exact.stds.float()
    )
    assert short.cvar(0.9).dtype == torch.float32
    torch.testing.assert_close(
        short.cvar(0.9).double(), exact.cvar(0.9), atol=1e-5, rtol=0
    )


def test_log_prob_integrates_to_one_with_its_atoms() -> None:
    mixture = random_mixture(cells=1)
    grid = torch.linspace(0, 1, 20001, dtype=torch.float64)[1:-1]
    density = torch.stack(
        [mixture.log_prob(torch.full((2, 1, 1), x)).exp() for x in grid.tolist()[::4]]
    )
    inside = density.mean(0)
    atoms = sum(
        mixture.log_prob(torch.full((2, 1, 1), edge)).exp() for edge in (0.0, 1.0)
    )
    torch.testing.assert_close(
        inside + atoms, torch.ones(2, 1, 1, dtype=torch.float64), atol=2e-3, rtol=0
    )
    assert (mixture.log_prob(torch.full((2, 1, 1), 1.2)) == -math.inf).all()


def test_cdf_has_the_atoms_of_clipping() -> None:
    mixture = single(0.9, 0.2)
    assert mixture.cdf(-1e-9).item() == 0
    assert mixture.cdf(0.0).item() == pytest.approx(stats.norm.cdf(-4.5))
    assert mixture.cdf(0.9).item() == pytest.approx(0.5)
    assert mixture.cdf(1.0).item() == 1


def test_most_likely_keeps_the_heaviest_class_where_each_has_one_component() -> None:
    mixture = random_mixture()
    kept = mixture.most_likely()
    best = mixture.weights.argmax(1)
    assert kept.means.shape == (2, 1, 1, 6)
    assert kept.means[1, 0, 0, 3] == mixture.means[1, best[1, 0, 3], 0, 3]


def test_most_likely_keeps_the_heaviest_class_whole() -> None:
    """Class 7 has two components that are together heavier than the heaviest one, which
    is of class 2.
    """
    mixture = random_mixture(components=4)
    weights = (
        torch.tensor([0.3, 0.4, 0.25, 0.05], dtype=torch.float64)
        .view(1, 4, 1, 1)
        .expand(2, 4, 1, 6)
        .clone()
    )
    weights[1, :, 0, 0] = torch.tensor([0.1, 0.85, 0.04, 0.01])
    of_classes = replace(mixture, weights=weights, group=(7, 2, 7, 3))
    kept = of_classes.most_likely()
    alone = TraversabilityMixture(
        weights[:, [0, 2]] / weights[:, [0, 2]].sum(1, keepdim=True),
        mixture.means[:, [0, 2]],
        mixture.stds[:, [0, 2]],
    )
    torch.testing.assert_close(kept.cvar(0.9)[0], alone.cvar(0.9)[0])
    other = TraversabilityMixture(
        torch.ones(2, 1, 1, 6).double(), mixture.means[:, [1]], mixture.stds[:, [1]]
    )
    assert kept.mean()[1, 0, 0].item() == pytest.approx(
        other.mean()[1, 0, 0].item(), abs=1e-12
    )
    assert kept.mean()[1, 0, 1].item() == pytest.approx(
        alone.mean()[1, 0, 1].item(), abs=1e-12
    )
    torch.testing.assert_close(kept.weights.sum(1), torch.ones(2, 1, 6).double())
    # It is one class, so that it may be asked again.
    torch.testing.assert_close(kept.most_likely().mean(), kept.mean())


def test_the_most_likely_class_of_components_that_are_none_is_refused() -> None:
    with pytest.raises(ConfigError, match="without `group`"):
        replace(random_mixture(), group=None).most_likely()
    alone = single(0.4, 0.1)
    assert alone.group is None
    assert alone.most_likely().cvar(0.9).item() == alone.cvar(0.9).item()
    with pytest.raises(ConfigError, match="each of 4 components, got 3"):
        replace(random_mixture(), group=(0, 1, 2))


WEIGHTS = {2: (0.3, 0.7), 4: (0.1, 0.4, 0.2, 0.3)}
Components = tuple[tuple[float, float], ...]  # means and standard deviations
# Where all are wide, one is narrow, several are, and one is a point.
COMPONENTS: list[Components] = [
    ((0.3, 0.04), (0.6, 0.2)),
    ((0.497, 0.0735), (0.01, 0.001)),
    ((0.4, 0.001), (0.41, 0.003)),
    ((0.4, 0.02), (0.4003, 1e-5)),
    ((0.4, 1e-5), (0.4003, 0.02)),
    ((0.002, 0.001), (0.99, 0.02)),
    ((-0.01, 0.01), (1.002, 0.001)),
    ((0.5, 0.002), (0.5, 0.002)),
    ((0.25, 1e-9), (0.7, 0.15)),
    ((0.3, 0.004), (0.31, 0.1), (0.29, 0.02), (0.8, 0.001)),
]


def exactly(components: Components, work: str, at: float) -> float:
    """`expected_time` with a floor, or `crps` of an observation, by quadrature between
    points that no step of F is narrower than.
    """
    weights = np.array(WEIGHTS[len(components)])
    means, stds = np.array(components).T
    min_x = at if work == "expected_time" else 0.0
    steps = means + stds * np.array([-12, -7, -4, -2, 0, 2, 4, 7, 12])[:, None]
    doublings = at * 2.0 ** np.arange(12)
    edges = np.unique(np.concatenate([steps.ravel(), doublings, [at, 1.0, min_x]]))
    edges = edges[(edges >= min_x) & (edges <= 1)]
    nodes, node_weights = np.polynomial.legendre.leggauss(40)
    half = np.diff(edges)[:, None] / 2
    x = edges[:-1, None] + half * (1 + nodes)
    cdf = ndtr((x[..., None] - means) / stds) @ weights
    values = cdf / x**2 if work == "expected_time" else (cdf - (x >= at)) ** 2
    integral = float((half * node_weights * values).sum())
    return 1 + integral if work == "expected_time" else integral


def mixture_of(
    components: Components, dtype: torch.dtype = torch.float64
) -> TraversabilityMixture:
    values = WEIGHTS[len(components)], *zip(*components, strict=True)
    weights, means, stds = (
        torch.tensor(row, dtype=dtype).view(-1, 1, 1) for row in values
    )
    return TraversabilityMixture(weights, means, stds)


@pytest.mark.parametrize("components", COMPONENTS)
def test_the_expected_time_is_exact_to_a_millionth_for_small_floors(
    components: Components,
) -> None:
    for floor in (0.001, 0.01, 0.05, 0.5):
        expected = exactly(components, "expected_time", floor)
        time = mixture_of(components).expected_time(floor).item()
        assert time == pytest.approx(expected, abs=1e-6, rel=0)


@pytest.mark.parametrize("components", COMPONENTS)
def test_the_crps_is_exact_for_narrow_components(components: Components) -> None:
    for observed in (0.0, 0.4, 0.997):
        expected = exactly(components, "crps", observed)
        score = (
            mixture_of(components)
            .crps(torch.tensor([[observed]], dtype=torch.float64))
            .item()
        )
        assert score == pytest.approx(expected, abs=1e-5, rel=0)


def test_float32_parameters_lose_no_more_than_their_rounding() -> None:
    components, eps = COMPONENTS[-1], torch.finfo(torch.float32).eps
    rounded = mixture_of(components, torch.float32)
    read = tuple(
        zip(
            rounded.means.flatten().tolist(),
            rounded.stds.flatten().tolist(),
            strict=True,
        )
    )
    expected = exactly(read, "expected_time", 0.001)
    time = rounded.expected_time(0.001)
    assert time.dtype == torch.float32
    assert time.item() == pytest.approx(expected, abs=1e-6, rel=2 * eps)
    score = rounded.crps(torch.tensor([[0.4]])).item()
    assert score == pytest.approx(exactly(read, "crps", 0.4), abs=1e-5, rel=0)


@pytest.mark.parametrize("floor", [0.02, 0.05, 0.5, 1.0])
def test_the_expected_time_is_that_of_an_adaptive_integrator(floor: float) -> None:
    """From needles to planes, by their densities and the atoms at 0 and 1; our form
    integrates the CDF.
    """
    from scipy.integrate import quad

    for mean in (-0.3, 0.0, 0.04, 0.06, 0.5, 0.97, 1.3):
        for std in (1e-4, 0.01, 0.05, 0.2, 1.0):
            law = stats.norm(mean, std)
            edges = [
                x
                for x in (mean + z * std for z in (-8, -4, -1, 0, 1, 4, 8))
                if floor < x < 1
            ]

            def slow(x: float, law=law) -> float:  # type: ignore[no-untyped-def]
                return float(law.pdf(x)) / x

            inside = (
                quad(slow, floor, 1, points=edges or None, limit=500)[0]
                if floor < 1
                else 0.0
            )
            time = law.cdf(floor) / floor + inside + law.sf(1)
            assert single(mean, std).expected_time(floor).item() == pytest.approx(
                time, rel=1e-6
            )


@pytest.mark.parametrize("floor", [0.001, 0.02, 0.3, 1.0])
@pytest.mark.parametrize("level", [0.3, 0.8, 0.99])
def test_the_tail_of_the_time_is_that_of_an_adaptive_integrator_over_ranks(
    level: float, floor: float
) -> None:
    from scipy.integrate import quad

    tail = 1 - level
    for mean in (-0.3, 0.06, 0.5, 1.3):
        for std in (0.01, 0.05, 0.2, 1.0):
            law = stats.norm(mean, std)
            edges = [rank for rank in map(law.cdf, (0, floor, 1)) if 0 < rank < tail]

            def time(rank: float, law=law) -> float:  # type: ignore[no-untyped-def]
                return 1 / min(max(float(law.ppf(rank)), floor), 1)

            wanted = quad(time, 0, tail, points=edges or None, limit=500)[0] / tail
            assert single(mean, std).time_cvar(level, floor).item() == pytest.approx(
                wanted, rel=2e-6
            )


def test_the_tail_of_the_time_of_a_mixture_is_that_of_its_worst_draws() -> None:
    draws = monte_carlo()[:, 1, 0, 3].clamp(0, 1).sort().values
    found = random_mixture().time_cvar(0.8, 0.05)[1, 0, 3].item()
    assert found == pytest.approx(
        (1 / draws[: len(draws) // 5].clamp(min=0.05)).mean().item(), rel=5e-3
    )


def test_the_expected_time_of_a_mixture_is_that_of_its_components_in_the_mean() -> None:
    mixture = random_mixture()
    times = sum(
        mixture.weights[:, k]
        * TraversabilityMixture(
            torch.ones_like(mixture.weights[:, [k]]),
            mixture.means[:, [k]],
            mixture.stds[:, [k]],
        ).expected_time(0.05)
        for k in range(4)
    )
    torch.testing.assert_close(mixture.expected_time(0.05), times)
    draws = monte_carlo()
    assert mixture.expected_time(0.05)[1, 0, 3].item() == pytest.approx(
        (1 / draws[:, 1, 0, 3].clamp(min=0.05)).mean().item(), rel=5e-3
    )
    assert (
        1 / mixture.expected_time(0.05) <= mixture.mean().clamp(min=0.05) + 0.05
    ).all()


@pytest.mark.parametrize("floor", [0.0, -0.1, 1.1, math.nan])
def test_a_least_speed_out_of_range_is_refused(floor: float) -> None:
    with pytest.raises(ConfigError, match="minimum speed"):
        random_mixture().expected_time(floor)
    with pytest.raises(ConfigError, match="minimum speed"):
        random_mixture().time_cvar(0.5, floor)


@pytest.mark.parametrize("bound", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_the_chance_is_the_share_of_draws_at_the_bound_or_above(bound: float) -> None:
    expected = (monte_carlo() >= bound).double().mean(0)
    torch.testing.assert_close(
        random_mixture().chance(bound), expected, atol=3e-3, rtol=0
    )


def test_normal_numbers_go_through_each_cells_quantile_function() -> None:
    mixture = random_mixture()
    generator = torch.Generator().manual_seed(5)
    for z in torch.randn(20, 2, 1, 6, generator=generator, dtype=torch.float64):
        found = mixture.from_normal(z)
        share = torch.from_numpy(stats.norm.cdf(z.numpy()))
        inside = (found > 0) & (found < 1)
        torch.testing.assert_close(
            mixture.cdf(found)[inside], share[inside], atol=1e-7, rtol=0
        )
        assert (mixture.cdf(0.0)[found == 0] >= share[found == 0]).all()
        assert (mixture.chance(1.0)[found == 1] >= 1 - share[found == 1] - 1e-12).all()
    alone = single(0.5, 0.3)
    for z in (-3.0, -1.0, 0.0, 0.4, 2.5):
        both = TraversabilityMixture(
            *(t.expand(2, 1, 1) for t in (alone.weights / 2, alone.means, alone.stds))
        )
        at = torch.full((1, 1), z, dtype=torch.float64)
        assert alone.from_normal(at).item() == pytest.approx(
            min(max(0.5 + 0.3 * z, 0), 1)
        )
        assert both.from_normal(at).item() == pytest.approx(
            alone.from_normal(at).item(), abs=1e-8
        )


def test_maps_are_selected_with_their_classes() -> None:
    mixture = random_mixture()
    kept = mixture.select(torch.tensor([1, 1, 0]))
    assert kept.group == mixture.group
    for name in ("weights", "means", "stds"):
        assert torch.equal(getattr(kept, name), getattr(mixture, name)[[1, 1, 0]])


def test_bad_arguments_are_refused() -> None:
    mixture = single(0.5, 0.1)
    for level in (-0.1, 1.0, math.nan):
        with pytest.raises(ConfigError, match="level"):
            mixture.cvar(level)
    with pytest.raises(ConfigError, match="the same shape"):
        TraversabilityMixture(
            torch.ones(1, 2, 3), torch.ones(1, 2, 3), torch.ones(1, 2, 4)
        )


@pytest.mark.parametrize("shape", [(2, 3, 9, 5), (4, 1, 7, 3), (1, 2, 3, 8, 2)])
def test_rows_at_a_time_change_no_bit(
    shape: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = torch.Generator().manual_seed(1)
    weights, means, stds = (torch.rand(shape, generator=drawn) for _ in range(3))
    mixture = TraversabilityMixture(
        weights / weights.sum(-3, keepdim=True), means, 0.2 * stds
    )
    whole = mixture.cvar(0.7), mixture.var(0.6), mixture.mean()
    for numbers in (1, 2 * mixture.weights.numel() // shape[-2]):
        monkeypatch.setattr("benchnav.core.mixture._CHUNK_NUMBERS_ON_CPU", numbers)
        for found, wanted in zip(
            (mixture.cvar(0.7), mixture.var(0.6), mixture.mean()), whole, strict=True
        ):
            assert torch.equal(found, wanted)


def grouped(
    group: tuple[int, ...] | None, components: int = 3
) -> TraversabilityMixture:
    weights = torch.rand(
        2, components, 4, 5, generator=torch.Generator().manual_seed(0)
    )
    weights = weights / weights.sum(1, keepdim=True)
    return TraversabilityMixture(weights, weights, weights, group)


def test_the_components_of_a_class_are_added_up_in_the_order_of_the_classes() -> None:
    made = grouped((2, 0, 2))
    found = made.class_probabilities(4)
    assert found.shape == (2, 4, 4, 5)
    torch.testing.assert_close(found[:, 2], made.weights[:, 0] + made.weights[:, 2])
    assert torch.equal(found[:, 0], made.weights[:, 1])
    assert not bool(found[:, [1, 3]].any())


@pytest.mark.parametrize("group", [None, (0, 1, 2)])
def test_one_component_a_class_is_left_as_it_is(group: tuple[int, ...] | None) -> None:
    made = grouped(group)
    assert made.class_probabilities(3) is made.weights


def test_components_of_no_class_are_none_of_the_classes_and_together_one_more() -> None:
    made = grouped((0, -1, 1, -1), 4)
    classes = made.class_probabilities(2)
    assert torch.equal(classes, made.weights[:, [0, 2]])
    rest = 1 - classes.sum(1)
    likely = made.most_likely()
    without = rest > classes.amax(1)
    assert without.any()
    assert not without.all()
    alone = made.weights[:, [1, 3]] / made.weights[:, [1, 3]].sum(1, keepdim=True)
    wanted = (alone * made.means[:, [1, 3]]).sum(1)
    best = torch.gather(made.means[:, [0, 2]], 1, classes.argmax(1, keepdim=True))[:, 0]
    exact = TraversabilityMixture(
        alone, made.means[:, [1, 3]], made.stds[:, [1, 3]]
    ).mean()
    torch.testing.assert_close(likely.mean()[without], exact[without])
    assert wanted.shape == exact.shape
    one = TraversabilityMixture(
        torch.ones_like(best)[:, None], best[:, None], best[:, None]
    ).mean()
    torch.testing.assert_close(likely.mean()[~without], one[~without])
