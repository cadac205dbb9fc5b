"""What recipes of synthesis 2 make: the same ground at any size, soft spots, correlated
noise.
"""

import hashlib
from dataclasses import replace

import networkx
import numpy as np
import pytest
import torch
from scipy import stats

from benchnav.core import rng
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.datagen.recipe import latent
from benchnav.datagen.recipe.load import load_recipe, recipe_from_dict
from benchnav.datagen.recipe.recipe import Recipe, Split
from benchnav.datagen.recipe.scenario import blend
from benchnav.datagen.schema import FIELDS, entry_digests
from benchnav.datagen.synth import elevation
from benchnav.datagen.synth.generate import generate, reference_time_s
from tests.datagen.small import SOFT, small_stakes, terrain_class
from tests.factories import tiny_recipe

KEY = rng.stream_key(0, "ground")
STAKES = load_recipe("stakes-v1")


def sized(
    recipe: Recipe, metres: int, scenario: str = "std", resolution_m: float = 0.5
) -> Recipe:
    """Square maps of one scenario, of another size."""
    cells = round(metres / resolution_m)
    return replace(
        recipe, id="sized", height=cells, width=cells, resolution_m=resolution_m,
        places=None, start_m=(1.0, 1.0), goal_m=(metres - 2.0, metres - 2.0),
        splits={"all": Split(scenario=scenario, maps=1)},
    )  # fmt: skip


def truth_of(recipe: Recipe, maps: dict[str, np.ndarray]) -> TraversabilityMixture:
    slope = maps["slope_deg"].astype(np.float64)
    parameters = latent.truth(maps["class_id"], slope, recipe.classes)
    return TraversabilityMixture(*(torch.from_numpy(values) for values in parameters))


# The ground


def median_slopes(recipe: Recipe, maps: int) -> np.ndarray:
    return np.median(generate(recipe, "all", np.arange(maps))["slope_deg"], axis=(1, 2))


def test_a_scenario_is_as_steep_on_maps_of_any_size() -> None:
    steepness = {
        metres: median_slopes(sized(STAKES, metres), maps)
        for metres, maps in ((16, 150), (32, 150), (128, 12))
    }
    for metres in (16, 128):
        there, here = steepness[metres], steepness[32]
        error = np.hypot(
            there.std() / np.sqrt(len(there)), here.std() / np.sqrt(len(here))
        )
        # Over larger maps relief is a mean over squares, which takes 1.5 % off the
        # slope.
        assert abs(there.mean() - here.mean()) < 3 * error + 0.02 * here.mean()
    paper = load_recipe("paper-v1")
    one, many = (median_slopes(sized(paper, metres), 8).mean() for metres in (32, 128))
    assert many < 0.6 * one


def test_std_is_as_steep_as_that_of_paper_v1() -> None:
    paper = median_slopes(sized(load_recipe("paper-v1"), 32), 200)
    assert median_slopes(sized(STAKES, 32), 200).mean() == pytest.approx(
        paper.mean(), abs=0.25
    )


@pytest.mark.parametrize(
    ("shape", "cells"), [((32, 32), 32), ((64, 96), 32), ((20, 40), 32), ((9, 9), 16)]
)
def test_relief_is_the_mean_over_reference_squares(
    shape: tuple[int, int], cells: int
) -> None:
    whole = tuple(-(-size // cells) * cells for size in shape)
    ground = elevation.open_fractal(KEY, np.arange(6), whole, 0.75, cells)
    tiles = [
        np.ptp(ground[:, i : i + cells, j : j + cells], axis=(1, 2))
        for i in range(0, whole[0], cells)
        for j in range(0, whole[1], cells)
    ]
    np.testing.assert_allclose(np.mean(tiles, axis=0), 1)
    # A map that the squares reach beyond is the corner of what they cover.
    np.testing.assert_array_equal(
        elevation.open_fractal(KEY, np.arange(6), shape, 0.75, cells),
        ground[:, : shape[0], : shape[1]],
    )


def test_a_map_of_32_m_has_the_relief_asked_for() -> None:
    recipe = sized(STAKES, 32)
    relief = np.ptp(generate(recipe, "all", np.arange(40))["elevation_m"], axis=(1, 2))
    low, high = recipe.scenarios["std"].relief_m
    assert low - 1e-3 <= relief.min() < relief.max() <= high + 1e-3
    assert relief.std() > 0.15 * (high - low)
    coarse = generate(sized(STAKES, 32, resolution_m=1.0), "all", np.arange(40))[
        "elevation_m"
    ]
    assert np.ptp(coarse, axis=(1, 2)).min() >= low - 1e-3
    assert np.ptp(coarse, axis=(1, 2)).max() <= high + 1e-3


def edge_difference(ground: np.ndarray, first: int, second: int) -> float:
    """Root mean square of the difference between two columns."""
    return float(np.sqrt(((ground[:, :, first] - ground[:, :, second]) ** 2).mean()))


def test_opposite_edges_are_no_neighbours() -> None:
    indices = np.arange(200)
    open_ground = elevation.open_fractal(KEY, indices, (64, 64), 0.75, 64)
    # Ground on a wider map, where nothing of the kind could be: as unlike as any
    # columns so far apart.
    wider = elevation.open_fractal(KEY, indices, (64, 192), 0.75, 64)
    apart = edge_difference(wider, 60, 60 + 63)
    assert edge_difference(open_ground, 0, 63) == pytest.approx(apart, rel=0.15)
    assert edge_difference(open_ground, 0, 63) > 5 * edge_difference(
        open_ground, 31, 32
    )
    torus = elevation.fractal(KEY, indices, (64, 64), 0.75)
    assert edge_difference(torus, 0, 63) < 1.3 * edge_difference(torus, 31, 32)


@pytest.mark.parametrize("roughness", [0.5, 0.75, 0.9])
def test_fine_ground_has_the_asked_roughness(roughness: float) -> None:
    ground = elevation.open_fractal(KEY, np.arange(60), (128, 128), roughness, 128)
    lags = np.array([1, 2, 4])
    squares = [((ground[:, :, lag:] - ground[:, :, :-lag]) ** 2).mean() for lag in lags]
    plain = elevation.fractal(KEY, np.arange(60), (128, 128), roughness)
    plain_squares = [
        ((plain[:, :, lag:] - plain[:, :, :-lag]) ** 2).mean() for lag in lags
    ]
    rise, plain_rise = (
        np.polyfit(np.log(lags), np.log(s), 1)[0] for s in (squares, plain_squares)
    )
    assert rise == pytest.approx(plain_rise, abs=0.1)


def test_craters_are_counted_for_32_m_by_32_m() -> None:
    hg = STAKES.scenarios["hg"]
    assert hg.crater_count == (3, 5)
    assert [sized(STAKES, metres).craters(hg) for metres in (16, 32, 64, 128)] == [
        (1, 1), (3, 5), (12, 20), (48, 80),
    ]  # fmt: skip
    assert sized(load_recipe("paper-v1"), 64).craters(hg) == (3, 5)
    wide = replace(sized(STAKES, 32), width=128)
    assert wide.craters(hg) == (6, 10)
    # Maps too small for one are made without.
    assert sized(STAKES, 8).craters(hg) == (0, 0)


def test_scaled_craters_are_dug() -> None:
    flat = {
        "relief_m": (0.0, 0.0),
        "crater_radius_m": (2.5, 2.5),
        "crater_count": (2.0, 2.0),
    }
    hg = replace(STAKES.scenarios["hg"], **flat)
    recipe = replace(STAKES, scenarios=STAKES.scenarios | {"hg": hg})
    for metres, bowls in ((32, 2), (64, 8)):
        made = generate(sized(recipe, metres, "hg"), "all", np.arange(10))[
            "elevation_m"
        ]
        # A bowl is the only ground below the plain: ratio² < 0.8. Some reach over the
        # map's edges.
        area_m2 = 0.25 * (made < 0).sum(axis=(1, 2))
        whole_m2 = bowls * 0.8 * np.pi * 2.5**2
        assert 0.6 * whole_m2 < area_m2.mean() < 1.05 * whole_m2


def test_too_many_craters_for_the_area_are_refused_at_any_size() -> None:
    crowded = replace(STAKES.scenarios["hg"], crater_count=(20, 20))
    for metres in (16, 32, 64):
        with pytest.raises(ConfigError, match="cover at most 40% of a map"):
            replace(sized(STAKES, metres), scenarios={"std": crowded})
        # A scenario that no split uses need not fit.
        replace(
            sized(STAKES, metres),
            scenarios={"std": STAKES.scenarios["std"], "hg": crowded},
        )


def test_the_series_of_stakes_climbs_from_std_in_equal_steps() -> None:
    for preset in ("hg", "hs"):
        for severity in (0.25, 0.5, 0.75):
            between = STAKES.scenarios[f"{preset}-{100 * severity:03.0f}"]
            assert between == blend(
                STAKES.scenarios["std"], STAKES.scenarios[preset], severity
            )
    assert (
        STAKES.scenarios["std"].relief_m
        != load_recipe("paper-v1").scenarios["std"].relief_m
    )
    assert STAKES.splits == {
        "train": Split(scenario="std", maps=1000, solvable=True),
        "valid": Split(scenario="std", maps=250, solvable=True),
    } | {
        f"test/{name}": Split(scenario=name, maps=200, solvable=True)
        for name in STAKES.scenarios
    }


# Stored λ


def test_stored_traversability_has_the_distribution_of_each_cell() -> None:
    recipe = small_stakes()
    maps = generate(recipe, "train", np.arange(400))
    mixture = truth_of(recipe, maps)
    stored = torch.from_numpy(maps["traversability"].astype(np.float64))
    below, at = mixture.cdf(stored - 1e-9), mixture.cdf(stored)
    # Ranks, drawn within the jumps of clipping; thinned, as neighbours are alike.
    share = np.random.default_rng(0).random(stored.shape)
    rank = (below + (at - below) * torch.from_numpy(share)).numpy()[:, 4::12, 4::12]
    assert stats.kstest(rank.ravel(), "uniform").pvalue > 1e-3
    soft = np.array([item.soft is not None for item in recipe.classes])[
        maps["class_id"][:, 4::12, 4::12]
    ]
    assert stats.kstest(rank[soft], "uniform").pvalue > 1e-3
    assert abs((rank[soft] < 0.1).mean() - 0.1) < 4 * np.sqrt(0.09 / soft.sum())


@pytest.mark.parametrize("correlation_m", [0.0, 0.5, 1.5, 3.0])
def test_noise_is_correlated_over_the_metres_asked_for(correlation_m: float) -> None:
    # One class with λ far from 0 and 1, so that λ is noise and nothing else.
    plain = (terrain_class("even", scale=0.0, offset=0.5, noise=0.05),)
    for resolution_m in (0.5, 0.25):
        recipe = replace(
            small_stakes(correlation_m=correlation_m, classes=plain, occupancy=(1.0,)),
            resolution_m=resolution_m, height=round(16 / resolution_m), width=round(16 / resolution_m),
        )  # fmt: skip
        noise = (
            generate(recipe, "train", np.arange(150))["traversability"].astype(float)
            - 0.5
        ) / 0.05
        for cells in (1, 3, 6):
            distance_m = cells * resolution_m
            expected = (
                np.exp(-((distance_m / correlation_m) ** 2) / 2)
                if correlation_m
                else 0.0
            )
            for found in (
                noise[:, cells:] * noise[:, :-cells],
                noise[:, :, cells:] * noise[:, :, :-cells],
            ):
                assert found.mean() == pytest.approx(expected, abs=0.08)


def test_each_map_split_and_seed_has_noise_of_its_own() -> None:
    recipe = small_stakes()
    again = replace(recipe, seed=1)
    first = generate(recipe, "train", np.arange(3))["traversability"]
    assert not np.array_equal(first[0], first[1])
    assert not np.array_equal(
        generate(again, "train", np.arange(3))["traversability"], first
    )
    np.testing.assert_array_equal(
        generate(recipe, "train", np.array([2]))["traversability"][0], first[2]
    )


def test_reference_times_are_over_the_whole_truth_from_each_map_s_own_places() -> None:
    recipe = small_stakes(height=20, width=24, occupancy=(0.5, 0.5))
    maps = generate(recipe, "test/hg", np.arange(3))
    expected = truth_of(recipe, maps).mean().numpy()
    for b in range(3):
        graph = networkx.Graph()
        for i in range(20):
            for j in range(24):
                for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
                    k, m = i + di, j + dj
                    if (
                        k < 20
                        and 0 <= m < 24
                        and min(expected[b, i, j], expected[b, k, m]) > 0.1
                    ):
                        time = (
                            0.25
                            * np.hypot(di, dj)
                            * (1 / expected[b, i, j] + 1 / expected[b, k, m])
                        )
                        graph.add_edge((i, j), (k, m), weight=time)
        ends = [
            tuple((maps[name][b, ::-1] / 0.5).astype(int).tolist())
            for name in ("start_m", "goal_m")
        ]
        time = networkx.dijkstra_path_length(graph, *ends)
        assert maps["reference_time_s"][b] == pytest.approx(time, rel=1e-5)


def test_soft_spots_lengthen_reference_times_and_close_cells() -> None:
    firm = (terrain_class("firm", scale=0.0, offset=0.2),)
    recipe = small_stakes(classes=firm, occupancy=(1.0,))
    maps = generate(recipe, "train", np.arange(4))
    soft = replace(recipe, classes=(replace(firm[0], soft=SOFT),))
    slow, fast = reference_time_s(soft, maps), reference_time_s(recipe, maps)
    truth = truth_of(recipe, maps).mean().max(), truth_of(soft, maps).mean().max()
    np.testing.assert_allclose(slow / fast, float(truth[0] / truth[1]), rtol=1e-6)
    closed = replace(soft, stuck_threshold=0.75)
    assert np.isinf(reference_time_s(closed, maps)).all()
    assert np.isfinite(
        reference_time_s(replace(recipe, stuck_threshold=0.75), maps)
    ).all()


# The recipe


def test_what_is_new_is_refused_with_synthesis_1() -> None:
    tiny = tiny_recipe().to_dict()
    assert not {"synthesis", "places", "correlation_m"} & set(tiny)
    assert all("soft" not in item for item in tiny["classes"])
    spots = {"weight": 0.1, "mean": 0.05, "std": 0.05}
    classes = [{**tiny["classes"][0], "soft": spots}, *tiny["classes"][1:]]
    places = {
        name: value for name, value in tiny.items() if name not in ("start_m", "goal_m")
    } | {"places": {"least_distance_m": 5, "margin_m": 1}}
    for data, name in (
        (tiny | {"classes": classes}, "soft"),
        (places, "places"),
        (tiny | {"correlation_m": 1}, "correlation_m"),
    ):
        with pytest.raises(ConfigError, match=rf"`synthesis: 2` with `{name}`"):
            recipe_from_dict(data, "test")
        assert recipe_from_dict(data | {"synthesis": 2}, "test").synthesis == 2
    for synthesis in (0, 3):
        with pytest.raises(ConfigError, match="`synthesis` 1 or 2"):
            recipe_from_dict(tiny | {"synthesis": synthesis}, "test")


@pytest.mark.parametrize("correlation_m", [-1, 4.01, float("nan")])
def test_a_correlation_that_the_map_has_no_room_for_is_refused(
    correlation_m: float,
) -> None:
    assert small_stakes(correlation_m=4.0)
    with pytest.raises(ConfigError, match="`correlation_m` in 0–4 m"):
        small_stakes(correlation_m=correlation_m)


def test_a_recipe_of_synthesis_2_survives_its_manifest() -> None:
    recipe = small_stakes(correlation_m=0.75)
    data = recipe.to_dict()
    assert recipe_from_dict(data, "manifest") == recipe
    assert data["synthesis"] == 2
    assert data["correlation_m"] == 0.75
    assert [item["name"] for item in data["classes"] if item["soft"]] == [
        "wet_clay", "loose_soil", "fine_sand", "dune_sand",
    ]  # fmt: skip


def test_the_presets_of_a_recipe_are_those_of_its_synthesis() -> None:
    scenarios = {"std": {"preset": "std"}, "hs": {"preset": "hs", "severity": 0.5}}
    tiny = tiny_recipe().to_dict() | {"scenarios": scenarios}
    tiny["splits"] = {"train": {"scenario": "std", "maps": 1}}
    first, second = (recipe_from_dict(tiny | {"synthesis": s}, "test") for s in (1, 2))
    assert first.scenarios["std"].relief_m == (1.4, 1.7)
    assert list(second.scenarios.values()) == [
        STAKES.scenarios[name] for name in ("std", "hs-050")
    ]


@pytest.mark.parametrize(
    ("split", "digest"),
    [
        ("train", "ac0d1fa5bac16592e6dace1e9ac05ff7041b065e50ffd047df15aadf09c8ef91"),
        ("test/hg", "4b77b5694bb189749dd16df89722aebdf46063d4f970bbf22fd6db8065f00379"),
    ],
)
def test_the_maps_of_stakes_v1_stay_as_models_were_trained_on(
    split: str, digest: str
) -> None:
    made = entry_digests(generate(STAKES, split, np.arange(2)), FIELDS)
    assert hashlib.sha256(made.tobytes()).hexdigest() == digest
