from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from benchnav import ConfigError, Terrain
from benchnav.core import registry
from benchnav.planning import (
    Appearance,
    Contact,
    Full,
    Measurement,
    Near,
    NoiseKey,
    Probe,
    Sensor,
)
from benchnav.testing import check_sensor
from tests.testing.refusal import refusal

Change = Callable[[Measurement, Terrain, Tensor, NoiseKey], Any]


def telling(good: Sensor, change: Change) -> Sensor:
    """A good sensor, but for what it tells."""

    class Bad(Sensor):
        def sense(
            self,
            terrain: Terrain,
            field: Tensor,
            robot_state: Tensor,
            noise_key: NoiseKey,
        ) -> Measurement:
            return change(
                good.sense(terrain, field, robot_state, noise_key),
                terrain,
                field,
                noise_key,
            )  # type: ignore[no-any-return]

    return Bad()


def given(terrain: Callable[[Terrain], Terrain], good: Sensor | None = None) -> Sensor:
    """A good sensor on another terrain than the true one."""

    class Bad(Sensor):
        def sense(
            self,
            truth: Terrain,
            field: Tensor,
            robot_state: Tensor,
            noise_key: NoiseKey,
        ) -> Measurement:
            return (good or Near()).sense(terrain(truth), field, robot_state, noise_key)

    return Bad()


def moved(
    noise_key: Callable[[NoiseKey], NoiseKey], good: Sensor | None = None
) -> Sensor:
    """A good sensor with other noise."""

    class Bad(Sensor):
        def sense(
            self, terrain: Terrain, field: Tensor, robot_state: Tensor, given: NoiseKey
        ) -> Measurement:
            return (good or Probe()).sense(
                terrain, field, robot_state, noise_key(given)
            )

    return Bad()


def probing(change: Callable[[Tensor, Terrain, Tensor, NoiseKey], Tensor]) -> Sensor:
    return telling(
        Probe(),
        lambda sensed, terrain, field, noise_key: replace(
            sensed,
            traversability=change(sensed.traversability, terrain, field, noise_key),
        ),
    )


def looking(change: Callable[[Appearance], Any]) -> Sensor:
    return telling(
        Near(),
        lambda sensed, *_: (
            replace(sensed, appearance=change(sensed.appearance))
            if sensed.appearance
            else sensed
        ),
    )


def seeing(**change: Callable[[Any], Any]) -> Sensor:
    """Near, but for what its observation holds."""
    return looking(
        lambda look: replace(
            look,
            observation=replace(
                look.observation,
                **{
                    name: other(getattr(look.observation, name))
                    for name, other in change.items()
                },
            ),
        )
    )


def blurred(values: Tensor) -> Tensor:
    return torch.nn.functional.avg_pool2d(
        values.float(), 3, 1, 1, count_include_pad=False
    )


class Forgetful(Sensor):
    """Noise of the sensor's own count."""

    asked = 0

    def sense(
        self, terrain: Terrain, field: Tensor, robot_state: Tensor, noise_key: NoiseKey
    ) -> Measurement:
        self.asked += 1
        return Probe().sense(
            terrain, field, robot_state, NoiseKey(noise_key.keys, self.asked)
        )


class Ray(Sensor):
    """Sees a cell beside the robot where the one between, which it never reports, is
    low.
    """

    def sense(
        self, terrain: Terrain, field: Tensor, robot_state: Tensor, noise_key: NoiseKey
    ) -> Measurement:
        seen = torch.zeros_like(field, dtype=torch.bool)
        seen[:, 5, 5] = terrain.elevation_m[:, 5, 4] > -1.2
        noise_level = torch.zeros_like(field)
        return Measurement.of_appearance(
            Appearance(
                seen=seen, observation=terrain.observe(), noise_level=noise_level
            )
        )


class Seer(Full):
    sees_all = "yes"  # type: ignore[assignment]


def drawn(values: Tensor, *seed: int) -> Tensor:
    """Noise from a generator of the sensor's own."""
    return torch.rand(values.shape, generator=torch.Generator().manual_seed(sum(seed)))


ELSEWHERE = "its distribution and the class in cells that are not measured, got a different measurement."
APPEARANCE = "does not depend on colour, slope and layers in unobserved cells, got a different measurement."
ELEVATION = (
    "does not depend on the elevation of unobserved cells, got a different measurement."
)
ALONE = "do not depend on the other episodes of the batch or on their order, got different results."
BAD: dict[str, tuple[Any, str]] = {
    "senses nothing": (
        probing(lambda found, *_: torch.nan * found),
        "to observe a cell for a robot in the middle of a map, got no cell",
    ),
    **{
        f"knows {name} of the map": (
            telling(
                Probe(),
                lambda sensed, terrain, field, *_, of=of: replace(
                    sensed, std=sensed.std * (1 + of(terrain, field)[:, None, None])
                ),
            ),
            ELSEWHERE,
        )
        for name, of in {
            "mean λ": lambda terrain, field: field.mean((1, 2)),
            "greatest λ": lambda terrain, field: field.amax((1, 2)),
            "mean of the truth": lambda terrain, field: terrain.truth.mean().mean(
                (1, 2)
            ),
            "best of the truth": lambda terrain, field: terrain.truth.mean().amax(
                (1, 2)
            ),
            "spread of the truth": lambda terrain, field: terrain.truth.stds.mean(
                (1, 2, 3)
            ),
            "stored λ": lambda terrain, field: terrain.traversability.mean((1, 2)),
        }.items()
    },
    "no sensor": (3, "an instance of benchnav.planning.Sensor, got int"),
    "raises": (
        probing(lambda found, *_: found[99]),
        "Expected a result from `sense`, got IndexError",
    ),
    "says nothing": (
        telling(Probe(), lambda *_: None),
        "a Measurement from `sense`, got NoneType",
    ),
    "λ of a cell": (
        probing(lambda found, *_: found[:, 0]),
        "`Measurement.traversability` as torch.float32 of shape [4, 24, 24]",
    ),
    "float64": (
        probing(lambda found, *_: found.double()),
        "`Measurement.traversability` as torch.float32",
    ),
    "λ above 1": (probing(lambda found, *_: found + 1), "Expected λ in [0, 1]"),
    "too sure": (
        telling(Probe(), lambda sensed, *_: replace(sensed, std=0 * sensed.std)),
        "`Measurement.std` ≥ 0.001",
    ),
    "never sure": (
        telling(Probe(), lambda sensed, *_: replace(sensed, std=sensed.std / 0)),
        "`Measurement.std` ≥ 0.001",
    ),
    "sees all, it says": (Seer(), "Expected `sees_all` of type bool, got 'yes'"),
    "no appearance": (
        looking(lambda look: 3),
        "Expected `Measurement.appearance` as an Appearance",
    ),
    "seen in part": (
        looking(lambda look: replace(look, seen=look.seen.float())),
        "`Appearance.seen` as torch.bool",
    ),
    "doubt of a map": (
        looking(lambda look: replace(look, noise_level=look.noise_level[:, 0])),
        "`Appearance.noise_level` as torch.float32",
    ),
    "doubt below 0": (
        looking(lambda look: replace(look, noise_level=-look.noise_level)),
        "Expected `Appearance.noise_level` ≥ 0",
    ),
    "elevation unknown": (
        seeing(elevation_m=lambda height: height / 0),
        "Expected finite elevation in",
    ),
    "a layer less": (
        seeing(layers=lambda layers: {}),
        "and layers vegetation_m, got",
    ),
    "λ around": (
        probing(
            lambda found, terrain, field, _: torch.where(
                found.isnan(), found, blurred(field)
            )
        ),
        ELSEWHERE,
    ),
    "λ farther on": (
        telling(
            Contact(),
            lambda sensed, terrain, field, _: replace(
                sensed,
                traversability=(
                    sensed.traversability + 0.1 * field.mean((1, 2), keepdim=True)
                )
                / 1.1,
            ),
        ),
        ELSEWHERE,
    ),
    "λ of the dataset": (
        probing(
            lambda found, terrain, *_: (
                0.9 * found + 0.1 * terrain.traversability.amax((1, 2), keepdim=True)
            )
        ),
        ELSEWHERE,
    ),
    "where ground is good": (
        telling(
            Near(),
            lambda sensed, _, field, __: Measurement.of_appearance(
                replace(sensed.appearance, seen=sensed.appearance.seen & (field > 0.5))
            ),
        ),
        ELSEWHERE,
    ),
    "colour tells the class": (
        given(
            lambda terrain: replace(
                terrain, rgb=terrain.rgb + terrain.class_id[:, None].to(torch.uint8)
            )
        ),
        ELSEWHERE,
    ),
    "what all is like": (
        probing(
            lambda found, terrain, *_: (
                found * (0.5 + terrain.truth.means[:, 1].mean((1, 2), keepdim=True) / 2)
            )
        ),
        ELSEWHERE,
    ),
    "blurred colours": (
        given(
            lambda terrain: replace(terrain, rgb=blurred(terrain.rgb).to(torch.uint8))
        ),
        APPEARANCE,
    ),
    "colours around λ": (
        probing(
            lambda found, terrain, *_: (
                found * (0.5 + terrain.rgb.float().mean((1, 2, 3))[:, None, None] / 510)
            )
        ),
        APPEARANCE,
    ),
    "layers around": (
        given(
            lambda terrain: replace(
                terrain,
                layers={name: blurred(layer) for name, layer in terrain.layers.items()},
            )
        ),
        APPEARANCE,
    ),
    "steepest slope": (
        telling(
            Near(),
            lambda sensed, terrain, *_: Measurement.of_appearance(
                replace(
                    sensed.appearance,
                    noise_level=sensed.appearance.noise_level
                    + terrain.slope_deg.amax((1, 2), keepdim=True),
                )
            ),
        ),
        APPEARANCE,
    ),
    "blurred elevation": (
        given(
            lambda terrain: replace(terrain, elevation_m=blurred(terrain.elevation_m))
        ),
        ELEVATION,
    ),
    "a ray": (Ray(), ELEVATION),
    "the batch's mean": (
        given(
            lambda terrain: replace(
                terrain, elevation_m=terrain.elevation_m - terrain.elevation_m.mean(0)
            )
        ),
        ALONE,
    ),
    "noise of the batch": (
        probing(lambda found, *_: (found + 0.2 * drawn(found)).clamp(max=1)),
        ALONE,
    ),
    "keys of the first": (
        moved(
            lambda noise_key: NoiseKey(
                [noise_key.keys[0]] * len(noise_key.keys), noise_key.step
            )
        ),
        ALONE,
    ),
    "noise of the count": (
        Forgetful(),
        "Expected the same measurement when called again, got a different measurement.",
    ),
    "the same in each step": (
        moved(lambda noise_key: NoiseKey(noise_key.keys, 0)),
        "Expected different noise in different steps",
    ),
    "colours the same in each step": (
        moved(lambda noise_key: NoiseKey(noise_key.keys, 0), Near()),
        "Expected different noise in different steps",
    ),
    "the same in each episode": (
        moved(lambda noise_key: NoiseKey([7] * len(noise_key.keys), noise_key.step)),
        "Expected different noise in different episodes",
    ),
    "PyTorch's generator": (
        probing(lambda found, *_: found + 0 * torch.rand(1)),
        "PyTorch's global generator",
    ),
    "writes into λ": (
        probing(lambda found, _, field, __: (field.zero_(), found)[1]),
        "got changes in field",
    ),
    "writes into the terrain": (
        probing(lambda found, terrain, *_: (terrain.rgb.zero_(), found)[1]),
        "got changes in terrain.rgb",
    ),
}


@pytest.mark.parametrize(("sensor", "expected"), BAD.values(), ids=BAD.keys())
def test_a_breach_is_caught_and_named(sensor: Any, expected: str) -> None:
    assert expected in refusal(check_sensor, sensor)


@pytest.mark.parametrize(
    "sensor",
    [
        *registry.names("sensor"),
        *registry.names("ground"),
        "near:20",
        "probe:3",
        {"part": "probe", "options": {"noise_std": 0.5}},
        Near(fov_deg=70.0, height_m=0.2, colour_noise=40.0),
        Near(colour_noise=0.0, elevation_noise=0.0),
    ],
    ids=str,
)
def test_shipped_sensors_keep_the_contract(sensor: Any) -> None:
    check_sensor(sensor)


def test_a_line_of_sight_may_be_barred_by_what_is_not_seen_where_that_is_said() -> None:
    check_sensor(Ray(), sinks=False)


def test_each_breach_is_told_once_with_its_places() -> None:
    with pytest.raises(ConfigError) as caught:
        check_sensor(probing(lambda found, *_: found + 1), shapes=[(9, 8)])
    assert str(caught.value).split("\n")[1:] == [
        "(1) Expected λ in [0, 1], or NaN in cells that are not measured, got other numbers. [in all cases]"
    ]
