"""Whatever the device, rows and recordings are the same, and nothing waits for it at
every step.
"""

import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from benchnav.core import mixture
from benchnav.core.cvar import Cells
from benchnav.core.device import DeviceError, find_device, gpu_failed
from benchnav.core.errors import ConfigError
from benchnav.core.terrain import Terrain
from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Unit, units
from benchnav.eval.folder.run_folder import open_run, write_run
from benchnav.eval.run import recordings
from benchnav.eval.run import unit as units_of_run
from benchnav.eval.run.rollout import run_episodes
from benchnav.eval.run.runner import run_suite
from benchnav.eval.run.unit import Settings, UnitInputs, run_unit
from benchnav.models.base import TraversabilityModel, predict
from benchnav.models.predictor import Oracle
from benchnav.planning.planners.planner import Plan, Planner
from benchnav.planning.problem import Problem
from benchnav.planning.sensing.sensor import Step
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.simulation import Simulation
from benchnav.planning.world.world import World
from tests import factories
from tests.core.test_mixture import random_mixture
from tests.elsewhere.device import elsewhere, waits

SMALL = {"samples": 20, "horizon_s": 0.4}
DWA = {
    "part": "astar_dwa",
    "options": {"dwa": {"speeds": 3, "turn_rates": 3, "horizon_s": 0.4}},
}
CL_RRT = {"part": "cl_rrt", "options": {"expansions": 25, "edge_time_s": 3.0}}
MPPI = {"part": "mppi", "options": SMALL}
GUIDED = {"part": "astar_mppi", "label": "guided", "options": {"mppi": SMALL}}


def faulty(fault: str) -> dict[str, Any]:
    return {
        "part": "tests.eval.parts:Faulty",
        "label": "faulty",
        "options": {"fault": fault},
    }


def unit_of(data: Path | str, **changes: Any) -> Unit:
    given: dict[str, Any] = {
        "data": str(data), "model": "oracle", "planners": ("straight",), "risks": ("cvar:0.9",),
        "scenarios": ("std",),
    } | changes  # fmt: skip
    given["world"] = {"time_budget_s": 1.2} | given.get("world", {})
    (condition,) = conditions_of(Suite(**given), lambda data: ["std"])
    return Unit(
        condition=condition,
        seed=0,
        realisation=0,
        maps=(0, 1),
        record="all",
        is_first_unit=True,
    )


def run_here(
    unit: Unit, folder: Path, device: torch.device | str = "cpu", limit_s: float = 0.0
) -> None:
    asked = Settings(planner_limit_s=limit_s, device=str(device))
    run_unit(unit, folder, asked.origins().of(unit), asked)


def made(folder: Path) -> dict[str, Any]:
    """All that a unit has written but wall times and what code it was, of which its
    device is one, by file.
    """
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.suffix == ".npz":
            with np.load(path) as stored:
                found |= {f"{name} {key}": stored[key] for key in stored.files}
        elif path.suffix == ".parquet":
            rows = pd.read_parquet(path).drop(columns="code", errors="ignore")
            kind = name.split("/")[0]
            found |= {
                f"{kind} {key}": rows[key].to_numpy()
                for key in rows
                if "planning" not in str(key)
            }
    return found


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"planners": (DWA,)},
        {"planners": (MPPI,)},
        {"planners": (GUIDED,)},
        {"planners": (CL_RRT,)},
        {"planners": (faulty("nan"),)},
        {"planners": (faulty("raise"),)},
        {"world": {"noise": "frozen", "immobile": {"below": 0.2, "for_s": 0.5}}},
        {"planners": (DWA,), "world": {"noise": "frozen"}, "model": "clairvoyant"},
        {"planners": (DWA,), "risks": ("expected-time",)},
        {
            "planners": (DWA,),
            "world": {"noise": "stored"},
            "model": "ideal",
            "risks": ("var:0.9",),
        },
        {"planners": (DWA,), "model": "tests.eval.parts:Broken"},
    ],
)
def test_a_unit_is_the_same_on_another_device(
    changes: dict[str, Any],
    dataset_path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    unit = unit_of(dataset_path, **changes)
    used: set[torch.device] = set()

    def simulate(unit: Unit, built: UnitInputs, *given: Any, **options: Any) -> Any:
        problem = built.problem
        used.update(
            value.device
            for value in (problem.start, problem.risk_map, built.simulation.steps)
        )
        return simulate_here(unit, built, *given, **options)

    simulate_here = units_of_run.simulate
    monkeypatch.setattr(units_of_run, "simulate", simulate)
    run_here(unit, tmp_path / "here")
    with elsewhere() as device:
        used.clear()
        run_here(unit, tmp_path / "there", device=device)
        assert used <= {device}
        assert waits, "nothing was computed there"
    here, there = made(tmp_path / "here"), made(tmp_path / "there")
    assert len(here) > 10
    assert here.keys() == there.keys()
    for name, values in here.items():
        np.testing.assert_array_equal(values, there[name], err_msg=name)


@pytest.mark.parametrize(
    ("planner", "robot"),
    [
        ("straight", "unicycle"),
        (DWA, "unicycle"),
        (MPPI, "differential_drive"),
        (GUIDED, "unicycle"),
    ],
    ids=str,
)
def test_nothing_waits_for_a_device_at_every_step(
    planner: Any, robot: str, dataset_path: Path, tmp_path: Path
) -> None:
    counted = []
    for budget_s in (0.4, 1.2):  # neither is enough to arrive
        unit = unit_of(
            dataset_path,
            planners=(planner,),
            robots=(robot,),
            world={"time_budget_s": budget_s},
        )
        unit = replace(unit, record="steps")
        with elsewhere() as device:
            run_here(unit, tmp_path / f"{budget_s:g}", device=device)
            counted.append(len(waits))
        (path,) = tmp_path.glob(f"{budget_s:g}/units/**/*.parquet")
        assert pd.read_parquet(path)["end_time_s"].to_list() == pytest.approx(
            [budget_s] * 2
        )
    # 8 steps more, and a look at every eighth.
    assert counted[1] - counted[0] <= 8 / 8 + 1


class Exhausted(Planner[Problem]):
    """Finds no memory left on its GPU."""

    def __init__(self, at: str = "plan") -> None:
        self.at = at

    def init(self, problem: Problem, generator: torch.Generator) -> Problem:
        if self.at == "init":
            raise torch.OutOfMemoryError("no memory left\nwhatever else it says")
        return problem

    def plan(self, step: Step, plan_state: Problem) -> Any:
        raise torch.OutOfMemoryError("no memory left\nwhatever else it says")


class Large(Oracle):
    """A model that finds no memory left."""

    def predict_terrain(self, terrain: Terrain) -> Any:
        raise torch.AcceleratorError("device-side assert")


HERE = "tests.elsewhere.units"


@pytest.mark.parametrize(
    ("changes", "limit_s", "said"),
    [
        (
            {"planners": (f"{HERE}:Exhausted",)},
            0.0,
            r"no memory left\. Finished work is kept",
        ),
        (
            {"planners": ({"part": f"{HERE}:Exhausted", "options": {"at": "init"}},)},
            0.0,
            "no memory left",
        ),
        ({"planners": (f"{HERE}:Exhausted",)}, 60.0, "no memory left"),
        ({"model": f"{HERE}:Large", "planners": (DWA,)}, 0.0, "device-side assert"),
    ],
)
def test_a_gpu_that_fails_ends_the_run_and_makes_no_rows(
    changes: dict[str, Any],
    limit_s: float,
    said: str,
    dataset_path: Path,
    tmp_path: Path,
) -> None:
    with pytest.raises(DeviceError, match=said):
        run_here(unit_of(dataset_path, **changes), tmp_path, limit_s=limit_s)
    assert not list(tmp_path.rglob("*.parquet"))


def test_what_a_gpu_said_comes_back_from_a_worker_as_it_is() -> None:
    failed = gpu_failed(
        torch.OutOfMemoryError("no memory left.\nwhatever else it says")
    )
    assert str(failed).startswith(
        "The GPU failed: no memory left. Finished work is kept"
    )
    assert str(pickle.loads(pickle.dumps(failed))) == str(failed)


def test_an_episode_is_replayed_on_the_device_of_its_run(
    dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite = Suite(
        data=str(dataset_path), model="oracle", planners=("straight",), risks=("mean",), scenarios=("std",),
        maps=1, world={"time_budget_s": 2.0}, record="steps",
    )  # fmt: skip
    for _ in run_suite(suite, tmp_path / "run"):
        pass
    about = json.loads((tmp_path / "run" / "run.json").read_text())
    write_run(tmp_path / "run", {**about, "device": "cuda"})
    (unit,) = units(open_run(tmp_path / "run").conditions)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(
        ConfigError,
        match="a GPU that PyTorch can use, got none",
    ):
        recordings.find_recording(tmp_path / "run", unit, 0)
    with elsewhere() as device:
        monkeypatch.setattr(recordings, "device_of_run", lambda about: device)
        assert recordings.find_recording(tmp_path / "run", unit, 0).about["map"] == "0"
        assert waits


def test_a_gpu_convolves_as_the_cpu_does() -> None:
    seen = []

    class Network(TraversabilityModel):
        def predict(self, observation: Any) -> Any:
            cudnn = torch.backends.cudnn
            seen.append((cudnn.allow_tf32, cudnn.deterministic, cudnn.benchmark))
            raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        predict(Network(), factories.terrain(torch.full((1, 8, 8), 0.5)))
    assert seen == [(False, True, False)]


class Late(Planner[Problem]):
    """Stands still; raises at a step when all episodes have ended and nobody has looked
    yet.
    """

    def init(self, problem: Problem, generator: torch.Generator) -> Problem:
        return problem

    def plan(self, step: Step, plan_state: Problem) -> Any:
        if step.time_s > 1.15:
            raise RuntimeError("nobody is left")
        return (
            torch.zeros_like(step.state[:, :2]),
            plan_state,
            Plan.empty(len(step.state), step.state.device),
        )


def test_steps_beyond_the_last_end_harm_nobody() -> None:
    ground, goal = torch.full((2, 16, 16), 0.8), torch.tensor([[6.75, 6.75]] * 2)
    problem = factories.problem(ground, time_budget_s=1.0)
    world = World(time_budget_s=1.0)
    with elsewhere() as device:
        simulation = Simulation(
            factories.terrain(ground).to(device),
            factories.task(),
            world,
            factories.places(goal).to(device),
            0,
            range(2),
        )
        episodes = run_episodes(
            Late(), problem.to(device), simulation, torch.Generator()
        )
    assert episodes.steps.tolist() == [10, 10]
    assert episodes.outcome.tolist() == [Outcome.STALLED] * 2
    assert episodes.actions.shape[1] == 12
    assert (episodes.errors, episodes.traceback) == (("", ""), "")


def test_a_device_that_is_not_there_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert find_device("auto") == find_device("cpu") == torch.device("cpu")
    with pytest.raises(ConfigError, match="GPU"):
        find_device("cuda")
    with pytest.raises(ConfigError, match="among auto, cpu, cuda"):
        find_device("gpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert find_device("auto") == find_device("cuda") == torch.device("cuda")
    assert find_device("cpu") == torch.device("cpu")


def test_a_gpu_takes_all_cells_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made, pieces, search = random_mixture(cells=40), [], mixture.value_at_risk

    def counted(cells: Cells, tail: torch.Tensor) -> torch.Tensor:
        pieces.append(len(tail))
        return search(cells, tail)

    monkeypatch.setattr(mixture, "_CHUNK_NUMBERS_ON_CPU", 32)
    monkeypatch.setattr(mixture, "value_at_risk", counted)
    here = made.var(0.9)
    assert len(pieces) > 1
    pieces.clear()
    with elsewhere() as device:
        there = made.to(device).var(0.9).cpu()
    assert pieces == [here.numel()]
    assert torch.allclose(here, there, rtol=0, atol=1e-9)
