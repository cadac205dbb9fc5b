"""Dataset formats 1.0 to 1.4: fields, manifest and content digests.

A dataset is an HDF5 file or a folder of such files. The groups of a file are splits.
Each split contains the fields that the manifest lists (those of `FIELDS`, and optional
ones), and the SHA-256 digest of each map's entry of each field. The manifest of a file
is JSON text in the HDF5 dataset `manifest`. A folder has a manifest of its own, which
lists the number of maps in each file. Digests are computed from array values instead of
the file's bytes, so they do not depend on compression, machine or number of workers.
`docs/reference/format.md` describes the files for other readers.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy import ndarray

from benchnav.core.errors import expect

FORMAT = "benchnav-dataset"
FORMAT_VERSION = (1, 4)  # newest version that can be read
MANIFEST = "manifest"
ENTRY_DIGESTS = "entry_digests"
DIGEST_BYTES = 32
UNLABELLED = 255  # `class_id` of a cell without a class, as in real data

Json = dict[str, Any]  # manifest, or part of a manifest
Maps = dict[str, ndarray]  # arrays of B maps by field, each of shape [B, *entry shape]


@dataclass(frozen=True)
class Field:
    """Description of one array of a split.

    Args:
        dtype: NumPy dtype, in little-endian byte order.
        shape: shape of one map's entry; "H" and "W" are the numbers of rows and columns
            of the grid.
        unit: SI unit, "deg", or "1" for no unit.
        minimum: smallest valid value.
        maximum: largest valid value.
        meaning: description in one line.
    """

    dtype: str
    shape: tuple[str | int, ...]
    unit: str
    minimum: float
    maximum: float
    meaning: str

    def entry_shape(self, height: int, width: int) -> tuple[int, ...]:
        """Return the shape of one map's entry on a grid."""
        sizes = {"H": height, "W": width}
        return tuple(sizes[n] if isinstance(n, str) else n for n in self.shape)


Fields = Mapping[str, Field]  # fields by name, in the order in which they are stored

# Fields of each dataset. Their texts are stored in manifests and must not change.
FIELDS: dict[str, Field] = {
    "rgb": Field("|u1", (3, "H", "W"), "1", 0, 255, "top-down colour image, shaded"),
    "class_id": Field("|u1", ("H", "W"), "1", 0, 255, "index into the class table"),
    "elevation_m": Field(
        "<f4", ("H", "W"), "m", -1e4, 1e4, "elevation, in steps of 2^-13 m"
    ),
    "slope_deg": Field(
        "<f4", ("H", "W"), "deg", 0, 90, "slope by Horn's method, in steps of 2^-10 deg"
    ),
    "traversability": Field(
        "<f4", ("H", "W"), "1", 0, 1, "realised traversability, in steps of 2^-16"
    ),
    "environment": Field("<i2", (), "1", 0, 32767, "environment of the map"),
    "start_m": Field("<f4", (2,), "m", 0, 1e6, "start position (x, y)"),
    "goal_m": Field("<f4", (2,), "m", 0, 1e6, "goal position (x, y)"),
    "reference_time_s": Field(
        "<f4",
        (),
        "s",
        0,
        np.inf,
        "grid reference time at a commanded 1 m/s; NaN where not asked for",
    ),
}


# Further fields that a dataset may have.
OPTIONAL: dict[str, Field] = {
    "group": Field(
        "<i8",
        (),
        "1",
        0,
        2**53,
        "maps of one number overlap, directly or by others between them",
    ),
    # `drive_count` and `drive_std` describe measured λ, so no model may use them.
    "drive_count": Field(
        "<i4",
        ("H", "W"),
        "1",
        0,
        2**31 - 1,
        "rows of a robot's log that λ is the mean of",
    ),
    "drive_std": Field(
        "<f4",
        ("H", "W"),
        "1",
        0,
        1,
        "standard deviation of λ over these rows; NaN under two",
    ),
}

# Fields of the true distribution of λ, if layers of the recipe change λ. No model may
# use them.
TRUTH = ("truth_mean", "truth_std")

KNOWN = FIELDS | OPTIONAL
MAP_FIELDS = tuple(name for name, field in FIELDS.items() if "H" in field.shape)

# Names that no layer may have, since they are used for other arrays of a split, other
# inputs of models, or observations of environments.
_RESERVED = (
    *KNOWN,
    *TRUTH,
    ENTRY_DIGESTS,
    MANIFEST,
    "map_index",
    "x_m",
    "y_m",
    "state",
    "goal",
    "seen",
)


def truth_fields(components: int) -> dict[str, Field]:
    """Return the fields of `TRUTH` for K components of the distribution of λ."""
    shape = (components, "H", "W")
    meanings = (
        "mean of each component of λ before clipping, with layers",
        "standard deviation of each component of λ before clipping",
    )
    fields = {}
    for name, meaning in zip(TRUTH, meanings, strict=True):
        fields[name] = Field("<f4", shape, "1", 0, 1, meaning)
    return fields


def layer_names(fields: Fields) -> tuple[str, ...]:
    """Return the names of the layers among fields, which models may use.

    Layers are all float32 fields of shape (H, W) that are not in `FIELDS` or
    `OPTIONAL`. Their missing values are NaN.
    """
    names = []
    for name, field in fields.items():
        is_map = field.dtype == "<f4" and field.shape == ("H", "W")
        if is_map and name not in KNOWN:
            names.append(name)
    return tuple(names)


def check_layer_name(description: str, name: str) -> None:
    """Check the name of a layer.

    Args:
        description: description of the name, for messages.
        name: name to check.

    Raises:
        ConfigError: If the name is not an ASCII identifier, or is reserved.
    """
    expect(
        name.isidentifier() and name.isascii(),
        f"{description} of letters, digits and '_', not beginning with a digit, got "
        f"{name!r}.",
    )
    expect(
        name not in _RESERVED,
        f"{description} other than the reserved names {', '.join(_RESERVED)}, got "
        f"{name!r}.",
    )


def quantise(values: ndarray, bits: int) -> ndarray:
    """Return values rounded to multiples of 2^−bits.

    Rounding removes small differences between the results of different machines.
    """
    steps = np.rint(values * 2.0**bits)
    return steps * 2.0**-bits


def join_maps(parts: Sequence[Maps]) -> Maps:
    """Return the maps of one or more parts of a split, concatenated."""
    if len(parts) == 1:
        return parts[0]
    joined = {}
    for name in parts[0]:
        arrays = [part[name] for part in parts]
        joined[name] = np.concatenate(arrays)
    return joined


def stored_arrays(
    fields: Fields, height: int, width: int
) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Return (dtype, entry shape) by name of each array of a split.

    The arrays are the fields and the digests of their entries.
    """
    arrays: dict[str, tuple[str, tuple[int, ...]]] = {}
    for name, field in fields.items():
        arrays[name] = (field.dtype, field.entry_shape(height, width))
    arrays[ENTRY_DIGESTS] = ("|u1", (len(fields), DIGEST_BYTES))
    return arrays


def entry_digests(maps: Maps, fields: Fields) -> ndarray:
    """Return the SHA-256 digest of each map's entry of each field.

    A digest is computed from the entry's bytes in little-endian order.

    Args:
        maps: arrays by field, each of shape [B, *entry shape].
        fields: F fields.

    Returns:
        uint8, shape [B, F, 32].
    """
    digests = []
    for name, field in fields.items():
        entries = np.ascontiguousarray(maps[name], dtype=field.dtype)
        digests += [hashlib.sha256(entry.tobytes()).digest() for entry in entries]
    joined = np.frombuffer(b"".join(digests), np.uint8)
    by_field = joined.reshape(len(fields), -1, DIGEST_BYTES)
    return by_field.swapaxes(0, 1)


def split_digest(digests: ndarray, height: int, width: int, fields: Fields) -> str:
    """Return the SHA-256 digest of a split.

    It is computed from the names, dtypes and shapes of the fields, followed by the
    digests of the entries, map by map.

    Args:
        digests: digests of all N maps from `entry_digests`, shape [N, F, 32].
        height: number of rows of a map.
        width: number of columns of a map.
        fields: F fields.
    """
    table = []
    for name, field in fields.items():
        shape = [len(digests), *field.entry_shape(height, width)]
        table.append([name, field.dtype, shape])
    text = json.dumps(table, separators=(",", ":")).encode()
    return hashlib.sha256(text + digests.tobytes()).hexdigest()


def version_of(recipes: Sequence[Json], splits: Iterable[Json], fields: Fields) -> str:
    """Return the lowest format version that fits recipes, splits and fields."""
    if any("layers" in recipe for recipe in recipes):
        return "1.4"
    if set(fields) - set(FIELDS):
        return "1.3"
    if any(has_unlabelled(entry) for entry in splits):
        return "1.2"
    synthesis = max(recipe.get("synthesis", 1) for recipe in recipes)
    return "1.1" if synthesis > 1 else "1.0"


def has_unlabelled(entry: Json) -> bool:
    """Return whether a split with this manifest entry has unlabelled cells."""
    for part in entry["parts"]:
        source = part.get("source", {})
        counts = source.get("unlabelled", ())
        if sum(counts) > 0:
            return True
    return False


def field_table(height: int, width: int, fields: Fields) -> Json:
    """Return the description of fields for the manifest."""
    return {
        name: {
            "dtype": field.dtype,
            "shape": list(field.entry_shape(height, width)),
            "unit": field.unit,
            "meaning": field.meaning,
        }
        for name, field in fields.items()
    }


def read_field_table(
    table: Json, layers: Fields = MappingProxyType({})
) -> dict[str, Field]:
    """Return the fields that a manifest describes, in the manifest's order.

    A field that is neither defined in this module nor in `layers` has no limits.

    Args:
        table: descriptions of fields by name, from a manifest.
        layers: fields of layers with known limits, by name.

    Raises:
        KeyError, TypeError, ValueError: If a field of `FIELDS` is missing, or a field
            is invalid.
    """
    height, width = table["class_id"]["shape"]
    for name in FIELDS:
        if name not in table:
            raise ValueError(f"it does not list field {name!r}")
    fields = {}
    defined = {**layers, **KNOWN}
    for name, row in table.items():
        dtype = np.dtype(row["dtype"]).str
        sizes = tuple(row["shape"])
        shape = sizes
        if sizes[-2:] == (height, width):
            shape = (*sizes[:-2], "H", "W")
        foreign = Field(dtype, shape, row["unit"], -np.inf, np.inf, row["meaning"])
        if name in TRUTH and len(sizes) == 3:
            defined |= truth_fields(sizes[0])
        fields[name] = defined.get(name, foreign)
    return fields


# Keys that readers need, with the types of their values.
_MANIFEST = {
    "id": str,
    "generator": {"package": str, "version": str},
    "fields": dict,
    "splits": dict,
    "recipes": list,
}
_ENTRY = {"scenario": str, "maps": int, "digest": str, "parts": list}
_GENERATED = {"maps": int, "recipe": int, "split": str, "first": int}
_IMPORTED = {"maps": int, "source": {"file": str, "left_out": dict}}
_RECIPE = {"id": str, "seed": int, "scenarios": dict, "splits": dict}


def check(manifest: Json) -> None:
    """Check that a manifest contains the keys that readers need, with valid values.

    Raises:
        AttributeError, KeyError, TypeError, ValueError: If a key is missing, or a value
            is invalid.
    """
    _check_kinds(manifest, _MANIFEST)
    read_field_table(manifest["fields"])
    if not manifest["splits"] or not manifest["recipes"]:
        raise ValueError("it has no split or no recipe")
    for recipe in manifest["recipes"]:
        _check_kinds(recipe, _RECIPE)
    for name, entry in manifest["splits"].items():
        _check_kinds(entry, _ENTRY)
        parts = entry["parts"]
        for part in parts:
            kinds = _IMPORTED if "source" in part else _GENERATED
            _check_kinds(part, kinds)
            if "recipe" in part:
                recipe = manifest["recipes"][part["recipe"]]
                split = recipe["splits"][part["split"]]
                recipe["scenarios"][split["scenario"]]  # KeyError if it is missing
        shards = manifest["shards"][name] if "shards" in manifest else parts
        for items in (parts, shards):
            n_maps = sum(item["maps"] for item in items)
            if n_maps <= 0 or n_maps != entry["maps"]:
                raise ValueError(
                    f"the number of maps of split {name!r} is not the sum over its "
                    "parts"
                )
        for shard in shards:
            if "/" in shard.get("file", ""):
                raise ValueError(f"a file of split {name!r} is not in the folder")


def _check_kinds(mapping: Any, kinds: Json) -> None:
    """Check that a mapping has the keys of `kinds`, with values of their types."""
    for name, kind in kinds.items():
        value = mapping.get(name)
        if isinstance(kind, dict):
            _check_kinds(value, kind)
        elif type(value) is not kind:
            raise ValueError(f"it has no {name!r} of type {kind.__name__}")
