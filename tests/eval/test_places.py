"""Where runs lie: links, the folder that the user is in, copies, and folders that
cannot be written.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchnav.core.errors import ConfigError
from benchnav.core.store import Shard
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.eval import cli
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.folder.run_folder import EPISODES, open_run, read_table, write_run
from benchnav.eval.folder.sealed import metadata
from benchnav.eval.run import unit as units_of_run
from benchnav.eval.run.merge import merge_shards
from benchnav.eval.run.rerun import compare, rerun
from benchnav.eval.run.runner import run_suite
from tests.commands import call
from tests.eval.forged import forge_rows


def words_on(dataset: Path, *more: str) -> tuple[str, ...]:
    return (
        "run", "--data", str(dataset), "--model", "oracle", "--planners", "[tests.eval.parts:Faulty]", "--risks",
        "[mean]", "--scenarios", "[std]", "--maps", "1", "--world.time_budget_s", "4", "--record", "steps", *more,
    )  # fmt: skip


@pytest.fixture(scope="module")
def made(dataset_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("places") / "run"
    assert call("eval", *words_on(dataset_path, "--out", str(folder))) == 0
    return folder


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "run"))


def quick(dataset: Path, **changes: Any) -> Suite:
    given: dict[str, Any] = {
        "data": str(dataset), "model": "oracle", "planners": ("tests.eval.parts:Faulty",), "risks": ("mean",),
        "scenarios": ("std",), "maps": 1, "record": "none", "world": {"time_budget_s": 2.0},
    }  # fmt: skip
    return Suite(**(given | changes))


def makings(folder: Path) -> set[str]:
    """Tokens of the makings of a run's units."""
    return {metadata(path)["made"] for path in folder.glob("units/*/*.parquet")}


def test_a_link_stays_a_link_when_what_it_points_to_is_dropped(
    run: Path, dataset_path: Path, tmp_path: Path
) -> None:
    (tmp_path / "link").symlink_to(run)
    before = makings(run)
    list(run_suite(quick(dataset_path), tmp_path / "link", overwrite=True))
    assert (tmp_path / "link").is_symlink()
    assert makings(run).isdisjoint(before)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "run"]


def test_the_folder_that_the_user_is_in_can_be_dropped_and_merged_into(
    run: Path, dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run)
    before = makings(run)
    list(run_suite(quick(dataset_path), Path(), overwrite=True))
    assert makings(Path()).isdisjoint(before)
    assert not Path("report.html").exists()
    list(run_suite(quick(dataset_path), tmp_path / "part", shard=Shard(index=1, of=1)))
    (tmp_path / "all").mkdir()
    monkeypatch.chdir(tmp_path / "all")
    list(merge_shards([tmp_path / "part"], Path()))
    for folder in (Path(), tmp_path / "all"):
        assert len(read_table(folder, EPISODES)) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["all", "part", "run"]


def test_a_copy_certifies_nothing(run: Path, tmp_path: Path) -> None:
    again = Path(shutil.copytree(run, tmp_path / "again"))
    with pytest.raises(
        ConfigError, match=r"again, where 1 of 1 units are copies from the original run"
    ):
        list(rerun(run, again))
    # Nor under another account of the run.
    write_run(again, {**open_run(again).manifest, "history": []})
    with pytest.raises(ConfigError, match="copies"):
        list(rerun(run, again))
    list(rerun(run, again, overwrite=True))
    assert compare(run, again)[0]
    # What was repeated may be gone on with.
    list(rerun(run, again))


def test_merged_copies_of_one_shard_certify_nothing(
    dataset_path: Path, tmp_path: Path
) -> None:
    list(run_suite(quick(dataset_path), tmp_path / "part", shard=Shard(index=1, of=1)))
    for name in ("one", "two"):
        list(merge_shards([tmp_path / "part"], tmp_path / name))
    with pytest.raises(ConfigError, match="copies"):
        list(rerun(tmp_path / "one", tmp_path / "two"))


def test_a_column_that_one_table_has_is_a_difference(run: Path, tmp_path: Path) -> None:
    list(rerun(run, tmp_path / "again"))
    forge_rows(run, pd.read_parquet(run / "episodes.parquet").assign(more=1.0))
    same, lines = compare(run, tmp_path / "again")
    assert not same
    assert "column more is in only one of the two tables" in lines
    assert not any("rows are identical" in line for line in lines)


def test_a_run_is_reported_and_replayed_without_being_written(
    run: Path, tmp_path: Path, capsys: Any
) -> None:
    for path in [run / "report.html", run / "summary.csv"]:
        path.unlink()
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    out = tmp_path / "elsewhere"
    assert call("eval", "report", str(run), "--out", str(out)) == 0
    assert str(out / "report.html") in capsys.readouterr().out
    assert {
        "report.html",
        "summary.csv",
        "summary.md",
        "summary.tex",
        "failures.csv",
        "figures",
    } == {path.name for path in out.iterdir()}
    assert (out / "figures" / "driven.png").exists()
    assert call("eval", "replay", str(run), "--view", "false", "--out", str(out)) == 0
    assert sorted(path.suffix for path in (out / "playback").iterdir()) == [
        ".npz",
        ".rrd",
    ]
    assert {
        path: path.read_bytes() for path in run.rglob("*") if path.is_file()
    } == before
    other = Path(shutil.copytree(run, tmp_path / "other"))
    capsys.readouterr()
    for command in ("report", "replay"):
        assert call("eval", command, str(run), "--out", str(other)) == 2
        assert "a folder without another run" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        ("run", "--seed", "-5"),
        ("run", "--seed", "99999999999999999999"),
        ("run", "--seeds", "[0,-1]"),
        ("run", "--planners", "[straight]", "--risks", "cvar:1.5"),
        ("run", "--out", "/"),
        ("run", "--world", "[]"),
        ("run", "--world", "[paper,papr]"),
        ("merge", "/", "RUN"),
        ("rerun", "/"),
        ("compare", "RUN", "--out", "."),
        ("compare", "RUN", "--out", "/"),
        ("compare", "RUN", "--out", ".."),
        ("compare", "RUN", "--out", "bad/"),
        ("replay", "RUN", "--seed", "-5"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    words: tuple[str, ...],
    made: Path,
    dataset_path: Path,
    tmp_path: Path,
    monkeypatch: Any,
    capsys: Any,
) -> None:
    monkeypatch.chdir(tmp_path)
    given = [str(made) if word == "RUN" else word for word in words]
    if words[0] == "run":
        given = [*words_on(dataset_path), *words[1:]]
    assert call("eval", *given) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.strip().splitlines()) == 1
    assert "Traceback" not in captured.err
    assert list(tmp_path.iterdir()) == []


def test_the_module_is_the_command(made: Path) -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "benchnav.eval.cli", "compare", str(made), "--out", "/"],
        capture_output=True, text=True, env=os.environ,
    )  # fmt: skip
    assert (ran.returncode, ran.stdout) == (2, "")
    assert "got the folder /" in ran.stderr


def test_all_commands_and_suites_stand_in_the_run_with_when_and_where(
    dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    for seed in (0, 0, 3):
        monkeypatch.setattr(sys, "argv", ["benchnav-eval", "run", "--seed", str(seed)])
        list(run_suite(quick(dataset_path, seed=seed), out))
    first, second = open_run(out).manifest["history"]
    assert (first["suite"]["seed"], second["suite"]["seed"]) == (0, 3)
    assert second["command"].endswith("--seed 3")
    for entry in (first, second):
        assert pd.Timestamp(entry["date"]).tz is not None
        assert entry["host"] == os.uname().nodename
        assert entry["cores"] == os.cpu_count()
    cpuinfo = Path("/proc/cpuinfo")
    names = [
        line
        for line in cpuinfo.read_text().splitlines()
        if line.startswith("model name")
    ]
    assert not names or names[0].partition(": ")[2].strip() == first["processor"]
    here = Path(cli.__file__).parent
    asked = ["git", "-C", str(here), "rev-parse", "HEAD"]
    commit = subprocess.run(asked, capture_output=True, text=True).stdout.strip()
    assert first["commit"].removesuffix("+") == commit


def test_one_condition_has_one_label_for_good(
    dataset_path: Path, tmp_path: Path
) -> None:
    def suite(label: str | None, *levels: float) -> Suite:
        named = {} if label is None else {"label": label}
        risk = {
            "part": "cvar",
            "options": {"level": list(levels) if len(levels) > 1 else levels[0]},
            **named,
        }
        return quick(dataset_path, risks=(risk,))

    out = tmp_path / "run"
    list(run_suite(suite("careful", 0.9), out))
    before = json.loads((out / "run.json").read_text())
    with pytest.raises(
        ConfigError, match=r"got 'cvar:0\.9' and 'careful' for the same setting"
    ):
        list(run_suite(suite(None, 0.5, 0.9), out))
    assert json.loads((out / "run.json").read_text()) == before
    list(run_suite(suite("cautious", 0.5), out))
    rows = pd.read_parquet(out / "episodes.parquet")
    labels = {
        i: entry["labels"]["risk"]
        for i, entry in open_run(out).manifest["conditions"].items()
    }
    assert dict(zip(rows["condition"], rows["risk"], strict=True)) == labels
    assert set(labels.values()) == {"careful", "cautious"}


def test_rows_have_the_group_of_their_map(
    run: Path, dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = pd.read_parquet(run / "episodes.parquet")
    assert rows["group"].dtype == "int64"
    assert (rows["group"] == rows["map"]).all()

    class Grouped(TerrainDataset):
        field_names = ("group",)

        def read(self, split: str, indices: Any, names: Any = None) -> Any:
            if names != ["group"]:
                return super().read(split, indices, names)
            return {"group": np.array([40 + index // 2 for index in indices], np.int32)}

    monkeypatch.setattr(units_of_run, "TerrainDataset", Grouped)
    units_of_run._block.cache_clear()
    block = units_of_run.read_maps(Grouped(dataset_path), "test/std", [0, 1])
    assert (block.groups.tolist(), block.groups.dtype) == ([40, 40], np.int64)
    list(run_suite(quick(dataset_path, maps=2), tmp_path / "grouped"))
    assert read_table(tmp_path / "grouped", EPISODES)["group"].tolist() == [40, 40]
