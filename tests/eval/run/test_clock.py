from types import SimpleNamespace

import pytest
import torch

from benchnav.eval.run import clock
from benchnav.eval.run.clock import Clock


def test_calls_are_timed_one_by_one_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = iter([0.0, 2.0, 10.0, 11.5])
    monkeypatch.setattr(clock, "time", SimpleNamespace(perf_counter=lambda: next(ticks)))
    timer = Clock(torch.device("cpu"))
    for _ in range(2):
        with timer.timed():
            pass
    assert timer.seconds() == [2.0, 1.5]


def test_a_gpu_is_waited_for_once_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Events as those of a GPU, whose times are known only after it was waited for."""
    told: list[str] = []

    class Event:
        def __init__(self, enable_timing: bool) -> None:
            assert enable_timing

        def record(self) -> None:
            self.place = len(told)
            told.append("record")

        def elapsed_time(self, end: "Event") -> float:
            assert "synchronize" in told
            return 1000.0 * (end.place - self.place)

    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: told.append("synchronize"))
    timer = Clock(torch.device("cuda"))
    with timer.timed():
        told.append("work")
    with timer.timed():
        pass
    assert told == ["record", "work", "record", "record", "record"]
    assert timer.seconds() == [2.0, 1.0]


def test_what_raises_is_not_counted() -> None:
    timer = Clock(torch.device("cpu"))
    with pytest.raises(RuntimeError, match="no"), timer.timed():
        raise RuntimeError("no")
    assert timer.seconds() == []
