from collections import Counter
from dataclasses import asdict, replace
from itertools import pairwise, product

import pytest

from benchnav.core.errors import ConfigError
from benchnav.core.store import Shard, read_shard
from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.suite import RECORDS, Suite
from benchnav.eval.experiment.unit import Extent, Unit, units


def some_units(
    risks: tuple[str, ...] = ("mean", "var"), maps: int = 120, **draws: object
) -> list[Unit]:
    suite = Suite(model="oracle", planners=("astar_dwa",), risks=risks)
    extent = Extent.product(
        **{"seeds": (0, 1), "realisations": 2, "maps": maps} | draws
    )  # type: ignore[arg-type]
    return units(
        {
            condition.id: (condition, extent)
            for condition in conditions_of(suite, lambda data: ["std", "hg"])
        }
    )


def test_every_unit_is_in_one_shard() -> None:
    every = some_units()
    assert len(every) == 4 * 2 * 2 * 3
    for of in (1, 2, 3, 7):
        for unit in every:
            having = [
                index
                for index in range(1, of + 1)
                if unit.shard(of) == Shard(index=index, of=of)
            ]
            assert having == [unit.shard(of).index]


def test_a_unit_stays_in_its_shard_whatever_else_is_run() -> None:
    before = {(unit.condition.id, unit.name): unit.shard(5) for unit in some_units()}
    # A last block that is not full, another setting, another order, recordings.
    more = [
        replace(unit, record="all")
        for unit in reversed(some_units(risks=("cvar", "var", "mean"), maps=110))
    ]
    after = {(unit.condition.id, unit.name): unit.shard(5) for unit in more}
    assert {path: after[path] for path in before} == before
    assert len(after) > len(before)


@pytest.mark.parametrize(
    "draws",
    [
        {"seeds": (0,), "realisations": 1, "maps": 200},
        {"seeds": (0,), "realisations": 4, "maps": 50},
        {"seeds": (3, 4, 5, 6), "realisations": 1, "maps": 50},
    ],
)
def test_blocks_realisations_and_seeds_of_a_condition_go_round(
    draws: dict[str, object],
) -> None:
    every = some_units(risks=("mean",), **draws)
    counts = Counter((unit.condition.id, unit.shard(4).index) for unit in every)
    assert len(every) == 8
    assert set(counts.values()) == {1}


def test_conditions_do_not_all_begin_in_one_shard() -> None:
    risks = tuple(f"cvar:{0.01 * level:g}" for level in range(1, 50))
    counts = Counter(
        unit.shard(3).index
        for unit in some_units(risks, 50, seeds=(0,), realisations=1)
    )
    # Of 98 units a third is 33; four standard deviations are 19.
    assert all(14 < counts[index] < 52 for index in (1, 2, 3))


def test_a_shard_is_read_as_it_is_written() -> None:
    assert read_shard("") is None
    assert read_shard("2/5") == Shard(index=2, of=5)
    assert str(Shard(index=2, of=5)) == "2/5"
    assert Shard(**asdict(Shard(index=2, of=5))) == Shard(index=2, of=5)
    for text in ("2", "0/5", "6/5", "1/0", "-1/5", "a/b", "2/5/7", "1.5/2"):
        with pytest.raises(ConfigError, match="shard"):
            read_shard(text)


def test_units_that_predict_nothing_come_last_of_their_block() -> None:
    suite = Suite(
        model="oracle", planners=("straight", "astar_dwa"), risks=("mean", "var")
    )
    extent = Extent.product(seeds=(0, 1), realisations=1, maps=100)
    made = units(
        {
            condition.id: (condition, extent)
            for condition in conditions_of(suite, lambda data: ["std", "hg"])
        }
    )
    by_block: dict[tuple[str, int], list[bool]] = {}
    for unit in made:
        by_block.setdefault((unit.condition.scenario, unit.block), []).append(
            unit.condition.blind
        )
    # Two risk settings and one blind condition, each under two seeds.
    assert by_block == {
        (s, b): [False] * 4 + [True] * 2 for s in ("std", "hg") for b in (0, 1)
    }
    # What is of one block stands together.
    assert [
        *dict.fromkeys((unit.condition.scenario, unit.block) for unit in made)
    ] == list(by_block)


ENDED = [True, False, True, False]  # whether each episode succeeded


@pytest.mark.parametrize(
    ("record", "leads", "watched", "recorded"),
    [
        ("none", True, [], []),
        ("steps", True, [], []),
        ("first", True, [0], [0]),
        ("first", False, [], []),
        ("failures", True, [0, 1, 2, 3], [0, 1, 3]),
        ("failures", False, [0, 1, 2, 3], [1, 3]),
        ("all", False, [0, 1, 2, 3], [0, 1, 2, 3]),
    ],
)
def test_what_is_recorded(
    record: str, leads: bool, watched: list[int], recorded: list[int]
) -> None:
    unit = replace(
        some_units()[0], maps=(0, 1, 2, 3), record=record, is_first_unit=leads
    )  # type: ignore[arg-type]
    assert list(unit.possibly_recorded()) == watched
    assert unit.recorded(ENDED) == recorded


def test_each_word_records_all_that_the_one_before_it_does() -> None:
    """Whatever way episodes end."""
    unit = replace(some_units()[0], maps=(0, 1))
    for less, more in pairwise(RECORDS):
        for leads, *ended in product((True, False), repeat=3):
            of = [
                replace(unit, record=record, is_first_unit=leads).recorded(ended)
                for record in (less, more)
            ]
            assert set(of[0]) <= set(of[1])


def test_one_unit_leads_each_condition() -> None:
    leading = [unit for unit in some_units() if unit.is_first_unit]
    assert len({unit.condition.id for unit in leading}) == len(leading) == 4
    assert {(unit.seed, unit.realisation, unit.block) for unit in leading} == {
        (0, 0, 0)
    }


def test_other_words_for_what_is_recorded_are_refused() -> None:
    with pytest.raises(
        ConfigError,
        match=r"Expected `record` .*none.*steps.*first.*failures.*all.*got 'sometimes'",
    ):
        Suite(record="sometimes")  # type: ignore[arg-type]


def test_an_extended_run_has_what_either_command_asked_for() -> None:
    wide, deep = Extent.product((0, 1), 1, 5), Extent.product((0,), 2, 9)
    assert wide.union(deep).draws == ((0, 0, 9), (1, 0, 5), (0, 1, 9))
    assert deep.union(wide).draws == ((0, 0, 9), (0, 1, 9), (1, 0, 5))
