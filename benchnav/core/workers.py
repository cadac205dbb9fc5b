"""Parallel calls in processes of this machine or on a Dask cluster.

`distributed` is an optional dependency, imported only for a cluster.
"""

import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, chdir, contextmanager
from functools import cache, partial
from itertools import islice
from multiprocessing import resource_tracker
from queue import Empty, SimpleQueue
from typing import Any, TypeVar
from urllib.parse import urlparse

from joblib.externals.loky import get_reusable_executor
from joblib.externals.loky.backend.utils import kill_process_tree

from benchnav.core.errors import BenchnavError, ConfigError, quiet
from benchnav.core.touched import THREADS

_POLL_S = 0.5
_CONNECTION_S = 5  # time limit for the connection to a scheduler
# Time limit for a cluster's first worker, and time between checks of local workers.
_WORKERS_S = 10

Result = TypeVar("Result")


def run_calls(
    calls: Sequence[Callable[[], Result]], jobs: int = 1, scheduler: str = ""
) -> Iterator[Result]:
    """Run calls in parallel and yield their results in order of completion.

    The first error ends the iteration. Worker processes remain for some minutes, so
    that later calls start quickly. Worker processes of this machine run a call in the
    current working directory. A call contains all other state of this process that it
    needs.

    Args:
        calls: functions without arguments, such as `functools.partial` objects, which
            are sent to other processes with cloudpickle.
        jobs: number of worker processes on this machine. If 1, this process runs the
            calls sequentially.
        scheduler: address of a Dask cluster's scheduler. The cluster's workers then run
            the calls instead of this machine's; empty without a cluster.

    Raises:
        ConfigError: If the cluster cannot be reached, or has no worker.
        BenchnavError: If a worker was killed, or the cluster was lost.
    """
    if scheduler:
        yield from _run_on_cluster(calls, scheduler)
    elif jobs == 1 or not calls:
        yield from (call() for call in calls)
    else:
        yield from _run_in_processes(calls, min(jobs, len(calls)))


@cache
def end_with(parent: int) -> None:
    """End this process when its parent ends, even if the parent is killed.

    Further calls in the same process have no effect.

    Args:
        parent: ID of the process that started this process. `os.getppid` may return
            another ID here, if the parent was killed during the start-up.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_POLL_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _run_in_processes(
    calls: Sequence[Callable[[], Result]], jobs: int
) -> Iterator[Result]:
    # One thread per worker; by default, each would start one thread per processor.
    threads = {name: os.environ.get(name, "1") for name in THREADS}
    executor = get_reusable_executor(
        jobs, timeout=300, initializer=end_with, initargs=(os.getpid(),), env=threads
    )
    # The executor replaces a worker whose memory has grown, with a warning that needs no
    # action of users.
    warnings.filterwarnings(
        "ignore", message="A worker stopped while some jobs were given"
    )
    # Finished futures arrive in a queue, because an interruption of
    # `concurrent.futures.wait` would leave a future locked.
    remaining = (partial(_call_in, os.getcwd(), call) for call in calls)
    pending = set[Future[Result]]()
    done = SimpleQueue[Future[Result]]()
    try:
        while True:
            # Submit only a few calls at a time, so that results do not accumulate.
            next_calls = islice(remaining, jobs + 1 - len(pending))
            pending |= _submit(executor, next_calls, done.put)
            if not pending:
                break
            future = _wait_for_one(executor, done)
            pending.remove(future)
            yield future.result()
    except BrokenProcessPool as error:
        raise BenchnavError(
            "A worker was killed, perhaps for lack of memory. Finished work is kept. Run "
            "the same command again, if necessary with fewer `jobs`."
        ) from error
    finally:
        # Pending results are not needed. The executor's own method to end its processes
        # fails while the executor sends a call.
        if pending:
            for process in list(executor._processes.values()):
                kill_process_tree(process)
            executor.shutdown()


def _call_in(folder: str, call: Callable[[], Result]) -> Result:
    """Run a call in a working directory, and return its result."""
    with chdir(folder):
        return call()


def _wait_for_one(executor: Any, done: SimpleQueue[Future[Result]]) -> Future[Result]:
    """Wait for the next future that is done, and return it.

    The executor usually detects a killed worker. On a loaded machine, however, it was
    observed to wait after its last worker had ended. This function detects that.

    Raises:
        BrokenProcessPool: If no worker is alive.
    """
    while True:
        try:
            return done.get(timeout=_WORKERS_S)
        except Empty:
            workers = list(executor._processes.values())
            if any(worker.is_alive() for worker in workers):
                continue
        # A result may have arrived since the timeout.
        if done.empty():
            raise BrokenProcessPool("no worker is alive")


def _submit(
    executor: Any,
    calls: Iterable[Callable[[], Result]],
    on_done: Callable[[Future[Result]], None],
) -> set[Future[Result]]:
    """Submit calls and return their futures, each with a callback on completion.

    Interruptions are blocked meanwhile, and new worker processes inherit this. An
    interruption would break their imports; only this process reacts to it.
    """
    # Start the resource tracker first, because its start ends the blocking.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        futures = {executor.submit(call) for call in calls}
        for future in futures:
            future.add_done_callback(on_done)
        return futures
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _run_on_cluster(
    calls: Sequence[Callable[[], Result]], scheduler: str
) -> Iterator[Result]:
    with connected(scheduler) as client:
        from distributed import CancelledError, KilledWorker, as_completed

        try:
            # Submit all calls at once, so that workers that join later receive some.
            futures = (client.submit(call, pure=False) for call in calls)
            for future in as_completed(futures, client.loop):
                yield future.result()
        except CancelledError as error:
            raise BenchnavError(
                f"The connection to the scheduler at {scheduler} was lost. Finished work "
                "is kept. Run the same command again."
            ) from error
        except KilledWorker as error:
            raise BenchnavError(
                "The cluster dropped a task after several workers were killed, the last "
                f"one at {error.last_worker.address}, perhaps for lack of memory. "
                "Finished work is kept. See the logs of the workers."
            ) from error


@contextmanager
def connected(scheduler: str) -> Iterator[Any]:
    """Yield a client of a cluster that has workers.

    Args:
        scheduler: address, such as tcp://127.0.0.1:8786.

    Raises:
        ConfigError: If Dask is not installed, or the scheduler cannot be reached or has
            no worker.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise ConfigError(
            f"Expected Dask to be installed for a cluster, got: {error}. Run: pip "
            "install 'benchnav[dask]'"
        ) from error
    address = urlparse(scheduler)
    try:
        has_host = address.hostname and address.port
    except ValueError:  # the port is not numeric
        has_host = False
    if not has_host or address.scheme not in ("tcp", "tls"):
        raise ConfigError(
            f"Expected `scheduler` as tcp://HOST:PORT or tls://HOST:PORT, got "
            f"{scheduler!r}."
        )
    with ExitStack() as stack:
        stack.enter_context(quiet("distributed", "distributed.client"))
        try:
            client = stack.enter_context(
                Client(scheduler, timeout=_CONNECTION_S, set_as_default=False)
            )
        except (OSError, ValueError) as error:
            raise ConfigError(
                "Expected `scheduler` to be the address of a running Dask scheduler, "
                f"got {scheduler}, which did not answer within {_CONNECTION_S} s. Start "
                "a scheduler with `dask scheduler`."
            ) from error
        try:
            client.wait_for_workers(1, timeout=_WORKERS_S)
        except TimeoutError as error:
            raise ConfigError(
                f"Expected a cluster with workers, got {scheduler}, which had no worker "
                f"for {_WORKERS_S} s. Start workers with "
                f"`dask worker {scheduler} --nworkers N --nthreads 1`."
            ) from error
        yield client
