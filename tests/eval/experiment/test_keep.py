from itertools import product

import pytest

from benchnav.core.errors import ConfigError
from benchnav.eval.experiment.keep import Keep

ENDED = [True, False, True, False]  # whether each episode succeeded


@pytest.mark.parametrize(
    ("record", "watched", "recorded"),
    [
        ("none", [], []),
        ("first", [0], [0]),
        ("failures", [0, 1, 2, 3], [1, 3]),
        ("all", [0, 1, 2, 3], [0, 1, 2, 3]),
    ],
)
def test_what_is_recorded(record: str, watched: list[int], recorded: list[int]) -> None:
    keep = Keep(record=record)  # type: ignore[arg-type]
    assert list(keep.watched(4)) == watched
    assert keep.recorded(ENDED) == recorded


@pytest.mark.parametrize(
    ("record", "steps", "stored"),
    [
        ("all", "none", []),
        ("none", "all", [0, 1, 2, 3]),
        ("failures", "recorded", [1, 3]),
        ("none", "recorded", []),
        ("first", "recorded", [0]),
    ],
)
def test_of_what_the_steps_are_stored(record: str, steps: str, stored: list[int]) -> None:
    assert Keep(record=record, steps=steps).with_steps(ENDED) == stored  # type: ignore[arg-type]


def test_a_unit_that_kept_more_has_all_that_less_asks_for() -> None:
    """Whatever way episodes end: what covers another has its recordings and steps."""
    every = [
        Keep(record=record, steps=steps)  # type: ignore[arg-type]
        for record, steps in product(("none", "failures", "first", "all"), ("none", "recorded", "all"))
    ]
    for one, other in product(every, every):
        has = all(
            set(kept(one)) >= set(kept(other))
            for ended in product((True, False), repeat=2)
            for kept in (
                lambda keep, ended=ended: keep.recorded(ended),
                lambda keep, ended=ended: keep.with_steps(ended),
            )
        )
        assert one.covers(other) == has, (one, other)
        joined = one.joined(other)
        assert joined.covers(one)
        assert joined.covers(other)
        if one.covers(other):
            assert joined == one or (joined.covers(one) and one.covers(joined))


def test_failures_asked_for_after_the_first_add_the_failures_alone() -> None:
    for one, other in (("failures", "first"), ("first", "failures")):
        joined = Keep(record=one).joined(Keep(record=other))  # type: ignore[arg-type]
        assert joined.recorded(ENDED) == [0, 1, 3]
        assert list(joined.watched(4)) == [0, 1, 2, 3]
        assert Keep(**joined.to_dict()) == joined  # type: ignore[arg-type]
        assert Keep(record="all").covers(joined)
        assert not joined.covers(Keep(record="all"))


@pytest.mark.parametrize(
    ("name", "value"), [("record", "sometimes"), ("steps", "failures"), ("record", None)]
)
def test_other_words_are_refused(name: str, value: str) -> None:
    with pytest.raises(ConfigError, match=f"Expected `{name}` as none"):
        Keep(**{name: value})
