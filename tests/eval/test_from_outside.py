"""Parts from outside, each in one file, give equal rows from a program and from the command in two processes."""

from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml

from benchnav.core.errors import ConfigError
from benchnav.datagen import load_recipe
from benchnav.eval import Results, evaluate, open_run
from benchnav.metrics import Energy, Episode, Metric
from benchnav.planning import World
from benchnav.viz import Figure
from tests.commands import call
from tests.docs.pages import DOCS, blocks
from tests.eval.test_evaluate import results_of

EXAMPLES = Path(__file__).parents[2] / "examples"
MODEL = '''"""A model: less traversability on steeper ground."""

import torch

from benchnav import TraversabilityMixture
from benchnav.models import TraversabilityModel


class Steepness(TraversabilityModel):
    def __init__(self, loss_per_deg: float = 0.02) -> None:
        self.loss_per_deg = loss_per_deg

    def predict(self, observation):
        mean = (1 - self.loss_per_deg * observation.slope_deg).clamp(0, 1)
        mean = mean[:, None]  # one Gaussian
        return TraversabilityMixture(torch.ones_like(mean), mean, torch.full_like(mean, 0.1))
'''
FILES = ("own_metric", "own_planner", "own_figure", "slope_model", "wet")
RISKS, MAPS = ["mean", "cvar:0.8"], 2


def page_file(name: str) -> str:
    """A file that the page on layers of one's own shows."""
    return next(block.body for block in blocks(DOCS / "how-to" / "own-layer.md") if block.file == name)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A working folder with a file a part, which programs import and commands name."""
    folder = tmp_path_factory.mktemp("outside")
    for name in ("own_metric.py", "own_planner.py", "own_figure.py"):
        (folder / name).write_text((EXAMPLES / name).read_text())
    (folder / "slope_model.py").write_text(MODEL)
    (folder / "wet.py").write_text(page_file("wet.py"))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(folder)
        yield folder


@pytest.fixture(scope="module")
def parts(place: Path) -> dict[str, ModuleType]:
    """The modules of the files, by name."""
    return {name: import_module(name) for name in FILES}


@pytest.mark.parametrize("name", FILES)
def test_each_part_is_one_file_of_at_most_forty_lines(place: Path, name: str) -> None:
    code = [line for line in (place / f"{name}.py").read_text().splitlines() if line.strip()]
    assert len(code) <= 40


@pytest.fixture(scope="module")
def program(parts: dict[str, ModuleType]) -> Results:
    recipe = yaml.safe_load(page_file("wet.yaml"))
    layer = parts["wet"].Wetness(**recipe["layers"][0]["options"])
    Path("wet.yaml").write_text(page_file("wet.yaml"))
    read = load_recipe("wet.yaml")
    results = evaluate(
        replace(read, layers=(layer,)),
        folder="program",
        planners=[parts["own_planner"].Fan(arcs=5)],
        models=[parts["slope_model"].Steepness(loss_per_deg=0.03)],
        risks=RISKS,
        metrics=[parts["own_metric"].Detour(), Energy(power_w=120)],
        figures=[parts["own_figure"].WhenFailed()],
        world=World.stakes(time_budget_s=20.0),
        maps=MAPS,
        verbose=False,
    )
    assert not any("not reproducible" in note for note in results.notes)
    return results


def test_rows_are_those_of_the_command_in_two_processes(program: Results) -> None:
    assert call("datagen", "create", "wet.yaml", "--out", "wet.h5") == 0
    named = {
        "data": "wet.h5",
        "model": "{part: 'slope_model.py:Steepness', label: 'Steepness:0.03', options: {loss_per_deg: 0.03}}",
        "planners": "[{part: 'own_planner.py:Fan', label: 'Fan:5', options: {arcs: 5}}]",
        "risks": str(RISKS),
        "metrics": "['own_metric.py:Detour', 'energy:120']",
        "figures": "['own_figure.py:WhenFailed']",
        "world": "{preset: stakes, time_budget_s: 20}",
        "maps": MAPS,
        "jobs": 2,
        "out": "command",
    }
    assert call("eval", "run", *(word for name, value in named.items() for word in (f"--{name}", value))) == 0
    ours, theirs = (
        results_of(rows).drop(columns=["data", "condition"])
        for rows in (program.episodes, open_run("command").episodes)
    )
    order = ["scenario", "risk", "map"]
    pd.testing.assert_frame_equal(
        ours.sort_values(order, ignore_index=True), theirs.sort_values(order, ignore_index=True)
    )
    assert {"detour", "energy_j"} <= set(ours)
    assert np.isfinite(ours["energy_j"]).all()
    assert Path("command/figures/when-failed.png").is_file()


def test_a_figure_is_drawn_as_an_object_and_stands_in_the_report(
    program: Results, parts: dict[str, ModuleType], tmp_path: Path
) -> None:
    assert not program.episodes["success"].all()
    assert program.plot(parts["own_figure"].WhenFailed()).axes
    page = program.report(tmp_path / "suite")
    assert "failed episodes ended" in page.read_text()
    renamed = parts["own_figure"].WhenFailed().variant(name="again")
    program.report(tmp_path / "more", figures=[renamed])
    assert (tmp_path / "more" / "figures" / "again.png").is_file()
    assert "success" in dir(program.plot)


def test_a_figure_whose_needs_are_not_met_is_named(program: Results) -> None:
    class Nothing(Figure):
        name = "nothing"

        def needs(self, data: Any) -> bool:
            return False

        def draw(self, data: Any) -> Any:
            raise AssertionError

    with pytest.raises(ConfigError, match="what figure 'nothing' needs"):
        program.plot(Nothing())


def test_a_metric_of_one_process_is_marked_and_not_resumed(dataset_path: Path, tmp_path: Path) -> None:
    class Steps(Metric):
        name = column = "steps"
        meaning = "number of steps"

        def compute(self, episode: Episode) -> float:
            return episode.steps

    given: dict[str, Any] = {"terrain": dataset_path, "planners": ["straight"], "models": ["oracle"]}
    given |= {"metrics": [Steps()], "scenarios": ["std"], "maps": 1, "verbose": False}
    results = evaluate(**given, folder=tmp_path / "run")
    assert (results.episodes["steps"] > 0).all()
    assert any("not reproducible: metric steps" in line for line in results.notes)
    with pytest.raises(ConfigError, match="metric steps was an object of one process"):
        evaluate(**given, folder=tmp_path / "run")
    with pytest.raises(ConfigError, match="which only this process has"):
        evaluate(**given, jobs=2)
