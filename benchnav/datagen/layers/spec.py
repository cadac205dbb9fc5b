"""What a recipe records of a layer, from which it is built again: part, options, stored
field, digest of its code.

A dataset with a layer of a user's is read without the layer's code; only generating
maps, and what the colours of look-alike classes tell of λ where the layer changes it,
need the code.
"""

import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any, Self

import numpy as np

from benchnav.core import registry
from benchnav.core.errors import BenchnavError, ConfigError, expect
from benchnav.core.settings import of, plain, read
from benchnav.datagen.layers.layer import Layer
from benchnav.datagen.layers.vegetation import Vegetation
from benchnav.datagen.schema import Field, check_layer_name

KIND = "layer"
_OWN_PACKAGE = "benchnav."


@dataclass(frozen=True, kw_only=True)
class LayerSpec:
    """A layer of a recipe, as its dataset records it.

    Args:
        part: shipped name, entry point, `package.module:Name` or
            `path/to/file.py:Name`.
        options: all its settings, as plain data.
        name: of the stored field.
        unit: of the stored field.
        minimum: smallest value allowed; None for any.
        maximum: largest value allowed; None for any.
        meaning: one line for readers of the dataset.
        words: the layer and its settings, for `show`.
        affects: whether it changes the distribution of λ.
        hides: whether it changes which classes a picture shows.
        source: where its code was found; empty if it is shipped.
        digest: SHA-256 of its code and of what that imports; empty if it is shipped.
        files: digests of the files that its options name.
    """

    part: str
    options: dict[str, Any] = field(default_factory=dict)
    name: str
    unit: str = "1"
    minimum: float | None = None
    maximum: float | None = None
    meaning: str = ""
    words: str = ""
    affects: bool = False
    hides: bool = False
    source: str = ""
    digest: str = ""
    files: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the name."""
        check_layer_name(f"`name` of layer {self.part}", self.name)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the object, whose class another process may have to load from a
        file.
        """
        return {name: value for name, value in vars(self).items() if name != "layer"}

    @property
    def stored_field(self) -> Field:
        """The stored field."""
        low = -np.inf if self.minimum is None else self.minimum
        high = np.inf if self.maximum is None else self.maximum
        return Field("<f4", ("H", "W"), self.unit, low, high, self.meaning)

    @property
    def is_vegetation(self) -> bool:
        """Whether recipes write it by the keys of vegetation."""
        return self.part == "vegetation"

    @property
    def meaning_of_maps(self) -> dict[str, Any]:
        """What the maps depend on, wherever the code lies."""
        return {
            "name": self.name,
            "options": self.options,
            "digest": self.digest,
            "files": self.files,
        }

    @property
    def is_built(self) -> bool:
        """Whether the layer itself was built."""
        return "layer" in vars(self)

    @cached_property
    def layer(self) -> Layer:
        """The layer itself.

        Raises:
            ConfigError: If its code is not found, is other code than was recorded, or
                rejects its options.
        """
        if self.is_vegetation:
            return read(Vegetation, self.options, of("layer 'vegetation'"))
        part = registry.Part(
            part=self.part, label=self.name, options=self.options, kind=KIND
        )
        try:
            layer, digest = part.create(), part.found.digest
            files = registry.option_files(part) if self.source else {}
        except BenchnavError as error:
            raise ConfigError(
                f"The code of layer {self.name!r} is needed to generate maps or to "
                f"tell what colours show: {error}"
            ) from error
        expect(
            digest == self.digest,
            f"the code of layer {self.name!r} that the dataset records, of digest "
            f"{self.digest[:12] or 'none'}, got "
            f"{self.part} of digest {digest[:12] or 'none'}. Restore that code, or "
            "make a new dataset.",
        )
        expect(
            files == self.files,
            f"the files that options of layer {self.name!r} name as the dataset "
            "records them, got others: "
            f"{', '.join(sorted(dict(files.items() ^ self.files.items())))}. Restore "
            "them, or make a new dataset.",
        )
        return layer

    def check_workers(self) -> None:
        """Check that other processes can build the layer.

        Raises:
            ConfigError: If its class is known in this process only.
        """
        found = None if self.is_vegetation else registry.find(KIND, self.part)
        expect(
            found is None or found.everywhere,
            f"one process with layer {self.name!r}, whose class is registered in this "
            "process only, got more. Pass "
            "`jobs` 1, or put the class in a file.",
        )

    @property
    def available(self) -> Layer | None:
        """The layer itself, None if its code is not here."""
        with suppress(BenchnavError):
            return self.layer
        return None

    def scaled(self, factor: float, resolution_m: float) -> Self:
        """Return it for maps whose lengths are multiplied by a factor; see
        `Layer.scaled`.
        """
        settings = plain(self.layer.scaled(factor, resolution_m).settings())
        return self if settings == self.options else replace(self, options=settings)


def read_layer(given: Any) -> LayerSpec:
    """Read a layer as a recipe has it.

    Args:
        given: `NAME`, `{part: NAME, options: {…}}`, a `LayerSpec` as plain data, or a
            `Layer`.

    Raises:
        ConfigError: If it is none of these, or there is no such layer or option.
    """
    if isinstance(given, LayerSpec):
        return given
    if isinstance(given, Layer):
        options = plain(given.settings())
        return _record(
            registry.Part(part=_part_of(given), label="", options=options, kind=KIND),
            given,
        )
    if isinstance(given, Mapping) and "name" in given:
        return read(LayerSpec, given, of("a layer"))
    expect(
        isinstance(given, str) or (isinstance(given, Mapping) and "label" not in given),
        f"a layer as NAME or as {{part: NAME, options: {{…}}}}, got {given!r}.",
    )
    part = registry.complete(KIND, registry.read_part(KIND, given))
    return _record(part, part.create())


def read_layers(given: Any) -> tuple[LayerSpec, ...]:
    """Read the layers of a recipe, in the order in which they are drawn.

    Raises:
        ConfigError: If they are no list, two have one name, or as of `read_layer`.
    """
    expect(isinstance(given, list | tuple), f"`layers` as a list, got {given!r}.")
    specs = tuple(map(read_layer, given))
    names = [spec.name for spec in specs]
    for name in names:
        expect(
            names.count(name) == 1, f"layers of different names, got {name!r} twice."
        )
    return specs


def overrides_of(
    before: Sequence[LayerSpec], after: Sequence[LayerSpec]
) -> dict[str, Any]:
    """Return the changed options of a recipe's layers by the keys of overrides."""
    changed: dict[str, Any] = {}
    number = 0
    for old, new in zip(before, after, strict=True):
        key = "vegetation_" if old.is_vegetation else f"layers.{number}.options."
        number += not old.is_vegetation
        changed |= {
            key + name: value
            for name, value in new.options.items()
            if value != old.options[name]
        }
    return changed


def shipped_fields() -> dict[str, Field]:
    """Return the stored fields of the shipped layers by name."""
    return _shipped_fields(tuple(sys.path))


@cache
def _shipped_fields(path: tuple[str, ...]) -> dict[str, Field]:
    """See `shipped_fields`; asked again when the path has changed."""
    layers: Iterable[type[Layer]] = (Vegetation, *_shipped_classes().values())
    return {layer.name: layer.field() for layer in layers}


def _shipped_classes() -> dict[str, type[Layer]]:
    return {
        name: registry.find(KIND, name).target for name in registry.shipped_names(KIND)
    }


def _part_of(layer: Layer) -> str:
    """Name the class of a layer so that it can be found again."""
    kind = type(layer)
    if isinstance(layer, Vegetation):
        return "vegetation"
    if kind.__module__.startswith(_OWN_PACKAGE):
        return next(
            name for name, target in _shipped_classes().items() if target is kind
        )
    is_file = kind.__module__.startswith("benchnav_file_")
    place = sys.modules[kind.__module__].__file__ if is_file else kind.__module__
    return f"{place}:{kind.__qualname__}"


def _record(part: registry.Part, layer: Layer) -> LayerSpec:
    """Record a layer that was built."""
    kind, is_vegetation = type(layer), isinstance(layer, Vegetation)
    stored = kind.field()
    found = None if is_vegetation else part.found
    is_own = found is not None and not found.shipped
    spec = LayerSpec(
        part="vegetation" if is_vegetation else part.part,
        options=dict(part.options),
        name=kind.name,
        unit=stored.unit,
        minimum=stored.least if np.isfinite(stored.least) else None,
        maximum=stored.most if np.isfinite(stored.most) else None,
        meaning=stored.meaning,
        words=layer.describe(),
        affects=kind.affects(),
        hides=kind.hides(),
        source=found.origin if found and is_own else "",
        digest=found.digest if found and is_own else "",
        files=registry.option_files(part) if is_own else {},
    )
    vars(spec)["layer"] = layer
    return spec
