"""A file of a run that is not what it has to be is said to be damaged, with how."""

import json
import shutil
from pathlib import Path

import pandas as pd
import pytest

from benchnav.core.errors import ConfigError
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.folder.run_folder import EPISODES, open_run, read_table
from benchnav.eval.run.runner import run_suite


@pytest.fixture(scope="module")
def made(dataset_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("schema") / "run"
    suite = Suite(
        data=str(dataset_path), model="oracle", planners=("tests.eval.parts:Faulty",), risks=("mean", "cvar:0.5"),
        scenarios=("std",), maps=2, seeds=(0, 3), world={"time_budget_s": 2.0}, record="none",
    )  # fmt: skip
    list(run_suite(suite, folder))
    return folder


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "run"))


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", "null", '{"format": "benchnav-run"}', "[" * 100000]
)
def test_an_empty_or_truncated_file_is_damaged_and_a_missing_one_is_none(
    text: str, run: Path
) -> None:
    (run / "run.json").write_text(text)
    with pytest.raises(ConfigError, match=r"run\.json is damaged: "):
        open_run(run)
    (run / "run.json").unlink()
    with pytest.raises(ConfigError, match=r"Expected a run folder with run\.json"):
        open_run(run)


@pytest.mark.parametrize("version", [5, 7])
def test_runs_of_other_formats_are_refused_with_what_reads_them(
    version: int, run: Path
) -> None:
    (run / "run.json").write_text(
        json.dumps({**open_run(run).manifest, "format_version": version})
    )
    remedy = {
        5: r"Run its suite again, or read it with benchnav 1\.3",
        7: "Read it with a newer benchnav: pip install --upgrade benchnav",
    }[version]
    with pytest.raises(
        ConfigError,
        match=rf"format version 6, got .* of version {version}\. {remedy}\.$",
    ):
        open_run(run)


def test_a_seal_that_does_not_fit_is_damage(run: Path) -> None:
    text = (run / "run.json").read_text()
    (run / "run.json").write_text(text.replace('"compiles": ', '"compiles":  '))
    assert open_run(run).manifest["codes"]  # as JSON it is the same
    (run / "run.json").write_text(text.replace('"date": "2', '"date": "3'))
    with pytest.raises(ConfigError, match="changed after benchnav wrote it"):
        open_run(run)


def test_a_table_or_a_seal_that_was_changed_or_taken_away_is_damage(run: Path) -> None:
    pd.read_parquet(run / EPISODES).iloc[:-1].to_parquet(run / EPISODES)
    with pytest.raises(ConfigError, match="changed after benchnav wrote it"):
        read_table(run, EPISODES)
    about = open_run(run).manifest
    (run / "run.json").write_text(
        json.dumps(
            {name: value for name, value in about.items() if name != "manifest_digest"}
        )
    )
    with pytest.raises(ConfigError, match="changed after benchnav wrote it"):
        open_run(run)
