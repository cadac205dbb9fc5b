"""Options of an import: elevation model, selection of maps, and further rasters."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from benchnav.core.errors import expect
from benchnav.datagen.dem.layer import LayerRaster, read_layer

MAX_MAPS = 20_000  # maximum number of maps of an import, unless more are allowed


@dataclass(frozen=True, kw_only=True)
class GroundOptions:
    """Options of the elevation model, and of cutting it into maps.

    Args:
        dem_unit: Unit of elevations: m, ft, us-ft, or the length of the unit in metres.
            If empty, the unit that the raster declares.
        origin: South-west corner of the first map, [X,Y] in the coordinate reference
            system of the maps.
        max_maps: Maximum number of maps. If there are more, the import fails, and the
            error contains a command for fewer maps.
        coarse: Allow an elevation model with cells at least three times as wide as the
            cells of the maps.
    """

    dem_unit: str = ""
    origin: tuple[float, float] | None = None
    max_maps: int = MAX_MAPS
    coarse: bool = False

    def __post_init__(self) -> None:
        """Check the number of maps."""
        expect(self.max_maps >= 1, f"`max_maps` ≥ 1, got {self.max_maps}.")


@dataclass(frozen=True, kw_only=True)
class Cut:
    """Selection of the maps of an import.

    Args:
        shares: fraction of the maps by split.
        scenario: name of the recipe's scenario, whose light the maps get.
        stride_m: distance from one map to the next in metres; None for adjacent maps.
        solvable: whether to keep only maps whose goal is reachable, and to store the
            grid reference time.
        ground: options of the elevation model.
    """

    shares: Mapping[str, float] = field(default_factory=lambda: {"test/real": 1.0})
    scenario: str = "std"
    stride_m: float | None = None
    solvable: bool = False
    ground: GroundOptions = field(default_factory=GroundOptions)


@dataclass(frozen=True, kw_only=True)
class Rasters:
    """Further rasters of the terrain.

    A layer must cover all maps; its missing values are NaN. Maps that any other raster
    does not cover are left out.

    Args:
        classes: Raster of terrain classes. If empty, classes are random.
        class_ids: Class names by value of `classes`, such as '{1: gravel, 9: null}';
            null for no label. If not given, values are class indices.
        random_classes: Allow a photo or measured traversability without a raster of
            classes; classes are then random.
        unlabelled: Allow a photo and measured traversability without a raster of
            classes; all cells are then unlabelled.
        photo: Raster of red, green and blue. If empty, cells have the colours of their
            classes.
        traversability: Raster of measured traversability in [0, 1]. If empty, it is
            drawn from the class table.
        layer: A layer as NAME=RASTER or NAME=RASTER:UNIT, such as
            vegetation_m=canopy.tif; several as a list.
    """

    classes: str = ""
    class_ids: dict[int, str | None] | None = None
    random_classes: bool = False
    unlabelled: bool = False
    photo: str = ""
    traversability: str = ""
    layer: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Reject options that contradict each other."""
        expect(
            self.classes or self.class_ids is None,
            "`classes` with `class_ids`, got only `class_ids`. Pass the raster of "
            "classes with --classes.",
        )
        expect(
            not (self.classes and self.random_classes),
            "either `classes` or `random_classes`, got both. Leave one out.",
        )
        has_classes = bool(self.classes or self.random_classes)
        expect(
            not self.unlabelled or (self.photo and not has_classes),
            "`unlabelled` with `photo` and without `classes` or `random_classes`, got "
            "another combination. Unlabelled cells take their colour from the photo. "
            "Pass --photo RASTER, or --classes RASTER instead of --unlabelled.",
        )
        for name in ("photo", "traversability"):
            expect(
                not getattr(self, name) or has_classes or self.unlabelled,
                f"`classes` with `{name}`, got only `{name}`, which would be combined "
                "with random classes. Pass --classes RASTER, --unlabelled for models "
                "that need no classes, or --random-classes to allow this.",
            )
        names = [layer.name for layer in self.layers]
        repeated = sorted({name for name in names if names.count(name) > 1})
        expect(
            not repeated,
            f"each `layer` once, got {', '.join(repeated)} more than once.",
        )

    @property
    def layers(self) -> list[LayerRaster]:
        """Layers of the option `layer`."""
        return [read_layer(text) for text in self.layer]
