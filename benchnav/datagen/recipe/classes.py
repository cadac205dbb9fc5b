"""Terrain classes: their looks, and what their latent traversability (LT) functions are
made of.

Beyond the paper, a class may have soft spots, a second mode of λ that neither colour
nor slope shows, and classes may share a colour.
"""

from dataclasses import dataclass

import numpy as np

from benchnav.core.errors import check_label, expect


@dataclass(frozen=True, kw_only=True)
class SoftSpots:
    """Ground of a class that is soft for no reason one could see: buried loose sand, a
    wet patch.

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
    """

    name: str
    colour: tuple[int, int, int]
    scale: float
    exponent: float
    offset: float
    noise: float
    soft: SoftSpots | None = None

    def __post_init__(self) -> None:
        """Refuses values that make no LT function or no colour."""
        check_label("`name` of a class", self.name)
        check_colour(f"class {self.name!r}", self.colour)
        numbers = self.scale, self.exponent, self.offset, self.noise
        expect(
            np.isfinite(numbers).all()
            and self.scale >= 0
            and self.exponent > 0
            and self.noise > 0,
            f"`scale` ≥ 0, `exponent` > 0 and `noise` > 0 of class {self.name!r}, "
            f"got {self.scale}, {self.exponent} and {self.noise}.",
        )


ClassTable = tuple[TerrainClass, ...]


def look_alike_classes(classes: ClassTable) -> list[tuple[int, ...]]:
    """Classes that share a colour, by class: of each class those that look like it,
    itself among them.
    """
    return [
        tuple(i for i, c in enumerate(classes) if c.colour == own.colour)
        for own in classes
    ]


def check_colour(of: str, colour: tuple[int, int, int]) -> None:
    """Check that a colour is one of 8 bits a channel.

    Raises:
        ConfigError: If it is not, with `of` in its message.
    """
    expect(
        all(0 <= value <= 255 for value in colour),
        f"`colour` of {of} in 0–255, got {colour}.",
    )
