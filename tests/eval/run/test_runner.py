import json
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from benchnav.core import registry
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.settings import plain
from benchnav.datagen.recipe.load import load_recipe
from benchnav.eval.compare import compare_runs
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.find_episodes import find_episodes
from benchnav.eval.folder import provenance
from benchnav.eval.folder.provenance import Origin
from benchnav.eval.folder.run_folder import EPISODES, open_run, read_table
from benchnav.eval.folder.steps import read_steps
from benchnav.eval.report.playback.viewer_file import write_viewer_files
from benchnav.eval.report.write import write_report
from benchnav.eval.run import runner
from benchnav.eval.run import unit as units_of_run
from benchnav.eval.run.recordings import find_recording
from benchnav.eval.run.runner import run_suite
from benchnav.eval.run.unit import Settings, run_unit
from tests import factories
from tests.commands import call
from tests.eval.report.playback.rrd import read_path

BUDGETS = {
    "astar_dwa": {"dwa": {"turn_rates": 7, "horizon_s": 1.5}},
    "cl_rrt": {"expansions": 50},
    "mppi": {"samples": 64, "horizon_s": 1.5},
}
PLANNERS = ("straight", *BUDGETS)
# Episodes are short, and robots fast enough to reach their goals in them.
WORLD = {"time_budget_s": 4.0}
FAST = {"part": "unicycle", "options": {"speed_mps": [0.0, 3.0]}}
KEYS = ["scenario", "planner", "risk", "seed", "realisation", "map"]
# What a wall clock says is no result.
TIMING = ["planning_ms", "planning_ms_p95", "planning_start_ms"]


SHIPPED = "paper-v1"
GIVES_UP = """from tests.eval.parts import Faulty

class Mine(Faulty):
    def __init__(self, fault="none", after_s=1.0):
        super().__init__("give up", 1.0)
"""
MINE = "from tests.eval.parts import Faulty\n\nclass Mine(Faulty):\n    pass\n"


def suite_on(dataset: Path, **changes: object) -> Suite:
    if "models" in changes:
        changes = {"model": Suite.model} | changes
    made = Suite(
        data=str(dataset), model="oracle", maps=2, world=WORLD,
        planners=("straight", *({"part": n, "options": o} for n, o in BUDGETS.items())),
        risks=("cvar", "mean"), scenarios=("std", "hs"), robots=(FAST,),
    )  # fmt: skip
    return replace(made, **changes)  # type: ignore[arg-type]


def quick(dataset: Path, **changes: object) -> Suite:
    """A suite of a planner that needs no time."""
    given = {"planners": ("tests.eval.parts:Faulty",), "record": "none"} | changes
    return suite_on(dataset, **given)


def finish(
    suite: Suite, folder: Path, jobs: int = 1, **options: object
) -> pd.DataFrame:
    for _ in run_suite(suite, folder, jobs, **options):  # type: ignore[arg-type]
        pass
    return pd.read_parquet(folder / "episodes.parquet")


def unused(suite: Suite, folder: Path, **options: object) -> str:
    """Runs a suite in a folder of which no unit counts; gives what is said to differ."""
    said: list[str] = []
    rows = finish(suite, folder, say=said.append, **options)
    count = rows["condition"].nunique()
    assert not any("already finished" in line for line in said)
    (line,) = [line for line in said if "are run again" in line]
    begun = f"{count} of {count} units were run with other code or maps ("
    assert line.startswith(begun)
    differing, _, rest = line.removeprefix(begun).rpartition(") and are run again")
    assert rest.startswith("; pass --reuse-code")
    return differing


def same(first: pd.DataFrame, second: pd.DataFrame) -> None:
    first, second = (
        rows.sort_values(KEYS).drop(columns=TIMING).reset_index(drop=True)
        for rows in (first, second)
    )
    pd.testing.assert_frame_equal(first, second)


@pytest.fixture(scope="module")
def finished(
    dataset_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Suite, Path]:
    """A run of every planner under two risk settings on two scenarios."""
    suite = suite_on(dataset_path)
    folder = tmp_path_factory.mktemp("run") / "run"
    finish(suite, folder)
    write_report(folder)
    return suite, folder


@pytest.fixture(scope="module")
def brief(dataset_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of `quick`, to be copied."""
    folder = tmp_path_factory.mktemp("brief") / "run"
    finish(quick(dataset_path), folder)
    return folder


def test_a_run_folder_has_all_that_is_promised(finished: tuple[Suite, Path]) -> None:
    _, folder = finished
    episodes = pd.read_parquet(folder / "episodes.parquet")
    assert len(episodes) == (1 + 3 * 2) * 2 * 2
    assert not episodes.duplicated(KEYS).any()
    assert set(episodes["planner"]) == set(PLANNERS)
    assert set(episodes[episodes["planner"] == "straight"]["risk"]) == {"–"}
    about = json.loads((folder / "run.json").read_text())
    assert (about["format"], about["format_version"]) == ("benchnav-run", 6)
    environments = [code["environment"] for code in about["codes"].values()]
    assert {known["torch"] for known in environments} == {
        torch.__version__.split("+")[0]
    }
    (data,) = about["datasets"].values()
    assert [len(digests) for digests in data["maps"].values()] == [2, 2]
    assert len({digest for digests in data["maps"].values() for digest in digests}) == 4
    figures = ("figures/trajectories.png", "figures/success.png")
    for name in ("summary.md", "summary.csv", "summary.tex", *figures):
        assert (folder / name).stat().st_size > 100
    assert len(pd.read_csv(folder / "summary.csv")) == 14
    assert not list(folder.rglob("*partial*"))
    assert not list(folder.parent.glob(".*"))
    # A unit is one file, in the folder of its condition.
    assert sorted(p.parent.name for p in folder.glob("units/*/*")) == sorted(
        about["conditions"]
    )


def test_recordings_verify_and_hold_the_driven_path(
    finished: tuple[Suite, Path],
) -> None:
    _, folder = finished
    write_viewer_files(folder)
    recordings = sorted((folder / "playback").glob("*.rrd"))
    conditions = open_run(folder).conditions
    assert len(recordings) == len(conditions) == (1 + 3 * 2) * 2
    paths = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    }
    subprocess.run(
        ["rerun", "rrd", "verify", *map(str, recordings)],
        check=True,
        capture_output=True,
        env=paths,
    )
    for planner in PLANNERS:
        ((unit, member),) = find_episodes(folder, {"planner": [planner]}, None, 0, 0)
        path = folder / unit.recording_path(member, ".rrd")
        assert path in recordings
        episode = read_steps(folder, condition=unit.condition.id, map=0)
        times, positions = read_path(path)
        np.testing.assert_allclose(times, episode["time_s"], atol=1e-6)
        np.testing.assert_array_equal(
            positions[:, :2], episode[["x_m", "y_m"]].to_numpy()
        )


def test_rows_do_not_depend_on_workers(
    finished: tuple[Suite, Path], tmp_path: Path
) -> None:
    suite, folder = finished
    same(
        finish(suite, tmp_path / "two", jobs=2),
        pd.read_parquet(folder / "episodes.parquet"),
    )
    steps = [read_steps(place) for place in (folder, tmp_path / "two")]
    pd.testing.assert_frame_equal(*steps)


def test_a_killed_run_goes_on_to_the_same_rows(
    finished: tuple[Suite, Path], tmp_path: Path
) -> None:
    suite, whole = finished
    folder = tmp_path / "run"
    code = (
        "import sys; from pathlib import Path; from benchnav.eval.experiment.suite import Suite\n"
        "from benchnav.eval.run.runner import run_suite\n"
        f"for _ in run_suite(Suite(**{vars(suite)!r}), Path({str(folder)!r})): pass"
    )
    process = subprocess.Popen([sys.executable, "-c", code])
    while len(list(folder.glob("units/*/*.parquet"))) < 2:
        time.sleep(0.02)
        assert process.poll() is None
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not (folder / "episodes.parquet").exists()
    kept = {
        path: path.stat().st_mtime_ns for path in folder.glob("units/*/[!.]*.parquet")
    }
    said: list[str] = []
    same(
        finish(suite, folder, say=said.append),
        pd.read_parquet(whole / "episodes.parquet"),
    )
    assert all(path.stat().st_mtime_ns == when for path, when in kept.items())
    measured = "measuring the planning time of a single robot"
    assert said == [f"{len(kept)} of 14 units were already finished", measured]


def test_workers_end_with_a_command_that_was_killed(
    dataset_path: Path, tmp_path: Path
) -> None:
    (tmp_path / "begun").mkdir()
    asleep = {
        "part": "tests.eval.parts:Asleep",
        "options": {"folder": str(tmp_path / "begun")},
    }
    suite = quick(
        dataset_path, planners=(asleep,), risks=("mean", "cvar"), scenarios=("std",)
    )
    code = (
        "from pathlib import Path; from benchnav.eval.experiment.suite import Suite\n"
        "from benchnav.eval.run.runner import run_suite\n"
        f"for _ in run_suite(Suite(**{vars(suite)!r}), Path({str(tmp_path / 'run')!r}), jobs=2): pass"
    )
    process = subprocess.Popen([sys.executable, "-c", code], start_new_session=True)
    while len(list((tmp_path / "begun").iterdir())) < 2:
        time.sleep(0.05)
        assert process.poll() is None
    process.kill()
    process.wait()
    deadline = time.monotonic() + 30
    while is_alive(process.pid) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not is_alive(process.pid)


def is_alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_the_same_suite_again_runs_nothing_and_says_so(
    brief: Path, dataset_path: Path, tmp_path: Path
) -> None:
    said: list[str] = []
    folder = shutil.copytree(brief, tmp_path / "run")
    first = pd.read_parquet(folder / "episodes.parquet")
    before = {path: path.stat().st_mtime_ns for path in folder.glob("units/*/*")}
    again = finish(quick(dataset_path), folder, say=said.append)
    pd.testing.assert_frame_equal(first, again)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert said == ["4 of 4 units were already finished"]


@pytest.mark.parametrize(
    ("change", "conditions", "rows", "kept"),
    [
        ({"risks": ("var",)}, 6, 12, 4),
        ({"planners": ("tests.eval.parts:Faulty", "straight")}, 6, 12, 4),
        ({"models": ("oracle", "tests.eval.parts:Gaussian")}, 8, 16, 4),
        ({"seed": 5}, 4, 16, 4),
        ({"seed": 5, "maps": 1}, 4, 12, 4),
        ({"realisations": 3}, 4, 24, 4),
        ({"scenarios": ("hg",)}, 6, 12, 4),
        ({"world": WORLD | {"noise": "stored"}}, 8, 16, 4),
    ],
)
def test_a_run_is_extended_by_what_is_missing(
    change: dict[str, object],
    conditions: int,
    rows: int,
    kept: int,
    brief: Path,
    dataset_path: Path,
    tmp_path: Path,
) -> None:
    folder = shutil.copytree(brief, tmp_path / "run")
    before = {path: path.stat().st_mtime_ns for path in folder.glob("units/*/*")}
    extended = finish(quick(dataset_path, **change), folder)
    assert (extended["condition"].nunique(), len(extended)) == (conditions, rows)
    assert (
        sum(path.stat().st_mtime_ns == when for path, when in before.items())
        == kept
        == len(before)
    )
    # What was there and what came make the rows of a run that had all at once.
    fresh = (
        {"risks": ("cvar", "mean", "var")} if change == {"risks": ("var",)} else change
    )
    fresh = {"seeds": (0, 5)} if change == {"seed": 5} else fresh
    if not {"scenarios", "world", "maps"} & set(change):
        same(extended, finish(quick(dataset_path, **fresh), tmp_path / "fresh"))


def test_a_run_is_extended_by_maps(tmp_path: Path) -> None:
    dataset = factories.tiny_dataset(
        tmp_path / "tiny.h5", factories.tiny_recipe(test_std=53)
    )
    folder, suite = (
        tmp_path / "run",
        quick(dataset, scenarios=("std",), risks=("mean",)),
    )
    sizes = []
    for maps in (50, 52, 0, 4):
        rows = finish(replace(suite, maps=maps), folder)
        sizes.append((len(rows), len(list(folder.glob("units/*/*")))))
    # a last block of more maps is another unit
    assert sizes == [
        (50, 1),
        (52, 2),
        (53, 3),
        (53, 3),
    ]
    same(rows, finish(replace(suite, maps=0), tmp_path / "fresh"))


def test_a_run_is_extended_by_another_dataset(
    dataset_path: Path, tmp_path: Path
) -> None:
    finish(quick(dataset_path, scenarios=("std",), risks=("mean",)), tmp_path / "run")
    other = factories.tiny_dataset(
        tmp_path / "other.h5", replace(factories.tiny_recipe(), seed=1)
    )
    rows = finish(quick(other, scenarios=("std",), risks=("mean",)), tmp_path / "run")
    assert rows.groupby("data").size().to_dict() == {
        str(dataset_path): 2,
        str(other): 2,
    }
    assert len(open_run(tmp_path / "run").manifest["datasets"]) == 2


def test_an_extension_under_a_label_that_is_taken_is_refused(
    dataset_path: Path, tmp_path: Path
) -> None:
    finish(quick(dataset_path, scenarios=("std",)), tmp_path / "run")
    late = {"part": "tests.eval.parts:Faulty", "options": {"after_s": 2.0}}
    with pytest.raises(ConfigError, match="with the label 'Faulty'"):
        finish(
            quick(dataset_path, scenarios=("std",), planners=(late,)), tmp_path / "run"
        )


def test_code_that_changes_while_a_run_goes_on_makes_no_table(
    dataset_path: Path, tmp_path: Path
) -> None:
    mine = tmp_path / "mine.py"
    mine.write_text(
        "from tests.eval.parts import Faulty\n\nclass Mine(Faulty):\n    pass\n"
    )
    suite = quick(
        dataset_path, planners=(f"{mine}:Mine",), scenarios=("std",), risks=("mean",)
    )
    steps = run_suite(suite, tmp_path / "run")
    next(steps)
    mine.write_text(mine.read_text() + "# edited\n")
    with pytest.raises(
        ConfigError, match=r"with which the run was begun, got changes: .*mine\.py"
    ):
        list(steps)
    assert not (tmp_path / "run" / "episodes.parquet").exists()


def test_a_unit_of_another_run_counts_if_the_same_made_it(
    dataset_path: Path, tmp_path: Path
) -> None:
    suite = quick(dataset_path, scenarios=("std",), risks=("mean",))
    for name in ("one", "two"):
        finish(suite, tmp_path / name)
    (unit,) = (
        path.relative_to(tmp_path / "one")
        for path in (tmp_path / "one").glob("units/*/*")
    )
    (tmp_path / "two" / unit).unlink()
    shutil.copy(tmp_path / "one" / unit, tmp_path / "two" / unit)
    said: list[str] = []
    same(
        finish(suite, tmp_path / "two", say=said.append),
        pd.read_parquet(tmp_path / "one" / "episodes.parquet"),
    )
    assert said == ["1 of 1 units were already finished"]
    # Under other seeds it is another unit, also where it lies under its name.
    shutil.copy(
        tmp_path / "one" / unit,
        (tmp_path / "two" / unit).with_name(unit.name.replace("0-", "5-", 1)),
    )
    said.clear()
    finish(replace(suite, seed=5), tmp_path / "two", say=said.append)
    assert not any("there already" in line for line in said)


def test_a_narrower_command_runs_no_more_than_it_names(
    dataset_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wide = quick(dataset_path, risks=("mean", "cvar"), seeds=(0, 1))
    narrow = replace(wide, risks=("cvar",), scenarios=("std",))
    whole, folder = finish(wide, tmp_path / "whole"), tmp_path / "run"
    next(steps := run_suite(wide, folder))
    steps.close()
    said: list[str] = []
    steps = run_suite(narrow, folder, say=said.append)
    assert [tuple(step) for step in steps] == [(0, 2), (1, 2), (2, 2)]
    made = pd.concat(map(pd.read_parquet, folder.glob("units/*/*.parquet")))
    assert set(made["risk"]) | set(made["scenario"]) == {"cvar", "std"}
    assert len(made) == 4
    (line,) = [line for line in said if "finished" in line]
    others = whole[["scenario", "risk"]].drop_duplicates().shape[0]
    assert f"{others - 1} of {others} conditions of {folder} are unfinished" in line
    assert not (folder / EPISODES).exists()
    # The command says the same, has no report, and is content.
    config = tmp_path / "narrow.yaml"
    config.write_text(json.dumps(plain(narrow)))
    assert call("eval", "run", "--config", config, "--out", folder) == 0
    told = capsys.readouterr()
    assert f"{others - 1} of {others} conditions" in told.err
    assert "report" in told.out
    assert "--partial" in told.out
    assert not (folder / "report.html").exists()
    # What is lacking may come in parts; the part that completes the run makes its
    # table.
    for risk in ("mean", "cvar"):
        list(run_suite(replace(wide, risks=(risk,)), folder))
    same(pd.read_parquet(folder / EPISODES), whole)


def test_a_block_of_maps_stays_whole_under_a_narrower_command(
    dataset_path: Path, tmp_path: Path
) -> None:
    wide = quick(dataset_path, scenarios=("std",), risks=("mean", "cvar"), maps=2)
    next(steps := run_suite(wide, tmp_path / "run"))
    steps.close()
    list(run_suite(replace(wide, risks=("mean",), maps=1), tmp_path / "run"))
    list(run_suite(replace(wide, risks=("cvar",)), tmp_path / "run"))
    assert len(pd.read_parquet(tmp_path / "run" / EPISODES)) == 4


def test_a_table_does_not_stay_beside_newer_units_than_it_holds(
    dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wide = quick(dataset_path, scenarios=("std",), risks=("mean", "cvar"))
    before = finish(wide, tmp_path / "run")
    narrow = replace(wide, risks=("mean",))
    monkeypatch.setattr(provenance, "version", lambda name: "another")
    said: list[str] = []
    list(run_suite(narrow, tmp_path / "run", say=said.append))
    assert not (tmp_path / "run" / EPISODES).exists()
    assert "1 of 2 conditions" in said[-1]
    assert "(1 of their units were run with other code or maps)" in said[-1]
    # The units of the old code are still there and count again with it.
    monkeypatch.undo()
    list(run_suite(narrow, tmp_path / "run"))
    same(pd.read_parquet(tmp_path / "run" / EPISODES), before)


@pytest.mark.parametrize("jobs", [1, 2])
def test_progress_names_what_is_run_and_counts_episodes(
    dataset_path: Path, tmp_path: Path, jobs: int
) -> None:
    suite = quick(dataset_path, scenarios=("std",), risks=("mean", "cvar"), maps=2)
    first, *middle, last = run_suite(suite, tmp_path / "run", jobs)
    names = {"std Faulty mean, maps 0 to 1", "std Faulty cvar, maps 0 to 1"}
    assert first.doing.removeprefix("running ") in names
    assert last.doing.removeprefix("finished ") in names
    (between,) = middle
    assert between.doing.startswith("running" if jobs == 1 else "finished")
    assert [
        (step.size_done, step.size, step.sized) for step in (first, between, last)
    ] == [(done, 4, "episodes") for done in (0, 2, 4)]


@pytest.mark.parametrize(
    "risk", ["cvar:1.5", "var:-0.1", "expected-time:-1", "chance:2", "single-class:1"]
)
def test_options_that_a_risk_measure_cannot_take_are_refused_before_the_run(
    dataset_path: Path, tmp_path: Path, risk: str
) -> None:
    with pytest.raises(ConfigError, match=r"Expected .* in [\[(]0, 1[\])], got"):
        finish(
            quick(dataset_path, scenarios=("std",), risks=("mean", risk)),
            tmp_path / "run",
        )
    assert not (tmp_path / "run" / "units").exists()


def test_units_under_another_time_limit_or_compiler_are_not_used(
    dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite = quick(dataset_path, scenarios=("std",), risks=("mean",))
    finish(suite, tmp_path / "run")
    assert (
        unused(suite, tmp_path / "run", settings=Settings(planner_limit_s=9.0))
        == "planner_limit_s (0.0 to 9.0)"
    )
    monkeypatch.setattr(provenance, "can_compile", lambda: None)
    assert unused(suite, tmp_path / "run").startswith("compiles (")


def test_every_unit_is_run_on_the_device_that_is_asked_for(
    dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite, given = quick(dataset_path, scenarios=("std",), risks=("mean",)), []

    def run_here(unit: Unit, folder: Path, origin: Origin, settings: Settings) -> None:
        given.append(settings.device)
        monkeypatch.setattr(units_of_run, "_check_origin", lambda *given: None)
        run_unit(unit, folder, origin, Settings())

    monkeypatch.setattr(runner, "run_unit", run_here)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "a GPU")
    finish(suite, tmp_path / "cuda", settings=Settings.on("auto"))
    assert set(given) == {"cuda"}
    assert open_run(tmp_path / "cuda").manifest["device"] == "cuda"
    assert open_run(tmp_path / "cuda").manifest["gpu"] == "a GPU"
    given.clear()
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "another")
    assert (
        unused(suite, tmp_path / "cuda", settings=Settings.on("cuda"))
        == "device (a GPU to another)"
    )
    given.clear()
    finish(suite, tmp_path / "cpu", settings=Settings.on("cpu"))
    assert set(given) == {"cpu"}
    assert open_run(tmp_path / "cpu").manifest["gpu"] is None
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="GPU"):
        finish(suite, tmp_path / "none", settings=Settings.on("cuda"))
    assert not (tmp_path / "none").exists()


def test_units_of_other_code_or_maps_are_kept_and_not_used_and_what_changed_is_named(
    dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, mine, folder = tmp_path / "tiny.h5", tmp_path / "mine.py", tmp_path / "run"
    shutil.copy(dataset_path, data)
    mine.write_text(
        "from tests.eval.parts import Faulty\n\nclass Mine(Faulty):\n    pass\n"
    )
    suite = quick(data, planners=(f"{mine}:Mine",), scenarios=("std",))
    rows = finish(suite, folder)
    modules = provenance.digests_of_package_modules
    changes = {
        "benchnav.eval.run.rollout": (
            provenance, "digests_of_package_modules", lambda names: modules(names) | {"benchnav.eval.run.rollout": "0"}
        ),
        "torch (": (provenance, "version", lambda name: "9.9" if name == "torch" else version(name)),
        "processor (": (torch.backends.cpu, "get_cpu_capability", lambda: "ABACUS"),
    }  # fmt: skip
    for name, (place, attribute, changed) in changes.items():
        with monkeypatch.context() as patch:
            patch.setattr(place, attribute, changed)
            assert unused(suite, shutil.copytree(folder, tmp_path / name)).startswith(
                name
            )
    mine.write_text(mine.read_text() + "# another\n")
    assert "mine.py" in unused(suite, shutil.copytree(folder, tmp_path / "other code"))
    mine.write_text(mine.read_text().removesuffix("# another\n"))
    factories.tiny_dataset(
        tmp_path / "other.h5", replace(factories.tiny_recipe(), seed=1)
    )
    os.replace(data, tmp_path / "first.h5")
    os.replace(tmp_path / "other.h5", data)
    assert unused(suite, folder) == "maps"
    # As it was, all is there again, and the table is of it.
    os.replace(tmp_path / "first.h5", data)
    files, said = (
        {path: path.stat().st_mtime_ns for path in folder.glob("units/*/*")},
        list[str](),
    )
    same(finish(suite, folder, say=said.append), rows)
    assert said == ["2 of 2 units were already finished"]
    assert {path: path.stat().st_mtime_ns for path in folder.glob("units/*/*")} == files
    assert len(files) == 4


def test_units_of_other_code_are_taken_when_asked_for_and_marked(
    dataset_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine, folder = tmp_path / "mine.py", tmp_path / "run"
    mine.write_text(MINE)
    suite = quick(
        dataset_path, planners=(f"{mine}:Mine",), scenarios=("std",), risks=("mean",)
    )
    first = finish(suite, folder)
    first_key = next(folder.glob("units/*/*.parquet")).stem.rpartition("-")[2]
    mine.write_text(MINE + "# the same, in other words\n")
    said: list[str] = []
    rows = finish(
        replace(suite, seeds=(0, 5)), folder, reuse_code=True, say=said.append
    )
    assert "1 of 2 units were already finished" in said
    assert not any("not used" in line for line in said)
    codes = dict(zip(rows["seed"], rows["code"], strict=True))
    assert codes[0] == first["code"].iloc[0] != codes[5]
    about = open_run(folder).manifest
    assert set(about["codes"]) == set(codes.values())
    line = (
        f"1 of 2 units were run with other code (planner {mine}:Mine); the column "
        "`code` identifies the code of each row"
    )
    assert about["reused"] == line
    report = write_report(folder)
    assert f"warning: {line}" in report.warnings
    # Rows of other code are compared with none of this code, unless that is asked for.
    finish(replace(suite, seeds=(0, 5), risks=("cvar",)), folder, reuse_code=True)
    with pytest.raises(
        ConfigError, match="got conditions that were run with different code"
    ):
        compare_runs([folder], "risk", "", {}, 0.05)
    # Without it the unit is run anew, and nothing is marked.
    finish(replace(suite, seeds=(0, 5)), folder)
    assert open_run(folder).manifest["reused"] == ""
    assert len(set(read_table(folder, "episodes.parquet")["code"])) == 1
    # Where a unit is there of this code too, that one is taken, though other code's is
    # newer.
    for path in folder.glob(f"units/*/*-{first_key}.parquet"):
        os.utime(path, (time.time() + 60,) * 2)
    finish(replace(suite, seeds=(0, 5)), folder, reuse_code=True)
    assert set(
        read_table(folder, "episodes.parquet").query("risk == 'mean'")["code"]
    ) == {codes[5]}
    # Of other maps nothing is ever taken.
    other = factories.tiny_dataset(
        tmp_path / "other.h5", replace(factories.tiny_recipe(), seed=1)
    )
    data = tmp_path / "data.h5"
    shutil.copy(dataset_path, data)
    moved = replace(suite, data=str(data))
    finish(moved, tmp_path / "moved")
    shutil.copy(other, data)
    assert unused(moved, tmp_path / "moved", reuse_code=True) == "maps"


def test_what_was_recorded_by_other_code_is_not_taken_for_this(
    dataset_path: Path, tmp_path: Path
) -> None:
    """Steps and recordings lie once; rows of each code stay. Back at old code only its
    rows are of it.
    """
    mine, folder = tmp_path / "mine.py", tmp_path / "run"
    mine.write_text(MINE)
    suite = quick(
        dataset_path,
        planners=(f"{mine}:Mine",),
        scenarios=("std",),
        risks=("mean",),
        record="steps",
    )
    finish(suite, folder)
    driven = read_steps(folder)
    mine.write_text(GIVES_UP)
    assert "mine.py" in unused(suite, folder)
    assert len(read_steps(folder)) < len(driven)
    mine.write_text(MINE)
    said: list[str] = []
    finish(suite, folder, say=said.append)
    assert "1 of 1 units have no recordings or steps and are run again" in said
    pd.testing.assert_frame_equal(read_steps(folder), driven)
    # What is lost is made again with all that was kept, though less is asked for now.
    shutil.rmtree(folder / "steps")
    finish(replace(suite, record="none"), folder)
    pd.testing.assert_frame_equal(read_steps(folder), driven)


def test_a_changed_checkpoint_is_named(
    dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite = quick(dataset_path, scenarios=("std",))
    suite = replace(suite, model=SHIPPED)
    finish(suite, tmp_path / "run")
    monkeypatch.setattr(provenance, "digests_of", lambda folder: {"a": "b"})
    assert unused(suite, tmp_path / "run") == f"model {SHIPPED}"


def test_two_runs_in_one_folder_refuse_each_other_also_with_overwrite(
    dataset_path: Path, tmp_path: Path
) -> None:
    suite = quick(dataset_path)
    first = run_suite(suite, tmp_path / "run")
    next(first)
    for options in ({}, {"overwrite": True}):
        with pytest.raises(BenchnavError, match="Another run"):
            finish(suite, tmp_path / "run", **options)
    for _ in first:
        pass
    assert len(pd.read_parquet(tmp_path / "run" / "episodes.parquet")) == 8


def test_overwrite_drops_run_folders_alone(dataset_path: Path, tmp_path: Path) -> None:
    precious = tmp_path / "run" / "thesis.tex"
    precious.parent.mkdir()
    precious.write_text("years")
    with pytest.raises(ConfigError):
        finish(quick(dataset_path), tmp_path / "run", overwrite=True)
    with pytest.raises(ConfigError, match="which is neither"):
        finish(quick(dataset_path), tmp_path / "run")
    assert precious.read_text() == "years"
    finish(quick(dataset_path, scenarios=("std", "hs")), tmp_path / "other")
    rows = finish(
        quick(dataset_path, scenarios=("std",)), tmp_path / "other", overwrite=True
    )
    assert set(rows["scenario"]) == {"std"}


def test_replay_repeats_an_episode_that_was_not_recorded(
    finished: tuple[Suite, Path],
) -> None:
    _, folder = finished
    asked = {"planner": ["astar_dwa"], "risk": ["mean"], "scenario": ["hs"]}
    ((unit, member),) = find_episodes(folder, asked, None, 0, 1)
    recording = find_recording(folder, unit, member)
    steps = read_steps(folder, planner="astar_dwa", risk="mean", scenario="hs", map=1)
    np.testing.assert_array_equal(
        recording.states[:, :2], steps[["x_m", "y_m"]].to_numpy()
    )
    write_viewer_files(folder)
    _, positions = read_path(folder / unit.recording_path(member, ".rrd"))
    np.testing.assert_array_equal(positions[:, :2], recording.states[:, :2])


def test_what_the_caller_set_is_left_alone(dataset_path: Path, tmp_path: Path) -> None:
    threads, filters = torch.get_num_threads(), list(warnings.filters)
    torch.set_num_threads(2)
    try:
        steps = run_suite(quick(dataset_path), tmp_path / "run")
        for _ in steps:
            assert torch.get_num_threads() == 2
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert list(warnings.filters) == filters


def test_suites_are_checked_before_anything_is_run_or_dropped(
    dataset_path: Path, tmp_path: Path
) -> None:
    finish(quick(dataset_path, scenarios=("std",), risks=("mean",)), tmp_path / "run")
    kept = sorted((tmp_path / "run").rglob("*"))
    for change, expected in (
        ({"scenarios": ("fog",)}, "fog"),
        ({"risks": ("cvr",)}, "cvr"),
        ({"planners": ("mpi",)}, "mpi"),
        ({"planners": ({"part": "mppi", "options": {"sample": 1}},)}, "samples"),
        ({"model": "no-such-model"}, "no-such-model"),
        ({"data": "no-such-data"}, "no-such-data"),
        ({"world": {"noise": "loud"}}, "loud"),
        ({"maps": 9}, "Use 0 for all maps"),
        (
            {"world": {"time_budget_s": 0.01}},
            "time budget of at least 0.1 s .one time step",
        ),
        ({"planners": ("astar_dwa",), "robots": ("bicycle",)}, "steering_rad"),
        ({"planners": ("cl_rrt",), "robots": ("bicycle",)}, "steering_rad"),
        ({"planners": ({"part": "mppi", "options": {"noise": [0.5]}},)}, "noise"),
        (
            {"robots": ("tests.eval.parts:Faulty",)},
            "an instance of benchnav.planning.Robot, got Faulty",
        ),
        (
            {"planners": ("benchnav.planning.robots:Unicycle",)},
            r"an instance of benchnav.planning.Planner, got Unicycle\. Write class Unicycle\(Planner\)",
        ),
        (
            {"objectives": ("benchnav.planning.robots:Unicycle",)},
            "an instance of benchnav.planning.Objective, got Unicycle",
        ),
        ({"conditions": ({"task": 3},)}, "mapping"),
        ({"conditions": ({"planners": []},)}, "at least one condition"),
        ({"model": {"part": "paper-v1", "lable": "mine"}}, "lable"),
    ):
        for place in (tmp_path / "run", tmp_path / "new"):
            with pytest.raises(BenchnavError, match=expected):
                finish(quick(dataset_path, **change), place, overwrite=True)
        assert not (tmp_path / "new").exists()
    assert sorted((tmp_path / "run").rglob("*")) == kept


def test_parts_of_this_process_alone_are_refused_for_workers(
    dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tests.eval.parts import Faulty

    registry.register("planner", "mine", Faulty)
    suite = quick(dataset_path, planners=("mine",))
    assert len(finish(suite, tmp_path / "run")) == 8
    for options in ({"jobs": 2}, {"settings": Settings(planner_limit_s=9.0)}):
        with pytest.raises(ConfigError, match="jobs"):
            finish(suite, tmp_path / "two", **options)


def test_what_a_user_should_know_is_said(dataset_path: Path, tmp_path: Path) -> None:
    said: list[str] = []
    suite = quick(
        dataset_path,
        task={"free_space": {"above": 0.1}},
        model="paper-v1",
        scenarios=("std",),
    )
    other = replace(
        factories.tiny_recipe(),
        classes=factories.tiny_recipe().classes[:4],
        environments=1,
    )
    data = factories.tiny_dataset(tmp_path / "four.h5", other)
    finish(replace(suite, data=str(data)), tmp_path / "run", say=said.append)
    assert any(
        "with λ above 0.3" in line and "free cells have λ above 0.1" in line
        for line in said
    )
    assert any("class" in line and "paper-v1" in line for line in said)


def test_a_planner_that_gives_up_at_once_is_recorded_and_reported(
    dataset_path: Path, tmp_path: Path
) -> None:
    hopeless = {
        "part": "tests.eval.parts:Faulty", "label": "hopeless", "options": {"fault": "give up", "after_s": 0.0},
    }  # fmt: skip
    suite = quick(
        dataset_path,
        planners=(hopeless,),
        scenarios=("std",),
        risks=("mean",),
        record="first",
    )
    episodes = finish(suite, tmp_path / "run")
    assert episodes["outcome"].tolist() == ["planner_failure"] * 2
    assert episodes["end_time_s"].tolist() == [0, 0]
    assert episodes["total_time_s"].tolist() == [WORLD["time_budget_s"]] * 2
    write_report(tmp_path / "run")
    write_viewer_files(tmp_path / "run")
    (recording,) = (tmp_path / "run" / "playback").glob("*.rrd")
    _, positions = read_path(recording)
    assert len(positions) <= 2


def test_a_run_that_lacks_maps_tells_how_they_are_made(tmp_path: Path) -> None:
    """Of a file with some maps of a shipped recipe; of others there is nothing to be
    told.
    """
    recipe = load_recipe("tiny-v1")
    few = {
        name: replace(recipe.splits[name], maps=2) for name in ("test/std", "test/hg")
    }
    path = factories.tiny_dataset(tmp_path / "few.h5", replace(recipe, splits=few))
    made = "Create all maps of tiny-v1 by `benchnav-datagen create tiny-v1`"
    for changes, told in (
        ({"maps": 3}, True),
        ({"maps": 5}, False),
        ({"scenarios": ("hs",)}, True),
        ({"scenarios": ("night",)}, False),
    ):
        suite = Suite(data=str(path), model="oracle", planners=("straight",), **changes)
        with pytest.raises(ConfigError) as refused:
            finish(suite, tmp_path / "run")
        assert (made in str(refused.value)) == told, changes


def test_goals_out_of_reach_are_told_before_the_run(
    dataset_path: Path, tmp_path: Path
) -> None:
    def told(budget: float, robot: str | dict[str, Any] = "unicycle") -> list[str]:
        lines: list[str] = []
        suite = Suite(
            data=str(dataset_path), model="oracle", planners=("straight",), scenarios=("std",), maps=2,
            world={"time_budget_s": budget}, robots=(robot,), record="steps",
        )  # fmt: skip
        for _ in run_suite(
            suite, tmp_path / f"{budget}-{len(str(robot))}", say=lines.append
        ):
            pass
        return [line for line in lines if "within the time budget T" in line]

    # 8 m by 8 m to the goal, of which the last metre is not driven: 10.3 s at 1 m/s.
    line = (
        "warning: in 2 of 2 maps of test/std, a robot with a top speed of 1 m/s cannot "
        "reach the goal within the time budget T"
    )
    assert told(10.2) == [line]
    assert told(10.4) == []
    assert told(10.2, {"part": "unicycle", "options": {"speed_mps": [0.0, 2.0]}}) == []


def test_a_world_that_cannot_be_drawn_is_refused_before_a_run_is_dropped(
    dataset_path: Path, tmp_path: Path
) -> None:
    suite = Suite(
        data=str(dataset_path),
        model="oracle",
        planners=("straight",),
        scenarios=("std",),
        maps=2,
        record="steps",
    )
    before = finish(suite, tmp_path / "run")
    for world, expected in (
        (
            {"noise": "frozen", "correlation_m": 4.1},
            r"`world.correlation_m` of at most 4 m.* got 4.1 m",
        ),
        ({"noise": "frozen", "immobile": {"below": 0.99}}, "none for map"),
    ):
        for place in ("run", "new"):
            with pytest.raises(ConfigError, match=expected):
                finish(replace(suite, world=world), tmp_path / place, overwrite=True)
    same(before, pd.read_parquet(tmp_path / "run" / "episodes.parquet"))
    assert not (tmp_path / "new").exists()


def test_a_command_that_may_start_no_processes_runs_its_units_itself(
    tmp_path: Path,
) -> None:
    config = tmp_path / "suite.yaml"
    data = factories.tiny_dataset(tmp_path / "d.h5")
    config.write_text(f"data: {data}\nscenarios: [std]\nmaps: 1\nrecord: none\n"
                      "conditions:\n  - {planners: [straight]}\n")  # fmt: skip
    code = "from benchnav.eval import cli; cli._finish = cli._failed; cli.main()"
    words = [
        "run",
        "--config",
        str(config),
        "--jobs",
        "2",
        "--out",
        str(tmp_path / "run"),
    ]
    ran = subprocess.run(
        [sys.executable, "-c", code, *words], env={**os.environ, "JOBLIB_MULTIPROCESSING": "0"},
        capture_output=True, text=True,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    assert (tmp_path / "run" / "episodes.parquet").exists()


def test_hypotheses_are_fixed_before_the_first_unit_and_stay(
    dataset_path: Path, tmp_path: Path
) -> None:
    faulty, straight = (
        {"planner": "Faulty", "risk": "mean"},
        {"planner": "Faulty", "risk": "cvar"},
    )
    given = {"one": faulty, "other": straight, "metric": "success"}
    suite = quick(dataset_path, scenarios=("std",), hypotheses=(given,))
    folder, steps = tmp_path / "run", run_suite(suite, tmp_path / "run")
    next(steps)
    about = open_run(folder).manifest
    fixed = about["hypotheses"]
    assert not list(folder.glob("units/*/*"))
    (test,) = fixed["tests"]
    assert [
        about["conditions"][test[side]]["labels"]["risk"] for side in ("one", "other")
    ] == [
        "mean",
        "cvar",
    ]
    assert fixed["episodes"] == {test["one"]: 2, test["other"]: 2}
    list(steps)
    # without them the run goes on
    finish(quick(dataset_path, scenarios=("std",), seed=5), folder)
    assert open_run(folder).manifest["hypotheses"] == fixed
    report = write_report(folder)
    assert report.tests["n_episodes"].tolist() == [4]
    assert (
        "extended after the hypotheses were fixed (episodes per condition: 2 then, 4 now)"
        in next(iter(report.findings.values()))[-1]
    )
    other = (given | {"metric": "score"},)
    with pytest.raises(
        ConfigError, match=f"digest {fixed['digest']}.*got different ones"
    ):
        finish(replace(suite, hypotheses=other), folder)
    finish(quick(dataset_path, scenarios=("std",)), tmp_path / "plain")
    with pytest.raises(ConfigError, match="digest none"):
        finish(suite, tmp_path / "plain")
    assert "hypotheses" not in open_run(tmp_path / "plain").manifest
    wrong = (given | {"one": {"planner": "Fulty"}},)
    with pytest.raises(ConfigError, match="Did you mean 'Faulty'"):
        finish(replace(suite, hypotheses=wrong), tmp_path / "wrong")
    assert not (tmp_path / "wrong" / "run.json").exists()
