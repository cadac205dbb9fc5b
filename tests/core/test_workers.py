import os
import signal
import subprocess
import sys
import time
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from types import SimpleNamespace

import pytest

from benchnav.core import workers
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.workers import run_calls

LIVES = (
    "import time; from benchnav.core.workers import end_with; "
    "end_with({parent}); time.sleep({seconds}); print('done')"
)

# Prints the numbers of its processes, then waits to be interrupted or killed.
WAITS = """
import os, signal, sys, time
from concurrent.futures.process import BrokenProcessPool
from functools import partial
signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background jobs do not have
from benchnav.core.workers import run_calls
def call(number):
    time.sleep(0.01 if number < 2 else 60)
    return os.getpid()
try:
    for process in run_calls([partial(call, number) for number in range(4)], jobs=2):
        print(process, flush=True)
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.mark.parametrize(("of_this", "printed"), [(True, "done\n"), (False, "")])
def test_a_worker_lives_as_long_as_the_process_it_was_given(
    of_this: bool, printed: str
) -> None:
    # One whose parent was killed before it came up has another parent from the first.
    parent, seconds = (os.getpid(), 1.2) if of_this else (os.getppid(), 60)
    code = LIVES.format(parent=parent, seconds=seconds)
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120
    )
    assert ended.stdout == printed


def square(number: int) -> tuple[int, int]:
    return number**2, os.getpid()


def test_calls_give_the_same_here_and_in_processes() -> None:
    calls = [partial(square, number) for number in range(20)]
    here = list(run_calls(calls))
    assert here == [(number**2, os.getpid()) for number in range(20)]
    there = list(run_calls(calls, jobs=2))
    assert sorted(value for value, _ in there) == [value for value, _ in here]
    processes = {process for _, process in there}
    assert os.getpid() not in processes
    assert len(processes) <= 2
    again = {process for _, process in run_calls(calls, jobs=2)}
    assert again | processes == processes | again
    assert list(run_calls([], jobs=2)) == []


def test_workers_that_remain_follow_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = [os.getcwd] * 2
    assert set(run_calls(calls, jobs=2)) == {os.getcwd()}
    monkeypatch.chdir(tmp_path)
    assert set(run_calls(calls, jobs=2)) == {str(tmp_path)}


def test_the_error_of_a_call_is_raised_and_ends_the_others(tmp_path: Path) -> None:
    def write(number: int) -> None:
        if number == 0:
            raise ConfigError("of the call")
        time.sleep(0.3)
        (tmp_path / str(number)).touch()

    with pytest.raises(ConfigError, match="of the call"):
        list(run_calls([partial(write, number) for number in range(8)], jobs=2))
    time.sleep(0.5)
    assert len(list(tmp_path.iterdir())) < 4


def test_results_are_not_awaited_from_workers_that_are_gone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(workers, "_WORKERS_S", 0.01)
    gone = SimpleNamespace(is_alive=lambda: False)
    executor = SimpleNamespace(_processes={1: gone})
    with pytest.raises(BrokenProcessPool):
        workers._wait_for_one(executor, SimpleQueue())


def test_a_worker_that_is_killed_is_one_line_and_the_next_calls_have_others() -> None:
    def end(number: int) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(BenchnavError, match="A worker was killed"):
        list(run_calls([partial(end, number) for number in range(2)], jobs=2))
    assert (
        len(list(run_calls([partial(square, number) for number in range(2)], jobs=2)))
        == 2
    )


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_an_interruption_or_a_kill_leaves_no_process_and_says_nothing(
    how: signal.Signals, tmp_path: Path
) -> None:
    (tmp_path / "waits.py").write_text(WAITS)
    process = subprocess.Popen(
        [sys.executable, "waits.py"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        cwd=tmp_path, start_new_session=True, env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline().strip().isdigit()
    if how == signal.SIGINT:  # as a terminal sends it, to all of them
        os.killpg(process.pid, how)
    else:
        process.kill()
    _, printed = process.communicate(timeout=120)
    if how == signal.SIGINT:
        assert (process.returncode, printed) == (130, "")
    deadline = time.monotonic() + 20
    while _alive(process.pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not _alive(process.pid)


def _alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_cluster_makes_the_calls() -> None:
    from distributed import LocalCluster

    with LocalCluster(
        1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None
    ) as cluster:
        calls = [partial(square, number) for number in range(5)]
        found = list(run_calls(calls, scheduler=cluster.scheduler_address))
        assert sorted(value for value, _ in found) == [0, 1, 4, 9, 16]
        with pytest.raises(ZeroDivisionError):
            list(run_calls([lambda: 1 / 0], scheduler=cluster.scheduler_address))  # type: ignore[list-item]


def test_a_cluster_that_is_not_there_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(workers, "_CONNECTION_S", 0.2)
    for scheduler, message in (
        ("127.0.0.1:8786", "tcp://HOST:PORT"),
        ("tcp://127.0.0.1:9", "did not answer"),
    ):
        with pytest.raises(ConfigError, match=message):
            list(run_calls([partial(square, 1)], scheduler=scheduler))
