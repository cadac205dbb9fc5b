"""Reading of recipes from YAML files and plain data.

Shipped recipes are loaded by id (`paper-v1`), custom ones by the path of their file.
"""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from benchnav.core.errors import ConfigError, expect
from benchnav.core.settings import changed, read
from benchnav.core.yaml_text import load_yaml, read_yaml
from benchnav.datagen.layers import vegetation
from benchnav.datagen.layers.spec import read_layers
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.recipe.scenario import (
    DEFAULTS,
    PRESETS,
    RECIPES,
    load_presets,
    resolve,
)


def load_recipe(source: str | Path, overrides: Sequence[str] = ()) -> Recipe:
    """Load a recipe by its shipped id or the path of a YAML file.

    Args:
        source: id of a shipped recipe, or path of a file.
        overrides: changes `key.key=value` with the value in YAML, such as
            `splits.train.maps=50`. The key of an item of a list is its `name`, as in
            `classes.dune_sand.soft.weight=0.2`. Overrides must include `id=NAME`, since
            changed maps need another id.

    Raises:
        ConfigError: If the recipe does not exist or is invalid, or its id is used for
            other maps.
    """
    path = RECIPES / f"{source}.yaml"
    if not path.exists():
        path = Path(source)
    shipped = shipped_recipes()
    expect(
        path.is_file(),
        f"a shipped recipe ({', '.join(shipped)}) or the path of a YAML file, got "
        f"{str(source)!r}, which does not exist.",
    )
    data = read_yaml(path)
    resolved = _with_class_table(data)
    for text in overrides:
        name, equals, value = text.partition("=")
        keys = name.split(".")
        is_override = equals and all(keys)
        expect(is_override, f"an override such as splits.train.maps=50, got {text!r}.")
        resolved = changed(resolved, keys, load_yaml(value))
    is_synthesis_2 = isinstance(resolved, dict) and resolved.get("synthesis") == 2
    if is_synthesis_2 and resolved.get("id") not in shipped:
        resolved = {"closed_corners": True, **resolved}
    recipe = recipe_from_dict(resolved, str(source))
    has_new_id = not overrides or recipe.id != data.get("id")
    expect(
        has_new_id,
        f"a new id for a recipe with overrides, got {recipe.id!r}, which is the id of "
        "the recipe without overrides. Add `id=NAME` to the overrides, with another "
        "name.",
    )
    is_shipped = path == RECIPES / f"{recipe.id}.yaml" and not overrides
    if recipe.id in shipped and not is_shipped:
        expect(
            recipe == shipped_recipe(recipe.id),
            f"an `id` in {source} that differs from the ids of shipped recipes, got "
            f"{recipe.id!r}. Choose another `id`.",
        )
    return recipe


@cache
def shipped_recipe(recipe_id: str) -> Recipe:
    """Return a shipped recipe by its id; a process reads each recipe once."""
    return load_recipe(recipe_id)


def shipped_recipes() -> list[str]:
    """Return the ids of the recipes in the package, sorted."""
    return sorted(path.stem for path in RECIPES.glob("*.yaml") if path != PRESETS)


def shipped_sizes(recipe: str) -> dict[str, int]:
    """Return the number of maps by split of a shipped recipe, which is not checked."""
    splits = read_yaml(RECIPES / f"{recipe}.yaml")["splits"]
    return {split: entry["maps"] for split, entry in splits.items()}


def _with_class_table(data: Any) -> Any:
    """Return the data with the shipped class table, unless it lists its own classes."""
    if not isinstance(data, dict) or data.get("classes", "default") != "default":
        return data
    classes, _ = load_presets(data.get("synthesis"))
    return {**data, "classes": classes}


def recipe_from_dict(data: Any, origin: str) -> Recipe:
    """Return a recipe from plain data.

    Args:
        data: mapping with the keys of a recipe file; scenarios may name presets.
        origin: source of the data, for messages, such as the path of the file.

    Raises:
        ConfigError: If a key is unknown or missing, or a value is of the wrong type or
            out of range.
    """
    kind = type(data).__name__
    expect(isinstance(data, dict), f"a mapping in recipe {origin}, got {kind}.")
    data = _with_class_table(data)
    _, presets = load_presets(data.get("synthesis"))
    default = {name: {"preset": name} for name in DEFAULTS}
    scenarios = data.get("scenarios", default)
    if isinstance(scenarios, dict):
        scenarios = {
            name: resolve(entry, presets, name) for name, entry in scenarios.items()
        }
    try:
        growth, data = vegetation.read_keys(data)
        layers: Any = read_layers(data.get("layers", []))
        if growth:
            layers = (growth, *layers)
        data["layers"] = read_layers(layers)
        data["scenarios"] = scenarios
        return read(Recipe, data, lambda key: f"`{key}`" if key else "a recipe")
    except ConfigError as error:
        raise ConfigError(f"Recipe {origin}: {error}") from error
