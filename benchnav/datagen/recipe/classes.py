"""Terrain classes: their looks, and what their latent traversability (LT) functions are made of.

Beyond the paper, a class may have soft spots, a second mode of λ that neither colour nor slope shows,
classes may share a colour, and vegetation may hide the colour of the ground.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from benchnav.core.errors import check_label, expect
from benchnav.core.settings import plain

LEAST_HEIGHT_M, MOST_HEIGHT_M = 0.01, 100.0  # of vegetation


@dataclass(frozen=True, kw_only=True)
class SoftSpots:
    """Ground of a class that is soft for no reason one could see: buried loose sand, a wet patch.

    Args:
        weight: share of the class's ground, in (0, 1).
        mean: λ there before clipping, at any slope.
        std: its standard deviation, > 0.
    """

    weight: float
    mean: float
    std: float

    def __post_init__(self) -> None:
        """Refuses values that make no distribution."""
        expect(
            0 < self.weight < 1 and 0 <= self.mean <= 1 and 0 < self.std <= 1,
            "soft spots of `weight` in (0, 1), `mean` in [0, 1] and `std` in (0, 1], "
            f"got {self.weight}, {self.mean} and {self.std}.",
        )


@dataclass(frozen=True, kw_only=True)
class Vegetation:
    """What grows on some of a class's ground, and hides its colour. λ of the ground stays what it is.

    Args:
        height_m: least and greatest height, in metres; heights are uniform between them.
        cover: share of the class's ground that is overgrown, in (0, 1].
        colour: RGB in full light, 0–255.
    """

    height_m: tuple[float, float]
    cover: float
    colour: tuple[int, int, int]

    def __post_init__(self) -> None:
        """Refuses what does not grow."""
        low, high = self.height_m
        expect(
            LEAST_HEIGHT_M <= low <= high <= MOST_HEIGHT_M,
            f"`height_m` of vegetation ordered and within [{LEAST_HEIGHT_M:g}, {MOST_HEIGHT_M:g}], "
            f"got {list(self.height_m)}.",
        )
        expect(0 < self.cover <= 1, f"`cover` of vegetation in (0, 1], got {self.cover}.")
        _check_colour("vegetation", self.colour)


@dataclass(frozen=True, kw_only=True)
class TerrainClass:
    """A terrain class: its looks and its LT function.

    Args:
        name: what people call it.
        colour: RGB in full light, 0–255.
        scale: a_c, in [1, 9] in the shipped table.
        exponent: b_c, in [1.4, 2.0] in the shipped table.
        offset: o_c, loss on flat ground, in [0, 0.1] in the shipped table.
        noise: σ_c, in [0.1, 0.2] in the shipped table.
        soft: its soft spots, if it has any.
        vegetation: what grows on it, if anything does.
    """

    name: str
    colour: tuple[int, int, int]
    scale: float
    exponent: float
    offset: float
    noise: float
    soft: SoftSpots | None = None
    vegetation: Vegetation | None = None

    def __post_init__(self) -> None:
        """Refuses values that make no LT function or no colour."""
        check_label("`name` of a class", self.name)
        _check_colour(f"class {self.name!r}", self.colour)
        numbers = self.scale, self.exponent, self.offset, self.noise
        expect(
            np.isfinite(numbers).all() and self.scale >= 0 and self.exponent > 0 and self.noise > 0,
            f"`scale` ≥ 0, `exponent` > 0 and `noise` > 0 of class {self.name!r}, "
            f"got {self.scale}, {self.exponent} and {self.noise}.",
        )


ClassTable = tuple[TerrainClass, ...]


def plain_classes(classes: ClassTable) -> list[dict[str, Any]]:
    """Gives a class table as plain data; `vegetation` stands only where something grows, so that digests stay."""
    rows = [plain(item) for item in classes]
    return [{key: value for key, value in row.items() if key != "vegetation" or value} for row in rows]


def look_alike_classes(classes: ClassTable) -> list[tuple[int, ...]]:
    """Classes that share a colour, by class: of each class those that look like it, itself among them."""
    return [tuple(i for i, c in enumerate(classes) if c.colour == own.colour) for own in classes]


def _check_colour(of: str, colour: tuple[int, int, int]) -> None:
    expect(all(0 <= value <= 255 for value in colour), f"`colour` of {of} in 0–255, got {colour}.")
