"""Vegetation: a layer that hides the terrain's colour and does not change λ.

Recipes describe it by `vegetation` of a class and by `vegetation_period_m`. Letters in
shapes: B maps, H×W cells, C classes.
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
        cover: fraction of the class's cells that is overgrown, in (0, 1].
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
        """Properties that an image shows, as text: colour and cover."""
        return f"{list(self.colour)} on {self.cover:.6g}"


@dataclass(frozen=True, kw_only=True)
class Vegetation(Layer):
    """Vegetation in patches, by one noise for all classes.

    Args:
        period_m: lattice spacing of the noise in metres, at least two cells; a patch is
            about half as wide.
        classes: vegetation by class.
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
        """Check that its colours neither create nor separate look-alike classes.

        Heights may separate them. The arguments are those of `Layer.check`.
        """
        min_m = 2 * grid.resolution_m
        expect(
            min_m <= self.period_m < np.inf,
            f"`vegetation_period_m` of at least two cells, {min_m:g} m, where a class "
            f"has `vegetation`, got {self.period_m:g}.",
        )
        names = [item.name for item in classes]
        for name in self.classes:
            check_known("classes of layer 'vegetation'", name, names)
        shown = []
        for name in names:
            growth = self.classes.get(name)
            shown.append(growth.appearance if growth else "none")
        for class_id, alike in enumerate(look_alike_classes(classes)):
            first = alike[0]
            if shown[first] != shown[class_id]:
                raise ConfigError(
                    "Expected `vegetation` of one `colour` and `cover` on "
                    f"{names[first]!r} and {names[class_id]!r}, whose terrain has one "
                    f"colour, got {shown[first]} and {shown[class_id]}. Only "
                    "`height_m` may differ."
                )
        for scenario, class_colours in colours.items():
            for name, growth in self.classes.items():
                is_same = (class_colours == growth.colour).all(axis=1)
                same_ids = np.flatnonzero(is_same)
                same = [repr(names[class_id]) for class_id in same_ids]
                expect(
                    not same,
                    f"vegetation on {name!r} of a `colour` that no terrain has in "
                    f"scenario {scenario!r}, got that of {', '.join(same)}.",
                )

    def draw(self, streams: Streams, maps: DrawnMaps) -> ndarray:
        """Return drawn heights in steps of 2⁻¹⁰ m, 0 on bare terrain."""
        noise = streams.noise(self.period_m, self.period_m / 2)
        return self.grow(noise, maps)

    def grow(self, noise: ndarray, maps: DrawnMaps) -> ndarray:
        """Return heights that increase with the noise, 0 on bare terrain.

        On each map, vegetation covers the fraction `cover` of each class's cells, to
        within a cell, and its heights are uniform. Cover and heights follow the noise's
        ranks within the class, so patches do not reveal the class among look-alikes.

        Args:
            noise: smooth noise, shape [B, H, W].
            maps: the terrain below.

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
        """Return weights of the classes that may lie below vegetation of one colour.

        An overgrown cell looks like the overgrown cells of all classes on its map that
        have vegetation of the same colour. The weight of a class is its cover. If these
        classes also have one terrain colour, an image contains no more information. If
        they do not, bare terrain next to a patch indicates the class within it, and a
        model that uses the neighbourhood can predict better.
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
        """Return a description with the size of the patches."""
        return f"vegetation in patches with a period of {self.period_m:g} m"

    def describe_class(self, name: str) -> str:
        """Return cover, colour and heights on a class, as text."""
        growth = self.classes.get(name)
        if growth is None:
            return ""
        low, high = growth.height_m
        return f"{growth.cover:.0%} #{bytes(growth.colour).hex()} {low:g}–{high:g} m"

    def class_columns(self, name: str) -> dict[str, float | str]:
        """Return cover, heights and colour on a class; 0 and empty without vegetation."""
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
        """Return the layer with its period scaled with the map, of at least two cells."""
        period_m = float(f"{self.period_m * factor:.6g}")
        min_m = 2 * resolution_m
        return replace(self, period_m=max(min_m, period_m))


def read_keys(data: Mapping[str, Any]) -> tuple[Vegetation | None, dict[str, Any]]:
    """Return the vegetation of a recipe: `vegetation` of classes, and its period.

    Args:
        data: a recipe as plain data.

    Returns:
        The layer, or None without vegetation; and the recipe without the keys of
        vegetation.

    Raises:
        ConfigError: If the keys are invalid.
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
            "classes of different names where one has `vegetation`, got two of one "
            "name. Rename one.",
        )
    if growths:
        options = {"period_m": period_m, "classes": growths}
        return read(Vegetation, options, _key_of), recipe
    expect(
        not period_m,
        f"`vegetation_period_m` only with `vegetation` of a class, got {period_m}. "
        "Leave it out.",
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
    """Return the name of an option of the layer as a recipe's key."""
    head, _, tail = key.partition(".")
    name, _, inner = tail.partition(".")
    if head == "classes" and name:
        dot = "." if inner else ""
        return f"`classes.{name}.vegetation{dot}{inner}`"
    return f"`vegetation_{key}`" if key else "vegetation"
