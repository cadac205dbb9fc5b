"""A split as a map-style PyTorch dataset, for training loops of one's own."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.data import Dataset

from benchnav.core.errors import DatasetError
from benchnav.datagen.files.find import find_dataset
from benchnav.datagen.files.reader import TerrainDataset


class TerrainMaps(Dataset[dict[str, Tensor]]):
    """The maps of a split, each a dict of tensors by field.

    Safe under DataLoader workers, forked or spawned: each process opens files for
    itself, at the first map of each. Only the fields asked for are read.

    Args:
        path: dataset file or folder, or the id of one at hand.
        split: name of one of its splits.
        fields: names among `TerrainDataset.field_names`.
        in_memory: read all maps at once, here; worth it for what is read many times.

    Raises:
        DatasetError: no such file, split or field; when a map is read: its data are
            damaged.
    """

    def __init__(
        self,
        path: str | Path,
        split: str,
        fields: Sequence[str] = ("rgb", "class_id"),
        in_memory: bool = False,
    ) -> None:
        """Checks split and fields, and reads the maps where that is asked for."""
        self.dataset = TerrainDataset(find_dataset(path).resolve(), keep_open=True)
        self.split, self.fields = split, self.dataset.check_fields(tuple(fields))
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
        """Reads a map; negative indices count from the end.

        Returns:
            Tensors by field, each of the field's entry shape.

        Raises:
            IndexError: there is no such map.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"Expected a map index in 0–{len(self) - 1}, got {index}.")
        return {
            name: values[0]
            for name, values in self.read([int(index) % len(self)]).items()
        }

    def read(self, indices: Sequence[int]) -> dict[str, Tensor]:
        """Reads maps by their indices ≥ 0, in any order; tensors by field, each of
        shape [B, *entry shape].
        """
        if self._memory is None:
            read = self.dataset.read(self.split, indices, self.fields)
            return {name: torch.from_numpy(values) for name, values in read.items()}
        which = torch.as_tensor(indices)
        return {name: values[which] for name, values in self._memory.items()}
