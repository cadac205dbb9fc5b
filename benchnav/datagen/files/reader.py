"""Reading datasets of formats 1.0 to 1.4: a file (HDF5), or a folder of such files with
one manifest.

All that reads maps goes through `TerrainDataset.read`, which may be passed to other
processes. PyTorch is imported where Terrain is asked for. Letters in shapes: B maps.
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
from benchnav.datagen.files.manifest import READ_ERRORS, open_file, read_manifest
from benchnav.datagen.layers.spec import shipped_fields
from benchnav.datagen.recipe.recipe import Recipe, recipe_from_dict
from benchnav.datagen.schema import Maps

if TYPE_CHECKING:
    from benchnav.core.terrain import Terrain

CHUNK_CELLS = 2**17
_MOST_OPEN = 128  # files that a process keeps open; far fewer than systems allow

# a file, and its arrays by split and name
Opened = tuple[h5py.File, dict[tuple[str, str], h5py.Dataset]]

_SHOWN_SPLITS = 8


class Piece(NamedTuple):
    """What one file holds of a split: all maps under the split's name.

    Args:
        path: the file.
        first: place of its first map in the split.
        maps: how many it holds.
    """

    path: Path
    first: int
    maps: int


@lru_cache(maxsize=16)
def _read_recipe(text: str, origin: str) -> Recipe:
    """The recipe in a manifest, checked; kept, since to check it takes longer than to
    read a map.
    """
    return recipe_from_dict(json.loads(text), origin)


class TerrainDataset:
    """Reads a dataset.

    Args:
        path: the file, or the folder.
        keep_open: keep files open from call to call, for many reads of few maps. Each
            process opens them for itself, forked or spawned. Otherwise they are open
            during a call alone, and may be changed in between.

    Raises:
        DatasetError: there is no such file, or it is damaged, foreign, or of a newer
            format.
    """

    def __init__(self, path: str | Path, keep_open: bool = False) -> None:
        """Reads and checks the manifest."""
        self.path, self.keep_open = Path(path), keep_open
        self.manifest: schema.Json = read_manifest(self.path)
        # by process, since one's files are not for another
        self._opened: dict[tuple[int, Path], Opened] = {}

    def __getstate__(self) -> schema.Json:
        """Leaves out the open files, so that it may be sent to other processes."""
        return self.__dict__ | {"_opened": {}}

    def __repr__(self) -> str:
        """Return id, path, cells and the maps of each split, in up to six lines."""
        height, width = self.grid.shape
        splits = [f"{name} {about['maps']}" for name, about in self.splits.items()]
        shown = ", ".join(splits[:_SHOWN_SPLITS]) + (
            ", …" if len(splits) > _SHOWN_SPLITS else ""
        )
        return (
            f"TerrainDataset {self.id} in {self.path}\n"
            f"  {height} × {width} cells of {self.grid.resolution_m:g} m, fields "
            f"{', '.join(self.field_names)}\n"
            f"  maps: {shown}"
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
        """The recipe that the file was made by; of the first part where it was made
        from several.
        """
        return _read_recipe(json.dumps(self.manifest["recipes"][0]), f"in {self.path}")

    @property
    def grid(self) -> Grid:
        """Size and resolution of every map."""
        return self.recipe.grid

    @cached_property
    def fields(self) -> dict[str, schema.Field]:
        """What every map has, by name: those of `schema.FIELDS`, and others that this
        dataset lists.
        """
        drawn = {spec.name: spec.stored_field for spec in self.recipe.layers}
        return schema.read_field_table(
            self.manifest["fields"], shipped_fields() | drawn
        )

    @property
    def field_names(self) -> tuple[str, ...]:
        """Names of `fields`."""
        return tuple(self.fields)

    @property
    def layer_names(self) -> tuple[str, ...]:
        """Names of the layers among `fields`: what a model may see of the ground beside
        colour and shape.
        """
        return schema.layer_names(self.fields)

    @property
    def truth_names(self) -> tuple[str, ...]:
        """Names of the fields of `schema.TRUTH` that the dataset has."""
        return tuple(name for name in schema.TRUTH if name in self.fields)

    def truth_of(self, split: str) -> Literal["generated", "unknown"]:
        """Return whether the distribution of λ in each cell of a split is known.

        Returns:
            "generated" where a recipe made all its maps, λ by its class table;
            "unknown" where some were imported: the class table says nothing of real
            ground, whether or not λ was measured there.

        Raises:
            DatasetError: there is no such split.
        """
        self.map_count(split)
        # Files before 1.3 do not say it of what they import.
        known = all(
            "recipe" in part or part["source"].get("truth") == "generated"
            for part in self.splits[split]["parts"]
        )
        return "generated" if known else "unknown"

    @property
    def truth(self) -> Literal["generated", "unknown"]:
        """Knowledge of the distribution of λ in each cell, over all splits; see
        `truth_of`.
        """
        known = all(self.truth_of(name) == "generated" for name in self.splits)
        return "generated" if known else "unknown"

    def has_photo(self, split: str) -> bool:
        """Return whether the colours of some maps of a split are those of a photo,
        which is lit from one direction.

        Raises:
            DatasetError: If there is no such split.
        """
        self.map_count(split)
        return any(
            part.get("source", {}).get("photo") for part in self.splits[split]["parts"]
        )

    def about_digest(self, split: str) -> str:
        """SHA-256 of what numbers on a split rest on beside its maps.

        These are class table, layers of the recipe, λ_stuck, resolution and kind of
        truth.

        Raises:
            DatasetError: there is no such split.
        """
        recipe = self.recipe
        drawn = [
            spec.meaning_of_maps for spec in recipe.layers if not spec.is_vegetation
        ]
        about = {
            **({"layers": drawn} if drawn else {}),
            "classes": recipe.class_rows,
            "stuck_threshold": recipe.stuck_threshold,
            "resolution_m": recipe.resolution_m,
            "truth": self.truth_of(split),
        }
        text = json.dumps(about, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def split_digest(self, split: str) -> str:
        """SHA-256 of a split's maps and of what they mean, which models and results
        record: `about_digest` too.

        Raises:
            DatasetError: there is no such split.
        """
        about = self.about_digest(split)
        return hashlib.sha256(
            f"{self.splits[split]['digest']} {about}".encode()
        ).hexdigest()

    @property
    def digest(self) -> str:
        """One digest for the dataset, as `split:split_digest` joined in the manifest's
        order.
        """
        return ",".join(f"{name}:{self.split_digest(name)}" for name in self.splits)

    def read(
        self,
        split: str,
        indices: Sequence[int] | None = None,
        fields: Collection[str] | None = None,
    ) -> Maps:
        """Reads stored arrays.

        Args:
            split: name of a split.
            indices: which maps, in any order; None for all.
            fields: which of `field_names`; None for all.

        Returns:
            Arrays by field, each of shape [B, *entry shape].

        Raises:
            DatasetError: no such split or map, or a stored chunk is damaged.
        """
        size = self.map_count(split)
        names = self.field_names if fields is None else self.check_fields(fields)
        chosen = range(size) if indices is None else np.asarray(indices).tolist()
        if not all(type(i) is int and 0 <= i < size for i in chosen):
            raise DatasetError(
                f"Expected map indices in 0–{size - 1} of split {split!r}, got "
                f"{chosen}."
            )

        pieces, firsts = self.pieces[split], self._firsts[split]
        # In the order of the files, each of which is asked once for maps that follow
        # one another in it.
        places = sorted(range(len(chosen)), key=chosen.__getitem__)

        def run_of(item: tuple[int, int]) -> tuple[int, int]:
            rank, place = item
            return bisect_right(firsts, chosen[place]) - 1, chosen[place] - rank

        read = {
            name: np.empty((len(chosen), *self._stored[name][1]), self._stored[name][0])
            for name in names
        }
        for (piece, _), items in groupby(enumerate(places), run_of):
            own = [place for _, place in items]
            run = range(chosen[own[0]], chosen[own[-1]] + 1)
            part = self._read_run(split, pieces[piece], run, names)
            if own == list(range(len(chosen))):
                return part
            for name, values in part.items():
                read[name][own] = values
        return read

    def entry_digests(
        self, split: str, indices: Sequence[int] | None = None
    ) -> np.ndarray:
        """Reads the stored SHA-256 of every entry, as `schema.entry_digests` gives
        them.

        Raises:
            DatasetError: no such split, or a stored chunk is damaged.
        """
        return self.read(split, indices, (schema.ENTRY_DIGESTS,))[schema.ENTRY_DIGESTS]

    def chunks(
        self,
        split: str,
        fields: Collection[str] | None = None,
        cells: int = CHUNK_CELLS,
    ) -> Iterator[tuple[range, Maps]]:
        """Reads a split from its first map to its last, some maps at a time.

        Args:
            split: name of a split.
            fields: which fields; None for all.
            cells: most cells at a time, but for one map that has more.

        Yields:
            Which maps, and what `read` gives of them.
        """
        size, count = self.grid.maps_in(cells), self.map_count(split)
        for first in range(0, count, size):
            indices = range(first, min(first + size, count))
            yield indices, self.read(split, indices, fields)

    def terrain_chunks(self, split: str) -> "Iterator[Terrain]":
        """Reads a split as Terrain, some maps at a time, as `chunks` does."""
        for indices, _ in self.chunks(split, fields=()):
            yield self.terrain(split, indices)

    def check_fields(self, names: Collection[str]) -> Collection[str]:
        """Gives names of fields back.

        Raises:
            DatasetError: maps have no such field.
        """
        unknown = [
            name for name in names if name not in (*self.fields, schema.ENTRY_DIGESTS)
        ]
        if unknown:
            raise DatasetError(
                f"Expected `fields` among {list(self.fields)}, got {unknown}."
            )
        return names

    @cached_property
    def pieces(self) -> dict[str, list[Piece]]:
        """By split the files that hold its maps, in their order."""
        pieces: dict[str, list[Piece]] = {split: [] for split in self.splits}
        for split, own in pieces.items():
            one = [{"file": "", "maps": self.splits[split]["maps"]}]
            first = 0
            for shard in self.manifest.get("shards", {}).get(split, one):
                own.append(Piece(self.path / shard["file"], first, shard["maps"]))
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
        """The files that hold maps."""
        return {piece.path for pieces in self.pieces.values() for piece in pieces}

    def _read_run(
        self, split: str, piece: Piece, run: range, names: Collection[str]
    ) -> Maps:
        """Reads maps that follow one another in a file, as `read` does."""
        file, arrays = self._open(piece.path)
        read, most = Maps(), len(self.recipe.classes) - 1
        which = slice(run.start - piece.first, run.stop - piece.first)
        try:
            for name in names:
                if (split, name) not in arrays:
                    arrays[split, name] = self.stored_array(
                        file, split, name, piece.maps
                    )
                read[name] = values = _values(arrays[split, name], which)
                # The greatest is looked at first, since that is quicker than to compare
                # each.
                is_beyond = name == "class_id" and values.max(initial=0) > most
                if (
                    is_beyond
                    and ((values > most) & (values != schema.UNLABELLED)).any()
                ):
                    raise ValueError(f"it has classes beyond {most}")
        except READ_ERRORS as error:
            raise damage(piece.path, split, name, error) from error
        finally:
            if not self.keep_open:
                file.close()
        return read

    def _open(self, path: Path) -> Opened:
        """A file, and those of its arrays that were read before, by split and name."""
        if not self.keep_open:
            return open_file(path), {}
        place = os.getpid(), path
        if place not in self._opened:
            if len(self._opened) == _MOST_OPEN:
                # Let go, which closes it: h5py's own `close` looks through all that is
                # open, of any file.
                del self._opened[next(iter(self._opened))]
            self._opened[place] = open_file(path), {}
        return self._opened[place]

    def stored_array(
        self, file: h5py.File, split: str, name: str, maps: int
    ) -> h5py.Dataset:
        """An array of so many maps in a file; refuses, by a ValueError, one that is not
        what the manifest says.
        """
        array = file[f"{split}/{name}"]
        kind, entry = self._stored[name]
        if (array.dtype.str, array.shape) != (kind, (maps, *entry)):
            raise ValueError(
                f"it is {array.dtype.str} {list(array.shape)}, not {kind} "
                f"{[maps, *entry]}"
            )
        return array

    def terrain(self, split: str, indices: Sequence[int] | None = None) -> "Terrain":
        """Reads maps as Terrain, float32 on the CPU, the latent functions evaluated on
        what is stored.
        """
        from benchnav.datagen.files.stored_terrain import terrain_of

        names = (*schema.MAP_FIELDS, *self.layer_names, *self.truth_names)
        return terrain_of(self.read(split, indices, names), self.recipe)

    def map_count(self, split: str) -> int:
        """Number of maps of a split.

        Raises:
            DatasetError: there is no such split.
        """
        if split not in self.splits:
            raise DatasetError(
                f"Expected a split of {self.path}, one of {sorted(self.splits)}, got "
                f"{split!r}."
            )
        return self.splits[split]["maps"]


def damage(path: Path, split: str, field: str, error: Exception) -> DatasetError:
    """Says that a field cannot be read, and what to do."""
    return DatasetError(
        f"Field {field!r} of split {split!r} in {path} is damaged: {error}. Run "
        "`benchnav-datagen validate` "
        "on the dataset, which says how to make it anew."
    )


def _values(array: h5py.Dataset, which: slice) -> np.ndarray:
    """Some maps of an array; one at a time where they cannot be read together, which
    may be for want of memory.
    """
    try:
        return array[which]
    except OSError:
        return np.concatenate(
            [array[index : index + 1] for index in range(which.start, which.stop)]
        )
