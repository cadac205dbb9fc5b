from dataclasses import replace

import networkx
import numpy as np
import pytest
import torch

from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.datagen.recipe.latent import (
    expected_traversability,
    latent_mean,
    latent_std,
)
from benchnav.datagen.recipe.load import load_recipe
from benchnav.datagen.schema import FIELDS
from benchnav.datagen.synth.generate import generate
from tests.factories import tiny_recipe

PAPER = load_recipe("paper-v1")


def test_a_map_is_the_same_in_any_batch() -> None:
    recipe = tiny_recipe(test_hg=9)
    whole = generate(recipe, "test/hg", np.arange(9))
    part = generate(recipe, "test/hg", np.array([1, 2, 7]))
    for name in FIELDS:
        np.testing.assert_array_equal(whole[name][[1, 2, 7]], part[name])


def test_a_map_with_craters_is_the_same_alone() -> None:
    whole = generate(PAPER, "test/hg", np.arange(20))
    for i in range(20):
        np.testing.assert_array_equal(
            generate(PAPER, "test/hg", np.array([i]))["rgb"][0], whole["rgb"][i]
        )


def test_std_terrain_has_the_figures_it_is_known_by() -> None:
    maps = generate(PAPER, "train", np.arange(300))
    relief = np.ptp(maps["elevation_m"], axis=(1, 2))
    assert relief.min() > 1.2
    assert relief.max() < 1.75
    assert 6 < np.median(maps["slope_deg"]) < 7.5
    assert 12 < np.percentile(maps["slope_deg"], 95) < 15


def test_environments_use_every_class_alike_and_splits_differ() -> None:
    shown = PAPER.environment_classes
    assert all(len(set(row)) == 4 for row in shown.tolist())
    assert np.bincount(shown.ravel()).tolist() == [4] * 10
    assert len({tuple(sorted(row)) for row in shown.tolist()}) == 10
    train, valid = (
        generate(PAPER, split, np.arange(10)) for split in ("train", "valid")
    )
    assert (train["environment"] == valid["environment"]).all()
    for i in range(10):
        assert set(np.unique(train["class_id"][i])) == set(shown[i])
        assert not np.array_equal(train["elevation_m"][i], valid["elevation_m"][i])


def test_realised_traversability_is_the_clipped_latent_one() -> None:
    maps = generate(PAPER, "train", np.arange(100))
    slope = maps["slope_deg"].astype(np.float64)
    mean, std = (
        latent_mean(maps["class_id"], slope, PAPER.classes),
        latent_std(maps["class_id"], PAPER.classes),
    )
    inside = (mean > 0.35) & (mean < 0.5)
    score = (maps["traversability"][inside] - mean[inside]) / std[inside]
    assert abs(score.mean()) < 0.03
    assert score.std() == pytest.approx(1, abs=0.03)
    # Near 1 clipping pulls the expectation under the latent mean.
    near_one = mean > 0.97
    assert (expected_traversability(mean, std)[near_one] < mean[near_one]).all()


def test_solvable_maps_have_the_reference_time_of_networkx() -> None:
    recipe = tiny_recipe(test_hg=4)
    maps = generate(recipe, "test/hg", np.arange(4))
    slope = maps["slope_deg"].astype(np.float64)
    means, stds = (
        latent_mean(maps["class_id"], slope, recipe.classes),
        latent_std(maps["class_id"], recipe.classes),
    )
    shaped = [torch.from_numpy(a)[:, None] for a in (np.ones_like(means), means, stds)]
    expected = TraversabilityMixture(*shaped).mean().numpy()
    for b in range(4):
        graph = networkx.Graph()
        for i in range(32):
            for j in range(32):
                for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
                    k, m = i + di, j + dj
                    if (
                        k < 32
                        and 0 <= m < 32
                        and min(expected[b, i, j], expected[b, k, m]) > 0.3
                    ):
                        time = (
                            0.25
                            * np.hypot(di, dj)
                            * (1 / expected[b, i, j] + 1 / expected[b, k, m])
                        )
                        graph.add_edge((i, j), (k, m), weight=time)
        time = networkx.dijkstra_path_length(graph, (8, 8), (24, 24))
        assert maps["reference_time_s"][b] == pytest.approx(time, rel=1e-5)
    assert np.isnan(generate(recipe, "train", np.arange(2))["reference_time_s"]).all()


def test_a_recipe_that_cannot_be_met_says_so() -> None:
    recipe = replace(tiny_recipe(), stuck_threshold=0.999)
    with pytest.raises(ConfigError, match="goal that can be reached"):
        generate(recipe, "test/std", np.arange(2))


def test_start_and_goal_are_free_in_the_cells_that_a_robot_stands_in() -> None:
    tiny = tiny_recipe()
    recipe = replace(
        tiny,
        resolution_m=0.1,
        start_m=(0.7, 0.7),
        goal_m=(2.9, 2.9),
        class_periods_m=(1.2, 0.6),
        scenarios={"std": replace(tiny.scenarios["std"], relief_m=(0.3, 0.4))},
        splits={"test/std": tiny.splits["test/std"]},
    )
    maps = generate(recipe, "test/std", np.arange(60))
    mean = latent_mean(
        maps["class_id"], maps["slope_deg"].astype(np.float64), recipe.classes
    )
    expected = expected_traversability(
        mean, latent_std(maps["class_id"], recipe.classes)
    )
    for name in ("start_m", "goal_m"):
        row, column = recipe.grid.cell_of(*torch.from_numpy(maps[name][0]))
        assert (expected[:, row, column] > recipe.stuck_threshold).all()
