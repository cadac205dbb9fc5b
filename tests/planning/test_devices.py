"""Nothing in the control loop makes a tensor on another device, or waits for a value.

A fake tensor has a device and no values, so that a GPU's code runs where there is none:
an operation that mixes devices raises, and so does whatever asks for a value. Planners
are tried in their own files.

On the host by nature, and so not here: the search of A* (compiled code of SciPy);
whether all episodes of a batch have ended, looked at once a step; the check of stored λ
when a realisation is built, and that of a user's risk map, once an episode each; the
noise of a realisation, drawn on the host and moved once.
"""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorMode

from benchnav.core import registry
from benchnav.core.terrain import Terrain
from benchnav.planning.planners.boundary import act, begin
from benchnav.planning.planners.planner import Plan
from benchnav.planning.planners.straight import Straight
from benchnav.planning.problem import Prediction, Problem, pose_problem
from benchnav.planning.robots import Unicycle
from benchnav.planning.sensing.sensor import Step
from benchnav.planning.world import realisation
from benchnav.planning.world import simulation as simulation_module
from benchnav.planning.world import world as world_module
from benchnav.planning.world.outcome import Outcome, classify_standstill
from benchnav.planning.world.simulation import Simulation, end
from benchnav.planning.world.world import World
from tests import factories

BATCH, SAMPLES = 3, 5


@pytest.fixture(autouse=True)
def _fake() -> Iterator[None]:
    with FakeTensorMode():
        yield


def make_problem(**parts: Any) -> Problem:
    return factories.problem(torch.empty(BATCH, 12, 20), **parts).to("cuda")


def terrain_on_gpu() -> Terrain:
    return factories.terrain(torch.empty(BATCH, 12, 20)).to("cuda")


def gpu(*shape: int) -> Tensor:
    return torch.empty(shape, device="cuda")


def expect(value: Tensor, *shape: int, dtype: torch.dtype = torch.float32) -> None:
    assert (value.device.type, tuple(value.shape), value.dtype) == (
        "cuda",
        shape,
        dtype,
    )


def test_a_tensor_made_on_the_wrong_device_is_seen() -> None:
    """The tests below can fail."""

    class OnHost(Unicycle):
        def __call__(
            self, state: Tensor, action: Tensor, traversability: Tensor
        ) -> Tensor:
            return super().__call__(state, action * torch.ones(2), traversability)

    with pytest.raises(RuntimeError, match="device"):
        OnHost()(gpu(BATCH, 3), gpu(BATCH, 2), gpu(BATCH))
    with pytest.raises(DataDependentOutputException):
        bool(gpu(BATCH).any())


@pytest.mark.parametrize("name", registry.names("robot"))
def test_robots(name: str) -> None:
    robot = registry.make("robot", name)
    state = robot.initial_state(gpu(BATCH, 3))
    size = state.shape[-1]
    expect(state, BATCH, size)
    for leading in ((BATCH,), (BATCH, SAMPLES)):
        expect(
            robot(gpu(*leading, size), gpu(*leading, 2), gpu(*leading)), *leading, size
        )


@pytest.mark.parametrize("name", registry.names("objective"))
def test_objectives(name: str) -> None:
    objective = registry.make("objective", name, robot=Unicycle(), goal_radius_m=1.0)
    state, target = gpu(BATCH, SAMPLES, 3), gpu(BATCH, 1, 2)
    expect(
        objective.stage(state, gpu(BATCH, SAMPLES, 2), gpu(BATCH, SAMPLES), target),
        BATCH,
        SAMPLES,
    )
    expect(objective.terminal(state, gpu(BATCH, SAMPLES), target), BATCH, SAMPLES)


@pytest.mark.parametrize("name", registry.names("risk"))
def test_risk_maps(name: str) -> None:
    mixture = make_problem().distribution
    expect(registry.make("risk", name)(mixture), BATCH, 12, 20)


@pytest.mark.parametrize("robot", registry.names("robot"))
def test_lookups_and_costs_of_a_problem(robot: str) -> None:
    problem = make_problem(robot=registry.make("robot", robot))
    size = problem.start.shape[1]
    state, action = gpu(BATCH, SAMPLES, size), gpu(BATCH, SAMPLES, 2)
    ground, target = problem.ground_at(state), problem.goal_m[:, None]
    expect(ground, BATCH, SAMPLES)
    expect(problem.traversability_at(state), BATCH, SAMPLES)
    expect(problem.free_at(state), BATCH, SAMPLES, dtype=torch.bool)
    expect(problem.stage_cost(state, action, ground, target), BATCH, SAMPLES)
    expect(problem.terminal_cost(state, target), BATCH, SAMPLES)
    for bound in problem.action_bounds:
        expect(bound, 2)


def test_a_problem_is_posed_selected_and_copied_where_it_is() -> None:
    made = make_problem()
    prediction = Prediction(made.observation, made.distribution, made.risk_map)
    posed = pose_problem(made.task, prediction, made.start[:, :2], made.goal_m, 100.0)
    chosen = posed.select(torch.empty(2, dtype=torch.int64, device="cuda"))
    for one, batch in ((posed, BATCH), (posed.clone(), BATCH), (chosen, 2)):
        expect(one.start, batch, 3)
        expect(one.free, batch, 12, 20, dtype=torch.bool)
        expect(one.distribution.means, batch, 1, 12, 20)


@pytest.mark.parametrize("noise", ["resampled", "stored"])
@pytest.mark.parametrize("robot", registry.names("robot"))
def test_the_simulation(
    robot: str, noise: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What is asked of the device once, when episodes begin.
    for module in (realisation, world_module):
        monkeypatch.setattr(module, "bool", lambda values: False, raising=False)
    monkeypatch.setattr(simulation_module, "int", lambda values: 20, raising=False)
    problem = make_problem(robot=registry.make("robot", robot))
    world = World(noise=noise, time_budget_s=2.0)
    places = factories.places(problem.goal_m)
    simulation = Simulation(
        terrain_on_gpu(), problem.task, world, places, 0, range(BATCH)
    )
    now = simulation.init(problem.start)
    for _ in range(2):
        now, met = simulation.step(now, gpu(BATCH, 2))
        expect(now.state, *problem.start.shape)
        expect(now.outcome, BATCH, dtype=torch.int64)
        expect(now.step, BATCH, dtype=torch.int64)
        expect(met, BATCH)
    expect(simulation.unhindered(now, gpu(BATCH, 2)), *problem.start.shape)
    now = end(now, now.running, Outcome.PLANNER_ERROR)
    expect(
        classify_standstill(
            now.outcome, now.step, gpu(BATCH, 21, 2), gpu(BATCH, 20), 0.1
        ),
        BATCH,
        dtype=torch.int64,
    )


def step_of(problem: Problem) -> Step:
    return Step(state=problem.start, traversability=gpu(BATCH), time_s=0.0)


def test_the_boundary_and_the_blind_planner() -> None:
    problem = make_problem()
    answer = act(
        Straight(),
        step_of(problem),
        begin(Straight(), problem, torch.Generator()),
        problem,
    )
    expect(answer.action, BATCH, 2)
    expect(answer.faulty, BATCH, dtype=torch.bool)
    expect(answer.plan.status, BATCH, dtype=torch.int64)


@pytest.mark.parametrize(
    "say",
    [lambda: torch.empty(BATCH, 2), lambda: gpu(1, 2), lambda: None],
    ids=["on the host", "one for all", "none"],
)
def test_what_is_wrong_at_the_boundary_is_told_where_the_states_are(
    say: Callable[[], Any],
) -> None:
    class Wrong(Straight):
        def plan(self, step: Step, plan_state: Problem) -> Any:
            return say(), plan_state, Plan.empty(BATCH, "cuda")

    problem = make_problem()
    answer = act(Wrong(), step_of(problem), problem, problem)
    assert answer.reason.startswith("Expected actions")
    expect(answer.action, BATCH, 2)
    expect(answer.faulty, BATCH, dtype=torch.bool)
    expect(answer.plan.status, BATCH, dtype=torch.int64)
