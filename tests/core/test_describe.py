"""Describing an object and creating it again gives an equal object, or says that it
cannot.
"""

import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchnav.core.describe import describe
from benchnav.core.errors import ConfigError
from benchnav.core.registry import Part, complete, is_object, make
from benchnav.planning import (
    MPPI,
    AStarDWA,
    Bicycle,
    Classes,
    Copula,
    MPPIConfig,
    Near,
    Probe,
    Straight,
    TravelTime,
    Unicycle,
)
from benchnav.planning.risk import Chance, CVaR, Mean, TimeCVaR

LEVEL = st.floats(0, 0.99)


@given(level=LEVEL, floor=st.floats(0.01, 1))
def test_a_risk_measure_is_the_part_that_suites_name(
    level: float, floor: float
) -> None:
    assert make("risk", describe("risk", CVaR(level))) == CVaR(level)
    assert make("risk", describe("risk", TimeCVaR(level, floor))) == TimeCVaR(
        level, floor
    )
    assert describe("risk", TimeCVaR(level=level, floor=floor)).options == {
        "level": level,
        "floor": floor,
    }
    assert complete("risk", describe("risk", CVaR(level))).options == {"level": level}


@pytest.mark.parametrize(
    ("kind", "instance", "source", "label"),
    [
        ("risk", Mean(), "mean", "mean"),
        ("risk", CVaR(), "cvar", "cvar"),
        ("risk", CVaR(0.95), "cvar", "cvar:0.95"),
        ("risk", Chance(bound=0.2), "chance", "chance:0.2"),
        ("planner", AStarDWA(), "astar_dwa", "astar_dwa"),
        ("planner", Straight(), "straight", "straight"),
        ("planner", MPPI(MPPIConfig(samples=200)), "mppi", "mppi samples=200"),
        ("robot", Unicycle(speed_mps=(0, 2)), "unicycle", "unicycle speed_mps=[0, 2]"),
        ("robot", Bicycle(), "bicycle", "bicycle"),
        (
            "objective",
            TravelTime(robot=Unicycle(), goal_radius_m=2.0),
            "travel_time",
            "travel_time",
        ),
        ("sensor", Near(8), "near", "near:8"),
        ("ground", Probe(2), "probe", "probe:2"),
        ("belief", Copula(), "copula", "copula"),
        ("belief", Classes(), "classes", "classes"),
    ],
)
def test_a_shipped_object_is_described_by_its_name(
    kind: str, instance: Any, source: str, label: str
) -> None:
    part = describe(kind, instance)
    assert (part.part, part.label) == (source, label)
    # The label of an option is what a suite would write, and means the same.
    if ":" in label:
        assert (
            complete(kind, part).options
            == complete(kind, describe(kind, label)).options
        )


def test_an_object_that_was_changed_is_not_described_by_its_former_arguments() -> None:
    changed = MPPI(MPPIConfig(samples=200))
    assert describe("planner", changed).options == {"samples": 200}
    changed.config = replace(changed.config, samples=100)
    part = describe("planner", changed)
    assert is_object("planner", part.part)
    assert make("planner", part) is changed


def test_what_nothing_describes_is_known_in_this_process_only() -> None:
    def half(distribution: Any) -> Any:
        return distribution.mean() / 2

    class Mine(AStarDWA):
        pass

    first, second = Mine(), Mine()
    parts = [
        describe("planner", first),
        describe("planner", second),
        describe("planner", first),
    ]
    assert [make("planner", part) for part in parts] == [first, second, first]
    assert parts[0] == parts[2] != parts[1]
    for risk in (half, lambda distribution: distribution.mean()):
        part = describe("risk", risk)
        assert is_object("risk", part.part)
        assert make("risk", part).func is risk  # called with a distribution
    assert not is_object("risk", "cvar")


def test_a_class_of_a_file_is_described_by_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    Path("halves.py").write_text(
        "from benchnav.planning import AStarDWA\n"
        "def half(distribution, by=2.0):\n    return distribution.mean() / by\n"
        "class Mine(AStarDWA):\n"
        "    def __init__(self, extra=1):\n        super().__init__()\n        self.extra = extra\n"
    )
    module = import_module("halves")
    assert describe("risk", module.half) == Part(part="halves.py:half", label="half")
    part = describe("planner", module.Mine(extra=3))
    assert part == Part(part="halves.py:Mine", label="Mine:3", options={"extra": 3})
    assert make("planner", part).extra == 3
    del sys.modules["halves"]


def test_arguments_that_are_no_plain_data_are_not_described() -> None:
    class Holding(AStarDWA):
        def __init__(self, inner: object) -> None:
            super().__init__()

    assert is_object("planner", describe("planner", Holding(object())).part)
    with pytest.raises(TypeError, match="takes no arguments"):
        Straight(5)  # type: ignore[call-arg]


def test_a_class_is_described_with_its_defaults() -> None:
    assert describe("objective", TravelTime) == Part(
        part="travel_time", label="travel_time"
    )

    class Mine(AStarDWA):
        pass

    assert isinstance(make("planner", describe("planner", Mine)), Mine)


def test_an_object_of_another_kind_is_rejected() -> None:
    with pytest.raises(
        ConfigError, match=r"to be an instance of benchnav\.planning\.Planner, got CVaR"
    ):
        describe("planner", CVaR())
