"""A suite can be asked whether its conditions repeat, and names those that do not, with
the cause.
"""

import multiprocessing
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Unit, units
from benchnav.eval.run import determinism
from benchnav.eval.run.check import check_suite
from benchnav.eval.run.determinism import check_determinism
from benchnav.eval.run.unit import Settings

PARTS = """
import random, time

import numpy as np
import torch
from benchnav.planning import Plan, Planner

COUNT = []


class Steady(Planner):
    steers = (("speed_mps", "turn_rate_radps"),)

    def init(self, problem, generator):
        return 0

    def plan(self, step, plan_state):
        action = torch.zeros(len(step.state), 2)
        action[:, 0] = 0.3 + 0.2 * self.draw()
        return action, plan_state, Plan.empty(len(step.state))

    def draw(self):
        return 0.5


class Clock(Steady):
    def draw(self):
        return time.perf_counter_ns() % 1009 / 1009


class Python(Steady):
    def draw(self):
        return random.random()


class NumPy(Steady):
    def draw(self):
        return np.random.rand()


class Torch(Steady):
    def draw(self):
        return torch.rand(()).item()


class Counting(Steady):
    def draw(self):
        COUNT.append(1)
        return min(len(COUNT) / 1e4, 1.0)
"""


def suite_of(dataset: Path, folder: Path, *names: str) -> Suite:
    (folder / "parts.py").write_text(PARTS)
    return Suite(
        data=str(dataset), model="oracle", planners=tuple(f"{folder / 'parts.py'}:{name}" for name in names),
        risks=("mean",), scenarios=("std",), maps=2, world={"time_budget_s": 0.6}, record="none",
    )  # fmt: skip


def run_forked(chosen: Sequence[Unit], settings: Settings) -> Any:
    """Run units in a fork, which starts sooner than a new process."""
    with multiprocessing.get_context("fork").Pool(1) as pool:
        return pool.apply(determinism._run_units, (Path.cwd(), chosen, settings))


def test_conditions_that_do_not_repeat_are_named_with_the_cause(
    dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(determinism, "_run_fresh", run_forked)
    names = ("Steady", "Clock", "Python", "NumPy", "Torch", "Counting")
    suite = suite_of(dataset_path, tmp_path, *names)
    said: list[str] = []
    count, lines = check_determinism(suite, said.append)
    assert count == len(names)
    assert len(said) == 1
    causes = {
        line.partition("planner ")[2].partition(",")[0]: line.rpartition("; ")[2]
        for line in lines
    }
    assert causes == {
        "Clock": "a part depends on external input, such as a clock, entropy or the order of threads",
        "Python": "a part draws from the global generator of random",
        "NumPy": "a part draws from the global generator of numpy.random",
        "Torch": "a part draws from the global generator of torch",
        "Counting": "a part keeps state between episodes or units, so that rows depend on earlier episodes",
    }
    assert not any("planning" in line for line in lines)


def test_units_run_in_a_new_process(dataset_path: Path, tmp_path: Path) -> None:
    suite = suite_of(dataset_path, tmp_path, "Counting")
    unit, *_ = units(check_suite(suite, uses_workers=True).conditions)
    (rows, generators), (more, _) = determinism._run_fresh([unit, unit], Settings())
    assert len(rows) == 2
    assert generators == ()
    assert not rows.equals(more)  # one process has run both
    counts = [
        vars(module)["COUNT"]
        for module in list(sys.modules.values())
        if str(tmp_path) in str(getattr(module, "__file__", ""))
    ]
    assert counts == [[]]  # and this process none
