"""What each unit of a suite meets where λ is frozen: worked out here from the dataset
and the streams alone.

A spy planner writes down what it sees, on 53 maps with places of their own, in two
blocks, with two workers.
"""

from collections import Counter
from dataclasses import replace
from typing import Any

import networkx
import numpy as np
import pandas as pd
import pytest
import torch

from benchnav.core import rng
from benchnav.core.copula import correlated_normal
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.places import PlacesRule
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.run.runner import run_suite
from tests import factories

MAPS, SEEDS, REALISATIONS, RATIO = 53, (3, 4), 2, 0.05
WORLDS = {0.5: 0.05, 2.0: 0.6}  # ℓ in metres, and what λ immobilises a robot
BLOCKS = (tuple(range(50)), tuple(range(50, MAPS)))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> TerrainDataset:
    recipe = factories.tiny_recipe(
        train=1, valid=1, test_std=MAPS, test_hg=1, test_hs=1
    )
    recipe = replace(
        recipe, synthesis=2, start_m=None, goal_m=None, correlation_m=1.0,
        places=PlacesRule(least_distance_m=9.0, margin_m=2.0),
    )  # fmt: skip
    return TerrainDataset(
        factories.tiny_dataset(tmp_path_factory.mktemp("data") / "d.h5", recipe)
    )


@pytest.fixture(scope="module")
def ran(
    dataset: TerrainDataset, tmp_path_factory: pytest.TempPathFactory
) -> tuple[list[Any], pd.DataFrame]:
    folder = tmp_path_factory.mktemp("spied")
    (folder / "log").mkdir()
    worlds = [
        {
            "preset": "stakes",
            "correlation_m": length,
            "immobile": {"below": below, "for_s": 50},
            "time_budget_ratio": RATIO,
        }
        for length, below in WORLDS.items()
    ]
    suite = Suite(
        data=str(dataset.path), scenarios=("std",), models=("oracle", "clairvoyant"), risks=("mean", "cvar:0.5"),
        planners=({"part": "tests.eval.parts:Spy", "options": {"log": str(folder / "log")}},),
        seeds=SEEDS, realisations=REALISATIONS, maps=0, record="steps", conditions=({"world": worlds},),
    )  # fmt: skip
    for _ in run_suite(suite, folder / "run", jobs=2):
        pass
    notes = [torch.load(path) for path in (folder / "log").glob("*.pt")]
    return notes, pd.read_parquet(folder / "run" / "episodes.parquet")


def cell(position: np.ndarray) -> tuple[int, int]:
    return int(position[1] // 0.5), int(position[0] // 0.5)


def has_way(ground: np.ndarray, start: tuple[int, int], goal: tuple[int, int]) -> bool:
    graph = networkx.grid_2d_graph(*ground.shape)
    graph.remove_nodes_from([node for node in list(graph) if not ground[node]])
    return start in graph and goal in graph and networkx.has_path(graph, start, goal)


def field(
    dataset: TerrainDataset, map_index: int, seed: int, realisation: int, length: float
) -> tuple[torch.Tensor, int]:
    """λ of an episode, and how often it was drawn again."""
    terrain = dataset.terrain("test/std", [map_index])
    places = dataset.read("test/std", [map_index], ["start_m", "goal_m"])
    names = ("test/std", realisation) if realisation else ("test/std",)
    noise = rng.stream_key(seed, "simulation", *names)
    for attempt in range(100):
        key = rng.stream_key(noise, map_index, "field", attempt)
        normal = correlated_normal(key, np.zeros(1, np.int64), (32, 32), length / 0.5)[
            0
        ]
        mean, std = (
            t[0, 0].double().numpy() for t in (terrain.truth.means, terrain.truth.stds)
        )
        met = np.clip(mean + std * normal, 0, 1)
        if has_way(
            met >= WORLDS[length], cell(places["start_m"][0]), cell(places["goal_m"][0])
        ):
            return torch.from_numpy(met), attempt
    raise AssertionError("no way in a hundred draws")


def test_each_unit_meets_the_field_of_its_own_world_seed_realisation_and_maps(
    dataset: TerrainDataset, ran: tuple[list[Any], pd.DataFrame]
) -> None:
    notes, _ = ran
    truth = dataset.terrain("test/std").truth
    places = dataset.read("test/std", fields=["start_m", "goal_m", "reference_time_s"])
    fields = {
        (length, seed, realisation, block): torch.stack(
            [field(dataset, i, seed, realisation, length)[0] for i in block]
        )
        for length in WORLDS
        for seed in SEEDS
        for realisation in range(REALISATIONS)
        for block in BLOCKS
    }
    met: Counter[tuple[Any, ...]] = Counter()
    for note in notes:
        if len(note["goal_m"]) == 1:  # a robot alone, for its latency
            continue
        (block,) = (b for b in BLOCKS if len(b) == len(note["goal_m"]))
        rows = list(block)
        np.testing.assert_allclose(note["start"][:, :2], places["start_m"][rows])
        np.testing.assert_allclose(note["goal_m"], places["goal_m"][rows])
        np.testing.assert_allclose(
            note["time_budget_s"], RATIO * places["reference_time_s"][rows], rtol=1e-5
        )
        # Free by the mean, whatever the risk setting; motion at no less than 0.05.
        mean = truth.select(torch.tensor(rows)).mean()
        torch.testing.assert_close(note["motion_map"], note["risk_map"].clamp(min=0.05))
        observed = note["observed"][0].double()
        starts = [cell(position) for position in places["start_m"][rows]]
        fitting = [
            key
            for key, known in fields.items()
            if key[3] == block
            and np.allclose(
                observed, [known[b][at] for b, at in enumerate(starts)], atol=1e-5
            )
        ]
        assert len(fitting) == 1
        assert torch.equal(
            note["observed"], note["observed"][:1].expand_as(note["observed"])
        )
        known = fields[fitting[0]]
        if torch.allclose(note["risk_map"].double(), known, atol=1e-5):
            setting = "clairvoyant"
            assert ((note["free"] != (known > 0.1)).flatten(1).sum(1) <= 40).all()
        else:
            setting = "mean" if torch.allclose(note["risk_map"], mean) else "cvar:0.5"
            if setting != "mean":
                chosen = truth.select(torch.tensor(rows)).cvar(0.5)
                torch.testing.assert_close(note["risk_map"], chosen)
            assert ((note["free"] != (mean > 0.1)).flatten(1).sum(1) <= 40).all()
        met[setting, *fitting[0]] += 1
    wanted = {
        (setting, *key)
        for setting in ("mean", "cvar:0.5", "clairvoyant")
        for key in fields
    }
    assert set(met) == wanted
    assert set(met.values()) == {1}


def test_rows_tell_what_was_drawn_again_and_the_clairvoyant_runs_once(
    dataset: TerrainDataset, ran: tuple[list[Any], pd.DataFrame]
) -> None:
    _, rows = ran
    assert len(rows) == 3 * len(WORLDS) * len(SEEDS) * REALISATIONS * MAPS
    assert set(zip(rows["model"], rows["risk"], strict=True)) == {
        ("oracle", "mean"), ("oracle", "cvar:0.5"), ("clairvoyant", "–"),
    }  # fmt: skip
    assert rows["rejected_draws"].max() > 0
    for row in (
        rows[rows["world"].str.contains("correlation_m=2")]
        .sample(20, random_state=1)
        .to_dict("records")
    ):
        told = field(dataset, row["map"], row["seed"], row["realisation"], 2.0)
        assert row["rejected_draws"] == told[1]
        assert row["total_time_s"] == pytest.approx(
            RATIO * row["reference_time_s"], rel=1e-4
        )
