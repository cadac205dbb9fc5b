"""Running episodes: a planner and the simulation in a closed loop, as one batch.

A GPU works through what it is given while the next is prepared, as long as nobody waits
for its numbers. So on devices other than the CPU the loop looks at which episodes still
run at every few steps only, and faults are kept as
tensors until the end. Letters in shapes: B episodes, N steps, S state and A action
dimensions.
"""

import itertools
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from benchnav.core.device import GPU_FAULTS, DeviceError, gpu_failed
from benchnav.core.errors import BenchnavError, out_of_memory
from benchnav.core.settings import fault
from benchnav.eval.run.knowledge import Knowing, Learning
from benchnav.planning.objective import distance
from benchnav.planning.planners.boundary import (
    Answer,
    act,
    begin,
    revise,
    standing_actions,
)
from benchnav.planning.planners.planner import Plan, Planner, PlanStatus
from benchnav.planning.problem import Problem
from benchnav.planning.sensing.knowledge import KnowledgeError
from benchnav.planning.sensing.sensor import Step
from benchnav.planning.world.outcome import Outcome, tell_standstill
from benchnav.planning.world.simulation import Simulation, SimulationState, end

_FULL = 0.75  # share of a batch that still runs, over which it is left as it is
# steps between two looks at which episodes still run, where a look waits for a GPU
_LOOK_EVERY = 8


@dataclass(frozen=True, kw_only=True)
class Observer:
    """What is called while episodes run, for recordings.

    Args:
        plan: called with a step's number, its plan and the episodes that it is for,
            before the step is taken.
        every: steps between two calls of `plan`, from the first on.
        knowledge: called with a step's number and what is known when that was updated,
            before the step is planned.
    """

    plan: Callable[[int, Plan, list[int]], None] | None = None
    every: int = 1
    knowledge: Callable[[int, Knowing], None] | None = None


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """What happened in a batch of episodes, on the CPU. Beyond an episode's own `steps`
    its state stands still.

    Args:
        states: shape [B, N + 1, S].
        actions: shape [B, N, A].
        traversability: λ that the robot met at each step, shape [B, N].
        speed_mps: speed that each action would give on ground of λ = 1, shape [B, N].
        turn_rate_radps: turn rate, likewise, shape [B, N].
        outcome: `Outcome`, shape [B].
        steps: steps to the end, shape [B].
        begin_s: wall time of what the planner prepared for the whole batch.
        planning_s: wall time of each step's plan, shape [N].
        planned: how many episodes it was for, int64, shape [N].
        revisions: how often each episode's map changed on the way, int64, shape [B].
        learning_s: wall time of what the robots learnt, all steps together.
        errors: one line for each episode that ended by a fault of its planner, empty
            for the others, B of them.
        traceback: where the planner raised; empty where it did not.
        seen_cells: how many cells each robot saw, int64, shape [B]; None where robots
            learn nothing.
        sensed_cells: of how many cells each sensed λ, int64, shape [B]; None likewise.
        ahead: RMSE of E[λ] and log score over the cells ahead of the robot, NaN at
            steps without an update, shape [B, N, 2]; None likewise. See `Knowing`.
    """

    states: Tensor
    actions: Tensor
    traversability: Tensor
    speed_mps: Tensor
    turn_rate_radps: Tensor
    outcome: Tensor
    steps: Tensor
    begin_s: float
    planning_s: Tensor
    planned: Tensor
    revisions: Tensor
    learning_s: float
    errors: tuple[str, ...]
    traceback: str = ""
    seen_cells: Tensor | None = None
    sensed_cells: Tensor | None = None
    ahead: Tensor | None = None


class Clock:
    """Times calls one after another without waiting for a GPU: there, events of its own
    stream are read at the end.

    Args:
        device: where the calls compute.
    """

    def __init__(self, device: torch.device) -> None:
        """Begins with nothing."""
        self._on_gpu = device.type == "cuda"
        self._marks: list[tuple[Any, Any]] = []

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Times what is done within; what raises is not counted."""
        began = self._mark()
        yield
        self._marks.append((began, self._mark()))

    def _mark(self) -> Any:
        if not self._on_gpu:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    def seconds(self) -> list[float]:
        """The time of each call so far."""
        if not self._on_gpu:
            return [end - begin for begin, end in self._marks]
        torch.cuda.synchronize()
        return [begin.elapsed_time(end) / 1e3 for begin, end in self._marks]


class _Log:
    """What is kept of the steps while they are taken."""

    def __init__(self, start: SimulationState, problem: Problem) -> None:
        self.dt_s = problem.dt_s
        self.states = [start.state]
        # Of each step actions, observed λ, and how far and by what turn rate ground of
        # λ = 1 would have led.
        none = start.state.new_zeros(len(start.state), 0)
        self._steps = [
            [
                none[..., None].expand(-1, 0, len(problem.robot.action_low)),
                none,
                none,
                none,
            ]
        ]
        self.clock = Clock(start.state.device)  # what is prepared, then each plan
        self.learning = Clock(start.state.device)
        self.planned: list[int] = []
        self._reasons: list[str] = []
        # The reason of each episode, by its place in the list.
        self._fault = torch.full_like(start.outcome, -1)

    def blame(self, which: Tensor, reason: str) -> None:
        """Notes what ends some running episodes, bool [B]."""
        if reason not in self._reasons:
            self._reasons.append(reason)
        self._fault = torch.where(which, self._reasons.index(reason), self._fault)

    def add(
        self, after: SimulationState, action: Tensor, met: Tensor, free: Tensor
    ) -> None:
        before = self.states[-1]
        turned = (free[:, 2] - before[:, 2]) / self.dt_s
        kept = action, met, distance(free, before[:, :2]), turned
        self._steps.append([value.unsqueeze(1) for value in kept])
        self.states.append(after.state)

    def episodes(
        self, now: SimulationState, traceback_: str, knowing: Knowing | None
    ) -> Episodes:
        track, taken = torch.stack(self.states, dim=1), len(self._steps) - 1
        actions, met, driven, turned = (
            torch.cat(values, dim=1) for values in zip(*self._steps, strict=True)
        )
        seconds = self.clock.seconds()
        return Episodes(
            states=track.cpu(),
            actions=actions.cpu(),
            traversability=met.cpu(),
            speed_mps=(driven / self.dt_s).cpu(),
            turn_rate_radps=turned.cpu(),
            outcome=tell_standstill(
                now.outcome, now.step, track[..., :2], driven, self.dt_s
            ).cpu(),
            steps=now.step.cpu(),
            begin_s=seconds[0] if seconds else 0.0,
            # A planner that raised has no step for its last plan.
            planning_s=torch.tensor(seconds[1 : taken + 1], dtype=torch.float64),
            planned=torch.tensor(self.planned[:taken]),
            revisions=torch.zeros_like(now.step).cpu()
            if knowing is None
            else knowing.revisions.cpu(),
            seen_cells=None if knowing is None else knowing.seen_cells.cpu(),
            sensed_cells=None if knowing is None else knowing.sensed_cells.cpu(),
            ahead=None
            if knowing is None
            else _by_step(knowing.ahead, len(track), taken),
            learning_s=sum(self.learning.seconds()),
            errors=tuple(
                "" if place < 0 else self._reasons[place]
                for place in self._fault.tolist()
            ),
            traceback=traceback_,
        )


def _by_step(measured: Mapping[int, Tensor], batch: int, steps: int) -> Tensor:
    """What was measured in some steps, NaN in all others, shape [B, N, 2]."""
    found = torch.full((batch, steps, 2), torch.nan)
    for step, values in measured.items():
        if step < steps:
            found[:, step] = values.cpu()
    return found


def run_episodes(
    planner: Planner[Any],
    problem: Problem,
    simulation: Simulation,
    generator: torch.Generator,
    observer: Observer = Observer(),
    enough: Callable[[int], bool] = lambda step: False,
    learning: Learning | None = None,
) -> Episodes:
    """Runs a batch of episodes to the end of the last.

    A planner that raises ends the episodes that still run; one whose action no robot
    can do ends that action's own.

    Args:
        planner: chooses actions; it is given copies of what is predicted, never the
            truth.
        problem: with predicted traversability.
        simulation: with the true terrain.
        generator: the planner's randomness.
        observer: what is called on the way.
        enough: is asked before each step, by its number, whether to leave it there;
            episodes that still run are then left running.
        learning: how the robots learn on their way, whose planner then goes on under
            what they know; None where they learn nothing.

    Returns:
        What happened.

    Raises:
        RobotError: the robot's F failed in the simulation.
        DeviceError: the GPU failed.
    """
    now = simulation.init(problem.start)
    log = _Log(now, problem)
    observed = torch.full_like(now.state[:, 0], torch.nan)
    look_every = 1 if observed.device.type == "cpu" else _LOOK_EVERY
    trace, knowing = "", None if learning is None else Knowing(learning, problem)
    try:
        with log.clock.timed():
            plan_state = begin(planner, problem, generator)
        batch = _Batch(planner, problem, plan_state)
        for count in itertools.count():
            if enough(count):
                break
            if count % look_every == 0:
                running = now.running.cpu()
                if not bool(running.any()):
                    break
                left = batch.drop_ended(running)
                if knowing is not None and left is not None:
                    knowing.keep(left)
            revised = None
            if knowing is not None:
                at, goes_on = batch.part_of(now.state), batch.part_of(now.running)
                with log.learning.timed():
                    revised = knowing.learn(count, at, goes_on)
                if knowing.is_due(count):
                    knowing.look_ahead(count, at, goes_on)
                    if observer.knowledge is not None:
                        observer.knowledge(count, knowing)
            watched = observer.plan is not None and count % observer.every == 0
            step = Step(
                state=now.state,
                traversability=observed,
                time_s=count * problem.dt_s,
                draw=watched,
            )
            with log.clock.timed():
                if revised is not None:
                    batch.revise(revised, generator)
                answer = batch.act(step)
            log.planned.append(len(batch.members))
            if watched and observer.plan is not None:
                observer.plan(count, answer.plan, batch.members.tolist())
            action, faulty, status = batch.spread(answer)
            log.blame(now.running & faulty, answer.reason)
            now = end(now, faulty, Outcome.PLANNER_ERROR)
            now = end(now, status == PlanStatus.FAILED, Outcome.PLANNER_FAILURE)
            now, observed, free = _move(simulation, now, action)
            log.add(now, action, observed, free)
    except (RobotError, DeviceError):
        raise
    except GPU_FAULTS as error:
        raise gpu_failed(error) from error
    except (Exception, SystemExit) as error:
        if no_memory := out_of_memory(error):
            raise no_memory from error
        trace = traceback.format_exc() if bool(now.running.any()) else ""
        log.blame(now.running, fault(error))
        outcome = (
            error.outcome
            if isinstance(error, KnowledgeError)
            else Outcome.PLANNER_ERROR
        )
        now = end(now, now.running, outcome)
    return log.episodes(now, trace, knowing)


class _Batch:
    """The episodes that are planned for: all at first, and fewer when enough of them
    have ended.

    Args:
        planner: any planner.
        problem: of all episodes.
        plan_state: from `begin`.
    """

    def __init__(
        self, planner: Planner[Any], problem: Problem, plan_state: Any
    ) -> None:
        self.members = torch.arange(len(problem))
        self._planner, self._whole, self._part, self._state = (
            planner,
            problem,
            problem,
            plan_state,
        )
        self._index = self.members.to(problem.start.device)

    def drop_ended(self, running: Tensor) -> Tensor | None:
        """Lets ended episodes leave, where the planner can do without them and a
        quarter has ended.

        Args:
            running: which episodes go on, bool on the CPU, shape [B].

        Returns:
            Places of those that stay among those that there were, int64; None where
            none has left.
        """
        left = running[self.members].nonzero()[:, 0]
        if len(left) > _FULL * len(self.members):
            return None
        places = left.to(self._index.device)
        state = self._planner.select(self._state, places)
        if state is NotImplemented:
            return None
        self._state, self.members = state, self.members[left]
        self._index = self.members.to(self._index.device)
        self._part = self._part.select(places)
        return places

    def part_of(self, values: Tensor) -> Tensor:
        """Of values of all episodes, [B, ...], those of the ones that are left."""
        return values[self._index]

    def revise(self, problem: Problem, generator: torch.Generator) -> None:
        """Tells the planner of another problem, of the episodes that are left."""
        self._state, self._part = (
            revise(self._planner, self._state, problem, generator),
            problem,
        )

    def act(self, step: Step) -> Answer:
        """Asks the planner, for the episodes that are left."""
        given = replace(
            step,
            state=step.state[self._index],
            traversability=step.traversability[self._index],
        )
        answer = act(self._planner, given, self._state, self._part)
        self._state = answer.plan_state
        return answer

    def spread(self, answer: Answer) -> tuple[Tensor, Tensor, Tensor]:
        """Actions, faults and statuses of all episodes; of those that have left, what
        is harmless.
        """
        zeros = torch.zeros(
            len(self._whole), dtype=torch.int64, device=self._index.device
        )
        return (
            standing_actions(self._whole).index_copy(0, self._index, answer.action),
            zeros.bool().index_copy(0, self._index, answer.faulty),
            zeros.index_copy(0, self._index, answer.plan.status),
        )


class RobotError(BenchnavError):
    """A robot's F raised in the simulation; no planner is to blame, and no row would
    mean anything.
    """


def _move(
    simulation: Simulation, now: SimulationState, action: Tensor
) -> tuple[SimulationState, Tensor, Tensor]:
    """The next states, the observed λ, and where the action would have led on ground of
    λ = 1.
    """
    try:
        free = simulation.unhindered(now, action)
        return *simulation.step(now, action), free
    except GPU_FAULTS as error:
        raise gpu_failed(error) from error
    except Exception as error:
        robot = type(simulation.robot).__name__
        raise out_of_memory(error) or RobotError(
            f"Robot {robot} failed in the simulation: {fault(error)}"
        ) from error
