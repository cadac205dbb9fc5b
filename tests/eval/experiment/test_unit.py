from collections import Counter
from dataclasses import replace

import pytest

from benchnav.core.errors import ConfigError
from benchnav.core.store import Shard, read_shard
from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.keep import Keep
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Extent, Unit, units


def some_units(risks: tuple[str, ...] = ("mean", "var"), maps: int = 120, **draws: object) -> list[Unit]:
    suite = Suite(model="oracle", planners=("astar_dwa",), risks=risks)
    extent = Extent.product(**{"seeds": (0, 1), "realisations": 2, "maps": maps} | draws)  # type: ignore[arg-type]
    return units(
        {condition.id: (condition, extent) for condition in conditions_of(suite, lambda data: ["std", "hg"])},
        Keep(),
    )


def test_every_unit_is_in_one_share() -> None:
    every = some_units()
    assert len(every) == 4 * 2 * 2 * 3
    for of in (1, 2, 3, 7):
        for unit in every:
            having = [index for index in range(1, of + 1) if unit.share(of) == Shard(index=index, of=of)]
            assert having == [unit.share(of).index]


def test_a_unit_stays_in_its_share_whatever_else_is_run() -> None:
    before = {unit.path: unit.share(5) for unit in some_units()}
    # A last block that is not full, another setting, another order, recordings.
    more = [
        replace(unit, keep=Keep(record="all"))
        for unit in reversed(some_units(risks=("cvar", "var", "mean"), maps=110))
    ]
    after = {unit.path: unit.share(5) for unit in more}
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
def test_blocks_realisations_and_seeds_of_a_condition_go_round(draws: dict[str, object]) -> None:
    every = some_units(risks=("mean",), **draws)
    counts = Counter((unit.condition.id, unit.share(4).index) for unit in every)
    assert len(every) == 8
    assert set(counts.values()) == {1}


def test_conditions_do_not_all_begin_in_one_share() -> None:
    risks = tuple(f"cvar:{0.01 * level:g}" for level in range(1, 50))
    counts = Counter(unit.share(3).index for unit in some_units(risks, 50, seeds=(0,), realisations=1))
    # Of 98 units a third is 33; four standard deviations are 19.
    assert all(14 < counts[index] < 52 for index in (1, 2, 3))


def test_a_shard_is_read_as_it_is_written() -> None:
    assert read_shard("") is None
    assert read_shard("2/5") == Shard(index=2, of=5)
    assert str(Shard(index=2, of=5)) == "2/5"
    assert Shard(**Shard(index=2, of=5).to_dict()) == Shard(index=2, of=5)
    for text in ("2", "0/5", "6/5", "1/0", "-1/5", "a/b", "2/5/7", "1.5/2"):
        with pytest.raises(ConfigError, match="shard"):
            read_shard(text)


def test_units_that_predict_nothing_come_last_of_their_block() -> None:
    suite = Suite(model="oracle", planners=("straight", "astar_dwa"), risks=("mean", "var"))
    extent = Extent.product(seeds=(0, 1), realisations=1, maps=100)
    made = units(
        {condition.id: (condition, extent) for condition in conditions_of(suite, lambda data: ["std", "hg"])},
        Keep(),
    )
    by_block: dict[tuple[str, int], list[bool]] = {}
    for unit in made:
        by_block.setdefault((unit.condition.scenario, unit.block), []).append(unit.condition.blind)
    # Two risk settings and one blind condition, each under two seeds.
    assert by_block == {(s, b): [False] * 4 + [True] * 2 for s in ("std", "hg") for b in (0, 1)}
    # What is of one block stands together.
    assert [*dict.fromkeys((unit.condition.scenario, unit.block) for unit in made)] == list(by_block)
