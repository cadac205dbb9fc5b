import json

import pytest
import torch

from benchnav.core.errors import ConfigError
from benchnav.core.ground import GroundStatistics

GROUND = GroundStatistics(
    weights=(0.25, 0.75),
    means=(0.2, 0.7),
    stds=(0.1, 0.05),
    layer_means={"rgb": (1.0, 2.0, 3.0), "elevation_m": (0.5,), "slope_deg": (4.0,)},
    look_alikes=(("a", "b"),),
    potts_strength=1.5,
)


def test_a_round_trip_gives_the_same_statistics() -> None:
    assert GroundStatistics.from_json(GROUND.to_json()) == GROUND


def test_the_mixture_is_the_same_in_every_cell() -> None:
    mixture = GROUND.mixture((2, 3, 4), torch.zeros(1, dtype=torch.float64))
    assert mixture.shape == (2, 3, 4)
    torch.testing.assert_close(
        mixture.mean(),
        torch.full((2, 3, 4), 0.575, dtype=torch.float64),
        atol=0.01,
        rtol=0,
    )


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("{", "JSONDecodeError"),
        ("[]", "TypeError"),
        ('{"format": "other"}', "'other'"),
        ('{"format": "benchnav-ground-1"}', "'layer_means'"),
        (json.dumps(json.loads(GROUND.to_json()) | {"stds": [1.0]}), "2, 2 and 1"),
        (
            json.dumps(json.loads(GROUND.to_json()) | {"stds": [1.0, -1.0]}),
            "`stds` ≥ 0",
        ),
        (
            json.dumps(json.loads(GROUND.to_json()) | {"weights": [0.3, 0.3]}),
            "sum to 1",
        ),
        (
            json.dumps(json.loads(GROUND.to_json()) | {"layer_means": {"rgb": [1.0]}}),
            "numbers of channels",
        ),
    ],
)
def test_what_is_no_statistics_is_refused_in_one_line(text: str, named: str) -> None:
    with pytest.raises(ConfigError, match=named) as refused:
        GroundStatistics.from_json(text)
    assert "\n" not in str(refused.value)
