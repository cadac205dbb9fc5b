"""Progress: the rate and the time left are closed forms of a clock that the tests set."""

import sys
import threading
from collections.abc import Iterator
from itertools import pairwise

import pytest

from benchnav.core import progress
from benchnav.core.command import tell
from benchnav.core.progress import Progress, Watch, in_words, show_progress


class Clock:
    """Seconds that pass when a test says so."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        monkeypatch.setattr(progress.time, "monotonic", lambda: self.now_s)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def test_rate_and_time_left_are_of_what_this_command_did(clock: Clock) -> None:
    watch = Watch("units")
    clock.now_s += 30  # checks before the first step are no work
    watch.update((4, 10))
    assert watch.line() == "units: 4/10"
    clock.now_s += 20
    assert watch.line() == "units: 4/10, 20 s so far"
    watch.update((6, 10))
    assert watch.line() == "units: 6/10, 6.0 units/min, about 40 s left"
    clock.now_s += 20  # while nothing is done the rate falls and the estimate grows
    assert watch.line() == "units: 6/10, 3.0 units/min, about 80 s left"
    watch.update((10, 10))
    assert watch.line() == "units: 10/10, 9.0 units/min, took 40 s"


def test_parts_of_unlike_size_count_by_their_size(clock: Clock) -> None:
    watch = Watch("units")
    watch.update(Progress(1, 4, "running a", size_done=50, size=400, sized="episodes"))
    assert watch.line() == "units: 1/4, running a"
    clock.now_s += 100
    watch.update(Progress(2, 4, "running b", size_done=250, size=400, sized="episodes"))
    assert watch.line() == "units: 2/4, 2.0 episodes/s, about 75 s left, running b"
    assert tuple(watch.step) == (2, 4)


def test_a_log_has_a_line_a_tenth_and_at_least_one_a_minute_but_never_thousands(
    clock: Clock,
) -> None:
    watch = Watch("units")
    watch.update((0, 1000))
    told = [0.0] if watch.is_due() else []
    began_s, month_s = clock.now_s, 30 * 86400
    while (elapsed_s := clock.now_s - began_s) < month_s:
        clock.now_s += 1 if elapsed_s < 1200 else 100
        watch.update((int(1000 * elapsed_s / month_s), 1000))
        if watch.is_due():
            told.append(clock.now_s - began_s)
    assert told[0] == 0
    assert all(60 * place in told for place in range(10))
    assert max(b - a for a, b in pairwise(told)) <= 700
    assert len(told) < 5000
    quick = Watch("units")
    lines = 0
    for done in range(100_001):
        quick.update((done, 100_000))
        lines += quick.is_due()
    assert lines == 11


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0, "0 s"),
        (89, "89 s"),
        (90, "2 min"),
        (3600, "60 min"),
        (5400, "1.5 h"),
        (172_800, "2.0 days"),
    ],
)
def test_a_duration_is_said_as_people_say_it(seconds: float, words: str) -> None:
    assert in_words(seconds) == words


def test_plain_lines_tell_of_work_that_makes_no_step(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "_POLL_S", 0.001)
    monkeypatch.setattr(progress, "_MIN_SILENCE_S", 0.0)
    said = progress.tell
    lines: list[str] = []
    monkeypatch.setattr(progress, "tell", lambda line: (lines.append(line), said(line)))

    ended = threading.Event()

    def steps() -> Iterator[Progress]:
        yield Progress(0, 1, "running one")
        for _ in range(1000):
            if len(lines) < 3:
                ended.wait(0.01)
        yield Progress(1, 1, "finished one")

    show_progress(steps(), "units")
    err = capsys.readouterr().err.splitlines()
    assert err[0] == err[1] == "units: 0/1, running one"
    assert err[-1] == "units: 1/1, finished one"


@pytest.mark.parametrize("columns", [60, 200])
def test_a_terminal_shows_a_bar_with_the_same_words(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], columns: int
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", str(columns))
    show_progress(
        iter([Progress(0, 3), Progress(3, 3, "finished hard mppi cvar")]), "units"
    )
    err = capsys.readouterr().err
    assert "3/3" in err
    assert ("finished hard mppi cvar" in err) == (columns == 200)
    assert "finished" in err


class Unread:
    """A standard error whose reader has gone."""

    def write(self, text: str) -> int:
        raise BrokenPipeError

    def flush(self) -> None:
        raise BrokenPipeError


def test_work_goes_on_where_no_one_reads_how_far_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "stderr", Unread())
    reached = []

    def steps() -> Iterator[tuple[int, int]]:
        for done in range(11):
            reached.append(done)
            yield done, 10

    show_progress(steps(), "units")
    tell("a line more")
    assert reached == list(range(11))
