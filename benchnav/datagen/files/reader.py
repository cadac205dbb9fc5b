"""Reader of datasets of formats 1.0 to 1.4: an HDF5 file, or a folder of such files.

A `TerrainDataset` may be sent to other processes. PyTorch is imported only by
`TerrainDataset.terrain`. Letters in shapes: B maps.
"""

import hashlib
import json
import os
from bisect import bisect_right
from collections.abc import Collection, Iterator, Sequence
from functools import cached_property, lru_cache
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import h5py
import numpy as np

from benchnav.core.errors import DatasetError
from benchnav.core.grid import Grid
from benchnav.datagen import schema
from benchnav.datagen.files.manifest import (
    READ_ERRORS,
    damage_error,
    open_file,
    read_manifest,
)
from benchnav.datagen.layers.spec import shipped_fields
from benchnav.datagen.recipe.load import recipe_from_dict
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.schema import Maps

if TYPE_CHECKING:
    from benchnav.core.terrain import Terrain

CHUNK_CELLS = 2**17
_MAX_OPEN = 128  # maximum number of open files; operating systems allow more
_SHOWN_SPLITS = 8

# Open file, and its arrays by split and name.
Opened = tuple[h5py.File, dict[tuple[str, str], h5py.Dataset]]


class Piece(NamedTuple):
    """Maps of a split in one file.

    Args:
        path: path of the file.
        first: index in the split of the file's first map.
        maps: number of maps in the file.
    """

    path: Path
    first: int
    maps: int


@lru_cache(maxsize=16)
def _read_recipe(text: str, origin: str) -> Recipe:
    """Return the checked recipe of a manifest; cached, since the check is slow."""
    return recipe_from_dict(json.loads(text), origin)


class TerrainDataset:
    """Dataset in a file or a folder.

    Args:
        path: path of the file or folder.
        keep_open: whether to keep files open between calls, for many reads of few maps.
            Each process, forked or spawned, opens files itself. If False, files are
            open only during a call, and may change between calls.

    Raises:
        DatasetError: If the dataset does not exist, is damaged, or has another format
            or a newer version.
    """

    def __init__(self, path: str | Path, keep_open: bool = False) -> None:
        """Read and check the manifest."""
        self.path = Path(path)
        self.keep_open = keep_open
        self.manifest: schema.Json = read_manifest(self.path)
        # Keys contain the process id, since processes must not share open files.
        self._opened: dict[tuple[int, Path], Opened] = {}

    def __getstate__(self) -> schema.Json:
        """Omit open files, which cannot be sent to other processes."""
        return self.__dict__ | {"_opened": {}}

    def __repr__(self) -> str:
        """Return id, path, cells, fields and the maps of each split, in three lines."""
        height, width = self.grid.shape
        splits = [f"{name} {entry['maps']}" for name, entry in self.splits.items()]
        if len(splits) > _SHOWN_SPLITS:
            splits = [*splits[:_SHOWN_SPLITS], "…"]
        return (
            f"TerrainDataset {self.id} in {self.path}\n"
            f"  {height} × {width} cells of {self.grid.resolution_m:g} m, fields "
            f"{', '.join(self.field_names)}\n"
            f"  maps: {', '.join(splits)}"
        )

    @property
    def id(self) -> str:
        """Name and version of the dataset."""
        return self.manifest["id"]

    @property
    def splits(self) -> schema.Json:
        """Splits by name, each with `maps`, `scenario`, `digest` and `parts`."""
        return self.manifest["splits"]

    @cached_property
    def recipe(self) -> Recipe:
        """Recipe of the dataset; the first recipe if it has several."""
        return _read_recipe(json.dumps(self.manifest["recipes"][0]), f"in {self.path}")

    @property
    def grid(self) -> Grid:
        """Size and resolution of every map."""
        return self.recipe.grid

    @cached_property
    def fields(self) -> dict[str, schema.Field]:
        """Fields of the maps by name: `schema.FIELDS`, and further ones."""
        recorded = {spec.name: spec.stored_field for spec in self.recipe.layers}
        layers = shipped_fields() | recorded
        return schema.read_field_table(self.manifest["fields"], layers)

    @property
    def field_names(self) -> tuple[str, ...]:
        """Names of `fields`."""
        return tuple(self.fields)

    @property
    def layer_names(self) -> tuple[str, ...]:
        """Names of the layers among `fields`, which models may use as inputs."""
        return schema.layer_names(self.fields)

    @property
    def truth_names(self) -> tuple[str, ...]:
        """Names of the fields of `schema.TRUTH` that the dataset has."""
        return tuple(name for name in schema.TRUTH if name in self.fields)

    def truth_of(self, split: str) -> Literal["generated", "unknown"]:
        """Return whether the true distribution of λ of a split is known.

        Returns:
            "generated" if recipes generated all maps, with λ from their class tables;
            "unknown" if some maps were imported, since a class table does not describe
            real terrain, even where λ was measured.

        Raises:
            DatasetError: If the dataset has no such split.
        """
        self.map_count(split)
        # Formats before 1.3 do not record the kind of truth of imported maps.
        is_known = all(
            "recipe" in part or part["source"].get("truth") == "generated"
            for part in self.splits[split]["parts"]
        )
        return "generated" if is_known else "unknown"

    @property
    def truth(self) -> Literal["generated", "unknown"]:
        """Whether the true distribution of λ of all splits is known; see `truth_of`."""
        is_known = all(self.truth_of(name) == "generated" for name in self.splits)
        return "generated" if is_known else "unknown"

    def has_photo(self, split: str) -> bool:
        """Return whether some maps of a split have the colours of a photo.

        Maps that are cut from one photo have the same direction of light.

        Raises:
            DatasetError: If the split does not exist.
        """
        self.map_count(split)
        sources = [part.get("source", {}) for part in self.splits[split]["parts"]]
        return any(source.get("photo") for source in sources)

    def about_digest(self, split: str) -> str:
        """Return the SHA-256 digest of the properties of a split other than its maps.

        These are class table, recipe layers, λ_stuck, resolution and kind of truth.

        Raises:
            DatasetError: If the split does not exist.
        """
        recipe = self.recipe
        properties: schema.Json = {
            "classes": recipe.class_rows,
            "stuck_threshold": recipe.stuck_threshold,
            "resolution_m": recipe.resolution_m,
            "truth": self.truth_of(split),
        }
        specs = [spec for spec in recipe.layers if not spec.is_vegetation]
        if specs:
            properties["layers"] = [spec.meaning_of_maps for spec in specs]
        text = json.dumps(properties, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def split_digest(self, split: str) -> str:
        """Return the SHA-256 digest of a split, which models and results record.

        It is computed from the digest of the maps and `about_digest`.

        Raises:
            DatasetError: If the split does not exist.
        """
        text = f"{self.splits[split]['digest']} {self.about_digest(split)}"
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def digest(self) -> str:
        """Digest of the dataset: `split:split_digest`, joined in the manifest's order."""
        return ",".join(f"{name}:{self.split_digest(name)}" for name in self.splits)

    def read(
        self,
        split: str,
        indices: Sequence[int] | None = None,
        fields: Collection[str] | None = None,
    ) -> Maps:
        """Return stored arrays of maps.

        Args:
            split: name of a split.
            indices: indices of the maps, in any order; None for all.
            fields: names of fields, from `field_names`; None for all.

        Returns:
            Arrays by field, each of shape [B, *entry shape].

        Raises:
            DatasetError: If a split, map or field does not exist, or a stored chunk is
                damaged.
        """
        size = self.map_count(split)
        names = self.field_names if fields is None else self.check_fields(fields)
        chosen = range(size) if indices is None else np.asarray(indices).tolist()
        if not all(type(i) is int and 0 <= i < size for i in chosen):
            raise DatasetError(
                f"Expected map indices in 0–{size - 1} of split {split!r}, got "
                f"{chosen}."
            )
        pieces = self.pieces[split]
        firsts = self._firsts[split]
        # Each run of consecutive maps in a file is read at once, in ascending order.
        order = sorted(range(len(chosen)), key=chosen.__getitem__)

        def run_of(item: tuple[int, int]) -> tuple[int, int]:
            rank, position = item
            index = chosen[position]
            return bisect_right(firsts, index) - 1, index - rank

        arrays = {}
        for name in names:
            dtype, entry = self._stored[name]
            arrays[name] = np.empty((len(chosen), *entry), dtype)
        for (piece, _), items in groupby(enumerate(order), run_of):
            positions = [position for _, position in items]
            run = range(chosen[positions[0]], chosen[positions[-1]] + 1)
            maps = self._read_run(split, pieces[piece], run, names)
            if positions == list(range(len(chosen))):
                return maps
            for name, values in maps.items():
                arrays[name][positions] = values
        return arrays

    def entry_digests(
        self, split: str, indices: Sequence[int] | None = None
    ) -> np.ndarray:
        """Return the stored SHA-256 digests of maps, as in `schema.entry_digests`.

        Raises:
            DatasetError: If the split does not exist, or a stored chunk is damaged.
        """
        return self.read(split, indices, (schema.ENTRY_DIGESTS,))[schema.ENTRY_DIGESTS]

    def chunks(
        self,
        split: str,
        fields: Collection[str] | None = None,
        cells: int = CHUNK_CELLS,
    ) -> Iterator[tuple[range, Maps]]:
        """Read a split in chunks, from the first map to the last.

        Args:
            split: name of a split.
            fields: names of fields, from `field_names`; None for all.
            cells: maximum number of cells of a chunk with several maps.

        Yields:
            Indices of the maps, and their arrays as from `read`.
        """
        size = self.grid.maps_in(cells)
        count = self.map_count(split)
        for first in range(0, count, size):
            indices = range(first, min(first + size, count))
            yield indices, self.read(split, indices, fields)

    def terrain_chunks(self, split: str) -> "Iterator[Terrain]":
        """Read a split as Terrain, in the chunks of `chunks`."""
        for indices, _ in self.chunks(split, fields=()):
            yield self.terrain(split, indices)

    def check_fields(self, names: Collection[str]) -> Collection[str]:
        """Return the names after a check that maps have such fields.

        Raises:
            DatasetError: If a field does not exist.
        """
        known_names = {*self.fields, schema.ENTRY_DIGESTS}
        unknown = [name for name in names if name not in known_names]
        if unknown:
            raise DatasetError(
                f"Expected `fields` among {list(self.fields)}, got {unknown}."
            )
        return names

    @cached_property
    def pieces(self) -> dict[str, list[Piece]]:
        """Files that contain the maps of each split, in order."""
        pieces: dict[str, list[Piece]] = {}
        for split, entry in self.splits.items():
            pieces[split] = []
            single = [{"file": "", "maps": entry["maps"]}]
            first = 0
            for shard in self.manifest.get("shards", {}).get(split, single):
                path = self.path / shard["file"]
                pieces[split].append(Piece(path, first, shard["maps"]))
                first += shard["maps"]
        return pieces

    @cached_property
    def _firsts(self) -> dict[str, list[int]]:
        return {
            split: [piece.first for piece in pieces]
            for split, pieces in self.pieces.items()
        }

    @cached_property
    def _stored(self) -> dict[str, tuple[str, tuple[int, ...]]]:
        return schema.stored_arrays(self.fields, *self.grid.shape)

    @cached_property
    def files(self) -> set[Path]:
        """Files that contain maps."""
        return {piece.path for pieces in self.pieces.values() for piece in pieces}

    def _read_run(
        self, split: str, piece: Piece, run: range, names: Collection[str]
    ) -> Maps:
        """Return consecutive maps of a file, in the form of `read`."""
        file, arrays = self._open(piece.path)
        maps = Maps()
        max_class = len(self.recipe.classes) - 1
        selection = slice(run.start - piece.first, run.stop - piece.first)
        try:
            for name in names:
                if (split, name) not in arrays:
                    arrays[split, name] = self.stored_array(
                        file, split, name, piece.maps
                    )
                values = _values(arrays[split, name], selection)
                maps[name] = values
                # The maximum is checked first, since it is faster to compute.
                if name == "class_id" and values.max(initial=0) > max_class:
                    is_beyond = (values > max_class) & (values != schema.UNLABELLED)
                    if is_beyond.any():
                        raise ValueError(f"it has class indices above {max_class}")
        except READ_ERRORS as error:
            raise damage_error(piece.path, split, name, error) from error
        finally:
            if not self.keep_open:
                file.close()
        return maps

    def _open(self, path: Path) -> Opened:
        """Return an open file, and its arrays so far by split and name."""
        if not self.keep_open:
            return open_file(path), {}
        key = os.getpid(), path
        if key not in self._opened:
            if len(self._opened) == _MAX_OPEN:
                # Deleting the last reference closes the file. h5py's `close` is slow,
                # since it searches all open objects of all files.
                del self._opened[next(iter(self._opened))]
            self._opened[key] = open_file(path), {}
        return self._opened[key]

    def stored_array(
        self, file: h5py.File, split: str, name: str, maps: int
    ) -> h5py.Dataset:
        """Return an array of a file, after a check of its dtype and shape.

        Args:
            file: open file.
            split: name of a split.
            name: name of a field.
            maps: expected number of maps.

        Raises:
            ValueError: If dtype or shape differs from the manifest.
        """
        array = file[f"{split}/{name}"]
        dtype, entry = self._stored[name]
        shape = (maps, *entry)
        if (array.dtype.str, array.shape) != (dtype, shape):
            raise ValueError(
                f"it is {array.dtype.str} {list(array.shape)}, not {dtype} "
                f"{list(shape)}"
            )
        return array

    def terrain(self, split: str, indices: Sequence[int] | None = None) -> "Terrain":
        """Return maps as Terrain, in float32 on the CPU, with the true distribution.

        Args:
            split: name of a split.
            indices: indices of the maps, in any order; None for all.
        """
        from benchnav.datagen.files.stored_terrain import terrain_of

        names = (*schema.MAP_FIELDS, *self.layer_names, *self.truth_names)
        return terrain_of(self.read(split, indices, names), self.recipe)

    def map_count(self, split: str) -> int:
        """Return the number of maps of a split.

        Raises:
            DatasetError: If the split does not exist.
        """
        if split not in self.splits:
            raise DatasetError(
                f"Expected a split of {self.path}, one of {sorted(self.splits)}, got "
                f"{split!r}."
            )
        return self.splits[split]["maps"]


def _values(array: h5py.Dataset, selection: slice) -> np.ndarray:
    """Return maps of an array; if memory does not suffice, they are read one by one."""
    try:
        return array[selection]
    except OSError:
        indices = range(selection.start, selection.stop)
        return np.concatenate([array[index : index + 1] for index in indices])
