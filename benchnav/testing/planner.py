"""The contract of planners, tried on small maps made on the spot.

Letters in shapes: B episodes, H×W cells, S state and A action dimensions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Observation
from benchnav.planning.free_space import FreeSpace, Rules
from benchnav.planning.objective import GoalDistance
from benchnav.planning.planners.boundary import (
    NOT_FINITE,
    find_fault,
    find_layer_faults,
)
from benchnav.planning.planners.planner import INPUTS, Plan, Planner, PlanStatus
from benchnav.planning.problem import Prediction, Problem, Task, pose_problem
from benchnav.planning.sensing.belief import Fields, Law, Static
from benchnav.planning.sensing.sensor import Step
from benchnav.testing.breaches import NOTHING, SEED, Breaches, same

_RESOLUTION_M = 0.5
_STEPS = 3


def check_planner(
    planner: Any,
    robots: Sequence[Any] | None = None,
    objective: Any = None,
    shapes: Sequence[tuple[int, int]] = ((24, 24), (20, 33)),
    device: torch.device | str = "cpu",
    tolerance: float = 1e-3,
) -> None:
    """Tries whether a planner keeps the contract, by letting it plan a few steps on
    four maps.

    For the tests of whoever writes a planner, as Gymnasium's `check_env` is for those
    of an environment: one that passes can be evaluated like any other, and its rows do
    not hang on the batch, the order or what is drawn.

    The maps: free ground, a closed wall, a start on ground predicted to immobilise the
    robot, a wall with a gap.
    The contract: finite actions within the robot's bounds, of shape [B, A], in the
    states' dtype and on their device; a `Plan` with a `PlanStatus` for each episode,
    and layers of the shapes that it names; the problem, the step and the plan state
    left as they were, and with them the global generators of Python, NumPy and PyTorch;
    the same answer when asked again, from the same seed, after other problems were
    begun, and whether it is drawn or not; for an episode alone, and for some that
    `select` keeps, what it is in a batch; no error where some robots of the batch have
    arrived or left the map. What a planner makes of a closed wall is its own affair.
    What it does not name in `uses` is replaced, under rules by which free space comes
    from λ̂ and from the prediction; no action may change.

    Args:
        planner: any planner, or the name, file or mapping of one as suites have it.
        robots: likewise; every registered one when not given. Those that the planner
            does not steer, by its `steers`, are left out.
        objective: likewise; the goal distance when not given.
        shapes: (H, W) of the maps to try.
        device: where the problems are.
        tolerance: by how much an action alone and in a batch may differ, as a share of
            its bounds' range.

    Raises:
        ConfigError: the planner breaks the contract; every breach is named.
    """
    made = registry.take("planner", planner)
    breaches = Breaches("planner", type(made).__name__)
    named = made.steers is None or (
        isinstance(made.steers, tuple) and all(map(_are_lines, made.steers))
    )
    breaches.expect(
        named, f"Expected `steers` as tuples of action names, got {made.steers!r}."
    )
    breaches.expect(
        isinstance(made.blind, bool),
        f"Expected `blind` of type bool, got {made.blind!r}.",
    )
    breaches.refuse()
    steered, rules = 0, Rules()
    for given in registry.names("robot") if robots is None else robots:
        robot = registry.take("robot", given)
        if made.steers is not None and tuple(robot.action_names) not in made.steers:
            continue
        if made.robots is not None and type(robot) not in made.robots:
            continue
        steered += 1
        name = given if isinstance(given, str) else type(robot).__name__
        goal = objective or GoalDistance()
        goal = registry.take(
            "objective", goal, robot=robot, goal_radius_m=rules.goal_radius_m
        )
        for height, width in shapes:
            breaches.place = f"{name} on {height}×{width}"
            task = Task(robot=robot, objective=goal, rules=rules)
            posed = _make_problem(
                task, height, width, torch.device(device), made.given_truth
            )
            _Trial(made, posed, tolerance, breaches).run()
        for by in ("risk", "mean"):
            breaches.place = f"{name} on {shapes[0][0]}×{shapes[0][1]}"
            task = Task(
                robot=robot,
                objective=goal,
                rules=replace(rules, free_space=FreeSpace(by=by)),
            )
            posed = _make_problem(
                task, *shapes[0], torch.device(device), made.given_truth
            )
            _Trial(made, posed, tolerance, breaches).check_uses()
    breaches.expect(
        steered > 0, "Expected a robot among those tried that it steers, got none."
    )
    breaches.refuse()


def _are_lines(values: Any) -> bool:
    return isinstance(values, tuple) and all(
        isinstance(line, str) and "\n" not in line for line in values
    )


@dataclass(frozen=True)
class _Trial:
    """A planner on one batch, and where its breaches are noted."""

    planner: Planner[Any]
    problem: Problem
    tolerance: float
    breaches: Breaches

    def run(self) -> None:
        """Plans some steps, then anew under what should change nothing; stops at what
        makes the rest meaningless.
        """
        problem, start = self.problem, self.problem.start
        self.check_words()
        first = plan_state = self.begin(problem)
        step = Step(
            state=start,
            traversability=torch.full_like(start[:, 0], torch.nan),
            time_s=0.0,
        )
        tried: list[tuple[Step, Tensor]] = []
        last = torch.tensor([len(problem) - 1], device=start.device)
        two = torch.cat((last, last - 1))
        for number in range(_STEPS + 1):
            running = (
                torch.arange(len(problem), device=start.device)
                >= (number == _STEPS) * two[1]
            )
            step = _step(problem, step, ~running, number)
            answer = self.ask(step, plan_state, problem)
            if answer is NOTHING:
                return
            action, following, plan = answer
            self.check_answer(action[running], plan)
            self.ask_again(step, plan_state, action)
            tried.append((step, action))
            plan_state, observed = following, problem.traversability_at(step.state)
            moved = problem.robot(
                step.state, action.clamp(*problem.action_bounds), observed
            )
            step = replace(step, state=moved, traversability=observed)
        again = (
            "Expected the same action from a generator of the same seed, got another."
        )
        following = self.expect_action(again, tried[0], self.begin(problem), problem)
        plan_state = self.begin(problem.select(last))
        for answered in tried[:_STEPS]:
            alone = (
                "Expected for an episode alone the action that it got in a "
                "batch, "
                "got another."
            )
            plan_state = self.expect_action(alone, answered, plan_state, problem, last)
        act = partial(self.planner.select, following, two)
        kept = (
            NOTHING
            if following is NOTHING
            else self.breaches.watch("select", act, plan_state=following)
        )
        if kept is not NotImplemented:
            among = (
                "Expected of episodes that `select` keeps the actions that they "
                "got among all, got others."
            )
            self.expect_action(among, tried[1], kept, problem, two)
        self.begin(_with_other_prediction(problem.select(two)))
        self.expect_action(
            "Expected the first step's action to be the same after other steps and "
            "problems, got another. "
            "Keep what evolves in the plan state, not on the planner.",
            tried[0],
            first,
            problem,
        )

    def check_uses(self) -> None:
        """Plans some steps, and again with other values of each input that the planner
        says it does not use.
        """
        problem, expect = self.problem, self.breaches.expect
        used = self.breaches.watch("uses", lambda: self.planner.uses(problem.task))
        if used is NOTHING:
            return
        of_inputs = isinstance(used, frozenset) and used <= INPUTS
        known = ", ".join(sorted(INPUTS))
        if not expect(
            of_inputs,
            f"Expected `uses` to return a frozenset of {known}, got {used!r}.",
        ):
            return
        blind = not self.planner.blind or not used
        expect(
            blind, "Expected `uses` of a `blind` planner to give no input, got some."
        )
        for name in sorted(INPUTS - used):
            other = _with_other(problem, name)
            same_action = (
                f"Expected the same action whatever `{name}` holds, which "
                "is not in `uses`, got another."
            )
            step = Step(
                state=problem.start,
                traversability=torch.full_like(problem.start[:, 0], torch.nan),
                time_s=0.0,
            )
            states = self.begin(problem), self.begin(other)
            for number in range(_STEPS):
                step = replace(step, time_s=number * problem.dt_s)
                answer = self.ask(step, states[0], problem)
                if answer is NOTHING:
                    return
                following = self.expect_action(
                    same_action, (step, answer[0]), states[1], other
                )
                states = answer[1], following
                observed = problem.traversability_at(step.state)
                moved = problem.robot(
                    step.state, answer[0].clamp(*problem.action_bounds), observed
                )
                step = replace(step, state=moved, traversability=observed)

    def begin(self, problem: Problem) -> Any:
        generator = torch.Generator().manual_seed(SEED)
        return self.breaches.watch(
            "init", lambda: self.planner.init(problem, generator), problem=problem
        )

    def ask(self, step: Step, plan_state: Any, problem: Problem) -> Any:
        """Asks for an action; `NOTHING` where what came is of no use."""
        if plan_state is NOTHING:
            return NOTHING
        act = partial(self.planner.plan, step, plan_state)
        answer = self.breaches.watch(
            "plan", act, problem=problem, step=step, plan_state=plan_state
        )
        fault = "" if answer is NOTHING else find_fault(answer, problem)
        return answer if self.breaches.expect(not fault, fault) else NOTHING

    def expect_action(
        self,
        breach: str,
        answered: tuple[Step, Tensor],
        plan_state: Any,
        problem: Problem,
        members: Tensor | None = None,
    ) -> Any:
        """Expects an action at a step, exactly, or nearly of some members; gives the
        next plan state, if any.
        """
        step, action = answered
        if members is not None:
            step, action, problem = (
                step.select(members),
                action[members],
                problem.select(members),
            )
        answer = self.ask(step, plan_state, problem)
        if answer is NOTHING:
            self.breaches.expect(plan_state is NOTHING, breach)
            return NOTHING
        low, high = problem.action_bounds
        near = (answer[0] - action).abs() <= self.tolerance * (high - low)
        is_kept = same(answer[0], action) or (members is not None and bool(near.all()))
        self.breaches.expect(is_kept, breach)
        return answer[1]

    def ask_again(self, step: Step, plan_state: Any, action: Tensor) -> None:
        """Asks again with drawing switched, which is to change nothing."""
        answer = self.ask(replace(step, draw=not step.draw), plan_state, self.problem)
        if answer is NOTHING:
            return
        self.check_layers(answer[2])
        if not same(answer[0], action):
            again = (
                "Expected the same action for the same step and plan state, got "
                "another when asked again."
            )
            answer = self.ask(step, plan_state, self.problem)
            if self.breaches.expect(
                answer is not NOTHING and same(answer[0], action), again
            ):
                self.breaches.expect(
                    False,
                    "Expected the same action whether it is drawn or not, got another.",
                )

    def check_words(self) -> None:
        watch, expect, task = (
            self.breaches.watch,
            self.breaches.expect,
            self.problem.task,
        )
        follows = watch("follows", lambda: self.planner.follows(task))
        remarks = watch("remarks", lambda: self.planner.remarks(task))
        expect(
            follows is NOTHING or _are_lines((follows,)),
            "Expected `follows` to give a single line, got something else.",
        )
        expect(
            remarks is NOTHING or _are_lines(remarks),
            "Expected `remarks` to give a tuple of single lines, got something else.",
        )

    def check_answer(self, action: Tensor, plan: Plan) -> None:
        """Tells what is wrong with an answer of the right form; ended episodes may get
        any action.
        """
        expect, (low, high) = self.breaches.expect, self.problem.action_bounds
        slack = 1e-5 * (high - low)
        expect(bool(action.isfinite().all()), NOT_FINITE)
        beyond = (action < low - slack) | (action > high + slack)
        expect(
            not bool(beyond.any()),
            "Expected actions within the robot's bounds, got some beyond them.",
        )
        known = (plan.status >= min(PlanStatus)) & (plan.status <= max(PlanStatus))
        expect(
            bool(known.all()),
            f"Expected `Plan.status` in 0–{int(max(PlanStatus))}, got other numbers.",
        )
        self.check_layers(plan)

    def check_layers(self, plan: Plan) -> None:
        for fault in find_layer_faults(plan, self.problem):
            self.breaches.expect(False, fault)


def _with_other_prediction(problem: Problem) -> Problem:
    """Firm ground for soft and soft for firm, in all inputs."""
    return _with_other(_with_other(problem, "risk_map"), "distribution")


def _with_other(problem: Problem, name: str) -> Problem:
    """The problem with other values of one of `INPUTS`, and with the free space that
    comes from it.
    """
    mixture = problem.distribution
    assert isinstance(mixture, TraversabilityMixture)  # of `_make_problem`
    others: dict[str, Any] = {
        "risk_map": 1 - problem.risk_map,
        "distribution": replace(mixture, means=1 - mixture.means),
        "fields": _fields_of(replace(mixture, means=1 - mixture.means), problem.grid),
    }
    is_source = problem.task.rules.free_space.source == name
    return replace(problem, free=problem.free ^ is_source, **{name: others[name]})


def _step(problem: Problem, step: Step, ended: Tensor, number: int) -> Step:
    """The step of a number; of the ended robots one has left the map, the others have
    arrived.
    """
    places = problem.goal_m.index_fill(0, ended.nonzero()[:1, 0], -0.3)
    state = step.state.clone()
    state[ended, :2] = places[ended]
    return replace(
        step, state=state, time_s=number * problem.dt_s, draw=number % 2 == 1
    )


def _make_problem(
    task: Task, height: int, width: int, device: torch.device, known: bool
) -> Problem:
    """Poses four problems: free ground, a closed wall, a start on ground predicted 0, a
    wall with a gap.

    Where λ is known the prediction is certain.
    """
    rows, columns = (
        torch.arange(height, device=device)[:, None],
        torch.arange(width, device=device),
    )
    # Waves, so that no two cells are quite alike.
    ground = (0.8 + 0.1 * torch.sin(0.7 * rows + 1.3 * columns)).repeat(4, 1, 1)
    wall = slice(height // 2, height // 2 + 2)
    ground[1, wall] = 0.1
    ground[2, :5, :5] = 0
    ground[3, wall, : width - 7] = ground[3, wall, width - 3 :] = 0
    elevation = (0.2 * torch.sin(0.4 * rows) * torch.cos(0.3 * columns)).repeat(4, 1, 1)
    rgb = (255 * ground).to(torch.uint8)[:, None].repeat(1, 3, 1, 1)
    doubt = 0.0 if known else 1.0
    means = torch.stack((ground - 0.05 * doubt, ground + 0.05 * doubt), dim=1)
    mixture = TraversabilityMixture(
        torch.full_like(means, 0.5), means, torch.full_like(means, 0.1 * doubt)
    )
    grid = Grid(height, width, _RESOLUTION_M)
    seen = Observation(rgb, elevation, 10 * elevation.abs(), grid)
    start = ground.new_tensor([1.2, 1.3]).repeat(4, 1)
    goal = (ground.new_tensor(grid.extent_m) - ground.new_tensor([1.7, 1.4])).repeat(
        4, 1
    )
    fields = _fields_of(mixture, grid)
    return pose_problem(
        task, Prediction(seen, mixture, ground, fields=fields), start, goal, 60.0
    )


def _fields_of(mixture: TraversabilityMixture, grid: Grid) -> Fields:
    """Fields of a prediction, correlated over a metre."""
    believed = Static().init(mixture, Law(grid=grid, correlation_m=1.0))
    return Fields(Static(), believed, tuple(range(mixture.shape[0])))
