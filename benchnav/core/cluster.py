"""A Dask cluster, reached through joblib.

`distributed` is an extra of this package, imported when a cluster is asked for.
"""

import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from urllib.parse import urlparse

import joblib

from benchnav.core.errors import BenchnavError, ConfigError

_REACH_S = 5
_WORKERS_S = 10


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
            f"Expected Dask for a cluster, got: {error}. Install it: pip install 'benchnav[dask]'"
        ) from error
    _check_address(scheduler)
    with ExitStack() as stack:
        stack.enter_context(_quiet())
        try:
            client = stack.enter_context(Client(scheduler, timeout=_REACH_S, set_as_default=False))
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"Expected `scheduler` to be the address of a running Dask scheduler, got {scheduler}, which gave "
                f"no answer within {_REACH_S} s. Start one with `dask scheduler`."
            ) from error
        try:
            client.wait_for_workers(1, timeout=_WORKERS_S)
        except TimeoutError as error:
            raise ConfigError(
                f"Expected a cluster with workers, got {scheduler} with none for {_WORKERS_S} s. Start some with "
                f"`dask worker {scheduler} --nworkers N --nthreads 1`."
            ) from error
        yield client


def parallel(client: Any) -> joblib.Parallel:
    """Sends all calls at once, so that workers that join later have their share."""
    from joblib._dask import DaskDistributedBackend

    class Cluster(DaskDistributedBackend):
        def effective_n_jobs(self, n_jobs: int) -> int:
            # joblib would make the calls of a cluster of one worker in this process.
            return max(2, super().effective_n_jobs(n_jobs))

    backend = Cluster(client=client, wait_for_workers_timeout=_WORKERS_S)
    return joblib.Parallel(
        n_jobs=-1, backend=backend, return_as="generator_unordered", pre_dispatch="all", batch_size=1
    )


@contextmanager
def told_when_lost(scheduler: str) -> Iterator[None]:
    """Says what a user can do where the cluster is lost.

    Raises:
        BenchnavError: the scheduler was lost, or several workers died over one call.
    """
    from distributed import CancelledError, KilledWorker

    try:
        yield
    except CancelledError as error:
        raise BenchnavError(
            f"The scheduler at {scheduler} was lost. What was finished is kept: give the same command again."
        ) from error
    except KilledWorker as error:
        raise BenchnavError(
            f"Some work was given up, since several workers died over it, the last at {error.last_worker.address}: "
            "see their logs, perhaps for want of memory. What was finished is kept."
        ) from error


def _check_address(scheduler: str) -> None:
    place = urlparse(scheduler)
    try:
        known = place.scheme in ("tcp", "tls") and place.hostname and place.port
    except ValueError:  # a port that is no number
        known = False
    if not known:
        raise ConfigError(f"Expected `scheduler` tcp://HOST:PORT, got {scheduler!r}.")


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps the library's own log off the terminal; what a user has to know is raised."""
    levels = {name: logging.getLogger(name).level for name in ("distributed", "distributed.client")}
    for name in levels:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)
