import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from benchnav.core.errors import ConfigError
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.datagen.layers.layer import DrawnMaps
from benchnav.datagen.recipe import latent
from benchnav.datagen.recipe.classes import (
    ClassTable,
    SoftSpots,
    TerrainClass,
    look_alike_classes,
)
from benchnav.datagen.schema import UNLABELLED
from tests.datagen.small import SOFT, terrain_class

TABLE = (
    terrain_class("firm", 10),
    terrain_class("wet", 20, soft=SoftSpots(weight=0.25, mean=0.1, std=0.05)),
    terrain_class(
        "dune",
        30,
        offset=0.2,
        noise=0.2,
        soft=SoftSpots(weight=0.4, mean=0.3, std=0.02),
    ),
)
DRAWS = 200_000


def cells(*numbers: int, slope_deg: float = 8.0) -> tuple[np.ndarray, np.ndarray]:
    class_id = np.array(numbers).reshape(1, 1, -1)
    return class_id, np.full(class_id.shape, slope_deg)


def as_mixture(parameters: latent.Parameters) -> TraversabilityMixture:
    return TraversabilityMixture(*(torch.from_numpy(values) for values in parameters))


def drawn(
    item: TerrainClass, slope_deg: float, generator: np.random.Generator
) -> np.ndarray:
    """λ of a class as its definition says, drawn one by one."""
    mean = 1 - (item.scale * 1e-3 * slope_deg**item.exponent + item.offset)
    value = mean + item.noise * generator.standard_normal(DRAWS)
    if item.soft:
        is_soft = generator.random(DRAWS) < item.soft.weight
        value = np.where(
            is_soft,
            item.soft.mean + item.soft.std * generator.standard_normal(DRAWS),
            value,
        )
    return value.clip(0, 1)


@pytest.mark.parametrize("slope_deg", [0.0, 8.0, 25.0])
def test_truth_is_the_distribution_that_classes_are_drawn_from(
    slope_deg: float,
) -> None:
    class_id, slope = cells(0, 1, 2, slope_deg=slope_deg)
    parameters = latent.truth(class_id, slope, TABLE)
    assert all(values.shape == (1, 2, 1, 3) for values in parameters)
    mixture, expected = as_mixture(parameters), latent.expected_of(parameters)
    assert expected.shape == (1, 1, 3)
    generator = np.random.default_rng(1)
    for number, item in enumerate(TABLE):
        draws = drawn(item, slope_deg, generator)
        for value in (0.0, 0.05, 0.12, 0.3, 0.5, 0.8, 0.9):
            found = float(mixture.cdf(value)[0, 0, number])
            assert found == pytest.approx((draws <= value).mean(), abs=5e-3)
        assert expected[0, 0, number] == pytest.approx(draws.mean(), abs=4e-3)


def test_classes_without_soft_spots_have_theirs_at_no_weight() -> None:
    class_id, slope = cells(0, 1)
    weights, _, stds = latent.truth(class_id, slope, TABLE)
    np.testing.assert_array_equal(weights[0, :, 0], [[1, 0.75], [0, 0.25]])
    assert (stds > 0).all()


def test_a_table_without_soft_spots_has_one_component() -> None:
    class_id, slope = cells(0, 0)
    parameters = latent.truth(class_id, slope, TABLE[:1])
    assert all(values.shape == (1, 1, 1, 2) for values in parameters)
    mean, std = (values[:, 0] for values in parameters[1:])
    # The same bits as by the function of version 0.1.
    np.testing.assert_array_equal(
        latent.expected_of(parameters), latent.expected_traversability(mean, std)
    )


@pytest.mark.parametrize(
    "numbers",
    [
        {"weight": 0.0}, {"weight": 1.0}, {"mean": -0.1}, {"mean": 1.1}, {"std": 0.0}, {"std": 1.5},
        {"weight": float("nan")},
    ],
)  # fmt: skip
def test_soft_spots_that_are_no_distribution_are_refused(
    numbers: dict[str, float],
) -> None:
    with pytest.raises(ConfigError, match="soft spots"):
        SoftSpots(**{"weight": 0.1, "mean": 0.05, "std": 0.05} | numbers)


def look_alikes(
    class_id: np.ndarray, slope_deg: np.ndarray, table: ClassTable
) -> latent.Parameters:
    """What colours tell of maps without layers."""
    flat = np.zeros(class_id.shape)
    return latent.look_alikes(
        DrawnMaps(class_id, flat, slope_deg, Grid(3, 3, 0.5), table)
    )


def test_look_alikes_are_classes_of_one_colour() -> None:
    table = tuple(
        terrain_class(name, red)
        for name, red in zip("abcdef", (1, 2, 1, 3, 1, 2), strict=True)
    )
    assert look_alike_classes(table) == [
        (0, 2, 4),
        (1, 5),
        (0, 2, 4),
        (3,),
        (0, 2, 4),
        (1, 5),
    ]


def test_what_looks_alike_is_the_average_over_its_classes() -> None:
    # Three of one colour, two of another, one alone; some with soft spots.
    table = (
        terrain_class("a", 1), terrain_class("b", 2, soft=SOFT), terrain_class("c", 1, offset=0.4, soft=SOFT),
        terrain_class("d", 3, soft=SOFT), terrain_class("e", 1, offset=0.8), terrain_class("f", 2, offset=0.5),
    )  # fmt: skip
    class_id, slope = cells(*range(6), slope_deg=6.0)
    found = look_alikes(class_id, slope, table)
    # One component a class, and a second of its soft spots.
    assert all(values.shape == (1, 9, 1, 6) for values in found)
    np.testing.assert_allclose(
        found[0][0, :, 0, 2], [1 / 3, 0, 0, 0.3, 0.1 / 3, 0, 0, 1 / 3, 0]
    )
    np.testing.assert_allclose(found[0].sum(1), 1)
    own = as_mixture(latent.truth(class_id, slope, table))
    alike = as_mixture(found)
    for value in (0.0, 0.06, 0.3, 0.55, 0.85, 0.95):
        single = own.cdf(value)[0, 0].numpy()
        for number, group in enumerate(look_alike_classes(table)):
            expected = np.mean([single[member] for member in group])
            assert float(alike.cdf(value)[0, 0, number]) == pytest.approx(
                expected, abs=1e-12
            )
    # What is seen is the same whichever of the look-alikes it is.
    mean = alike.mean()[0, 0]
    assert mean[0] == pytest.approx(float(mean[2]), abs=1e-9)
    assert mean[1] == pytest.approx(float(mean[5]), abs=1e-9)


def test_of_a_cell_without_a_class_nothing_is_known() -> None:
    table = (
        terrain_class("a", 1),
        terrain_class("b", 2, soft=SOFT),
        terrain_class("c", 1, offset=0.4),
    )
    known, slope = cells(0, 1, 2, slope_deg=6.0)
    holed = known.copy()
    holed[..., 1] = UNLABELLED
    for measure in (latent.truth, look_alikes):
        found, wanted = (
            as_mixture(measure(ids, slope, table)).mean()[0, 0]
            for ids in (holed, known)
        )
        assert found.isnan().tolist() == [False, True, False]
        assert torch.equal(found[[0, 2]], wanted[[0, 2]])
    drawn = latent.quantile_of(latent.truth(holed, slope, table), np.zeros(holed.shape))
    assert np.isnan(drawn[0, 0]).tolist() == [False, True, False]


def test_colours_that_all_differ_tell_the_truth() -> None:
    seen, own = (
        as_mixture(measure(*cells(0, 1), TABLE))
        for measure in (look_alikes, latent.truth)
    )
    for value in (0.0, 0.3, 0.9):
        assert torch.equal(seen.cdf(value), own.cdf(value))


@given(
    weight=hnp.arrays(float, 5, elements=st.floats(0.01, 0.99)),
    means=hnp.arrays(float, (2, 5), elements=st.floats(-0.5, 1.5)),
    stds=hnp.arrays(float, (2, 5), elements=st.floats(1e-3, 0.5)),
    normal=hnp.arrays(float, 5, elements=st.floats(-6, 6)),
)
@example(  # narrow modes far apart, at the rank between them
    weight=np.full(5, 0.5),
    means=np.array([[0.0] * 5, [1.0] * 5]),
    stds=np.full((2, 5), 0.0625),
    normal=np.zeros(5),
)
@settings(deadline=None)
def test_quantiles_are_those_of_the_mixture(
    weight: np.ndarray, means: np.ndarray, stds: np.ndarray, normal: np.ndarray
) -> None:
    weights = np.stack([1 - weight, weight])
    parameters = tuple(values[None, :, None] for values in (weights, means, stds))
    found = latent.quantile_of(parameters, normal[None, None])
    expected = (
        as_mixture(parameters).from_normal(torch.from_numpy(normal[None, None])).numpy()
    )
    # Between two narrow modes that are far apart the CDF is flat: many values have one
    # rank to rounding.
    same_value = np.isclose(found, expected, rtol=0, atol=2.0**-24)
    ranks = [
        (weights * stats.norm.cdf(values, means, stds)).sum(axis=0)
        for values in (found, expected)
    ]
    same_rank = np.isclose(*ranks, rtol=0, atol=1e-14)
    assert (same_value | same_rank).all(), (found, expected)


def test_quantiles_of_one_component_are_in_closed_form() -> None:
    normal = np.array([[[-1.0, 0.3, 40.0]]])
    class_id, slope = cells(0, 0, 0, slope_deg=0.0)
    firm = latent.quantile_of(latent.truth(class_id, slope, TABLE[:1]), normal)
    np.testing.assert_array_equal(firm, (0.95 + 0.1 * normal).clip(0, 1))
    # A class without soft spots in a table that has some takes the same.
    np.testing.assert_array_equal(
        firm, latent.quantile_of(latent.truth(class_id, slope, TABLE), normal)
    )


def test_quantiles_of_standard_normals_have_the_distribution() -> None:
    generator = np.random.default_rng(0)
    class_id, slope = cells(*([2] * 20_000))
    parameters = latent.truth(class_id, slope, TABLE)
    draws = latent.quantile_of(
        parameters, generator.standard_normal(class_id.shape)
    ).ravel()
    reference = drawn(TABLE[2], 8.0, generator)
    assert stats.ks_2samp(draws, reference).pvalue > 1e-3
