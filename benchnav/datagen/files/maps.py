"""A split as a map-style PyTorch dataset, for custom training loops."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.data import Dataset

from benchnav.core.errors import DatasetError
from benchnav.datagen.files.find import find_dataset
from benchnav.datagen.files.reader import TerrainDataset


class TerrainMaps(Dataset[dict[str, Tensor]]):
    """Maps of a split, each a dict of tensors by field.

    Safe under DataLoader workers, forked or spawned: each process opens files itself,
    at its first map of each file. Only the requested fields are read.

    Args:
        path: dataset file or folder, or the id of a local dataset.
        split: name of one of its splits.
        fields: names among `TerrainDataset.field_names`.
        in_memory: whether to read all maps now; faster if maps are read many times.

    Raises:
        DatasetError: If there is no such file, split or field, or, when a map is read,
            its data are damaged.
    """

    def __init__(
        self,
        path: str | Path,
        split: str,
        fields: Sequence[str] = ("rgb", "class_id"),
        in_memory: bool = False,
    ) -> None:
        """Check split and fields; read all maps if they are kept in memory."""
        self.dataset = TerrainDataset(find_dataset(path).resolve(), keep_open=True)
        self.split = split
        self.fields = self.dataset.check_fields(tuple(fields))
        if not fields:
            raise DatasetError(
                f"Expected `fields` among {list(self.dataset.field_names)}, got none."
            )
        self._maps = self.dataset.map_count(split)
        self._memory: dict[str, Tensor] | None = None
        if in_memory:
            self._memory = self.read(range(self._maps))

    def __len__(self) -> int:
        """Number of maps."""
        return self._maps

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        """Return a map; negative indices count from the end.

        Returns:
            Tensors by field, each of the field's entry shape.

        Raises:
            IndexError: If there is no such map.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"Expected a map index in 0–{len(self) - 1}, got {index}.")
        maps = self.read([int(index) % len(self)])
        return {name: values[0] for name, values in maps.items()}

    def read(self, indices: Sequence[int]) -> dict[str, Tensor]:
        """Return maps by field, each tensor of shape [B, *entry shape].

        Args:
            indices: indices of the maps, ≥ 0, in any order.
        """
        if self._memory is None:
            maps = self.dataset.read(self.split, indices, self.fields)
            return {name: torch.from_numpy(values) for name, values in maps.items()}
        index = torch.as_tensor(indices)
        return {name: values[index] for name, values in self._memory.items()}
