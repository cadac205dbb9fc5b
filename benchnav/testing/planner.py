"""The contract of planners, tried on small maps made on the spot.

`check_planner` is for the tests of whoever writes a planner, as `check_model` is for those of a model: a
planner that passes can be evaluated like any other, and its rows do not hang on the batch, the order or
what is drawn. Letters in shapes: B episodes, H×W cells, S state and A action dimensions.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Observation
from benchnav.planning.free_space import Rules
from benchnav.planning.objective import GoalDistance
from benchnav.planning.planners.boundary import NOT_FINITE, find_fault, find_layer_faults
from benchnav.planning.planners.planner import Plan, PlanStatus, Step
from benchnav.planning.problem import Problem, Task, pose_problem
from benchnav.planning.robots import Robot
from benchnav.testing.side_effects import NOTHING, same, watch

SHAPES = ((24, 24), (20, 33))
TOLERANCE = 1e-3

_RESOLUTION_M = 0.5
_STEPS = 3
_SEED = 20240229

Breaches = Iterator[str]


def check_planner(
    planner: Any,
    robots: Sequence[Any] | None = None,
    objective: Any = None,
    shapes: Sequence[tuple[int, int]] = SHAPES,
    device: torch.device | str = "cpu",
    tolerance: float = TOLERANCE,
) -> None:
    """Tries whether a planner keeps the contract, by letting it plan a few steps on four maps.

    The maps: free ground, a closed wall, a start on ground predicted to immobilise the robot, a wall with a gap.
    The contract: finite actions within the robot's bounds, of shape [B, A], in the states' dtype and on
    their device; a `Plan` with a `PlanStatus` for each episode, and layers of the shapes that it names;
    the problem, the step and the plan state left as they were, and with them the global generators of
    Python, NumPy and PyTorch; the same answer when asked again, from the same seed, after other problems
    were begun, and whether it is drawn or not; for an episode alone, and for some that `select` keeps, what it is
    in a batch; no error where some robots of the batch have arrived or left the map. What a planner makes of a
    closed wall is its own affair.

    Args:
        planner: any planner, or the name, file or mapping of one as suites have it.
        robots: likewise; every registered one when not given. Those that the planner does not steer, by
            its `steers`, are left out.
        objective: likewise; the goal distance when not given.
        shapes: (H, W) of the maps to try.
        device: where the problems are.
        tolerance: by how much an action alone and in a batch may differ, as a share of its bounds' range.

    Raises:
        ConfigError: the planner breaks the contract; every breach is named.
    """
    made = _part("planner", planner)
    found: dict[str, list[str]] = {}
    for breach in _unsound_attributes(made):
        found.setdefault(breach, [])
    steered = 0
    for given in registry.names("robot") if robots is None else robots:
        robot = _part("robot", given)
        if not _steers(made, robot):
            continue
        steered += 1
        name = given if isinstance(given, str) else type(robot).__name__
        rules = Rules()
        made_for = {"robot": robot, "goal_radius_m": rules.goal_radius_m}
        goal = _part("objective", objective or GoalDistance(), **made_for)
        task = Task(robot=robot, objective=goal, rules=rules)
        for height, width in shapes:
            problem = _make_problem(task, height, width, torch.device(device))
            for breach in dict.fromkeys(_breaches(made, problem, tolerance)):
                found.setdefault(breach, []).append(f"{name} on {height}×{width}")
    if not steered:
        found.setdefault("Expected a robot among those tried that it steers, got none.", [])
    if found:
        where = {breach: f" [{', '.join(places)}]" if places else "" for breach, places in found.items()}
        listed = " ".join(
            f"({i}) {breach}{place}" for i, (breach, place) in enumerate(where.items(), start=1)
        )
        raise ConfigError(
            "Expected a planner that keeps the contract of "
            f"`benchnav.testing.planner.check_planner`, got {type(made).__name__}, "
            f"which breaks it: {listed}"
        )


def _part(kind: str, given: Any, **made_for: Any) -> Any:
    is_named = isinstance(given, str | Mapping | registry.Part)
    return registry.make(kind, given, **made_for) if is_named else given


def _steers(planner: Any, robot: Robot) -> bool:
    known = getattr(planner, "steers", None)
    return known is None or tuple(robot.action_names) in {tuple(names) for names in known}


def _unsound_attributes(planner: Any) -> Breaches:
    """Tells which of the attributes that tables and refusals read mean nothing."""
    known = getattr(planner, "steers", None)
    if known is not None and not (
        isinstance(known, tuple)
        and all(isinstance(n, tuple) and all(isinstance(a, str) for a in n) for n in known)
    ):
        yield f"Expected `steers` as tuples of action names, got {known!r}."
    if not isinstance(getattr(planner, "blind", False), bool):
        yield f"Expected `blind` of type bool, got {planner.blind!r}."


def _breaches(planner: Any, problem: Problem, tolerance: float) -> Breaches:
    """Tells what a planner breaks on one batch; stops at what makes the rest meaningless."""
    yield from _unsound_remarks(planner, problem.task)
    plan_state, found = _begin(planner, problem)
    yield from found
    if plan_state is NOTHING:
        return
    first_state, steps, actions = plan_state, [], []
    step = Step(
        state=problem.start, traversability=torch.full_like(problem.start[:, 0], torch.nan), time_s=0.0
    )
    for number in range(_STEPS + 1):
        is_last = number == _STEPS
        ended = _some_ended(problem) if is_last else torch.zeros_like(step.traversability, dtype=torch.bool)
        step = _step(problem, step, ended, number)
        said, found = _ask(planner, step, plan_state, problem)
        yield from found
        if said is NOTHING:
            return
        action, following, plan = said
        yield from _unsound(action, plan, problem, ~ended)
        yield from _compare_again(planner, step, plan_state, problem, action)
        steps.append(step)
        actions.append(action)
        plan_state = following
        met = problem.traversability_at(step.state)
        moved = problem.robot(step.state, action.clamp(*problem.action_bounds), met)
        step = replace(step, state=moved, traversability=met)
    yield from _compare_seed(planner, problem, steps[0], actions[0])
    yield from _compare_alone(planner, problem, steps[:_STEPS], actions, tolerance)
    yield from _compare_selected(planner, problem, steps[:_STEPS], actions, tolerance)
    yield from _compare_later(planner, problem, steps[0], first_state, actions[0])
    yield from _compare_blind(planner, problem, steps[0], actions[0])


def _unsound_remarks(planner: Any, task: Task) -> Breaches:
    if hasattr(planner, "follows"):
        follows, found = watch("follows", lambda: planner.follows(task))
        yield from found
        if follows is not NOTHING and not (isinstance(follows, str) and "\n" not in follows):
            yield "Expected `follows` to give a single line, got something else."
    if not hasattr(planner, "remarks"):
        return
    remarks, found = watch("remarks", lambda: planner.remarks(task))
    yield from found
    if remarks is not NOTHING and not (
        isinstance(remarks, tuple) and all(isinstance(line, str) and "\n" not in line for line in remarks)
    ):
        yield "Expected `remarks` to give a tuple of single lines, got something else."


def _unsound(action: Tensor, plan: Plan, problem: Problem, running: Tensor) -> Breaches:
    """Tells what is wrong with an answer of the right form; ended episodes may get any action."""
    action = action[running]
    if not bool(action.isfinite().all()):
        yield NOT_FINITE
    low, high = problem.action_bounds
    slack = 1e-5 * (high - low)
    if bool(((action < low - slack) | (action > high + slack)).any()):
        yield "Expected actions within the robot's bounds, got some beyond them."
    if not bool(((plan.status >= min(PlanStatus)) & (plan.status <= max(PlanStatus))).all()):
        yield f"Expected `Plan.status` in 0–{int(max(PlanStatus))}, got other numbers."
    yield from find_layer_faults(plan, problem)


def _compare_again(planner: Any, step: Step, plan_state: Any, problem: Problem, action: Tensor) -> Breaches:
    """Asks again with drawing switched, which is to change nothing."""
    said, found = _ask(planner, replace(step, draw=not step.draw), plan_state, problem)
    yield from found
    if said is NOTHING:
        return
    yield from find_layer_faults(said[2], problem)
    if same(said[0], action):
        return
    said, _ = _ask(planner, step, plan_state, problem)
    if said is not NOTHING and same(said[0], action):
        yield "Expected the same action whether it is drawn or not, got another."
    else:
        yield "Expected the same action for the same step and plan state, got another when asked again."


def _compare_seed(planner: Any, problem: Problem, step: Step, action: Tensor) -> Breaches:
    plan_state, found = _begin(planner, problem)
    yield from found
    said, found = _ask(planner, step, plan_state, problem)
    yield from found
    if said is not NOTHING and not same(said[0], action):
        yield "Expected the same action from a generator of the same seed, got another."


def _compare_alone(
    planner: Any, problem: Problem, steps: Sequence[Step], actions: Sequence[Tensor], tolerance: float
) -> Breaches:
    """Plans for the last episode by itself, from the same generator."""
    alone = problem.select(torch.tensor([len(problem) - 1], device=problem.start.device))
    plan_state, found = _begin(planner, alone)
    yield from found
    low, high = problem.action_bounds
    for step, action in zip(steps, actions, strict=False):
        said, found = _ask(
            planner,
            replace(step, state=step.state[-1:], traversability=step.traversability[-1:]),
            plan_state,
            alone,
        )
        yield from found
        if said is NOTHING:
            return
        if not bool(((said[0] - action[-1:]).abs() <= tolerance * (high - low)).all()):
            yield "Expected for an episode alone the action that it got in a batch, got another."
            return
        plan_state = said[1]


def _compare_selected(
    planner: Any, problem: Problem, steps: Sequence[Step], actions: Sequence[Tensor], tolerance: float
) -> Breaches:
    """Plans the first step for all, and the second for two of them that are kept, out of their order."""
    if not hasattr(planner, "select") or len(steps) < 2:
        return
    members = torch.tensor([len(problem) - 1, len(problem) - 2], device=problem.start.device)
    plan_state, _ = _begin(planner, problem)
    said, _ = _ask(planner, steps[0], plan_state, problem)
    if said is NOTHING:
        return
    kept, found = watch("select", lambda: planner.select(said[1], members), plan_state=said[1])
    yield from found
    if kept is NOTHING:
        return
    step = replace(steps[1], state=steps[1].state[members], traversability=steps[1].traversability[members])
    said, found = _ask(planner, step, kept, problem.select(members))
    yield from found
    low, high = problem.action_bounds
    if said is not NOTHING and not bool(
        ((said[0] - actions[1][members]).abs() <= tolerance * (high - low)).all()
    ):
        yield "Expected of episodes that `select` keeps the actions that they got among all, got others."


def _compare_later(planner: Any, problem: Problem, step: Step, plan_state: Any, action: Tensor) -> Breaches:
    """Goes back to the first step, after others were planned and another problem was begun."""
    _, found = _begin(planner, _with_other_prediction(problem.select(torch.arange(len(problem) - 1))))
    yield from found
    said, found = _ask(planner, step, plan_state, problem)
    yield from found
    if said is NOTHING or not same(said[0], action):
        yield (
            "Expected the first step's action to be the same after other steps and problems, got another. "
            "Keep what evolves in the plan state, not on the planner."
        )


def _compare_blind(planner: Any, problem: Problem, step: Step, action: Tensor) -> Breaches:
    """Shows a planner that calls itself blind other predictions, which is to change nothing."""
    if not getattr(planner, "blind", False):
        return
    other = _with_other_prediction(problem)
    plan_state, _ = _begin(planner, other)
    said, _ = _ask(planner, step, plan_state, other)
    if said is NOTHING or not same(said[0], action):
        yield "Expected of a `blind` planner the same action whatever is predicted, got another."


def _with_other_prediction(problem: Problem) -> Problem:
    """Firm ground for soft and soft for firm."""
    return replace(
        problem,
        mixture=replace(problem.mixture, means=1 - problem.mixture.means),
        risk_map=1 - problem.risk_map,
        free=~problem.free,
    )


def _begin(planner: Any, problem: Problem) -> tuple[Any, list[str]]:
    generator = torch.Generator().manual_seed(_SEED)
    return watch("init", lambda: planner.init(problem, generator), problem=problem)


def _ask(planner: Any, step: Step, plan_state: Any, problem: Problem) -> tuple[Any, list[str]]:
    """Asks for an action; `NOTHING` where what came is of no use."""
    if plan_state is NOTHING:
        return NOTHING, []
    said, found = watch(
        "plan", lambda: planner.plan(step, plan_state), problem=problem, step=step, plan_state=plan_state
    )
    if said is not NOTHING and (fault := find_fault(said, problem)):
        return NOTHING, [*found, fault]
    return said, found


def _some_ended(problem: Problem) -> Tensor:
    """The episodes that have ended by the last step tried: all but the last two, bool [B]."""
    return torch.arange(len(problem), device=problem.start.device) < len(problem) - 2


def _step(problem: Problem, step: Step, ended: Tensor, number: int) -> Step:
    """The step of a number; of the ended robots one has left the map, the others have arrived."""
    places = problem.goal_m.clone()
    places[0] = -0.3
    state = step.state.clone()
    state[:, :2] = torch.where(ended[:, None], places, state[:, :2])
    return replace(step, state=state, time_s=number * problem.dt_s, draw=number % 2 == 1)


def _make_problem(task: Task, height: int, width: int, device: torch.device) -> Problem:
    """Poses four problems: free ground, a closed wall, a start on ground predicted 0, a wall with a gap."""
    rows = torch.arange(height, device=device)[:, None]
    columns = torch.arange(width, device=device)[None, :]
    # Waves, so that no two cells are quite alike.
    ground = (0.8 + 0.1 * torch.sin(0.7 * rows + 1.3 * columns)).repeat(4, 1, 1)
    wall = (rows == height // 2) | (rows == height // 2 + 1)
    ground[1] = torch.where(wall, 0.1, ground[1])
    ground[2] = torch.where((rows < 5) & (columns < 5), 0.0, ground[2])
    ground[3] = torch.where(wall & ((columns < width - 7) | (columns > width - 4)), 0.0, ground[3])
    elevation = (0.2 * torch.sin(0.4 * rows) * torch.cos(0.3 * columns)).repeat(4, 1, 1)
    slope = (10 * elevation.abs()).clone()
    rgb = (255 * ground).to(torch.uint8)[:, None].repeat(1, 3, 1, 1)
    spread = torch.tensor([-0.05, 0.05], device=device)[:, None, None]
    means = ground[:, None] + spread
    mixture = TraversabilityMixture(torch.full_like(means, 0.5), means, torch.full_like(means, 0.1))
    here = ground.new_tensor([[1.2, 1.3]]).repeat(4, 1)
    goal = ground.new_tensor([[width * _RESOLUTION_M - 1.7, height * _RESOLUTION_M - 1.4]]).repeat(4, 1)
    seen = Observation(rgb, elevation, slope, Grid(height, width, _RESOLUTION_M))
    return pose_problem(task, seen, mixture, ground, here, goal, 60.0)
