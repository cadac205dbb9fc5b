"""Wall times of calls, on the CPU and on a GPU."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


class Clock:
    """Times calls one after another without waiting for a GPU: there, events of its own stream are read at the end.

    Args:
        device: where the calls compute.
    """

    def __init__(self, device: torch.device) -> None:
        """Begins with nothing."""
        self._on_gpu = device.type == "cuda"
        self._seconds: list[float] = []
        self._events: list[tuple[torch.cuda.Event, torch.cuda.Event]] = []

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Times what is done within; what raises is not counted."""
        if self._on_gpu:
            begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
            begin.record()
            yield
            end.record()
            self._events.append((begin, end))
        else:
            began = time.perf_counter()
            yield
            self._seconds.append(time.perf_counter() - began)

    def seconds(self) -> list[float]:
        """The time of each call so far."""
        if self._on_gpu:
            torch.cuda.synchronize()
            return [begin.elapsed_time(end) / 1e3 for begin, end in self._events]
        return self._seconds
