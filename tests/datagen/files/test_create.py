import os
import resource
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchnav.core.errors import BenchnavError, ConfigError, DatasetError
from benchnav.core.store import Shard
from benchnav.datagen.files.check import find_faults
from benchnav.datagen.files.create import create
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.recipe import Recipe
from tests.factories import tiny_dataset, tiny_recipe

ROOT = Path(__file__).parents[3]
CELLS = 32 * 32  # of a map of the tiny recipe


def digests(path: Path) -> dict[str, str]:
    return {
        name: split["digest"] for name, split in TerrainDataset(path).splits.items()
    }


def creating(path: Path, train: int, jobs: int) -> subprocess.Popen[bytes]:
    code = (
        "from pathlib import Path; from tests.factories import tiny_recipe; "
        "from benchnav.datagen.files.create import create\n"
        f"for _ in create(tiny_recipe(train={train}), Path({str(path)!r}), jobs={jobs}, shard_cells={20 * CELLS}): pass"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code], cwd=ROOT, start_new_session=True
    )


def alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_digest_does_not_depend_on_workers_or_blocks(tmp_path: Path) -> None:
    recipe = tiny_recipe(train=13)
    found = []
    for name, jobs, block in (("a", 1, 100), ("b", 2, 3), ("c", 1, 5)):
        path = tmp_path / f"{name}.h5"
        for _ in create(recipe, path, jobs=jobs, shard_cells=block * CELLS):
            pass
        found.append(digests(path))
    assert found[0] == found[1] == found[2]
    assert len(set(found[0].values())) == 5


def test_an_existing_file_is_kept(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    before = path.read_bytes()
    with pytest.raises(ConfigError, match="exists"):
        tiny_dataset(path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_killed_run_leaves_no_file_and_no_process_and_keeps_its_shards(
    tmp_path: Path, jobs: int
) -> None:
    path = tmp_path / "d.h5"
    process = creating(path, 4000, jobs)
    folder = tmp_path / ".d.h5.partial"
    while len(list(folder.glob("*.h5"))) < 4:
        time.sleep(0.02)
        assert process.poll() is None
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not path.exists()
    deadline = time.monotonic() + 20
    while alive(process.pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(process.pid)
    finished = {block: block.stat().st_mtime_ns for block in folder.glob("*.h5")}
    steps = create(tiny_recipe(train=4000), path, shard_cells=20 * CELLS)
    for _ in range(len(finished) - jobs):
        done, total = next(steps)
        assert total == 4009
        assert done >= 20 * len(finished)
    # Not carried to the end here; the kept blocks stand untouched.
    steps.close()
    assert all(block.stat().st_mtime_ns == when for block, when in finished.items())


def test_a_resumed_run_has_the_digest_of_an_unbroken_one(tmp_path: Path) -> None:
    recipe = tiny_recipe(train=12)
    broken, whole = tmp_path / "broken.h5", tmp_path / "whole.h5"
    steps = create(recipe, broken, shard_cells=4 * CELLS)
    assert [next(steps) for _ in range(3)] == [(0, 21), (4, 21), (8, 21)]
    steps.close()
    assert not broken.exists()
    kept = next((tmp_path / ".broken.h5.partial").glob("*.h5"))
    resumed = create(recipe, broken, shard_cells=4 * CELLS)
    assert next(resumed) == (8, 21)
    resumed.close()
    # A shard that is not whole is made again.
    kept.write_bytes(kept.read_bytes()[:1000])
    resumed = create(recipe, broken, shard_cells=4 * CELLS)
    assert next(resumed) == (4, 21)
    resumed.close()
    for path in (broken, whole):
        for _ in create(recipe, path, shard_cells=4 * CELLS):
            pass
    assert digests(broken) == digests(whole)
    assert find_faults(broken) == []
    assert sorted(p.name for p in tmp_path.iterdir()) == ["broken.h5", "whole.h5"]


def test_blocks_of_another_recipe_are_dropped(tmp_path: Path) -> None:
    path = tmp_path / "d.h5"
    steps = create(tiny_recipe(), path, shard_cells=4 * CELLS)
    next(steps)
    next(steps)
    steps.close()
    other = replace(tiny_recipe(), seed=3)
    for _ in create(other, path, shard_cells=4 * CELLS):
        pass
    assert digests(path) == digests(tiny_dataset(tmp_path / "other.h5", other))


def test_two_runs_on_one_file_refuse_each_other(tmp_path: Path) -> None:
    path = tmp_path / "d.h5"
    first = create(tiny_recipe(), path, shard_cells=4 * CELLS)
    next(first)
    with pytest.raises(BenchnavError, match="Another run"):
        next(create(tiny_recipe(), path, shard_cells=4 * CELLS))
    first.close()


@pytest.mark.parametrize("room", [2_000, 30_000, 150_000, 280_000, 330_000])
def test_a_full_disk_is_named_and_leaves_no_half_file(
    tmp_path: Path, room: int
) -> None:
    path = tmp_path / "d.h5"
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        # No file may grow beyond this: writing fails as on a full disk.
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
        with pytest.raises(DatasetError, match=r"Could not write .*d\.h5"):
            for _ in create(tiny_recipe(), path, shard_cells=4 * CELLS):
                pass
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert not path.exists()
    left = {item.suffix for item in (tmp_path / ".d.h5.partial").iterdir()}
    assert left <= {".h5", ""}
    assert digests(tiny_dataset(path)) == digests(tiny_dataset(tmp_path / "whole.h5"))


def test_an_error_in_a_worker_is_the_runs_error(tmp_path: Path) -> None:
    recipe = replace(tiny_recipe(), stuck_threshold=0.999)
    with pytest.raises(ConfigError, match="goal that can be reached"):
        for _ in create(recipe, tmp_path / "d.h5", jobs=2):
            pass
    assert not list(tmp_path.iterdir())


def test_a_file_that_another_run_finished_meanwhile_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "d.h5"
    late = create(tiny_recipe(), path, jobs=2)  # has asked nothing yet
    tiny_dataset(path, tiny_recipe(train=9))
    before = path.read_bytes()
    with pytest.raises(ConfigError, match="exists"):
        next(late)
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["d.h5"]
    with pytest.raises(ConfigError, match="contains d"):
        next(create(tiny_recipe(), tmp_path, overwrite=True))
    assert path.exists()


def make(path: Path, recipe: Recipe | None = None, **how: Any) -> Path:
    for _ in create(recipe or tiny_recipe(), path, **{"shard_cells": 3 * CELLS, **how}):
        pass
    return path


def test_a_folder_of_shards_holds_what_a_file_does(tmp_path: Path) -> None:
    folder, file = (
        TerrainDataset(make(tmp_path / "d")),
        TerrainDataset(make(tmp_path / "d.h5")),
    )
    assert folder.digest == file.digest
    assert folder.manifest["format_version"] == "1.2"
    assert file.manifest["format_version"] == "1.0"
    assert [piece.maps for piece in folder.pieces["train"]] == [3, 3, 2]
    for indices in (None, [7, 0, 3, 3], [], [2], range(2, 7)):
        for name, values in folder.read("train", indices).items():
            np.testing.assert_array_equal(values, file.read("train", indices)[name])
        np.testing.assert_array_equal(
            folder.entry_digests("train", indices), file.entry_digests("train", indices)
        )
    for dataset in (folder, file):
        chunks = list(dataset.chunks("train", ["class_id"], cells=5 * CELLS))
        assert [list(indices) for indices, _ in chunks] == [[0, 1, 2, 3, 4], [5, 6, 7]]
        joined = np.concatenate([maps["class_id"] for _, maps in chunks])
        np.testing.assert_array_equal(joined, file.read("train")["class_id"])
    assert find_faults(tmp_path / "d") == []


def test_shares_of_a_folder_are_made_by_any_number_of_processes(tmp_path: Path) -> None:
    whole = make(tmp_path / "whole")
    path = tmp_path / "d"
    made = []
    for index in (2, 1, 3):
        steps = list(
            create(
                tiny_recipe(),
                path,
                shard=Shard(index=index, of=3),
                shard_cells=3 * CELLS,
            )
        )
        made.append(steps[-1][1])
        assert (path / "manifest.json").exists() == (index == 3)
    assert sum(made) == 17
    assert max(made) < 10
    assert TerrainDataset(path).manifest == TerrainDataset(whole).manifest


def test_only_one_process_makes_a_share(tmp_path: Path) -> None:
    first, second = Shard(index=1, of=2), Shard(index=2, of=2)
    steps = create(tiny_recipe(), tmp_path / "d", shard=first, shard_cells=3 * CELLS)
    next(steps)
    make(tmp_path / "d", shard=second)
    with pytest.raises(BenchnavError, match="Another run"):
        make(tmp_path / "d", shard=first)
    steps.close()
    make(tmp_path / "d", shard=first)
    assert TerrainDataset(tmp_path / "d").map_count("train") == 8


def test_a_folder_that_holds_anything_else_is_left_alone(tmp_path: Path) -> None:
    folder = make(tmp_path / "d")
    before = {file: file.read_bytes() for file in folder.iterdir()}
    for how in ({}, {"overwrite": True}):
        other = replace(tiny_recipe(), seed=3)
        (folder / "notes.txt").write_text("mine")
        with pytest.raises(ConfigError, match=r"contains notes\.txt"):
            make(folder, other, **how)
        (folder / "notes.txt").unlink()
    with pytest.raises(
        ConfigError, match=r"and this version, got .*\.h5, which differs"
    ):
        make(folder, replace(tiny_recipe(), seed=3))
    assert {file: file.read_bytes() for file in folder.iterdir()} == before
    make(folder, replace(tiny_recipe(), seed=3), overwrite=True)
    assert digests(folder) == digests(
        tiny_dataset(tmp_path / "o.h5", replace(tiny_recipe(), seed=3))
    )
    with pytest.raises(ConfigError, match="folder if `shard` is given"):
        make(tmp_path / "e.h5", shard=Shard(index=1, of=2))


def test_a_cluster_makes_the_same_maps(tmp_path: Path) -> None:
    from distributed import LocalCluster

    with LocalCluster(
        2, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None
    ) as cluster:
        make(tmp_path / "d.h5", scheduler=cluster.scheduler_address)
    assert digests(tmp_path / "d.h5") == digests(tiny_dataset(tmp_path / "here.h5"))
    with pytest.raises(ConfigError, match="did not answer"):
        make(tmp_path / "e.h5", scheduler="tcp://127.0.0.1:9")


@pytest.mark.parametrize("name", ["d.h5", "d.hdf5", "d", "d.v2"])
def test_the_name_tells_a_file_from_a_folder(tmp_path: Path, name: str) -> None:
    path = make(tmp_path / name)
    assert path.is_file() == (name in ("d.h5", "d.hdf5"))
    assert TerrainDataset(path).map_count("train") == 8


def test_a_finished_folder_is_there_until_what_replaces_it_is_whole(
    tmp_path: Path,
) -> None:
    path, other = make(tmp_path / "d"), replace(tiny_recipe(), seed=3)
    before = digests(path)
    steps = create(other, path, overwrite=True, shard_cells=3 * CELLS)
    assert [next(steps)[0] for _ in range(3)] == [0, 3, 6]
    steps.close()
    assert digests(path) == before
    assert find_faults(path) == []
    steps = create(other, path, overwrite=True, shard_cells=3 * CELLS)
    assert next(steps)[0] == 6  # goes on
    for _ in steps:
        pass
    assert digests(path) == digests(tiny_dataset(tmp_path / "o.h5", other)) != before
    assert sorted(item.name for item in tmp_path.iterdir()) == ["d", "o.h5"]
    with pytest.raises(ConfigError, match="Remove the dataset first"):
        make(path, shard=Shard(index=1, of=2), overwrite=True)
    assert find_faults(path) == []


@pytest.mark.parametrize(
    "name",
    ["notes.txt", ".git", "maps.h5", "radar-20240101-20240131.h5", "manifest.json"],
)
def test_a_folder_with_a_file_of_a_user_is_never_replaced(
    tmp_path: Path, name: str
) -> None:
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / name).write_text("mine")
    for overwrite in (False, True):
        with pytest.raises(ConfigError, match="contains"):
            make(tmp_path / "d", overwrite=overwrite)
    assert (tmp_path / "d" / name).read_text() == "mine"


def begun(path: Path, recipe: Recipe, share: int, overwrite: bool = False) -> Any:
    """The making of a share of two that has looked at what is there, and has made
    nothing yet.
    """
    steps = create(
        recipe,
        path,
        shard=Shard(index=share, of=2),
        overwrite=overwrite,
        shard_cells=3 * CELLS,
    )
    next(steps)
    return steps


def finish(*making: Any) -> None:
    for steps in making:
        for _ in steps:
            pass


def test_unlike_shares_that_are_made_at_once_are_no_dataset(tmp_path: Path) -> None:
    path, recipe = tmp_path / "d", tiny_recipe()
    one, other = begun(path, recipe, 1), begun(path, replace(recipe, seed=3), 2)
    with pytest.raises(
        ConfigError, match=r"and this version, got .*\.h5, which differs"
    ):
        finish(one, other)
    assert not (path / "manifest.json").exists()
    finish(begun(path, recipe, 2, overwrite=True))
    assert digests(path) == digests(tiny_dataset(tmp_path / "o.h5", recipe))


def test_shares_replace_their_own_shards_alone(tmp_path: Path) -> None:
    path, recipe = tmp_path / "d", replace(tiny_recipe(), seed=3)
    finish(begun(path, tiny_recipe(), 1))
    of_first = sorted(path.iterdir())
    make(path)
    (path / "manifest.json").unlink()
    every = sorted(path.iterdir())
    one = begun(path, recipe, 1, overwrite=True)
    assert sorted(path.iterdir()) == [file for file in every if file not in of_first]
    other = begun(path, recipe, 2, overwrite=True)
    assert list(path.iterdir()) == []
    finish(one, other)
    assert digests(path) == digests(tiny_dataset(tmp_path / "o.h5", recipe))


def test_a_share_keeps_out_who_makes_the_whole(tmp_path: Path) -> None:
    path = tmp_path / "d"
    one = begun(path, tiny_recipe(), 1)
    for share in (None, Shard(index=1, of=2)):
        with pytest.raises(BenchnavError, match="Another run"):
            make(path, shard=share, overwrite=True)
    other = begun(path, tiny_recipe(), 2)
    finish(one, other)
    assert find_faults(path) == []
    assert [item.name for item in tmp_path.iterdir()] == ["d"]


def test_a_kill_while_a_new_folder_takes_its_place_loses_neither(
    tmp_path: Path,
) -> None:
    path, dropped = make(tmp_path / "d"), tmp_path / ".d.dropped"
    before = digests(path)
    path.rename(dropped)
    with pytest.raises(ConfigError, match="exists"):
        make(path)
    assert digests(path) == before
    dropped.mkdir()
    (dropped / "left.h5").write_text("of a kill while it was removed")
    make(path, recipe=replace(tiny_recipe(), seed=3), overwrite=True)
    assert digests(path) != before
    assert [item.name for item in tmp_path.iterdir()] == ["d"]


def test_a_link_stays_a_link_to_the_disk_that_it_leads_to(tmp_path: Path) -> None:
    disk, path = tmp_path / "disk", tmp_path / "d"
    disk.mkdir()
    path.symlink_to(disk / "d", target_is_directory=True)
    make(path)
    before = digests(path)
    make(path, recipe=replace(tiny_recipe(), seed=3), overwrite=True)
    assert digests(disk / "d") == digests(path) != before
    assert path.is_symlink()


def test_a_folder_of_a_damaged_manifest_is_replaced(tmp_path: Path) -> None:
    path = make(tmp_path / "d")
    (path / "manifest.json").write_text("{broken")
    with pytest.raises(ConfigError, match="--overwrite"):
        make(path)
    make(path, overwrite=True)
    assert find_faults(path) == []


def test_a_refusal_keeps_what_was_made_so_far(tmp_path: Path) -> None:
    path, other = tiny_dataset(tmp_path / "d.h5"), replace(tiny_recipe(), seed=3)
    steps = create(other, path, overwrite=True, shard_cells=3 * CELLS)
    assert [next(steps)[0] for _ in range(3)] == [0, 3, 6]
    steps.close()
    with pytest.raises(ConfigError, match="exists"):
        make(path, recipe=other)
    steps = create(other, path, overwrite=True, shard_cells=3 * CELLS)
    assert next(steps)[0] == 6
    steps.close()


def test_what_is_put_into_a_folder_while_it_is_replaced_is_kept(tmp_path: Path) -> None:
    path = make(tmp_path / "d")
    before = digests(path)
    steps = create(
        replace(tiny_recipe(), seed=3), path, overwrite=True, shard_cells=3 * CELLS
    )
    next(steps)
    (path / "notes.txt").write_text("mine")
    with pytest.raises(ConfigError, match=r"contains notes\.txt"):
        finish(steps)
    assert (path / "notes.txt").read_text() == "mine"
    assert digests(path) == before


def test_the_folder_that_one_stands_in_may_be_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "d").mkdir()
    monkeypatch.chdir(tmp_path / "d")
    make(Path())
    assert find_faults(tmp_path / "d") == []
