"""What grows: where, how high, in which colour, and that all else is as without it."""

import hashlib
from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from scipy import stats

from benchnav.core.errors import ConfigError
from benchnav.core.grid import Grid
from benchnav.datagen.layers.layer import DrawnMaps
from benchnav.datagen.layers.spec import shipped_fields
from benchnav.datagen.layers.stack import draw_layers
from benchnav.datagen.layers.vegetation import Growth, Vegetation
from benchnav.datagen.recipe.load import load_recipe, recipe_from_dict
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.schema import FIELDS, entry_digests
from benchnav.datagen.synth.generate import class_map, generate
from tests.datagen.small import grown, small_stakes, terrain_class
from tests.factories import tiny_recipe

SHIPPED = load_recipe("vegetation-v1")
STEP = 2.0**-10


def grow(
    class_id: np.ndarray, noise: np.ndarray, **classes: Growth | None
) -> np.ndarray:
    """Heights on maps of classes in the order given, by a noise."""
    table = tuple(
        terrain_class(name, 1 + number) for number, name in enumerate(classes)
    )
    growths = {name: growth for name, growth in classes.items() if growth is not None}
    flat, grid = np.zeros(class_id.shape), Grid(*class_id.shape[1:], 0.5)
    return Vegetation(period_m=4.0, classes=growths).grow(
        noise, DrawnMaps(class_id, flat, flat, grid, table)
    )


def growths_of(recipe: Recipe) -> dict[str, Growth]:
    (spec,) = recipe.layers
    assert isinstance(spec.layer, Vegetation)
    return spec.layer.classes


def reeds(
    cover: float = 0.4, low: float = 0.2, high: float = 1.4, green: int = 90
) -> Growth:
    return Growth(height_m=(low, high), cover=cover, colour=(40, green, 20))


RECIPE = grown(small_stakes(), wet_clay=reeds(), gravel=reeds(0.7, 2.0, 2.0, 120))


def test_each_class_is_covered_by_its_share_on_every_map() -> None:
    maps = generate(RECIPE, "train", np.arange(24))
    is_grown = maps["vegetation_m"] > 0
    for number, item in enumerate(RECIPE.classes):
        own = maps["class_id"] == number
        share = (
            growths_of(RECIPE)[item.name].cover
            if item.name in growths_of(RECIPE)
            else 0.0
        )
        counts = own.sum(axis=(1, 2))
        assert np.abs((is_grown & own).sum(axis=(1, 2)) - share * counts).max() <= 0.5
        assert counts.any()


def test_heights_are_uniform_between_those_of_the_class() -> None:
    maps = generate(RECIPE, "train", np.arange(24))
    heights = {
        name: maps["vegetation_m"][
            (maps["class_id"] == number) & (maps["vegetation_m"] > 0)
        ]
        for number, name in enumerate(item.name for item in RECIPE.classes)
    }
    assert {name for name, own in heights.items() if len(own)} == {"wet_clay", "gravel"}
    assert (
        stats.kstest(heights["wet_clay"], stats.uniform(0.2, 1.2).cdf).statistic < 0.01
    )
    assert set(heights["gravel"]) == {2.0}
    assert not (heights["wet_clay"] % STEP).any()


def test_the_tallest_stand_where_the_noise_is_greatest() -> None:
    """So heights of a patch go over into one another, from its edge to its middle."""
    generator = np.random.default_rng(1)
    class_id, noise = (
        generator.integers(0, 2, (3, 20, 30)),
        generator.normal(size=(3, 20, 30)),
    )
    height_m = grow(class_id, noise, a=reeds(), b=None)
    for heights, values, own in zip(height_m, noise, class_id == 0, strict=True):
        order = np.argsort(values[own])
        assert (np.diff(heights[own][order]) >= 0).all()
        assert 0.2 < heights[own][order][-1] <= 1.4


@pytest.mark.parametrize("split", RECIPE.splits)
def test_it_hides_the_colour_of_its_cells_alone_and_changes_nothing_else(
    split: str,
) -> None:
    maps, without = (
        generate(recipe, split, np.arange(3))
        for recipe in (RECIPE, replace(RECIPE, layers=()))
    )
    assert list(maps) == [*without, "vegetation_m"]
    for name in set(without) - {"rgb"}:
        np.testing.assert_array_equal(maps[name], without[name])
    is_grown = maps["vegetation_m"] > 0
    image, other = (
        np.moveaxis(each["rgb"], 1, -1).astype(float) for each in (maps, without)
    )
    np.testing.assert_array_equal(image[~is_grown], other[~is_grown])
    ground = np.array([item.colour for item in RECIPE.classes])[maps["class_id"]]
    # of the red, known to within half a level
    brightness = other[..., :1] / ground[..., :1]
    for number, item in enumerate(RECIPE.classes):
        own = is_grown & (maps["class_id"] == number)
        if growth := growths_of(RECIPE).get(item.name):
            shaded = np.array(growth.colour) * brightness[own]
            error = 0.5 + 0.5 * np.array(growth.colour) / item.colour[0] + 1e-9
            assert (np.abs(image[own] - shaded) <= error).all()
            assert (image[own] != other[own]).any(axis=1).all()
    assert is_grown.any()


def test_seed_split_draw_and_map_each_have_vegetation_of_their_own() -> None:
    """On one class map, so that nothing else differs."""
    class_id, indices = np.ones((2, 32, 32), int), np.arange(2)

    def drawn(
        recipe: Recipe = RECIPE, split: str = "train", attempt: int = 0
    ) -> np.ndarray:
        flat = np.zeros(class_id.shape)
        below = DrawnMaps(class_id, flat, flat, recipe.grid, recipe.classes)
        layers = [spec.layer for spec in recipe.layers]
        return draw_layers(layers, recipe.seed, (split, attempt), indices, below)[
            "vegetation_m"
        ]

    several = [
        drawn(),
        drawn(replace(RECIPE, seed=5)),
        drawn(split="test/hg"),
        drawn(attempt=1),
    ]
    maps = [own for each in several for own in each]
    for one, other in combinations(maps, 2):
        assert ((one > 0) & (other > 0)).mean() < 0.7 * 0.4
    # Nor does it follow the classes or the ground.
    classes = (
        class_map(RECIPE, "train", indices)
        == class_map(RECIPE, "train", indices)[:, :1, :1]
    )
    assert abs(np.corrcoef(classes.ravel(), (several[0] > 0).ravel())[0, 1]) < 0.2


def test_patches_are_as_large_as_the_period_says() -> None:
    borders = []
    for period_m in (2.0, 4.0, 8.0):
        recipe = grown(small_stakes(), period_m, wet_clay=reeds(0.5))
        is_grown = generate(recipe, "train", np.arange(24))["vegetation_m"] > 0
        wet = generate(RECIPE, "train", np.arange(24))["class_id"] == 1
        both = wet[:, :, 1:] & wet[:, :, :-1]
        borders.append((is_grown[:, :, 1:] != is_grown[:, :, :-1])[both].mean())
    assert borders[0] > 1.4 * borders[1] > 1.4 * 1.4 * borders[2]


def test_where_it_grows_does_not_tell_look_alikes_apart() -> None:
    """Two look-alikes exchange their ground: the same cells are overgrown, so the
    picture is the same.
    """
    growths = {"low": reeds(0.4, 0.2, 0.3), "high": reeds(0.4, 0.8, 0.9)}
    generator = np.random.default_rng(0)
    class_id, noise = (
        generator.integers(0, 2, (4, 20, 30)),
        generator.normal(size=(4, 20, 30)),
    )
    first, second = (
        grow(class_id, noise, **growths),
        grow(1 - class_id, noise, **growths),
    )
    np.testing.assert_array_equal(first > 0, second > 0)
    cells = first > 0
    assert (first[cells] < 0.4).tolist() == (class_id[cells] == 0).tolist()
    assert (second[cells] < 0.4).tolist() == (class_id[cells] == 1).tolist()


def test_a_class_may_be_overgrown_altogether_or_by_less_than_a_cell() -> None:
    class_id, noise = (
        np.zeros((2, 4, 5), int),
        np.random.default_rng(0).normal(size=(2, 4, 5)),
    )
    assert (grow(class_id, noise, a=reeds(1.0)) > 0).all()
    assert not grow(class_id, noise, a=reeds(0.02)).any()
    assert not grow(class_id + 1, noise, a=reeds(1.0), b=None).any()


@pytest.mark.parametrize(
    ("item", "change", "expected"),
    [
        ("wet_clay", {"height_m": [0.5, 0.2]}, "`height_m` of vegetation ordered and within [0.01, 100], got [0.5"),
        ("wet_clay", {"height_m": [0.0, 0.2]}, "`height_m` of vegetation ordered and within [0.01, 100]"),
        ("wet_clay", {"height_m": [0.1, float("nan")]}, "`height_m` of vegetation"),
        ("wet_clay", {"cover": 0}, "`cover` of vegetation in (0, 1], got 0"),
        ("wet_clay", {"cover": 1.1}, "`cover` of vegetation in (0, 1], got 1.1"),
        ("wet_clay", {"colour": [0, 0, 256]}, "`colour` of vegetation in 0–255, got (0, 0, 256)"),
        ("wet_clay", {"colour": [152, 126, 100]}, "on 'wet_clay' to have a `colour` that no terrain has in"),
        ("packed_soil", {}, "'packed_soil' and 'crusted_soil', whose terrain has the same colour, to have"),
        ("wet_clay", {"width": 3}, "'width'"),
    ],
)  # fmt: skip
def test_what_does_not_grow_is_refused_in_one_line(
    item: str, change: dict[str, object], expected: str
) -> None:
    data = small_stakes().to_dict() | {"vegetation_period_m": 4}
    own = {"height_m": [0.2, 1.4], "cover": 0.4, "colour": [40, 90, 20]} | change
    data["classes"] = [
        each | ({"vegetation": own} if each["name"] == item else {})
        for each in data["classes"]
    ]
    with pytest.raises(ConfigError) as caught:
        recipe_from_dict(data, "mine.yaml")
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("period_m", "expected"),
    [
        (
            0.9,
            "finite `vegetation_period_m` of at least 1 m (two cells) if a class has `vegetation`, got 0.9",
        ),
        (0.0, "finite `vegetation_period_m` of at least 1 m"),
        (float("inf"), "finite `vegetation_period_m` of at least 1 m"),
        ("wide", "Expected `vegetation_period_m` as a number, got 'wide'"),
    ],
)
def test_recipes_with_vegetation_say_how_large_its_patches_are(
    period_m: object, expected: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        recipe_from_dict(
            RECIPE.to_dict() | {"vegetation_period_m": period_m}, "mine.yaml"
        )
    assert expected in str(caught.value)
    bare = small_stakes().to_dict() | {"vegetation_period_m": 4}
    with pytest.raises(
        ConfigError,
        match="`vegetation_period_m` only if a class has `vegetation`, got 4",
    ):
        recipe_from_dict(bare, "mine.yaml")


def test_synthesis_1_has_no_vegetation() -> None:
    classes = [
        item | {"vegetation": None} for item in tiny_recipe().to_dict()["classes"]
    ]
    classes[1]["vegetation"] = {
        "height_m": [0.2, 1.4],
        "cover": 0.4,
        "colour": [40, 90, 20],
    }
    with pytest.raises(
        ConfigError,
        match="`synthesis: 2` with `layer vegetation_m`, got `synthesis: 1`",
    ):
        recipe_from_dict(
            tiny_recipe().to_dict() | {"classes": classes, "vegetation_period_m": 4},
            "mine.yaml",
        )


def test_a_recipe_says_of_vegetation_only_what_it_has() -> None:
    assert recipe_from_dict(RECIPE.to_dict(), "manifest") == RECIPE
    assert RECIPE.to_dict()["vegetation_period_m"] == 4.0
    named = {
        item["name"]: item.get("vegetation") for item in RECIPE.to_dict()["classes"]
    }
    assert {name for name, own in named.items() if own} == {"wet_clay", "gravel"}
    assert not any("vegetation" in item for item in small_stakes().to_dict()["classes"])
    assert "vegetation_period_m" not in small_stakes().to_dict()
    assert (RECIPE.fields, small_stakes().fields) == (FIELDS | shipped_fields(), FIELDS)


def test_vegetation_v1_is_stakes_v1_overgrown() -> None:
    stakes = load_recipe("stakes-v1")
    assert SHIPPED.classes == stakes.classes
    assert replace(SHIPPED, id=stakes.id, layers=()) == replace(
        stakes,
        splits={name: stakes.splits[name] for name in SHIPPED.splits},
        scenarios={name: stakes.scenarios[name] for name in SHIPPED.scenarios},
    )
    # No two of the classes are as high, whatever the colour.
    ranges = sorted(growth.height_m for growth in growths_of(SHIPPED).values())
    assert len(ranges) == 5
    assert all(one[1] < other[0] for one, other in pairwise(ranges))


@pytest.mark.parametrize(
    ("split", "digest"),
    [
        ("train", "a6d3f109527de62de3b84ac9a00304bb66009f41e7e7dd05f94cfb6554a5907b"),
        ("test/hs", "99ec804384d48c9ae15aff982224fe5c943bb7143cd67830c77467ead7f962b9"),
    ],
)
def test_the_maps_of_vegetation_v1_stay(split: str, digest: str) -> None:
    made = entry_digests(generate(SHIPPED, split, np.arange(2)), SHIPPED.fields)
    assert hashlib.sha256(made.tobytes()).hexdigest() == digest
