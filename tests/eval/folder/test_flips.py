"""A flipped bit in any file of a run is found, or makes no difference."""

import random
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from benchnav.core.errors import ConfigError
from benchnav.eval.cli import _report
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import units
from benchnav.eval.folder.run_folder import (
    EPISODES,
    find_units,
    open_run,
    read_table,
    unit_rows,
)
from benchnav.eval.folder.sealed import metadata, read_sealed, with_metadata
from benchnav.eval.folder.steps import read_steps
from benchnav.eval.folder.verify import verify_run
from benchnav.eval.recording import GROUND, RecordedMap, Recording
from benchnav.eval.report.playback.viewer_file import write_viewer_files
from benchnav.eval.run.runner import run_suite
from tests.commands import call

FLIPS = 80  # of every file alike; the suite's share of the many that were tried by hand


@pytest.fixture(scope="module")
def suite(dataset_path: Path) -> Suite:
    return Suite(
        data=str(dataset_path), model="oracle", planners=("straight", "tests.eval.parts:Faulty"), risks=("mean",),
        scenarios=("std",), maps=2, world={"time_budget_s": 2.0}, record="first",
    )  # fmt: skip


@pytest.fixture(scope="module")
def run(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flips") / "run"
    list(run_suite(suite, folder))
    write_viewer_files(folder)
    _report(folder, folder)
    return folder


def everything(folder: Path) -> Iterator[Any]:
    """All that is read of a run."""
    known = open_run(folder)
    yield known.manifest
    yield read_table(folder, EPISODES)
    yield read_steps(folder)
    for unit in units(known.conditions):
        (finished,) = find_units(folder, unit) or [None]
        if finished is None or finished.damage():
            raise ConfigError("a unit is damaged")
        yield unit_rows(finished)
        yield dict(finished.metadata)
    for path in sorted((folder / "playback").glob("*.npz")):
        recording = Recording.load(path)
        yield recording.states, recording.predicted, recording.about
    ground = RecordedMap.load(folder / GROUND)
    yield ground.rgb, ground.field


def same(one: Any, other: Any) -> bool:
    if isinstance(one, pd.DataFrame):
        return one.equals(other)
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other)


def flip(path: Path, chance: random.Random) -> bytes:
    """Flip a bit of a file; gives what it held."""
    content = path.read_bytes()
    changed = bytearray(content)
    changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
    path.write_bytes(bytes(changed))
    return content


def test_a_whole_run_has_no_damage(run: Path) -> None:
    assert verify_run(run) == ([], [])


def test_a_flipped_bit_is_found_or_makes_no_difference(
    run: Path, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    whole = list(everything(copy))
    files = sorted(path for path in copy.rglob("*") if path.is_file())

    chance = random.Random(0)
    found = 0
    for _ in range(FLIPS):
        path = chance.choice(files)
        content = flip(path, chance)
        damage, _ = verify_run(copy)
        found += bool(damage)
        try:
            assert same(list(everything(copy)), whole), (
                f"{path} is read with other values"
            )
        except ConfigError:
            assert damage, f"{path} is refused, and not found damaged"
        if path.parts[-2] in ("figures", "playback") or path.name in (
            "report.html",
            "summary.csv",
        ):
            assert damage, f"{path} is not found damaged"
        path.write_bytes(content)
    assert found > 0.8 * FLIPS


@pytest.mark.parametrize(
    "kind", ["units/*/*.parquet", "steps/*/*.parquet", "playback/*.npz"]
)
def test_a_damaged_unit_is_run_again_with_one_line(
    kind: str, run: Path, suite: Suite, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    path = sorted(copy.glob(kind))[0]
    content = path.read_bytes()
    path.write_bytes(content[:-20] + bytes(20))
    lines: list[str] = []
    steps = list(run_suite(suite, copy, say=lines.append))
    assert (steps[0].done, steps[0].total) == (1, 2)
    (line,) = (line for line in lines if "damaged" in line)
    assert line.startswith("1 of 2 units are damaged and are run again; the first: ")
    assert str(path.relative_to(copy)) in line
    assert same(
        read_table(copy, EPISODES).filter(regex="^(?!planning|code)"),
        read_table(run, EPISODES).filter(regex="^(?!planning|code)"),
    )
    write_viewer_files(copy)
    _report(copy, copy)
    assert verify_run(copy) == ([], [])


def test_missing_files_and_units_of_another_run_are_told(
    run: Path, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    first, second = sorted(copy.glob("steps/*/*.parquet"))
    (copy / "summary.csv").unlink()
    damage, notes = verify_run(copy)
    assert damage == []
    count = len((run / "SHA256SUMS").read_text().splitlines())
    assert notes == [
        f"1 of {count} files in SHA256SUMS are missing; the first is summary.csv"
    ]
    shutil.copyfile(second, first)  # a whole file, of another unit
    unit = next(
        (copy / "units" / first.parent.name.removeprefix("condition=")).glob(
            "*.parquet"
        )
    )
    damage, _ = verify_run(copy)
    assert damage == []  # its key is another's, so that the unit lacks its steps
    unit.unlink()
    assert "1 of 2 units are not finished" in verify_run(copy)[1]


def test_steps_that_are_sealed_again_are_not_those_of_the_unit(
    run: Path, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    path = sorted(copy.glob("steps/*/*.parquet"))[0]
    changed = with_metadata(read_sealed(path).slice(1), {"key": metadata(path)["key"]})
    pq.write_table(changed, path)
    damage, _ = verify_run(copy)
    assert damage == [f"{path.relative_to(copy)}: it contains the steps of another run"]


def test_a_damaged_viewer_file_is_written_again(run: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    first, second = sorted(copy.glob("playback/*.rrd"))
    for path in (first, second):
        content = path.read_bytes()
        path.write_bytes(content[: len(content) // 2])
    assert len(verify_run(copy)[0]) == 2
    assert call("eval", "replay", copy, "--planner", "straight", "--view", "false") == 0
    assert len(verify_run(copy)[0]) == 1  # the episode that was asked for
    write_viewer_files(copy)
    assert verify_run(copy) == ([], [])
    for path in (first, second):
        assert path.stat().st_size > 0.9 * (run / path.relative_to(copy)).stat().st_size


def test_the_command_prints_what_is_damaged_and_ends_with_status_1(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    assert call("eval", "verify", copy) == 0
    assert capsys.readouterr().out == f"{copy}: no file is damaged\n"
    (copy / "summary.md").write_text("Everything arrived.")
    (copy / "run.json").write_text(
        (copy / "run.json").read_text().replace('"device": "cpu"', '"device": "gpu"')
    )
    assert call("eval", "verify", copy) == 1
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("damaged: run.json: ")
    assert "it was changed after benchnav wrote it" in line
    shutil.copyfile(run / "run.json", copy / "run.json")
    assert call("eval", "verify", copy) == 1
    assert (
        "damaged: summary.md: it was changed after benchnav wrote it\n"
        in capsys.readouterr().out
    )
    assert call("eval", "verify", tmp_path) == 2
