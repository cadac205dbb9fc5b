from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from benchnav.core.errors import ConfigError
from benchnav.datagen.recipe import latent
from benchnav.datagen.recipe.load import (
    load_recipe,
    recipe_from_dict,
    shipped_recipes,
    shipped_sizes,
)
from benchnav.datagen.recipe.scenario import Scenario, blend
from benchnav.datagen.synth.generate import reference_time_s

TINY = yaml.safe_load(
    (Path(load_recipe.__globals__["RECIPES"]) / "tiny-v1.yaml").read_text()
)


def test_shipped_recipes_load_and_survive_their_manifest() -> None:
    assert {"paper-v1", "tiny-v1"} <= set(shipped_recipes())
    for name in shipped_recipes():
        recipe = load_recipe(name)
        assert recipe_from_dict(recipe.to_dict(), "manifest") == recipe


def test_maps_of_a_new_id_close_corners_and_those_of_ids_before_do_not(
    tmp_path: Path,
) -> None:
    assert not any(load_recipe(name).closed_corners for name in shipped_recipes())
    stakes = yaml.safe_load(
        (Path(load_recipe.__globals__["RECIPES"]) / "stakes-v1.yaml").read_text()
    )
    path = tmp_path / "own.yaml"
    path.write_text(yaml.safe_dump(stakes | {"id": "own"}))
    recipe = load_recipe(path)
    assert recipe.closed_corners
    assert load_recipe("stakes-v1", ["id=other"]).closed_corners
    assert not load_recipe(
        "stakes-v1", ["id=other", "closed_corners=false"]
    ).closed_corners
    # A manifest holds what was used; without the key its maps are of a version that
    # knew no such rule.
    assert recipe_from_dict(recipe.to_dict(), "manifest") == recipe
    assert not recipe_from_dict(stakes | {"id": "own"}, "manifest").closed_corners
    # Maps as version 0.1 made them know none either.
    assert not load_recipe("tiny-v1", ["id=other"]).closed_corners
    with pytest.raises(ConfigError, match="closed_corners"):
        load_recipe("tiny-v1", ["id=other", "closed_corners=true"])


@pytest.mark.parametrize("closed_corners", [False, True])
def test_a_goal_behind_cells_that_touch_at_corners_has_a_reference_time_only_by_the_former_rule(
    closed_corners: bool,
) -> None:
    recipe = replace(load_recipe("stakes-v1"), closed_corners=closed_corners)
    shape = 1, 1, len(recipe.classes)
    order = np.arange(len(recipe.classes)).reshape(shape)
    expected = latent.expected_of(latent.truth(order, np.zeros(shape), recipe.classes))
    size = np.arange(recipe.height)
    class_id = np.full((1, recipe.height, recipe.width), int(expected.argmax()))
    class_id[0, size, recipe.width - 1 - size] = int(expected.argmin())
    recipe = replace(recipe, stuck_threshold=float(expected.mean()))
    near, far = (
        np.array([[share * recipe.grid.extent_m[0]] * 2]) for share in (0.25, 0.75)
    )
    maps = {
        "class_id": class_id,
        "slope_deg": np.zeros(class_id.shape),
        "start_m": near,
        "goal_m": far,
    }
    assert np.isinf(reference_time_s(recipe, maps)[0]) == closed_corners


def test_severity_moves_from_std_to_the_preset() -> None:
    scenarios = {f"hs{s}": {"preset": "hs", "severity": s} for s in (0, 0.5, 1)} | {
        "std": {"preset": "std"}
    }
    recipe = recipe_from_dict(
        {**TINY, "scenarios": scenarios | TINY["scenarios"]}, "test"
    )
    std, half, full = (recipe.scenarios[name] for name in ("hs0", "hs0.5", "hs1"))
    assert std == Scenario()
    assert half.light_height[0] == pytest.approx(
        (std.light_height[0] + full.light_height[0]) / 2
    )
    assert half.light_height[1] == pytest.approx(
        (std.light_height[1] + full.light_height[1]) / 2
    )
    assert blend(std, full, 0.25).light_height[0] == pytest.approx(
        0.75 * 0.8 + 0.25 * full.light_height[0]
    )


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"occupancy": [0.5, 0.2]}, "that sum to 1"),
        ({"occupancy": [0.5, float("nan")]}, "occupancy"),
        ({"colour": 3}, "colour"),
        ({"splits": {"train": {"scenario": "std", "maps": 0}}}, "maps"),
        ({"splits": {"train": {"scenario": "fog", "maps": 1}}}, "scenario"),
        ({"splits": {}}, "split"),
        ({"scenarios": {"std": {"preset": "fog"}}}, "preset"),
        ({"scenarios": {"std": {"relief_m": [2, 1]}}}, "relief_m"),
        ({"scenarios": {"std": {"ambient": float("nan")}}}, "ambient"),
        ({"goal_m": [99, 3]}, "goal_m"),
        ({"height": "tall"}, "height"),
        ({"resolution_m": 0}, "resolution_m"),
        ({"environments": 0}, "environments"),
        ({"id": "../x"}, "id"),
        ({"goal_m": [4, 4]}, "goal_m"),
        (
            {"scenarios": {"std": {"preset": "hg", "crater_radius_m": [9, 9]}}},
            "crater_radius_m",
        ),
        ({"splits": {"test+std": {"scenario": "std", "maps": 1}}}, "split name"),
        ({"splits": {"manifest": {"scenario": "std", "maps": 1}}}, "split name"),
        ({"scenarios": {"std": {"preset": ["std"]}}}, "preset"),
    ],
)
def test_bad_recipes_give_one_line_that_names_the_key(
    change: dict, expected: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        recipe_from_dict({**TINY, **change}, "bad.yaml").grid  # noqa: B018 - built when asked for
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_recipe_that_is_not_there_lists_those_that_are() -> None:
    with pytest.raises(ConfigError, match=r"paper-v1.*no-such"):
        load_recipe("no-such")


@pytest.mark.parametrize("resolution", [0.25, 0.3, 0.5, 0.7])
def test_positions_lie_in_the_cells_that_a_robot_finds_itself_in(
    resolution: float,
) -> None:
    size = ["height=64", "width=48", f"resolution_m={resolution}"]
    recipe = load_recipe("tiny-v1", ["id=mine", *size, "goal_m=[8,8]"])
    on_borders = np.arange(-2, 70) * resolution
    anywhere = np.random.default_rng(0).uniform(-5, 50, 2000)
    positions = np.stack(
        [np.r_[on_borders, anywhere], np.r_[on_borders[::-1], -anywhere + 40]], axis=1
    )
    wanted = recipe.grid.cell_of(*torch.from_numpy(positions.astype(np.float32)).T)
    for found, cells in zip(recipe.cells_of(positions), wanted, strict=True):
        np.testing.assert_array_equal(found, cells.numpy())


@pytest.mark.parametrize("name", shipped_recipes())
def test_sizes_are_those_of_the_whole_recipe(name: str) -> None:
    assert shipped_sizes(name) == {
        split: spec.maps for split, spec in load_recipe(name).splits.items()
    }
