"""A file of a run that is not what it has to be is said to be damaged, with how."""

import shutil
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from benchnav.errors import ConfigError
from benchnav.eval.folder.folder import EPISODES, open_run, read_table, write_run
from benchnav.eval.folder.schema import digest_of_file
from benchnav.eval.run.runner import run_suite
from benchnav.eval.suite import Suite


@pytest.fixture(scope="module")
def made(dataset_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("schema") / "run"
    suite = Suite(
        data=str(dataset_path), model="oracle", planners=("tests.eval.parts:Faulty",), risks=("mean", "cvar:0.5"),
        scenarios=("std",), instances=2, seeds=(0, 3), time_budget_s=2.0, record="none", steps="none",
    )  # fmt: skip
    list(run_suite(suite, folder))
    return folder


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "run"))


def first(about: dict[str, Any]) -> dict[str, Any]:
    entry: dict[str, Any] = next(iter(about["trials"].values()))
    return entry


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", "null", '{"format": "benchnav-run"}', "[" * 100000])
def test_an_empty_or_truncated_file_is_damaged_and_a_missing_one_is_none(text: str, run: Path) -> None:
    (run / "run.json").write_text(text)
    with pytest.raises(ConfigError, match=r"run\.json is damaged: "):
        open_run(run)
    (run / "run.json").unlink()
    with pytest.raises(ConfigError, match=r"Expected a run folder with run\.json"):
        open_run(run)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda about: about.update(format="other"), "does not say that it is a run"),
        (lambda about: about.pop("datasets"), "lacks 'datasets'"),
        (lambda about: about.update(code=3), "code is no mapping"),
        (lambda about: about["code"].pop("sources"), "code lacks 'sources'"),
        (lambda about: about.update(commands="x"), "commands is no list"),
        (lambda about: about.update(run_id=7), "run_id is no text"),
        (lambda about: about.update(trials={}), "names no trial"),
        (lambda about: about["trials"].update(x=about["trials"].popitem()[1]), "a value that is not its own"),
        (
            lambda about: first(about)["value"]["world"].update(time_budget_s=9.0),
            "a value that is not its own",
        ),
        (lambda about: first(about)["labels"].update(scenario="hs"), "labels that are not its own"),
        (lambda about: first(about)["draws"][0].__setitem__(2, 99), "more instances than the 2 maps"),
        (lambda about: first(about)["draws"][0].__setitem__(2, 0), "draws that are none"),
        (lambda about: first(about)["draws"].append([0, 0, 1]), "a draw twice"),
        (lambda about: first(about)["seeds"].pop(), "seeds that are not those"),
    ],
)
def test_what_does_not_fit_is_named(change: Any, expected: str, run: Path) -> None:
    about = open_run(run).about
    change(about)
    write_run(run, about)
    with pytest.raises(ConfigError, match=expected):
        open_run(run)


def test_a_seal_that_does_not_fit_is_damage(run: Path) -> None:
    text = (run / "run.json").read_text()
    (run / "run.json").write_text(text.replace('"compiles": ', '"compiles":  '))
    assert open_run(run).about["code"]  # as JSON it is the same
    (run / "run.json").write_text(text.replace('"date": "2', '"date": "3'))
    with pytest.raises(ConfigError, match="changed after benchnav wrote it"):
        open_run(run)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda rows: rows.iloc[:0], "has no rows"),
        (lambda rows: rows.iloc[:-1], "7 rows, where the run has 8 episodes"),
        (lambda rows: pd.concat([rows.iloc[:-1], rows.iloc[:1]]), "an episode twice"),
        (lambda rows: rows.assign(seed=rows["seed"] + 1), "episodes that the run has not"),
        (lambda rows: rows.assign(risk="mean"), "column risk does not hold the labels of the run"),
        (lambda rows: rows.drop(columns="success"), "no column success of true and false"),
        (lambda rows: rows.drop(columns="trial"), "no column trial of text"),
        (lambda rows: rows.assign(total_time_s="9"), "no column total_time_s of numbers"),
        (lambda rows: rows.assign(total_time_s=float("nan")), "times that are none"),
        (lambda rows: rows.assign(success=~rows["success"]), "outcome and success do not agree"),
        (lambda rows: rows.assign(outcome="lost", success=False), "'lost' is no outcome"),
        (lambda rows: rows.assign(group=0.5), "no column group of whole numbers"),
    ],
)
def test_rows_that_are_not_those_of_the_run_are_named(change: Any, expected: str, run: Path) -> None:
    change(pd.read_parquet(run / EPISODES)).to_parquet(run / EPISODES)
    with pytest.raises(ConfigError, match="changed after benchnav wrote it"):
        read_table(run, EPISODES)
    write_run(run, {**open_run(run).about, "tables": {EPISODES: digest_of_file(run / EPISODES)}})
    with pytest.raises(ConfigError, match=f"is damaged: .*{expected}"):
        read_table(run, EPISODES)
