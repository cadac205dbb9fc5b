"""Planners, models and risk measures that tests name as `tests.eval.parts:Name`."""

import inspect
import os
import signal
import time
import uuid
from pathlib import Path
from typing import Any

import torch

from benchnav.core.mixture import TraversabilityMixture
from benchnav.models.base import TraversabilityModel
from benchnav.planning.planners.planner import Plan, Planner, PlanStatus
from benchnav.planning.problem import Problem, Task
from benchnav.planning.robots import Unicycle
from benchnav.planning.sensing.sensor import Step


class Spy(Planner[Any]):
    """Stands still, and writes down what it is given."""

    steers = (("speed_mps", "turn_rate_radps"),)
    writes = ("log",)

    def __init__(self, log: str, gain: float = 1.0) -> None:
        self.log, self.gain = Path(log), gain

    def init(self, problem: Problem, generator: torch.Generator):  # type: ignore[no-untyped-def]
        note = {
            "risk_map": problem.risk_map,
            "motion_map": problem.traversability,
            "free": problem.free,
            "start": problem.start,
            "goal_m": problem.goal_m,
            "time_budget_s": problem.time_budget_s,
            "components": problem.distribution.weights.shape[1],
            "rgb": problem.observation.rgb,
            "robot": repr(problem.robot),
            "objective": type(problem.objective).__name__,
            "generator": generator.initial_seed(),
            "gain": self.gain,
        }
        return note, []

    def plan(self, step: Step, plan_state):  # type: ignore[no-untyped-def]
        note, observed = plan_state
        observed = [*observed, step.traversability]
        if len(observed) == 4:
            torch.save(
                {**note, "observed": torch.stack(observed[1:])},
                self.log / f"{uuid.uuid4().hex}.pt",
            )
        return (
            torch.zeros(len(step.state), 2),
            (note, observed),
            Plan.empty(len(step.state)),
        )


class TwoModes(TraversabilityModel):
    """A model whose two components are no classes."""

    def predict(self, observation):  # type: ignore[no-untyped-def]
        half = torch.full((len(observation.rgb), 2, *observation.grid.shape), 0.5)
        return TraversabilityMixture(
            half, half + torch.tensor([0.4, 0.1]).view(2, 1, 1), 0.1 * half
        )


class Faulty(Planner[Problem]):
    """Drives straight on until `after_s`, then does something wrong for the episode
    nearest to its goal.
    """

    def __init__(self, fault: str = "none", after_s: float = 1.0) -> None:
        self.fault, self.after_s = fault, after_s

    def init(self, problem: Problem, generator: torch.Generator) -> Problem:
        if self.fault == "raise in init":
            raise RuntimeError("no beginning")
        if self.fault == "write in init":
            problem.risk_map.zero_()
            problem.start.zero_()
            problem.goal_m.copy_(problem.start[:, :2])
        return problem

    def plan(self, step: Step, plan_state: Problem):  # type: ignore[no-untyped-def]
        batch, device = len(step.state), step.state.device
        action = torch.tensor([[1.0, 0.0]], device=device).repeat(batch, 1)
        if step.time_s < self.after_s - 1e-6:
            return action, plan_state, Plan.empty(batch, device)
        if self.fault == "write":
            step.state[:, :2] = plan_state.goal_m
            step.traversability.zero_()
        if self.fault == "nan":
            action[0] = torch.nan
        if self.fault == "shape":
            action = action[:, :1]
        if self.fault == "raise":
            raise RuntimeError("no way on")
        if self.fault == "exit":
            raise SystemExit(0)
        if self.fault == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.fault == "hang":
            time.sleep(600)
        if self.fault == "give up":
            failed = torch.full((batch,), int(PlanStatus.FAILED), device=device)
            return action, plan_state, Plan.empty(batch, device, status=failed)
        return action, plan_state, Plan.empty(batch, device)


class Unseeing(Faulty):
    """Says that it uses nothing."""

    def uses(self, task: Task) -> frozenset[str]:
        return frozenset()


class ByMean(Faulty):
    """Says that it uses the prediction alone."""

    def uses(self, task: Task) -> frozenset[str]:
        return frozenset({"distribution"})


class Vague(Faulty):
    """Does not say what it uses in the words for it."""

    def uses(self, task: Task) -> frozenset[str]:
        return frozenset({"maps"})


class Steering(Faulty):
    """Knows one kind of robot alone."""

    steers = (("speed_mps", "turn_rate_radps"),)


class Still(Faulty):
    """Stands still."""

    def plan(self, step: Step, plan_state: Problem):  # type: ignore[no-untyped-def]
        action, plan_state, plan = super().plan(step, plan_state)
        return 0 * action, plan_state, plan


class Timed(Faulty):
    """Takes 80 ms for its first step, then 4 ms and for every tenth 40 ms; notes how
    many robots it plans for.
    """

    writes = ("log",)

    def __init__(self, log: str) -> None:
        super().__init__(after_s=1e9)
        self.log, self.calls = Path(log), 0

    def plan(self, step: Step, plan_state: Problem):  # type: ignore[no-untyped-def]
        time.sleep(0.08 if not self.calls else 0.04 if self.calls % 10 == 0 else 0.004)
        self.calls += 1
        with self.log.open("a") as log:
            log.write(f"{len(step.state)} {step.time_s:.3f}\n")
        return super().plan(step, plan_state)


class Picky(Faulty):
    """Can be made until a unit has begun, which a file tells."""

    def __init__(self, log: str) -> None:
        super().__init__()
        if any(line.function == "simulate" for line in inspect.stack()):
            raise OSError(f"not here: {log}")


class Held(Faulty):
    """Writes down which process began it; one that a file beside names, `PID N`, ends
    nothing from its Nth on.
    """

    writes = ("log",)

    def __init__(self, log: str) -> None:
        super().__init__()
        self.log = Path(log)

    def init(self, problem: Problem, generator: torch.Generator) -> Problem:
        own, hold = str(os.getpid()), self.log.with_suffix(".hold")
        with self.log.open("a") as log:
            log.write(f"{own}\n")
        if hold.exists():
            named, first = hold.read_text().split()
            while own == named and self.log.read_text().splitlines().count(own) >= int(
                first
            ):
                time.sleep(0.05)
        return problem


class Rusty(Unicycle):
    """A robot whose F fails where it drives fast."""

    def __call__(self, state, action, traversability):  # type: ignore[no-untyped-def]
        raise ValueError("seized")


class Gaussian(TraversabilityModel):
    """The same Gaussian everywhere."""

    def __init__(self, mean: float = 0.77, std: float = 0.01) -> None:
        self.mean, self.std = mean, std

    def predict(self, observation):  # type: ignore[no-untyped-def]
        ones = torch.ones_like(observation.slope_deg).unsqueeze(1)
        return TraversabilityMixture(ones, self.mean * ones, self.std * ones)


class Broken(TraversabilityModel):
    """A model that raises."""

    def predict(self, observation):  # type: ignore[no-untyped-def]
        raise ValueError("no idea")


def least(mixture: TraversabilityMixture, factor: float = 1.0) -> torch.Tensor:
    """A risk measure: the least component mean, times a factor."""
    return (mixture.means.amin(dim=1) * factor).clamp(0, 1)


class Noting(Still):
    """Stands still, and keeps each problem that it is given in a file."""

    writes = ("log",)

    def __init__(self, log: str) -> None:
        super().__init__()
        self.log = Path(log)

    def init(self, problem: Problem, generator: torch.Generator) -> Problem:
        return self._noted(problem)

    def revise(self, plan_state: Problem, problem: Problem) -> Problem:
        return self._noted(problem)

    def select(self, plan_state: Problem, members: torch.Tensor) -> Problem:
        return plan_state.select(members)

    def _noted(self, problem: Problem) -> Problem:
        observation = problem.observation
        note = {
            "rgb": observation.rgb,
            "seen": observation.layers.get("seen"),
            "risk_map": problem.risk_map,
        }
        torch.save(note, self.log / f"{len(list(self.log.iterdir())):03d}.pt")
        return problem


class Asleep(Planner[Problem]):
    """Writes down which process began it, and does not wake."""

    writes = ("folder",)

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def init(self, problem: Problem, generator: torch.Generator) -> Problem:
        (self.folder / str(os.getpid())).touch()
        time.sleep(600)
        return problem

    def plan(self, step: Step, plan_state: Problem):  # type: ignore[no-untyped-def]
        raise AssertionError("it has woken")
