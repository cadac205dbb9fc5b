"""What a user's own part reads is recorded with its units, and a unit is run again when that has changed."""

import runpy
import shutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from benchnav.core import sources
from benchnav.core.errors import ConfigError
from benchnav.core.ownership import is_installed, is_own
from benchnav.core.touched import changed_entries, snapshot, watch
from benchnav.core.workers import run_calls
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.folder.provenance import code_differences
from benchnav.eval.folder.run_folder import open_run
from benchnav.eval.folder.sealed import metadata
from benchnav.eval.run import runner
from benchnav.eval.run.runner import run_suite
from benchnav.eval.run.unit import Settings

CACHES: tuple[Any, ...] = (sources.installed_folders, is_own, is_installed)

PART = """
import importlib, json, os
from pathlib import Path

import torch
from benchnav.planning import Plan, Planner

HERE = Path(__file__).parent
SPEED = json.loads((HERE / "speed.json").read_text())  # at import


class Own(Planner):
    steers = (("speed_mps", "turn_rate_radps"),)

    def init(self, problem, generator):
        __import__("".join(["own", "lib"]))
        importlib.import_module("".join(["own", "more"]))
        self.gain = float(os.environ.get("OWN_GAIN", "1"))
        dict(os.environ), {**os.environ}, list(os.environ.items())
        self.helper = importlib.import_module("".join(["hel", "per"]))
        (HERE / "log.txt").write_text("output")
        (HERE / "log.txt").read_text()
        (HERE.parent / "passing.txt").read_text()  # in the temporary folder, and not beside the part
        return 0

    def plan(self, step, plan_state):
        action = torch.zeros(len(step.state), 2)
        action[:, 0] = SPEED * self.gain * self.helper.FACTOR
        return action, plan_state, Plan.empty(len(step.state))
"""


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A part that reads a file, a variable, a module whose name is put together, and an installed package."""
    folder = tmp_path / "own"
    site = tmp_path / "site"
    for name in ("ownlib", "ownmore"):
        (site / name).mkdir(parents=True)
        (site / name / "__init__.py").touch()
        _install(site, name, "1.0")
    folder.mkdir()
    (folder / "part.py").write_text(PART)
    (folder / "helper.py").write_text("FACTOR = 1.0")
    (folder / "speed.json").write_text("0.5")
    (tmp_path / "passing.txt").write_text("nothing")
    return folder


def _install(site: Path, name: str, version: str) -> None:
    for info in site.glob(f"{name}-*.dist-info"):
        shutil.rmtree(info)
    info = site / f"{name}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\nRequires-Dist: pandas\n"
    )
    (info / "top_level.txt").write_text(f"{name}\n")
    (info / "RECORD").write_text(f"{name}/__init__.py,,\n")


@pytest.fixture(autouse=True)
def paths(own: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(own))
    monkeypatch.syspath_prepend(str(own.parent / "site"))
    monkeypatch.delenv("OWN_GAIN", raising=False)
    for cached in CACHES:
        cached.cache_clear()
    yield
    for name in ("helper", "ownlib", "ownmore"):
        sys.modules.pop(name, None)
    for cached in CACHES:
        cached.cache_clear()


def run(
    own: Path, dataset: Path, name: str, planner_limit_s: float = 0.0, **options: bool
) -> list[str]:
    """Run the part and a shipped planner; gives what was said."""
    suite = Suite(
        data=str(dataset), model="oracle", planners=(f"{own / 'part.py'}:Own", "straight"), risks=("mean",),
        scenarios=("std",), maps=2, world={"time_budget_s": 2.0}, record="none",
    )  # fmt: skip
    lines: list[str] = []
    list(
        run_suite(
            suite,
            own.parent / name,
            settings=Settings(planner_limit_s=planner_limit_s),
            say=lines.append,
            **options,
        )
    )
    return [line for line in lines if not line.startswith("warning: ")]


def records(own: Path, name: str) -> list[dict[str, str]]:
    """What units recorded, those of the shipped planner first."""
    units = (own.parent / name).glob("units/*/*.parquet")
    return sorted((metadata(path)["touched"] for path in units), key=len)


def files_of(own: Path, touched: Mapping[str, str]) -> set[str]:
    """Recorded files, by name where they lie beside the part, but for those of the installed packages."""
    paths = [
        Path(name.removeprefix("file ")) for name in touched if name.startswith("file ")
    ]
    return {
        path.name if path.parent == own else str(path)
        for path in paths
        if not path.is_relative_to(own.parent / "site")
    }


def test_what_a_part_reads_is_recorded_and_a_change_runs_its_unit_again(
    own: Path, dataset_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(own, dataset_path, "run")
    nothing, touched = records(own, "run")
    assert nothing == {}
    # neither its output nor a temporary file
    assert files_of(own, touched) == {
        "speed.json",
        "helper.py",
    }
    # no copy of all
    assert [name for name in touched if name.startswith("variable ")] == [
        "variable OWN_GAIN"
    ]
    assert touched["package ownlib"] == touched["package ownmore"] == "1.0"
    # dateutil is what pandas requires, and that what ownlib does.
    assert {"package torch", "package pandas", "package python-dateutil"} <= set(
        touched
    )
    assert not {"package benchnav", "package h5py", "package gymnasium"} & set(touched)
    assert changed_entries(touched) == []
    assert touched in [
        code["touched"]
        for code in open_run(own.parent / "run").manifest["codes"].values()
    ]
    assert run(own, dataset_path, "run") == ["2 of 2 units were already finished"]

    monkeypatch.setenv("OWN_GAIN", "0.5")
    assert changed_entries(touched) == ["variable OWN_GAIN"]
    assert run(own, dataset_path, "run", reuse_code=True) == [
        "2 of 2 units were already finished"
    ]
    reused = open_run(own.parent / "run").manifest["reused"]
    assert reused.startswith(
        "1 of 2 units were run with other code (variable OWN_GAIN)"
    )
    (own / "speed.json").write_text("0.4")
    (own / "helper.py").write_text("FACTOR = 0.9")
    _install(own.parent / "site", "ownlib", "2.0")
    sys.modules.pop("helper")
    for name in [
        name for name in sys.modules if name.startswith("benchnav_file_part_")
    ]:
        del sys.modules[name]
    sources.load_file.cache_clear()  # as in a new process
    done, again, *_ = run(own, dataset_path, "run")
    assert done == "1 of 2 units were already finished"
    start, _, changes = again.partition("changed: ")
    assert (
        start
        == "1 of 2 units are run again, since their parts read files or variables that have "
    )
    assert {Path(change).name for change in changes.split("; ")} == {
        "speed.json", "helper.py", "variable OWN_GAIN", "package ownlib (1.0 to 2.0)",
    }  # fmt: skip
    assert run(own, dataset_path, "run") == ["2 of 2 units were already finished"]


def test_a_process_that_imported_a_part_earlier_cannot_run_it_on_a_changed_file(
    own: Path, dataset_path: Path
) -> None:
    """Its module read the file once; the same process would use what it read then."""
    run(own, dataset_path, "run")
    (own / "speed.json").write_text("0.4")
    with pytest.raises(
        ConfigError,
        match=r"not to change during the run, got changes: file .*speed\.json",
    ):
        run(own, dataset_path, "run")


def test_a_planner_in_a_process_of_its_own_is_watched_too(
    own: Path, dataset_path: Path
) -> None:
    run(own, dataset_path, "limited", planner_limit_s=60.0)
    _, touched = records(own, "limited")
    assert files_of(own, touched) == {"speed.json", "helper.py"}
    assert "variable OWN_GAIN" in touched


def test_what_changes_during_a_run_ends_it(
    own: Path, dataset_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measure = runner.measure_latencies

    def change(*given: Any) -> None:
        measure(*given)
        (own / "speed.json").write_text("0.3")

    monkeypatch.setattr(runner, "measure_latencies", change)
    with pytest.raises(
        ConfigError,
        match=r"not to change during the run, got changes: file .*speed\.json\. Repeat",
    ):
        run(own, dataset_path, "run")


def test_what_a_script_reads_itself_is_none_of_its_parts(own: Path) -> None:
    """Only what benchnav called it for counts."""
    script = own / "script.py"
    script.write_text("def read(path):\n    return lambda: path.read_text()\n")
    read = runpy.run_path(str(script))["read"]
    for name in ("itself", "called"):
        (own / name).touch()
    watch()
    read(own / "itself")()
    list(run_calls([read(own / "called")]))
    assert [Path(path).name for path in snapshot()["files"][str(script)]] == ["called"]


def test_runs_whose_parts_read_something_else_are_of_other_code() -> None:
    """As `merge` and `compare` ask."""
    code = {"modules": {}, "environment": {}, "parts": {}}
    one = {**code, "touched": {"file a.npz": "1", "package x": "1.0", "variable A": ""}}
    other = {
        **code,
        "touched": {"file a.npz": "2", "package x": "2.0", "variable B": "3"},
    }
    assert code_differences(one, other) == ["file a.npz", "package x (1.0 to 2.0)"]
    assert code_differences(code, other) == []  # a run of version 1.0 recorded nothing
