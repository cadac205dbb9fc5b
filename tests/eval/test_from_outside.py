"""Parts from outside, each in one file, give equal rows from a program and from the
command in two processes.
"""

import runpy
import shlex
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchnav.core.errors import ConfigError
from benchnav.eval import Results, evaluate, open_run
from benchnav.metrics import Episode, Metric
from benchnav.viz import Figure
from tests.commands import call
from tests.docs.pages import DOCS, blocks
from tests.eval.test_evaluate import results_of

PAGE = list(blocks(DOCS / "tutorials" / "five-parts.md"))
FILES = {block.file: block.body for block in PAGE if block.file}
PARTS = ("wet", "dry", "headings", "lost", "lost_figure")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A working folder with the files of the tutorial, which its program imports and
    its commands name.
    """
    folder = tmp_path_factory.mktemp("outside")
    for name, body in FILES.items():
        (folder / name).write_text(body)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(folder)
        yield folder


@pytest.mark.parametrize("name", PARTS)
def test_each_part_is_one_file_of_at_most_forty_lines(name: str) -> None:
    assert len(FILES[f"{name}.py"].splitlines()) <= 40


@pytest.fixture(scope="module")
def program(place: Path) -> Results:
    results: Results = runpy.run_path("program.py")["results"]
    assert not any("not reproducible" in note for note in results.notes)
    return results


@pytest.fixture(scope="module")
def figure(place: Path) -> Figure:
    return import_module("lost_figure").LostOverTime()


def test_rows_are_those_of_the_command_in_two_processes(program: Results) -> None:
    (commands,) = (
        block.body for block in PAGE if block.body.startswith("benchnav-datagen")
    )
    for line in commands.replace("\\\n", " ").splitlines():
        command, *words = shlex.split(line)
        assert call(command.removeprefix("benchnav-"), *words) == 0
    ours, theirs = (
        results_of(rows).drop(columns=["data", "condition", "planner", "model"])
        for rows in (program.episodes, open_run("runs/command").episodes)
    )
    order = ["scenario", "risk", "map", "lost_m"]
    pd.testing.assert_frame_equal(
        ours.sort_values(order, ignore_index=True),
        theirs.sort_values(order, ignore_index=True),
    )
    assert np.isfinite(ours[["lost_m", "energy_j"]]).all().all()
    assert Path("runs/command/figures/lost-over-time.png").is_file()


def test_a_figure_is_drawn_as_an_object_and_stands_in_the_report(
    program: Results, figure: Figure, tmp_path: Path
) -> None:
    assert program.plot(figure).axes
    page = program.report(tmp_path / "suite")
    assert "lost to slip in 6 episodes" in page.read_text()
    renamed = figure.variant(name="again")
    program.report(tmp_path / "more", figures=[renamed])
    assert (tmp_path / "more" / "figures" / "again.png").is_file()
    assert "success" in dir(program.plot)


def test_a_figure_whose_needs_are_not_met_is_named(program: Results) -> None:
    class Nothing(Figure):
        name = "nothing"

        def is_available(self, data: Any) -> bool:
            return False

        def draw(self, data: Any) -> Any:
            raise AssertionError

    with pytest.raises(ConfigError, match="the data that figure 'nothing' needs"):
        program.plot(Nothing())


def test_a_metric_of_one_process_is_marked_and_not_resumed(
    dataset_path: Path, tmp_path: Path
) -> None:
    class Steps(Metric):
        name = column = "steps"
        meaning = "number of steps"

        def compute(self, episode: Episode) -> float:
            return episode.steps

    given: dict[str, Any] = {
        "terrain": dataset_path,
        "planners": ["straight"],
        "models": ["oracle"],
    }
    given |= {"metrics": [Steps()], "scenarios": ["std"], "maps": 1, "verbose": False}
    results = evaluate(**given, folder=tmp_path / "run")
    assert (results.episodes["steps"] > 0).all()
    assert any("not reproducible: metric steps" in line for line in results.notes)
    with pytest.raises(ConfigError, match="metric steps was a Python object"):
        evaluate(**given, folder=tmp_path / "run")
    with pytest.raises(ConfigError, match="which exists only in this process"):
        evaluate(**given, jobs=2)
