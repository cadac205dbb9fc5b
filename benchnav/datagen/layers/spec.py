"""Record of a layer in a recipe: part, options, stored field, digest of its code.

A layer can be rebuilt from its record. Its code is needed to generate maps, and to
predict λ from colours if the layer changes λ or hides colours. A dataset with a custom
layer can be read without the layer's code.
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
    """Layer of a recipe, as its dataset records it.

    Args:
        part: name of a shipped layer or of an entry point, `package.module:Name` or
            `path/to/file.py:Name`.
        options: all settings of the layer by name, as plain data.
        name: name of the stored field.
        unit: unit of the stored field.
        minimum: smallest valid value; None for no lower limit.
        maximum: largest valid value; None for no upper limit.
        meaning: description for readers of the dataset, in one line.
        words: description of the layer and its settings, for `show`.
        affects: whether the layer changes the distribution of λ.
        hides: whether the layer changes the classes that an image shows.
        source: origin of the layer's code; empty if it is shipped.
        digest: SHA-256 digest of the layer's code and of the code that it imports;
            empty if the layer is shipped.
        files: digests of files that are named in options, by path.
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
        """Omit the layer object, since another process must load its class first."""
        return {name: value for name, value in vars(self).items() if name != "layer"}

    @property
    def stored_field(self) -> Field:
        """Description of the stored field, with its limits."""
        low = -np.inf if self.minimum is None else self.minimum
        high = np.inf if self.maximum is None else self.maximum
        return Field("<f4", ("H", "W"), self.unit, low, high, self.meaning)

    @property
    def is_vegetation(self) -> bool:
        """Whether the layer is vegetation, which has its own keys in recipes."""
        return self.part == "vegetation"

    @property
    def meaning_of_maps(self) -> dict[str, Any]:
        """Entries that determine the maps; the location of the code is not included."""
        return {
            "name": self.name,
            "options": self.options,
            "digest": self.digest,
            "files": self.files,
        }

    @property
    def is_built(self) -> bool:
        """Whether the layer object was built."""
        return "layer" in vars(self)

    @cached_property
    def layer(self) -> Layer:
        """The layer object, built from the record.

        Raises:
            ConfigError: If the layer's code is not found, differs from the recorded
                code, or rejects the options.
        """
        if self.is_vegetation:
            return read(Vegetation, self.options, of("layer 'vegetation'"))
        part = registry.Part(
            part=self.part, label=self.name, options=self.options, kind=KIND
        )
        try:
            layer = part.create()
            digest = part.found.digest
            files = registry.option_files(part) if self.source else {}
        except BenchnavError as error:
            raise ConfigError(
                f"Expected the code of layer {self.name!r} to be available for "
                f"generating maps and predicting λ from colours, got: {error}"
            ) from error
        expected = self.digest[:12] or "none"
        got = digest[:12] or "none"
        expect(
            digest == self.digest,
            f"the code of layer {self.name!r} to have the digest {expected}, which the "
            f"dataset records, got {self.part} with digest {got}. Restore the recorded "
            "code, or create a new dataset.",
        )
        different = dict(files.items() ^ self.files.items())
        changed = ", ".join(sorted(different))
        expect(
            files == self.files,
            f"the files in options of layer {self.name!r} to be those that the dataset "
            f"records, got changed files: {changed}. Restore them, or create a new "
            "dataset.",
        )
        return layer

    def check_workers(self) -> None:
        """Check that other processes can build the layer.

        Raises:
            ConfigError: If the layer's class is registered only in this process.
        """
        entry = None if self.is_vegetation else registry.find(KIND, self.part)
        is_everywhere = entry is None or entry.everywhere
        expect(
            is_everywhere,
            f"a single process, got several. The class of layer {self.name!r} is "
            "registered only in this process. Pass `jobs` 1, or put the class in a "
            "file.",
        )

    @property
    def available(self) -> Layer | None:
        """The layer object; None if its code is not available."""
        with suppress(BenchnavError):
            return self.layer
        return None

    def scaled(self, factor: float, resolution_m: float) -> Self:
        """Return the record for maps of another size; see `Layer.scaled`."""
        scaled = self.layer.scaled(factor, resolution_m)
        options = plain(scaled.settings())
        if options == self.options:
            return self
        return replace(self, options=options)


def read_layer(entry: Any) -> LayerSpec:
    """Return the record of a layer in a recipe.

    Args:
        entry: `NAME`, `{part: NAME, options: {…}}`, a `Layer`, or a `LayerSpec` as an
            object or as plain data.

    Raises:
        ConfigError: If the entry has another type, or the layer or option does not
            exist.
    """
    if isinstance(entry, LayerSpec):
        return entry
    if isinstance(entry, Layer):
        options = plain(entry.settings())
        part = registry.Part(part=_part_of(entry), label="", options=options, kind=KIND)
        return _record(part, entry)
    is_mapping = isinstance(entry, Mapping)
    if is_mapping and "name" in entry:
        return read(LayerSpec, entry, of("a layer"))
    is_part = isinstance(entry, str) or (is_mapping and "label" not in entry)
    expect(
        is_part, f"a layer as NAME or as {{part: NAME, options: {{…}}}}, got {entry!r}."
    )
    part = registry.read_part(KIND, entry)
    part = registry.complete(KIND, part)
    return _record(part, part.create())


def read_layers(entries: Any) -> tuple[LayerSpec, ...]:
    """Return the records of a recipe's layers, in the order in which they are drawn.

    Args:
        entries: list of entries that `read_layer` accepts.

    Raises:
        ConfigError: If `entries` is not a list, two layers have the same name, or
            `read_layer` raises.
    """
    expect(isinstance(entries, list | tuple), f"`layers` as a list, got {entries!r}.")
    specs = tuple(map(read_layer, entries))
    names = [spec.name for spec in specs]
    for name in names:
        expect(
            names.count(name) == 1,
            f"each of the `layers` to have its own name, got {name!r} more than once. "
            "Leave one out.",
        )
    return specs


def overrides_of(
    before: Sequence[LayerSpec], after: Sequence[LayerSpec]
) -> dict[str, Any]:
    """Return the options of a recipe's layers that changed, by the keys of overrides.

    Args:
        before: records of the layers before the change.
        after: records of the same layers after the change.
    """
    changed: dict[str, Any] = {}
    number = 0
    for old, new in zip(before, after, strict=True):
        key = "vegetation_" if old.is_vegetation else f"layers.{number}.options."
        number += not old.is_vegetation
        for name, value in new.options.items():
            if value != old.options[name]:
                changed[key + name] = value
    return changed


def shipped_fields() -> dict[str, Field]:
    """Return the stored fields of the shipped layers by name."""
    return _shipped_fields(tuple(sys.path))


@cache
def _shipped_fields(path: tuple[str, ...]) -> dict[str, Field]:
    """Return the result of `shipped_fields`, cached for each Python search path."""
    shipped = _shipped_classes()
    layers: Iterable[type[Layer]] = (Vegetation, *shipped.values())
    return {layer.name: layer.field() for layer in layers}


def _shipped_classes() -> dict[str, type[Layer]]:
    names = registry.shipped_names(KIND)
    return {name: registry.find(KIND, name).target for name in names}


def _part_of(layer: Layer) -> str:
    """Return the part name of a layer's class, by which `registry` finds the class."""
    kind = type(layer)
    if isinstance(layer, Vegetation):
        return "vegetation"
    module = kind.__module__
    if module.startswith(_OWN_PACKAGE):
        classes = _shipped_classes()
        return next(name for name, target in classes.items() if target is kind)
    is_file = module.startswith("benchnav_file_")
    location = sys.modules[module].__file__ if is_file else module
    return f"{location}:{kind.__qualname__}"


def _record(part: registry.Part, layer: Layer) -> LayerSpec:
    """Return the record of a layer object that was built from a part."""
    kind = type(layer)
    is_vegetation = isinstance(layer, Vegetation)
    stored = kind.field()
    has_minimum = np.isfinite(stored.minimum)
    has_maximum = np.isfinite(stored.maximum)
    spec = LayerSpec(
        part="vegetation" if is_vegetation else part.part,
        options=dict(part.options),
        name=kind.name,
        unit=stored.unit,
        minimum=stored.minimum if has_minimum else None,
        maximum=stored.maximum if has_maximum else None,
        meaning=stored.meaning,
        words=layer.describe(),
        affects=kind.affects(),
        hides=kind.hides(),
    )
    entry = None if is_vegetation else part.found
    if entry is not None and not entry.shipped:
        files = registry.option_files(part)
        spec = replace(spec, source=entry.origin, digest=entry.digest, files=files)
    vars(spec)["layer"] = layer
    return spec
