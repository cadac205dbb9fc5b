"""A run on a real Dask cluster has the rows of one process, whatever happens to workers
and scheduler.
"""

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest
import torch

from benchnav.core import workers as dask
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import units
from benchnav.eval.folder import provenance
from benchnav.eval.folder.run_folder import open_run
from benchnav.eval.folder.steps import read_steps
from benchnav.eval.run import cluster
from benchnav.eval.run.cluster import check_worker, run_on_worker
from benchnav.eval.run.runner import run_suite
from benchnav.eval.run.unit import Settings
from tests.commands import call

pytestmark = pytest.mark.skipif(
    find_spec("distributed") is None, reason="the extra dask is not installed"
)

ROOT = Path(__file__).parents[3]
PATIENCE_S = 600  # a busy machine takes its time to start processes
KEYS = ["condition", "seed", "realisation", "map"]


class Cluster:
    """A scheduler and workers of one thread, each a process of its own on this machine."""

    def __init__(self, folder: Path, workers: int) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.folder, self.address = folder, f"tcp://127.0.0.1:{self.port}"
        self.scheduler = self._start("scheduler", "--port", str(self.port))
        of_one = ("worker", self.address, "--no-nanny", "--nthreads", "1")
        self.workers = [self._start(*of_one) for _ in range(workers)]
        try:
            from distributed import Client

            with Client(
                self.address, timeout=PATIENCE_S, set_as_default=False
            ) as client:
                client.wait_for_workers(workers, timeout=PATIENCE_S)
        except BaseException:
            self.stop()
            raise

    def _start(self, role: str, *options: str) -> subprocess.Popen[bytes]:
        words = ["-m", "dask", role, "--host", "127.0.0.1", "--no-dashboard", *options]
        local = ["--local-directory", str(self.folder)] if role == "worker" else []
        with open(self.folder / f"{role}.log", "ab") as log:
            return subprocess.Popen(
                [sys.executable, *words, *local], cwd=ROOT, stdout=log, stderr=log,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            )  # fmt: skip

    def stop(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def cluster_of_two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    made = Cluster(tmp_path_factory.mktemp("cluster"), 2)
    yield made
    made.stop()


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask, "_CONNECTION_S", PATIENCE_S)
    monkeypatch.setattr(dask, "_WORKERS_S", PATIENCE_S)


def suite_on(dataset: Path, log: Path, **changes: object) -> Suite:
    held = {
        "part": "tests.eval.parts:Held",
        "label": "held",
        "options": {"log": str(log)},
    }
    given = {
        "data": str(dataset), "model": "oracle", "planners": (held,), "risks": ("mean", "cvar"),
        "scenarios": ("std", "hs"), "maps": 2, "seeds": (0, 1), "world": {"noise": "stored", "time_budget_s": 6.0},
    } | changes  # fmt: skip
    return Suite(**given)  # type: ignore[arg-type]


def same(one: Path, other: Path, without: tuple[str, ...] = ()) -> None:
    """Asserts that two runs have the same rows in the same order, but for some columns,
    steps and recordings.
    """
    first, second = (
        pd.read_parquet(run / "episodes.parquet").drop(columns=list(without))
        for run in (one, other)
    )
    assert not second.duplicated(KEYS).any()
    pd.testing.assert_frame_equal(
        *(
            rows[[c for c in rows if not c.startswith("planning_")]]
            for rows in (first, second)
        )
    )
    pd.testing.assert_frame_equal(*(read_steps(run) for run in (one, other)))
    recordings = [
        sorted(path.name for path in (run / "playback").glob("*"))
        for run in (one, other)
    ]
    assert recordings[0] == recordings[1] != []


def test_a_worker_that_is_killed_in_the_middle_loses_nothing_and_doubles_nothing(
    cluster_of_two: Cluster, dataset_path: Path, tmp_path: Path
) -> None:
    log, suite = tmp_path / "log", suite_on(dataset_path, tmp_path / "log")
    victim, other = cluster_of_two.workers
    (tmp_path / "log.hold").write_text(f"{victim.pid} 1")
    steps = run_suite(suite, tmp_path / "cluster", jobs=cluster_of_two.address)
    done = 0
    while done < 2 or str(victim.pid) not in log.read_text().splitlines():
        done, total = next(steps)
    assert done < total == 8
    victim.kill()  # in the middle of a unit
    last = list(steps)[-1]
    assert (last.done, last.total) == (8, 8)
    begun = log.read_text().splitlines()
    assert begun.count(str(os.getpid())) == 1  # one robot alone, for its latency
    assert set(begun) == {str(victim.pid), str(other.pid), str(os.getpid())}
    assert len(begun) == 8 + 1 + 1
    list(run_suite(suite, tmp_path / "here"))
    same(tmp_path / "here", tmp_path / "cluster")
    assert len(list((tmp_path / "cluster").glob("units/*/*"))) == 8
    assert not list((tmp_path / "cluster").rglob(".*"))


def test_a_worker_of_other_code_or_without_the_data_is_named(
    cluster_of_two: Cluster,
    dataset_path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    suite = suite_on(
        dataset_path, tmp_path / "log", risks=("mean",), scenarios=("std",), seeds=(0,)
    )
    modules = provenance.digests_of_package_modules
    with monkeypatch.context() as patch:
        patch.setattr(
            provenance,
            "digests_of_package_modules",
            lambda names: modules(names) | {"benchnav.eval.run.rollout": "0"},
        )
        with pytest.raises(
            ConfigError,
            match=r"tcp://127\.0\.0\.1:\d+: .*got changes: benchnav\.eval\.run\.rollout",
        ):
            list(run_suite(suite, tmp_path / "run", jobs=cluster_of_two.address))
    assert not list((tmp_path / "run").glob("units/*/*"))
    # What only a unit can tell: a part's file, and the maps, that are not there when it
    # begins.
    mine, data = tmp_path / "mine.py", shutil.copy(dataset_path, tmp_path / "tiny.h5")
    mine.write_text(
        "from tests.eval.parts import Faulty\n\nclass Mine(Faulty):\n    pass\n"
    )
    suite = suite_on(data, tmp_path / "log", planners=(f"{mine}:Mine",))
    for change, expected in (
        (
            lambda: mine.write_text(mine.read_text() + "# edited\n"),
            r"\d+: .*got changes: planner .*mine\.py",
        ),
        (data.unlink, r"\d+: .*tiny\.h5"),
    ):
        steps = run_suite(
            suite, tmp_path / "run", overwrite=True, jobs=cluster_of_two.address
        )
        next(steps)
        change()
        with pytest.raises(BenchnavError, match=rf"tcp://127\.0\.0\.1:{expected}"):
            list(steps)
        assert not list((tmp_path / "run").glob("units/*/*"))


def test_planners_with_a_time_limit_have_processes_of_their_own_on_workers_too(
    cluster_of_two: Cluster, dataset_path: Path, tmp_path: Path
) -> None:
    log = tmp_path / "log"
    suite = suite_on(dataset_path, log, risks=("mean",), scenarios=("std",), seeds=(0,))
    list(
        run_suite(
            suite,
            tmp_path / "cluster",
            settings=Settings(planner_limit_s=PATIENCE_S),
            jobs=cluster_of_two.address,
        )
    )
    begun = log.read_text().split()
    assert len(begun) == 2  # the unit, and one robot alone for its latency
    assert not set(begun) & {
        str(pid) for pid in (os.getpid(), *(w.pid for w in cluster_of_two.workers))
    }
    list(run_suite(suite, tmp_path / "here"))
    assert log.read_text().split() == [*begun, str(os.getpid()), str(os.getpid())]
    # of which a time limit is part
    same(tmp_path / "here", tmp_path / "cluster", without=("code",))


def test_half_of_a_run_on_a_cluster_that_is_lost_and_half_here(
    cluster_of_two: Cluster, dataset_path: Path, tmp_path: Path
) -> None:
    """The last test of the cluster, which it ends."""
    suite = suite_on(dataset_path, tmp_path / "log")
    gone, worker = cluster_of_two.workers
    gone.kill()
    (tmp_path / "log.hold").write_text(f"{worker.pid} 5")
    steps = run_suite(suite, tmp_path / "run", jobs=cluster_of_two.address)
    while next(steps).done < 4:
        pass
    cluster_of_two.scheduler.kill()
    with pytest.raises(BenchnavError, match=r"was lost\. Finished work is kept"):
        list(steps)
    cluster_of_two.stop()
    kept = {
        path: path.stat().st_mtime_ns
        for path in (tmp_path / "run").glob("units/*/*.parquet")
    }
    assert len(kept) == 4
    list(run_suite(suite, tmp_path / "run"))
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    list(run_suite(suite, tmp_path / "here"))
    same(tmp_path / "here", tmp_path / "run")


def test_a_scheduler_that_cannot_be_reached_is_one_line_and_drops_nothing(
    dataset_path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(dask, "_CONNECTION_S", 0.2)
    suite = suite_on(
        dataset_path, tmp_path / "log", scenarios=("std",), risks=("mean",), seeds=(0,)
    )
    list(run_suite(suite, tmp_path / "run"))
    before = sorted((tmp_path / "run").rglob("*"))
    with socket.socket() as free:  # bound, and nobody listens
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        words = (
            "run",
            "--data",
            str(dataset_path),
            "--model",
            "oracle",
            "--planners",
            "[straight]",
            "--overwrite",
        )
        words += (
            "--maps",
            "1",
            "--out",
            str(tmp_path / "run"),
            "--backend",
            "dask",
            "--scheduler",
            address,
        )
        assert call("eval", *words) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert address in line
    assert captured.out == ""
    assert sorted((tmp_path / "run").rglob("*")) == before


@pytest.mark.parametrize(
    "address",
    ["127.0.0.1:8786", "tcp://127.0.0.1", "http://a:1", "tcp://a:b", "tcp://:1"],
)
def test_an_address_is_as_dask_writes_it(
    address: str, dataset_path: Path, tmp_path: Path
) -> None:
    suite = suite_on(dataset_path, tmp_path / "log")
    with pytest.raises(ConfigError, match="tcp://HOST:PORT"):
        list(run_suite(suite, tmp_path / "run", jobs=address))
    assert not (tmp_path / "run").exists()


def test_parts_of_this_process_alone_are_refused(
    dataset_path: Path, tmp_path: Path
) -> None:
    from benchnav.core import registry
    from tests.eval.parts import Faulty

    registry.register("planner", "only_here", Faulty)
    suite = suite_on(dataset_path, tmp_path / "log", planners=("only_here",))
    with pytest.raises(ConfigError, match="scheduler"):
        list(run_suite(suite, tmp_path / "run", jobs="tcp://127.0.0.1:1"))


def worker_of(folder: Path, threads: int = 1) -> Any:
    """What a unit sees of the worker that it is on."""
    return SimpleNamespace(
        address="tcp://w",
        local_directory=str(folder),
        state=SimpleNamespace(nthreads=threads),
    )


def test_a_worker_is_refused_for_each_thing_that_would_change_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its code and maps are checked with each unit."""
    check_worker(worker_of(tmp_path), Settings())
    check_worker(worker_of(tmp_path), Settings(planner_limit_s=5.0))
    with pytest.raises(ConfigError, match="tcp://w with 4"):
        check_worker(worker_of(tmp_path, threads=4), Settings())
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match=r"with a GPU .*tcp://w"):
        check_worker(worker_of(tmp_path), Settings(device="cuda"))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    check_worker(worker_of(tmp_path), Settings(device="cuda"))
    daemon = SimpleNamespace(daemon=True)
    monkeypatch.setattr("multiprocessing.current_process", lambda: daemon)
    check_worker(worker_of(tmp_path), Settings())
    with pytest.raises(ConfigError, match=r"tcp://w.*no-nanny"):
        check_worker(worker_of(tmp_path), Settings(planner_limit_s=5.0))


def test_a_worker_runs_units_on_the_device_and_under_the_limit_of_the_run(
    dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite = suite_on(dataset_path, tmp_path / "log", scenarios=("std",), seeds=(0,))
    list(run_suite(suite, tmp_path / "run"))
    unit = units(open_run(tmp_path / "run").conditions)[0]
    monkeypatch.setattr("distributed.get_worker", lambda: worker_of(tmp_path))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    given: list[Settings] = []
    monkeypatch.setattr(cluster, "run_unit", lambda *words: given.append(words[-1]))
    asked = [Settings(), Settings(device="cuda", planner_limit_s=3.0)]
    for settings in asked:
        assert run_on_worker(
            tmp_path, unit, Settings().origins().of(unit), settings
        ) == (unit, {})
    assert given == asked


def test_the_rows_of_a_unit_come_last_since_they_say_that_it_is_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[str] = []

    @contextmanager
    def replacing(path: Path) -> Iterator[Path]:
        yield tmp_path / "partial"
        written.append(path.relative_to(tmp_path).parts[0])

    monkeypatch.setattr(cluster, "replacing", replacing)
    monkeypatch.setattr(
        cluster, "clear_unit", lambda folder, unit: written.append("cleared")
    )
    files = {"units/a.parquet": b"", "playback/a.npz": b"", "steps/a.parquet": b""}
    cluster.store_files(tmp_path, None, files)  # type: ignore[arg-type]
    assert written == ["cleared", "playback", "steps", "units"]
