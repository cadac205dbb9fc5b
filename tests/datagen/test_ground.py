import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.special import ndtr

from benchnav.core import rng
from benchnav.core.errors import DatasetError
from benchnav.core.ground import GroundStatistics
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.ground import (
    count_neighbours,
    find_ground,
    fit_ground,
    fit_mixture,
    fit_potts_strength,
    ground_file,
    look_alike_pairs,
)
from benchnav.datagen.recipe.load import load_recipe, shipped_recipes
from benchnav.datagen.recipe.recipe import Split
from benchnav.datagen.recipe.scenario import RECIPES
from tests.commands import call
from tests.datagen.small import small_stakes
from tests.factories import tiny_dataset


@pytest.fixture(scope="module")
def stakes(tmp_path_factory: pytest.TempPathFactory) -> TerrainDataset:
    return TerrainDataset(
        tiny_dataset(tmp_path_factory.mktemp("ground") / "stakes.h5", small_stakes())
    )


@pytest.fixture(scope="module")
def fitted(stakes: TerrainDataset) -> GroundStatistics:
    return fit_ground(stakes)


def gap(
    weights: np.ndarray, means: np.ndarray, stds: np.ndarray, values: np.ndarray
) -> float:
    """Largest distance of a clipped mixture's distribution function from that of
    values, left limits at 1.
    """
    at = np.linspace(0, 1, 2001)[:-1]
    fit = (weights * ndtr((at[:, None] - means) / stds)).sum(1)
    return float(
        np.abs(
            fit - np.searchsorted(np.sort(values), at, side="right") / len(values)
        ).max()
    )


def counted(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    inside = values[(values > 0) & (values < 1)]
    ends = np.array([(values == 0).sum(), (values == 1).sum()])
    return np.histogram(inside, 1024, (0, 1))[0].astype(float), ends.astype(float)


def uniform(*names: str, count: int = 20000) -> np.ndarray:
    return rng.uniform(rng.stream_key(0, *names), np.arange(count))


LAWS = {
    "clipped at both ends": lambda: (0.5 + 0.5 * rng.normal(7, np.arange(20000))).clip(
        0, 1
    ),
    "uniform": lambda: uniform("value"),
    "atoms alone": lambda: (uniform("value") < 0.3).astype(float),
    "an atom beside a narrow mode": lambda: np.where(
        uniform("which") < 0.4, 0.0, 0.6 + 0.01 * rng.normal(8, np.arange(20000))
    ),
    "one value": lambda: np.full(20000, 0.25),
}


@pytest.mark.parametrize("law", [name for name in LAWS if name != "one value"])
def test_the_mixture_is_within_a_hundredth_of_what_was_counted(law: str) -> None:
    values = LAWS[law]()
    fitted = fit_mixture(*counted(values))
    assert gap(*fitted, values) < 0.01
    assert len(fitted[0]) == 10
    assert fitted[0].sum() == pytest.approx(1)


def test_a_single_value_is_met_by_a_narrow_component() -> None:
    weights, means, stds = fit_mixture(*counted(LAWS["one value"]()))
    inner = weights > 0.01
    np.testing.assert_allclose(means[inner], 0.25, atol=1e-3)
    assert stds[inner].max() < 0.01


def test_statistics_of_a_dataset_are_those_of_its_training_maps(
    stakes: TerrainDataset, fitted: GroundStatistics
) -> None:
    maps = stakes.read(
        "train", fields=("traversability", "rgb", "elevation_m", "slope_deg")
    )
    parameters = (
        np.array(values) for values in (fitted.weights, fitted.means, fitted.stds)
    )
    assert gap(*parameters, maps["traversability"].ravel()) < 0.01
    np.testing.assert_allclose(
        fitted.layer_means["rgb"], maps["rgb"].mean((0, 2, 3)), atol=1e-5
    )
    for name in ("elevation_m", "slope_deg"):
        np.testing.assert_allclose(
            fitted.layer_means[name], maps[name].astype(float).mean(), atol=1e-5
        )
    assert fitted.look_alikes == (
        ("packed_soil", "crusted_soil"),
        ("firm_sand", "drift_sand"),
    )
    assert fitted.potts_strength > 1
    given = fitted.mixture((1, 1, 1), torch.zeros(1, dtype=torch.float64))
    assert float(given.cdf(0.0)) == pytest.approx(
        (maps["traversability"] == 0).mean(), abs=0.01
    )


def test_layers_of_the_dataset_are_among_the_means_by_what_is_known_of_them(
    tmp_path: Path,
) -> None:
    recipe = replace(
        load_recipe("vegetation-v1"), id="grown", height=32, width=32, class_periods_m=(6, 3),
        places=small_stakes().places, splits={"train": Split(scenario="std", maps=2)},
    )  # fmt: skip
    dataset = TerrainDataset(tiny_dataset(tmp_path / "grown.h5", recipe))
    stored = dataset.read("train", fields=("vegetation_m",))["vegetation_m"]
    np.testing.assert_allclose(
        fit_ground(dataset).layer_means["vegetation_m"], stored.mean(), atol=1e-5
    )


def test_colours_of_their_own_are_no_look_alikes() -> None:
    assert look_alike_pairs(load_recipe("paper-v1")) == []
    assert look_alike_pairs(load_recipe("stakes-v1")) == [(2, 10), (8, 11)]


def gibbs(
    strength: float, field: float, maps: int = 16, side: int = 48, sweeps: int = 100
) -> np.ndarray:
    """Labels of P(x) ∝ exp(h·#a + β·#(neighbours alike)), by Gibbs sampling on the two
    colours of a chessboard.
    """
    random = np.random.default_rng(0)
    is_a = random.random((maps, side, side)) < 0.5
    black = np.indices((side, side)).sum(0) % 2 == 0
    for _ in range(sweeps):
        for colour in (black, ~black):
            sign = np.pad(np.where(is_a, 1, -1), ((0, 0), (1, 1), (1, 1)))
            around = (
                sign[:, :-2, 1:-1]
                + sign[:, 2:, 1:-1]
                + sign[:, 1:-1, :-2]
                + sign[:, 1:-1, 2:]
            )
            chance = 1 / (1 + np.exp(-(field + strength * around)))
            is_a = np.where(colour, random.random(is_a.shape) < chance, is_a)
    return np.where(is_a, 3, 5)


@pytest.mark.parametrize(("strength", "field"), [(0.0, 0.3), (0.4, 0.0), (0.7, -0.1)])
def test_the_strength_of_a_sampled_field_is_found(
    strength: float, field: float
) -> None:
    labels = gibbs(strength, field)
    labels[:, :, 20:22] = 7  # of neither class: a wall that counts on no side
    counts = count_neighbours(labels, (3, 5))
    assert fit_potts_strength(counts[None]) == pytest.approx(strength, abs=0.03)


def test_pairs_share_a_strength_and_have_fields_of_their_own() -> None:
    counts = np.stack(
        [count_neighbours(gibbs(0.4, field), (3, 5)) for field in (0.6, -0.6)]
    )
    assert fit_potts_strength(counts) == pytest.approx(0.4, abs=0.03)
    assert abs(fit_potts_strength(counts.sum(0)[None]) - 0.4) > 0.05


def test_neighbours_are_counted_by_the_four_beside_a_cell() -> None:
    a, b, other = 1, 2, 0
    labels = np.array([[[other, a, other], [b, a, a], [other, b, b]]])
    counts = count_neighbours(labels, (a, b))
    # (0, 1): a below. (1, 1): a above and right, b left and below. (1, 2): a left, b
    # below. (1, 0): a right.
    assert counts[4 + 1, 1] == 1
    assert counts[4, 1] == 2
    assert counts[4 + 1, 0] == 1
    assert counts.sum() == 6


def test_classes_that_never_mix_have_a_finite_strength() -> None:
    labels = np.zeros((1, 8, 8), dtype=int)
    labels[:, :, 4:] = 1
    assert 1 < fit_potts_strength(count_neighbours(labels, (0, 1))[None]) < 100


def test_a_dataset_without_observed_traversability_has_no_statistics(
    stakes: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = TerrainDataset.read

    def blind(self: TerrainDataset, *given: object) -> dict[str, np.ndarray]:
        maps = read(self, *given)  # type: ignore[arg-type]
        return maps | {"traversability": np.full_like(maps["traversability"], np.nan)}

    monkeypatch.setattr(TerrainDataset, "read", blind)
    with pytest.raises(DatasetError, match="cells with traversability"):
        fit_ground(stakes)


def test_statistics_beside_a_dataset_come_before_those_of_a_shipped_recipe(
    tmp_path: Path,
) -> None:
    recipe = load_recipe("stakes-v1")
    sibling = replace(
        recipe,
        id="stakes-v1-seed1",
        seed=1,
        splits={"test/hg": Split(scenario="hg", maps=1)},
    )
    dataset = TerrainDataset(tiny_dataset(tmp_path / "sibling.h5", sibling))
    shipped = GroundStatistics.from_json(
        (RECIPES / "ground" / "stakes-v1.json").read_text()
    )
    assert find_ground(dataset) == shipped
    own = replace(shipped, potts_strength=0.5)
    ground_file(dataset.path).write_text(own.to_json())
    assert find_ground(dataset) == own


def test_another_ground_is_none_of_a_shipped_recipe(stakes: TerrainDataset) -> None:
    assert find_ground(stakes) is None


def test_a_folder_of_files_has_its_statistics_beside_it() -> None:
    assert ground_file(Path("a/maps.v2")) == Path("a/maps.v2.ground.json")
    assert ground_file(Path("a/maps.h5")) == Path("a/maps.ground.json")


def test_every_shipped_recipe_with_training_maps_has_statistics() -> None:
    with_train = {
        name for name in shipped_recipes() if "train" in load_recipe(name).splits
    }
    assert {path.stem for path in (RECIPES / "ground").glob("*.json")} == with_train


def test_a_shipped_file_is_what_the_command_makes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    datagen = partial(call, "datagen")
    assert datagen("create", "tiny-v1", "--splits", "[train]", "--out", "tiny.h5") == 0
    assert datagen("ground", "tiny.h5") == 0
    assert "wrote tiny.ground.json: λ of 40 maps" in capsys.readouterr().out
    made, shipped = (
        json.loads(path.read_text())
        for path in (Path("tiny.ground.json"), RECIPES / "ground" / "tiny-v1.json")
    )
    assert made.keys() == shipped.keys()
    for name in ("weights", "means", "stds"):
        assert made[name] == pytest.approx(shipped[name], abs=1e-3)
    assert datagen("ground", "tiny.h5") == 2
    assert "--overwrite" in capsys.readouterr().err
    assert datagen("ground", "tiny.h5", "--overwrite") == 0
    assert datagen("ground", "tiny.h5", "--out", "tiny.txt") == 2
