"""The base class of layers: what is stored, how it is drawn, how it looks, and what it
does to λ.

A layer is a frozen dataclass. Its fields are its settings; its class attributes
describe the map that is stored, float32 and NaN-free. Only `draw` is required: by
default a layer shows nothing and leaves λ as it is. All methods are pure functions of
their arguments, for any batch of maps. Letters in shapes: B maps, H×W cells, C classes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy import ndarray

from benchnav.core import rng
from benchnav.core.grid import Grid
from benchnav.core.settings import check_known
from benchnav.datagen.noise import fractal_perlin
from benchnav.datagen.recipe.classes import ClassTable
from benchnav.datagen.schema import Field


@dataclass(frozen=True)
class Streams:
    """Random streams of a layer: the numbers of a map are the same in any batch, order
    or process.

    Draws of one kind and one name are the same numbers, so a layer that draws several
    times names each draw.

    Args:
        seed: root seed of the recipe.
        names: of the split, the layer and the number of rejected draws before.
        indices: which maps of the split, shape [B].
        grid: size and resolution.
    """

    seed: int
    names: tuple[rng.Name, ...]
    indices: ndarray
    grid: Grid

    def noise(self, *periods_m: float, name: str = "") -> ndarray:
        """Smooth noise in about [−0.7, 0.7] with a lattice spacing an octave, in
        metres; shape [B, H, W].
        """
        names = (*self.names, name) if name else self.names
        periods = [period / self.grid.resolution_m for period in periods_m]
        return fractal_perlin(self.seed, names, self.indices, self.grid.shape, periods)

    def normal(self, name: str) -> ndarray:
        """Standard normal numbers, one a cell, shape [B, H, W]."""
        return rng.normal(self._key(name), self.indices, self.grid.shape)

    def uniform(self, name: str, shape: tuple[int, ...] = ()) -> ndarray:
        """Numbers in (0, 1), shape [B, *shape]; one a map by default."""
        return rng.uniform(self._key(name), self.indices, shape)

    def _key(self, name: str) -> int:
        return rng.stream_key(self.seed, *self.names, name)


@dataclass(frozen=True)
class DrawnMaps:
    """What is known of maps when their layers are drawn.

    Args:
        class_id: index into the class table; 255 where the class is not known, as in
            imported maps. Shape [B, H, W].
        elevation_m: shape [B, H, W].
        slope_deg: shape [B, H, W].
        grid: size and resolution.
        classes: the class table.
    """

    class_id: ndarray
    elevation_m: ndarray
    slope_deg: ndarray
    grid: Grid
    classes: ClassTable

    def cells_of(self, *names: str) -> ndarray:
        """Cells of some classes, bool, shape [B, H, W].

        Raises:
            ConfigError: If the table has no class of a name.
        """
        numbers = {item.name: number for number, item in enumerate(self.classes)}
        for name in names:
            check_known("a class of the recipe", name, numbers)
        return np.isin(self.class_id, [numbers[name] for name in names])


class Layer:
    """A map of the terrain that a recipe draws, and that models may see.

    Attributes:
        name: of the stored field and the input of models: letters, digits and `_`,
            beginning with no digit. A name that ends in `_azimuth_deg` is a direction.
        unit: SI unit, or "1".
        minimum: smallest value allowed.
        maximum: largest value allowed.
        meaning: one line for readers of the dataset.
        stream: names of its random streams; the default is its own name.
    """

    name: ClassVar[str] = ""
    unit: ClassVar[str] = "1"
    minimum: ClassVar[float] = -np.inf
    maximum: ClassVar[float] = np.inf
    meaning: ClassVar[str] = "layer of a recipe"
    stream: ClassVar[tuple[str, ...]] = ()

    def check(
        self, grid: Grid, classes: ClassTable, colours: Mapping[str, ndarray]
    ) -> None:
        """Check that the settings fit a recipe.

        Args:
            grid: size and resolution of maps.
            classes: the class table.
            colours: by scenario, the colours of the classes in full light after tints,
                0–255, shape [C, 3].

        Raises:
            ConfigError: If they do not.
        """

    def draw(self, streams: Streams, maps: DrawnMaps) -> ndarray:
        """Draw the values of B maps, in `unit`, shape [B, H, W]; stored in single
        precision.
        """
        raise NotImplementedError

    def look(self, rgb: ndarray, values: ndarray, maps: DrawnMaps) -> ndarray:
        """Return the colours in full light that the terrain has with the layer.

        Args:
            rgb: without it, after tints and earlier layers, 0–255, float64, shape [B,
                3, H, W].
            values: as stored, float64, shape [B, H, W].
            maps: what lies below.
        """
        return rgb

    def affect(
        self, mean: ndarray, std: ndarray, values: ndarray, maps: DrawnMaps
    ) -> tuple[ndarray, ndarray]:
        """Return the distribution of λ that the terrain has with the layer.

        Called once for the latent function of the class and once for its soft spots.

        Args:
            mean: of the normal distribution that λ is clipped from, without the layer,
                in [0, 1], shape [B, H, W].
            std: its standard deviation, in (0, 1], shape [B, H, W].
            values: as stored, float64, shape [B, H, W].
            maps: what lies below.

        Returns:
            Mean in [0, 1] and standard deviation in (0, 1], each of shape [B, H, W].
        """
        return mean, std

    def class_weights(
        self, weights: ndarray, values: ndarray, maps: DrawnMaps
    ) -> ndarray:
        """Return the probability of each class by what a picture shows at best, for the
        model `ideal`.

        A layer that hides the colour of classes overrides this; weights need not sum to
        1.

        Args:
            weights: of each class by colour without the layer, shape [B, C, H, W].
            values: as stored, float64, shape [B, H, W].
            maps: what lies below.
        """
        return weights

    def describe(self) -> str:
        """Return a few words on the layer and its settings, for `show`."""
        settings = ", ".join(
            f"{name} {value}" for name, value in self.settings().items()
        )
        return f"layer {self.name}" + (f" ({settings})" if settings else "")

    def describe_class(self, name: str) -> str:
        """Return what the layer is on a class, in words; empty if there is nothing to
        say.
        """
        return ""

    def class_columns(self, name: str) -> dict[str, float | str]:
        """Return what an exported class table has of the layer, by column, the same
        columns for all classes.
        """
        return {}

    def scaled(self, factor: float, resolution_m: float) -> Self:
        """Return the layer for maps whose lengths are multiplied by a factor, with
        cells of another width.
        """
        return self

    @classmethod
    def affects(cls) -> bool:
        """Return whether it changes the distribution of λ."""
        return cls.affect is not Layer.affect

    @classmethod
    def hides(cls) -> bool:
        """Return whether it changes which classes a picture shows."""
        return cls.class_weights is not Layer.class_weights

    def settings(self) -> dict[str, Any]:
        """Return the values of its fields by name; a class that is no dataclass has
        none.
        """
        return (
            {each.name: getattr(self, each.name) for each in fields(self)}
            if is_dataclass(self)
            else {}
        )

    @classmethod
    def field(cls) -> Field:
        """Return the stored field."""
        return Field("<f4", ("H", "W"), cls.unit, cls.minimum, cls.maximum, cls.meaning)
