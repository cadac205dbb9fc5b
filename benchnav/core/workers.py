"""Calls made elsewhere: in processes of this machine, or on a Dask cluster.

`distributed` is an extra of this package, imported when a cluster is asked for.
"""

import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from functools import cache
from itertools import islice
from multiprocessing import resource_tracker
from queue import Empty, SimpleQueue
from typing import Any, TypeVar
from urllib.parse import urlparse

from joblib.externals.loky import get_reusable_executor
from joblib.externals.loky.backend.utils import kill_process_tree

from benchnav.core.errors import BenchnavError, ConfigError, quiet
from benchnav.core.touched import THREADS

_LOOK_S = 0.5
_REACH_S = 5
_WORKERS_S = 10

Result = TypeVar("Result")


def run_calls(
    calls: Sequence[Callable[[], Result]], jobs: int = 1, scheduler: str = ""
) -> Iterator[Result]:
    """Makes calls and yields what they return, each as it is done, in any order; the
    first error ends it.

    Worker processes outlive the calls for some minutes, so that the next ones find them
    ready. So what they need to know of this process, such as its folder, belongs into
    the calls.

    Args:
        calls: what is done, such as `functools.partial` of a function; sent to other
            processes with cloudpickle.
        jobs: processes of this machine; 1 makes the calls in this one, one after the
            other.
        scheduler: address of a Dask cluster's scheduler, whose workers take their
            place; empty for none.

    Raises:
        ConfigError: the cluster cannot be reached, or has no worker.
        BenchnavError: a worker was killed, or the cluster was lost.
    """
    if scheduler:
        yield from _run_on_cluster(calls, scheduler)
    elif jobs == 1 or not calls:
        yield from (call() for call in calls)
    else:
        yield from _run_in_processes(calls, min(jobs, len(calls)))


@cache
def end_with(parent: int) -> None:
    """Ends this process when its parent is gone, which a kill tells no worker; once a
    process is enough.

    Args:
        parent: number of the process that started this one. It is given, since a worker
            that is still on its way up when its parent is killed would take the process
            that adopts it for its parent.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _run_in_processes(
    calls: Sequence[Callable[[], Result]], jobs: int
) -> Iterator[Result]:
    # Processes that share the processors should not each take all of them.
    threads = {name: os.environ.get(name, "1") for name in THREADS}
    executor = get_reusable_executor(
        jobs, timeout=300, initializer=end_with, initargs=(os.getpid(),), env=threads
    )
    # A worker whose memory has grown is replaced; that is no concern of a user's.
    warnings.filterwarnings(
        "ignore", message="A worker stopped while some jobs were given"
    )
    # Not `concurrent.futures.wait`: an interruption in the midst of it would leave a
    # future locked for good.
    waiting, pending, done = (
        iter(calls),
        set[Future[Result]](),
        SimpleQueue[Future[Result]](),
    )
    try:
        # Few at a time, so that results do not pile up.
        while pending := pending | _submit(
            executor, islice(waiting, jobs + 1 - len(pending)), done.put
        ):
            future = _wait_for_one(executor, done)
            pending.remove(future)
            yield future.result()
    except BrokenProcessPool as error:
        raise BenchnavError(
            "A worker was killed, perhaps for lack of memory. Finished work is kept: "
            "give the same command again, "
            "if need be with fewer `jobs`."
        ) from error
    finally:
        # nobody waits for them; the library's own way to end them fails while it hands
        # a call over
        if pending:
            for process in list(executor._processes.values()):
                kill_process_tree(process)
            executor.shutdown()


def _wait_for_one(executor: Any, done: SimpleQueue[Future[Result]]) -> Future[Result]:
    """Return the next future that is done.

    The executor usually notices that a worker was killed. On a loaded machine it was
    seen to wait for results after its last worker had gone, which this notices.

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
        # A result may have come between the two looks.
        if done.empty():
            raise BrokenProcessPool("no worker is alive")


def _submit(
    executor: Any,
    calls: Iterable[Callable[[], Result]],
    tell: Callable[[Future[Result]], None],
) -> set[Future[Result]]:
    """Hands calls over, each to be told of when it is done.

    Processes that are started for them inherit that they hear no interruption: it is
    for this process to act on, and would find them in the middle of their imports.
    """
    # its start, which the first process would need, ends the blocking
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        futures = {executor.submit(call) for call in calls}
        for future in futures:
            future.add_done_callback(tell)
        return futures
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _run_on_cluster(
    calls: Sequence[Callable[[], Result]], scheduler: str
) -> Iterator[Result]:
    with connected(scheduler) as client:
        from distributed import CancelledError, KilledWorker, as_completed

        try:
            # All at once, so that workers that join later have their share.
            for future in as_completed(
                (client.submit(call, pure=False) for call in calls), client.loop
            ):
                yield future.result()
        except CancelledError as error:
            raise BenchnavError(
                f"The scheduler at {scheduler} was lost. Finished work is kept: give "
                "the same command again."
            ) from error
        except KilledWorker as error:
            raise BenchnavError(
                "A task was dropped; it killed several workers, the last at "
                f"{error.last_worker.address}: "
                "see their logs, perhaps for lack of memory. Finished work is kept."
            ) from error


@contextmanager
def connected(scheduler: str) -> Iterator[Any]:
    """A client of a cluster that has workers.

    Args:
        scheduler: address, such as tcp://127.0.0.1:8786.

    Raises:
        ConfigError: the scheduler cannot be reached, or has no worker.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise ConfigError(
            f"Expected Dask for a cluster, got: {error}. Install it: pip install "
            "'benchnav[dask]'"
        ) from error
    place = urlparse(scheduler)
    try:
        known = place.scheme in ("tcp", "tls") and place.hostname and place.port
    except ValueError:  # a port that is no number
        known = False
    if not known:
        raise ConfigError(f"Expected `scheduler` tcp://HOST:PORT, got {scheduler!r}.")
    with ExitStack() as stack:
        stack.enter_context(quiet("distributed", "distributed.client"))
        try:
            client = stack.enter_context(
                Client(scheduler, timeout=_REACH_S, set_as_default=False)
            )
        except (OSError, ValueError) as error:
            raise ConfigError(
                "Expected `scheduler` to be the address of a running Dask scheduler, "
                f"got {scheduler}, which gave "
                f"no answer within {_REACH_S} s. Start one with `dask scheduler`."
            ) from error
        try:
            client.wait_for_workers(1, timeout=_WORKERS_S)
        except TimeoutError as error:
            raise ConfigError(
                f"Expected a cluster with workers, got {scheduler} with none for "
                f"{_WORKERS_S} s. Start some with "
                f"`dask worker {scheduler} --nworkers N --nthreads 1`."
            ) from error
        yield client
