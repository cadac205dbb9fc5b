import json
from pathlib import Path
from typing import Any

import pytest

from benchnav.errors import ConfigError
from benchnav.eval.find_episodes import find_episodes
from benchnav.eval.run.folder import FORMAT, FORMAT_VERSION
from benchnav.eval.run.unit import Extent
from benchnav.eval.suite import Suite
from benchnav.eval.trial import trials_of


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a run is about, without its rows."""
    suite = Suite(
        model="oracle", planners=("straight", "astar_dwa", "mppi"), risks=("mean", "cvar:0.5", "cvar")
    )
    trials = trials_of(suite, lambda data: ["std", "hs"])
    extent = Extent(draws=((4, 0, 60), (4, 1, 60), (9, 0, 2)))
    entries = {t.id: {"value": t.value, "labels": t.labels, **extent.to_dict()} for t in trials}
    about = {"format": FORMAT, "format_version": FORMAT_VERSION, "suite": {}, "trials": entries}
    path = tmp_path_factory.mktemp("find") / "run"
    path.mkdir()
    (path / "run.json").write_text(json.dumps(about))
    return path


def found(
    folder: Path, seed: int | None = None, realisation: int = 0, instance: int = 0, **labels: Any
) -> list[Any]:
    episodes = find_episodes(folder, {n: list(v) for n, v in labels.items()}, seed, realisation, instance)
    for unit, member in episodes:
        assert unit.instances[member] == instance
        assert unit.realisation == realisation
    return [
        (u.trial.labels["planner"], u.trial.labels["risk"], u.trial.scenario, u.seed) for u, _ in episodes
    ]


def test_the_first_trial_that_fits_is_taken(folder: Path) -> None:
    assert found(folder) == [("straight", "–", "std", 4)]
    assert found(folder, planner=["mppi"]) == [("mppi", "mean", "std", 4)]
    assert found(folder, risk=["cvar"]) == [("astar_dwa", "cvar", "std", 4)]
    assert found(folder, scenario=["hs"], planner=["mppi"], risk=["cvar:0.5"]) == [
        ("mppi", "cvar:0.5", "hs", 4)
    ]


def test_seed_realisation_and_instance_are_those_asked_for(folder: Path) -> None:
    assert found(folder, seed=9, instance=1)[0][3] == 9
    assert found(folder, realisation=1, instance=59) == [("straight", "–", "std", 4)]


def test_several_labels_give_several_trials_in_their_order(folder: Path) -> None:
    assert found(folder, planner=["mppi"], risk=["cvar", "mean"]) == [
        ("mppi", "cvar", "std", 4), ("mppi", "mean", "std", 4)
    ]  # fmt: skip
    assert len(found(folder, planner=["mppi", "astar_dwa"], risk=["cvar", "mean"])) == 4


def test_a_blind_planner_stands_once_under_any_risk_setting(folder: Path) -> None:
    assert found(folder, planner=["straight", "mppi"], risk=["mean", "cvar"]) == [
        ("straight", "–", "std", 4), ("mppi", "mean", "std", 4), ("mppi", "cvar", "std", 4)
    ]  # fmt: skip


def test_other_maps_do_not_stand_together(folder: Path) -> None:
    with pytest.raises(ConfigError, match="trials on one map"):
        found(folder, scenario=["std", "hs"])


@pytest.mark.parametrize(
    "asked",
    [{"planner": ["no"]}, {"planner": ["mppi", "no"]}, {"instance": 60}, {"seed": 7}, {"seed": 9, "instance": 2},
     {"realisation": 2}, {"seed": 9, "realisation": 1}],
)  # fmt: skip
def test_what_is_not_there_is_refused_with_what_is(asked: dict[str, Any], folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"Expected an episode of the run, got .*planners \['straight'"):
        found(folder, **asked)
