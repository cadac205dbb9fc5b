"""Base class of layers: stored map, drawing, appearance, and effect on λ.

A layer is a frozen dataclass whose fields are its settings. Its class attributes
describe the stored map, which is float32 without NaN. Only `draw` is required: by
default, a layer is invisible and does not change λ. All methods are pure functions of
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
    """Random streams of a layer.

    The numbers of a map are the same in any batch, order or process. Two draws of the
    same kind and name return the same numbers, so a layer that draws several times must
    name each draw.

    Args:
        seed: root seed of the recipe.
        names: split, layer and number of previously rejected draws.
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
    """Terrain of maps below their layers.

    Args:
        class_id: index into the class table; 255 is unlabelled, as in imported maps;
            shape [B, H, W].
        elevation_m: elevation in metres, shape [B, H, W].
        slope_deg: slope in degrees, shape [B, H, W].
        grid: size and resolution of the maps.
        classes: the class table.
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
        name: name of the stored field and of the input of models: letters, digits and
            `_`, not beginning with a digit. A name that ends in `_azimuth_deg` is a
            direction.
        unit: SI unit, or "1".
        minimum: smallest valid value.
        maximum: largest valid value.
        meaning: one line for readers of the dataset.
        stream: names of its random streams; by default, its name.
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
            classes: the class table.
            colours: for each scenario, the tinted colours of the classes in full light,
                0–255, shape [C, 3].

        Raises:
            ConfigError: If they do not fit.
        """

    def draw(self, streams: Streams, maps: DrawnMaps) -> ndarray:
        """Return drawn values of B maps, in `unit`, shape [B, H, W].

        Args:
            streams: random numbers of the maps.
            maps: the terrain below.

        Returns:
            Values, which are stored in single precision.
        """
        raise NotImplementedError

    def look(self, rgb: ndarray, values: ndarray, maps: DrawnMaps) -> ndarray:
        """Return the colours of the terrain with the layer, in full light.

        Args:
            rgb: colours without this layer, after tints and earlier layers, 0–255,
                float64, shape [B, 3, H, W].
            values: values as stored, float64, shape [B, H, W].
            maps: the terrain below.
        """
        return rgb

    def affect(
        self, mean: ndarray, std: ndarray, values: ndarray, maps: DrawnMaps
    ) -> tuple[ndarray, ndarray]:
        """Return the distribution of λ with the layer.

        It is called once for the latent function of the class, and once for its soft
        spots.

        Args:
            mean: mean of the normal distribution of λ before clipping, without the
                layer, in [0, 1], shape [B, H, W].
            std: standard deviation of that distribution, in (0, 1], shape [B, H, W].
            values: values as stored, float64, shape [B, H, W].
            maps: the terrain below.

        Returns:
            Mean in [0, 1] and standard deviation in (0, 1], each of shape [B, H, W].
        """
        return mean, std

    def class_weights(
        self, weights: ndarray, values: ndarray, maps: DrawnMaps
    ) -> ndarray:
        """Return class probabilities given an image with the layer, for model `ideal`.

        A layer that hides the colour of classes overrides this; weights need not sum to
        1.

        Args:
            weights: class probabilities given the colours without the layer, shape [B,
                C, H, W].
            values: values as stored, float64, shape [B, H, W].
            maps: the terrain below.
        """
        return weights

    def describe(self) -> str:
        """Return a short description of the layer and its settings, for `show`."""
        settings = [f"{name} {value}" for name, value in self.settings().items()]
        if not settings:
            return f"layer {self.name}"
        return f"layer {self.name} ({', '.join(settings)})"

    def describe_class(self, name: str) -> str:
        """Return a description of the layer on a class; by default, it is empty."""
        return ""

    def class_columns(self, name: str) -> dict[str, float | str]:
        """Return the layer's columns of an exported class table, for one class.

        All classes must have the same columns.
        """
        return {}

    def scaled(self, factor: float, resolution_m: float) -> Self:
        """Return the layer for maps of another size.

        Args:
            factor: factor of all lengths of the map.
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
