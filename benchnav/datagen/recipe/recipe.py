"""Recipes: everything that fixes a dataset, as data.

A recipe is a YAML file. Shipped ones are named by id (`paper-v1`); a user's own is named by path.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchnav.core.errors import ConfigError
from benchnav.core.grid import Grid
from benchnav.datagen.recipe.classes import TerrainClass, look_alike_classes
from benchnav.datagen.recipe.environments import AlikeClasses, deal_classes, deal_units
from benchnav.datagen.recipe.places import PlacesRule
from benchnav.datagen.recipe.plain_data import parse, plain
from benchnav.datagen.recipe.rules import check_recipe
from benchnav.datagen.recipe.scenario import PRESETS, RECIPES, Scenario, load_presets, resolve

REFERENCE_M = 32.0  # side of the square that relief and crater counts of synthesis 2 are for


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
        start_m: (x, y) where navigation starts; None where `places` says.
        goal_m: (x, y) where it ends; None where `places` says.
        places: how start and goal are drawn a map, in place of `start_m` and `goal_m`; synthesis 2 only.
        stuck_threshold: λ_stuck; a cell is truly free when E[λ] exceeds it.
        synthesis: how maps are made: 1 as by version 0.1, bit for bit, or 2, which knows soft spots, classes
            that look alike, drawn places and correlated λ, and makes the same ground at any size.
        correlation_m: ℓ of stored λ: at distance d the noise of two cells has the correlation exp(−d²/2ℓ²);
            at 0, as in synthesis 1, each cell's is its own.
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
    start_m: tuple[float, float] | None = None
    goal_m: tuple[float, float] | None = None
    environments: int
    occupancy: tuple[float, ...]
    class_periods_m: tuple[float, ...]
    classes: tuple[TerrainClass, ...]
    scenarios: dict[str, Scenario]
    splits: dict[str, Split]
    stuck_threshold: float = 0.3
    synthesis: int = 1
    places: PlacesRule | None = None
    correlation_m: float = 0.0

    def __post_init__(self) -> None:
        """Refuses recipes that contradict themselves."""
        check_recipe(self)

    @property
    def grid(self) -> Grid:
        """Size and resolution of every map."""
        return Grid(self.height, self.width, self.resolution_m)

    def cells_of(self, positions_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the cells that positions [B, 2] lie in, read in single precision as stored."""
        column, row = (
            np.floor(positions_m.astype(np.float32) / np.float32(self.resolution_m)).astype(np.int64).T
        )
        return row.clip(0, self.height - 1), column.clip(0, self.width - 1)

    @cached_property
    def units(self) -> tuple[AlikeClasses, ...]:
        """Classes that are shown together: in synthesis 2 those of one colour, in the table's order."""
        if self.synthesis == 1:
            return tuple((number,) for number in range(len(self.classes)))
        return tuple(dict.fromkeys(look_alike_classes(self.classes)))

    def environment_classes(self, environment: int) -> np.ndarray:
        """The classes an environment shows.

        Returns:
            Class indices, distinct, shape [len(occupancy)].
        """
        if self.synthesis == 1:
            return deal_classes(len(self.classes), len(self.occupancy), environment)
        dealt = deal_units(self.units, len(self.occupancy), max(self.environments, environment + 1))
        return dealt[environment].copy()

    def craters(self, scenario: Scenario) -> tuple[int, int]:
        """Fewest and most craters of a map; in synthesis 2 a scenario's counts are for 32 m × 32 m."""
        extent_x, extent_y = self.grid.extent_m
        share = 1.0 if self.synthesis == 1 else extent_x * extent_y / REFERENCE_M**2
        low, high = (round(share * count) for count in scenario.crater_count)
        return low, high

    def to_dict(self) -> dict[str, Any]:
        """Gives the recipe as plain data for JSON, fully resolved."""
        data = plain(asdict(self))
        unused = ("places",) if self.places is None else ("start_m", "goal_m")
        for name in unused:
            data.pop(name)
        if self.synthesis == 1:
            # As version 0.1 wrote it, so that its files and readers stay as they are.
            for name in ("synthesis", "correlation_m"):
                data.pop(name)
            for item in data["classes"]:
                item.pop("soft")
        return data


def load_recipe(source: str | Path, overrides: Sequence[str] = ()) -> Recipe:
    """Reads a recipe by shipped id or by path of a YAML file.

    Args:
        source: id or path.
        overrides: changes such as `splits.train.maps=50` or `classes.dune_sand.soft.weight=0.2`, the value
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
    changed = override(_with_class_table(data), overrides) if overrides else data
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


def override(data: Any, overrides: Sequence[str]) -> Any:
    """Sets values in a recipe's plain data.

    Args:
        data: a mapping as in a recipe file.
        overrides: `key.key=value` each, the value in YAML; an item of a list is named by its `name`, as in
            `classes.dune_sand.soft.weight=0.2`.

    Raises:
        ConfigError: one is not of that form, or leads to nothing that could be set.
    """
    changed = deepcopy(data)
    for text in overrides:
        name, equals, value = text.partition("=")
        if not equals or not all(name.split(".")):
            raise ConfigError(f"Expected an override such as splits.train.maps=50, got {text!r}.")
        *parents, last = name.split(".")
        place = changed
        for parent in parents:
            place = _item(place, parent)
        if not isinstance(place, dict):
            raise ConfigError(f"Expected an override of something in the recipe, got {text!r}.")
        try:
            place[last] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise ConfigError(f"Expected YAML after '=' in override {text!r}.") from error
    return changed


def _item(place: Any, name: str) -> Any:
    """What a mapping has under a name, or a list of mappings under that `name`; None where there is none."""
    if isinstance(place, list):
        place = {item["name"]: item for item in place if isinstance(item, dict) and "name" in item}
    return place.get(name) if isinstance(place, dict) else None


def shipped_recipes() -> list[str]:
    """Ids of the recipes in the package."""
    return sorted(path.stem for path in RECIPES.glob("*.yaml") if path != PRESETS)


def shipped_sizes(recipe: str) -> dict[str, int]:
    """Maps by split of a shipped recipe, read without all that is to be checked of it."""
    splits = yaml.safe_load((RECIPES / f"{recipe}.yaml").read_text())["splits"]
    return {split: entry["maps"] for split, entry in splits.items()}


def _with_class_table(data: Any) -> Any:
    """Puts the shipped class table in the place of `default`, or of none."""
    if not isinstance(data, dict) or data.get("classes", "default") != "default":
        return data
    return {**data, "classes": load_presets(data.get("synthesis"))[0]}


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
    data = _with_class_table(data)
    _, presets = load_presets(data.get("synthesis"))
    scenarios = data.get("scenarios", {name: {"preset": name} for name in presets})
    if isinstance(scenarios, dict):
        data["scenarios"] = {name: resolve(entry, presets, name) for name, entry in scenarios.items()}
    try:
        return parse(Recipe, data)
    except ConfigError as error:
        raise ConfigError(f"Recipe {origin}: {error}") from error
