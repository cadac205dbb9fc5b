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

    It may be used by forked or spawned DataLoader workers: each process opens a file
    when it first reads a map from the file. Only the requested fields are read.

    Args:
        path: path of the dataset's file or folder, id of a local dataset, or address on
            a hub.
        split: name of one of the dataset's splits.
        fields: names of fields, from `TerrainDataset.field_names`.
        in_memory: whether to read all maps into memory now, which is faster if maps are
            read many times.

    Raises:
        DatasetError: If the dataset, split or field does not exist, or, when a map is
            read, if its data are damaged.
    """

    def __init__(
        self,
        path: str | Path,
        split: str,
        fields: Sequence[str] = ("rgb", "class_id"),
        in_memory: bool = False,
    ) -> None:
        """Check split and fields; if `in_memory`, read all maps."""
        self.dataset = TerrainDataset(find_dataset(path).resolve(), keep_open=True)
        self.split = split
        self.fields = self.dataset.check_fields(tuple(fields))
        if not fields:
            raise DatasetError(
                "Expected at least one of `fields` "
                f"{list(self.dataset.field_names)}, got an empty sequence."
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
            IndexError: If no map has this index.
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
