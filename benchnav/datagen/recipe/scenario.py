"""Scenarios: geometry, light and tints of a family of maps.

`presets.yaml` contains the shipped class table and scenarios, the presets. A recipe may
name or replace them. With a `severity` s, each number of a scenario is interpolated
between `std` (s = 0) and the preset (s = 1), or extrapolated.
"""

import re
from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchnav.core.errors import expect
from benchnav.core.settings import of, plain, read

RECIPES = Path(__file__).parent
PRESETS = RECIPES / "presets.yaml"

Range = tuple[float, float]
SeriesOfShifts = dict[str, list[tuple[float, str]]]

# Scenarios of a recipe that does not list its own.
DEFAULTS = ("std", "hg", "hs")

_NAMED = re.compile(
    r"(?P<scenario>.*[^/])(-(?P<hundredths>\d{3})|@(?P<severity>\d+(\.\d+)?))"
)


@dataclass(frozen=True, kw_only=True)
class Tint:
    """Change of the terrain's colour only, such as snow or wetness.

    Args:
        classes: names of the tinted classes; if empty, all.
        colour: RGB of the tint in full light, 0–255.
        share: weight of the tint, in (0, 1); the class's colour has weight 1 − share.
    """

    classes: tuple[str, ...] = ()
    colour: tuple[int, int, int]
    share: float

    def __post_init__(self) -> None:
        """Reject an invalid colour or weight."""
        in_range = all(0 <= value <= 255 for value in self.colour)
        expect(
            in_range,
            f"channels of `colour` of a tint in 0–255, got {self.colour}.",
        )
        expect(
            0 < self.share < 1,
            f"`share` of a tint in (0, 1), got {self.share:g}. Lower the severity, "
            "which multiplies the preset's `share`.",
        )


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """Geometry, light and tints of a family of maps.

    A range (minimum, maximum) is sampled uniformly, one value per map.

    Args:
        relief_m: difference between the maximum and minimum elevation of the fractal
            terrain, in metres.
        roughness: Hurst exponent of the fractal terrain, in [0, 1].
        crater_count: number of craters per map.
        crater_radius_m: radius of a crater's rim, in metres.
        crater_depth_ratio: depth below the rim, divided by the diameter, in [0, 1].
        light_height: z of the unit vector toward the light, in [0, 1]; 1 is overhead.
        ambient: fraction of ambient light, in [0, 1].
        tints: changes of the classes' colours, applied in order. They do not change the
            colour of vegetation.
    """

    relief_m: Range = (1.4, 1.7)
    roughness: float = 0.75
    crater_count: Range = (0.0, 0.0)
    crater_radius_m: Range = (2.0, 4.5)
    crater_depth_ratio: float = 0.1
    light_height: Range = (0.8, 1.0)
    ambient: float = 0.1
    tints: tuple[Tint, ...] = ()

    def __post_init__(self) -> None:
        """Reject ranges that are not ordered or exceed physical limits."""
        limits: dict[str, Range] = {
            "relief_m": (0, 1000),
            "roughness": (0, 1),
            "crater_count": (0, 1000),
            "crater_radius_m": (1e-6, 1e4),
            "crater_depth_ratio": (0, 1),
            "light_height": (0, 1),
            "ambient": (0, 1),
        }
        for name, (minimum, maximum) in limits.items():
            value = getattr(self, name)
            is_range = isinstance(value, tuple)
            low, high = value if is_range else (value, value)
            expect(
                minimum <= low <= high <= maximum,
                f"`{name}` of a scenario ordered and within [{minimum:g}, "
                f"{maximum:g}], got {value}.",
            )

    @property
    def mean_crater_area_m2(self) -> float:
        """Mean area of a crater in m²; the logarithm of its radius is uniform."""
        low, high = self.crater_radius_m
        if low == high:
            return float(np.pi * low**2)
        log_ratio = np.log(high / low)
        return float(np.pi * (high**2 - low**2) / (2 * log_ratio))


def blend(base: Scenario, full: Scenario, severity: float) -> Scenario:
    """Return a scenario between `base` (severity 0) and `full` (severity 1).

    All numbers are interpolated. The weights of the tints of `full` are multiplied by
    the severity. `base` must not have tints.
    """

    def between(low: Any, high: Any) -> Any:
        if isinstance(low, tuple):
            return tuple(map(between, low, high))
        return low + severity * (high - low)

    names = [item.name for item in fields(Scenario) if item.name != "tints"]
    numbers = {}
    for name in names:
        numbers[name] = between(getattr(base, name), getattr(full, name))
    tints = []
    if severity:
        for tint in full.tints:
            tints.append(replace(tint, share=severity * tint.share))
    return Scenario(**numbers, tints=tuple(tints))


def load_presets(synthesis: Any) -> tuple[list[Any], dict[str, Any]]:
    """Return the shipped class table and scenarios for a synthesis, as plain data."""
    data = deepcopy(_read_presets())
    key = "scenarios-2" if synthesis == 2 else "scenarios"
    return data["classes"], data[key]


@cache
def _read_presets() -> Any:
    """Return the content of `presets.yaml`, which a process reads once."""
    return yaml.safe_load(PRESETS.read_text())


def resolve(entry: Any, presets: Mapping[str, Any], name: str) -> Any:
    """Return the plain data of a scenario, with the numbers of its preset filled in.

    Args:
        entry: plain data of a scenario. If it names a `preset`, the preset's numbers at
            the given `severity` are used for all keys that the entry does not contain.
        presets: plain data of the presets by name, including `std`.
        name: name of the scenario, for messages.

    Raises:
        ConfigError: If the preset is unknown, or the severity is not finite.
    """
    if not isinstance(entry, dict) or "preset" not in entry:
        return entry
    preset = entry["preset"]
    is_listed = isinstance(preset, str) and preset in presets
    expect(
        is_listed,
        f"`preset` of scenario {name!r} to be one of {sorted(presets)}, got "
        f"{preset!r}.",
    )
    severity = entry.get("severity", 1.0)
    is_finite = isinstance(severity, int | float) and np.isfinite(severity)
    expect(
        is_finite,
        f"`severity` of scenario {name!r} to be a finite number, got {severity!r}.",
    )
    base = read(Scenario, presets["std"], of("preset 'std'"))
    full = read(Scenario, presets[preset], of(f"preset {preset!r}"))
    resolved = plain(blend(base, full, severity)) | entry
    del resolved["preset"]
    resolved.pop("severity", None)
    return resolved


def find_series(splits: Iterable[str]) -> SeriesOfShifts:
    """Return the series of shifts among splits, by their names.

    A split belongs to a series if its name ends in a severity: in hundredths after a
    dash (`test/hg-050`), or as a number after an @ (`test/hg@0.5`). The text before the
    severity is the name of the series (`test/hg`). A split with exactly this name has
    severity 1, and the split `std` of the same folder (`test/std`) has severity 0. All
    other splits belong to no series.

    Args:
        splits: names of splits.

    Returns:
        Pairs (severity, split) in ascending order, by name of the series. Series with
        fewer than two pairs are omitted.
    """
    splits = list(splits)
    all_series: SeriesOfShifts = {}
    for split in splits:
        match = _NAMED.fullmatch(split)
        if match is None:
            continue
        hundredths = match["hundredths"]
        severity = int(hundredths) / 100 if hundredths else float(match["severity"])
        pairs = all_series.setdefault(match["scenario"], [])
        pairs.append((severity, split))
    for scenario, pairs in all_series.items():
        folder, slash, _ = scenario.rpartition("/")
        std = f"{folder}{slash}std"
        for severity, split in ((0.0, std), (1.0, scenario)):
            if split in splits and severity not in dict(pairs):
                pairs.append((severity, split))
        pairs.sort()
    return {scenario: pairs for scenario, pairs in all_series.items() if len(pairs) > 1}
