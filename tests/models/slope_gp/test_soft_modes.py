from dataclasses import replace

import pytest
import torch

from benchnav.core.mixture import TraversabilityMixture
from benchnav.models.config import LatentGPConfig
from benchnav.models.slope_gp.cells import Cells, SlopeSums, sum_cells
from benchnav.models.slope_gp.soft_modes import find_soft_modes
from benchnav.models.slope_gp.table import SoftModes
from benchnav.models.training.gaussian_processes import fit_gps

NOISE, FLAT = 0.15, 0.85


def firm(
    slope_deg: torch.Tensor, fall: float = 3e-3, flat: float = FLAT
) -> torch.Tensor:
    """A latent function as the generator has them, 0 where it would be less."""
    return (flat - fall * slope_deg**1.6).clamp(min=0)


def draw(
    count: int,
    weight: float,
    mean: float = 0.05,
    std: float = 0.05,
    seed: int = 0,
    steep_deg: float = 8.0,
    fall: float = 3e-3,
    flat: float = FLAT,
) -> Cells:
    """Cells of one class: most about `firm`, with noise 0.15, and some from N(mean,
    std), all clipped.
    """
    generator = torch.Generator().manual_seed(seed)
    slope = (steep_deg * torch.randn(count, generator=generator).abs()).clamp(max=35)
    value = firm(slope, fall, flat) + NOISE * torch.randn(count, generator=generator)
    soft = torch.rand(count, generator=generator) < weight
    value = torch.where(
        soft, mean + std * torch.randn(count, generator=generator), value
    )
    return Cells(
        class_id=torch.zeros(count, dtype=torch.int64),
        slope_deg=slope,
        traversability=value.clamp(0, 1),
    )


def find(cells: Cells) -> SoftModes | None:
    return find_soft_modes(SlopeSums.of(cells, 1))[0]


@pytest.mark.parametrize("count", [3_000, 100_000])
@pytest.mark.parametrize(
    ("weight", "mean", "std", "fall"),
    [
        (0.10, 0.05, 0.05, 3e-3),
        (0.05, 0.05, 0.05, 3e-3),
        (0.20, 0.05, 0.05, 3e-3),
        (0.10, 0.30, 0.10, 3e-3),
        (0.10, 0.50, 0.08, 1e-2),
        (0.10, 0.98, 0.05, 2e-2),
    ],
)
def test_a_second_mode_is_found_within_the_error_that_the_cells_allow(
    count: int, weight: float, mean: float, std: float, fall: float
) -> None:
    # A mode near 1 is looked for on ground that is lower, from which it can be told.
    found = find(
        draw(count, weight, mean, std, fall=fall, flat=0.6 if mean > 0.9 else FLAT)
    )
    assert found is not None
    # Standard errors as if every cell were known to be of one mode or the other, times
    # 4, and times 8 where the modes overlap.
    soft, wide = weight * count, 4 if mean < 0.2 else 8
    assert (
        abs(float(found.weight) - weight)
        < wide * (weight * (1 - weight) / count) ** 0.5
    )
    assert abs(float(found.mean) - mean) < wide * std / soft**0.5
    assert abs(float(found.std) - std) < wide * std / (2 * soft) ** 0.5


@pytest.mark.parametrize(("count", "seeds"), [(150, 25), (1000, 15), (20_000, 5)])
def test_a_class_without_a_second_mode_keeps_one(count: int, seeds: int) -> None:
    parts = [
        draw(count, 0.0, seed=seed, steep_deg=(4.0, 8.0, 15.0)[seed % 3])
        for seed in range(seeds)
    ]
    many = [Cells(class_id=one.class_id + c, slope_deg=one.slope_deg, traversability=one.traversability)
            for c, one in enumerate(parts)]  # fmt: skip
    sums = sum_cells(many, seeds)
    soft, kept = find_soft_modes(sums)
    assert soft is None
    assert all(
        torch.equal(kept[name], values)
        for name, values in sums.bins(censored=True).items()
    )


@pytest.mark.parametrize(
    ("fall", "flat"), [(9e-3, 1.0), (2e-2, 0.9), (1e-3, 1.05), (3e-3, 0.1)]
)
def test_a_main_mode_that_is_clipped_is_not_taken_for_two(
    fall: float, flat: float
) -> None:
    # Steep ground on which most of λ is 0, and firm ground on which half of it is 1.
    assert find(draw(200_000, 0.0, steep_deg=15.0, fall=fall, flat=flat)) is None


def test_tails_a_little_heavier_than_those_of_a_normal_distribution_are_no_second_mode() -> (
    None
):
    count, generator = 200_000, torch.Generator().manual_seed(0)
    plain = draw(count, 0.0)
    freedom = 25
    spread = (
        torch.randn(freedom, count, generator=generator).square().mean(0)
    ) ** -0.5  # Student's t
    noise = NOISE * spread * torch.randn(count, generator=generator)
    value = (firm(plain.slope_deg) + noise).clamp(0, 1)
    # BIC alone would keep one, of a few per cent of the cells and nearly as wide as λ's
    # range.
    assert find(replace(plain, traversability=value)) is None


def test_a_mode_of_less_than_a_hundredth_is_left_out() -> None:
    assert find(draw(100_000, 0.007)) is None
    found = find(draw(100_000, 0.014))
    assert found is not None
    assert float(found.weight) == pytest.approx(0.014, abs=0.002)


def test_of_few_cells_no_second_mode_is_made() -> None:
    assert find(draw(90, 0.3)) is None
    assert find(draw(300, 0.2)) is not None
    assert find_soft_modes(SlopeSums.of(draw(0, 0.0), 2))[0] is None


def test_the_sums_of_the_main_mode_are_those_of_its_own_cells() -> None:
    with_soft, without = draw(50_000, 0.1), draw(50_000, 0.0)
    second = Cells(
        class_id=without.class_id + 1,
        slope_deg=without.slope_deg,
        traversability=without.traversability,
    )
    sums = sum_cells([with_soft, second], 2)
    soft, kept = find_soft_modes(sums)
    assert soft is not None
    assert soft.weight.tolist()[1] == 0
    exact = sums.bins(censored=True)
    for name, values in exact.items():
        assert torch.equal(kept[name][1], values[1]), name
    # 95 % of the soft cells are under 0.13, where nearly no firm cell of flat ground
    # is.
    flat = slice(0, 20)
    assert float(kept["zeros"][0, flat].sum()) < 0.05 * float(
        exact["zeros"][0, flat].sum()
    )
    cells = sum(kept[name][0].sum() for name in ("zeros", "ones", "inside"))
    assert float(cells) == pytest.approx(50_000 * (1 - float(soft.weight[0])), rel=1e-4)
    mean = kept["total"][0, flat] / kept["inside"][0, flat]
    alone = exact["total"][1, flat] / exact["inside"][1, flat]
    assert float((mean - alone).mean().abs()) < 0.01


def predicted(table, slope: torch.Tensor) -> TraversabilityMixture:  # type: ignore[no-untyped-def]
    return table.predict_by_class(
        torch.zeros(1, 1, len(slope), dtype=torch.int64), slope.view(1, 1, -1)
    )


@pytest.mark.parametrize("weight", [0.05, 0.1, 0.2])
def test_expectation_and_tail_of_the_fitted_class_are_those_of_the_truth(
    weight: float,
) -> None:
    slope = torch.linspace(0, 20, 81)
    main = firm(slope).view(1, 1, 1, -1)
    ones = torch.ones_like(main)
    truth = TraversabilityMixture(
        torch.cat([(1 - weight) * ones, weight * ones], 1),
        torch.cat([main, 0.05 * ones], 1),
        torch.cat([NOISE * ones, 0.05 * ones], 1),
    )
    sums = SlopeSums.of(draw(100_000, weight), 1)
    errors = {}
    for second in (True, False):
        table = fit_gps(LatentGPConfig(second_component=second), sums).tabulate()
        found = predicted(table, slope)
        errors[second] = [
            float((found.mean() - truth.mean()).abs().max()),
            float((found.cvar(0.9) - truth.cvar(0.9)).abs().max()),
        ]
    assert errors[True][0] < 0.01
    assert errors[True][1] < 0.03
    # Without the second mode the worst tenth of λ is not seen.
    assert errors[False][1] > 0.1


def test_a_class_without_a_second_mode_is_fitted_to_the_bit_as_without_looking_for_one() -> (
    None
):
    soft, plain = draw(5_000, 0.15), draw(5_000, 0.0, seed=1)
    second = Cells(
        class_id=plain.class_id + 1,
        slope_deg=plain.slope_deg,
        traversability=plain.traversability,
    )
    tables = {}
    for name, parts in (("one", [plain]), ("two", [soft, second])):
        for look in (True, False):
            sums = sum_cells(parts, len(parts))
            tables[name, look] = fit_gps(
                LatentGPConfig(second_component=look), sums
            ).tabulate()
    assert tables["one", True].soft is None
    assert tables["two", True].soft is not None
    for name in ("mean", "std", "noise_std"):
        assert torch.equal(
            getattr(tables["one", True], name), getattr(tables["one", False], name)
        )
        kept, before = (getattr(tables["two", look], name) for look in (True, False))
        assert torch.equal(kept[1], before[1])
        assert not torch.equal(kept[0], before[0])


def test_a_second_mode_goes_with_the_censored_likelihood_alone() -> None:
    sums = SlopeSums.of(draw(5_000, 0.15), 1)
    assert (
        fit_gps(
            LatentGPConfig(epochs=1, epoch_steps=2, likelihood="gaussian"), sums
        ).soft
        is None
    )
