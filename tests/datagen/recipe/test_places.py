from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from benchnav.core import rng
from benchnav.core.errors import ConfigError
from benchnav.core.grid import Grid
from benchnav.datagen.recipe.load import load_recipe, recipe_from_dict
from benchnav.datagen.recipe.places import PlacesRule, check_places, draw_places
from benchnav.datagen.recipe.recipe import Split
from benchnav.datagen.synth.generate import generate
from tests.datagen.small import small_stakes

KEY = rng.stream_key(0, "places")
GRID = Grid(40, 64, 0.5)  # 32 m × 20 m


def by_rejection(places: PlacesRule, count: int) -> np.ndarray:
    """Pairs drawn one after the other until they are far enough apart, shape [B, 2, 2]."""
    generator = np.random.default_rng(0)
    low = places.margin_m
    high = np.array(GRID.extent_m) - places.margin_m
    pairs = generator.uniform(low, high, (60 * count, 2, 2))
    return pairs[np.hypot(*(pairs[:, 1] - pairs[:, 0]).T) >= places.least_distance_m][
        :count
    ]


@pytest.mark.parametrize(("least", "margin"), [(1.0, 0.0), (10.0, 3.0), (20.0, 2.0)])
def test_places_are_uniform_inside_the_margin_given_their_distance(
    least: float, margin: float
) -> None:
    places = PlacesRule(least_distance_m=least, margin_m=margin)
    pairs = np.stack(draw_places(places, GRID, KEY, np.arange(2000)), axis=1)
    expected = by_rejection(places, 2000)
    assert len(expected) == 2000
    for number in range(4):
        drawn, reference = (
            values.reshape(-1, 4)[:, number] for values in (pairs, expected)
        )
        assert stats.ks_2samp(drawn, reference).pvalue > 1e-3
    drawn, reference = (
        np.hypot(*(values[:, 1] - values[:, 0]).T) for values in (pairs, expected)
    )
    assert drawn.min() >= least
    assert stats.ks_2samp(drawn, reference).pvalue > 1e-3
    assert pairs.min() >= margin
    assert (pairs < np.array(GRID.extent_m) - margin).all()


@given(
    width=st.integers(3, 40), height=st.integers(3, 40), resolution=st.floats(0.05, 3),
    margin=st.floats(0, 1), least=st.floats(0, 1),
)  # fmt: skip
@settings(deadline=None)
def test_places_keep_to_any_rule_that_there_is_room_for(
    width: int, height: int, resolution: float, margin: float, least: float
) -> None:
    grid = Grid(height, width, resolution)
    margin_m = margin * 0.45 * min(grid.extent_m)
    inside = np.array(grid.extent_m) - 2 * margin_m
    diagonal_m = np.sqrt(2) * resolution
    least_m = diagonal_m + least * (np.hypot(*inside) - diagonal_m)
    places = PlacesRule(least_distance_m=max(least_m, 1e-3), margin_m=margin_m)
    try:
        check_places(places, grid)
    except ConfigError:
        # Within the steps of 2⁻¹⁰ m of what there is no room for.
        assert least_m > np.hypot(*inside) - 4e-3 or least_m <= diagonal_m + 1e-9
        return
    start, goal = draw_places(places, grid, KEY, np.arange(20))
    assert (np.hypot(*(goal - start).T) >= places.least_distance_m).all()
    for position in (start, goal):
        np.testing.assert_array_equal(
            position.astype(np.float32).astype(np.float64), position
        )
        assert (position >= margin_m).all()
        assert (position < np.array(grid.extent_m) - margin_m).all()


def test_a_distance_that_hardly_any_two_places_have_gives_opposite_corners() -> None:
    places = PlacesRule(least_distance_m=float(np.hypot(26, 14)) - 0.01, margin_m=3)
    start, goal = draw_places(places, GRID, KEY, np.arange(50))
    corners = (np.abs(start - [3, 3]).max(axis=1) < 0.02) & (
        np.abs(goal - [29, 17]).max(axis=1) < 0.02
    )
    assert corners.all()


def test_a_map_has_its_places_in_any_batch_and_each_stream_its_own() -> None:
    places = PlacesRule(least_distance_m=10, margin_m=1)
    whole = np.stack(draw_places(places, GRID, KEY, np.arange(9)))
    np.testing.assert_array_equal(
        np.stack(draw_places(places, GRID, KEY, np.array([2, 5]))), whole[:, [2, 5]]
    )
    assert len(np.unique(whole.reshape(-1, 2), axis=0)) == 18
    recipe = small_stakes(
        splits={"a": Split(scenario="std", maps=4), "b": Split(scenario="std", maps=4)}
    )
    drawn = [
        generate(made, split, np.arange(4))["start_m"]
        for made, split in (
            (recipe, "a"),
            (recipe, "b"),
            (replace(recipe, seed=1), "a"),
        )
    ]
    assert len(np.unique(np.concatenate(drawn), axis=0)) == 12


def test_a_map_drawn_again_has_other_places() -> None:
    # A wall of λ_stuck so high that few draws can be crossed.
    recipe = small_stakes(
        stuck_threshold=0.75, places=PlacesRule(least_distance_m=12, margin_m=1)
    )
    asked = replace(recipe, splits={"test/hg": Split(scenario="hg", maps=12)})
    first, kept = (
        generate(made, "test/hg", np.arange(12))
        for made in (asked, replace_solvable(asked))
    )
    again = (first["elevation_m"] != kept["elevation_m"]).any(axis=(1, 2))
    assert 0 < again.sum() < 12
    assert ((first["start_m"] != kept["start_m"]).any(axis=1) == again).all()


def replace_solvable(recipe):
    return replace(
        recipe, splits={"test/hg": Split(scenario="hg", maps=12, solvable=True)}
    )


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        (
            {"least_distance_m": 40},
            r"at most 34\.98 m .the largest distance inside the margin of 1 m., got 40",
        ),
        ({"margin_m": 10}, r"`margin_m` of `places` below 10 m"),
        ({"least_distance_m": 0.5}, r"0\.707 m .a cell's diagonal"),
        ({"least_distance_m": 0}, "`least_distance_m` > 0"),
        ({"least_distance_m": float("nan")}, "`least_distance_m` > 0"),
        ({"margin_m": -1}, "`margin_m` ≥ 0"),
    ],
)
def test_rules_without_room_are_refused(rule: dict, expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        check_places(PlacesRule(**{"least_distance_m": 10, "margin_m": 1} | rule), GRID)


def test_a_recipe_has_either_places_or_a_start_and_a_goal() -> None:
    data = load_recipe("stakes-v1").to_dict()
    assert data["places"] == {"least_distance_m": 20, "margin_m": 3}
    assert not {"start_m", "goal_m"} & set(data)
    fixed = {name: value for name, value in data.items() if name != "places"}
    made = recipe_from_dict(fixed | {"start_m": [8, 8], "goal_m": [24, 24]}, "test")
    assert "places" not in made.to_dict()
    assert made.to_dict()["start_m"] == [8, 8]
    for changes in ({}, {"start_m": [8, 8]}, {"goal_m": [8, 8]}):
        with pytest.raises(
            ConfigError, match="either `start_m` and `goal_m`, or `places`"
        ):
            recipe_from_dict(fixed | changes, "test")
    for changes in ({"start_m": [8, 8], "goal_m": [9, 9]}, {"start_m": [8, 8]}):
        with pytest.raises(ConfigError, match=r"got start_m and .*places"):
            recipe_from_dict(data | changes, "test")
    with pytest.raises(ConfigError, match=r"at most 36\.76 m"):
        recipe_from_dict(
            data | {"places": {"least_distance_m": 37, "margin_m": 3}}, "test"
        )
