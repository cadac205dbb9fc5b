"""Episodes: a planner and the simulation in a closed loop, as one batch.

A GPU executes queued work while the CPU queues more, as long as the CPU reads no value.
On a GPU, the loop therefore reads the mask of running episodes only every few steps,
and records errors as tensors until the end.
Letters in shapes: B episodes, N steps, S state and A action dimensions.
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
from benchnav.core.errors import BenchnavError, out_of_memory_error
from benchnav.core.settings import fault
from benchnav.eval.run.knowledge import KnowledgeTracker, Learning
from benchnav.eval.run.planned_batch import PlannedBatch
from benchnav.planning.objective import distance
from benchnav.planning.planners.boundary import begin
from benchnav.planning.planners.planner import Plan, Planner, PlanStatus
from benchnav.planning.problem import Problem
from benchnav.planning.sensing.knowledge import KnowledgeError
from benchnav.planning.sensing.sensor import Step
from benchnav.planning.world.outcome import Outcome, classify_standstill
from benchnav.planning.world.simulation import Simulation, SimulationState, end

_CHECK_INTERVAL = 8  # steps between two reads of the running episodes on a GPU


@dataclass(frozen=True, kw_only=True)
class Observer:
    """Callbacks during episodes, for recordings.

    Args:
        plan: function that is called before a step is taken, with the index of the
            step, the plan and the indices of the planned episodes.
        plan_interval: number of steps between two calls of `plan`; the first call is at
            the first step.
        knowledge: function that is called after an update and before the step is
            planned, with the index of the step and the knowledge.
        state: function that is called with the state of the simulation at the start and
            after each step.
    """

    plan: Callable[[int, Plan, list[int]], None] | None = None
    plan_interval: int = 1
    knowledge: Callable[[int, KnowledgeTracker], None] | None = None
    state: Callable[[SimulationState], None] = lambda now: None


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """Trajectories and outcomes of a batch of episodes, on the CPU.

    Once an episode has ended, after its `steps` steps, its state is constant.

    Args:
        states: robot states, shape [B, N + 1, S].
        actions: commanded actions, shape [B, N, A].
        traversability: observed λ of each step, shape [B, N].
        unhindered_speed_mps: speed that the action of each step would give on terrain
            with λ = 1, in m/s, shape [B, N].
        unhindered_turn_rate_radps: turn rate that the action of each step would give on
            terrain with λ = 1, in rad/s, shape [B, N].
        outcome: codes of `Outcome`, int64, shape [B].
        steps: number of steps to the end, int64, shape [B].
        begin_s: wall time of the planner's preparation for the batch, in seconds.
        planning_s: wall time of planning at each step, for all planned episodes, in
            seconds, shape [N].
        planned: number of planned episodes at each step, int64, shape [N].
        revisions: number of times each robot's λ̂ map was updated, int64, shape [B].
        learning_s: wall time of sensing and updates in all steps, in seconds.
        errors: one-line description of the error that ended each episode, length B;
            empty without an error.
        traceback: traceback of the exception that ended episodes; empty without one.
        seen_cells: number of cells whose appearance each robot observed, int64, shape
            [B]; None if robots do not learn.
        sensed_cells: number of cells whose λ each robot measured, int64, shape [B];
            None if robots do not learn.
        ahead: RMSE of E[λ] and mean log score over the cells ahead of the robot, as in
            `KnowledgeTracker.ahead`, shape [B, N, 2]; NaN at steps without an update. None if
            robots do not learn.
    """

    states: Tensor
    actions: Tensor
    traversability: Tensor
    unhindered_speed_mps: Tensor
    unhindered_turn_rate_radps: Tensor
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
    """Timer of successive code blocks that does not wait for a GPU.

    On a GPU, events are recorded in the GPU's stream and read at the end.

    Args:
        device: device on which the blocks compute.
    """

    def __init__(self, device: torch.device) -> None:
        """Start without measurements."""
        self._on_gpu = device.type == "cuda"
        self._marks: list[tuple[Any, Any]] = []

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Measure the enclosed block, unless it raises."""
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
        """Return the time of each measured block, in seconds."""
        if not self._on_gpu:
            return [end - begin for begin, end in self._marks]
        torch.cuda.synchronize()
        return [begin.elapsed_time(end) / 1e3 for begin, end in self._marks]


class _Log:
    """Record of the steps of all episodes."""

    def __init__(self, start: SimulationState, problem: Problem) -> None:
        device = start.state.device
        self.dt_s = problem.dt_s
        self.states = [start.state]
        # Values of each step: action, observed λ, and distance and turn rate for λ = 1.
        # The empty first entry defines the shapes if there is no step.
        n_actions = len(problem.robot.action_low)
        empty = start.state.new_zeros(len(start.state), 0)
        no_actions = empty[..., None].expand(-1, 0, n_actions)
        self._steps = [[no_actions, empty, empty, empty]]
        self.clock = Clock(device)  # times the preparation, then each plan
        self.learning_clock = Clock(device)  # times sensing and updates
        self.planned: list[int] = []
        self._reasons: list[str] = []
        # Index of each episode's reason; -1 without an error.
        self._reason_index = torch.full_like(start.outcome, -1)

    def record_error(self, mask: Tensor, reason: str) -> None:
        """Record the error that ends the episodes of a mask, bool, shape [B]."""
        if reason not in self._reasons:
            self._reasons.append(reason)
        index = self._reasons.index(reason)
        self._reason_index = torch.where(mask, index, self._reason_index)

    def add(
        self,
        after: SimulationState,
        action: Tensor,
        traversability: Tensor,
        unhindered: Tensor,
    ) -> None:
        """Add a step.

        Args:
            after: state of the simulation after the step.
            action: commanded actions, shape [B, A].
            traversability: observed λ, shape [B].
            unhindered: robot states after the step if λ were 1, shape [B, S].
        """
        before = self.states[-1]
        distance_m = distance(unhindered, before[:, :2])
        turn_rate = (unhindered[:, 2] - before[:, 2]) / self.dt_s
        values = (action, traversability, distance_m, turn_rate)
        self._steps.append([value.unsqueeze(1) for value in values])
        self.states.append(after.state)

    def episodes(
        self, now: SimulationState, traceback_: str, tracker: KnowledgeTracker | None
    ) -> Episodes:
        """Return the episodes; `now` is the last state of the simulation."""
        track = torch.stack(self.states, dim=1)
        n_steps = len(self._steps) - 1
        actions, traversability, distance_m, turn_rate = (
            torch.cat(values, dim=1) for values in zip(*self._steps, strict=True)
        )
        seconds = self.clock.seconds()
        outcome = classify_standstill(
            now.outcome, now.step, track[..., :2], distance_m, self.dt_s
        )
        reasons = [*self._reasons, ""]  # index -1 selects the empty reason
        errors = [reasons[index] for index in self._reason_index.tolist()]
        learning: dict[str, Any] = {}
        if tracker is None:
            learning["revisions"] = torch.zeros_like(now.step).cpu()
        else:
            learning["revisions"] = tracker.revisions.cpu()
            learning["seen_cells"] = tracker.seen_cells.cpu()
            learning["sensed_cells"] = tracker.sensed_cells.cpu()
            learning["ahead"] = _by_step(tracker.ahead, len(track), n_steps)
        return Episodes(
            states=track.cpu(),
            actions=actions.cpu(),
            traversability=traversability.cpu(),
            unhindered_speed_mps=(distance_m / self.dt_s).cpu(),
            unhindered_turn_rate_radps=turn_rate.cpu(),
            outcome=outcome.cpu(),
            steps=now.step.cpu(),
            begin_s=seconds[0] if seconds else 0.0,
            # If the planner raised, its last plan belongs to no step.
            planning_s=torch.tensor(seconds[1 : n_steps + 1], dtype=torch.float64),
            planned=torch.tensor(self.planned[:n_steps]),
            learning_s=sum(self.learning_clock.seconds()),
            errors=tuple(errors),
            traceback=traceback_,
            **learning,
        )


def _by_step(measured: Mapping[int, Tensor], batch: int, steps: int) -> Tensor:
    """Return the scores of all steps, shape [B, N, 2]; NaN without an update."""
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

    An exception of the planner ends all episodes that still run. An action that the
    robot cannot perform ends only the episode of this robot.

    Args:
        planner: planner that chooses actions; it receives copies of predictions, never
            the true terrain.
        problem: problem with predicted traversability.
        simulation: simulation with the true terrain.
        generator: random generator of the planner.
        observer: callbacks for recordings.
        stop: function that is called with the index of each step. If it returns True,
            the batch stops, and episodes that still run keep the outcome `RUNNING`.
        learning: sensing and belief of the robots; None if the robots do not learn.

    Returns:
        The episodes.

    Raises:
        RobotError: If the robot dynamics F failed in the simulation.
        DeviceError: If the GPU failed.
    """
    now = simulation.init(problem.start)
    observer.state(now)
    log = _Log(now, problem)
    observed = torch.full_like(now.state[:, 0], torch.nan)
    check_interval = 1 if observed.device.type == "cpu" else _CHECK_INTERVAL
    traceback_ = ""
    tracker = None if learning is None else KnowledgeTracker(learning, problem)
    try:
        with log.clock.timed():
            plan_state = begin(planner, problem, generator)
        batch = PlannedBatch(planner, problem, plan_state)
        for count in itertools.count():
            if stop(count):
                break
            if count % check_interval == 0:
                running = now.running.cpu()
                if not bool(running.any()):
                    break
                remaining = batch.drop_ended(running)
                if tracker is not None and remaining is not None:
                    tracker.keep(remaining)
            revised_problem = None
            if tracker is not None:
                state = batch.part_of(now.state)
                running_part = batch.part_of(now.running)
                with log.learning_clock.timed():
                    revised_problem = tracker.learn(count, state, running_part)
                if tracker.is_due(count):
                    tracker.look_ahead(count, state, running_part)
                    if observer.knowledge is not None:
                        observer.knowledge(count, tracker)
            watched = observer.plan is not None and count % observer.plan_interval == 0
            step = Step(
                state=now.state,
                traversability=observed,
                time_s=count * problem.dt_s,
                draw=watched,
            )
            with log.clock.timed():
                if revised_problem is not None:
                    batch.revise(revised_problem, generator)
                answer = batch.act(step)
            log.planned.append(len(batch.episode_indices))
            if watched and observer.plan is not None:
                observer.plan(count, answer.plan, batch.episode_indices.tolist())
            action, faulty, status = batch.spread(answer)
            log.record_error(now.running & faulty, answer.reason)
            now = end(now, faulty, Outcome.PLANNER_ERROR)
            now = end(now, status == PlanStatus.FAILED, Outcome.PLANNER_FAILURE)
            now, observed, unhindered = _move(simulation, now, action)
            log.add(now, action, observed, unhindered)
            observer.state(now)
    except (RobotError, DeviceError):
        raise
    except GPU_FAULTS as error:
        raise gpu_failed(error) from error
    except (Exception, SystemExit) as error:
        if no_memory := out_of_memory_error(error):
            raise no_memory from error
        traceback_ = traceback.format_exc() if bool(now.running.any()) else ""
        log.record_error(now.running, fault(error))
        outcome = (
            error.outcome
            if isinstance(error, KnowledgeError)
            else Outcome.PLANNER_ERROR
        )
        now = end(now, now.running, outcome)
    episodes = log.episodes(now, traceback_, tracker)
    faults = simulation.faults(now)
    errors = [
        first or second for first, second in zip(episodes.errors, faults, strict=True)
    ]
    return replace(episodes, errors=tuple(errors))


class RobotError(BenchnavError):
    """The robot dynamics F raised an error in the simulation, so no result is valid."""


def _move(
    simulation: Simulation, now: SimulationState, action: Tensor
) -> tuple[SimulationState, Tensor, Tensor]:
    """Return the next state, the observed λ, and the robot states if λ were 1."""
    try:
        unhindered = simulation.unhindered(now, action)
        return *simulation.step(now, action), unhindered
    except GPU_FAULTS as error:
        raise gpu_failed(error) from error
    except Exception as error:
        robot = type(simulation.robot).__name__
        message = f"Robot {robot} failed in the simulation: {fault(error)}"
        raise out_of_memory_error(error) or RobotError(message) from error
