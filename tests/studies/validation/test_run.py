from dataclasses import replace

import pandas as pd
import pytest
import torch
from torch import Tensor

from benchnav.core.errors import ConfigError
from benchnav.planning.planners.mppi import MPPIConfig
from benchnav.planning.problem import Problem
from studies.validation import run
from studies.validation.run import run_trials
from studies.validation.task import Setup

QUICK = Setup(mppi=MPPIConfig(horizon_s=0.8, samples=16, noise=(2.0, 2.0), temperature=1.0, control_cost=0.0))


DENSITIES, SETTINGS = [0.1, 0.4], ["mean", "cvar:0.8"]


def trials(
    densities: list[float], settings: list[str], realisations: int = 1, seed: int = 0, setup: Setup = QUICK
) -> pd.DataFrame:
    with torch._dynamo.config.patch(disable=True):
        return pd.concat(run_trials(densities, settings, 1, realisations, seed, setup), ignore_index=True)


@pytest.fixture(scope="module")
def rows() -> pd.DataFrame:
    return trials(DENSITIES, SETTINGS, realisations=2)


def times(rows: pd.DataFrame, **chosen: object) -> list[float]:
    """Of the chosen rows; −1 where there was no arrival."""
    kept = (rows[list(chosen)] == pd.Series(chosen)).all(axis=1)
    return rows.loc[kept, "time_s"].fillna(-1).tolist()


def test_every_setting_and_density_meets_the_same_noise(rows: pd.DataFrame) -> None:
    alone = trials([0.4, 0.4], ["cvar:0.8"])
    assert times(alone) == 2 * times(rows, density=0.4, setting="cvar:0.8", realisation=0)


def test_rows_are_trials(rows: pd.DataFrame) -> None:
    assert len(rows) == 2 * 2 * 2
    assert not rows.duplicated(["density", "setting", "map", "realisation"]).any()
    assert (rows["success"] == rows["time_s"].notna()).all()
    assert rows["success"].any()
    assert rows.loc[rows["success"], "time_s"].between(3.0, 15.0).all()


def test_realisations_settings_and_seeds_count(rows: pd.DataFrame) -> None:
    first = times(rows, realisation=0)
    assert first != times(rows, realisation=1)
    assert times(rows, setting="mean") != times(rows, setting="cvar:0.8")
    assert first != times(trials(DENSITIES, SETTINGS, seed=1))


def test_noise_is_named_by_map_and_realisation(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds, fields = [], []

    def record(planner: object, problem: Problem, traction: Tensor, generator: torch.Generator) -> Tensor:
        seeds.append(generator.initial_seed())
        fields.append(traction)
        return torch.zeros(len(problem))

    monkeypatch.setattr(run, "drive", record)
    rows = pd.concat(run_trials(DENSITIES, SETTINGS, 2, 2, 0, QUICK))
    assert len(set(seeds)) == 4
    for sparse, sparse_again, dense, dense_again in fields:
        assert torch.equal(sparse, sparse_again)
        assert torch.equal(dense, dense_again)
        assert not torch.equal(sparse, dense)
    assert not torch.equal(fields[0][0], fields[1][0])
    assert rows["success"].all()
    assert rows.iloc[:4][["density", "setting"]].to_numpy().tolist() == [
        [d, s] for d in DENSITIES for s in SETTINGS
    ]


@pytest.mark.parametrize(
    "change", [{"risk_map": "histogram"}, {"distance_power": 2}, {"min_traversability": 0.9}]
)
def test_a_setup_is_heeded(rows: pd.DataFrame, change: dict) -> None:
    changed = trials(DENSITIES, SETTINGS, setup=Setup(mppi=QUICK.mppi, **change))
    assert times(changed) != times(rows, realisation=0)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (([1.1], ["mean"], 1, 1), "Expected densities in"),
        (([0.4], ["mean"], 0, 1), "Expected `maps` and `realisations`"),
        (([0.4], ["mean"], 1, 0), "Expected `maps` and `realisations`"),
        (([0.4], ["meen"], 1, 1), "meen"),
    ],
)
def test_what_cannot_be_run_is_refused(given: tuple, expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        next(run_trials(*given, 0, QUICK))


def test_risk_on_the_cost_has_a_planner_of_its_own_and_leaves_the_other_rows(rows: pd.DataFrame) -> None:
    setup = replace(QUICK, fields=26)
    found = trials(DENSITIES, ["mean", "cost", "cost-cvar:0.6"], setup=setup)
    assert times(found, setting="mean") == times(rows, setting="mean", realisation=0)
    assert len({tuple(times(found, setting=name)) for name in ("mean", "cost", "cost-cvar:0.6")}) == 3
    # Neither the other densities nor the other settings change its fields.
    alone = trials([0.4], ["cost-cvar:0.6"], setup=setup)
    assert times(alone) == times(found, setting="cost-cvar:0.6", density=0.4)
    fewer = trials(DENSITIES, ["cost"], setup=replace(QUICK, fields=1))
    assert times(fewer) != times(found, setting="cost")
    for change in ({"motions": "two"}, {"risk_map": "histogram"}):
        changed = trials(DENSITIES, ["cost"], setup=replace(setup, **change))
        assert times(changed) != times(found, setting="cost"), change
