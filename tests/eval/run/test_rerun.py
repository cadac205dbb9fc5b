"""A run that is repeated says truly whether its rows are identical, and what
differs around it.
"""

import inspect
import json
import shutil
import sys
from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import pandas as pd
import pytest
import torch

from benchnav.core.errors import ConfigError
from benchnav.core.store import Shard
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.folder import provenance
from benchnav.eval.folder.run_folder import open_run, write_run
from benchnav.eval.run.rerun import compare, rerun
from benchnav.eval.run.runner import run_suite
from tests import factories
from tests.commands import call
from tests.eval.forged import forge_rows

MINE = "from tests.eval.parts import Faulty\n\nclass Mine(Faulty):\n    pass\n"


@pytest.fixture
def suite(dataset_path: Path, tmp_path: Path) -> Suite:
    """Two planners that need no time, one of them in a file."""
    (tmp_path / "mine.py").write_text(MINE)
    shutil.copy(dataset_path, tmp_path / "tiny.h5")
    return Suite(
        data=str(tmp_path / "tiny.h5"), model="oracle", risks=("mean",), scenarios=("std",), maps=2,
        planners=("tests.eval.parts:Faulty", f"{tmp_path / 'mine.py'}:Mine"),
        world={"noise": "stored", "time_budget_s": 30.0},
        record="steps",
    )  # fmt: skip


def finish(suite: Suite, folder: Path, **options: object) -> Path:
    list(run_suite(suite, folder, **options))  # type: ignore[arg-type]
    return folder


def repeat(run: Path, folder: Path, **options: object) -> tuple[bool, list[str]]:
    list(rerun(run, folder, **options))  # type: ignore[arg-type]
    return compare(run, folder)


def change_rows(run: Path, changes: Mapping[str, object], where: str) -> None:
    rows = pd.read_parquet(run / "episodes.parquet")
    chosen = rows.eval(where)
    for name, value in changes.items():
        rows.loc[chosen, name] = value
    forge_rows(run, rows)


def test_a_run_that_was_extended_by_commands_is_repeated_whole(
    suite: Suite, tmp_path: Path
) -> None:
    run = finish(suite, tmp_path / "run")
    finish(replace(suite, seeds=(3,), maps=1), run)
    finish(replace(suite, scenarios=("hs",), realisations=2), run)
    assert repeat(run, tmp_path / "again") == (
        True,
        [
            f"all {2 * 2 + 2 * 1 + 2 * 2 * 2} rows are identical",
            "no difference between the recorded environments",
        ],
    )
    first, second = open_run(run), open_run(tmp_path / "again")
    assert second.conditions == first.conditions


def test_the_time_limit_of_planners_is_repeated(suite: Suite, tmp_path: Path) -> None:
    run = finish(suite, tmp_path / "run")
    about = json.loads((run / "run.json").read_text())
    assert "planner_limit_s" in about
    write_run(run, {**about, "planner_limit_s": 77.0})
    next(steps := rerun(run, tmp_path / "again"))
    steps.close()
    assert open_run(tmp_path / "again").manifest["planner_limit_s"] == 77.0


def test_the_device_is_repeated_and_refused_where_it_is_not(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = finish(suite, tmp_path / "run")
    about = json.loads((run / "run.json").read_text())
    assert about["device"] == "cpu"
    write_run(run, {**about, "device": "cuda"})
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="GPU"):
        next(rerun(run, tmp_path / "again"))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "a GPU")
    told: list[str] = []
    next(steps := rerun(run, tmp_path / "again", say=told.append))
    steps.close()
    assert open_run(tmp_path / "again").manifest["device"] == "cuda"
    assert "running on a GPU" in told


def test_rows_that_differ_are_counted_and_the_first_named(
    suite: Suite, tmp_path: Path
) -> None:
    run = finish(replace(suite, seeds=(0, 1, 2, 3)), tmp_path / "run")
    change_rows(
        run,
        {"outcome": "timeout", "total_time_s": 12.5},
        "planner == 'Mine' and seed > 0",
    )
    same, lines = repeat(run, tmp_path / "again")
    assert not same
    assert lines[0] == "6 of 16 rows differ, in 1 of 2 conditions:"
    assert "planner Mine" in lines[1]
    assert lines[1].endswith("6 rows")
    named = [line for line in lines if "outcome timeout → success" in line]
    assert len(named) == 5
    assert "seed 1, realisation 0, map 0: " in named[0]
    assert "total_time_s 12.5 → " in named[0]
    time_s = pd.read_parquet(tmp_path / "again" / "episodes.parquet").query(
        "planner == 'Mine' and seed > 0"
    )
    greatest = (time_s["total_time_s"] - 12.5).abs().max()
    assert f"largest differences: total_time_s {greatest:.3g}" in lines


def test_wall_time_is_no_difference(suite: Suite, tmp_path: Path) -> None:
    run = finish(suite, tmp_path / "run")
    change_rows(run, {"planning_ms": 1e6}, "seed == 0")
    assert repeat(run, tmp_path / "again")[0]


def test_code_that_changed_is_named_beside_the_rows(
    suite: Suite, tmp_path: Path
) -> None:
    run = finish(suite, tmp_path / "run")
    slower = MINE.replace(
        "pass",
        "def __init__(self, fault='none', after_s=1.0):\n        super().__init__('give up', 2.0)",
    )
    (tmp_path / "mine.py").write_text(slower)
    _, lines = repeat(run, tmp_path / "again")
    assert lines[0].startswith("2 of 4 rows differ")
    assert (
        len([line for line in lines if "outcome success → planner_failure" in line])
        == 2
    )
    assert lines[-1].startswith("the environments differ in: ")
    assert "mine.py" in lines[-1]


def test_files_that_a_part_imports_or_is_named_are_seen_by_extension_resumption_and_repetition(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    helper, weights = tmp_path / "helper_of_mine.py", tmp_path / "weights.txt"
    helper.write_text("from tests.eval.parts import Faulty\n")
    weights.write_text("1.0")
    (tmp_path / "mine.py").write_text(
        f"import sys\nsys.path.insert(0, {str(tmp_path)!r})\nfrom helper_of_mine import Faulty\n\n"
        "class Mine(Faulty):\n    def __init__(self, weights: str = ''):\n"
        "        super().__init__('give up', float(open(weights).read()))\n"
    )
    own = {
        "part": f"{tmp_path / 'mine.py'}:Mine",
        "options": {"weights": "weights.txt"},
    }
    suite = replace(suite, planners=(own,))
    run = finish(suite, tmp_path / "run")
    assert (
        repeat(run, tmp_path / "same")[1][-1]
        == "no difference between the recorded environments"
    )
    name = f"planner {tmp_path / 'mine.py'}:Mine"
    for changed, content, told in (
        (helper, "from tests.eval.parts import Faulty\nx = 1\n", f"({name})"),
        (weights, "2.0", f"(weights.txt of {name})"),
    ):
        before = changed.read_text()
        changed.write_text(content)
        for asked in (suite, replace(suite, realisations=2)):
            copy, said = Path(shutil.copytree(run, tmp_path / "copy")), list[str]()
            finish(asked, copy, say=said.append)
            (line,) = [line for line in said if "are run again" in line]
            assert f"run with other code or maps {told} and are run again" in line
            shutil.rmtree(copy)
        if changed is weights:
            _, lines = repeat(run, tmp_path / "again")
            assert lines[0].startswith("2 of 2 rows differ")
            assert (
                lines[-1]
                == f"the environments differ in: weights.txt of {name}; file weights.txt"
            )
        changed.write_text(before)
    steps = run_suite(suite, tmp_path / "other")
    next(steps)
    weights.write_text("3.0")
    with pytest.raises(
        ConfigError, match=r"with which the run was begun, got changes: weights\.txt of"
    ):
        list(steps)
    del sys.modules["helper_of_mine"]


def test_maps_that_changed_are_named(suite: Suite, tmp_path: Path) -> None:
    run = finish(suite, tmp_path / "run")
    factories.tiny_dataset(
        tmp_path / "other.h5", replace(factories.tiny_recipe(), seed=1)
    )
    (tmp_path / "other.h5").replace(tmp_path / "tiny.h5")
    same, lines = repeat(run, tmp_path / "again")
    assert not same
    assert "maps of" in lines[-1]


def test_versions_processor_and_machine_are_named_though_rows_are_the_same(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = finish(suite, tmp_path / "run")
    torch_version = provenance.version("torch")
    monkeypatch.setattr(
        provenance, "version", lambda name: "9.9" if name == "torch" else version(name)
    )
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "ABACUS")
    monkeypatch.setattr(
        provenance, "describe_machine", lambda: {"processor": "bead", "cores": 7}
    )
    same, lines = repeat(run, tmp_path / "again")
    assert same
    assert f"torch ({torch_version} to 9.9)" in lines[-1]
    assert "to ABACUS)" in lines[-1]
    assert "to bead, 7 cores)" in lines[-1]


def test_all_that_is_no_longer_there_is_told_before_anything_is_run(
    suite: Suite, tmp_path: Path
) -> None:
    run = finish(
        replace(suite, risks=("mean", "tests.eval.parts:least")), tmp_path / "run"
    )
    (tmp_path / "mine.py").unlink()
    (tmp_path / "tiny.h5").unlink()
    with pytest.raises(
        ConfigError,
        match=r"all inputs of .*run, got none for some parts or maps: .*dataset.*tiny\.h5.*mine\.py",
    ):
        repeat(run, tmp_path / "again")
    assert not (tmp_path / "again").exists()


def test_a_dataset_with_fewer_maps_is_told(suite: Suite, tmp_path: Path) -> None:
    run = finish(suite, tmp_path / "run")
    (tmp_path / "tiny.h5").unlink()
    factories.tiny_dataset(tmp_path / "tiny.h5", factories.tiny_recipe(test_std=1))
    with pytest.raises(
        ConfigError,
        match=r"Expected `maps` at most 1, which is the number of maps of test/std in .*, got 2",
    ):
        repeat(run, tmp_path / "again")


def test_a_folder_of_other_conditions_is_left_as_it_is(
    suite: Suite, tmp_path: Path
) -> None:
    run = finish(suite, tmp_path / "run")
    other = finish(replace(suite, risks=("cvar",)), tmp_path / "other")
    before = {path: path.read_bytes() for path in other.rglob("*") if path.is_file()}
    with pytest.raises(ConfigError, match="which has other conditions"):
        repeat(run, other)
    assert {
        path: path.read_bytes() for path in other.rglob("*") if path.is_file()
    } == before


def test_what_cannot_be_repeated_is_refused(suite: Suite, tmp_path: Path) -> None:
    run = finish(suite, tmp_path / "run")
    with pytest.raises(ConfigError, match="`out` to differ from the folder"):
        repeat(run, tmp_path / "x" / ".." / "run", overwrite=True)
    assert (run / "episodes.parquet").exists()
    part = finish(suite, tmp_path / "part", shard=Shard(index=1, of=1))
    with pytest.raises(ConfigError, match="shard 1/1"):
        repeat(part, tmp_path / "again")
    (run / "episodes.parquet").unlink()
    with pytest.raises(ConfigError, match="Expected a finished run"):
        repeat(run, tmp_path / "again")
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ((), {"jobs": 1, "overwrite": False}),
        (("--jobs", "3", "--overwrite"), {"jobs": 3, "overwrite": True}),
        (("--backend", "dask", "--scheduler", "tcp://a:1"), {"jobs": "tcp://a:1"}),
    ],
)
def test_the_command_repeats_with_the_workers_that_are_asked_for(
    words: tuple[str, ...],
    expected: dict[str, object],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[dict[str, object]] = []

    def begin(*args: object, **options: object) -> None:
        given.append(inspect.signature(rerun).bind(*args, **options).arguments)
        raise ConfigError("enough")

    monkeypatch.setattr("benchnav.eval.run.rerun.rerun", begin)
    assert call("eval", "rerun", tmp_path / "run", *words) == 2
    (told,) = given
    assert {name: told[name] for name in expected} == expected
    assert (told["run_folder"], told["folder"]) == (
        tmp_path / "run",
        tmp_path / "run-rerun",
    )


def test_the_command_ends_with_0_1_or_2(  # type: ignore[no-untyped-def]
    suite: Suite, tmp_path: Path, capsys
) -> None:
    def told(*words: str) -> tuple[int, str, str]:
        status, captured = call("eval", "rerun", *words), capsys.readouterr()
        return status, captured.out, captured.err

    run = finish(suite, tmp_path / "run")
    status, printed, _ = told(str(run))
    assert status == 0
    assert "all 4 rows are identical" in printed
    assert (tmp_path / "run-rerun" / "episodes.parquet").exists()
    change_rows(run, {"score": 0.25}, "map == 1")
    status, printed, error = told(str(run))
    assert status == 1
    assert "2 of 2 units were already finished" in error
    assert "2 of 4 rows differ" in printed
    status, _, error = told(str(run), "--overwrite", "--out", str(tmp_path / "other"))
    assert status == 1
    assert "already" not in error
    (tmp_path / "mine.py").unlink()
    status, printed, error = told(str(run), "--out", str(tmp_path / "third"))
    assert (status, printed, len(error.splitlines())) == (2, "", 1)
