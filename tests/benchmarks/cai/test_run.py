from collections.abc import Iterator

import pandas as pd
import pytest
import torch

from benchmarks.cai.run import run_trials
from benchmarks.cai.task import Setup
from benchnav.errors import ConfigError
from benchnav.planning.planners.mppi import MPPIConfig

QUICK = Setup(mppi=MPPIConfig(horizon=8, samples=16, noise=(2.0, 2.0), temperature=1.0, control_cost=0.0))


@pytest.fixture(autouse=True)
def _eager() -> Iterator[None]:
    with torch._dynamo.config.patch(disable=True):
        yield


def trials(densities: list[float], settings: list[str], seed: int = 0, setup: Setup = QUICK) -> pd.DataFrame:
    return pd.concat(run_trials(densities, settings, 1, 2, seed, setup), ignore_index=True)


def of(rows: pd.DataFrame, density: float, setting: str) -> pd.DataFrame:
    chosen = rows[(rows["density"] == density) & (rows["setting"] == setting)]
    return chosen[["map", "realisation", "success", "time_s"]].reset_index(drop=True)


def test_every_setting_and_density_meets_the_same_luck() -> None:
    together = trials([0.1, 0.4], ["mean", "cvar:0.8"])
    pd.testing.assert_frame_equal(
        of(together, 0.4, "cvar:0.8"), of(trials([0.4], ["cvar:0.8"]), 0.4, "cvar:0.8")
    )
    twice = trials([0.4, 0.4], ["mean"])
    assert twice.groupby(["map", "realisation"])["time_s"].nunique(dropna=False).eq(1).all()


def test_rows_are_trials() -> None:
    rows = trials([0.1, 0.4], ["mean", "cvar:0.8"])
    assert len(rows) == 2 * 2 * 2
    assert not rows.duplicated(["density", "setting", "map", "realisation"]).any()
    assert (rows["success"] == rows["time_s"].notna()).all()
    assert rows["success"].any()
    assert rows.loc[rows["success"], "time_s"].between(4.0, 15.0).all()


def test_realisations_maps_seeds_and_settings_count() -> None:
    rows = trials([0.4], ["mean", "cvar:0.8"])
    assert not of(rows, 0.4, "mean")["time_s"].duplicated().any()
    assert not of(rows, 0.4, "mean").equals(of(rows, 0.4, "cvar:0.8"))
    assert not of(rows, 0.4, "mean").equals(of(trials([0.4], ["mean"], seed=1), 0.4, "mean"))


@pytest.mark.parametrize(
    "change", [{"average": "drawn"}, {"risk_map": "histogram"}, {"distance_power": 2}, {"slowest": 0.9}]
)
def test_a_setup_is_heeded(change: dict) -> None:
    usual = trials([0.4], ["cvar:0.8"])
    changed = trials([0.4], ["cvar:0.8"], setup=Setup(mppi=QUICK.mppi, **change))
    assert not of(usual, 0.4, "cvar:0.8").equals(of(changed, 0.4, "cvar:0.8"))


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
