"""Progress of long work in a terminal and in plain logs: count, rate, remaining time.

The rate excludes results of earlier commands, and includes the start-up of this command.
Early estimates of the remaining time are therefore too long, and are shown with "about".
"""

import signal
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from benchnav.core.command import tell

# Time before the first estimate; an earlier rate would measure only the start-up.
_ESTIMATED_FROM_S = 5.0
# A log has a line at each tenth of the work, and after a time without a line. This time
# is a tenth of the elapsed time, within these limits.
_MIN_SILENCE_S = 60.0
_MAX_SILENCE_S = 600.0
_POLL_S = 1.0


@dataclass(frozen=True)
class Progress:
    """Progress of some work; unpacks as `done, total`.

    Args:
        done: number of finished items, including those of earlier commands.
        total: number of all items.
        doing: description of the current or last item.
        size_done: sum of the sizes of finished items, if items differ in size.
        size: sum of the sizes of all items; 0 if all items have the same size.
        sized: plural noun for the unit of sizes, such as "episodes".
    """

    done: int
    total: int
    doing: str = ""
    size_done: int = 0
    size: int = 0
    sized: str = ""

    def __iter__(self) -> Iterator[int]:
        """Iterate over `done` and `total`."""
        return iter((self.done, self.total))

    @property
    def amount(self) -> tuple[int, int]:
        """Finished amount and total amount, in the unit of the rate."""
        return (self.size_done, self.size) if self.size else (self.done, self.total)


class Watch:
    """Clock and text for the progress of some work.

    Args:
        noun: plural noun for the counted items, for example "units".
    """

    def __init__(self, noun: str) -> None:
        """Start the clock."""
        self.noun = noun
        self.step = Progress(0, 0)
        self._initial_amount: int | None = None
        self._start_s = time.monotonic()
        self._last_line_s = self._start_s
        self._tenth = -1

    def update(self, step: Progress | tuple[int, int]) -> None:
        """Record progress; work that is done at the first call counts as earlier work."""
        self.step = step if isinstance(step, Progress) else Progress(*step)
        if self._initial_amount is None:
            self._initial_amount = self.step.amount[0]
            self._start_s = time.monotonic()

    def is_due(self) -> bool:
        """Return whether a log line is due, and count that line as written."""
        now_s = time.monotonic()
        if not self.step.total:
            return False
        tenth = self.step.done * 10 // self.step.total
        elapsed_s = now_s - self._start_s
        silence_s = min(max(_MIN_SILENCE_S, elapsed_s / 10), _MAX_SILENCE_S)
        if tenth <= self._tenth and now_s - self._last_line_s < silence_s:
            return False
        self._tenth = max(tenth, self._tenth)
        self._last_line_s = now_s
        return True

    def line(self) -> str:
        """Return a log line with the count, rate, time and activity."""
        count = f"{self.noun}: {self.step.done}/{self.step.total}"
        return ", ".join([count, *self.words()])

    def words(self) -> list[str]:
        """Return texts for the rate, the remaining or elapsed time, and the activity.

        Texts for unknown values are omitted.
        """
        activity = [self.step.doing] if self.step.doing else []
        return [*self._pace(), *activity]

    def _pace(self) -> list[str]:
        elapsed_s = time.monotonic() - self._start_s
        done, total = self.step.amount
        new_amount = done - (self._initial_amount or 0)
        if elapsed_s < _ESTIMATED_FROM_S:
            return []
        if not new_amount:
            return [f"{in_words(elapsed_s)} so far"]
        rate = _rate(new_amount / elapsed_s, self.step.sized or self.noun)
        if done == total:
            return [rate, f"took {in_words(elapsed_s)}"]
        remaining_s = (total - done) * elapsed_s / new_amount
        return [rate, f"about {in_words(remaining_s)} left"]


def _rate(per_s: float, unit: str) -> str:
    """Return a rate as text, per s, min or h: the first unit with a rate of at least 1."""
    for seconds, name in ((1, "s"), (60, "min")):
        if per_s * seconds >= 1:
            return f"{_two_digits(per_s * seconds)} {unit}/{name}"
    return f"{_two_digits(per_s * 3600)} {unit}/h"


def _two_digits(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.1f}"


def in_words(seconds: float) -> str:
    """Return a duration as text, in s, min, h or days depending on its length."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    if seconds < 48 * 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 86400:.1f} days"


def show_progress(steps: Iterable[Progress | tuple[int, int]], noun: str) -> None:
    """Run work and show its progress: a bar in a terminal, lines in a log.

    Args:
        steps: iterator that does the work and yields its progress. The first value
            contains only the results of earlier commands.
        noun: plural noun for the counted items, for example "maps".
    """
    from rich.console import Console

    watch = Watch(noun)
    console = Console(stderr=True)
    display = _bar(watch, console) if console.is_terminal else _lines(watch)
    with display as show:
        for step in steps:
            watch.update(step)
            show()


@contextmanager
def _bar(watch: Watch, console: Any) -> Iterator[Any]:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        ProgressColumn,
        TextColumn,
        TimeElapsedColumn,
    )
    from rich.progress import Progress as Bar
    from rich.table import Column
    from rich.text import Text

    class Words(ProgressColumn):
        def render(self, task: Any) -> Text:
            return Text(", ".join(watch.words()), no_wrap=True, overflow="ellipsis")

    words = Words(Column(no_wrap=True, overflow="ellipsis", ratio=1))
    columns = [
        TextColumn("{task.description}"),
        BarColumn(20),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    ]
    with Bar(*columns, words, console=console, expand=True) as bar:
        task = bar.add_task(watch.noun, total=None)
        yield lambda: bar.update(
            task, completed=watch.step.done, total=watch.step.total
        )


@contextmanager
def _lines(watch: Watch) -> Iterator[Any]:
    lock = threading.Lock()
    ended = threading.Event()

    def show() -> None:
        with lock:
            if watch.is_due():
                tell(watch.line())

    def poll() -> None:
        # Block interruptions here: if this thread received one, the main thread would
        # continue to wait.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
        while not ended.wait(_POLL_S):
            show()

    thread = threading.Thread(target=poll, daemon=True)
    thread.start()
    try:
        yield show
    finally:
        ended.set()
        thread.join()
