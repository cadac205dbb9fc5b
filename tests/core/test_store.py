"""Files are written whole or not at all, by one process at a time."""

import fcntl
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.store import (
    building,
    check_replaceable,
    replace_folder,
    replacing,
    sole_writer,
    write_text,
)

HOLD = """
import sys, time
from pathlib import Path
from benchnav.core.store import sole_writer
with sole_writer(Path(sys.argv[1]), "it"):
    print("held", flush=True)
    time.sleep(60)
"""

# Each adds 1 to a number as often as it gets hold of it, with a pause between reading
# and writing.
COUNT = """
import sys, time
from pathlib import Path
from benchnav.core.errors import BenchnavError
from benchnav.core.store import sole_writer
path, done = Path(sys.argv[1]), 0
while done < 200:
    try:
        with sole_writer(path, "it"):
            number = int(path.read_text())
            time.sleep(0.0005)
            path.write_text(str(number + 1))
            done += 1
    except BenchnavError:
        time.sleep(0.0002)
"""


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "new" / "file"
    write_text(path, "first")
    with pytest.raises(RuntimeError), replacing(path) as partial:  # noqa: PT012
        partial.write_text("half")
        raise RuntimeError
    assert path.read_text() == "first"
    write_text(path, "second")
    assert path.read_text() == "second"
    assert [item.name for item in path.parent.iterdir()] == ["file"]


def test_a_folder_is_held_before_it_exists_and_nothing_stays_behind(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "runs" / "new"
    with sole_writer(folder, "the run"):
        assert not folder.exists()
        assert [item.name for item in folder.parent.iterdir()] == [".new.lock"]
        with (
            pytest.raises(BenchnavError, match="Another run is writing the run"),
            sole_writer(folder, "the run"),
        ):
            pass
    assert list(tmp_path.iterdir()) == []
    with sole_writer(folder, "the run"):
        pass


def test_a_folder_may_be_replaced_while_it_is_held(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with sole_writer(folder, "it"):
        folder.rename(tmp_path / "old")
        folder.mkdir()
        with pytest.raises(BenchnavError), sole_writer(folder, "it"):
            pass
        with sole_writer(tmp_path / "old", "another"):
            pass


def test_all_names_of_a_folder_have_one_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    (tmp_path / "link").symlink_to(folder)
    monkeypatch.chdir(folder)
    with sole_writer(folder, "it"):
        for name in (
            tmp_path / "link",
            Path("."),
            Path("../run"),
            tmp_path / "run/x/..",
        ):
            with pytest.raises(BenchnavError), sole_writer(name, "it"):
                pass


def test_an_error_within_frees_it(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), sole_writer(tmp_path / "run", "it"):
        raise RuntimeError
    with sole_writer(tmp_path / "run", "it"):
        pass


def test_a_killed_holder_frees_it(tmp_path: Path) -> None:
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path / "run")],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(BenchnavError), sole_writer(tmp_path / "run", "it"):
            pass
    finally:
        os.kill(holder.pid, signal.SIGKILL)
        holder.communicate()
    assert (tmp_path / ".run.lock").exists()
    with sole_writer(tmp_path / "run", "it"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_lock_that_is_removed_while_one_waits_for_it_is_not_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock, calls = tmp_path / ".run.lock", []
    flock = fcntl.flock

    def late(descriptor: int, how: int) -> None:
        calls.append(descriptor)
        if len(calls) == 1:
            lock.unlink()  # its holder leaves between our opening and our locking
        if len(calls) == 2:
            lock.unlink()  # and so does the next, after whom a third comes
            lock.touch()
        flock(descriptor, how)

    monkeypatch.setattr(fcntl, "flock", late)
    with sole_writer(tmp_path / "run", "it"):
        assert len(calls) == 3
        monkeypatch.setattr(fcntl, "flock", flock)
        with pytest.raises(BenchnavError), sole_writer(tmp_path / "run", "it"):
            pass


def test_racing_processes_never_hold_it_at_once(tmp_path: Path) -> None:
    number = tmp_path / "number"
    number.write_text("0")
    racers = [
        subprocess.Popen([sys.executable, "-c", COUNT, str(number)]) for _ in range(2)
    ]
    assert [racer.wait(timeout=120) for racer in racers] == [0, 0]
    assert number.read_text() == "400"
    assert [item.name for item in tmp_path.iterdir()] == ["number"]


def test_folders_that_were_made_for_nothing_are_removed(tmp_path: Path) -> None:
    with sole_writer(tmp_path / "a" / "b" / "run", "x"):
        assert (tmp_path / "a" / "b").is_dir()
    assert list(tmp_path.iterdir()) == []
    with sole_writer(tmp_path / "a" / "b" / "run", "x"):
        (tmp_path / "a" / "b" / "run").mkdir()
    assert (tmp_path / "a" / "b" / "run").is_dir()


def test_a_place_is_taken_by_what_is_no_output_always_and_else_unless_it_is_to_be_replaced(
    tmp_path: Path,
) -> None:
    def foreign(place: Path) -> str:
        return "holds notes" if (place / "notes").exists() else ""

    out = tmp_path / "out"
    for overwrite in (False, True):
        check_replaceable(out, overwrite, foreign)
    out.mkdir()
    check_replaceable(out, False, foreign)  # an empty folder is no loss
    (out / "made").touch()
    check_replaceable(out, True, foreign)
    with pytest.raises(ConfigError, match=r"exists\. Pass --overwrite"):
        check_replaceable(out, False, foreign)
    (out / "notes").touch()
    for overwrite in (False, True):
        with pytest.raises(
            ConfigError, match=r"out, which holds notes\. Choose another"
        ):
            check_replaceable(out, overwrite, foreign)


def test_a_folder_that_is_built_takes_its_place_or_goes(tmp_path: Path) -> None:
    out = tmp_path / "out"

    def stopped() -> None:
        with building(out) as folder:
            (folder / "half").touch()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped()
    assert list(tmp_path.iterdir()) == []
    with building(out) as folder:
        (folder / "left by a kill").touch()
        with building(out) as again:
            assert list(again.iterdir()) == []
            (again / "whole").touch()
            replace_folder(again, out)
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "whole"]
