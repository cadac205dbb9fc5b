from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from benchnav.planning.planners.boundary import (
    NOT_FINITE,
    Answer,
    act,
    begin,
    find_layer_faults,
)
from benchnav.planning.planners.planner import Plan, Planner, PlanStatus
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Unicycle
from benchnav.planning.sensing.sensor import Step
from tests import factories

BATCH = 3


class Says(Planner[str]):
    """A planner that answers what it is told to."""

    def __init__(self, *answer: Any) -> None:
        self.answer = answer

    def init(self, problem: Problem, generator: torch.Generator) -> str:
        return "first"

    def plan(self, step: Step, plan_state: str) -> Any:
        return self.answer if len(self.answer) != 1 else self.answer[0]


def problem(**changes: Any) -> Problem:
    return factories.problem(torch.full((BATCH, 16, 16), 0.8), **changes)


def step_of(given: Problem) -> Step:
    return Step(
        state=given.start, traversability=given.start[:, 0] * torch.nan, time_s=0.0
    )


def ask(*answer: Any, **changes: Any) -> Answer:
    given = problem(**changes)
    return act(Says(*answer), step_of(given), "first", given)


def ahead() -> Tensor:
    return torch.tensor([[1.0, 0.5]]).repeat(BATCH, 1)


def test_a_sound_answer_passes_as_it_is() -> None:
    plan = Plan.empty(
        BATCH,
        status=torch.tensor([0, 1, 2]),
        path=torch.rand(BATCH, 4, 2),
        tree=torch.rand(BATCH, 5, 3, 2),
    )
    answer = ask(ahead(), "next", plan)
    assert torch.equal(answer.action, ahead())
    assert answer.plan_state == "next"
    assert answer.plan is plan
    assert not answer.faulty.any()


def test_what_a_planner_does_to_its_arguments_reaches_nobody() -> None:
    class Vandal(Planner[Problem]):
        def init(self, problem: Problem, generator: torch.Generator) -> Problem:
            for tensor in tensors(problem):
                tensor.zero_()
            return problem

        def plan(self, step: Step, plan_state: Problem) -> tuple[Tensor, Problem, Plan]:
            step.state.fill_(9.0)
            step.traversability.fill_(9.0)
            return ahead(), plan_state, Plan.empty(BATCH)

    def tensors(value: Problem) -> list[Tensor]:
        return [
            value.start, value.goal_m, value.risk_map, value.free, value.elevation_m, value.traversability,
            value.observation.rgb, value.observation.slope_deg, value.distribution.weights, value.distribution.means,
            value.distribution.stds, value.padded_ground, *value.action_bounds,
        ]  # fmt: skip

    given = problem()
    step, before = step_of(given), [tensor.clone() for tensor in tensors(given)]
    plan_state = begin(Vandal(), given, torch.Generator())
    act(Vandal(), step, plan_state, given)
    assert all(
        torch.equal(kept, tensor)
        for kept, tensor in zip(before, tensors(given), strict=True)
    )
    assert step.traversability.isnan().all()


def test_an_action_that_is_written_into_later_stays_what_it_was() -> None:
    said = ahead()
    answer = ask(said, None, Plan.empty(BATCH))
    said.zero_()
    assert torch.equal(answer.action, ahead())


def test_a_learned_policys_graph_is_not_kept() -> None:
    answer = ask(ahead().requires_grad_(), None, Plan.empty(BATCH))
    assert not answer.action.requires_grad


WHOLE = {
    "nothing": ((None,), "Expected `plan` to return (action, plan_state, Plan), got NoneType."),
    "two values": ((ahead(), None), "got 2 values."),
    "a list": (([[1.0, 0.0]] * BATCH, None, Plan.empty(BATCH)), "of shape [3, 2] on cpu, got list."),
    "one action for all": ((ahead()[:1], None, Plan.empty(BATCH)), "got torch.float32 of shape [1, 2] on cpu."),
    "one number an action": ((ahead()[:, :1], None, Plan.empty(BATCH)), "got torch.float32 of shape [3, 1] on cpu."),
    "doubles": ((ahead().double(), None, Plan.empty(BATCH)), "got torch.float64 of shape [3, 2] on cpu."),
    "elsewhere": ((ahead().to("meta"), None, Plan.empty(BATCH)), "got torch.float32 of shape [3, 2] on meta."),
    "no plan": ((ahead(), None, None), "Expected `plan` to return a Plan as its third value, got NoneType."),
    "a status for all": (
        (ahead(), None, Plan.empty(BATCH, status=torch.zeros(1, dtype=torch.int64))),
        "`Plan.status` as torch.int64 of shape [3] on cpu, got torch.int64 of shape [1] on cpu.",
    ),
    "a status by name": (
        (ahead(), None, replace(Plan.empty(BATCH), status=PlanStatus.OK)),
        "of shape [3] on cpu, got PlanStatus.",
    ),
    "a status of floats": (
        (ahead(), None, Plan.empty(BATCH, status=torch.zeros(BATCH))),
        "got torch.float32 of shape [3] on cpu.",
    ),
    "a status elsewhere": (
        (ahead(), None, Plan.empty(BATCH, status=torch.zeros(BATCH, dtype=torch.int64, device="meta"))),
        "got torch.int64 of shape [3] on meta.",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("said", "reason"), WHOLE.values(), ids=WHOLE.keys())
def test_an_answer_of_another_form_is_every_episodes_fault(
    said: tuple[Any, ...], reason: str
) -> None:
    answer = ask(*said)
    assert answer.faulty.tolist() == [True] * BATCH
    assert reason in answer.reason
    assert "\n" not in answer.reason
    assert answer.action.tolist() == [[0.0, 0.0]] * BATCH
    assert answer.plan.status.tolist() == [PlanStatus.OK] * BATCH
    assert answer.plan_state == "first"


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_an_action_that_is_not_finite_is_its_own_episodes_fault(value: float) -> None:
    said = ahead()
    said[1, 1] = value
    backward = Unicycle(speed_mps=(0.2, 1.0), turn_rate_radps=(-2.0, -0.5))
    answer = ask(said, "next", Plan.empty(BATCH), robot=backward)
    assert answer.faulty.tolist() == [False, True, False]
    assert answer.reason == NOT_FINITE
    # Of what the robot can do, the nearest to nothing; its neighbours' actions stand.
    assert answer.action[1].tolist() == pytest.approx([0.2, -0.5])
    assert torch.equal(answer.action[::2], ahead()[::2])
    assert answer.plan_state == "next"


def test_layers_that_cannot_be_drawn_are_left_out_and_harm_no_episode() -> None:
    plan = Plan.empty(BATCH, status=torch.tensor([0, 1, 2]), path=torch.rand(1, 4, 2))
    answer = ask(ahead(), None, plan)
    assert not answer.faulty.any()
    assert answer.plan.path.shape == (BATCH, 0, 2)
    assert answer.plan.status.tolist() == [0, 1, 2]
    assert find_layer_faults(plan, problem()) == [
        "Expected `Plan.path` of shape [3, N, 2], got [1, 4, 2]."
    ]
    samples = replace(Plan.empty(BATCH), samples=torch.rand(BATCH, 4, 2), tree=None)  # type: ignore[arg-type]
    assert find_layer_faults(samples, problem()) == [
        "Expected `Plan.samples` of shape [3, M, N, 2], got [3, 4, 2].",
        "Expected `Plan.tree` of shape [3, E, N, 2], got NoneType.",
    ]


def test_what_a_planner_raises_passes_through() -> None:
    class Raises(Says):
        def init(self, problem: Problem, generator: torch.Generator) -> str:
            raise RuntimeError("in init")

        def plan(self, step: Step, plan_state: str) -> Any:
            raise RuntimeError("in plan")

    with pytest.raises(RuntimeError, match="in init"):
        begin(Raises(), problem(), torch.Generator())
    with pytest.raises(RuntimeError, match="in plan"):
        act(Raises(), step_of(problem()), "first", problem())
