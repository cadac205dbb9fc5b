"""What each unit of a suite is given: every setting reaches the episodes that it is
meant for, and no other.

A spy planner writes down what it sees, on 54 maps that are not square, in two blocks a
cell, with two workers; expectations are worked out here from the dataset and the random
streams alone.
"""

from collections import Counter
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from benchnav.core import rng
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.run.runner import run_suite
from tests import factories

MAPS, SEEDS, REALISATIONS = 54, (3, 4), 2
SCENARIOS = ("std", "hg")
RISKS = {"mean": lambda m: m.mean(), "cvar:0.5": lambda m: m.cvar(0.5)}
GAINS = {"quiet": 1.0, "loud": 2.5}
WORLDS = {
    "paper time_budget_s=0.6": "resampled",
    "paper noise=stored time_budget_s=0.6": "stored",
}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> TerrainDataset:
    recipe = replace(
        factories.tiny_recipe(train=1, valid=1, test_std=MAPS, test_hg=MAPS, test_hs=1),
        height=24, width=36, start_m=(3.0, 4.0), goal_m=(15.0, 9.0),
    )  # fmt: skip
    return TerrainDataset(
        factories.tiny_dataset(tmp_path_factory.mktemp("data") / "wide.h5", recipe)
    )


@pytest.fixture(scope="module")
def ran(
    dataset: TerrainDataset, tmp_path_factory: pytest.TempPathFactory
) -> tuple[list[Any], pd.DataFrame]:
    """What the spy saw, unit by unit, and the run's rows."""
    folder = tmp_path_factory.mktemp("spied")
    (folder / "log").mkdir()
    spies = tuple(
        {
            "part": "tests.eval.parts:Spy",
            "label": label,
            "options": {"log": str(folder / "log"), "gain": gain},
        }
        for label, gain in GAINS.items()
    )
    suite = Suite(
        data=str(dataset.path), scenarios=SCENARIOS, planners=spies, risks=tuple(RISKS), maps=0,
        seeds=SEEDS, realisations=REALISATIONS,
        model={"part": "oracle", "label": "truth"}, record="steps",
        conditions=({"world": {"noise": ["resampled", "stored"], "time_budget_s": 0.6}},),
    )  # fmt: skip
    for _ in run_suite(suite, folder / "run", jobs=2):
        pass
    notes = [torch.load(path) for path in (folder / "log").glob("*.pt")]
    return notes, pd.read_parquet(folder / "run" / "episodes.parquet")


@cache
def risk_maps(dataset: TerrainDataset, scenario: str, risk: str) -> torch.Tensor:
    return RISKS[risk](dataset.terrain(f"test/{scenario}").truth)


@cache
def ground_at_start(
    dataset: TerrainDataset, scenario: str, map_index: int
) -> tuple[float, float, float]:
    """λ, and mean and standard deviation of the distribution it was drawn from."""
    terrain = dataset.terrain(f"test/{scenario}", [map_index])
    row, column = int(4.0 // 0.5), int(3.0 // 0.5)
    mean, std = (
        float(t[0, 0, row, column]) for t in (terrain.truth.means, terrain.truth.stds)
    )
    return float(terrain.traversability[0, row, column]), mean, std


@cache
def expected_noise(
    dataset: TerrainDataset,
    scenario: str,
    map_index: int,
    seed: int,
    realisation: int,
    noise: str,
) -> np.ndarray:
    """λ of the first three steps at the start, from the streams."""
    stored, mean, std = ground_at_start(dataset, scenario, map_index)
    if noise == "stored":
        return np.full(3, stored)
    names = (f"test/{scenario}", realisation) if realisation else (f"test/{scenario}",)
    key = rng.stream_key(rng.stream_key(seed, "simulation", *names), map_index)
    drawn = rng.normal(key, np.zeros(1, np.int64), (6,))[0, :3]
    return np.clip(mean + std * drawn, 0, 1)


def identify(
    dataset: TerrainDataset, note: dict[str, Any]
) -> tuple[str, str, tuple[int, ...]]:
    """Scenario, risk and maps of a unit, told by the maps it was given."""
    for scenario in SCENARIOS:
        for risk in RISKS:
            maps = risk_maps(dataset, scenario, risk)
            same = (note["risk_map"][:, None] - maps[None]).abs().amax(
                dim=(2, 3)
            ) < 1e-6
            if bool(same.any(dim=1).all()):
                return scenario, risk, tuple(same.int().argmax(dim=1).tolist())
    raise AssertionError(
        "a unit was given maps that are those of no scenario and risk setting"
    )


def test_each_unit_meets_its_own_maps_risk_seed_noise_and_options(
    dataset: TerrainDataset, ran: tuple[list[Any], pd.DataFrame]
) -> None:
    notes, _ = ran
    met: Counter[tuple[Any, ...]] = Counter()
    for note in notes:
        scenario, risk, maps = identify(dataset, note)
        terrain = dataset.terrain(f"test/{scenario}", maps)
        assert torch.equal(note["rgb"], terrain.rgb)
        torch.testing.assert_close(note["motion_map"], note["risk_map"].clamp(min=0.3))
        away = note["free"] != (note["risk_map"] > 0.3)
        assert away.sum() <= 40 * len(maps)  # the goal's disc alone
        (seed,) = (
            s
            for s in SEEDS
            for r in range(REALISATIONS)
            if _planner_seed(s, scenario, r) == note["generator"]
        )
        (realisation,) = (
            r
            for r in range(REALISATIONS)
            if _planner_seed(seed, scenario, r) == note["generator"]
        )
        observed = note["observed"].numpy()
        noises = [
            noise
            for noise in WORLDS.values()
            if np.allclose(
                observed,
                np.stack(
                    [
                        expected_noise(dataset, scenario, i, seed, realisation, noise)
                        for i in maps
                    ],
                    axis=1,
                ),
                atol=1e-5,
            )
        ]
        assert len(noises) == 1, (
            "observed λ is that of no noise under this unit's seed and maps"
        )
        met[scenario, risk, maps, seed, realisation, noises[0], note["gain"]] += 1
        assert note["goal_m"].tolist() == [[15.0, 9.0]] * len(maps)
        assert note["start"][:, :2].tolist() == [[3.0, 4.0]] * len(maps)
        assert note["time_budget_s"] == pytest.approx(0.6)
        assert note["components"] == 1
    blocks = (tuple(range(50)), tuple(range(50, MAPS)))
    wanted = {
        (scenario, risk, block, seed, realisation, noise, gain)
        for scenario in SCENARIOS
        for risk in RISKS
        for block in blocks
        for seed in SEEDS
        for realisation in range(REALISATIONS)
        for noise in WORLDS.values()
        for gain in GAINS.values()
    }
    alone = {
        (SCENARIOS[0], "mean", (0,), SEEDS[0], 0, "resampled", gain)
        for gain in GAINS.values()
    }
    # one robot alone of each planner, for its latency
    assert set(met) == wanted | alone
    assert set(met.values()) == {1}


def _planner_seed(seed: int, scenario: str, realisation: int) -> int:
    names = (f"test/{scenario}", realisation) if realisation else (f"test/{scenario}",)
    return rng.stream_key(seed, "planner", *names) % 2**63


def test_each_row_is_that_of_its_own_episode(
    dataset: TerrainDataset, ran: tuple[list[Any], pd.DataFrame]
) -> None:
    _, rows = ran
    assert len(rows) == 2 * 2 * 2 * 2 * 2 * 2 * MAPS
    keys = ["scenario", "risk", "planner", "world", "seed", "realisation", "map"]
    assert not rows.duplicated(keys).any()
    assert set(rows["planner"]) == set(GAINS)
    assert set(rows["risk"]) == set(RISKS)
    assert set(rows["world"]) == set(WORLDS)
    assert set(rows["model"]) == {"truth"}
    assert rows["condition"].nunique() == 16
    assert set(rows["outcome"]) == {"stalled"} or set(rows["outcome"]) == {"timeout"}
    stored = rows[rows["world"].str.contains("stored")]
    for row in stored.sample(40, random_state=0).to_dict("records"):
        expected = expected_noise(
            dataset,
            row["scenario"],
            row["map"],
            row["seed"],
            row["realisation"],
            "stored",
        )
        assert row["traversability"] == pytest.approx(expected[0], abs=1e-5)
    drawn = rows[~rows["world"].str.contains("stored")]
    # Planners and risk settings meet the same noise; seeds, realisations and maps do
    # not.
    same = drawn.groupby(["scenario", "seed", "realisation", "map"])[
        "traversability"
    ].nunique()
    assert set(same) == {1}
    other = drawn.groupby(["scenario", "map"])["traversability"].nunique()
    assert set(other) == {len(SEEDS) * REALISATIONS}
