"""Episodes: a planner and the simulation in a closed loop, as one batch.

A GPU executes queued work while the CPU queues more, as long as no value is read. So on
devices other than the CPU the loop reads only every few steps which episodes still run,
and faults remain tensors until the end. Letters in shapes: B episodes, N steps, S state
and A action dimensions.
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

_FULL = 0.75  # fraction of running episodes above which the batch is not reduced
_CHECK_INTERVAL = 8  # steps between two reads of the running episodes, on a GPU


@dataclass(frozen=True, kw_only=True)
class Observer:
    """Callbacks during episodes, for recordings.

    Args:
        plan: called with the index of a step, its plan and the indices of its episodes,
            before the step is taken.
        plan_interval: steps between two calls of `plan`, from the first step.
        knowledge: called with the index of a step and the knowledge after an update,
            before the step is planned.
    """

    plan: Callable[[int, Plan, list[int]], None] | None = None
    plan_interval: int = 1
    knowledge: Callable[[int, Knowing], None] | None = None


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """Trajectories and outcomes of a batch of episodes, on the CPU.

    Beyond an episode's `steps` its state is constant.

    Args:
        states: shape [B, N + 1, S].
        actions: shape [B, N, A].
        traversability: observed λ of each step, shape [B, N].
        speed_mps: speed of each action on terrain of λ = 1 [m/s], shape [B, N].
        turn_rate_radps: turn rate of each action, likewise [rad/s], shape [B, N].
        outcome: `Outcome`, shape [B].
        steps: steps to the end, shape [B].
        begin_s: wall time of the planner's preparation for the batch.
        planning_s: wall time of each step's plan, shape [N].
        planned: number of episodes planned for in each step, int64, shape [N].
        revisions: number of changes of each episode's map, int64, shape [B].
        learning_s: wall time of sensing and updates, total of all steps.
        errors: a line for each episode that ended by a fault of its planner, empty
            for the others, length B.
        traceback: traceback of the planner's exception; empty if there was none.
        seen_cells: number of cells each robot saw, int64, shape [B]; None if robots do
            not learn.
        sensed_cells: number of cells whose λ each robot measured, int64, shape [B];
            None likewise.
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
    """Timer of successive calls that does not wait for a GPU.

    On a GPU, events are recorded in its stream and read at the end.

    Args:
        device: device of the calls.
    """

    def __init__(self, device: torch.device) -> None:
        """Start without measurements."""
        self._on_gpu = device.type == "cuda"
        self._marks: list[tuple[Any, Any]] = []

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Measure the enclosed block; one that raises is not counted."""
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
        """Return the time of each call so far, in seconds."""
        if not self._on_gpu:
            return [end - begin for begin, end in self._marks]
        torch.cuda.synchronize()
        return [begin.elapsed_time(end) / 1e3 for begin, end in self._marks]


class _Log:
    """Record of the steps while they are taken."""

    def __init__(self, start: SimulationState, problem: Problem) -> None:
        self.dt_s = problem.dt_s
        self.states = [start.state]
        # Of each step: actions, observed λ, and distance and turn rate for λ = 1.
        empty = start.state.new_zeros(len(start.state), 0)
        self._steps = [
            [
                empty[..., None].expand(-1, 0, len(problem.robot.action_low)),
                empty,
                empty,
                empty,
            ]
        ]
        self.clock = Clock(start.state.device)  # what is prepared, then each plan
        self.learning = Clock(start.state.device)
        self.planned: list[int] = []
        self._reasons: list[str] = []
        # Index of each episode's reason; -1 for none.
        self._fault = torch.full_like(start.outcome, -1)

    def blame(self, mask: Tensor, reason: str) -> None:
        """Record why some running episodes end, by a mask, bool [B]."""
        if reason not in self._reasons:
            self._reasons.append(reason)
        self._fault = torch.where(mask, self._reasons.index(reason), self._fault)

    def add(
        self,
        after: SimulationState,
        action: Tensor,
        traversability: Tensor,
        free: Tensor,
    ) -> None:
        before = self.states[-1]
        turned = (free[:, 2] - before[:, 2]) / self.dt_s
        values = action, traversability, distance(free, before[:, :2]), turned
        self._steps.append([value.unsqueeze(1) for value in values])
        self.states.append(after.state)

    def episodes(
        self, now: SimulationState, traceback_: str, knowing: Knowing | None
    ) -> Episodes:
        track = torch.stack(self.states, dim=1)
        taken = len(self._steps) - 1
        actions, traversability, driven, turned = (
            torch.cat(values, dim=1) for values in zip(*self._steps, strict=True)
        )
        seconds = self.clock.seconds()
        outcome = tell_standstill(
            now.outcome, now.step, track[..., :2], driven, self.dt_s
        )
        errors = ["" if i < 0 else self._reasons[i] for i in self._fault.tolist()]
        learnt: dict[str, Any] = {"revisions": torch.zeros_like(now.step).cpu()}
        if knowing is not None:
            learnt = {
                "revisions": knowing.revisions.cpu(),
                "seen_cells": knowing.seen_cells.cpu(),
                "sensed_cells": knowing.sensed_cells.cpu(),
                "ahead": _by_step(knowing.ahead, len(track), taken),
            }
        return Episodes(
            states=track.cpu(),
            actions=actions.cpu(),
            traversability=traversability.cpu(),
            speed_mps=(driven / self.dt_s).cpu(),
            turn_rate_radps=turned.cpu(),
            outcome=outcome.cpu(),
            steps=now.step.cpu(),
            begin_s=seconds[0] if seconds else 0.0,
            # A planner that raised has no step for its last plan.
            planning_s=torch.tensor(seconds[1 : taken + 1], dtype=torch.float64),
            planned=torch.tensor(self.planned[:taken]),
            learning_s=sum(self.learning.seconds()),
            errors=tuple(errors),
            traceback=traceback_,
            **learnt,
        )


def _by_step(measured: Mapping[int, Tensor], batch: int, steps: int) -> Tensor:
    """Return scores of all steps, NaN without an update, shape [B, N, 2]."""
    scores = torch.full((batch, steps, 2), torch.nan)
    for step, values in measured.items():
        if step < steps:
            scores[:, step] = values.cpu()
    return scores


def run_episodes(
    planner: Planner[Any],
    problem: Problem,
    simulation: Simulation,
    generator: torch.Generator,
    observer: Observer = Observer(),
    stop: Callable[[int], bool] = lambda step: False,
    learning: Learning | None = None,
) -> Episodes:
    """Run a batch of episodes until all have ended.

    An exception of the planner ends the episodes that still run. An action that its
    robot cannot perform ends only its own episode.

    Args:
        planner: chooses actions; it receives copies of predictions, never the truth.
        problem: problem with predicted traversability.
        simulation: simulation with the true terrain.
        generator: random generator of the planner.
        observer: callbacks for recordings.
        stop: called with each step index; True ends the run. Episodes that still run
            keep the outcome running.
        learning: sensing and belief of the robots, whose planner then replans; None if
            they do not learn.

    Returns:
        The episodes.

    Raises:
        RobotError: If the robot's F failed in the simulation.
        DeviceError: If the GPU failed.
    """
    now = simulation.init(problem.start)
    log = _Log(now, problem)
    observed = torch.full_like(now.state[:, 0], torch.nan)
    check_interval = 1 if observed.device.type == "cpu" else _CHECK_INTERVAL
    trace = ""
    knowing = None if learning is None else Knowing(learning, problem)
    try:
        with log.clock.timed():
            plan_state = begin(planner, problem, generator)
        batch = _Batch(planner, problem, plan_state)
        for count in itertools.count():
            if stop(count):
                break
            if count % check_interval == 0:
                running = now.running.cpu()
                if not bool(running.any()):
                    break
                remaining = batch.drop_ended(running)
                if knowing is not None and remaining is not None:
                    knowing.keep(remaining)
            revised = None
            if knowing is not None:
                state = batch.part_of(now.state)
                running_part = batch.part_of(now.running)
                with log.learning.timed():
                    revised = knowing.learn(count, state, running_part)
                if knowing.is_due(count):
                    knowing.look_ahead(count, state, running_part)
                    if observer.knowledge is not None:
                        observer.knowledge(count, knowing)
            watched = observer.plan is not None and count % observer.plan_interval == 0
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
    """The episodes planned for: all at first, fewer after enough of them have ended.

    Args:
        planner: the planner.
        problem: problem of all episodes.
        plan_state: plan state returned by `begin`.
    """

    def __init__(
        self, planner: Planner[Any], problem: Problem, plan_state: Any
    ) -> None:
        self.members = torch.arange(len(problem))
        self._planner = planner
        self._all = problem
        self._part = problem
        self._state = plan_state
        self._index = self.members.to(problem.start.device)

    def drop_ended(self, running: Tensor) -> Tensor | None:
        """Remove ended episodes if a quarter has ended and the planner supports it.

        Args:
            running: mask of running episodes, bool on the CPU, shape [B].

        Returns:
            Indices of the remaining episodes among the previous ones, int64; None if no
            episode was removed.
        """
        remaining = running[self.members].nonzero()[:, 0]
        if len(remaining) > _FULL * len(self.members):
            return None
        indices = remaining.to(self._index.device)
        state = self._planner.select(self._state, indices)
        if state is NotImplemented:
            return None
        self._state = state
        self.members = self.members[remaining]
        self._index = self.members.to(self._index.device)
        self._part = self._part.select(indices)
        return indices

    def part_of(self, values: Tensor) -> Tensor:
        """Return the values of the remaining episodes, from values [B, ...] of all."""
        return values[self._index]

    def revise(self, problem: Problem, generator: torch.Generator) -> None:
        """Replan for a changed problem of the remaining episodes."""
        self._state = revise(self._planner, self._state, problem, generator)
        self._part = problem

    def act(self, step: Step) -> Answer:
        """Return the planner's answer for the remaining episodes."""
        part_step = replace(
            step,
            state=step.state[self._index],
            traversability=step.traversability[self._index],
        )
        answer = act(self._planner, part_step, self._state, self._part)
        self._state = answer.plan_state
        return answer

    def spread(self, answer: Answer) -> tuple[Tensor, Tensor, Tensor]:
        """Return actions, faults and statuses of all episodes, neutral for ended ones."""
        zeros = torch.zeros(
            len(self._all), dtype=torch.int64, device=self._index.device
        )
        return (
            standing_actions(self._all).index_copy(0, self._index, answer.action),
            zeros.bool().index_copy(0, self._index, answer.faulty),
            zeros.index_copy(0, self._index, answer.plan.status),
        )


class RobotError(BenchnavError):
    """A robot's F raised in the simulation, so that no row would be meaningful."""


def _move(
    simulation: Simulation, now: SimulationState, action: Tensor
) -> tuple[SimulationState, Tensor, Tensor]:
    """Return the next states, the observed λ, and the states that λ = 1 would give."""
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
