"""Scenarios, the geometry, light and tints of a family of maps, and the shipped ones
that recipes build on.

`presets.yaml` holds the shipped class table and scenarios, which a recipe may name or
replace. A scenario's `severity` s moves every number of it from `std` (s = 0) to the
preset (s = 1), and beyond.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
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

# Those of a recipe that names none.
DEFAULTS = ("std", "hg", "hs")

_NAMED = re.compile(
    r"(?P<scenario>.*[^/])(-(?P<hundredths>\d{3})|@(?P<severity>\d+(\.\d+)?))"
)


@dataclass(frozen=True, kw_only=True)
class Tint:
    """What changes the colour of the ground and nothing else, such as snow or wetness.

    Args:
        classes: names of the classes that it changes; all when empty.
        colour: RGB in full light that it changes them towards, 0–255.
        share: how far, in (0, 1): (1 − share) of the class's own colour is left.
    """

    classes: tuple[str, ...] = ()
    colour: tuple[int, int, int]
    share: float

    def __post_init__(self) -> None:
        """Refuses what is no colour, and what would leave no colour of the class."""
        expect(
            all(0 <= value <= 255 for value in self.colour),
            f"`colour` of a tint in 0–255, got {self.colour}.",
        )
        expect(
            0 < self.share < 1,
            f"`share` of a tint in (0, 1), got {self.share:g}. At severity 1 a preset "
            "has its own share.",
        )


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """Geometry, light and tints of a family of maps; each range is drawn from
    uniformly, a value a map.

    Args:
        relief_m: highest minus lowest elevation of the fractal ground.
        roughness: Hurst exponent of the fractal ground.
        crater_count: fewest and most craters a map.
        crater_radius_m: smallest and largest radius of a crater's rim.
        crater_depth_ratio: depth below the rim over diameter.
        light_height: z of the unit vector toward the light; 1 is overhead.
        ambient: share of ambient light.
        tints: what changes the colours of classes, one after another. Vegetation keeps
            its own.
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
        """Refuses ranges that are not finite, ordered, or physical."""
        limits: dict[str, Range] = {
            "relief_m": (0, 1000),
            "roughness": (0, 1),
            "crater_count": (0, 1000),
            "crater_radius_m": (1e-6, 1e4),
            "crater_depth_ratio": (0, 1),
            "light_height": (0, 1),
            "ambient": (0, 1),
        }
        for name, (least, most) in limits.items():
            value = getattr(self, name)
            low, high = value if isinstance(value, tuple) else (value, value)
            expect(
                least <= low <= high <= most,
                f"scenario `{name}` finite, ordered and within [{least:g}, {most:g}], "
                f"got {value}.",
            )

    @property
    def mean_crater_area_m2(self) -> float:
        """Mean area inside a rim; radii are uniform in their logarithm."""
        low, high = self.crater_radius_m
        if low == high:
            return float(np.pi * low**2)
        return float(np.pi * (high**2 - low**2) / (2 * np.log(high / low)))


def blend(base: Scenario, full: Scenario, severity: float) -> Scenario:
    """Moves every number of a scenario from `base` (severity 0) to `full` (severity 1).

    Of a tint of `full` that is its share; `base` has none, as `std` has none.
    """

    def between(low: Any, high: Any) -> Any:
        return (
            tuple(map(between, low, high))
            if isinstance(low, tuple)
            else low + severity * (high - low)
        )

    numbers = [item.name for item in fields(Scenario) if item.name != "tints"]
    moved = {
        name: between(getattr(base, name), getattr(full, name)) for name in numbers
    }
    tints = tuple(
        replace(tint, share=severity * tint.share) for tint in full.tints if severity
    )
    return Scenario(**moved, tints=tints)


def load_presets(synthesis: Any) -> tuple[list[Any], dict[str, Any]]:
    """Reads the shipped class table and the scenarios shipped for a synthesis, as plain
    data.
    """
    data = yaml.safe_load(PRESETS.read_text())
    return data["classes"], data["scenarios-2" if synthesis == 2 else "scenarios"]


def resolve(entry: Any, presets: Mapping[str, Any], name: str) -> Any:
    """Gives a scenario's numbers in full.

    Args:
        entry: plain data of a scenario; where it names a `preset`, that one's numbers
            at its `severity`, with what else the entry says in their place.
        presets: the presets' plain data by name, `std` among them.
        name: the scenario's name, for messages.

    Raises:
        ConfigError: there is no such preset, or the severity is no number.
    """
    if not isinstance(entry, dict) or "preset" not in entry:
        return entry
    preset, severity = entry["preset"], entry.get("severity", 1.0)
    expect(
        isinstance(preset, str) and preset in presets,
        f"`preset` of scenario {name!r} to be one of {sorted(presets)}, got "
        f"{preset!r}.",
    )
    expect(
        isinstance(severity, int | float) and np.isfinite(severity),
        f"`severity` of scenario {name!r} to be a finite number, got {severity!r}.",
    )
    base, full = (
        read(Scenario, presets[key], of(f"preset {key!r}")) for key in ("std", preset)
    )
    changes = {
        key: value for key, value in entry.items() if key not in ("preset", "severity")
    }
    return {**plain(blend(base, full, severity)), **changes}


def find_series(splits: Iterable[str]) -> SeriesOfShifts:
    """Finds the series of shifts among splits by their names.

    A split is one of a series where its name ends in the severity: in hundredths after
    a dash (`test/hg-050`), or as a number after an @ (`test/hg@0.5`). What stands
    before is the scenario; the split `std` of the same folder is severity 0 of each,
    and a split of the scenario's own name (`test/hg`) severity 1. Every other split
    stands by itself.

    Args:
        splits: names of splits.

    Returns:
        By scenario, its pairs as (severity, split), ascending, with `std` at severity 0
        and the scenario itself at 1 where they are there; scenarios with fewer than two
        pairs are left out.
    """
    splits = list(splits)
    all_series: SeriesOfShifts = {}
    for split in splits:
        if named := _NAMED.fullmatch(split):
            hundredths = named["hundredths"]
            severity = int(hundredths) / 100 if hundredths else float(named["severity"])
            all_series.setdefault(named["scenario"], []).append((severity, split))
    for scenario, pairs in all_series.items():
        std = f"{scenario[: scenario.rfind('/') + 1]}std"
        for severity, split in ((0.0, std), (1.0, scenario)):
            if split in splits and severity not in dict(pairs):
                pairs.append((severity, split))
        pairs.sort()
    return {scenario: pairs for scenario, pairs in all_series.items() if len(pairs) > 1}
