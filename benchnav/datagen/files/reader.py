"""Reading datasets of formats 1.0 and 1.1 (HDF5).

Readers open the file at each call, so they may be passed to other processes.
"""

import json
from collections.abc import Iterable, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

import benchnav
from benchnav.datagen import schema
from benchnav.datagen.recipe import latent
from benchnav.datagen.recipe.classes import TerrainClass, twins
from benchnav.datagen.recipe.recipe import Recipe, recipe_from_dict
from benchnav.datagen.synth.generate import Maps
from benchnav.errors import DatasetError
from benchnav.mixture import TraversabilityMixture
from benchnav.terrain import Grid, Terrain

# What HDF5 and h5py raise where a file is damaged, by where the damage lies.
READ_ERRORS = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError, MemoryError)


class TerrainDataset:
    """Reads a dataset of format 1.0 or 1.1.

    Args:
        path: the file.

    Raises:
        DatasetError: there is no such file, or it is damaged, foreign, or of a newer format.
    """

    def __init__(self, path: str | Path) -> None:
        """Reads and checks the manifest."""
        self.path = Path(path)
        if not self.path.is_file():
            raise DatasetError(
                f"Expected a dataset file, got {self.path}, which is not there. "
                "Make one with `benchnav-datagen create`."
            )
        with self.open() as file:
            self.manifest: dict[str, Any] = self._read_manifest(file)

    @property
    def id(self) -> str:
        """Name and version of the dataset."""
        return self.manifest["id"]

    @property
    def splits(self) -> dict[str, Any]:
        """Splits by name, each with `maps`, `scenario`, `digest` and `parts`."""
        return self.manifest["splits"]

    @cached_property
    def recipe(self) -> Recipe:
        """The recipe that the file was made by; of the first part where it was made from several."""
        return recipe_from_dict(self.manifest["recipes"][0], f"in {self.path}")

    @property
    def grid(self) -> Grid:
        """Size and resolution of every map."""
        return self.recipe.grid

    @property
    def digest(self) -> str:
        """One digest for the file's splits, as `split:digest` joined in the manifest's order."""
        return ",".join(f"{name}:{split['digest']}" for name, split in self.splits.items())

    def read(
        self, split: str, indices: Sequence[int] | None = None, fields: Iterable[str] | None = None
    ) -> Maps:
        """Reads stored arrays.

        Args:
            split: name of a split.
            indices: which maps, in any order; None for all.
            fields: which fields of `schema.FIELDS`; None for all.

        Returns:
            Arrays by field, each of shape [B, *entry shape].

        Raises:
            DatasetError: no such split or map, or a stored chunk is damaged.
        """
        size = self.map_count(split)
        names = tuple(schema.FIELDS if fields is None else fields)
        unknown = [name for name in names if name not in schema.FIELDS]
        if unknown:
            raise DatasetError(f"Expected `fields` among {list(schema.FIELDS)}, got {unknown}.")
        if indices is not None:
            chosen = np.asarray(indices)
            whole = chosen.size == 0 or np.issubdtype(chosen.dtype, np.integer)
            if not whole or (chosen < 0).any() or (chosen >= size).any():
                raise DatasetError(
                    f"Expected map indices in 0–{size - 1} of split {split!r}, got {chosen.tolist()}."
                )
        with self.open() as file:
            return {name: self._read_array(file, split, name, indices) for name in names}

    def entry_digests(self, split: str, indices: Sequence[int] | None = None) -> np.ndarray:
        """Reads the stored SHA-256 of every entry, as `schema.entry_digests` gives them.

        Raises:
            DatasetError: no such split, or a stored chunk is damaged.
        """
        self.map_count(split)
        with self.open() as file:
            return self._read_array(file, split, schema.ENTRY_DIGESTS, indices)

    def _read_array(
        self, file: h5py.File, split: str, name: str, indices: Sequence[int] | None
    ) -> np.ndarray:
        # HDF5 reads ascending indices, each once; the asked order is made afterwards.
        everything = (slice(None), slice(None))
        chosen, order = (
            everything
            if indices is None
            else np.unique(np.asarray(indices, dtype=np.int64), return_inverse=True)
        )
        try:
            return file[split][name][chosen][order]
        except READ_ERRORS as error:
            raise self.damage(split, name, error) from error

    def terrain(self, split: str, indices: Sequence[int] | None = None) -> Terrain:
        """Reads maps as Terrain, float32 on the CPU, the latent functions evaluated on what is stored."""
        return terrain_of(self.read(split, indices, schema.MAP_FIELDS), self.recipe)

    def map_count(self, split: str) -> int:
        """Number of maps of a split.

        Raises:
            DatasetError: there is no such split.
        """
        if split not in self.splits:
            raise DatasetError(
                f"Expected a split of {self.path}, one of {sorted(self.splits)}, got {split!r}."
            )
        return self.splits[split]["maps"]

    def open(self) -> h5py.File:
        """Opens the file for reading.

        Raises:
            DatasetError: it is no HDF5 file, or its structure is damaged.
        """
        try:
            return h5py.File(self.path, "r")
        except FileNotFoundError as error:
            raise DatasetError(
                f"Expected a dataset file, got {self.path}, which is not there any more."
            ) from error
        except OSError as error:
            raise DatasetError(f"{self.path} is no readable HDF5 file: {error}. Make it again.") from error

    def damage(self, split: str, field: str, error: Exception) -> DatasetError:
        """Says that a field cannot be read, and what to do."""
        return DatasetError(
            f"Field {field!r} of split {split!r} in {self.path} is damaged: {error}. Run `benchnav-datagen "
            "validate` on the file, and `benchnav-datagen repair` to make its damaged maps anew."
        )

    def _read_manifest(self, file: h5py.File) -> dict[str, Any]:
        try:
            if schema.MANIFEST not in file:
                raise DatasetError(
                    f"Expected a {schema.FORMAT} file with a manifest, got {self.path} without one."
                )
            text = file[schema.MANIFEST][()]
            manifest = json.loads(text)
            kind, version = manifest["format"], manifest["format_version"]
            major, minor = (int(part) for part in version.split("."))
            if kind == schema.FORMAT and (major, minor) <= schema.FORMAT_VERSION:
                return schema.unseal(text)
        except READ_ERRORS as error:
            raise DatasetError(
                f"The manifest of {self.path} is damaged: {str(error)[:200]}. Make the file again."
            ) from error
        if kind != schema.FORMAT:
            raise DatasetError(f"Expected format {schema.FORMAT!r} in {self.path}, got {kind!r}.")
        raise DatasetError(
            f"Expected format version at most {'.'.join(map(str, schema.FORMAT_VERSION))} in {self.path}, "
            f"got {version}. Read it with a newer benchnav: pip install --upgrade benchnav."
        )


def terrain_of(maps: Maps, recipe: Recipe) -> Terrain:
    """Makes Terrain of stored arrays, float32 on the CPU.

    Args:
        maps: the fields of `schema.MAP_FIELDS`, each of shape [B, *entry shape].
        recipe: by which they were made.
    """
    slope = maps["slope_deg"].astype(np.float64)
    alike = max(len(own) for own in twins(recipe.classes)) > 1
    return Terrain(
        rgb=torch.from_numpy(maps["rgb"]),
        class_id=torch.from_numpy(maps["class_id"].astype(np.int64)),
        elevation_m=torch.from_numpy(maps["elevation_m"]),
        slope_deg=torch.from_numpy(maps["slope_deg"]),
        truth=_mixture(latent.truth(maps["class_id"], slope, recipe.classes), recipe.classes),
        traversability=torch.from_numpy(maps["traversability"]),
        grid=recipe.grid,
        look_alikes=partial(_look_alikes, recipe.classes) if alike and recipe.synthesis > 1 else None,
    )


def _look_alikes(
    classes: tuple[TerrainClass, ...], class_id: torch.Tensor, slope_deg: torch.Tensor
) -> TraversabilityMixture:
    slope = slope_deg.cpu().numpy().astype(np.float64)
    parameters = latent.look_alikes(class_id.cpu().numpy(), slope, classes)
    assert parameters is not None, "asked of a table in which no two classes look alike"
    return _mixture(parameters, classes).to(class_id.device)


def _mixture(parameters: latent.Parameters, classes: tuple[TerrainClass, ...]) -> TraversabilityMixture:
    """In float32; the components of a class, one or with its soft spots two, stand next to one another."""
    weights, means, stds = (torch.from_numpy(values.astype(np.float32)) for values in parameters)
    per_class = 2 if any(item.soft for item in classes) else 1
    group = tuple(k // per_class for k in range(weights.shape[1]))
    return TraversabilityMixture(weights, means, stds, group)


def dataset_folders() -> list[Path]:
    """Where datasets are looked for by id: `datasets/` here and in this checkout."""
    here, shipped = Path("datasets"), Path(benchnav.__file__).parents[1] / "datasets"
    return [here] if here.resolve() == shipped.resolve() else [here, shipped]


def find_dataset(source: str | Path) -> Path:
    """Finds a dataset by path, or by id in `dataset_folders`.

    Raises:
        DatasetError: neither is there.
    """
    if Path(source).is_file():
        return Path(source)
    for folder in dataset_folders():
        for name in (f"{source}.h5", f"{source}-test.h5"):
            if (folder / name).is_file():
                return folder / name
    if Path(source).suffix == ".h5":
        raise DatasetError(
            f"Expected a dataset, got {str(source)!r}, which is not there. "
            "Make one with `benchnav-datagen create`."
        )
    raise DatasetError(
        f"Expected the path or id of a dataset, got {str(source)!r}, which is neither a file nor in "
        f"{' or '.join(map(str, dataset_folders()))}. Make one with `benchnav-datagen create`."
    )
