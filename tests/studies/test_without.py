from pathlib import Path

import pytest
import torch

from benchnav.core import registry
from benchnav.core.settings import of, read
from benchnav.core.yaml_text import read_yaml
from benchnav.eval import Suite
from benchnav.planning.world.outcome import Outcome
from tests.planning.planners.test_planners import run

ROOT = Path(__file__).parents[2]
PARTS = f"{ROOT}/studies/planners/without.py"


@pytest.mark.parametrize("name", ["NoLines", "NoHalving"])
def test_a_planner_without_its_part_drives(name: str) -> None:
    driven = run(
        f"{PARTS}:{name}", "unicycle", torch.full((2, 16, 20), 0.85), goal=(8.25, 6.25)
    )
    assert driven.outcome.tolist() == [Outcome.SUCCESS] * 2


def test_the_suite_names_planners_that_are_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(ROOT)
    suite = read(
        Suite, read_yaml(Path("studies/planners/without.yaml")), of("the suite")
    )
    made = [
        type(registry.make("planner", planner)).__name__ for planner in suite.planners
    ]
    assert made == ["AStarDWA", "NoLines", "CLRRT", "NoHalving"]
