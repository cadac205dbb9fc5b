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
from benchnav.eval import evaluate, open_run
from benchnav.metrics import Energy, Episode, Metric
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
RISKS, MAPS = ["mean", "cvar:0.8"], 2


def page_file(name: str) -> str:
    """A file that the page on layers of one's own shows."""
    return next(block.body for block in blocks(DOCS / "how-to" / "own-layer.md") if block.file == name)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A working folder with a file a part, which programs import and commands name."""
    folder = tmp_path_factory.mktemp("outside")
    for name in ("own_metric.py", "own_planner.py"):
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
    return {name: import_module(name) for name in ("own_metric", "own_planner", "slope_model", "wet")}


@pytest.mark.parametrize("name", ["own_metric.py", "own_planner.py", "slope_model.py", "wet.py"])
def test_each_part_is_one_file_of_at_most_forty_lines(place: Path, name: str) -> None:
    code = [line for line in (place / name).read_text().splitlines() if line.strip()]
    assert len(code) <= 40


@pytest.fixture(scope="module")
def program(parts: dict[str, ModuleType]) -> pd.DataFrame:
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
        maps=MAPS,
        verbose=False,
    )
    assert not any("not reproducible" in note for note in results.notes)
    return results.episodes


def test_rows_are_those_of_the_command_in_two_processes(program: pd.DataFrame) -> None:
    assert call("datagen", "create", "wet.yaml", "--out", "wet.h5") == 0
    named = {
        "data": "wet.h5",
        "model": "{part: 'slope_model.py:Steepness', label: 'Steepness:0.03', options: {loss_per_deg: 0.03}}",
        "planners": "[{part: 'own_planner.py:Fan', label: 'Fan:5', options: {arcs: 5}}]",
        "risks": str(RISKS),
        "metrics": "['own_metric.py:Detour', 'energy:120']",
        "maps": MAPS,
        "jobs": 2,
        "out": "command",
    }
    assert call("eval", "run", *(word for name, value in named.items() for word in (f"--{name}", value))) == 0
    ours, theirs = (
        results_of(rows).drop(columns=["data", "condition"])
        for rows in (program, open_run("command").episodes)
    )
    order = ["scenario", "risk", "map"]
    pd.testing.assert_frame_equal(
        ours.sort_values(order, ignore_index=True), theirs.sort_values(order, ignore_index=True)
    )
    assert {"detour", "energy_j"} <= set(ours)
    assert np.isfinite(ours["energy_j"]).all()


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
