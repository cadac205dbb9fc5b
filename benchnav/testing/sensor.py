"""The check of appearance and traversability sensors on small generated hills.

Letters in shapes: B episodes; S state dimensions; H×W cells.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.core.batch import Batch, find_tensor_fault
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Observation, Terrain
from benchnav.planning.sensing.sensor import (
    MIN_STD,
    Appearance,
    Measurement,
    NoiseKey,
    Sensor,
)
from benchnav.testing.breaches import NOTHING, SEED, Breaches, same

_RESOLUTION_M = 0.5
_KEYS = (3, 14, 15, 92)
_OTHER_KEYS = (65, 35, 89, 79)
_STEPS = (0, 7)


def check_sensor(
    sensor: Any,
    shapes: Sequence[tuple[int, int]] = ((24, 24), (20, 33)),
    device: torch.device | str = "cpu",
    sinks: bool = True,
    tolerance: float = 1e-5,
) -> None:
    """Check that an appearance or traversability sensor fulfils its contract.

    One robot is in the middle of the map, two are at its borders, one is off the map.
    The contract:

    - at least one cell is observed;
    - the measurement has the shape, dtype and device of the λ field;
    - λ is in [0, 1], or NaN in cells without a measurement; its standard deviation is
      at least `MIN_STD`;
    - an `Appearance` has the layers of the terrain, and in observed cells a finite
      elevation and a noise level ≥ 0;
    - arguments and the global generators of Python, NumPy and PyTorch are unchanged;
    - the measurement is the same when repeated, and for selected episodes in any order
      as in the batch;
    - noise, if any, differs between episodes and steps.

    The measurement must not depend on the truth of unobserved cells. It must be the
    same if λ, its distribution and the class are replaced in cells without measured λ,
    and if colour, slope and layers are replaced in unobserved cells. It must also be
    the same if the elevation of unobserved cells is lowered by 1 to 3 m; it is not
    raised, since raised terrain may come into view. The robot's cell keeps its
    elevation, since the robot carries the sensor.

    Args:
        sensor: a sensor, or its name, file or mapping as in suites.
        shapes: (H, W) of the maps.
        device: device of the maps.
        sinks: whether elevation is lowered. Pass False for a sensor whose line of sight
            unobserved terrain may block, such as single rays to the centres of cells.
        tolerance: tolerance between values that should be equal for other arguments.

    Raises:
        ConfigError: If the sensor breaks the contract; the message lists all breaches.
    """
    name = sensor.get("part") if isinstance(sensor, Mapping) else sensor
    kind = "sensor"
    if isinstance(name, str):
        base_name, _, _ = name.partition(":")
        if base_name in registry.names("ground"):
            kind = "ground"
    new_sensor = registry.take(kind, sensor)
    breaches = Breaches("sensor", type(new_sensor).__name__)
    sees_all = new_sensor.sees_all
    is_bool = isinstance(sees_all, bool)
    breaches.expect(is_bool, f"Expected `sees_all` of type bool, got {sees_all!r}.")
    for height, width in shapes:
        hills = _create_hills(height, width, torch.device(device))
        for step in _STEPS:
            breaches.location = f"{height}×{width} in step {step}"
            check = _SensorCheck(new_sensor, hills, step, sinks, breaches, tolerance)
            check.run()
    breaches.raise_any()


@dataclass(frozen=True, kw_only=True)
class _Truth(Batch):
    """Arguments of `Sensor.sense`, except for the key of the noise."""

    terrain: Terrain
    field: Tensor
    robot_state: Tensor


@dataclass(frozen=True)
class _SensorCheck:
    """The check of a sensor in one step of four episodes."""

    sensor: Sensor
    truth: _Truth
    step: int
    sinks: bool
    breaches: Breaches
    tolerance: float

    def run(self) -> None:
        """Sense, then in ways that should have the same results except for noise."""
        sensed = self.sense(self.truth)
        if sensed is NOTHING:
            return
        appearance = sensed.appearance
        has_sensed = bool(sensed.mask.any())
        has_seen = appearance is not None and bool(appearance.seen.any())
        self.breaches.expect(
            has_sensed or has_seen,
            "Expected the sensor to observe a cell for a robot in the middle of a map, "
            "got no cell.",
        )
        reported = _reported_values(sensed)
        is_same = self.breaches.expect(
            self.is_alike(self.sense(self.truth), reported, 0),
            "Expected the same measurement when called again, got a different "
            "measurement.",
        )
        for indices in ([3], [2, 0]):
            members = torch.tensor(indices, device=self.truth.field.device)
            keys = [_KEYS[index] for index in indices]
            selected_measurement = self.sense(self.truth.select(members), keys)
            expected = tuple(values[members] for values in reported)
            self.breaches.expect(
                self.is_alike(selected_measurement, expected, self.tolerance),
                "Expected results of an episode that do not depend on the other "
                "episodes of the batch or on their order, got different results. Draw "
                "noise with `NoiseKey.normal`.",
            )
        if not is_same:
            return  # all further comparisons would fail
        for description, changed_truth in _with_replaced_values(
            self.truth, sensed, self.sinks
        ):
            self.breaches.expect(
                self.is_alike(self.sense(changed_truth), reported, self.tolerance),
                f"Expected a measurement that does not depend on {description}, got a "
                "different measurement. Use only the truth of observed cells.",
            )
        self.try_noise(sensed)

    def try_noise(self, sensed: Measurement) -> None:
        """Check that noise differs between episodes and between steps."""
        with_keys = self.sense(self.truth, _OTHER_KEYS)
        with_step = self.sense(self.truth, step=self.step + 1)
        by_key = with_keys is not NOTHING and _differ(sensed, with_keys)
        by_step = with_step is not NOTHING and _differ(sensed, with_step)
        self.breaches.expect(
            by_step or not by_key,
            "Expected different noise in different steps, got the same noise. Draw it "
            "with `NoiseKey.normal`.",
        )
        self.breaches.expect(
            by_key or not by_step,
            "Expected different noise in different episodes, got noise that differs "
            "only between steps. Draw it with `NoiseKey.normal`.",
        )

    def sense(
        self, truth: _Truth, keys: Sequence[int] = _KEYS, step: int | None = None
    ) -> Any:
        """Return the sensor's measurement, or `NOTHING` if it is invalid."""
        if step is None:
            step = self.step
        noise_key = NoiseKey(tuple(keys), step)
        answer = self.breaches.watch(
            "sense",
            lambda: self.sensor.sense(
                truth.terrain, truth.field, truth.robot_state, noise_key
            ),
            **vars(truth),
        )
        faults = [] if answer is NOTHING else list(_faults(answer, truth))
        for fault in faults:
            self.breaches.expect(False, fault)
        return NOTHING if faults else answer

    def is_alike(
        self, sensed: Any, expected: tuple[Tensor, ...], tolerance: float
    ) -> bool:
        """Return whether a measurement has the expected values, or is `NOTHING`."""
        return sensed is NOTHING or same(_reported_values(sensed), expected, tolerance)


def _faults(sensed: Any, truth: _Truth) -> Iterator[str]:
    """Yield a message for each fault of a measurement's types, shapes and values."""
    like = truth.field
    if not isinstance(sensed, Measurement):
        yield f"Expected a Measurement from `sense`, got {type(sensed).__name__}."
        return
    faults = [
        _tensor_fault("`Measurement.traversability`", sensed.traversability, like),
        _tensor_fault("`Measurement.std`", sensed.std, like),
    ]
    if any(faults):
        yield from filter(None, faults)
        return
    traversability = sensed.traversability[sensed.mask]
    in_range = (traversability >= 0) & (traversability <= 1)
    if not bool(in_range.all()):
        yield (
            "Expected λ in [0, 1], or NaN in cells that are not measured, got other "
            "numbers."
        )
    std = sensed.std[sensed.mask]
    is_valid = (std >= MIN_STD) & std.isfinite()
    if not bool(is_valid.all()):
        yield (
            f"Expected `Measurement.std` ≥ {MIN_STD:g} and finite in measured cells, "
            "got other values."
        )
    if sensed.appearance is not None:
        yield from _appearance_faults(sensed.appearance, truth)


def _appearance_faults(appearance: Any, truth: _Truth) -> Iterator[str]:
    is_appearance = isinstance(appearance, Appearance)
    if not is_appearance or not isinstance(appearance.observation, Observation):
        yield (
            "Expected `Measurement.appearance` as an Appearance whose `observation` is "
            "an Observation, got another type."
        )
        return
    like = truth.field
    expected = truth.terrain.observe()
    observation = appearance.observation
    layers = observation.layers
    has_layers = layers.keys() == expected.layers.keys()
    if not has_layers or observation.grid != expected.grid:
        expected_names = ", ".join(expected.layers)
        names = ", ".join(layers) or "no layers"
        yield (
            "Expected `Appearance.observation` with the terrain's grid "
            f"{expected.grid} and layers {expected_names}, got {observation.grid} and "
            f"{names}."
        )
        return
    pairs = {
        "seen": (appearance.seen, like.bool()),
        "noise_level": (appearance.noise_level, like),
        "observation.rgb": (observation.rgb, expected.rgb),
        "observation.elevation_m": (observation.elevation_m, expected.elevation_m),
    }
    for name, layer in expected.layers.items():
        pairs[f"observation.layers[{name!r}]"] = (layers[name], layer)
    is_sound = True
    for name, (values, like) in pairs.items():
        fault = _tensor_fault(f"`Appearance.{name}`", values, like)
        if fault:
            is_sound = False
            yield fault
    if not is_sound:
        return
    seen = appearance.seen
    noise_level = appearance.noise_level[seen]
    if not bool((noise_level >= 0).all()):
        yield (
            "Expected `Appearance.noise_level` ≥ 0 in observed cells, got negative "
            "values or NaN."
        )
    elevation_m = observation.elevation_m[seen]
    if not bool(elevation_m.isfinite().all()):
        yield "Expected finite elevation in observed cells, got NaN or infinite values."


def _tensor_fault(what: str, values: Any, like: Tensor) -> str:
    return find_tensor_fault(what, values, like.dtype, tuple(like.shape), like.device)


def _reported_values(sensed: Measurement) -> tuple[Tensor, ...]:
    """Return the maps of a measurement, NaN in unobserved cells, each [B, H, W]."""
    std = sensed.std.where(sensed.mask, torch.nan)
    appearance = sensed.appearance
    if appearance is None:
        return sensed.traversability, std
    seen = appearance.seen
    maps = (appearance.noise_level, *_channels(appearance))
    observed = [values.where(seen, torch.nan) for values in maps]
    return (sensed.traversability, std, seen, *observed)


def _channels(appearance: Appearance) -> tuple[Tensor, ...]:
    """Return colours, elevation and layers, each of shape [B, H, W]."""
    observation = appearance.observation
    colours = observation.rgb.float().unbind(1)
    return (*colours, observation.elevation_m, *observation.layers.values())


def _differ(first: Measurement, second: Measurement) -> bool:
    """Return whether two measurements differ in a cell that both observe."""
    common = first.mask & second.mask
    is_different = first.traversability != second.traversability
    differ = bool(is_different[common].any())
    if differ or first.appearance is None or second.appearance is None:
        return differ
    common = first.appearance.seen & second.appearance.seen
    channels = _channels(first.appearance)
    pairs = zip(channels, _channels(second.appearance), strict=True)
    return not all(same(a[common], b[common]) for a, b in pairs)


def _with_replaced_values(
    truth: _Truth, sensed: Measurement, sinks: bool
) -> Iterator[tuple[str, _Truth]]:
    """Yield a description of replaced unobserved values, and the new truth."""
    terrain = truth.terrain
    mask = sensed.mask
    reported = mask
    if sensed.appearance is not None:
        reported = mask | sensed.appearance.seen
    # Each cell's value changes, and so do summaries such as mean and maximum.
    mixture = terrain.truth
    is_fixed = mask[:, None]
    new_means = 0.4 * (1 - mixture.means)
    distribution = replace(
        mixture,
        weights=mixture.weights.where(is_fixed, mixture.weights.flip(1, 2)),
        means=mixture.means.where(is_fixed, new_means),
        stds=mixture.stds.where(is_fixed, 0.5 * mixture.stds),
    )
    traversability = terrain.traversability
    new_traversability = 0.4 * (1 - traversability)
    changed = replace(
        terrain,
        class_id=terrain.class_id.where(mask, terrain.class_id + 1),
        truth=distribution,
        traversability=traversability.where(mask, new_traversability),
    )
    new_field = 0.4 * (1 - truth.field)
    field = truth.field.where(mask, new_field)
    yield (
        "λ, its distribution and the class in cells that are not measured",
        replace(truth, terrain=changed, field=field),
    )
    layers = {}
    for name, layer in terrain.layers.items():
        layers[name] = layer.where(reported, layer + 1)
    new_rgb = (255 - terrain.rgb) // 2
    changed = replace(
        terrain,
        rgb=terrain.rgb.where(reported[:, None], new_rgb),
        slope_deg=terrain.slope_deg.where(reported, terrain.slope_deg + 5),
        layers=layers,
    )
    yield (
        "colour, slope and layers in unobserved cells",
        replace(truth, terrain=changed),
    )
    if not sinks:
        return
    x = truth.robot_state[:, 0]
    y = truth.robot_state[:, 1]
    rows, columns = terrain.grid.cell_of(x, y)
    is_kept = reported.clone()
    episodes = torch.arange(len(is_kept), device=is_kept.device)
    is_kept[episodes, rows, columns] = True
    height = terrain.elevation_m
    new_height = height - 2 - (7 * height).sin()
    changed = replace(terrain, elevation_m=height.where(is_kept, new_height))
    yield (
        "the elevation of unobserved cells",
        replace(truth, terrain=changed),
    )


def _create_hills(height: int, width: int, device: torch.device) -> _Truth:
    """Return the truth of four episodes on maps of hills that occlude each other.

    λ is 0 or 1 in some cells. The maps have two classes and a layer.

    Args:
        height: number of rows.
        width: number of columns.
        device: device of the maps.
    """
    generator = torch.Generator().manual_seed(SEED)
    grid = Grid(height, width, _RESOLUTION_M)
    uniform = torch.rand(8, 4, height, width, generator=generator).to(device)
    rows = torch.arange(height, device=device)[:, None]
    columns = torch.arange(width, device=device)
    waves_y = 0.7 * torch.sin(0.9 * rows + 0.3)
    waves_x = 0.7 * torch.sin(0.8 * columns)
    waves = waves_y + waves_x
    low_mean = 0.1 + 0.1 * uniform[0]
    high_mean = 0.5 + 0.3 * uniform[1]
    means = torch.stack((low_mean, high_mean), dim=1)
    low_weight = 0.1 + 0.2 * uniform[2]
    weights = torch.stack((low_weight, 1 - low_weight), dim=1)
    stds = torch.full_like(means, 0.1)
    truth = TraversabilityMixture(weights, means, stds, (0, 0))
    scores = 0.2 + 2 * (uniform[3] - 0.5)
    field = truth.from_normal(scores)
    colours = (255 * uniform[4:7]).to(torch.uint8)
    has_class_1 = uniform[0] > 0.5
    terrain = Terrain(
        rgb=colours.movedim(0, 1).contiguous(),
        class_id=has_class_1.long(),
        elevation_m=waves.repeat(4, 1, 1) + 0.1 * uniform[7],
        slope_deg=20 * uniform[2],
        truth=truth,
        traversability=field.flip(1),
        grid=grid,
        layers={"vegetation_m": uniform[1]},
    )
    x, y = grid.extent_m
    speed = 0.5
    states = [
        [0.52 * x, 0.47 * y, 0.6, speed],
        [0.3, 0.2, 0.9, speed],
        [0.6 * x, y - 0.1, -2.5, speed],
        [-0.3, 2.0, 0.0, speed],
    ]
    robot_state = torch.tensor(states, device=device)
    return _Truth(terrain=terrain, field=field, robot_state=robot_state)
