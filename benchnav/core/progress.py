"""Progress of work that takes long: what is done, the rate, and the time left, in a
terminal and in plain logs.

The rate is that of this command: what was there before it does not count, and its
start-up does. So early estimates are too slow rather than too quick; a line says
"about".
"""

import signal
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from benchnav.core.command import tell

# Before that an estimate is of the start-up alone.
_ESTIMATED_FROM_S = 5.0
# Plain lines come at each tenth, and at least this often: more rarely the longer the
# work has taken.
_QUIET_S, _MOST_QUIET_S = 60.0, 600.0
_LOOK_S = 1.0


@dataclass(frozen=True)
class Progress:
    """How far some work is; unpacks as `done, total`.

    Args:
        done: parts that are done, those that were there before included.
        total: parts in all.
        doing: what is being done or was done last, in words.
        size_done: sizes of the parts that are done, summed, where parts differ in size.
        size: sizes of all parts; 0 where all parts count alike.
        sized: what sizes count, such as "episodes".
    """

    done: int
    total: int
    doing: str = ""
    size_done: int = 0
    size: int = 0
    sized: str = ""

    def __iter__(self) -> Iterator[int]:
        """Done and total."""
        return iter((self.done, self.total))

    @property
    def amount(self) -> tuple[int, int]:
        """What is done and what there is in all, as the rate counts it."""
        return (self.size_done, self.size) if self.size else (self.done, self.total)


class Watch:
    """Puts the progress of one piece of work into words.

    Args:
        what: what is counted, for example "units".
    """

    def __init__(self, what: str) -> None:
        """Starts the clock."""
        self.what = what
        self.step = Progress(0, 0)
        self._first: int | None = None
        self._began_s = self._told_s = time.monotonic()
        self._tenth = -1

    def update(self, step: Progress | tuple[int, int]) -> None:
        """Takes the next step; what the first one says to be done is not of this
        command.
        """
        self.step = step if isinstance(step, Progress) else Progress(*step)
        if self._first is None:
            self._first = self.step.amount[0]
            self._began_s = time.monotonic()

    def is_due(self) -> bool:
        """Whether a log should have a line now; True once for each time it is due."""
        now_s = time.monotonic()
        if not self.step.total:
            return False
        tenth = self.step.done * 10 // self.step.total
        quiet_s = min(max(_QUIET_S, (now_s - self._began_s) / 10), _MOST_QUIET_S)
        if tenth <= self._tenth and now_s - self._told_s < quiet_s:
            return False
        self._tenth, self._told_s = max(tenth, self._tenth), now_s
        return True

    def line(self) -> str:
        """A line of a log."""
        return ", ".join(
            [f"{self.what}: {self.step.done}/{self.step.total}", *self.words()]
        )

    def words(self) -> list[str]:
        """The rate, the time left or taken, and what is being done; what is not known
        is left out.
        """
        return [*self._pace(), *([self.step.doing] if self.step.doing else [])]

    def _pace(self) -> list[str]:
        elapsed_s = time.monotonic() - self._began_s
        done, total = self.step.amount
        mine = done - (self._first or 0)
        if elapsed_s < _ESTIMATED_FROM_S:
            return []
        if not mine:
            return [f"{in_words(elapsed_s)} so far"]
        rate = f"{_rate(mine / elapsed_s, self.step.sized or self.what)}"
        if done == total:
            return [rate, f"took {in_words(elapsed_s)}"]
        return [rate, f"about {in_words((total - done) * elapsed_s / mine)} left"]


def _rate(per_s: float, unit: str) -> str:
    """A rate with two digits that count, in the largest unit of time in which it is 1
    or more.
    """
    for seconds, name in ((1, "s"), (60, "min")):
        if per_s * seconds >= 1:
            return f"{_two_digits(per_s * seconds)} {unit}/{name}"
    return f"{_two_digits(per_s * 3600)} {unit}/h"


def _two_digits(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.1f}"


def in_words(seconds: float) -> str:
    """A duration, in the unit in which people count it."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    if seconds < 48 * 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 86400:.1f} days"


def show_progress(steps: Iterable[Progress | tuple[int, int]], what: str) -> None:
    """Runs work to its end while showing how far it is: a bar in a terminal, plain
    lines elsewhere.

    Args:
        steps: the work, yielding its progress as it goes, first what is done already.
        what: what is counted, for example "maps".
    """
    from rich.console import Console

    watch, console = Watch(what), Console(stderr=True)
    shown = _bar(watch, console) if console.is_terminal else _lines(watch)
    with shown as show:
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
        task = bar.add_task(watch.what, total=None)
        yield lambda: bar.update(
            task, completed=watch.step.done, total=watch.step.total
        )


@contextmanager
def _lines(watch: Watch) -> Iterator[Any]:
    lock, ended = threading.Lock(), threading.Event()

    def show() -> None:
        with lock:
            if watch.is_due():
                tell(watch.line())

    def look() -> None:
        # An interruption is for the main thread, which would not wake if this one took
        # it.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
        while not ended.wait(_LOOK_S):
            show()

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield show
    finally:
        ended.set()
        thread.join()
