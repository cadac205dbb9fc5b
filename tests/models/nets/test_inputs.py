import math

import pytest
import torch

from benchnav.core.errors import ConfigError
from benchnav.models.nets.inputs import InputStack, LayerScale, check_inputs


def one(mean: float, std: float) -> LayerScale:
    return LayerScale(torch.tensor([mean]), torch.tensor([std]), torch.ones(()))


def test_layers_become_scaled_channels_in_the_order_of_their_names() -> None:
    scale = {
        "rgb": LayerScale(
            torch.tensor([10.0, 20, 30]), torch.tensor([1.0, 2, 4]), torch.ones(())
        ),
        "elevation_m": one(100, 5),
        "wind_azimuth_deg": LayerScale(torch.zeros(2), torch.ones(2), torch.ones(())),
    }
    maps = {
        "rgb": torch.tensor([12, 24, 34], dtype=torch.uint8)
        .view(1, 3, 1, 1)
        .expand(-1, -1, 1, 2),
        "elevation_m": torch.tensor([[[110.0, math.nan]]]),
        "wind_azimuth_deg": torch.tensor([[[90.0, 180.0]]]),
    }
    stack = InputStack(("elevation_m", "rgb", "wind_azimuth_deg"), scale)
    assert stack.channels == 6
    found = stack(maps)
    # what is missing stands at the mean
    expected = [
        [2, 0],
        [2, 2],
        [2, 2],
        [1, 1],
        [0, -1],
        [1, 0],
    ]
    torch.testing.assert_close(
        found[0, :, 0], torch.tensor(expected, dtype=torch.float32), rtol=0, atol=1e-6
    )
    again = InputStack(("elevation_m", "rgb", "wind_azimuth_deg"))
    again.load_state_dict(stack.state_dict())
    assert torch.equal(again(maps), found)


def test_scales_are_kept_whole_where_kernels_are_halved() -> None:
    """A mean of 2 345.678 m in half precision would be off by more than a metre."""
    assert all(
        value.ndim == 1 for value in InputStack(("elevation_m",)).state_dict().values()
    )


@pytest.mark.parametrize(
    ("inputs", "expected"),
    [
        ((), "at least one map layer, and none twice"),
        (("rgb", "rgb"), "at least one map layer, and none twice"),
        (("rgb", "vegetation"), "Did you mean 'vegetation_m'"),
        (("class_id",), "got 'class_id'"),
    ],
)
def test_inputs_that_maps_do_not_have_are_refused(
    inputs: tuple[str, ...], expected: str
) -> None:
    with pytest.raises(ConfigError, match=expected):
        check_inputs(inputs, ["rgb", "elevation_m", "slope_deg", "vegetation_m"])
