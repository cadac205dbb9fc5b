"""Vegetation: a layer that hides the terrain's colour and does not change λ.

Recipes describe vegetation by the keys `vegetation` of a class and
`vegetation_period_m`. Letters in shapes: B maps, H×W cells, C classes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy import ndarray

from benchnav.core.errors import ConfigError, expect
from benchnav.core.grid import Grid
from benchnav.core.settings import check_known, plain, read
from benchnav.datagen.layers.layer import DrawnMaps, Layer, Streams
from benchnav.datagen.recipe.classes import ClassTable, check_colour, look_alike_classes
from benchnav.datagen.schema import quantise

MIN_HEIGHT_M = 0.01
MAX_HEIGHT_M = 100.0


@dataclass(frozen=True, kw_only=True)
class Growth:
    """Vegetation on some cells of a class.

    Args:
        height_m: minimum and maximum height in metres; heights are uniform between
            them.
        cover: fraction of the class's cells with vegetation, in (0, 1].
        colour: RGB in full light, 0–255.
    """

    height_m: tuple[float, float]
    cover: float
    colour: tuple[int, int, int]

    def __post_init__(self) -> None:
        """Check the ranges."""
        low, high = self.height_m
        expect(
            MIN_HEIGHT_M <= low <= high <= MAX_HEIGHT_M,
            f"`height_m` of vegetation ordered and within [{MIN_HEIGHT_M:g}, "
            f"{MAX_HEIGHT_M:g}], got {list(self.height_m)}.",
        )
        expect(
            0 < self.cover <= 1, f"`cover` of vegetation in (0, 1], got {self.cover}."
        )
        check_colour("vegetation", self.colour)

    @property
    def appearance(self) -> str:
        """Text of the properties that an image shows: colour and cover."""
        return f"colour {list(self.colour)} with cover {self.cover:.6g}"


@dataclass(frozen=True, kw_only=True)
class Vegetation(Layer):
    """Vegetation in patches, from the same noise for all classes.

    Args:
        period_m: lattice spacing of the noise in metres, at least two cells; a patch is
            about half as wide.
        classes: vegetation by name of the class.
    """

    period_m: float
    classes: dict[str, Growth] = field(default_factory=dict)

    name: ClassVar[str] = "vegetation_m"
    unit: ClassVar[str] = "m"
    minimum: ClassVar[float] = 0.0
    maximum: ClassVar[float] = 200.0
    meaning: ClassVar[str] = "height of the vegetation; 0 on bare ground"
    stream: ClassVar[tuple[str, ...]] = ("vegetation",)

    def check(
        self, grid: Grid, classes: ClassTable, colours: Mapping[str, ndarray]
    ) -> None:
        """Check that vegetation neither creates nor separates look-alike classes.

        Only colours and cover are checked, since heights may separate classes. The
        arguments are those of `Layer.check`.
        """
        min_m = 2 * grid.resolution_m
        expect(
            min_m <= self.period_m < np.inf,
            f"finite `vegetation_period_m` of at least {min_m:g} m (two cells) if a "
            f"class has `vegetation`, got {self.period_m:g} m.",
        )
        names = [item.name for item in classes]
        for name in self.classes:
            check_known("classes of layer 'vegetation'", name, names)
        shown = []
        for name in names:
            growth = self.classes.get(name)
            shown.append(growth.appearance if growth else "no vegetation")
        for class_id, alike in enumerate(look_alike_classes(classes)):
            first = alike[0]
            if shown[first] != shown[class_id]:
                raise ConfigError(
                    f"Expected classes {names[first]!r} and {names[class_id]!r}, whose "
                    "terrain has the same colour, to have `vegetation` with the same "
                    f"`colour` and `cover`, got {shown[first]} and {shown[class_id]}. "
                    "Only `height_m` may differ."
                )
        for scenario, class_colours in colours.items():
            for name, growth in self.classes.items():
                is_same = (class_colours == growth.colour).all(axis=1)
                same_ids = np.flatnonzero(is_same)
                same = [repr(names[class_id]) for class_id in same_ids]
                expect(
                    not same,
                    f"vegetation on {name!r} to have a `colour` that no terrain has in "
                    f"scenario {scenario!r}, got the colour of {', '.join(same)}. "
                    "Change a `colour`.",
                )

    def draw(self, streams: Streams, maps: DrawnMaps) -> ndarray:
        """Return drawn heights in steps of 2⁻¹⁰ m, 0 on bare terrain."""
        noise = streams.noise(self.period_m, self.period_m / 2)
        return self.grow(noise, maps)

    def grow(self, noise: ndarray, maps: DrawnMaps) -> ndarray:
        """Return heights that increase with the noise, 0 on bare terrain.

        On each map, vegetation covers the fraction `cover` of each class's cells, to
        within a cell, and its heights are uniform. Cover and heights depend only on the
        ranks of the noise within the class, so patches do not reveal the class among
        look-alikes.

        Args:
            noise: smooth noise, shape [B, H, W].
            maps: terrain below the vegetation.

        Returns:
            Metres, float64, shape [B, H, W].
        """
        flat_id = maps.class_id.reshape(len(noise), -1)
        flat = noise.reshape(len(noise), -1)
        height_m = np.zeros(noise.shape)
        heights = height_m.reshape(len(noise), -1)
        for class_id, item in enumerate(maps.classes):
            growth = self.classes.get(item.name)
            if growth is None:
                continue
            cells = flat_id == class_id
            n_cells = cells.sum(axis=1, keepdims=True)
            n_overgrown = np.rint(growth.cover * n_cells)
            descending = np.where(cells, -flat, np.inf)
            order = np.argsort(descending, axis=1, kind="stable")
            ranks = np.arange(flat.shape[1])[None]
            rank = np.empty_like(order)
            np.put_along_axis(rank, order, ranks, axis=1)
            low, high = growth.height_m
            fraction = 1 - (rank + 0.5) / np.maximum(n_overgrown, 1)
            grown = low + (high - low) * fraction
            overgrown = cells & (rank < n_overgrown)
            heights[:] = np.where(overgrown, grown, heights)
        return quantise(height_m, 10)

    def look(self, rgb: ndarray, values: ndarray, maps: DrawnMaps) -> ndarray:
        """Return colours with the terrain hidden by vegetation; see `Layer.look`."""
        for name, growth in self.classes.items():
            cells = maps.cells_of(name) & (values > 0)
            colour = np.array(growth.colour, dtype=np.float64)[:, None, None]
            rgb = np.where(cells[:, None], colour, rgb)
        return rgb

    def class_weights(
        self, weights: ndarray, values: ndarray, maps: DrawnMaps
    ) -> ndarray:
        """Return the weights of the classes that may lie below each cell's vegetation.

        An overgrown cell looks like the overgrown cells of all classes on its map that
        have vegetation of the same colour. The weight of a class is its cover. If the
        terrain of these classes has the same colour too, an image contains no further
        information about the class. Otherwise, bare terrain next to a patch indicates
        the class in the patch, and a model that uses neighbouring cells can predict
        better.
        """
        weights = weights.copy()
        overgrown = values > 0
        growths = [self.classes.get(item.name) for item in maps.classes]
        is_shown = []
        for class_id in range(len(growths)):
            cells = maps.class_id == class_id
            is_shown.append(cells.any(axis=(1, 2), keepdims=True))
        for class_id, growth in enumerate(growths):
            cells = overgrown & (maps.class_id == class_id)
            if not cells.any():
                continue
            for candidate_id, candidate in enumerate(growths):
                weight: ndarray | float = 0.0
                if growth is None:
                    weight = float(candidate_id == class_id)
                elif candidate is not None and candidate.colour == growth.colour:
                    weight = candidate.cover * is_shown[candidate_id]
                old_weight = weights[:, candidate_id]
                weights[:, candidate_id] = np.where(cells, weight, old_weight)
        return weights

    def describe(self) -> str:
        """Return a description of the layer, with the period of the patches."""
        return f"vegetation in patches with a period of {self.period_m:g} m"

    def describe_class(self, name: str) -> str:
        """Return cover, colour and heights on a class, as text."""
        growth = self.classes.get(name)
        if growth is None:
            return ""
        low, high = growth.height_m
        return f"{growth.cover:.0%} #{bytes(growth.colour).hex()} {low:g}–{high:g} m"

    def class_columns(self, name: str) -> dict[str, float | str]:
        """Return the properties of a class's vegetation, keyed by column name.

        Without vegetation, they are 0, and "" for the colour.
        """
        cover = low = high = 0.0
        colour = ""
        growth = self.classes.get(name)
        if growth is not None:
            cover = growth.cover
            low, high = growth.height_m
            colour = f"#{bytes(growth.colour).hex()}"
        return {
            "vegetation_cover": cover,
            "vegetation_least_m": low,
            "vegetation_most_m": high,
            "vegetation_colour": colour,
        }

    def scaled(self, factor: float, resolution_m: float) -> Self:
        """Return the layer with its period scaled, to at least two cells of a map."""
        period_m = float(f"{self.period_m * factor:.6g}")
        min_m = 2 * resolution_m
        return replace(self, period_m=max(min_m, period_m))


def read_keys(data: Mapping[str, Any]) -> tuple[Vegetation | None, dict[str, Any]]:
    """Return the vegetation of a recipe, and the recipe without the vegetation's keys.

    Args:
        data: recipe as plain data.

    Returns:
        The layer, or None if no class has vegetation; and the plain data without the
        keys of vegetation.

    Raises:
        ConfigError: If the values of these keys are invalid.
    """
    recipe = dict(data)
    rows = data.get("classes")
    period_m = recipe.pop("vegetation_period_m", 0.0)
    growths = {}
    if isinstance(rows, list | tuple):
        items = [item for item in rows if isinstance(item, Mapping)]
        names = [str(item.get("name")) for item in items]
        for name, item in zip(names, items, strict=True):
            if item.get("vegetation"):
                growths[name] = item["vegetation"]
        recipe["classes"] = [_without_vegetation(item) for item in rows]
        is_distinct = len(set(names)) == len(names)
        expect(
            is_distinct or not growths,
            "each of the `classes` to have its own name if a class has `vegetation`, "
            "got two classes with the same name. Rename one.",
        )
    if growths:
        options = {"period_m": period_m, "classes": growths}
        return read(Vegetation, options, _key_of), recipe
    expect(
        not period_m,
        f"`vegetation_period_m` only if a class has `vegetation`, got {period_m}, "
        "although no class has `vegetation`. Leave `vegetation_period_m` out.",
    )
    return None, recipe


def write_classes(
    rows: list[dict[str, Any]], vegetation: Vegetation | None
) -> list[dict[str, Any]]:
    """Return the rows of a class table as plain data, with their `vegetation`."""
    growths = vegetation.classes if vegetation else {}
    written = []
    for row in rows:
        growth = growths.get(row["name"])
        if growth is not None:
            row = row | {"vegetation": plain(growth)}
        written.append(row)
    return written


def _without_vegetation(row: Any) -> Any:
    if not isinstance(row, Mapping):
        return row
    return {key: value for key, value in row.items() if key != "vegetation"}


def _key_of(key: str) -> str:
    """Return the recipe key that sets an option of the layer, as messages name it."""
    head, _, tail = key.partition(".")
    name, _, inner = tail.partition(".")
    if head == "classes" and name:
        dot = "." if inner else ""
        return f"`classes.{name}.vegetation{dot}{inner}`"
    return f"`vegetation_{key}`" if key else "vegetation"
