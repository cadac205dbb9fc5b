"""Recipes and scenarios: everything that fixes a dataset, as data.

A recipe is a YAML file. Shipped ones are named by id (`paper-v1`); a user's own is named by path.
`presets.yaml` holds the shipped class table and scenarios, which a recipe may name or replace.
A scenario's `severity` s moves every number of it from `std` (s = 0) to the preset (s = 1), and
beyond.
"""

import re
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from benchnav.datagen.latent import TerrainClass
from benchnav.datagen.schema import FIELDS
from benchnav.errors import ConfigError
from benchnav.terrain import Grid

RECIPES = Path(__file__).parent / "recipes"
_MOST_CRATERED = 0.4  # share of a map; discs laid at random one by one jam at 0.55
PRESETS = RECIPES / "presets.yaml"

Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """Geometry and light of a family of maps; each range is drawn from uniformly, a value a map.

    Args:
        relief_m: highest minus lowest elevation of the fractal ground.
        roughness: Hurst exponent of the fractal ground.
        crater_count: fewest and most craters a map.
        crater_radius_m: smallest and largest radius of a crater's rim.
        crater_depth_ratio: depth below the rim over diameter.
        light_height: z of the unit vector toward the light; 1 is overhead.
        ambient: share of ambient light.
    """

    relief_m: Range = (1.4, 1.7)
    roughness: float = 0.75
    crater_count: Range = (0.0, 0.0)
    crater_radius_m: Range = (2.0, 4.5)
    crater_depth_ratio: float = 0.1
    light_height: Range = (0.8, 1.0)
    ambient: float = 0.1

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
            if not (np.isfinite(low) and np.isfinite(high) and least <= low <= high <= most):
                raise ConfigError(
                    f"Expected scenario `{name}` finite, ordered and within [{least:g}, {most:g}], got {value}."
                )

    @property
    def mean_crater_area_m2(self) -> float:
        """Mean area inside a rim; radii are uniform in their logarithm."""
        low, high = self.crater_radius_m
        if low == high:
            return float(np.pi * low**2)
        return float(np.pi * (high**2 - low**2) / (2 * np.log(high / low)))


def blend(base: Scenario, full: Scenario, severity: float) -> Scenario:
    """Moves every number of a scenario from `base` (severity 0) to `full` (severity 1)."""

    def between(low: Any, high: Any) -> Any:
        if isinstance(low, tuple):
            return tuple(between(a, b) for a, b in zip(low, high, strict=True))
        return low + severity * (high - low)

    return replace(
        base, **{f.name: between(getattr(base, f.name), getattr(full, f.name)) for f in fields(base)}
    )


@dataclass(frozen=True, kw_only=True)
class Split:
    """One split of a dataset.

    Args:
        scenario: name of one of the recipe's scenarios.
        maps: number of maps; map i shows environment i mod the number of environments.
        solvable: keep only maps whose goal can be reached, and store the grid reference time.
    """

    scenario: str
    maps: int
    solvable: bool = False

    def __post_init__(self) -> None:
        """Refuses empty splits."""
        if self.maps < 1:
            raise ConfigError(
                f"Expected `maps` ≥ 1 in every split, got {self.maps}. Leave the split out instead."
            )


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """All that fixes a dataset: same recipe, same maps, on any machine.

    Args:
        id: name and version of the dataset, for example `paper-v1`.
        seed: root seed; another seed makes a sibling with other maps and the same class table.
        height: rows of a map.
        width: columns of a map.
        resolution_m: cell width.
        start_m: (x, y) where navigation starts.
        goal_m: (x, y) where it ends.
        stuck_threshold: λ_stuck; a cell is truly free when E[λ] exceeds it.
        synthesis: how maps are made: 1 as by version 0.1, bit for bit, or 2.
        environments: number of environments; each shows its own choice of classes.
        occupancy: share of the cells that each class of an environment covers, summing to 1.
        class_periods_m: lattice spacings of the class noise, one an octave.
        classes: the class table.
        scenarios: scenarios by name.
        splits: splits by name.
    """

    id: str
    seed: int
    height: int
    width: int
    resolution_m: float
    start_m: tuple[float, float]
    goal_m: tuple[float, float]
    environments: int
    occupancy: tuple[float, ...]
    class_periods_m: tuple[float, ...]
    classes: tuple[TerrainClass, ...]
    scenarios: dict[str, Scenario]
    splits: dict[str, Split]
    stuck_threshold: float = 0.3
    synthesis: int = 1

    def __post_init__(self) -> None:
        """Refuses recipes that contradict themselves."""
        extent_x, extent_y = self.grid.extent_m
        for name in ("start_m", "goal_m"):
            x, y = getattr(self, name)
            if not (0 <= x < extent_x and 0 <= y < extent_y):
                raise ConfigError(
                    f"Expected `{name}` on the map of {extent_x:g} m × {extent_y:g} m, got ({x}, {y})."
                )
        if self.cell_of(self.start_m) == self.cell_of(self.goal_m):
            raise ConfigError(
                f"Expected `goal_m` in another cell than `start_m`, got both in that of {self.goal_m}."
            )
        if not 0 <= self.stuck_threshold < 1:
            raise ConfigError(f"Expected `stuck_threshold` in [0, 1), got {self.stuck_threshold}.")
        if not self.classes:
            raise ConfigError("Expected at least one class in `classes`, got none.")
        for name, scenario in self.scenarios.items():
            if scenario.crater_count[1] > 0 and 2 * scenario.crater_radius_m[1] > min(extent_x, extent_y):
                raise ConfigError(
                    f"Expected `crater_radius_m` of scenario {name!r} to fit a map of {extent_x:g} m × {extent_y:g} m, "
                    f"got {scenario.crater_radius_m}."
                )
            covered = scenario.crater_count[1] * scenario.mean_crater_area_m2 / (extent_x * extent_y)
            if covered > _MOST_CRATERED:
                raise ConfigError(
                    f"Expected the craters of scenario {name!r} to cover at most {_MOST_CRATERED:.0%} of a map, "
                    f"so that they fit side by side, got {covered:.0%}. Lower `crater_count` or `crater_radius_m`."
                )
        if not np.isclose(sum(self.occupancy), 1, atol=1e-6) or not all(
            0 < share <= 1 for share in self.occupancy
        ):
            raise ConfigError(f"Expected `occupancy` as shares > 0 summing to 1, got {list(self.occupancy)}.")
        if len(self.occupancy) > len(self.classes):
            raise ConfigError(
                f"Expected at most {len(self.classes)} shares in `occupancy`, one a class, got {len(self.occupancy)}."
            )
        most = FIELDS["environment"].most
        if not 1 <= self.environments <= most:
            raise ConfigError(f"Expected `environments` in 1–{most}, got {self.environments}.")
        if not self.class_periods_m or not all(
            self.resolution_m <= period < np.inf for period in self.class_periods_m
        ):
            raise ConfigError(
                f"Expected `class_periods_m` of at least a cell, {self.resolution_m} m, "
                f"got {list(self.class_periods_m)}."
            )
        if len(self.classes) > 256:
            raise ConfigError(f"Expected at most 256 classes, got {len(self.classes)}.")
        check_name("id", self.id)
        for split_name in self.splits:
            for part in split_name.split("/"):
                check_name("split name", part)
            if any(other.startswith(f"{split_name}/") for other in self.splits):
                raise ConfigError(f"Expected splits side by side, got one inside {split_name!r}.")
        if not self.splits:
            raise ConfigError("Expected at least one split in `splits`, got none.")
        for name, split in self.splits.items():
            if split.scenario not in self.scenarios:
                raise ConfigError(
                    f"Expected `scenario` of split {name!r} to be one of {sorted(self.scenarios)}, "
                    f"got {split.scenario!r}."
                )

    @property
    def grid(self) -> Grid:
        """Size and resolution of every map."""
        return Grid(self.height, self.width, self.resolution_m)

    def cell_of(self, position_m: tuple[float, float]) -> tuple[int, int]:
        """Row and column of the cell that a position lies in, read in single precision as it is stored."""
        row, column = self.grid.cell_of(*torch.tensor(position_m, dtype=torch.float32))
        return int(row), int(column)

    def environment_classes(self, environment: int) -> np.ndarray:
        """The classes an environment shows: consecutive deals from one pack, so all are used equally.

        The pack is the class table taken with a stride, so that an environment shows classes of some
        distance in colour; each time the deals come full circle the stride changes.

        Returns:
            Class indices, distinct, shape [len(occupancy)].
        """
        count, shown = len(self.classes), len(self.occupancy)
        strides = [s for s in (3, 1, *range(2, count)) if np.gcd(s, count) == 1]
        first = environment * shown
        stride = strides[first // int(np.lcm(shown, count)) % len(strides)]
        return stride * np.arange(first, first + shown) % count

    def to_dict(self) -> dict[str, Any]:
        """Gives the recipe as plain data for JSON, fully resolved."""
        plain = _plain(asdict(self))
        if self.synthesis == 1:
            # As version 0.1 wrote it, so that its files and readers stay as they are.
            plain.pop("synthesis")
            for item in plain["classes"]:
                item.pop("soft")
        return plain


def load_recipe(source: str | Path, overrides: Sequence[str] = ()) -> Recipe:
    """Reads a recipe by shipped id or by path of a YAML file.

    Args:
        source: id or path.
        overrides: changes such as `splits.train.maps=50` or `scenarios.hs.severity=0.5`, the value
            in YAML. What differs needs a name of its own, so `id=NAME` has to be among them.

    Raises:
        ConfigError: there is no such recipe, or it is not one; or other maps would bear its id.
    """
    path = RECIPES / f"{source}.yaml"
    if not path.exists():
        path = Path(source)
    if not path.is_file():
        raise ConfigError(
            f"Expected a shipped recipe ({', '.join(shipped_recipes())}) or the path of a YAML file, "
            f"got {str(source)!r}."
        )
    try:
        data = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        raise ConfigError(f"Expected YAML in {path}, got: {' '.join(str(error).split())}") from error
    changed = override(data, overrides) if overrides else data
    recipe = recipe_from_dict(changed, str(source))
    if overrides and recipe.id == data.get("id"):
        raise ConfigError(
            f"Expected `id=NAME` among the overrides, since {recipe.id!r} names the maps of the recipe as it is."
        )
    as_shipped = path == RECIPES / f"{recipe.id}.yaml" and not overrides
    if not as_shipped and recipe.id in shipped_recipes() and recipe != load_recipe(recipe.id):
        raise ConfigError(
            f"Expected an `id` of its own in {source}, got {recipe.id!r}, which names other maps: "
            "a recipe shipped with the package."
        )
    return recipe


def check_name(kind: str, name: str) -> None:
    """Refuses names that would not do as a file's or a group's.

    Raises:
        ConfigError: with `kind` in its message.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name) or name == "manifest":
        raise ConfigError(f"Expected {kind} of letters, digits, '.', '_' and '-', got {name!r}.")


def override(data: Any, overrides: Sequence[str]) -> Any:
    """Sets values in a recipe's plain data.

    Args:
        data: a mapping as in a recipe file.
        overrides: `key.key=value` each, the value in YAML.

    Raises:
        ConfigError: one is not of that form, or leads through what is no mapping.
    """
    changed = deepcopy(data)
    for text in overrides:
        name, equals, value = text.partition("=")
        if not equals or not all(name.split(".")):
            raise ConfigError(f"Expected an override such as splits.train.maps=50, got {text!r}.")
        *parents, last = name.split(".")
        place = changed
        for parent in parents:
            place = place.get(parent) if isinstance(place, dict) else None
        if not isinstance(place, dict):
            raise ConfigError(f"Expected an override of something in the recipe, got {text!r}.")
        try:
            place[last] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise ConfigError(f"Expected YAML after '=' in override {text!r}.") from error
    return changed


def shipped_recipes() -> list[str]:
    """Ids of the recipes in the package."""
    return sorted(path.stem for path in RECIPES.glob("*.yaml") if path != PRESETS)


def recipe_from_dict(data: Any, origin: str) -> Recipe:
    """Builds a recipe from plain data, resolving presets.

    Args:
        data: a mapping as in a recipe file or a manifest.
        origin: where it came from, for messages.

    Raises:
        ConfigError: a key is unknown or missing, or a value is of the wrong type or out of range.
    """
    if not isinstance(data, dict):
        raise ConfigError(f"Expected a mapping in recipe {origin}, got {type(data).__name__}.")
    for key in ("splits", "scenarios"):
        named = data.get(key)
        if isinstance(named, dict) and not all(isinstance(name, str) for name in named):
            raise ConfigError(
                f"Expected names in `{key}` of recipe {origin}, got {list(named)}. Quote numbers."
            )
    presets = yaml.safe_load(PRESETS.read_text())
    data = {"classes": "default", **data}
    if data["classes"] == "default":
        data["classes"] = presets["classes"]
    scenarios = data.get("scenarios", {name: {"preset": name} for name in presets["scenarios"]})
    if isinstance(scenarios, dict):
        data["scenarios"] = {
            name: _resolve(entry, presets["scenarios"], name) for name, entry in scenarios.items()
        }
    try:
        return _parse(Recipe, data)
    except ConfigError as error:
        raise ConfigError(f"Recipe {origin}: {error}") from error


def _resolve(entry: Any, presets: dict[str, Any], name: str) -> Any:
    if not isinstance(entry, dict) or "preset" not in entry:
        return entry
    preset, severity = entry["preset"], entry.get("severity", 1.0)
    if not isinstance(preset, str) or preset not in presets:
        raise ConfigError(
            f"Expected `preset` of scenario {name!r} to be one of {sorted(presets)}, got {preset!r}."
        )
    if not isinstance(severity, int | float) or not np.isfinite(severity):
        raise ConfigError(
            f"Expected `severity` of scenario {name!r} to be a finite number, got {severity!r}."
        )
    base, full = (_parse(Scenario, presets[key]) for key in ("std", preset))
    changes = {key: value for key, value in entry.items() if key not in ("preset", "severity")}
    return {**_plain(asdict(blend(base, full, severity))), **changes}


def _parse(kind: type, data: Any) -> Any:
    """Builds a dataclass from plain data with jsonargparse's type checks, as one-line errors."""
    from jsonargparse import ArgumentError, ArgumentParser

    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument("--value", type=kind, required=True)
    try:
        return parser.instantiate_classes(parser.parse_object({"value": deepcopy(data)})).value
    except (ArgumentError, TypeError, ValueError) as error:
        # "value" is the parser's name for the whole, not a key that the user wrote.
        message = re.sub(r"\bvalue\.", "", " ".join(str(error).split())).replace("Group 'value'", "It")
        raise ConfigError(message) from error


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value
