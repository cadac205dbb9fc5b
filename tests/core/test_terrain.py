from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from benchnav.core.batch import map_tensors
from benchnav.core.errors import ConfigError
from benchnav.core.grid import Grid
from benchnav.core.terrain import Observation, Terrain
from tests import factories


@given(st.integers(3, 20), st.integers(3, 20), st.floats(0.1, 3), st.data())
def test_a_position_lies_in_the_cell_it_is_looked_up_in(
    height: int, width: int, resolution: float, data
) -> None:
    grid = Grid(height, width, resolution)
    x = torch.tensor(
        [data.draw(st.floats(0.001, 0.999)) * width * resolution], dtype=torch.float64
    )
    y = torch.tensor(
        [data.draw(st.floats(0.001, 0.999)) * height * resolution], dtype=torch.float64
    )
    row, column = grid.cell_of(x, y)
    centre_x, centre_y = grid.centre_of(row, column)
    assert (centre_x - x).abs() <= resolution * 0.5001
    assert (centre_y - y).abs() <= resolution * 0.5001
    values = torch.arange(height * width, dtype=torch.float64).reshape(1, height, width)
    found = grid.lookup(grid.pad(values, -1.0), x[None], y[None])
    assert found.item() == (row * width + column).item()


def test_rows_are_y_and_off_the_map_is_outside() -> None:
    grid = Grid(4, 6, 0.5)
    values = torch.arange(24.0).reshape(1, 4, 6)
    padded = grid.pad(values, -7.0)
    x = torch.tensor([[0.2, 2.9, 0.2, -0.01, 3.0, 1.0, 1.0, float("nan"), 1e30]])
    y = torch.tensor([[0.2, 0.2, 1.9, 0.2, 0.2, -0.01, 2.0, 1.0, 1.0]])
    assert grid.lookup(padded, x, y).tolist() == [[0, 5, 18, -7, -7, -7, -7, -7, -7]]
    assert grid.contains(x, y)[0].tolist() == [True] * 3 + [False] * 6


def test_observation_holds_what_a_robot_sees_and_nothing_else() -> None:
    observation = factories.terrain(torch.rand(2, 16, 16)).observe()
    assert isinstance(observation, Observation)
    assert set(vars(observation)) == {
        "rgb",
        "elevation_m",
        "slope_deg",
        "grid",
        "layers",
    }
    assert observation.layers == {}


def test_layers_that_do_not_fit_are_named() -> None:
    good = factories.terrain(torch.rand(2, 16, 16)).observe()
    with pytest.raises(ConfigError, match="slope_deg"):
        Observation(good.rgb, good.elevation_m, good.slope_deg[:, 1:], good.grid)
    with pytest.raises(ConfigError, match="rgb"):
        Observation(good.rgb.float(), good.elevation_m, good.slope_deg, good.grid)
    with pytest.raises(ConfigError, match="resolution_m"):
        Grid(4, 4, -1)


def layered() -> Terrain:
    ground = factories.terrain(torch.rand(3, 16, 16))
    return replace(
        ground, layers={"moss": torch.rand(3, 16, 16), "dust": torch.rand(3, 16, 16)}
    )


def test_layers_go_with_their_maps() -> None:
    terrain, members = layered(), torch.tensor([2, 0, 2])
    for whole in (terrain, terrain.observe()):
        kept, copy = whole.select(members), whole.clone()
        assert list(kept.layers) == list(copy.layers) == ["moss", "dust"]
        for name in whole.layers:
            assert torch.equal(kept.layers[name], whole.layers[name][members])
            assert torch.equal(copy.layers[name], whole.layers[name])
            assert copy.layers[name].data_ptr() != whole.layers[name].data_ptr()
        assert whole.to("meta").layers["moss"].device.type == "meta"


def test_several_batches_are_changed_together_layer_by_layer() -> None:
    one, other = layered().observe(), layered().observe()
    joined = map_tensors(one, lambda first, second: torch.cat((first, second)), other)
    assert torch.equal(
        joined.layers["dust"], torch.cat((one.layers["dust"], other.layers["dust"]))
    )


@pytest.mark.parametrize(
    ("layers", "expected"),
    [
        (
            {"moss": torch.zeros(3, 16, 15)},
            "`moss` of shape [3, 16, 16], got [3, 16, 15]",
        ),
        (
            {"moss": torch.zeros(2, 16, 16)},
            "`moss` of shape [3, 16, 16], got [2, 16, 16]",
        ),
        ({"moss": torch.zeros(3, 16, 16).double()}, "layer `moss` as float32"),
        (
            {"slope_deg": torch.zeros(3, 16, 16)},
            "layer `slope_deg` as float32 with a unique name",
        ),
        (
            {"rgb": torch.zeros(3, 16, 16)},
            "layer `rgb` as float32 with a unique name",
        ),
    ],
)
def test_layers_fit_the_grid(layers: dict[str, torch.Tensor], expected: str) -> None:
    terrain = layered()
    for whole in (terrain, terrain.observe()):
        with pytest.raises(ConfigError) as caught:
            replace(whole, layers=layers)
        assert expected in str(caught.value)
