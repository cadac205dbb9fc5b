"""Dataset formats 1.0 to 1.4: fields, manifest and content digests;
`docs/reference/format.md` is for readers.

One HDF5 file is one dataset. Groups are splits; each holds the fields that the manifest
lists, those of `FIELDS` and perhaps others, and the SHA-256 of every entry. The
manifest is a JSON text in the dataset `manifest`. A folder of such files, with a
manifest of its own that says which maps lie in which, is one dataset too. Digests cover
logical arrays, not the file's bytes, so they are the same whatever compression, machine
or number of workers wrote it.
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
FORMAT_VERSION = (1, 4)  # the newest that is read
MANIFEST = "manifest"
ENTRY_DIGESTS = "entry_digests"
DIGEST_BYTES = 32
UNLABELLED = 255  # `class_id` of a cell whose class is not known, as on real ground

Json = dict[str, Any]  # a manifest, or what is in it
Maps = dict[str, ndarray]  # some maps: arrays by field, each of shape [B, *entry shape]


@dataclass(frozen=True)
class Field:
    """What one array of a split holds.

    Args:
        dtype: NumPy dtype in little-endian order.
        shape: shape of one map's entry; "H" and "W" stand for the grid.
        unit: SI unit, or "1".
        least: smallest value allowed.
        most: largest value allowed.
        meaning: one line for readers.
    """

    dtype: str
    shape: tuple[str | int, ...]
    unit: str
    least: float
    most: float
    meaning: str

    def entry_shape(self, height: int, width: int) -> tuple[int, ...]:
        """Shape of one map's entry on a grid."""
        sizes = {"H": height, "W": width}
        return tuple(sizes[n] if isinstance(n, str) else n for n in self.shape)


Fields = Mapping[str, Field]  # by name, in the order of being stored

# What every dataset has.
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


# What a dataset may have beside.
OPTIONAL: dict[str, Field] = {
    "group": Field(
        "<i8",
        (),
        "1",
        0,
        2**53,
        "maps of one number overlap, directly or by others between them",
    ),
    # Of the measured λ, so no model may see them.
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

# The true distribution of λ where layers of the recipe change it; no model may see it.
TRUTH = ("truth_mean", "truth_std")

KNOWN = FIELDS | OPTIONAL
MAP_FIELDS = tuple(name for name, field in FIELDS.items() if "H" in field.shape)

# Names that no layer has: of other arrays of a split, and of what models and
# environments are given next to layers.
_TAKEN = (
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
    """Describe the fields of `TRUTH` for a number of components of λ's distribution, K."""
    mean, std = TRUTH
    shape = (components, "H", "W")
    return {
        mean: Field(
            "<f4",
            shape,
            "1",
            0,
            1,
            "mean of each component of λ before clipping, with layers",
        ),
        std: Field(
            "<f4",
            shape,
            "1",
            0,
            1,
            "standard deviation of each component of λ before clipping",
        ),
    }


def layer_names(fields: Fields) -> tuple[str, ...]:
    """Names of the layers among fields: float32 maps that are no other field, which a
    model may see.

    NaN is where nothing is known.
    """
    return tuple(
        name
        for name, field in fields.items()
        if name not in KNOWN and (field.dtype, field.shape) == ("<f4", ("H", "W"))
    )


def check_layer_name(what: str, name: str) -> None:
    """Check a name for a layer.

    Raises:
        ConfigError: If it is no identifier or that of something else, with `what` in
            its message.
    """
    expect(
        name.isidentifier() and name.isascii(),
        f"{what} of letters, digits and '_', not beginning with a digit, got {name!r}.",
    )
    expect(
        name not in _TAKEN, f"{what} to be none of {', '.join(_TAKEN)}, got {name!r}."
    )


def quantise(values: ndarray, bits: int) -> ndarray:
    """Rounds to multiples of 2^−bits, so that the last bits of a machine's arithmetic
    do not show.
    """
    return np.rint(values * 2.0**bits) * 2.0**-bits


def join_maps(parts: Sequence[Maps]) -> Maps:
    """Joins parts of a split, of which there is at least one, end to end."""
    if len(parts) == 1:
        return parts[0]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def stored_arrays(
    fields: Fields, height: int, width: int
) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Dtype and shape of a map's entry in each array that is stored of a split: its
    fields', and of their digests.
    """
    arrays = {
        name: (field.dtype, field.entry_shape(height, width))
        for name, field in fields.items()
    }
    return {**arrays, ENTRY_DIGESTS: ("|u1", (len(fields), DIGEST_BYTES))}


def entry_digests(maps: Maps, fields: Fields) -> ndarray:
    """Digests each map's entry of each field: the SHA-256 of its little-endian bytes.

    Args:
        maps: arrays by field, each of shape [B, *entry shape].
        fields: the F fields to digest.

    Returns:
        uint8, shape [B, F, 32].
    """
    digests = [
        hashlib.sha256(entry.tobytes()).digest()
        for name, field in fields.items()
        for entry in np.ascontiguousarray(maps[name], dtype=field.dtype)
    ]
    by_field = np.frombuffer(b"".join(digests), np.uint8).reshape(
        len(fields), -1, DIGEST_BYTES
    )
    return by_field.swapaxes(0, 1)


def split_digest(digests: ndarray, height: int, width: int, fields: Fields) -> str:
    """The digest of a split: SHA-256 over its field table and its entries' digests, map
    by map.

    Args:
        digests: of all maps' entries, from `entry_digests`, shape [N, F, 32].
        height: rows of a map.
        width: columns of a map.
        fields: the F fields.
    """
    table = [
        [name, field.dtype, [len(digests), *field.entry_shape(height, width)]]
        for name, field in fields.items()
    ]
    text = json.dumps(table, separators=(",", ":")).encode()
    return hashlib.sha256(text + digests.tobytes()).hexdigest()


def version_of(recipes: Sequence[Json], splits: Iterable[Json], fields: Fields) -> str:
    """The format version of a file: the least that its recipes, its splits' entries and
    its fields need.
    """
    if any("layers" in recipe for recipe in recipes):
        return "1.4"
    if set(fields) - set(FIELDS):
        return "1.3"
    if any(has_unlabelled(entry) for entry in splits):
        return "1.2"
    return "1.1" if max(recipe.get("synthesis", 1) for recipe in recipes) > 1 else "1.0"


def has_unlabelled(entry: Json) -> bool:
    """Tells by a split's entry in the manifest whether some of its cells have no class."""
    return any(
        sum(part.get("source", {}).get("unlabelled", ())) > 0 for part in entry["parts"]
    )


def field_table(height: int, width: int, fields: Fields) -> Json:
    """Describes fields for the manifest."""
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
    """Gives the fields that a manifest describes, in its order; of those that are not
    ours any value is allowed.

    Args:
        table: fields by name, as of a manifest.
        layers: layers whose range is known.

    Raises:
        KeyError, TypeError, ValueError: one of `FIELDS` is not among them, or one is
            not as it should be.
    """
    height, width = table["class_id"]["shape"]
    for name in FIELDS:
        if name not in table:
            raise ValueError(f"field {name!r} is not listed")
    fields, known = {}, {**layers, **KNOWN}
    for name, about in table.items():
        dtype, shape = np.dtype(about["dtype"]).str, tuple(about["shape"])
        symbols = (*shape[:-2], "H", "W") if shape[-2:] == (height, width) else shape
        foreign = Field(
            dtype, symbols, about["unit"], -np.inf, np.inf, about["meaning"]
        )
        if name in TRUTH and len(shape) == 3:
            known |= truth_fields(shape[0])
        fields[name] = known.get(name, foreign)
    return fields


# What readers need: keys and the types of their values.
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
    """Refuses a manifest that does not say what a reader needs.

    Raises:
        AttributeError, KeyError, TypeError, ValueError: it does not.
    """
    _check_kinds(manifest, _MANIFEST)
    read_field_table(manifest["fields"])
    if not manifest["splits"] or not manifest["recipes"]:
        raise ValueError("it has no split or no recipe")
    for recipe in manifest["recipes"]:
        _check_kinds(recipe, _RECIPE)
    for name, entry in manifest["splits"].items():
        _check_kinds(entry, _ENTRY)
        for part in entry["parts"]:
            _check_kinds(part, _IMPORTED if "source" in part else _GENERATED)
            if "recipe" in part:
                recipe = manifest["recipes"][part["recipe"]]
                recipe["scenarios"][recipe["splits"][part["split"]]["scenario"]]
        shards = manifest["shards"][name] if "shards" in manifest else entry["parts"]
        for parts in (entry["parts"], shards):
            if not 0 < sum(part["maps"] for part in parts) == entry["maps"]:
                raise ValueError(
                    f"the maps of split {name!r} are not as many as those of its parts"
                )
        if any("/" in shard.get("file", "") for shard in shards):
            raise ValueError(f"a file of split {name!r} is not in the folder")


def _check_kinds(given: Any, kinds: Json) -> None:
    for name, kind in kinds.items():
        value = given.get(name)
        if isinstance(kind, dict):
            _check_kinds(value, kind)
        elif type(value) is not kind:
            raise ValueError(f"it has no {name!r} of type {kind.__name__}")
