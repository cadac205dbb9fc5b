"""Writing and reading datasets of format 1.0 (HDF5).

A dataset is made in blocks of maps kept beside the target in `.NAME.partial`; a killed run goes on
from the blocks it finished. The target's name never holds a partial file. Readers open the file at
each call, so they may be passed to other processes.
"""

import json
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import joblib
import numpy as np
import torch

import benchnav
from benchnav.datagen import latent, schema
from benchnav.datagen.generate import Maps, generate
from benchnav.datagen.scenario import Recipe, recipe_from_dict
from benchnav.errors import DatasetError
from benchnav.files import replacing, sole_writer, write_text
from benchnav.terrain import Grid, Terrain

BLOCK_MAPS = 100

_MAP_FIELDS = tuple(name for name, field in schema.FIELDS.items() if "H" in field.shape)


def create(
    recipe: Recipe, path: Path, jobs: int = 1, block_maps: int = BLOCK_MAPS, overwrite: bool = False
) -> Iterator[tuple[int, int]]:
    """Makes a dataset, yielding (maps done, maps in all) as it goes; to be iterated to the end.

    Args:
        recipe: what to make.
        path: file to write.
        jobs: worker processes.
        block_maps: maps a unit of work; changes nothing in the result.
        overwrite: replace a file that is there.

    Raises:
        DatasetError: the file exists, another run is writing it, or it cannot be written.
        ConfigError: the recipe cannot be met.
    """
    if path.exists() and not overwrite:
        raise DatasetError(
            f"Expected `out` to be a new file, but {path} exists. Pass --overwrite true to replace it."
        )
    blocks = [
        (split, start, min(start + block_maps, spec.maps))
        for split, spec in recipe.splits.items()
        for start in range(0, spec.maps, block_maps)
    ]
    total = sum(stop - start for _, start, stop in blocks)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _workspace(path, _made_of(recipe, block_maps)) as folder:
            missing = [block for block in blocks if not _block_path(folder, *block).exists()]
            done = total - sum(stop - start for _, start, stop in missing)
            workers = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered")
            for made in workers(joblib.delayed(_make_block)(recipe, folder, *block) for block in missing):
                done += made
                yield done, total
            with replacing(path) as partial:
                _assemble(recipe, folder, blocks, partial)
            shutil.rmtree(folder, ignore_errors=True)
    except OSError as error:
        raise DatasetError(
            f"Could not write {path}: {error.strerror or error}. Nothing was left under its name."
        ) from error


class TerrainDataset:
    """Reads a dataset of format 1.0.

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
        with self._open() as file:
            if schema.MANIFEST not in file:
                raise DatasetError(
                    f"Expected a {schema.FORMAT} file with a manifest, got {self.path} without one."
                )
            try:
                self.manifest: dict[str, Any] = json.loads(file[schema.MANIFEST][()])
                kind = self.manifest["format"]
                major, minor = (int(part) for part in self.manifest["format_version"].split("."))
                missing = {"id", "seed", "generator", "recipe", "splits"} - set(self.manifest)
            except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
                raise DatasetError(
                    f"The manifest of {self.path} is damaged: {error!r}. Make the file again."
                ) from error
        if kind != schema.FORMAT:
            raise DatasetError(f"Expected format {schema.FORMAT!r} in {self.path}, got {kind!r}.")
        if (major, minor) > schema.FORMAT_VERSION:
            raise DatasetError(
                f"Expected format version at most {'.'.join(map(str, schema.FORMAT_VERSION))} in {self.path}, "
                f"got {major}.{minor}. Read it with a newer benchnav: pip install --upgrade benchnav."
            )
        if missing:
            raise DatasetError(
                f"The manifest of {self.path} lacks {', '.join(sorted(missing))}. Make the file again."
            )

    @property
    def id(self) -> str:
        """Name and version of the dataset."""
        return self.manifest["id"]

    @property
    def splits(self) -> dict[str, Any]:
        """Splits by name, each with `maps`, `scenario` and `digest`."""
        return self.manifest["splits"]

    @cached_property
    def recipe(self) -> Recipe:
        """The recipe that the file was made by."""
        return recipe_from_dict(self.manifest["recipe"], f"in {self.path}")

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
        if split not in self.splits:
            raise DatasetError(
                f"Expected a split of {self.path}, one of {sorted(self.splits)}, got {split!r}."
            )
        size = self.splits[split]["maps"]
        if indices is not None and len(indices) and not (min(indices) >= 0 and max(indices) < size):
            raise DatasetError(
                f"Expected map indices in 0–{size - 1} of split {split!r}, got {list(indices)}."
            )
        # HDF5 reads ascending indices, each once; the asked order is made afterwards.
        chosen, order = (
            (slice(None), slice(None)) if indices is None else np.unique(indices, return_inverse=True)
        )
        with self._open() as file:
            arrays = {}
            for name in fields or schema.FIELDS:
                try:
                    arrays[name] = file[split][name][chosen][order]
                except (KeyError, OSError) as error:
                    raise DatasetError(
                        f"Field {name!r} of split {split!r} in {self.path} is damaged: {error}. "
                        "Run `benchnav-datagen validate` on the file."
                    ) from error
        return arrays

    def terrain(self, split: str, indices: Sequence[int] | None = None) -> Terrain:
        """Reads maps as Terrain, float32 on the CPU, the latent functions evaluated on what is stored."""
        maps = self.read(split, indices, _MAP_FIELDS)
        classes = self.recipe.classes
        mean = latent.latent_mean(maps["class_id"], maps["slope_deg"].astype(np.float64), classes)
        std = latent.latent_std(maps["class_id"], classes)
        return Terrain(
            rgb=torch.from_numpy(maps["rgb"]),
            class_id=torch.from_numpy(maps["class_id"].astype(np.int64)),
            elevation_m=torch.from_numpy(maps["elevation_m"]),
            slope_deg=torch.from_numpy(maps["slope_deg"]),
            traversability_mean=torch.from_numpy(mean.astype(np.float32)),
            traversability_std=torch.from_numpy(std.astype(np.float32)),
            traversability=torch.from_numpy(maps["traversability"]),
            grid=self.grid,
        )

    def _open(self) -> h5py.File:
        try:
            return h5py.File(self.path, "r")
        except OSError as error:
            raise DatasetError(f"{self.path} is no readable HDF5 file: {error}. Make it again.") from error


def find_dataset(source: str | Path) -> Path:
    """Finds a dataset by path, or by id among `datasets/` here and in this checkout.

    Raises:
        DatasetError: neither is there.
    """
    if Path(source).is_file():
        return Path(source)
    folders = [Path("datasets"), Path(__file__).parents[2] / "datasets"]
    for folder in folders:
        for name in (f"{source}.h5", f"{source}-test.h5"):
            if (folder / name).is_file():
                return folder / name
    raise DatasetError(
        f"Expected the path or id of a dataset, got {str(source)!r}, which is neither a file nor in "
        f"{' or '.join(map(str, folders))}. Make one with `benchnav-datagen create`."
    )


def _made_of(recipe: Recipe, block_maps: int) -> dict[str, Any]:
    return {"recipe": recipe.to_dict(), "block_maps": block_maps, "version": benchnav.__version__}


def _make_block(recipe: Recipe, folder: Path, split: str, start: int, stop: int) -> int:
    maps = generate(recipe, split, np.arange(start, stop))
    with replacing(_block_path(folder, split, start, stop)) as partial, open(partial, "wb") as file:
        np.savez(file, **maps)  # type: ignore[arg-type]
    return stop - start


def _block_path(folder: Path, split: str, start: int, stop: int) -> Path:
    return folder / f"{split.replace('/', '+')}-{start:07d}-{stop:07d}.npz"


@contextmanager
def _workspace(path: Path, made_of: dict[str, Any]) -> Iterator[Path]:
    """Holds the folder of finished blocks, one run at a time; blocks of another recipe are dropped."""
    folder = path.parent / f".{path.name}.partial"
    folder.mkdir(exist_ok=True)
    with sole_writer(folder, str(path)):
        stamp, text = folder / "made_of.json", json.dumps(made_of, sort_keys=True)
        if not stamp.exists() or stamp.read_text() != text:
            for block in folder.glob("*.npz"):
                block.unlink()
            write_text(stamp, text)
        yield folder


def _assemble(recipe: Recipe, folder: Path, blocks: list[tuple[str, int, int]], target: Path) -> None:
    grid = recipe.grid
    digests = {split: schema.SplitDigest() for split in recipe.splits}
    with h5py.File(target, "w", libver=("earliest", "v110")) as file:
        for split, start, stop in blocks:
            group = file.require_group(split)
            with np.load(_block_path(folder, split, start, stop)) as block:
                maps = {name: block[name] for name in schema.FIELDS}
            digests[split].update(maps)
            for name, field in schema.FIELDS.items():
                if name not in group:
                    _new_array(group, name, field, recipe.splits[split].maps, grid)
                group[name][start:stop] = maps[name]
        manifest = {
            "format": schema.FORMAT,
            "format_version": ".".join(map(str, schema.FORMAT_VERSION)),
            "id": recipe.id,
            "seed": recipe.seed,
            "generator": {"package": "benchnav", "version": benchnav.__version__},
            "fields": schema.field_table(*grid.shape),
            "splits": {
                name: {"scenario": split.scenario, "maps": split.maps, "digest": digests[name].hexdigest()}
                for name, split in recipe.splits.items()
            },
            "recipe": recipe.to_dict(),
        }
        file[schema.MANIFEST] = json.dumps(manifest, indent=1)


def _new_array(group: h5py.Group, name: str, field: schema.Field, maps: int, grid: Grid) -> None:
    entry = field.entry_shape(*grid.shape)
    chunk = (1, *entry) if "H" in field.shape else (maps, *entry)
    array = group.create_dataset(
        name, (maps, *entry), field.dtype, chunks=chunk, compression="gzip", shuffle=True, fletcher32=True
    )
    array.attrs["unit"], array.attrs["meaning"] = field.unit, field.meaning
