from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional

from benchnav.core.errors import ConfigError
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Observation
from benchnav.models.base import TraversabilityModel, predict_observation
from benchnav.models.predictor import load_model
from benchnav.models.tiles import Window, measure_margin, predict_tiles, write_risk_maps
from tests.models.stub import ColourModel


def observe(
    height: int, width: int, maps: int = 1, block: int = 1, seed: int = 0
) -> Observation:
    """Random maps in blocks of one colour and slope."""
    generator = torch.Generator().manual_seed(seed)
    rows, columns = torch.arange(height)[:, None] // block, torch.arange(width) // block
    shape = (maps, 3, height // block + 1, width // block + 1)
    rgb = torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)[
        ..., rows, columns
    ]
    slope = 30 * torch.rand(maps, *shape[2:], generator=generator)[..., rows, columns]
    return Observation(rgb, slope / 10, slope, Grid(height, width, 0.5))


class Blur(TraversabilityModel):
    """Looks so many cells up and left, down and right; keeps the sizes of the maps that
    it was given.
    """

    def __init__(self, before: int, after: int) -> None:
        self.before, self.after, self.seen = before, after, list[tuple[int, int]]()

    def predict(self, observation: Observation) -> TraversabilityMixture:
        self.seen.append(observation.grid.shape)
        image = observation.rgb[:, :1].double() / 255
        padded = functional.pad(image, (self.before, self.after) * 2)
        side = self.before + self.after + 1
        mean = functional.avg_pool2d(
            functional.avg_pool2d(padded, (side, 1), 1), (1, side), 1
        )
        return TraversabilityMixture(
            torch.ones_like(mean), mean, torch.full_like(mean, 0.1)
        )


class Pool(TraversabilityModel):
    """Gives every cell the mean of its block, whose side is the stride."""

    def __init__(self, stride: int) -> None:
        self.stride = stride

    def predict(self, observation: Observation) -> TraversabilityMixture:
        image = observation.slope_deg.double()[:, None] / 90
        mean = functional.avg_pool2d(image, self.stride, ceil_mode=True)
        mean = mean.repeat_interleave(self.stride, -1).repeat_interleave(
            self.stride, -2
        )
        mean = mean[..., : image.shape[-2], : image.shape[-1]]
        return TraversabilityMixture(
            torch.ones_like(mean), mean, torch.full_like(mean, 0.1)
        )


def greatest_error(
    model: TraversabilityModel,
    observation: Observation,
    tile: int,
    margin: int | None = None,
) -> float:
    """Of any parameter of any tile, to the whole map's; every cell has to be in one
    tile.
    """
    whole = predict_observation(model, observation)
    count, error = torch.zeros(observation.grid.shape), 0.0
    for window, part in predict_tiles(model, observation, tile, margin):
        count[window] += 1
        for name in ("weights", "means", "stds"):
            there = getattr(whole, name)[..., *window]
            error = max(error, float((getattr(part, name) - there).abs().max()))
        assert part.group == whole.group
    assert (count == 1).all()
    return error


@pytest.mark.parametrize(
    ("name", "margin", "size", "tile"),
    [("stakes-v1", 96, (331, 517), 128), ("paper-v1", 288, (77, 717), 320)],
)
def test_tiles_of_a_network_are_the_whole_maps(
    name: str, margin: int, size: tuple[int, int], tile: int
) -> None:
    """Of a ResNet-18 U-Net 72 cells are in reach at depth 3 and 288 at depth 5."""
    model, observation = load_model(name), observe(*size, block=8)
    assert measure_margin(model, observation) == margin
    assert greatest_error(model, observation, tile, margin) < 1e-5
    assert greatest_error(model, observation, tile, margin // 3) > 1e-4


@settings(max_examples=25, deadline=None)
@given(
    height=st.integers(3, 300),
    width=st.integers(3, 300),
    tile=st.integers(64, 200),
    reach=st.tuples(st.integers(0, 40), st.integers(0, 40)),
)
def test_tiles_cover_any_map_and_are_the_whole_maps(
    height: int, width: int, tile: int, reach: tuple[int, int]
) -> None:
    model, observation = Blur(*reach), observe(height, width, maps=2)
    assert greatest_error(model, observation, tile, max(reach)) < 1e-12
    for window, part in predict_tiles(model, observation, tile, 0):
        sides = [cells.stop - cells.start for cells in window]
        assert max(sides) <= tile
        assert part.weights.shape == (2, 1, *sides)


@pytest.mark.parametrize(
    ("before", "after", "margin"),
    [
        (0, 0, 0),
        (1, 0, 32),
        (0, 1, 32),
        (32, 5, 32),
        (5, 33, 64),
        (100, 0, 128),
        (0, 180, 192),
        (200, 230, 256),
    ],
)
def test_the_margin_is_as_wide_as_the_model_looks_on_any_side(
    before: int, after: int, margin: int
) -> None:
    assert measure_margin(Blur(before, after), observe(40, 300)) == margin


def test_a_model_that_looks_at_each_cell_alone_needs_no_margin() -> None:
    model, observation = ColourModel(), observe(200, 150)
    assert measure_margin(model, observation) == 0
    assert greatest_error(model, observation, 64) < 1e-6


def test_one_tile_is_the_map_itself_and_measures_nothing() -> None:
    model = Blur(3, 3)
    ((window, _),) = predict_tiles(model, observe(100, 80), 128)
    assert window == Window(slice(0, 100), slice(0, 80))
    assert model.seen == [(100, 80)]


def test_tiles_are_predicted_when_they_are_asked_for_with_their_margin_alone() -> None:
    model = Blur(3, 3)
    tiles = predict_tiles(model, observe(256, 128), 128, 5)
    assert model.seen == []
    next(tiles)
    assert model.seen == [(160, 128)]
    assert [window.rows.start for window, _ in tiles] == [128]
    assert model.seen == [(160, 128), (160, 128)]


@pytest.mark.parametrize("stride", [2, 8, 32])
def test_tiles_begin_where_the_pools_of_a_network_do(stride: int) -> None:
    observation = observe(150, 333)
    assert measure_margin(Pool(stride), observation) <= 32
    for tile in (70, 96, 128):
        assert greatest_error(Pool(stride), observation, tile, 0) < 1e-12


class Picky(Blur):
    """Looks around where a row is of one colour, or where it is not."""

    def __init__(self, smooth: bool) -> None:
        super().__init__(40, 40)
        self.smooth = smooth

    def predict(self, observation: Observation) -> TraversabilityMixture:
        mixture, image = (
            super().predict(observation),
            observation.rgb[:, :1].double() / 255,
        )
        most, least = (
            sign * functional.max_pool2d(sign * image, (1, 9), 1, (0, 4))
            for sign in (1, -1)
        )
        means = torch.where((most == least) == self.smooth, mixture.means, image)
        return TraversabilityMixture(mixture.weights, means, mixture.stds)


@pytest.mark.parametrize("smooth", [True, False])
def test_a_model_is_tried_on_ground_as_it_lies_and_on_cells_from_all_over_the_map(
    smooth: bool,
) -> None:
    observation = observe(300, 500, block=64) if smooth else observe(300, 500)
    if not smooth:
        observation.rgb[..., 10:-10, 10:-10] = 80
    assert measure_margin(Picky(smooth), observation) == 64


class Everywhere(Blur):
    """Takes the mean of the map away."""

    def predict(self, observation: Observation) -> TraversabilityMixture:
        mixture = super().predict(observation)
        means = mixture.means - mixture.means.mean((-2, -1), keepdim=True)
        return TraversabilityMixture(mixture.weights, means, mixture.stds)


@pytest.mark.parametrize("model", [Everywhere(0, 0), Pool(64)])
def test_a_model_whose_tiles_cannot_be_the_whole_maps_is_refused(
    model: TraversabilityModel,
) -> None:
    with pytest.raises(
        ConfigError, match=rf"960 cells.*{type(model).__name__}.*`margin`"
    ):
        predict_tiles(model, observe(200, 200), 64)


class Unsure(Blur):
    """Knows nothing of dark ground."""

    def predict(self, observation: Observation) -> TraversabilityMixture:
        mixture = super().predict(observation)
        means = torch.where(mixture.means < 0.5, torch.nan, mixture.means)
        return TraversabilityMixture(mixture.weights, means, mixture.stds)


def test_cells_that_are_not_a_number_both_ways_do_not_differ() -> None:
    assert measure_margin(Unsure(0, 0), observe(60, 60)) == 0
    assert measure_margin(Unsure(7, 0), observe(60, 60)) == 32


class Noisy(Blur):
    """Rounds by the size of the map, as other kernels would."""

    def predict(self, observation: Observation) -> TraversabilityMixture:
        mixture = super().predict(observation)
        off = 1e-7 * observation.grid.width / 32
        return TraversabilityMixture(mixture.weights, mixture.means + off, mixture.stds)


def test_rounding_is_told_from_what_a_model_sees() -> None:
    assert measure_margin(Noisy(40, 3), observe(60, 60)) == 64


@dataclass(frozen=True)
class Layered(Observation):
    layers: Mapping[str, Tensor] = field(default_factory=dict)


class Vegetation(TraversabilityModel):
    def predict(self, observation: Observation) -> TraversabilityMixture:
        assert isinstance(observation, Layered)
        height = observation.layers["vegetation_m"].unsqueeze(1)
        return TraversabilityMixture(
            torch.ones_like(height), height, torch.full_like(height, 0.1)
        )


def test_layers_are_cut_with_the_map() -> None:
    plain = observe(130, 200)
    layers = {
        "vegetation_m": torch.rand(
            1, 130, 200, generator=torch.Generator().manual_seed(1)
        )
    }
    observation = Layered(
        plain.rgb, plain.elevation_m, plain.slope_deg, plain.grid, layers
    )
    assert greatest_error(Vegetation(), observation, 64) == 0


def test_risk_maps_are_those_of_the_whole_map(tmp_path: Path) -> None:
    model, observation = ColourModel(), observe(90, 200, maps=2)
    measures = {
        "cvar:0.9": lambda mixture: mixture.cvar(0.9),
        "mean": TraversabilityMixture.mean,
    }
    paths = write_risk_maps(model, observation, measures, tmp_path / "maps", tile=64)
    assert paths == {
        "cvar:0.9": tmp_path / "maps/cvar-0.9.npy",
        "mean": tmp_path / "maps/mean.npy",
    }
    whole = predict_observation(model, observation)
    for name, measure in measures.items():
        written = np.load(paths[name], mmap_mode="r")
        assert (written.dtype, written.shape) == (np.float32, (2, 90, 200))
        np.testing.assert_allclose(written, measure(whole), atol=1e-6)


def test_tile_and_margin_of_risk_maps_are_those_given(tmp_path: Path) -> None:
    model = Blur(0, 0)
    write_risk_maps(
        model,
        observe(128, 256),
        {"mean": TraversabilityMixture.mean},
        tmp_path,
        128,
        32,
    )
    assert model.seen == [(128, 160), (128, 160)]


def test_risk_maps_are_written_whole_or_not_at_all(tmp_path: Path) -> None:
    model, observation = ColourModel(), observe(128, 70)
    write_risk_maps(
        model, observation, {"mean": TraversabilityMixture.mean}, tmp_path, tile=64
    )
    before = (tmp_path / "mean.npy").read_bytes()
    bad = {
        "mean": TraversabilityMixture.mean,
        "row": lambda mixture: mixture.mean()[..., 0],
    }
    with pytest.raises(
        ConfigError, match=r"measure 'row' to return a tensor of shape \[1, 64, 32\]"
    ):
        write_risk_maps(model, observe(128, 70, seed=1), bad, tmp_path, tile=64)
    assert [path.name for path in tmp_path.iterdir()] == ["mean.npy"]
    assert (tmp_path / "mean.npy").read_bytes() == before
    same = {"a:b": TraversabilityMixture.mean, "a-b": TraversabilityMixture.mean}
    with pytest.raises(ConfigError, match="different file names"):
        write_risk_maps(model, observation, same, tmp_path, tile=64)


class Small(Blur):
    """Answers with a row less."""

    def predict(self, observation: Observation) -> TraversabilityMixture:
        mixture = super().predict(observation)
        return TraversabilityMixture(
            mixture.weights[..., 1:, :],
            mixture.means[..., 1:, :],
            mixture.stds[..., 1:, :],
        )


def test_bad_settings_and_answers_are_named() -> None:
    observation = observe(100, 100)
    with pytest.raises(ConfigError, match=r"`tile` of at least 64 cells, got 63"):
        predict_tiles(ColourModel(), observation, 63)
    with pytest.raises(ConfigError, match=r"`margin` of at least 0 cells, got -1"):
        predict_tiles(ColourModel(), observation, margin=-1)
    with pytest.raises(ConfigError, match=r"\[1, 64, 64\]"):
        next(predict_tiles(Small(0, 0), observation, 64, 0))
    with pytest.raises(ConfigError, match="Terrain for the privileged model Oracle"):
        next(predict_tiles(load_model("oracle"), observation, 64, 0))
