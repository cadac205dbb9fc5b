import os
import resource
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from benchnav.datagen.files.block import Block
from benchnav.datagen.files.check import find_faults
from benchnav.datagen.files.create import create
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.errors import BenchnavError, ConfigError, DatasetError
from tests.factories import tiny_dataset, tiny_recipe

ROOT = Path(__file__).parents[3]


def digests(path: Path) -> dict[str, str]:
    return {name: split["digest"] for name, split in TerrainDataset(path).splits.items()}


def creating(path: Path, train: int, jobs: int) -> subprocess.Popen[bytes]:
    code = (
        "from pathlib import Path; from tests.factories import tiny_recipe; "
        "from benchnav.datagen.files.create import create\n"
        f"for _ in create(tiny_recipe(train={train}), Path({str(path)!r}), jobs={jobs}, block_maps=20): pass"
    )
    return subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, start_new_session=True)


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
        for _ in create(recipe, path, jobs=jobs, block_maps=block):
            pass
        found.append(digests(path))
    assert found[0] == found[1] == found[2]
    assert len(set(found[0].values())) == 5


def test_an_existing_file_is_kept(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    before = path.read_bytes()
    with pytest.raises(DatasetError, match="exists"):
        tiny_dataset(path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_killed_run_leaves_no_file_and_no_process_and_keeps_its_blocks(tmp_path: Path, jobs: int) -> None:
    path = tmp_path / "d.h5"
    process = creating(path, 4000, jobs)
    folder = tmp_path / ".d.h5.partial"
    while len(list(folder.glob("*.block"))) < 4:
        time.sleep(0.02)
        assert process.poll() is None
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not path.exists()
    deadline = time.monotonic() + 20
    while alive(process.pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(process.pid)
    finished = {block: block.stat().st_mtime_ns for block in folder.glob("*.block")}
    steps = create(tiny_recipe(train=4000), path, block_maps=20)
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
    steps = create(recipe, broken, block_maps=4)
    assert [next(steps) for _ in range(3)] == [(0, 21), (4, 21), (8, 21)]
    steps.close()
    assert not broken.exists()
    kept = next((tmp_path / ".broken.h5.partial").glob("*.block"))
    content = bytearray(kept.read_bytes())
    content[len(content) // 2] ^= 1
    resumed = create(recipe, broken, block_maps=4)
    assert next(resumed) == (8, 21)
    resumed.close()
    # A block that the disk did not keep whole is made again.
    kept.write_bytes(content)
    assert not Block.is_whole(kept)
    for path in (broken, whole):
        for _ in create(recipe, path, block_maps=4):
            pass
    assert digests(broken) == digests(whole)
    assert find_faults(broken) == []
    assert sorted(p.name for p in tmp_path.iterdir()) == ["broken.h5", "whole.h5"]


def test_blocks_of_another_recipe_are_dropped(tmp_path: Path) -> None:
    path = tmp_path / "d.h5"
    steps = create(tiny_recipe(), path, block_maps=4)
    next(steps)
    next(steps)
    steps.close()
    other = replace(tiny_recipe(), seed=3)
    for _ in create(other, path, block_maps=4):
        pass
    assert digests(path) == digests(tiny_dataset(tmp_path / "other.h5", other))


def test_two_runs_on_one_file_refuse_each_other(tmp_path: Path) -> None:
    path = tmp_path / "d.h5"
    first = create(tiny_recipe(), path, block_maps=4)
    next(first)
    with pytest.raises(BenchnavError, match="Another run"):
        next(create(tiny_recipe(), path, block_maps=4))
    first.close()


@pytest.mark.parametrize("room", [2_000, 30_000, 150_000, 280_000, 330_000])
def test_a_full_disk_is_named_and_leaves_no_half_file(tmp_path: Path, room: int) -> None:
    path = tmp_path / "d.h5"
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        # No file may grow beyond this: writing fails as on a full disk.
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
        with pytest.raises(DatasetError, match=r"Could not write .*d\.h5"):
            for _ in create(tiny_recipe(), path, block_maps=4):
                pass
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert not path.exists()
    left = {item.suffix for item in (tmp_path / ".d.h5.partial").iterdir()}
    assert left <= {".block", ".json", ""}
    assert digests(tiny_dataset(path)) == digests(tiny_dataset(tmp_path / "whole.h5"))


def test_an_error_in_a_worker_is_the_runs_error(tmp_path: Path) -> None:
    recipe = replace(tiny_recipe(), stuck_threshold=0.999)
    with pytest.raises(ConfigError, match="goal can be reached"):
        for _ in create(recipe, tmp_path / "d.h5", jobs=2):
            pass
    assert not list(tmp_path.iterdir())


def test_a_file_that_another_run_finished_meanwhile_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "d.h5"
    late = create(tiny_recipe(), path, jobs=2)  # has asked nothing yet
    tiny_dataset(path, tiny_recipe(train=9))
    before = path.read_bytes()
    with pytest.raises(DatasetError, match="exists"):
        next(late)
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["d.h5"]
    with pytest.raises(DatasetError, match="got the folder"):
        next(create(tiny_recipe(), tmp_path, overwrite=True))
