"""A split as a map-style PyTorch dataset, for training loops of one's own."""

import os
from bisect import bisect_right
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from benchnav.core.errors import DatasetError
from benchnav.datagen.files.reader import READ_ERRORS, TerrainDataset, damage, find_dataset, open_file

# Files that a process keeps open; far fewer than systems allow.
_MOST_OPEN = 100


class TerrainMaps(Dataset[dict[str, Tensor]]):
    """The maps of a split, each a dict of tensors by field.

    Safe under DataLoader workers, forked or spawned: each process opens files for itself, at the first map of
    each. Only the fields asked for are read.

    Args:
        path: dataset file or folder, or the id of one at hand.
        split: name of one of its splits.
        fields: names among `TerrainDataset.field_names`.
        in_memory: read all maps at once, here; worth it for what is read many times.

    Raises:
        DatasetError: no such file, split or field; when a map is read: its data are damaged.
    """

    def __init__(
        self,
        path: str | Path,
        split: str,
        fields: Sequence[str] = ("rgb", "class_id"),
        in_memory: bool = False,
    ) -> None:
        """Checks split and fields, and reads the maps where that is asked for."""
        self.dataset, self.split, self.fields = (
            TerrainDataset(find_dataset(path).resolve()),
            split,
            tuple(fields),
        )
        unknown = sorted(set(fields) - set(self.dataset.field_names))
        if unknown or not fields:
            raise DatasetError(
                f"Expected `fields` among {list(self.dataset.field_names)}, got {unknown or list(fields)}."
            )
        self._maps = self.dataset.map_count(split)
        self._pieces = self.dataset.pieces(split)
        self._memory: dict[str, Tensor] | None = None
        if in_memory:
            read = self.dataset.read(split, fields=self.fields)
            self._memory = {name: torch.from_numpy(values) for name, values in read.items()}
        self._opened: tuple[int, dict[Path, dict[str, h5py.Dataset]]] = (0, {})

    def __len__(self) -> int:
        """Number of maps."""
        return self._maps

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        """Reads a map; negative indices count from the end.

        Returns:
            Tensors by field, each of the field's entry shape.

        Raises:
            IndexError: there is no such map.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"Expected a map index in 0–{len(self) - 1}, got {index}.")
        index = int(index) % len(self)
        if self._memory is not None:
            return {name: values[index].clone() for name, values in self._memory.items()}
        piece = self._pieces[bisect_right(self._pieces, index, key=lambda piece: piece.first) - 1]
        sample, name = {}, self.fields[0]
        try:
            for name, array in self._arrays(piece.path).items():
                sample[name] = torch.from_numpy(np.asarray(array[index - piece.first]))
        except READ_ERRORS as error:
            raise damage(piece.path, self.split, name, error) from error
        return sample

    def __getstate__(self) -> dict[str, Any]:
        """Leaves out the open files, so that it may be sent to other processes."""
        return self.__dict__ | {"_opened": (0, {})}

    def _arrays(self, path: Path) -> dict[str, h5py.Dataset]:
        if self._opened[0] != os.getpid():
            self._opened = os.getpid(), {}
        opened = self._opened[1]
        if path not in opened:
            if len(opened) == _MOST_OPEN:
                opened.pop(next(iter(opened)))
            group = open_file(path)[self.split]
            opened[path] = {name: group[name] for name in self.fields}
        return opened[path]
