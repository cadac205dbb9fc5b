from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchnav.core.errors import ConfigError
from benchnav.datagen.recipe.environments import AlikeClasses, deal_units, never_shown
from benchnav.datagen.recipe.load import load_recipe
from benchnav.datagen.synth.generate import class_map
from tests.datagen.small import small_stakes, terrain_class

STAKES = load_recipe("stakes-v1")


@st.composite
def packs(draw: st.DrawFn) -> tuple[tuple[AlikeClasses, ...], int]:
    sizes = draw(st.lists(st.integers(1, 3), min_size=1, max_size=9))
    ends = np.cumsum(sizes).tolist()
    units = tuple(
        tuple(range(end - size, end)) for size, end in zip(sizes, ends, strict=True)
    )
    return units, draw(st.integers(1, ends[-1]))


def can_be_filled(sizes: list[int], room: int) -> bool:
    """By trying every choice."""
    if room == 0 or not sizes:
        return room == 0
    return can_be_filled(sizes[1:], room) or (
        sizes[0] <= room and can_be_filled(sizes[1:], room - sizes[0])
    )


@given(packs())
@settings(max_examples=200, deadline=None)
def test_deals_are_full_distinct_whole_and_fair(
    pack: tuple[tuple[AlikeClasses, ...], int],
) -> None:
    units, shown = pack
    lost = never_shown(units, shown)
    for unit in units:
        others = [len(other) for other in units if other != unit]
        fits = len(unit) <= shown and can_be_filled(others, shown - len(unit))
        assert (unit in lost) == (not fits)
    if lost:
        return
    rounds = 12 * len(units)
    table = deal_units(units, shown, rounds)
    assert table.shape == (rounds, shown)
    times: Counter[AlikeClasses] = Counter()
    for dealt in table.tolist():
        assert len(set(dealt)) == shown
        whole = [unit for unit in units if set(unit) <= set(dealt)]
        assert sum(map(len, whole)) == shown
        times.update(whole)
    # The one that is shown least comes next, so that none starves.
    assert (
        min(times[unit] for unit in units) >= rounds * shown / sum(map(len, units)) / 3
    )


def test_more_environments_leave_the_first_as_they_are() -> None:
    units = STAKES.units
    np.testing.assert_array_equal(deal_units(units, 4, 5), deal_units(units, 4, 40)[:5])


def test_single_classes_are_dealt_equally_and_few_environments_are_alike() -> None:
    units = tuple((number,) for number in range(10))
    table = deal_units(units, 4, 10)
    assert np.bincount(table.ravel()).tolist() == [4] * 10
    assert len({tuple(sorted(dealt)) for dealt in table.tolist()}) >= 8


def test_the_environments_of_stakes_show_every_class_alike_and_look_alikes_together() -> (
    None
):
    names = [item.name for item in STAKES.classes]
    table = STAKES.environment_classes
    assert np.bincount(table.ravel()).tolist() == [4] * 12
    assert len({tuple(sorted(dealt)) for dealt in table.tolist()}) == 12
    for look_alikes in (("packed_soil", "crusted_soil"), ("firm_sand", "drift_sand")):
        first, second = (names.index(name) for name in look_alikes)
        assert ((table == first).any(axis=1) == (table == second).any(axis=1)).all()


def test_recipes_of_synthesis_1_deal_as_they_did() -> None:
    paper = load_recipe("paper-v1")
    assert [paper.environment_classes[e].tolist() for e in (0, 1, 2, 9)] == [
        [0, 3, 6, 9], [2, 5, 8, 1], [4, 7, 0, 3], [6, 7, 8, 9],
    ]  # fmt: skip


def test_each_of_two_look_alikes_takes_each_band_of_the_noise_equally_often() -> None:
    recipe = small_stakes(
        height=16, width=16, places=None, start_m=(1, 1), goal_m=(7, 7)
    )
    names = [item.name for item in recipe.classes]
    pair = [names.index("packed_soil"), names.index("crusted_soil")]
    shows = [e for e in range(12) if pair[0] in recipe.environment_classes[e]]
    indices = np.sort(np.concatenate([e + 12 * np.arange(500) for e in shows]))
    maps = class_map(recipe, "train", indices)
    # The bands of 30 % differ from those of 20 % by how much of a map they cover.
    wide = np.stack(
        [(maps == member).mean(axis=(1, 2)) > 0.25 for member in pair], axis=1
    )
    for share, expected in (
        (wide.mean(axis=0), 0.5),
        ((wide[:, 0] & wide[:, 1]).mean(), 1 / 6),
    ):
        np.testing.assert_allclose(
            share, expected, atol=4 * 0.5 / np.sqrt(len(indices))
        )
    # Which one borders on more of the others tells nothing: both lie alike in the
    # noise's order.
    inner = np.stack([(maps[:, 8, 8] == member).mean() for member in pair])
    assert abs(inner[0] - inner[1]) < 4 * np.sqrt(0.5 / len(indices))


def test_tables_that_cannot_be_dealt_are_refused_by_name() -> None:
    classes = tuple(terrain_class(name, red, offset=offset) for name, red, offset in (
        ("sand", 1, 0.0), ("dust", 1, 0.5), ("clay", 2, 0.0), ("silt", 2, 0.5),
    ))  # fmt: skip
    assert small_stakes(classes=classes, occupancy=(0.5, 0.5)).units == ((0, 1), (2, 3))
    with pytest.raises(
        ConfigError, match=r"map of 3 classes.*for sand, dust"
    ) as caught:
        small_stakes(classes=classes, occupancy=(0.4, 0.3, 0.3))
    assert "\n" not in str(caught.value)


def test_look_alikes_that_hardly_differ_are_refused_by_name() -> None:
    def table(offset: float, **changes: object) -> tuple:
        return terrain_class("sand", 1, offset=0.2), terrain_class(
            "dust", 1, offset=offset, **changes
        )

    # Both far from 0 and 1, E[λ] is 1 less the offset.
    assert small_stakes(classes=table(0.51), occupancy=(0.5, 0.5))
    with pytest.raises(
        ConfigError,
        match=r"0\.3 in E\[λ\] on flat terrain, got 0\.79\d for 'sand' and 0\.51",
    ):
        small_stakes(classes=table(0.49), occupancy=(0.5, 0.5))
    # Soft spots count.
    from benchnav.datagen.recipe.classes import SoftSpots

    assert small_stakes(
        classes=table(0.4, soft=SoftSpots(weight=0.3, mean=0.0, std=0.01)),
        occupancy=(0.5, 0.5),
    )
