"""A planner in a child process, so that a planner that hangs can be stopped.

The simulation stays in the parent process. Only calls of the planner are sent to the
child, each with a time limit. The child first loads planner, robot and objective by
name, so that it can unpickle objects of their classes.
"""

import multiprocessing
import pickle
import traceback
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

import torch

from benchnav.core.device import GPU_FAULTS, gpu_failed
from benchnav.core.errors import BenchnavError
from benchnav.core.touched import merge, snapshot
from benchnav.eval.experiment.condition import Condition
from benchnav.planning.planners import boundary
from benchnav.planning.planners.planner import Plan, Planner
from benchnav.planning.problem import Problem
from benchnav.planning.sensing.sensor import Step

# Time limits in seconds. Calls that may start or compile get the first limit in
# addition.
_START_S = 120.0
_CLOSE_S = 5.0


class PlannerProcessError(BenchnavError):
    """A planner timed out or raised, or its process ended.

    If the planner raised, the message is the last line of the traceback, and the error
    has the traceback as a note.
    """


class IsolatedPlanner(Planner[int]):
    """A condition's planner, run in a child process.

    Args:
        condition: condition of the planner.
        limit_s: time limit of each call in seconds; for `init`, `revise` and the first
            `plan`, which may compile, 120 s are added.
    """

    compiled: bool | None = None

    def __init__(self, condition: Condition, limit_s: float) -> None:
        """Start the child."""
        self.limit_s = limit_s
        context = multiprocessing.get_context("spawn")
        self._connection, child_end = context.Pipe()
        self._child = context.Process(
            target=_serve, args=(child_end, condition), daemon=True
        )
        self._child.start()
        child_end.close()
        try:
            self._ask(_START_S, "start")
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the child, and merge its record of files that the planner read."""
        if self._child.is_alive():
            with suppress(PlannerProcessError):
                merge(self._ask(_CLOSE_S, "touched"))
        self._child.kill()
        self._child.join()
        self._connection.close()

    def init(self, problem: Problem, generator: torch.Generator) -> int:
        """See `Planner`. Return the number of calls; the plan state stays in the child."""
        seed = generator.initial_seed()
        state = generator.get_state()
        self._ask(self.limit_s + _START_S, "init", problem, seed, state)
        return 0

    def plan(self, step: Step, plan_state: int) -> tuple[torch.Tensor, int, Plan]:
        """See `Planner`."""
        # The first call may compile.
        limit_s = self.limit_s if plan_state else self.limit_s + _START_S
        action, plan, self.compiled = self._ask(limit_s, "plan", step)
        return action, plan_state + 1, plan

    def revise(self, plan_state: int, problem: Problem) -> int:
        """See `Planner`. The call may prepare the planner again, as `init` does."""
        self._ask(self.limit_s + _START_S, "revise", problem)
        return plan_state

    def _ask(self, limit_s: float, call: str, *arguments: Any) -> Any:
        try:
            self._connection.send_bytes(pickle.dumps((call, *arguments)))
            if not self._connection.poll(limit_s):
                self._child.kill()
                raise PlannerProcessError(
                    f"The planner did not return from `{call}` within {limit_s:g} s."
                )
            kind, value = pickle.loads(self._connection.recv_bytes())
        except (EOFError, BrokenPipeError, ConnectionResetError) as error:
            self._child.join(1)
            raise PlannerProcessError(
                f"The planner's process ended in `{call}` with status "
                f"{self._child.exitcode}."
            ) from error
        if kind == "lost":
            raise gpu_failed(value)
        if kind == "raised":
            raised = PlannerProcessError(value.strip().splitlines()[-1])
            raised.add_note(value)
            raise raised
        return value


def _serve(connection: Connection, condition: Condition) -> None:
    """Run calls of the planner in the child until the connection closes."""
    torch.set_num_threads(1)
    planner: Any = None
    plan_state: Any = None
    generator = torch.Generator()
    while True:
        try:
            message = connection.recv_bytes()
        except EOFError:
            return
        try:
            call, *arguments = pickle.loads(message)
            answer: Any
            if call == "touched":
                answer = snapshot()
            elif call == "start":
                # A problem can be unpickled only after its classes are loaded.
                _ = condition.task, condition.belief.object
                planner = condition.planner.create()
                answer = None
            elif call == "init":
                problem, seed, state = arguments
                generator = torch.Generator().manual_seed(seed)
                generator.set_state(state)
                plan_state = planner.init(problem, generator)
                answer = None
            elif call == "revise":
                problem = arguments[0]
                plan_state = boundary.revise(planner, plan_state, problem, generator)
                answer = None
            else:
                action, plan_state, plan = planner.plan(arguments[0], plan_state)
                answer = action, plan, planner.compiled
            text = pickle.dumps(("answer", answer))
        except GPU_FAULTS as error:
            text = pickle.dumps(("lost", str(error)))
        except (Exception, SystemExit):
            text = pickle.dumps(("raised", traceback.format_exc()))
        connection.send_bytes(text)
