"""Vegetation: it hides the colour of the terrain on some cells of a class, and leaves λ
as it is.

Recipes write it as `vegetation` of a class and as `vegetation_period_m`. Letters in
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

MIN_HEIGHT_M, MAX_HEIGHT_M = 0.01, 100.0


@dataclass(frozen=True, kw_only=True)
class Growth:
    """What grows on some cells of a class.

    Args:
        height_m: least and greatest height, in metres; heights are uniform between
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
            f"{MAX_HEIGHT_M:g}], "
            f"got {list(self.height_m)}.",
        )
        expect(
            0 < self.cover <= 1, f"`cover` of vegetation in (0, 1], got {self.cover}."
        )
        check_colour("vegetation", self.colour)

    @property
    def appearance(self) -> str:
        """What a picture shows of it: colour and cover."""
        return f"{list(self.colour)} on {self.cover:.6g}"


@dataclass(frozen=True, kw_only=True)
class Vegetation(Layer):
    """Vegetation on classes, in patches by one noise for all of them.

    Args:
        period_m: lattice spacing of the noise, at least two cells: a patch is about
            half as wide.
        classes: what grows, by class.
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
        """Check that it neither makes classes look alike nor tells look-alikes apart,
        but by its height.
        """
        min_m = 2 * grid.resolution_m
        expect(
            min_m <= self.period_m < np.inf,
            f"`vegetation_period_m` of at least two cells, {min_m:g} m, where a class "
            "has `vegetation`, "
            f"got {self.period_m:g}.",
        )
        names = [item.name for item in classes]
        for name in self.classes:
            check_known("classes of layer 'vegetation'", name, names)
        growths = [self.classes.get(name) for name in names]
        shown = [growth.appearance if growth else "none" for growth in growths]
        for number, alike in enumerate(look_alike_classes(classes)):
            if shown[alike[0]] != shown[number]:
                raise ConfigError(
                    "Expected `vegetation` of one `colour` and `cover` on "
                    f"{names[alike[0]]!r} and "
                    f"{names[number]!r}, whose ground has one colour, got "
                    f"{shown[alike[0]]} and {shown[number]}. "
                    "Only `height_m` may tell them apart."
                )
        for scenario, ground in colours.items():
            for name, growth in self.classes.items():
                is_same = (ground == growth.colour).all(axis=1)
                same = [repr(names[number]) for number in np.flatnonzero(is_same)]
                expect(
                    not same,
                    f"vegetation on {name!r} of a `colour` that no ground has in "
                    f"scenario {scenario!r}, "
                    f"got that of {', '.join(same)}.",
                )

    def draw(self, streams: Streams, maps: DrawnMaps) -> ndarray:
        """Draw heights in steps of 2⁻¹⁰ m, 0 on bare ground."""
        return self.grow(streams.noise(self.period_m, self.period_m / 2), maps)

    def grow(self, noise: ndarray, maps: DrawnMaps) -> ndarray:
        """Grow vegetation where the noise is greatest, the higher the greater it is.

        On each map it covers the fraction `cover` of each class's cells, to within a
        cell, and takes all heights of the class equally often. It goes by ranks within
        the class, so where it grows does not show on which of two look-alike classes it
        is.

        Args:
            noise: shape [B, H, W].
            maps: what lies below.
        """
        flat_id, height_m = maps.class_id.reshape(len(noise), -1), np.zeros(noise.shape)
        flat, heights = noise.reshape(len(noise), -1), height_m.reshape(len(noise), -1)
        for number, item in enumerate(maps.classes):
            growth = self.classes.get(item.name)
            if growth is None:
                continue
            cells = flat_id == number
            n_overgrown = np.rint(growth.cover * cells.sum(axis=1, keepdims=True))
            order = np.argsort(np.where(cells, -flat, np.inf), axis=1, kind="stable")
            rank = np.empty_like(order)
            np.put_along_axis(rank, order, np.arange(flat.shape[1])[None], axis=1)
            low, high = growth.height_m
            fraction = 1 - (rank + 0.5) / np.maximum(n_overgrown, 1)
            heights[:] = np.where(
                cells & (rank < n_overgrown), low + (high - low) * fraction, heights
            )
        return quantise(height_m, 10)

    def look(self, rgb: ndarray, values: ndarray, maps: DrawnMaps) -> ndarray:
        """Hide the terrain below vegetation."""
        for name, growth in self.classes.items():
            cells = maps.cells_of(name) & (values > 0)
            rgb = np.where(
                cells[:, None],
                np.array(growth.colour, dtype=np.float64)[:, None, None],
                rgb,
            )
        return rgb

    def class_weights(
        self, weights: ndarray, values: ndarray, maps: DrawnMaps
    ) -> ndarray:
        """Weigh the classes that may lie below vegetation of one colour by their cover.

        An overgrown cell looks like those of all classes of its map on which the same
        grows. Where these have one ground colour too, this is all that a whole picture
        tells. Where they have not, bare ground next to a patch hints at the ground
        within, so that a model that looks around can do better than this.
        """
        weights, overgrown = weights.copy(), values > 0
        growths = [self.classes.get(item.name) for item in maps.classes]
        numbers = range(len(growths))
        is_shown = [
            (maps.class_id == number).any(axis=(1, 2))[:, None, None]
            for number in numbers
        ]
        for number, growth in enumerate(growths):
            cells = overgrown & (maps.class_id == number)
            if not cells.any():
                continue
            for other, candidate in enumerate(growths):
                weight: ndarray | float = float(other == number)
                if growth is not None:
                    is_alike = (
                        candidate is not None and candidate.colour == growth.colour
                    )
                    weight = (
                        candidate.cover * is_shown[other]
                        if candidate and is_alike
                        else 0.0
                    )
                weights[:, other] = np.where(cells, weight, weights[:, other])
        return weights

    def describe(self) -> str:
        """Return the size of its patches in words."""
        return f"vegetation in patches with a period of {self.period_m:g} m"

    def describe_class(self, name: str) -> str:
        """Return cover, colour and heights on a class, in words."""
        growth = self.classes.get(name)
        if growth is None:
            return ""
        low, high = growth.height_m
        return f"{growth.cover:.0%} #{bytes(growth.colour).hex()} {low:g}–{high:g} m"

    def class_columns(self, name: str) -> dict[str, float | str]:
        """Return cover, heights and colour on a class, 0 and empty where nothing grows."""
        growth = self.classes.get(name)
        low, high = growth.height_m if growth else (0.0, 0.0)
        return {
            "vegetation_cover": growth.cover if growth else 0.0,
            "vegetation_least_m": low,
            "vegetation_most_m": high,
            "vegetation_colour": f"#{bytes(growth.colour).hex()}" if growth else "",
        }

    def scaled(self, factor: float, resolution_m: float) -> Self:
        """Return it with patches on the same part of a map, of at least two cells."""
        return replace(
            self, period_m=max(2 * resolution_m, float(f"{self.period_m * factor:.6g}"))
        )


def read_keys(data: Mapping[str, Any]) -> tuple[Vegetation | None, dict[str, Any]]:
    """Read vegetation as recipes write it, `vegetation` of classes and
    `vegetation_period_m`.

    Args:
        data: a recipe as plain data.

    Returns:
        The layer, None if the recipe has none; and the rest of the recipe.

    Raises:
        ConfigError: If it is not usable as given.
    """
    rest, rows = dict(data), data.get("classes")
    period_m = rest.pop("vegetation_period_m", 0.0)
    growths = {}
    if isinstance(rows, list | tuple):
        items = [item for item in rows if isinstance(item, Mapping)]
        growths = {
            str(item.get("name")): item["vegetation"]
            for item in items
            if item.get("vegetation")
        }
        rest["classes"] = [_without_vegetation(item) for item in rows]
        names = {str(item.get("name")) for item in items}
        expect(
            not growths or len(names) == len(items),
            "classes of different names where one has `vegetation`, got two of one "
            "name. Rename one.",
        )
    if growths:
        return read(
            Vegetation, {"period_m": period_m, "classes": growths}, _key_of
        ), rest
    expect(
        not period_m,
        f"`vegetation_period_m` with `vegetation` of a class, got {period_m} and "
        "none. Leave it out.",
    )
    return None, rest


def write_classes(
    rows: list[dict[str, Any]], vegetation: Vegetation | None
) -> list[dict[str, Any]]:
    """Return the rows of a class table, as plain data, with `vegetation` where
    something grows.
    """
    growths = vegetation.classes if vegetation else {}
    return [
        row | {"vegetation": plain(growths[row["name"]])}
        if row["name"] in growths
        else row
        for row in rows
    ]


def _without_vegetation(row: Any) -> Any:
    if not isinstance(row, Mapping):
        return row
    return {key: value for key, value in row.items() if key != "vegetation"}


def _key_of(key: str) -> str:
    """Name an option of the layer as a recipe's keys do."""
    head, _, tail = key.partition(".")
    name, _, inner = tail.partition(".")
    if head == "classes" and name:
        return f"`classes.{name}.vegetation{'.' * bool(inner)}{inner}`"
    return f"`vegetation_{key}`" if key else "vegetation"
