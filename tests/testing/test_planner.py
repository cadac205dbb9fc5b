import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.planning.free_space import FreeSpace, Rules
from benchnav.planning.objective import GoalDistance
from benchnav.planning.planners.planner import INPUTS, Plan, Planner, check_steers
from benchnav.planning.planners.straight import Straight
from benchnav.planning.problem import Problem, Task
from benchnav.planning.robots import DifferentialDrive, Unicycle
from benchnav.planning.sensing.sensor import Step
from benchnav.testing import check_planner
from tests.testing.refusal import refusal

FEW = {"samples": 128, "horizon_s": 2.0}
SMALL = {
    "mppi": FEW,
    "astar_mppi": {"mppi": FEW},
    "cl_rrt": {"expansions": 50},
    "near_optimal": {"headings": 16, "levels": 1},
}


@dataclass
class Carried:
    """A plan state that can be written into."""

    problem: Problem
    last: Tensor
    noise: Tensor
    count: int = 0


class Good(Planner[Any]):
    """Turns by what is predicted, by its noise and by what it did last; draws a line
    when asked to.
    """

    steers = (("speed_mps", "turn_rate_radps"),)

    def init(self, problem: Problem, generator: torch.Generator) -> Any:
        noise = torch.rand((), generator=generator)
        return Carried(problem, torch.zeros(len(problem)), noise)

    def plan(self, step: Step, plan_state: Any) -> Any:
        speed = plan_state.problem.traversability_at(step.state).clamp(max=1)
        turn = 0.5 * plan_state.last + 0.1 * plan_state.noise
        following = replace(plan_state, last=turn, count=plan_state.count + 1)
        path = step.state[:, None, :2].repeat(1, 3 if step.draw else 0, 1)
        return (
            torch.stack((speed, turn), dim=1),
            following,
            Plan.empty(len(turn), path=path),
        )


def acting(act: Callable[[Step, Any], object]) -> Good:
    """Good, but for what it does before it plans."""

    class Bad(Good):
        def plan(self, step: Step, plan_state: Any) -> Any:
            act(step, plan_state)
            return super().plan(step, plan_state)

    return Bad()


def answering(change: Callable[[Tensor, Any, Plan, Step], Any]) -> Good:
    """Good, but for what it answers."""

    class Bad(Good):
        def plan(self, step: Step, plan_state: Any) -> Any:
            return change(*super().plan(step, plan_state), step)

    return Bad()


def action_of(change: Callable[[Tensor, Step], Tensor]) -> Good:
    return answering(
        lambda action, following, plan, step: (change(action, step), following, plan)
    )


def plan_of(change: Callable[[Plan], Any]) -> Good:
    return answering(
        lambda action, following, plan, step: (action, following, change(plan))
    )


def preparing(act: Callable[[Problem, torch.Generator], object]) -> Good:
    class Bad(Good):
        def init(self, problem: Problem, generator: torch.Generator) -> Any:
            act(problem, generator)
            return super().init(problem, generator)

    return Bad()


def using(names: set[str], speed: Callable[[Step, Problem], Tensor]) -> Good:
    """Good, but for its speed, with what it says that it uses."""

    class Bad(Good):
        def uses(self, task: Any) -> frozenset[str]:
            return frozenset(names)

        def plan(self, step: Step, plan_state: Any) -> Any:
            action, following, plan = super().plan(step, plan_state)
            fast = speed(step, plan_state.problem).to(action).clamp(0, 1)
            return torch.stack((fast, action[:, 1]), 1), following, plan

    return Bad()


def having(**attributes: Any) -> Good:
    return type("Bad", (Good,), attributes)()


def count_up(plan_state: Any) -> None:
    plan_state.count += 1


def poke(action: Tensor, step: Step) -> Tensor:
    action = action.clone()
    action[-1, 1] = torch.nan
    return action


def leave_the_map(step: Step, plan_state: Any) -> None:
    if (step.state[:, :2] < 0).any():
        raise IndexError("off the map")


class OnSelf(Good):
    """Remembers its last turn itself."""

    last = 0.0

    def plan(self, step: Step, plan_state: Any) -> Any:
        action, following, plan = super().plan(step, plan_state)
        self.last = 0.5 * self.last + 0.1
        return action + torch.tensor([0.0, self.last]), following, plan


class ProblemOnSelf(Good):
    """Remembers the problem itself."""

    def init(self, problem: Problem, generator: torch.Generator) -> Any:
        self.goal_m = problem.goal_m
        return super().init(problem, generator)

    def plan(self, step: Step, plan_state: Any) -> Any:
        action, following, plan = super().plan(step, plan_state)
        return action + 0 * self.goal_m.expand(len(action), 2), following, plan


class LastSeen(Good):
    """Remembers how many episodes it was given last, itself."""

    def init(self, problem: Problem, generator: torch.Generator) -> Any:
        self.turn = 0.5 if problem.traversability[0, 0, 0] > 0.5 else 0.1
        return super().init(problem, generator)

    def plan(self, step: Step, plan_state: Any) -> Any:
        action, following, plan = super().plan(step, plan_state)
        return (
            torch.stack((action[:, 0], torch.full_like(action[:, 1], self.turn)), 1),
            following,
            plan,
        )


class Unseeded(Good):
    def init(self, problem: Problem, generator: torch.Generator) -> Any:
        return super().init(
            problem, torch.Generator().manual_seed(torch.Generator().seed() % 2**60)
        )


class NoiseOfBatch(Good):
    """Draws noise for each episode in turn, so that an episode's hangs on its place."""

    def init(self, problem: Problem, generator: torch.Generator) -> Any:
        return replace(
            super().init(problem, generator),
            noise=torch.rand(len(problem), generator=generator),
        )


class Draws(Good):
    """Keeps a generator in its plan state and draws from it while it plans."""

    def init(self, problem: Problem, generator: torch.Generator) -> Any:
        made = super().init(problem, generator)
        made.generator = generator
        return made

    def plan(self, step: Step, plan_state: Any) -> Any:
        noise = torch.rand((), generator=plan_state.generator)
        action, following, plan = super().plan(step, plan_state)
        following.generator = plan_state.generator
        return action + noise * torch.tensor([0.0, 0.1]), following, plan


BAD: dict[str, tuple[Any, str]] = {
    "no planner": (object(), "Expected the planner to be an instance of benchnav.planning.Planner, got object"),
    "writes into the states": (acting(lambda step, _: step.state.zero_()), "got changes in step.state."),
    "writes into what was observed": (
        acting(lambda step, _: step.traversability.zero_()),
        "got changes in step.traversability.",
    ),
    "writes into the map": (acting(lambda _, s: s.problem.risk_map.mul_(0.5)), "got changes in problem.risk_map."),
    "writes into the goal": (preparing(lambda p, _: p.goal_m.add_(1)), "`init` to leave its arguments unchanged"),
    "writes into the prediction": (preparing(lambda p, _: p.distribution.means.zero_()), "problem.distribution.means"),
    "writes into the image": (preparing(lambda p, _: p.observation.rgb.add_(1)), "problem.observation.rgb"),
    "writes into the plan state": (acting(lambda _, s: s.last.add_(0.1)), "got changes in plan_state.last."),
    "counts in the plan state": (acting(lambda _, s: count_up(s)), "got changes in plan_state.count."),
    "draws from the plan state": (Draws(), "got changes in plan_state.generator"),
    "no number": (action_of(poke), "Expected finite actions"),
    "one action for all": (action_of(lambda action, _: action[:1]), "got torch.float32 of shape [1, 2]"),
    "doubles": (action_of(lambda action, _: action.double()), "got torch.float64 of shape [4, 2]"),
    "elsewhere": (action_of(lambda action, _: action.to("meta")), "on cpu, got torch.float32 of shape [4, 2] on meta"),
    "too fast": (action_of(lambda action, _: action + 0.5), "within the robot's bounds"),
    "no plan": (plan_of(lambda plan: None), "Expected `plan` to return a Plan as its third value"),
    "an unknown status": (plan_of(lambda plan: replace(plan, status=plan.status + 3)), "values of `PlanStatus` (0–2)"),
    "a status for all": (plan_of(lambda plan: replace(plan, status=plan.status[:1])), "got torch.int64 of shape [1]"),
    "a path for all": (plan_of(lambda plan: replace(plan, path=plan.path[:1])), "shape [4, N, 2], got [1, 3, 2]"),
    "raises": (acting(lambda step, _: step.state[9]), "Expected a result from `plan`, got IndexError"),
    "raises off the map": (acting(leave_the_map), "got IndexError: off the map"),
    "raises in init": (preparing(lambda p, _: p.goal_m[9]), "Expected a result from `init`, got IndexError"),
    "PyTorch's generator": (acting(lambda *_: torch.rand(1)), "PyTorch's global generator"),
    "PyTorch's seed in init": (preparing(lambda *_: torch.manual_seed(20_261)), "PyTorch's global generator"),
    "NumPy's generator": (acting(lambda *_: np.random.rand()), "NumPy's global generator"),  # noqa: NPY002
    "Python's generator": (acting(lambda *_: random.random()), "Python's global generator"),
    "evolves on self": (OnSelf(), "got a different action when called again"),
    "keeps the problem on self": (ProblemOnSelf(), "same after other steps and problems"),
    "keeps what it saw on self": (LastSeen(), "same after other steps and problems"),
    "no seed": (Unseeded(), "from a generator of the same seed, got a different action"),
    "drives otherwise when drawn": (action_of(lambda a, step: 0.9 * a if step.draw else a), "for any `Step.draw`"),
    "an action of the batch": (action_of(lambda a, _: a - 0.1 * a.mean(0)), "same action for a single episode"),
    "noise of the batch": (NoiseOfBatch(), "same action for a single episode"),
    "blind that is not": (having(blind=True), "value of `risk_map`, got a different action. Add 'risk_map' to `uses`"),
    "uses λ̂ later on and does not say so": (
        using({"distribution"}, lambda step, p: p.traversability_at(step.state) * (step.time_s > 0)),
        "for any value of `risk_map`",
    ),
    "uses free space by risk and says the mean": (
        using({"distribution"}, lambda step, p: p.free_at(step.state)), "for any value of `risk_map`",
    ),
    "uses free space by the mean and says λ̂": (
        using({"risk_map"}, lambda step, p: p.free_at(step.state)), "for any value of `distribution`",
    ),
    "uses fields and does not say so": (
        using({"risk_map"}, lambda step, p: p.sample_fields(1, 7)[:, 0, 8, 8]), "for any value of `fields`",
    ),
    "uses what is no input": (
        using({"free"}, lambda step, p: p.goal_m[:, 0]), "names from (distribution, fields, risk_map), got frozenset",
    ),
    "blind that uses something": (
        type("Bad", (Straight,), {"uses": lambda self, task: INPUTS})(), "`uses` of a `blind` planner",
    ),
    "follows no text": (having(follows=lambda self, task: 3), "Expected `follows` to return a single line"),
    "follows that is text": (having(follows="time"), "from `follows`, got TypeError"),
    "steers by one name": (having(steers=("speed_mps", "turn_rate_radps")), "to be a tuple of tuples of action names"),
    "steers nothing": (having(steers=()), "steer at least one of the tried robots, got a planner that steers none"),
    "remarks that are no tuple": (having(remarks=lambda self, task: "slow"), "to return a tuple of single lines"),
    "remarks that raise": (having(remarks=lambda self, task: task.wheels), "from `remarks`, got AttributeError"),
}  # fmt: skip


@pytest.mark.parametrize(("planner", "expected"), BAD.values(), ids=BAD.keys())
def test_a_breach_is_caught_and_named(planner: Any, expected: str) -> None:
    assert expected in refusal(check_planner, planner)


def test_a_good_planner_passes_on_maps_worth_trying() -> None:
    problems: list[Problem] = []
    steps: list[Step] = []

    class Spy(Good):
        def init(self, problem: Problem, generator: torch.Generator) -> Any:
            problems.append(problem)
            return super().init(problem, generator)

        def plan(self, step: Step, plan_state: Any) -> Any:
            steps.append(step)
            return super().plan(step, plan_state)

    check_planner(Spy())
    tried = {(len(one), *one.grid.shape) for one in problems}
    assert tried == {
        (batch, *shape) for batch in (4, 2, 1) for shape in ((24, 24), (20, 33))
    }
    # The robot stands on ground predicted 0 in one of them, and a wall is closed in
    # another.
    assert (problems[0].risk_map.amin(dim=(1, 2)) == 0).tolist() == [
        False,
        False,
        True,
        True,
    ]
    starts = [
        one.grid.lookup(one.grid.pad(one.risk_map, 0.0), *one.start.T[:2])
        for one in problems[:1]
    ]
    assert starts[0][2] == 0
    shut = ~problems[0].free.any(dim=2)
    assert shut.any(dim=1).tolist() == [False, True, False, False]
    assert {one.draw for one in steps} == {True, False}
    assert any(one.traversability.isnan().all() for one in steps)
    assert any(one.traversability.isfinite().all() for one in steps)
    assert max(one.time_s for one in steps) > 0
    assert any((one.state[:, :2] < 0).any() for one in steps)


def test_every_breach_is_named_once_with_the_robots_and_maps_it_was_found_on() -> None:
    bad = answering(
        lambda a, following, plan, step: (
            a + 5,
            following,
            replace(plan, status=plan.status + 3),
        )
    )
    with pytest.raises(ConfigError) as caught:
        check_planner(
            bad, robots=["unicycle", DifferentialDrive()], shapes=((9, 16), (12, 14))
        )
    message = str(caught.value)
    assert (
        message.count("within the robot's bounds")
        == message.count("values of `PlanStatus` (0–2)")
        == 1
    )
    assert message.count("[in all cases]\n(2) ") == 1
    assert message.endswith("[in all cases]")


def test_a_breach_that_is_not_everywhere_names_its_robots_and_maps_and_an_error_its_line() -> (
    None
):
    class Small(Good):
        def init(self, problem: Problem, generator: torch.Generator) -> Any:
            if problem.grid.shape[0] < 12:
                raise ValueError("too small")
            return super().init(problem, generator)

    with pytest.raises(ConfigError) as caught:
        check_planner(
            Small(),
            robots=["unicycle", DifferentialDrive()],
            shapes=((9, 16), (12, 14)),
        )
    line = Small.init.__code__.co_firstlineno + 2
    said = f"got ValueError: too small (test_planner.py, line {line})"
    assert f"{said} [unicycle on 9×16, DifferentialDrive on 9×16]" in str(caught.value)


def test_a_robot_that_it_does_not_steer_is_left_out() -> None:
    named: list[tuple[str, ...]] = []

    class Names(Good):
        def init(self, problem: Problem, generator: torch.Generator) -> Any:
            named.append(problem.robot.action_names)
            return super().init(problem, generator)

    check_planner(Names(), shapes=((12, 12),))
    assert set(named) == {("speed_mps", "turn_rate_radps")}
    with pytest.raises(ConfigError, match="to steer at least one of the tried robots"):
        check_planner(Names(), robots=["bicycle"])


def test_parts_are_taken_by_name_mapping_or_as_objects() -> None:
    with pytest.raises(ConfigError, match="Did you mean 'straight'"):
        check_planner("straigt")
    seen: list[Problem] = []
    spy = preparing(lambda problem, _: seen.append(problem))
    check_planner(
        spy,
        robots=[{"part": "unicycle", "options": {"dt_s": 0.2}}],
        objective="travel_time",
    )
    assert {one.dt_s for one in seen} == {0.2}
    assert type(seen[0].objective).__name__ == "TravelTime"
    assert seen[0].objective.robot.dt_s == 0.2  # type: ignore[attr-defined]
    seen.clear()
    check_planner(spy, robots=[Unicycle()])
    assert isinstance(seen[0].objective, GoalDistance)


def test_the_tolerance_is_of_an_episode_alone() -> None:
    nearly = action_of(lambda action, _: action - 1e-2 * action.mean(0))
    check_planner(nearly, tolerance=0.02)
    with pytest.raises(ConfigError, match="a single episode"):
        check_planner(nearly)


def test_a_blind_planner_may_be_right_about_itself() -> None:
    assert Straight.blind
    check_planner(Straight())


@pytest.mark.parametrize("robot", registry.names("robot"))
@pytest.mark.parametrize("planner", registry.names("planner"))
def test_every_registered_planner_keeps_the_contract(planner: str, robot: str) -> None:
    made = registry.make(
        "planner", {"part": planner, "options": SMALL.get(planner, {})}
    )
    try:
        check_steers(made, registry.make("robot", robot), planner)
    except ConfigError:
        pytest.skip("it does not steer this robot")
    # It simulates whole episodes, which take fewer steps of a longer time.
    options = {"dt_s": 1.0} if planner == "near_optimal" else {}
    check_planner(made, robots=[{"part": robot, "options": options}])


COST = {"samples": 16, "risk_on": "cost", "fields": 3, "horizon_s": 1.0}
MAPS = {"risk_map", "distribution"}
MEAN_FREE = Rules(free_space=FreeSpace(by="mean"))


@pytest.mark.parametrize(
    ("part", "options", "objective", "by_mean", "by_risk"),
    [
        (
            "mppi",
            COST,
            "goal_distance",
            {"fields", "distribution"},
            {"fields", "risk_map"},
        ),
        (
            "mppi",
            COST | {"cost_to_go": "map"},
            "travel_time",
            INPUTS,
            {"fields", "risk_map"},
        ),
        ("mppi", FEW | {"cost_to_go": "expected-time"}, "travel_time", MAPS, MAPS),
        (
            "astar_mppi",
            {"mppi": COST},
            "goal_distance",
            {"fields", "distribution"},
            {"fields", "risk_map"},
        ),
        ("astar_mppi", {"mppi": COST}, "travel_time", INPUTS, {"fields", "risk_map"}),
        ("astar_dwa", {"explore": 0.5}, "travel_time", MAPS, MAPS),
        ("astar_dwa", {"explore": 0.5}, "goal_distance", MAPS, {"risk_map"}),
        ("straight", {}, "goal_distance", set(), set()),
    ],
)
def test_planners_say_what_they_use(
    part: str,
    options: dict[str, Any],
    objective: str,
    by_mean: set[str],
    by_risk: set[str],
) -> None:
    planner, robot = (
        registry.make("planner", {"part": part, "options": options}),
        Unicycle(),
    )
    cost = registry.make("objective", objective, robot=robot, goal_radius_m=1.0)
    task = Task(robot=robot, objective=cost, rules=MEAN_FREE)
    assert planner.uses(task) == by_mean
    assert planner.uses(replace(task, rules=Rules())) == by_risk
    check_planner(planner, robots=[robot], objective=objective, shapes=((16, 16),))


@pytest.mark.parametrize("order", ["kept", "sorted"])
def test_what_select_keeps_has_to_be_those_that_were_asked_for(order: str) -> None:
    class Leaving(Good):
        def select(self, plan_state: Any, members: Tensor) -> Any:
            chosen = members if order == "kept" else members.sort().values
            return replace(
                plan_state,
                problem=plan_state.problem.select(chosen),
                last=plan_state.last[chosen],
            )

    if order == "kept":
        check_planner(Leaving(), robots=[Unicycle()])
        return
    with pytest.raises(ConfigError, match="Expected `select` to leave the actions"):
        check_planner(Leaving(), robots=[Unicycle()])
