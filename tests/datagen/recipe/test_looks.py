"""What colours tell: of tints, of look-alikes, and of ground under vegetation."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml

from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.datagen.files.stored_terrain import terrain_of
from benchnav.datagen.layers.layer import DrawnMaps
from benchnav.datagen.layers.vegetation import Growth, Vegetation
from benchnav.datagen.recipe import latent
from benchnav.datagen.recipe.load import load_recipe, recipe_from_dict
from benchnav.datagen.recipe.looks import shown_colours
from benchnav.datagen.recipe.recipe import Recipe, Split
from benchnav.datagen.recipe.scenario import PRESETS, Scenario, Tint, blend
from benchnav.datagen.synth.generate import generate
from tests.datagen.small import grown, small_stakes
from tests.factories import tiny_recipe

SNOW = Tint(colour=(240, 244, 248), share=0.6)


def grass(cover: float, low: float = 0.1) -> Growth:
    return Growth(height_m=(low, low + 0.1), cover=cover, colour=(60, 110, 30))


def overgrown(**by_class: Growth) -> Recipe:
    return grown(small_stakes(), **by_class)


def vegetation_of(recipe: Recipe) -> Vegetation:
    (spec,) = recipe.layers
    assert isinstance(spec.layer, Vegetation)
    return spec.layer


def told(
    recipe: Recipe,
    class_id: np.ndarray,
    slope_deg: np.ndarray,
    height_m: np.ndarray | None = None,
) -> latent.Parameters:
    """What colours tell of maps, with vegetation where heights are given."""
    maps = DrawnMaps(
        class_id, np.zeros(class_id.shape), slope_deg, recipe.grid, recipe.classes
    )
    if height_m is None:
        return latent.look_alikes(maps)
    return latent.look_alikes(maps, [vegetation_of(recipe)], {"vegetation_m": height_m})


def maps_in(scenario: Scenario, recipe: Recipe | None = None) -> dict[str, np.ndarray]:
    """Maps of one split, so that only the scenario differs."""
    recipe = replace(
        recipe or tiny_recipe(),
        scenarios={"mine": scenario},
        splits={"all": Split(scenario="mine", maps=6)},
    )
    return generate(recipe, "all", np.arange(6))


# Tints


def test_a_tint_changes_the_colours_of_its_classes_and_nothing_else() -> None:
    recipe = tiny_recipe()
    tints = (Tint(classes=("gravel", "scree"), colour=(30, 20, 10), share=0.25), SNOW)
    # all in full light
    plain, tinted = (maps_in(Scenario(tints=own, ambient=1.0)) for own in ((), tints))
    for name in set(plain) - {"rgb"}:
        np.testing.assert_array_equal(plain[name], tinted[name])
    own = np.array([item.colour for item in recipe.classes], dtype=float)
    for number in (4, 5):
        own[number] = 0.75 * own[number] + 0.25 * np.array([30, 20, 10])
    expected = np.rint(0.4 * own + 0.6 * np.array([240, 244, 248]))[tinted["class_id"]]
    np.testing.assert_array_equal(np.moveaxis(tinted["rgb"], 1, -1), expected)
    assert {4, 5} <= set(np.unique(tinted["class_id"]))


def test_a_tint_is_shaded_as_ground_is() -> None:
    tints = (Tint(classes=("gravel",), colour=(0, 0, 0), share=0.5),)
    plain, tinted = (maps_in(Scenario(tints=own)) for own in ((), tints))
    gravel = plain["class_id"] == 4
    before, after = (
        np.moveaxis(maps["rgb"], 1, -1).astype(float) for maps in (plain, tinted)
    )
    np.testing.assert_array_equal(before[~gravel], after[~gravel])
    assert np.abs(after[gravel] - before[gravel] / 2).max() <= 0.75
    assert gravel.any()


@pytest.mark.parametrize("synthesis", [1, 2])
@pytest.mark.parametrize("preset", ["snow", "wet"])
def test_severity_moves_the_share_of_a_preset(preset: str, synthesis: int) -> None:
    data = yaml.safe_load(PRESETS.read_text())[
        "scenarios-2" if synthesis == 2 else "scenarios"
    ][preset]
    (tint,) = data["tints"]
    entries = {
        f"s{s}": {"preset": preset, "severity": s} for s in (0, 0.25, 0.5, 1, 1.25)
    } | {"std": {"preset": "std"}}
    recipe = recipe_from_dict(
        small_stakes().to_dict()
        | {"scenarios": entries, "splits": {"train": {"scenario": "std", "maps": 1}}}
        if synthesis == 2
        else tiny_recipe().to_dict()
        | {"scenarios": entries, "splits": {"train": {"scenario": "std", "maps": 1}}},
        "test",
    )
    found = recipe.scenarios
    assert found["s0"] == found["std"]
    for severity in (0.25, 0.5, 1, 1.25):
        (own,) = found[f"s{severity}"].tints
        assert own.share == pytest.approx(severity * tint["share"], abs=1e-12)
        assert (own.classes, own.colour) == ((), tuple(tint["colour"]))
        assert replace(found[f"s{severity}"], tints=()) == found["std"]


def test_what_a_scenario_says_of_tints_stands_in_place_of_its_presets() -> None:
    data = tiny_recipe().to_dict()
    data["scenarios"] = {"std": {"preset": "snow", "severity": 0.5, "tints": []}}
    data["splits"] = {"train": {"scenario": "std", "maps": 1}}
    assert recipe_from_dict(data, "test").scenarios["std"] == Scenario()
    data["scenarios"] = {
        "std": {
            "preset": "hs",
            "tints": [{"classes": ["gravel"], "colour": [9, 9, 9], "share": 0.3}],
        }
    }
    recipe = recipe_from_dict(data, "test")
    assert recipe.scenarios["std"].tints == (
        Tint(classes=("gravel",), colour=(9, 9, 9), share=0.3),
    )
    assert recipe.scenarios["std"].light_height == pytest.approx((0.3, 0.8))
    assert recipe_from_dict(recipe.to_dict(), "manifest") == recipe


def test_a_manifest_names_tints_only_where_there_are_some() -> None:
    recipe = tiny_recipe()
    assert all(
        "tints" not in scenario for scenario in recipe.to_dict()["scenarios"].values()
    )
    snowy = replace(
        recipe, scenarios=recipe.scenarios | {"hs": Scenario(tints=(SNOW,))}
    ).to_dict()["scenarios"]
    assert snowy["hs"]["tints"] == [
        {"classes": [], "colour": [240, 244, 248], "share": 0.6}
    ]
    assert "tints" not in snowy["std"]


def test_a_recipe_without_scenarios_has_the_three_of_before() -> None:
    data = load_recipe("paper-v1").to_dict()
    del data["scenarios"]
    assert list(recipe_from_dict(data, "test").scenarios) == ["std", "hg", "hs"]


@pytest.mark.parametrize(
    ("tint", "expected"),
    [
        ({"share": 1.0}, "`share` of a tint in (0, 1), got 1."),
        ({"share": 0.0}, "`share` of a tint in (0, 1), got 0."),
        ({"colour": [0, 0, 300]}, "`colour` of a tint in 0–255"),
        ({"classes": ["gravle"]}, "`classes` of a tint of scenario 'std' among basalt"),
        (
            {"share": 0.995},
            "if the class table does, got 'basalt' and 'wet_clay' in the same colour. Lower",
        ),
        (
            {"classes": ["packed_soil"]},
            "got 'packed_soil' and 'crusted_soil' in different colours. Tint both.",
        ),
        ({"depth": 1}, "'depth'"),
    ],
)
def test_bad_tints_are_refused_in_one_line(
    tint: dict[str, object], expected: str
) -> None:
    own = {"colour": [240, 244, 248], "share": 0.5} | tint
    data = small_stakes().to_dict() | {"scenarios": {"std": {"tints": [own]}}}
    data["splits"] = {"train": {"scenario": "std", "maps": 1}}
    with pytest.raises(ConfigError) as caught:
        recipe_from_dict(data, "mine.yaml")
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_tint_may_not_give_ground_the_colour_of_vegetation() -> None:
    recipe = overgrown(wet_clay=grass(0.4))
    colour = np.array(recipe.classes[4].colour)
    towards = tuple(
        (colour + 2 * (np.array([60, 110, 30]) - colour)).clip(0, 255).tolist()
    )
    assert towards == (0, 94, 0)  # half way there gravel is (76, 110, 50)
    halved = Tint(classes=("gravel",), colour=(0, 94, 0), share=0.5)
    muddy = replace(
        recipe, scenarios=recipe.scenarios | {"mud": Scenario(tints=(halved,))}
    )
    with pytest.raises(
        ConfigError,
        match="on 'wet_clay' to have a `colour` that no terrain has in scenario 'mud'",
    ):
        grown(muddy, wet_clay=replace(grass(0.4), colour=(76, 110, 50)))


def test_vegetation_keeps_its_colour_under_a_tint() -> None:
    recipe = overgrown(wet_clay=grass(0.4))
    maps = maps_in(Scenario(tints=(SNOW,), ambient=1.0), recipe)
    cells = maps["vegetation_m"] > 0
    assert np.unique(np.moveaxis(maps["rgb"], 1, -1)[cells], axis=0).tolist() == [
        [60, 110, 30]
    ]
    shown = shown_colours(recipe.classes, Scenario(tints=(SNOW,)))
    np.testing.assert_allclose(
        shown[0], 0.4 * np.array([72, 62, 58]) + 0.6 * np.array([240, 244, 248])
    )


def test_blending_leaves_the_base_as_it_is() -> None:
    assert blend(Scenario(), Scenario(tints=(SNOW,)), 0.0) == Scenario()


# What colour tells at best


def frequencies(recipe: Recipe, maps: int, number: int, overgrown: bool) -> np.ndarray:
    """How often each class lies in cells that look like one class's, bare or overgrown,
    on maps; shape [C].
    """
    made = generate(
        replace(recipe, splits={"all": Split(scenario="std", maps=maps)}),
        "all",
        np.arange(maps),
    )

    growths = vegetation_of(recipe).classes
    looks: list[object] = [item.colour for item in recipe.classes]
    if overgrown:
        looks = [
            growths[item.name].colour if item.name in growths else None
            for item in recipe.classes
        ]
    alike = np.array([look == looks[number] for look in looks])
    cells = alike[made["class_id"]] & ((made["vegetation_m"] > 0) == overgrown)
    counts = np.bincount(made["class_id"][cells], minlength=len(recipe.classes))
    return counts / counts.sum()


def test_classes_below_one_vegetation_weigh_as_they_are_covered() -> None:
    """By Bayes, and as often as they lie there on maps that are drawn."""
    recipe = overgrown(
        packed_soil=grass(0.25),
        crusted_soil=grass(0.25, 0.5),
        wet_clay=grass(0.75, 1.0),
    )
    table, (packed, crusted, wet) = recipe.classes, (2, 10, 1)
    class_id = np.array([[[packed, crusted, wet, 0]], [[packed, crusted, packed, 0]]])
    slope, height_m = (
        np.full(class_id.shape, 5.0),
        np.array([[[0.1, 0.5, 1.0, 0.0]]] * 2),
    )
    weights, means, _ = told(recipe, class_id, slope, height_m)
    np.testing.assert_allclose(weights.sum(axis=1), 1)

    def share(of: int, where: tuple[int, int]) -> float:
        own = latent.truth(np.full_like(class_id, of), slope, table)[1][
            where[0], 0, 0, where[1]
        ]
        return float(
            weights[
                where[0], np.isclose(means[where[0], :, 0, where[1]], own), 0, where[1]
            ].sum()
            / 0.9 ** (of == wet)
        )

    for cell in range(3):  # of the first map, which shows all three: 1 : 1 : 3
        assert [share(of, (0, cell)) for of in (packed, crusted, wet)] == pytest.approx(
            [0.2, 0.2, 0.6]
        )
    for cell in range(3):  # the second has no wet clay, so it is not below
        assert [share(of, (1, cell)) for of in (packed, crusted)] == pytest.approx(
            [0.5, 0.5]
        )
    # The same on maps that show all three.
    recipe = replace(
        recipe,
        occupancy=(0.4, 0.3, 0.3),
        environments=1,
        classes=tuple(table[k] for k in (1, 2, 10)),
    )
    assert frequencies(recipe, 300, 0, overgrown=True) == pytest.approx(
        [0.6, 0.2, 0.2], abs=0.03
    )
    assert frequencies(recipe, 300, 1, overgrown=False) == pytest.approx(
        [0.0, 0.5, 0.5], abs=0.03
    )


def test_bare_cells_tell_what_they_told_without_vegetation() -> None:
    recipe = overgrown(packed_soil=grass(0.4), crusted_soil=grass(0.4, 0.5))
    maps = generate(recipe, "train", np.arange(6))
    slope = maps["slope_deg"].astype(np.float64)
    none = told(recipe, maps["class_id"], slope)
    bare = maps["vegetation_m"] == 0
    with_layer = told(
        recipe, maps["class_id"], slope, maps["vegetation_m"].astype(np.float64)
    )
    for one, other in zip(none, with_layer, strict=True):
        for cells in (
            bare,
            ~bare,
        ):  # where look-alikes have one vegetation, below it too
            np.testing.assert_array_equal(
                np.moveaxis(one, 1, 0)[:, cells], np.moveaxis(other, 1, 0)[:, cells]
            )


def test_a_terrain_tells_what_its_vegetation_hides() -> None:
    """Of a class that looks like no other: its own truth on bare ground, that of both
    classes below the grass.
    """
    recipe = overgrown(wet_clay=grass(0.5), gravel=grass(0.5, 0.5))
    recipe = replace(
        recipe,
        occupancy=(0.5, 0.5),
        environments=1,
        classes=tuple(recipe.classes[k] for k in (1, 4)),
    )
    terrain = terrain_of(generate(recipe, "train", np.arange(2)), recipe)
    assert terrain.look_alikes is not None
    seen, grown = terrain.look_alikes(terrain), terrain.layers["vegetation_m"] > 0
    both = [
        TraversabilityMixture(*(torch.from_numpy(v.astype(np.float32)) for v in latent.truth(
            np.full(terrain.class_id.shape, k), terrain.slope_deg.double().numpy(), recipe.classes))).mean()
        for k in range(2)
    ]  # fmt: skip
    torch.testing.assert_close(seen.mean()[~grown], terrain.truth.mean()[~grown])
    torch.testing.assert_close(seen.mean()[grown], (0.5 * (both[0] + both[1]))[grown])
    assert grown.any()
    # Kept maps and their layers stay together.
    index = torch.tensor([1])
    kept = terrain.select(index)
    torch.testing.assert_close(kept.look_alikes(kept).mean(), seen.mean()[index])


def test_a_terrain_has_the_slope_law_of_each_class() -> None:
    recipe = load_recipe("stakes-v1")
    terrain = terrain_of(generate(recipe, "test/std", np.arange(1)), recipe)
    slope_deg = torch.tensor([0.0, 7.5, 30.0, 90.0])
    assert terrain.slope_law is not None
    law = terrain.slope_law(slope_deg)
    for row, item in zip(law, recipe.classes, strict=True):
        loss = 1e-3 * item.scale * slope_deg.double() ** item.exponent + item.offset
        torch.testing.assert_close(row, (1 - loss).clamp(0, 1))
    # The first component of the truth is that law at the cells' slopes.
    cells = terrain.slope_law(terrain.slope_deg.flatten())
    own = cells.gather(0, terrain.class_id.flatten()[None])[0]
    torch.testing.assert_close(terrain.truth.means[:, 0].flatten().double(), own)


def test_heights_that_do_not_overlap_tell_what_colour_hides() -> None:
    recipe = overgrown(packed_soil=grass(0.4), crusted_soil=grass(0.4, 0.5))
    terrain = terrain_of(generate(recipe, "train", np.arange(8)), recipe)
    grown = terrain.layers["vegetation_m"] > 0
    tall = terrain.layers["vegetation_m"] > 0.3
    assert (tall == (grown & (terrain.class_id == 10))).all()
    seen = terrain.look_alikes(terrain).mean()
    assert (seen - terrain.truth.mean())[grown].abs().min() > 0.1  # colour leaves both
