"""Shards that are merged are the run of one process, and nothing that is no such run is
made.
"""

import json
import multiprocessing
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from benchnav.core.errors import ConfigError
from benchnav.core.store import Shard
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.folder.run_folder import caveats, open_run, read_table, write_run
from benchnav.eval.folder.sealed import metadata, with_metadata
from benchnav.eval.folder.steps import read_steps
from benchnav.eval.run import merge
from benchnav.eval.run.merge import merge_shards
from benchnav.eval.run.runner import run_suite
from tests.commands import call

OF = 3
KEYS = ["condition", "seed", "realisation", "map"]
BAD = {"part": "tests.eval.parts:Faulty", "label": "bad", "options": {"fault": "raise"}}


@pytest.fixture(scope="module")
def suite(dataset_path: Path) -> Suite:
    """12 units of planners that need no time, of which one fails."""
    return Suite(
        data=str(dataset_path), model="oracle", planners=("tests.eval.parts:Faulty", BAD), risks=("mean",),
        scenarios=("std", "hs"), maps=2, seeds=(0, 1, 2), world={"noise": "stored", "time_budget_s": 30.0},
    )  # fmt: skip


@pytest.fixture(scope="module")
def whole(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of one process."""
    return finish(suite, tmp_path_factory.mktemp("whole") / "run")


@pytest.fixture(scope="module")
def made(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Its shards; to be copied by those who change them."""
    folder = tmp_path_factory.mktemp("shards")
    return [
        finish(suite, folder / f"part{i}", Shard(index=i, of=OF))
        for i in range(1, OF + 1)
    ]


@pytest.fixture
def parts(made: list[Path], tmp_path: Path) -> list[Path]:
    """The shards, one's own."""
    return [shutil.copytree(part, tmp_path / part.name) for part in made]


def finish(suite: Suite, folder: Path, shard: Shard | None = None) -> Path:
    list(run_suite(suite, folder, shard=shard))
    return folder


def killed_after(count: int, steps: Callable[[], Iterator[tuple[int, int]]]) -> None:
    """Takes steps in a process that then is killed."""

    def begin() -> None:
        for number, _ in enumerate(steps(), start=1):
            if number == count:
                os.kill(os.getpid(), signal.SIGKILL)

    process = multiprocessing.get_context("fork").Process(target=begin)
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL


def same(one: Path, other: Path) -> None:
    """Asserts that two runs have the same rows in the same order, steps, faults and
    recordings.
    """
    first, second = (pd.read_parquet(run / "episodes.parquet") for run in (one, other))
    assert not second.duplicated(KEYS).any()
    pd.testing.assert_frame_equal(
        *(
            rows[[c for c in rows if not c.startswith("planning_")]]
            for rows in (first, second)
        )
    )
    pd.testing.assert_frame_equal(*(read_steps(run) for run in (one, other)))
    assert (one / "errors.txt").read_text() == (other / "errors.txt").read_text()
    recordings = [
        sorted(path.name for path in (run / "playback").glob("*"))
        for run in (one, other)
    ]
    assert recordings[0] == recordings[1] != []


def test_merged_shards_are_the_run_of_one_process(
    whole: Path, parts: list[Path], tmp_path: Path
) -> None:
    counts = [len(list(part.glob("units/*/*.parquet"))) for part in parts]
    assert sum(counts) == 12
    assert min(counts) > 0
    # In any order of the parts.
    steps = list(merge_shards([parts[1], parts[2], parts[0]], tmp_path / "all"))
    assert (steps[0], steps[-1]) == ((0, 12), (12, 12))
    same(whole, tmp_path / "all")
    first, merged = open_run(whole), open_run(tmp_path / "all")
    assert merged.shard is None
    assert merged.conditions == first.conditions
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "all",
        *(part.name for part in parts),
    ]


def test_planning_times_of_several_machines_are_warned_of(
    parts: list[Path], tmp_path: Path
) -> None:
    runs = [open_run(part) for part in parts]
    assert merge._about(runs)["warnings"] == runs[0].manifest["warnings"]
    other = {**runs[0].manifest["machine"], "processor": "Abacus", "host": "elsewhere"}
    write_run(parts[1], {**runs[1].manifest, "machine": other})
    list(merge_shards(parts, tmp_path / "all"))
    (line,) = [
        line
        for line in caveats(open_run(tmp_path / "all").manifest)
        if "planning times" in line
    ]
    assert line.startswith("warning: the shards ran on 2 machines (")
    assert "Abacus with " in line


def test_a_merged_run_is_gone_on_with_and_extended(
    suite: Suite, parts: list[Path], tmp_path: Path
) -> None:
    list(merge_shards(parts, tmp_path / "all"))
    before = {
        path: path.stat().st_mtime_ns for path in (tmp_path / "all").glob("units/*/*")
    }
    said: list[str] = []
    list(run_suite(suite, tmp_path / "all", say=said.append))
    assert said == ["12 of 12 units were already finished"]
    longer = replace(suite, seeds=(0, 1, 2, 3))
    finish(longer, tmp_path / "all")
    assert {path: path.stat().st_mtime_ns for path in before} == before
    same(finish(longer, tmp_path / "fresh"), tmp_path / "all")


def test_shards_that_are_killed_and_extended_are_the_extended_run(
    suite: Suite, tmp_path: Path
) -> None:
    longer = replace(suite, seeds=(0, 1, 2, 3), scenarios=("std",))
    shards = [Shard(index=i, of=2) for i in (1, 2)]
    folders = [tmp_path / "one", tmp_path / "two"]
    finish(replace(longer, seeds=(0, 1)), folders[0], shards[0])
    kept = {path: path.stat().st_mtime_ns for path in folders[0].glob("units/*/*")}
    killed_after(2, lambda: run_suite(longer, folders[1], shard=shards[1]))
    for folder, shard in zip(folders, shards, strict=True):
        finish(longer, folder, shard)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    list(merge_shards(folders, tmp_path / "all"))
    same(finish(longer, tmp_path / "fresh"), tmp_path / "all")


def test_a_shard_has_rows_and_no_tables(parts: list[Path]) -> None:
    part = parts[0]
    assert open_run(part).shard == Shard(index=1, of=OF)
    assert {path.name for path in part.iterdir()} <= {
        "run.json", "units", "steps", "playback", "errors.txt", "SHA256SUMS"
    }  # fmt: skip
    with pytest.raises(
        ConfigError, match=r"shard 1/3 and has no tables.*benchnav-eval merge"
    ):
        read_table(part, "episodes.parquet")


@pytest.mark.parametrize("other", [None, Shard(index=2, of=OF), Shard(index=1, of=2)])
def test_a_folder_holds_one_shard(
    suite: Suite, parts: list[Path], other: Shard | None
) -> None:
    with pytest.raises(ConfigError, match="contains shard 1/3"):
        finish(suite, parts[0], other)


def test_a_whole_run_is_no_shard(
    suite: Suite, whole: Path, parts: list[Path], tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match="contains an unsharded run"):
        finish(suite, whole, Shard(index=1, of=OF))
    with pytest.raises(ConfigError, match="which is not a shard"):
        list(merge_shards([*parts, whole], tmp_path / "all"))


def test_a_shard_without_units_is_not_needed(suite: Suite, tmp_path: Path) -> None:
    small = replace(suite, planners=(BAD,), scenarios=("std",), seeds=(0,))
    said: list[str] = []
    folders = [tmp_path / f"part{i}" for i in (1, 2)]
    for i, folder in enumerate(folders, start=1):
        steps = [
            tuple(step)
            for step in run_suite(
                small, folder, shard=Shard(index=i, of=2), say=said.append
            )
        ]
        assert steps in ([], [(0, 1), (1, 1)])
    full = [folder for folder in folders if (folder / "units").exists()]
    assert len(full) == 1
    (line,) = [one for one in said if "measuring" not in one]
    assert line.endswith(" contains none of the 1 units")
    assert len(said) == 2
    list(merge_shards(full, tmp_path / "all"))
    assert len(pd.read_parquet(tmp_path / "all" / "episodes.parquet")) == 2


def test_missing_units_are_told_with_their_shards(
    parts: list[Path], tmp_path: Path
) -> None:
    gone = next(parts[2].glob("units/*/*.parquet"))
    gone.unlink()
    count = len(list(parts[1].glob("units/*/*")))
    for given, expected in (
        (
            [parts[0], parts[2]],
            rf"got shards without {count} units of shard 2/3, 1 unit of shard 3/3 in .*part3",
        ),
        (parts, r"got shards without 1 unit of shard 3/3 in .*part3"),
    ):
        with pytest.raises(ConfigError, match=expected):
            list(merge_shards(given, tmp_path / "all"))
    assert not (tmp_path / "all").exists()


def change_run(part: Path, change: Callable[[dict], None]) -> None:  # type: ignore[type-arg]
    about = json.loads((part / "run.json").read_text())
    change(about)
    write_run(part, about)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda about: next(iter(about["datasets"].values()))["maps"]["test/hs"].reverse(), "maps of .* test/hs"),
        (lambda about: about["shard"].update(of=4), "number of shards"),
        (lambda about: about["conditions"].popitem(), "missing in .*hs .*bad"),
        (
            lambda about: [(t["draws"].pop(), t["seeds"].pop()) for t in about["conditions"].values()],
            "seeds, realisations or maps",
        ),
        (lambda about: [t["labels"].update(risk="other") for t in about["conditions"].values()], "labels"),
    ],
)  # fmt: skip
def test_shards_of_other_runs_are_refused_by_what_differs(
    change: Callable[[dict], None],  # type: ignore[type-arg]
    expected: str,
    parts: list[Path],
    tmp_path: Path,
) -> None:
    change_run(parts[1], change)
    with pytest.raises(ConfigError, match=rf"part2.*{expected}"):
        list(merge_shards(parts, tmp_path / "all"))
    assert not (tmp_path / "all").exists()


@pytest.mark.parametrize(
    ("group", "name", "value", "expected"),
    [
        ("modules", "benchnav.eval.run.unit", "0", r"benchnav\.eval\.run\.unit"),
        ("environment", "torch", "9.9", r"torch \(.* to 9\.9\)|torch \(9\.9 to .*\)"),
        ("environment", "processor", "ABACUS", "processor"),
        ("environment", "planner_limit_s", 5.0, "planner_limit_s"),
        ("environment", "device", "cuda", "device"),
        (
            "parts",
            "planner tests.eval.parts:Faulty",
            "0",
            "planner tests.eval.parts:Faulty",
        ),
    ],
)
def test_shards_that_other_code_made_are_refused_by_what_differs(
    group: str, name: str, value: Any, expected: str, parts: list[Path], tmp_path: Path
) -> None:
    path = next(parts[1].glob("units/*/*.parquet"))
    about = metadata(path)
    about["code"][group][name] = value
    pq.write_table(with_metadata(pq.read_table(path, partitioning=None), about), path)
    with pytest.raises(
        ConfigError,
        match=rf"Expected all shards to be run with the same code, got .*, which differ in ({expected})",
    ):
        list(merge_shards(parts, tmp_path / "all"))
    assert not (tmp_path / "all").exists()


def test_a_unit_may_be_there_twice_if_it_is_the_same(
    whole: Path, parts: list[Path], tmp_path: Path
) -> None:
    again = shutil.copytree(parts[0], tmp_path / "again")
    unit = next(again.glob("units/*/*.parquet"))
    table = pq.read_table(unit, partitioning=None)
    later = table.set_column(
        table.schema.get_field_index("planning_ms"),
        "planning_ms",
        pa.array([1e6] * len(table)),
    )
    pq.write_table(with_metadata(later, metadata(unit)), unit)
    list(merge_shards([*parts, again], tmp_path / "all"))
    same(whole, tmp_path / "all")
    other = table.set_column(
        table.schema.get_field_index("score"), "score", pa.array([0.25] * len(table))
    )
    pq.write_table(with_metadata(other, metadata(unit)), unit)
    with pytest.raises(
        ConfigError,
        match=rf"{unit.stem.rpartition('-')[0]} .* rows differ between .*part1.* and .*again",
    ):
        list(merge_shards([*parts, again], tmp_path / "all2"))


def test_a_merge_that_is_killed_leaves_nothing_and_can_be_given_again(
    whole: Path, parts: list[Path], tmp_path: Path
) -> None:
    killed_after(6, lambda: merge_shards(parts, tmp_path / "all"))
    assert not (tmp_path / "all").exists()
    list(merge_shards(parts, tmp_path / "all"))
    same(whole, tmp_path / "all")
    assert not list(tmp_path.glob(".*"))


def test_a_folder_that_is_there_is_not_merged_into(parts: list[Path]) -> None:
    before = sorted(parts[0].rglob("*"))
    with pytest.raises(ConfigError, match="a new folder as OUT"):
        list(merge_shards(parts[1:], parts[0]))
    assert sorted(parts[0].rglob("*")) == before


def test_the_commands(  # type: ignore[no-untyped-def]
    dataset_path: Path, tmp_path: Path, capsys
) -> None:
    def told(*words: str) -> tuple[int, str, str]:
        status, captured = call("eval", *words), capsys.readouterr()
        return status, captured.out, captured.err

    run = (
        "run", "--data", str(dataset_path), "--model", "oracle", "--planners", "[tests.eval.parts:Faulty]",
        "--risks", "[mean]", "--scenarios", "[std,hs]", "--maps", "2", "--world.time_budget_s", "30",
        "--realisations", "2",
    )  # fmt: skip
    out = [str(tmp_path / name) for name in ("one", "two", "all")]
    for index, folder in enumerate(out[:2], start=1):
        status, printed, _ = told(*run, "--shard", f"{index}/2", "--out", folder)
        assert status == 0
        assert f"shard {index}/2 is finished" in printed
    status, _, error = told("report", out[0])
    assert (status, len(error.splitlines())) == (2, 1)
    assert "shard 1/2" in error
    status, printed, _ = told("merge", out[2], *out[:2])
    assert status == 0
    assert "Faulty" in printed
    assert (Path(out[2]) / "summary.md").exists()
    commands = open_run(Path(out[2])).manifest["history"]
    assert [entry["command"].split()[1] for entry in commands] == [
        "run",
        "run",
        "merge",
    ]
    assert told("report", out[2])[0] == 0
    assert told(*run, "--shard", "3/2", "--out", out[0])[0] == 2
    assert told("merge", out[2])[0] == 2
    # A shard in which a part failed says so.
    bad = ["{part: tests.eval.parts:Faulty, options: {fault: raise}}"]
    status, _, error = told(
        *run,
        "--planners",
        f"[{bad[0]}]",
        "--shard",
        "1/1",
        "--out",
        str(tmp_path / "bad"),
    )
    assert status == 1
    assert "errors.txt" in error


def test_shards_of_one_suite_share_their_hypotheses(
    suite: Suite, parts: list[Path], tmp_path: Path
) -> None:
    claim = {
        "one": {"planner": "bad"},
        "other": {"planner": "Faulty"},
        "metric": "success",
        "direction": "lower",
    }
    shard = Shard(index=2, of=OF)
    parts[1] = finish(
        replace(suite, hypotheses=(claim,)), tmp_path / "other" / "part2", shard
    )
    with pytest.raises(ConfigError, match="part2: hypotheses"):
        list(merge_shards(parts, tmp_path / "all"))


def test_damaged_units_and_parts_that_read_something_else_are_not_merged(
    parts: list[Path], tmp_path: Path
) -> None:
    unit = sorted(parts[1].glob("units/*/*.parquet"))[-1]
    table, about = pq.read_table(unit, partitioning=None), metadata(unit)
    others = list(parts[0].glob("units/*/*.parquet"))
    for path in others:
        read = {**metadata(path), "touched": {"file a.npz": "1"}}
        pq.write_table(
            with_metadata(pq.read_table(path, partitioning=None), read), path
        )
    pq.write_table(
        with_metadata(table, {**about, "touched": {"file a.npz": "2"}}), unit
    )
    with pytest.raises(
        ConfigError,
        match=r"same files, packages and environment variables, got .*part\d.*differs .* in file a\.npz\. Run",
    ):
        list(merge_shards(parts, tmp_path / "all"))
    scores = pa.array([0.25] * len(table))
    pq.write_table(
        table.set_column(table.schema.get_field_index("score"), "score", scores), unit
    )
    with pytest.raises(ConfigError, match=rf"part2 is damaged: units/.*{unit.name}"):
        list(merge_shards(parts, tmp_path / "all"))
    assert not (tmp_path / "all").exists()
