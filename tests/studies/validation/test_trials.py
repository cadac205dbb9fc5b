"""Trials of the experiment of Cai et al.: what is drawn for them, and how they are
stored.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch

from benchnav.core.settings import of, read
from benchnav.planning import MPPIConfig
from studies.study import Study, Work
from studies.validation import trials
from studies.validation.task import THEIR_MPPI, Setup
from studies.validation.trials import run_trials

QUICK = Setup(
    mppi=MPPIConfig(
        horizon_s=0.8, samples=16, noise=(2.0, 2.0), temperature=1.0, control_cost=0.0
    )
)


DENSITIES, SETTINGS = [0.1, 0.4], ["mean", "cvar:0.8"]


def driven(
    densities: list[float],
    settings: list[str],
    realisations: int = 1,
    seed: int = 0,
    setup: Setup = QUICK,
) -> pd.DataFrame:
    with torch._dynamo.config.patch(disable=True):
        return pd.concat(
            run_trials(densities, settings, 1, realisations, seed, setup),
            ignore_index=True,
        )


@pytest.fixture(scope="module")
def rows() -> pd.DataFrame:
    return driven(DENSITIES, SETTINGS, realisations=2)


def times(rows: pd.DataFrame, **chosen: object) -> list[float]:
    """Of the chosen rows; −1 where there was no arrival."""
    kept = (rows[list(chosen)] == pd.Series(chosen)).all(axis=1)
    return rows.loc[kept, "time_s"].fillna(-1).tolist()


def test_every_setting_and_density_meets_the_same_noise(rows: pd.DataFrame) -> None:
    alone = driven([0.4, 0.4], ["cvar:0.8"])
    assert times(alone) == 2 * times(
        rows, density=0.4, setting="cvar:0.8", realisation=0
    )


def test_rows_are_trials(rows: pd.DataFrame) -> None:
    assert len(rows) == 2 * 2 * 2
    assert not rows.duplicated(["density", "setting", "map", "realisation"]).any()
    assert (rows["success"] == rows["time_s"].notna()).all()
    assert rows["success"].any()
    assert rows.loc[rows["success"], "time_s"].between(3.0, 15.0).all()


def test_risk_on_the_cost_has_a_planner_of_its_own_and_leaves_the_other_rows(
    rows: pd.DataFrame,
) -> None:
    setup = replace(QUICK, fields=26)
    found = driven(DENSITIES, ["mean", "cost", "cost-cvar:0.6"], setup=setup)
    assert times(found, setting="mean") == times(rows, setting="mean", realisation=0)
    assert (
        len(
            {
                tuple(times(found, setting=name))
                for name in ("mean", "cost", "cost-cvar:0.6")
            }
        )
        == 3
    )
    # Neither the other densities nor the other settings change its fields.
    alone = driven([0.4], ["cost-cvar:0.6"], setup=setup)
    assert times(alone) == times(found, setting="cost-cvar:0.6", density=0.4)


def test_trials_are_stored_and_tabulated_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    setups = []

    def two_trials(
        densities: list[float], settings: list[str], *rest: Any
    ) -> Iterator[pd.DataFrame]:
        setups.append(rest[3])
        numbers = {
            "success": [False, True],
            "time_s": [float("nan"), 9.0],
            "map": len(setups),
        }
        for realisation in range(2):
            yield pd.DataFrame(
                {
                    "density": 0.4,
                    "setting": settings,
                    "realisation": realisation,
                    **numbers,
                }
            )

    monkeypatch.setattr(trials, "run_trials", two_trials)
    work = Work(out=tmp_path, maps_in=tmp_path)
    for part, options in (
        ("a", {}),
        ("b", {"mppi": {"samples": 16}, "risk_map": "histogram"}),
    ):
        folder = tmp_path / f"validation-{part}"
        folder.mkdir()
        table = trials.trials(
            work, folder, ["mean", "cvar:0.8"], [0.4], 1, 2, 3, **options
        )["trials"]
        assert "| 40 % | `mean` | 0.0 [" in table
        assert "| 40 % | +100.0 | 2, 0 |" in table
    rows = pd.read_csv(folder / "trials.csv")
    assert rows["setting"].tolist() == ["mean", "mean", "cvar:0.8", "cvar:0.8"]
    assert rows["success"].tolist() == [False, False, True, True]
    plain, changed = setups
    assert plain == Setup()
    assert (changed.mppi.samples, changed.mppi.noise) == (16, THEIR_MPPI.noise)
    assert (
        "| 40 % | +100.0 | 4, 0 |"
        in trials.together(work, folder, ["a", "b"])["trials"]
    )
    runs = trials.compared(work, folder, {"one": "a", "other": "a"})["runs"]
    assert "won only with other, only with one" in runs


def test_each_part_has_usable_options() -> None:
    study = Study.load("validation")
    shared = {"risks", "densities", "maps", "realisations", "seed"}
    for part in study.parts.values():
        if part.script == "trials:trials":
            setup = {
                name: value
                for name, value in part.options.items()
                if name not in shared
            }
            assert read(Setup, setup, of("options"))
        else:
            runs = part.options.get("parts") or part.options["runs"].values()
            assert set(runs) <= set(study.parts)
