"""The check of planners on small generated maps.

Letters in shapes: B episodes, H×W cells, S state and A action dimensions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.planning.free_space import FreeSpace, Rules
from benchnav.planning.objective import GoalDistance
from benchnav.planning.planners.boundary import (
    NOT_FINITE,
    find_fault,
    find_layer_faults,
)
from benchnav.planning.planners.planner import INPUTS, Plan, Planner, PlanStatus
from benchnav.planning.problem import Problem, Task
from benchnav.planning.sensing.sensor import Step
from benchnav.testing.breaches import NOTHING, SEED, Breaches, same
from benchnav.testing.planner_inputs import (
    change_input,
    create_problem,
    first_step,
    invert_prediction,
    numbered_step,
    step_after,
)

_STEPS = 3


def check_planner(
    planner: Any,
    robots: Sequence[Any] | None = None,
    objective: Any = None,
    shapes: Sequence[tuple[int, int]] = ((24, 24), (20, 33)),
    device: torch.device | str = "cpu",
    tolerance: float = 1e-3,
) -> None:
    """Check that a planner fulfils its contract, in a few steps on four maps.

    Like Gymnasium's `check_env` for environments, it is meant for tests. The maps are
    free terrain, a closed wall, a start on terrain predicted to immobilise the robot,
    and a wall with a gap.

    The contract:

    - actions are finite, within the robot's bounds, of shape [B, A], in the dtype and
      on the device of the states;
    - a `Plan` has a `PlanStatus` for each episode, and layers of the documented shapes;
    - problem, step, plan state and the global generators of Python, NumPy and PyTorch
      are unchanged;
    - the action is the same when repeated, with the same seed, after `init` on other
      problems, and for any `Step.draw`;
    - it is the same for a single episode, and for episodes selected by `select`, as in
      the batch;
    - robots of the batch that have reached the goal or left the map cause no error;
    - inputs that are not in `uses` have no effect, whichever input determines free
      space.

    Args:
        planner: a planner, or its name, file or mapping as in suites.
        robots: robots, or their names, files or mappings; if None, all registered
            robots. Robots that the planner's `steers` or `robots` excludes are skipped.
        objective: an objective, or its name, file or mapping; if None, the distance to
            the goal.
        shapes: (H, W) of the maps.
        device: device of the problems.
        tolerance: tolerance between actions of a single episode and of a batch, as a
            fraction of the range of the bounds.

    Raises:
        ConfigError: If the planner breaks its contract; the message lists all breaches.
    """
    new_planner = registry.take("planner", planner)
    breaches = Breaches("planner", type(new_planner).__name__)
    steers = new_planner.steers
    are_names = isinstance(steers, tuple) and all(map(_are_single_lines, steers))
    breaches.expect(
        steers is None or are_names,
        "Expected `steers` to be a tuple of tuples of action names, or None, got "
        f"{steers!r}.",
    )
    is_bool = isinstance(new_planner.blind, bool)
    breaches.expect(
        is_bool, f"Expected `blind` of type bool, got {new_planner.blind!r}."
    )
    breaches.raise_any()
    n_robots = 0
    rules = Rules()
    if robots is None:
        robots = registry.names("robot")
    for robot_or_name in robots:
        robot = registry.take("robot", robot_or_name)
        if steers is not None and tuple(robot.action_names) not in steers:
            continue
        if new_planner.robots is not None and type(robot) not in new_planner.robots:
            continue
        n_robots += 1
        name = robot_or_name if isinstance(robot_or_name, str) else type(robot).__name__
        goal = registry.take(
            "objective",
            objective or GoalDistance(),
            robot=robot,
            goal_radius_m=rules.goal_radius_m,
        )
        task = Task(robot=robot, objective=goal, rules=rules)
        create = partial(
            create_problem,
            device=torch.device(device),
            is_certain=new_planner.given_truth,
        )
        for height, width in shapes:
            breaches.location = f"{name} on {height}×{width}"
            problem = create(task, height, width)
            _PlannerCheck(new_planner, problem, tolerance, breaches).run()
        height, width = shapes[0]
        for source in ("risk", "mean"):
            breaches.location = f"{name} on {height}×{width}"
            free_space_rules = replace(rules, free_space=FreeSpace(by=source))
            problem = create(replace(task, rules=free_space_rules), height, width)
            _PlannerCheck(new_planner, problem, tolerance, breaches).check_uses()
    breaches.expect(
        n_robots > 0,
        "Expected the planner to steer at least one of the tried robots, got a planner "
        "that steers none. Pass a robot that the attributes `steers` and `robots` of "
        "the planner include.",
    )
    breaches.raise_any()


def _are_single_lines(values: Any) -> bool:
    if not isinstance(values, tuple):
        return False
    return all(isinstance(text, str) and "\n" not in text for text in values)


@dataclass(frozen=True)
class _PlannerCheck:
    """The check of a planner on one batch."""

    planner: Planner[Any]
    problem: Problem
    tolerance: float
    breaches: Breaches

    def run(self) -> None:
        """Plan several steps, then in ways that should have the same results.

        The check stops at the first breach that prevents further checks.
        """
        problem = self.problem
        start = problem.start
        self.check_texts()
        first_state = self.begin(problem)
        plan_state = first_state
        step = first_step(problem)
        planned: list[tuple[Step, Tensor]] = []
        last_episode = torch.tensor([len(problem) - 1], device=start.device)
        last_two_episodes = torch.cat((last_episode, last_episode - 1))
        indices = torch.arange(len(problem), device=start.device)
        for number in range(_STEPS + 1):
            # In the last step, only the last two episodes are still running.
            running = indices >= (number == _STEPS) * last_two_episodes[1]
            step = numbered_step(problem, step, ~running, number)
            answer = self.plan(step, plan_state, problem)
            if answer is NOTHING:
                return
            action, next_plan_state, plan = answer
            self.check_answer(action[running], plan)
            self.plan_again(step, plan_state, action)
            planned.append((step, action))
            plan_state = next_plan_state
            step = step_after(problem, step, action)
        breach = (
            "Expected the same action from a generator of the same seed, got a "
            "different action."
        )
        repeated_state = self.begin(problem)
        second_state = self.expect_action(breach, planned[0], repeated_state, problem)
        plan_state = self.begin(problem.select(last_episode))
        breach = (
            "Expected the same action for a single episode as in the batch, got a "
            "different action."
        )
        for pair in planned[:_STEPS]:
            plan_state = self.expect_action(
                breach, pair, plan_state, problem, last_episode
            )
        selected = NOTHING
        if second_state is not NOTHING:
            select = partial(self.planner.select, second_state, last_two_episodes)
            selected = self.breaches.watch("select", select, plan_state=second_state)
        if selected is not NotImplemented:
            breach = (
                "Expected `select` to leave the actions of the selected episodes "
                "unchanged, got different actions."
            )
            self.expect_action(breach, planned[1], selected, problem, last_two_episodes)
        different = invert_prediction(problem.select(last_two_episodes))
        self.begin(different)
        breach = (
            "Expected the first step's action to be the same after other steps and "
            "problems, got a different action. Keep changing values in the plan state, "
            "not on the planner."
        )
        self.expect_action(breach, planned[0], first_state, problem)

    def check_uses(self) -> None:
        """Check that inputs that are not in `uses` do not change the actions."""
        problem = self.problem
        expect = self.breaches.expect
        used = self.breaches.watch("uses", lambda: self.planner.uses(problem.task))
        if used is NOTHING:
            return
        are_inputs = isinstance(used, frozenset) and used <= INPUTS
        listed = ", ".join(sorted(INPUTS))
        breach = (
            f"Expected `uses` to return a frozenset of names from ({listed}), got "
            f"{used!r}."
        )
        if not expect(are_inputs, breach):
            return
        is_consistent = not self.planner.blind or not used
        expect(
            is_consistent,
            f"Expected `uses` of a `blind` planner to be empty, got {sorted(used)}.",
        )
        for name in sorted(INPUTS - used):
            changed = change_input(problem, name)
            breach = (
                f"Expected the same action for any value of `{name}`, got a different "
                f"action. Add {name!r} to `uses`, or do not read it."
            )
            step = first_step(problem)
            plan_state = self.begin(problem)
            changed_state = self.begin(changed)
            for number in range(_STEPS):
                step = replace(step, time_s=number * problem.dt_s)
                answer = self.plan(step, plan_state, problem)
                if answer is NOTHING:
                    return
                action, plan_state, _ = answer
                changed_state = self.expect_action(
                    breach, (step, action), changed_state, changed
                )
                step = step_after(problem, step, action)

    def begin(self, problem: Problem) -> Any:
        """Return the initial plan state, or `NOTHING`."""
        generator = torch.Generator().manual_seed(SEED)
        return self.breaches.watch(
            "init", lambda: self.planner.init(problem, generator), problem=problem
        )

    def plan(self, step: Step, plan_state: Any, problem: Problem) -> Any:
        """Return the result of the planner's `plan`, or `NOTHING` if it is invalid."""
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
        planned: tuple[Step, Tensor],
        plan_state: Any,
        problem: Problem,
        members: Tensor | None = None,
    ) -> Any:
        """Check the action at a step; return the next plan state, or `NOTHING`.

        Args:
            breach: message if the action differs.
            planned: the step, and the expected action of each episode.
            plan_state: plan state before the step.
            problem: problem of all episodes.
            members: indices of episodes whose actions must agree within `tolerance`; if
                None, the actions of all episodes must be equal.
        """
        step, expected = planned
        if members is not None:
            step = step.select(members)
            expected = expected[members]
            problem = problem.select(members)
        answer = self.plan(step, plan_state, problem)
        if answer is NOTHING:
            self.breaches.expect(plan_state is NOTHING, breach)
            return NOTHING
        action, next_plan_state, _ = answer
        low, high = problem.action_bounds
        is_same = same(action, expected)
        if members is not None and not is_same:
            margin = self.tolerance * (high - low)
            is_close = (action - expected).abs() <= margin
            is_same = bool(is_close.all())
        self.breaches.expect(is_same, breach)
        return next_plan_state

    def plan_again(self, step: Step, plan_state: Any, expected: Tensor) -> None:
        """Check that the action is the same when repeated, and for any `Step.draw`."""
        toggled = replace(step, draw=not step.draw)
        answer = self.plan(toggled, plan_state, self.problem)
        if answer is NOTHING:
            return
        action, _, plan = answer
        self.check_layers(plan)
        if same(action, expected):
            return
        answer = self.plan(step, plan_state, self.problem)
        is_repeatable = self.breaches.expect(
            answer is not NOTHING and same(answer[0], expected),
            "Expected the same action for the same step and plan state, got a different "
            "action when called again.",
        )
        if is_repeatable:
            self.breaches.expect(
                False,
                "Expected the same action for any `Step.draw`, got a different action.",
            )

    def check_texts(self) -> None:
        """Note invalid texts of the planner."""
        watch = self.breaches.watch
        expect = self.breaches.expect
        task = self.problem.task
        follows = watch("follows", lambda: self.planner.follows(task))
        remarks = watch("remarks", lambda: self.planner.remarks(task))
        is_line = follows is NOTHING or _are_single_lines((follows,))
        expect(
            is_line,
            "Expected `follows` to return a single line, got another type or several "
            "lines.",
        )
        expect(
            remarks is NOTHING or _are_single_lines(remarks),
            "Expected `remarks` to return a tuple of single lines, got another type or "
            "several lines.",
        )

    def check_answer(self, action: Tensor, plan: Plan) -> None:
        """Note invalid values of the actions of running episodes, and of the plan."""
        expect = self.breaches.expect
        low, high = self.problem.action_bounds
        margin = 1e-5 * (high - low)
        expect(bool(action.isfinite().all()), NOT_FINITE)
        is_beyond = (action < low - margin) | (action > high + margin)
        expect(
            not bool(is_beyond.any()),
            "Expected actions within the robot's bounds, got actions outside them.",
        )
        status = plan.status
        is_valid = (status >= min(PlanStatus)) & (status <= max(PlanStatus))
        expect(
            bool(is_valid.all()),
            "Expected `Plan.status` to contain only values of `PlanStatus` "
            f"(0–{int(max(PlanStatus))}), got other numbers.",
        )
        self.check_layers(plan)

    def check_layers(self, plan: Plan) -> None:
        """Note invalid layers of a plan."""
        for fault in find_layer_faults(plan, self.problem):
            self.breaches.expect(False, fault)
