"""What every layer keeps: bits, batches, ranges; a layer without effect leaves all else
as it is.
"""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.core.settings import plain
from benchnav.datagen.dem.importer import import_dem
from benchnav.datagen.files.check import find_faults
from benchnav.datagen.files.stored_terrain import terrain_of
from benchnav.datagen.layers.layer import DrawnMaps, Layer
from benchnav.datagen.layers.spec import overrides_of, read_layer, shipped_fields
from benchnav.datagen.layers.vegetation import Growth, Vegetation
from benchnav.datagen.recipe import latent
from benchnav.datagen.recipe.load import recipe_from_dict
from benchnav.datagen.recipe.recipe import Recipe, Split
from benchnav.datagen.schema import FIELDS, TRUTH
from benchnav.datagen.synth.generate import generate
from tests.datagen.layers.own import Plain, wet, wetness
from tests.datagen.small import grown, small_stakes
from tests.factories import tiny_dataset

GRASS = Growth(height_m=(0.1, 0.8), cover=0.5, colour=(60, 110, 30))
# A layer of each shipped kind, as a recipe may have it.
SHIPPED: dict[str, Layer] = {
    "vegetation": Vegetation(period_m=4.0, classes={"wet_clay": GRASS, "scree": GRASS})
}
ON_ICE = {"period_m": 4, "classes": {"ice": plain(GRASS)}}
MAPS, ONES = np.arange(6), np.ones((2, 32, 32))


@pytest.fixture(params=[*SHIPPED, "wetness"])
def recipe(request: pytest.FixtureRequest, tmp_path: Path) -> Recipe:
    """A recipe with one layer."""
    if request.param == "wetness":
        return wet(tmp_path)
    return replace(small_stakes(), layers=(SHIPPED[request.param],))


def test_every_shipped_layer_is_tried_here() -> None:
    assert set(SHIPPED) == set(registry.shipped_names("layer"))
    assert set(shipped_fields()) == {layer.name for layer in SHIPPED.values()}


def test_a_map_is_the_same_in_any_batch_and_order(recipe: Recipe) -> None:
    whole = generate(recipe, "train", MAPS)
    parts = [generate(recipe, "train", np.array(part)) for part in ([1, 4], [5])]
    assert list(whole) == list(recipe.fields)
    for name, values in whole.items():
        assert values.dtype.str == recipe.fields[name].dtype
        np.testing.assert_array_equal(parts[0][name], values[[1, 4]])
        np.testing.assert_array_equal(parts[1][name][0], values[5])


def test_values_lie_within_the_range_and_fill_some_of_it(recipe: Recipe) -> None:
    maps = generate(recipe, "train", MAPS)
    (spec,) = recipe.layers
    values, field = maps[spec.name], spec.stored_field
    assert (field.minimum <= values).all()
    assert (values <= field.maximum).all()
    assert values.std() > 0


def test_what_a_layer_does_not_name_stays(recipe: Recipe) -> None:
    maps, without = (
        generate(each, "train", MAPS) for each in (recipe, replace(recipe, layers=()))
    )
    (spec,) = recipe.layers
    changed = {"rgb", "traversability"} if spec.affects else {"rgb"}
    for name in set(without) - changed:
        np.testing.assert_array_equal(maps[name], without[name])
    assert all((maps[name] != without[name]).any() for name in changed)


def test_a_layer_without_effect_leaves_colours_and_lambda_as_they_are() -> None:
    recipe = small_stakes()
    layered = replace(recipe, layers=(Plain(),))
    for split in recipe.splits:
        maps, without = (
            generate(each, split, np.arange(3)) for each in (layered, recipe)
        )
        for name in FIELDS:
            np.testing.assert_array_equal(maps[name], without[name])
        truth = latent.truth(
            maps["class_id"], maps["slope_deg"].astype(np.float64), recipe.classes
        )
        for name, values in zip(TRUTH, truth[1:], strict=True):
            np.testing.assert_array_equal(maps[name], values.astype(np.float32))
    own, bare = terrain_of(maps, layered), terrain_of(without, recipe)
    assert own.look_alikes is not None
    assert bare.look_alikes is not None
    torch.testing.assert_close(
        own.look_alikes(own).mean(), bare.look_alikes(bare).mean(), rtol=0, atol=1e-6
    )


def test_lambda_follows_the_distribution_that_the_layer_makes(tmp_path: Path) -> None:
    """By hand: of soft spots and of firm ground the mean falls by the wetness, and the
    deviation stays.
    """
    recipe = wet(tmp_path, loss=0.7)
    maps, bare = (
        generate(each, "train", MAPS) for each in (recipe, replace(recipe, layers=()))
    )
    weights, means, stds = latent.stored_truth(bare, recipe.classes)
    keeps = 1 - 0.7 * maps["wetness"].astype(np.float64)[:, None]
    expected = np.where(weights > 0, means * keeps, means)
    np.testing.assert_array_equal(maps["truth_mean"], expected.astype(np.float32))
    np.testing.assert_array_equal(maps["truth_std"], stds.astype(np.float32))
    terrain = terrain_of(maps, recipe)
    np.testing.assert_array_equal(terrain.truth.means.numpy(), maps["truth_mean"])
    assert list(terrain.layers) == ["wetness"]
    # All colours tell of look-alikes is the average of both, each with the wetness.
    assert terrain.look_alikes is not None
    seen = terrain.look_alikes(terrain).mean().double().numpy()
    slope = maps["slope_deg"].astype(np.float64)
    pair = [
        number
        for number, item in enumerate(recipe.classes)
        if item.name in ("packed_soil", "crusted_soil")
    ]
    expected_means = []
    for number in pair:
        _, mean, std = latent.truth(np.full(slope.shape, number), slope, recipe.classes)
        expected_means.append(
            latent.expected_traversability(mean[:, 0] * keeps[:, 0], std[:, 0])
        )
    cells = np.isin(maps["class_id"], pair)
    assert cells.any()
    np.testing.assert_allclose(
        seen[cells], np.mean(expected_means, axis=0)[cells], atol=1e-5
    )


def test_a_solvable_split_goes_by_the_lambda_that_the_layer_makes(
    tmp_path: Path,
) -> None:
    recipe = wet(tmp_path, loss=0.6)
    recipe = replace(
        recipe, splits={"all": Split(scenario="std", maps=4, solvable=True)}
    )
    maps, bare = (
        generate(each, "all", np.arange(4))
        for each in (recipe, replace(recipe, layers=()))
    )
    assert (maps["reference_time_s"] > bare["reference_time_s"]).all()


def test_layers_change_colours_and_lambda_in_their_order(tmp_path: Path) -> None:
    """Grass hides wet soil if it is drawn later; the values of both are those of each
    layer alone.
    """
    layers = wetness(tmp_path)(), Vegetation(period_m=4.0, classes={"wet_clay": GRASS})
    bright = replace(small_stakes().scenarios["std"], ambient=1.0)
    splits = {"train": Split(scenario="std", maps=6)}
    recipe = small_stakes(scenarios={"std": bright}, splits=splits)
    hidden, shown = (
        generate(replace(recipe, layers=order), "train", MAPS)
        for order in (layers, layers[::-1])
    )
    cells = hidden["vegetation_m"] > 0
    colours = [np.moveaxis(maps["rgb"], 1, -1)[cells] for maps in (hidden, shown)]
    assert (colours[0] == GRASS.colour).all()
    assert not (colours[1] == GRASS.colour).all(axis=1).any()
    for name in ("vegetation_m", "wetness", "traversability"):
        np.testing.assert_array_equal(hidden[name], shown[name])
    alone = generate(grown(recipe, wet_clay=GRASS), "train", MAPS)
    np.testing.assert_array_equal(alone["vegetation_m"], hidden["vegetation_m"])


def test_streams_differ_by_name_seed_split_and_rejected_draws() -> None:
    recipe = replace(small_stakes(), layers=(Plain(),))
    sibling, split = (
        replace(recipe, seed=5),
        replace(recipe, splits={"valid": recipe.splits["train"]}),
    )
    drawn = [
        generate(recipe, "train", MAPS)["plain"],
        generate(sibling, "train", MAPS)["plain"],
        generate(split, "valid", MAPS)["plain"],
    ]
    for number, one in enumerate(drawn):
        for other in drawn[:number]:
            assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.05


def test_vegetation_is_one_layer_however_it_is_named() -> None:
    keys = grown(small_stakes(), wet_clay=GRASS)
    named = {
        "part": "vegetation",
        "options": {
            "period_m": 4,
            "classes": {"wet_clay": plain(GRASS)},
        },
    }
    recipe = recipe_from_dict(small_stakes().to_dict() | {"layers": [named]}, "test")
    assert recipe == keys
    assert recipe.to_dict() == keys.to_dict()
    assert "layers" not in recipe.to_dict()
    assert (
        read_layer(Vegetation(period_m=4.0, classes={"wet_clay": GRASS}))
        == recipe.layers[0]
    )


class Broken(Plain):
    """A layer of which a test replaces a method."""


@pytest.mark.parametrize(
    ("method", "returned", "expected"),
    [
        ("draw", np.zeros((2, 3)), "values of `draw` of layer 'plain' of shape [2, 32, 32], got [2, 3]"),
        ("draw", np.full((2, 32, 32), np.nan), "values of `draw` of layer 'plain' finite, got nan (the first of 2048"),
        ("draw", np.full((2, 32, 32), np.inf), "values of `draw` of layer 'plain' finite, got inf"),
        ("draw", "dry", "values of `draw` of layer 'plain' as an array of numbers, got str"),
        ("draw", OSError("no\nfile"), "`draw` of layer 'plain' failed: OSError: no file"),
        ("look", np.full((2, 3, 32, 32), 256.0), "colours of `look` of layer 'plain' in [0, 255], got 256"),
        ("look", np.zeros((2, 32, 32)), "colours of `look` of layer 'plain' of shape [2, 3, 32, 32]"),
        ("affect", (1.5 * ONES, ONES), "means of `affect` of layer 'plain' in [0, 1], got 1.5"),
        ("affect", (-0.1 * ONES, ONES), "means of `affect` of layer 'plain' in [0, 1], got -0.1"),
        ("affect", (ONES, 0 * ONES), "stds of `affect` of layer 'plain' in [1e-06, 1], got 0"),
        ("affect", ONES, "(mean, std) from `affect` of layer 'plain', got ndarray"),
    ],
)  # fmt: skip
def test_a_bad_layer_ends_in_one_line(
    method: str, returned: object, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def bad(*_: object) -> object:
        if isinstance(returned, Exception):
            raise returned
        return returned

    monkeypatch.setattr(Broken, method, bad)
    recipe = replace(small_stakes(), layers=(Broken(),))
    with pytest.raises(ConfigError) as caught:
        generate(recipe, "train", np.arange(2))
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("layers", "expected"),
    [
        ("wet.py:Wetness", "`layers` as a list, got 'wet.py:Wetness'"),
        (["nothing"], "Expected a layer among vegetation, package.module:Name"),
        ([{"part": "vegetation", "label": "grass"}], "a layer as NAME or as {part: NAME, options: {…}}"),
        ([{"part": "vegetation", "options": {"period_m": 4, "moss": 1}}], "'moss'"),
        ([{"part": "vegetation", "options": ON_ICE}], "classes of layer 'vegetation' among"),
        ([{"part": "tests.datagen.layers.own:Plain"}] * 2, "its own name, got 'plain' more than once"),
    ],
)  # fmt: skip
def test_layers_that_are_none_are_rejected(layers: object, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        recipe_from_dict(small_stakes().to_dict() | {"layers": layers}, "mine.yaml")
    assert str(caught.value).startswith("Recipe mine.yaml:")
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "name",
    [
        "",
        "2d",
        "soil type",
        "λ",
        "slope_deg",
        "drive_std",
        "truth_mean",
        "goal",
        "seen",
    ],
)
def test_names_that_are_taken_or_no_names_are_rejected(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Broken, "name", name)
    with pytest.raises(ConfigError, match=r"Expected `name` of layer .*Broken"):
        replace(small_stakes(), layers=(Broken(),))


def test_a_class_that_the_recipe_lacks_is_named() -> None:
    flat = np.zeros((1, 3, 3))
    maps = DrawnMaps(
        flat.astype(int), flat, flat, small_stakes().grid, small_stakes().classes
    )
    with pytest.raises(
        ConfigError, match="Expected a class of the recipe among basalt"
    ):
        maps.cells_of("ice")


def test_layers_scale_with_their_maps_and_name_what_changed() -> None:
    """Of vegetation by the key of recipes, of others by their place among `layers`."""
    grass, taller = (
        read_layer(Vegetation(period_m=m, classes={"scree": GRASS})) for m in (4.0, 1.0)
    )
    assert grass.scaled(0.5, 0.5).options["period_m"] == 2.0
    assert grass.scaled(0.25, 1.0).options["period_m"] == 2.0  # two cells at least
    assert overrides_of((grass,), (grass.scaled(0.5, 0.5),)) == {
        "vegetation_period_m": 2.0
    }
    other = replace(taller, part="file.py:Other")
    after = replace(other, options={**other.options, "period_m": 3.0})
    assert overrides_of((grass, other), (grass, after)) == {
        "layers.0.options.period_m": 3.0
    }


def test_an_import_draws_no_layer_that_changes_lambda(tmp_path: Path) -> None:
    recipe = replace(small_stakes(), layers=(Plain(),))
    with pytest.raises(
        ConfigError,
        match="`layers` do not change λ, got plain",
    ):
        next(import_dem("none.tif", tmp_path / "d.h5", recipe))


def test_what_does_not_lie_in_the_range_of_a_users_layer_is_a_fault(
    tmp_path: Path,
) -> None:
    path = tiny_dataset(tmp_path / "d.h5", wet(tmp_path))
    with h5py.File(path, "r+") as file:
        file["train/wetness"][2, 0, 0] = 1.5
        file["train/truth_mean"][3, 0, 0, 0] = np.nan
    found = {
        (fault.map, fault.field)
        for fault in find_faults(path)
        if fault.problem == "is out of range"
    }
    assert found == {(2, "wetness"), (3, "truth_mean")}


def test_modes_without_weight_stay_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Broken, "affect", lambda _, mean, std, *__: (mean, 0.5 * std))
    recipe = replace(small_stakes(), layers=(Broken(),))
    maps = generate(recipe, "train", MAPS)
    weights, _, stds = latent.truth(
        maps["class_id"], maps["slope_deg"].astype(np.float64), recipe.classes
    )
    assert (weights == 0).any()
    expected = np.where(weights > 0, 0.5 * stds, stds).astype(np.float32)
    np.testing.assert_array_equal(maps["truth_std"], expected)
