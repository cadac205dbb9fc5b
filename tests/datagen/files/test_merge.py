from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from benchnav.core.errors import ConfigError, DatasetError
from benchnav.datagen.files.check import find_faults
from benchnav.datagen.files.create import create
from benchnav.datagen.files.merge import merge
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.recipe import Recipe
from tests.datagen.small import small_stakes
from tests.factories import tiny_dataset, tiny_recipe


def only(recipe: Recipe, *splits: str) -> Recipe:
    return replace(recipe, splits={name: recipe.splits[name] for name in splits})


def run(paths: list[Path], out: Path, name: str = "both") -> TerrainDataset:
    for _ in merge(paths, out, name):
        pass
    return TerrainDataset(out)


def test_splits_made_apart_are_the_whole(tmp_path: Path) -> None:
    recipe = tiny_recipe()
    whole = TerrainDataset(tiny_dataset(tmp_path / "whole.h5", recipe))
    some = tiny_dataset(tmp_path / "a.h5", only(recipe, "train", "valid"))
    rest = tiny_dataset(
        tmp_path / "b.h5", only(recipe, "test/std", "test/hg", "test/hs")
    )
    assert run([some, rest], tmp_path / "m.h5").digest == whole.digest


def test_siblings_are_joined_end_to_end(tmp_path: Path) -> None:
    first = tiny_dataset(tmp_path / "a.h5")
    second = tiny_dataset(tmp_path / "b.h5", replace(tiny_recipe(), seed=1))
    merged = run([first, second], tmp_path / "m.h5")
    assert find_faults(merged.path) == []
    for split in merged.splits:
        halves = [TerrainDataset(path).read(split) for path in (first, second)]
        for name, values in merged.read(split).items():
            np.testing.assert_array_equal(
                values, np.concatenate([half[name] for half in halves])
            )
    third = tiny_dataset(tmp_path / "c.h5", replace(tiny_recipe(), seed=2))
    assert run([merged.path, third], tmp_path / "n.h5").splits["train"]["maps"] == 24


def test_all_reasons_are_given_at_once(tmp_path: Path) -> None:
    recipe = tiny_recipe()
    first = tiny_dataset(tmp_path / "a.h5", only(recipe, "train", "test/hs"))
    classes = (replace(recipe.classes[0], scale=9.0), *recipe.classes[1:])
    scenarios = recipe.scenarios | {"hs": replace(recipe.scenarios["hs"], ambient=0.5)}
    unlike = replace(
        recipe, seed=5, classes=classes, resolution_m=0.6, scenarios=scenarios
    )
    second = tiny_dataset(tmp_path / "b.h5", only(unlike, "train", "test/hs"))
    with pytest.raises(DatasetError) as caught:
        run([first, second, first], tmp_path / "m.h5", "no spaces")
    for reason in (
        r"different resolution_m (0.5 / 0.6)", "different classes",
        "different scenarios or `solvable` in split 'test/hs'",
        "10 map(s) in common", "got 'no spaces'",
    ):  # fmt: skip
        assert reason in str(caught.value)
    # Each pair is named once: (a, b), (a, a) and (b, a).
    assert str(caught.value).count(f"{first} and {second} have ") == 1
    assert str(caught.value).count(" have ") == 3
    assert not (tmp_path / "m.h5").exists()
    with pytest.raises(DatasetError, match="fewer than two"):
        run([first], tmp_path / "m.h5")


def test_maps_made_in_another_way_are_refused(tmp_path: Path) -> None:
    recipe = small_stakes()
    first = tiny_dataset(tmp_path / "a.h5", only(recipe, "train"))
    second = tiny_dataset(tmp_path / "b.h5", only(replace(recipe, seed=1), "train"))
    merged = run([first, second], tmp_path / "m.h5")
    assert merged.manifest["format_version"] == "1.1"
    assert find_faults(merged.path) == []
    apart = replace(recipe.places, least_distance_m=9)
    plain = replace(tiny_recipe(), environments=12, stuck_threshold=0.1)
    for name, other in (
        ("places", replace(recipe, places=apart)),
        ("places", replace(recipe, places=None, start_m=(4, 4), goal_m=(12, 12))),
        ("correlation_m", replace(recipe, correlation_m=1.0)),
        ("synthesis", plain),
    ):
        path = tiny_dataset(
            tmp_path / "other.h5", only(replace(other, seed=3), "train")
        )
        with pytest.raises(DatasetError, match=f"different {name} ") as caught:
            run([first, path], tmp_path / "n.h5")
        assert "Rule(" not in str(caught.value)
        path.unlink()


def test_a_damaged_source_is_refused_and_an_existing_target_kept(
    tmp_path: Path,
) -> None:
    recipe = tiny_recipe()
    first = tiny_dataset(tmp_path / "a.h5", only(recipe, "train"))
    second = tiny_dataset(tmp_path / "b.h5", only(recipe, "valid"))
    with h5py.File(second, "r+") as file:
        file["valid/class_id"][1] = 3
    with pytest.raises(
        DatasetError, match=r"valid: map 1: field 'class_id' does not match"
    ):
        run([first, second], tmp_path / "m.h5")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.h5", "b.h5"]
    with pytest.raises(ConfigError, match="exists"):
        run([first, second], first)


def test_unlike_scenarios_are_found_in_files_that_were_merged_before(
    tmp_path: Path,
) -> None:
    recipe = tiny_recipe()
    first = tiny_dataset(tmp_path / "a.h5", only(recipe, "train"))
    second = tiny_dataset(tmp_path / "b.h5", only(recipe, "test/hs"))
    scenarios = recipe.scenarios | {"hs": replace(recipe.scenarios["hs"], ambient=0.5)}
    third = tiny_dataset(
        tmp_path / "c.h5", only(replace(recipe, seed=9, scenarios=scenarios), "test/hs")
    )
    both = run([first, second], tmp_path / "ab.h5").path
    for order in ([both, third], [third, both]):
        with pytest.raises(DatasetError, match=r"different scenarios .*'test/hs'"):
            run(order, tmp_path / "m.h5")


def test_what_a_killed_run_made_of_the_same_name_is_kept(tmp_path: Path) -> None:
    recipe = tiny_recipe()
    steps = create(recipe, tmp_path / "m.h5", shard_cells=4 * 32 * 32)
    next(steps)
    next(steps)
    steps.close()
    kept = set((tmp_path / ".m.h5.partial").glob("*.h5"))
    assert kept
    parts = [
        tiny_dataset(tmp_path / f"{name}.h5", only(recipe, name))
        for name in ("train", "valid")
    ]
    run(parts, tmp_path / "m.h5")
    assert kept <= set((tmp_path / ".m.h5.partial").glob("*.h5"))


def test_a_folder_is_replaced_only_where_it_is_a_dataset(tmp_path: Path) -> None:
    recipe = tiny_recipe()
    parts = [
        tiny_dataset(tmp_path / f"{name}.h5", only(recipe, name))
        for name in ("train", "valid")
    ]
    out = tmp_path / "out"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    for overwrite in (False, True):
        with pytest.raises(ConfigError, match=r"contains notes\.txt"):
            next(merge(parts, out, "both", overwrite))
    assert (out / "notes.txt").read_text() == "mine"
    (out / "notes.txt").unlink()
    both = run(parts, out)
    assert both.digest == run(parts, tmp_path / "both.h5").digest
    # Its files have the names that they came with.
    assert sorted(item.name for item in out.iterdir()) == [
        "manifest.json",
        "train.h5",
        "valid.h5",
    ]
    with pytest.raises(ConfigError, match="exists"):
        run(parts, out)
    for _ in merge(parts[::-1], out, "again", True):
        pass
    assert (TerrainDataset(out).id, list(TerrainDataset(out).splits)) == (
        "again",
        ["valid", "train"],
    )
    assert find_faults(out) == []
