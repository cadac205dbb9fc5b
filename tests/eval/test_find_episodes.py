import json
from pathlib import Path
from typing import Any

import pytest

from benchnav.core.errors import ConfigError
from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Extent
from benchnav.eval.find_episodes import find_episodes
from benchnav.eval.folder.run_folder import FORMAT, FORMAT_VERSION, write_run

DRAWS = ((4, 0, 60), (4, 1, 60), (9, 0, 2))


def made(path: Path, **draws: tuple[tuple[int, int, int], ...]) -> Path:
    """What a run is about, without its rows; by planner the draws of noise that are not
    those of all.
    """
    suite = Suite(
        model="oracle",
        planners=("straight", "astar_dwa", "mppi"),
        risks=("mean", "cvar:0.5", "cvar"),
    )
    entries = {}
    for condition in conditions_of(suite, lambda data: ["std", "hs"]):
        extent = Extent(draws=draws.get(condition.labels["planner"], DRAWS))
        entries[condition.id] = {
            "value": condition.value,
            "labels": condition.labels,
            "draws": extent.draws,
        }
    maps = {f"test/{scenario}": ["m"] * 60 for scenario in ("std", "hs")}
    about = {
        "format": FORMAT, "format_version": FORMAT_VERSION, "suite": {}, "conditions": entries,
        "datasets": {suite.data: {"id": "d", "maps": maps}}, "machine": {}, "device": "cpu",
        "planner_limit_s": 0.0,
    }  # fmt: skip
    path.mkdir()
    write_run(path, json.loads(json.dumps(about)))
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("find") / "run")


def found(
    folder: Path,
    seed: int | None = None,
    realisation: int = 0,
    map_index: int = 0,
    **labels: Any,
) -> list[Any]:
    episodes = find_episodes(
        folder, {n: list(v) for n, v in labels.items()}, seed, realisation, map_index
    )
    for unit, member in episodes:
        assert unit.maps[member] == map_index
        assert unit.realisation == realisation
    return [
        (
            u.condition.labels["planner"],
            u.condition.labels["risk"],
            u.condition.scenario,
            u.seed,
        )
        for u, _ in episodes
    ]


def test_the_first_condition_that_fits_is_taken(folder: Path) -> None:
    assert found(folder) == [("straight", "–", "std", 4)]
    assert found(folder, planner=["mppi"]) == [("mppi", "mean", "std", 4)]
    assert found(folder, risk=["cvar"]) == [("astar_dwa", "cvar", "std", 4)]
    assert found(folder, scenario=["hs"], planner=["mppi"], risk=["cvar:0.5"]) == [
        ("mppi", "cvar:0.5", "hs", 4)
    ]


def test_seed_realisation_and_map_are_those_asked_for(folder: Path) -> None:
    assert found(folder, seed=9, map_index=1)[0][3] == 9
    assert found(folder, realisation=1, map_index=59) == [("straight", "–", "std", 4)]


def test_several_labels_give_several_conditions_in_their_order(folder: Path) -> None:
    assert found(folder, planner=["mppi"], risk=["cvar", "mean"]) == [
        ("mppi", "cvar", "std", 4), ("mppi", "mean", "std", 4)
    ]  # fmt: skip
    assert len(found(folder, planner=["mppi", "astar_dwa"], risk=["cvar", "mean"])) == 4


def test_conditions_that_begin_with_other_seeds_are_shown_under_one(
    tmp_path: Path,
) -> None:
    """Of a run that was extended for one planner: all the others are looked for under
    the first's seed.
    """
    folder = made(
        tmp_path / "run", straight=((7, 0, 2), (9, 0, 2)), mppi=((9, 0, 2), (4, 0, 2))
    )
    assert found(folder, planner=["mppi", "astar_dwa"], risk=["cvar"]) == [
        ("mppi", "cvar", "std", 9), ("astar_dwa", "cvar", "std", 9)
    ]  # fmt: skip
    assert found(folder, planner=["astar_dwa", "mppi"], risk=["cvar"]) == [
        ("astar_dwa", "cvar", "std", 4), ("mppi", "cvar", "std", 4)
    ]  # fmt: skip
    with pytest.raises(
        ConfigError, match=r"got planner 'mppi', realisation 0, map 0, seed 7,"
    ):
        found(folder, planner=["straight", "mppi"])
    assert [
        seed for *_, seed in found(folder, seed=9, planner=["straight", "mppi"])
    ] == [9, 9]


def test_a_blind_planner_stands_once_under_any_risk_setting(folder: Path) -> None:
    assert found(folder, planner=["straight", "mppi"], risk=["mean", "cvar"]) == [
        ("straight", "–", "std", 4), ("mppi", "mean", "std", 4), ("mppi", "cvar", "std", 4)
    ]  # fmt: skip


def test_a_label_that_no_condition_has_is_refused_also_for_a_blind_planner(
    folder: Path,
) -> None:
    with pytest.raises(ConfigError, match=r"risk 'cvarr'.* Did you mean 'cvar'"):
        found(folder, planner=["straight"], risk=["cvarr"])


def test_other_maps_do_not_stand_together(folder: Path) -> None:
    with pytest.raises(ConfigError, match="conditions on the same map"):
        found(folder, scenario=["std", "hs"])


@pytest.mark.parametrize(
    "asked",
    [{"planner": ["no"]}, {"planner": ["mppi", "no"]}, {"map_index": 60}, {"seed": 7}, {"seed": 9, "map_index": 2},
     {"realisation": 2}, {"seed": 9, "realisation": 1}],
)  # fmt: skip
def test_what_is_not_there_is_refused_with_what_is(
    asked: dict[str, Any], folder: Path
) -> None:
    with pytest.raises(
        ConfigError,
        match=r"Expected an episode of the run, got .* The run has .*planner straight, .*; map 0 to \d+\.",
    ):
        found(folder, **asked)
