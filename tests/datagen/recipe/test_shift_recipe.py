from dataclasses import asdict, replace
from itertools import pairwise

import numpy as np
import pytest

from benchnav.datagen.recipe.load import load_recipe, recipe_from_dict
from benchnav.datagen.recipe.recipe import Split
from benchnav.datagen.recipe.scenario import Scenario
from benchnav.datagen.schema import FIELDS
from benchnav.datagen.synth.generate import generate

SHIFT, PAPER = load_recipe("shift-v1"), load_recipe("paper-v1")
STEPS = (0.25, 0.5, 0.75, 1.0)


def series(preset: str) -> list[Scenario]:
    """The pairs from std to the preset."""
    return [
        SHIFT.scenarios["std"],
        *(SHIFT.scenarios[f"{preset}-{100 * s:03.0f}"] for s in STEPS),
    ]


def numbers(scenario: Scenario) -> np.ndarray:
    return np.hstack([np.ravel(value) for value in asdict(scenario).values()])


def same_streams(scenario: str) -> dict[str, np.ndarray]:
    """Maps on the random streams of test/std, so that they differ in their scenario
    alone.
    """
    recipe = replace(SHIFT, splits={"test/std": Split(scenario=scenario, maps=8)})
    return generate(recipe, "test/std", np.arange(8))


def test_it_is_paper_v1_but_for_scenarios_and_splits() -> None:
    unchanged = replace(
        SHIFT, id=PAPER.id, scenarios=PAPER.scenarios, splits=PAPER.splits
    )
    assert unchanged == PAPER
    names = [
        "std",
        *(f"{preset}-{100 * s:03.0f}" for preset in ("hg", "hs") for s in STEPS),
    ]
    assert list(SHIFT.scenarios) == names
    assert SHIFT.splits == {
        f"test/{n}": Split(scenario=n, maps=100, solvable=True) for n in names
    }


@pytest.mark.parametrize("preset", ["hg", "hs"])
def test_the_series_climbs_from_std_to_the_preset_in_equal_steps(preset: str) -> None:
    entry = {"bottom": {"preset": preset, "severity": 0}}
    split = {"test/bottom": {"scenario": "bottom", "maps": 1}}
    bottom = recipe_from_dict(
        SHIFT.to_dict() | {"scenarios": entry, "splits": split}, "test"
    )
    pairs = series(preset)
    assert bottom.scenarios["bottom"] == pairs[0] == PAPER.scenarios["std"]
    np.testing.assert_allclose(
        numbers(pairs[-1]), numbers(PAPER.scenarios[preset]), rtol=0, atol=1e-12
    )
    whole = numbers(PAPER.scenarios[preset]) - numbers(PAPER.scenarios["std"])
    assert np.any(whole)
    for below, above in pairwise(pairs):
        np.testing.assert_allclose(
            numbers(above) - numbers(below), whole / 4, rtol=0, atol=1e-12
        )


def test_first_maps_of_std_are_those_of_paper_v1() -> None:
    ours, theirs = (
        generate(recipe, "test/std", np.arange(2)) for recipe in (SHIFT, PAPER)
    )
    for name in FIELDS:
        np.testing.assert_array_equal(ours[name], theirs[name])


@pytest.mark.parametrize("split", SHIFT.splits)
def test_every_severity_is_solvable(split: str) -> None:
    maps = generate(SHIFT, split, np.arange(3))
    assert np.isfinite(maps["reference_time_s"]).all()
    # Start and goal are 16 m apart on both axes; no cell is crossed faster than at 1
    # m/s.
    assert (maps["reference_time_s"] > 16 * np.sqrt(2)).all()


def test_hg_steepens_the_ground_and_hs_dims_the_light_alone() -> None:
    std = same_streams("std")
    slope, light = [std["slope_deg"].mean()], [std["rgb"].mean()]
    for s in STEPS:
        hg, hs = (same_streams(f"{preset}-{100 * s:03.0f}") for preset in ("hg", "hs"))
        slope.append(hg["slope_deg"].mean())
        light.append(hs["rgb"].mean())
        np.testing.assert_array_equal(hg["class_id"], std["class_id"])
        for name in ("class_id", "elevation_m", "slope_deg", "traversability"):
            np.testing.assert_array_equal(hs[name], std[name])
    assert (np.diff(slope) > 0).all()
    assert (np.diff(light) < 0).all()
