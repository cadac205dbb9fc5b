"""Base class of layers: stored map, drawing, appearance, and effect on λ.

A layer is a frozen dataclass whose fields are its settings. Its class attributes
describe the stored map, which is float32 without NaN. A subclass must only override
`draw`: by default, a layer is invisible and does not change λ. The result of a method
must depend only on settings and arguments. The result for a map must not depend on the
other maps of a batch. Letters in shapes: B maps, H×W cells, C classes.
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
    """Random streams of a layer.

    The numbers of a map are the same in any batch, order or process. Two draws of the
    same kind and name return the same numbers, so a layer that draws several times must
    give each draw another name.

    Args:
        seed: root seed of the recipe.
        names: names of the streams: split, layer, and number of rejected draws.
        indices: indices of the maps in the split, shape [B].
        grid: size and resolution of the maps.
    """

    seed: int
    names: tuple[rng.Name, ...]
    indices: ndarray
    grid: Grid

    def noise(self, *periods_m: float, name: str = "") -> ndarray:
        """Return smooth noise in about [−0.7, 0.7], shape [B, H, W].

        Args:
            periods_m: lattice spacing of each octave in metres.
            name: name of the draw.
        """
        names = (*self.names, name) if name else self.names
        periods = [period / self.grid.resolution_m for period in periods_m]
        return fractal_perlin(self.seed, names, self.indices, self.grid.shape, periods)

    def normal(self, name: str) -> ndarray:
        """Return standard normal numbers, one per cell, shape [B, H, W]."""
        return rng.normal(self._key(name), self.indices, self.grid.shape)

    def uniform(self, name: str, shape: tuple[int, ...] = ()) -> ndarray:
        """Return numbers in (0, 1), shape [B, *shape]; by default, one per map."""
        return rng.uniform(self._key(name), self.indices, shape)

    def _key(self, name: str) -> int:
        return rng.stream_key(self.seed, *self.names, name)


@dataclass(frozen=True)
class DrawnMaps:
    """Terrain of maps without layers.

    Args:
        class_id: index into the class table, 255 for unlabelled cells of imported maps,
            shape [B, H, W].
        elevation_m: elevation in metres, shape [B, H, W].
        slope_deg: slope in degrees, shape [B, H, W].
        grid: size and resolution of the maps.
        classes: class table.
    """

    class_id: ndarray
    elevation_m: ndarray
    slope_deg: ndarray
    grid: Grid
    classes: ClassTable

    def cells_of(self, *names: str) -> ndarray:
        """Return a mask of the cells of some classes, bool, shape [B, H, W].

        Raises:
            ConfigError: If a name is not in the class table.
        """
        ids = {item.name: class_id for class_id, item in enumerate(self.classes)}
        for name in names:
            check_known("a class of the recipe", name, ids)
        return np.isin(self.class_id, [ids[name] for name in names])


class Layer:
    """Map of a property of the terrain, drawn by a recipe and available to models.

    Attributes:
        name: name of the stored field and of the model input: letters, digits and `_`,
            not beginning with a digit. A name that ends in `_azimuth_deg` names a
            direction.
        unit: SI unit, "deg", or "1" for no unit.
        minimum: smallest valid value.
        maximum: largest valid value.
        meaning: description for readers of the dataset, in one line.
        stream: names of the layer's random streams; if empty, the layer's name.
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
            grid: size and resolution of the maps.
            classes: class table.
            colours: tinted colours of the classes in full light by scenario, 0–255,
                each of shape [C, 3].

        Raises:
            ConfigError: If a setting does not fit.
        """

    def draw(self, streams: Streams, maps: DrawnMaps) -> ndarray:
        """Draw the values of the layer.

        Args:
            streams: random streams of the maps.
            maps: terrain below the layer.

        Returns:
            Values in `unit`, shape [B, H, W]. They are stored in single precision.
        """
        raise NotImplementedError

    def look(self, rgb: ndarray, values: ndarray, maps: DrawnMaps) -> ndarray:
        """Return the colours of the terrain with the layer, in full light.

        Args:
            rgb: colours without this layer, after tints and earlier layers, 0–255,
                float64, shape [B, 3, H, W].
            values: stored values of the layer, float64, shape [B, H, W].
            maps: terrain below the layer.
        """
        return rgb

    def affect(
        self, mean: ndarray, std: ndarray, values: ndarray, maps: DrawnMaps
    ) -> tuple[ndarray, ndarray]:
        """Return the distribution of λ with the layer.

        The method is called for each component of λ: for the latent functions of the
        classes, and, if a class has soft spots, for the soft spots.

        Args:
            mean: mean of the normal distribution of λ before clipping, without the
                layer, in [0, 1], shape [B, H, W].
            std: standard deviation of that distribution, in (0, 1], shape [B, H, W].
            values: stored values of the layer, float64, shape [B, H, W].
            maps: terrain below the layer.

        Returns:
            Mean in [0, 1] and standard deviation in (0, 1], each of shape [B, H, W].
        """
        return mean, std

    def class_weights(
        self, weights: ndarray, values: ndarray, maps: DrawnMaps
    ) -> ndarray:
        """Return class probabilities given an image with the layer, for model `ideal`.

        A layer that hides the colour of classes must override this method. The weights
        need not sum to 1.

        Args:
            weights: class probabilities given the colours without the layer, shape [B,
                C, H, W].
            values: stored values of the layer, float64, shape [B, H, W].
            maps: terrain below the layer.
        """
        return weights

    def describe(self) -> str:
        """Return a short description of the layer and its settings, for `show`."""
        settings = [f"{name} {value}" for name, value in self.settings().items()]
        if not settings:
            return f"layer {self.name}"
        return f"layer {self.name} ({', '.join(settings)})"

    def describe_class(self, name: str) -> str:
        """Return a description of the layer on a class; by default, an empty text."""
        return ""

    def class_columns(self, name: str) -> dict[str, float | str]:
        """Return a class's values in the layer's columns of an exported class table.

        All classes must have the same columns.
        """
        return {}

    def scaled(self, factor: float, resolution_m: float) -> Self:
        """Return the layer for maps of another size.

        Args:
            factor: ratio of new to old lengths of the map.
            resolution_m: new cell width in metres.
        """
        return self

    @classmethod
    def affects(cls) -> bool:
        """Return whether the layer changes the distribution of λ."""
        return cls.affect is not Layer.affect

    @classmethod
    def hides(cls) -> bool:
        """Return whether the layer changes the classes that an image shows."""
        return cls.class_weights is not Layer.class_weights

    def settings(self) -> dict[str, Any]:
        """Return the values of the layer's dataclass fields by name."""
        if not is_dataclass(self):
            return {}
        return {item.name: getattr(self, item.name) for item in fields(self)}

    @classmethod
    def field(cls) -> Field:
        """Return the description of the stored field."""
        return Field("<f4", ("H", "W"), cls.unit, cls.minimum, cls.maximum, cls.meaning)
