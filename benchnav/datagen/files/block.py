"""Blocks: consecutive maps of a split, compressed and digested, ready to be written to a dataset.

Making a block is the work that threads share; writing one is copying. Letters in shapes: B maps.
"""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import safetensors.numpy

from benchnav.datagen import schema
from benchnav.datagen.files import chunks
from benchnav.files import replacing

BLOCK_MAPS = 32
_VALUES_A_CHUNK = 1024


@dataclass(frozen=True)
class Block:
    """Some maps as they are to be stored.

    Args:
        chunks: for each field with an array a map, the B encoded chunks.
        values: for each other field, its values, shape [B, *entry shape].
        digests: from `schema.entry_digests`, shape [B, F, 32].
    """

    chunks: dict[str, list[bytes]]
    values: dict[str, np.ndarray]
    digests: np.ndarray

    @classmethod
    def of(cls, maps: Mapping[str, np.ndarray]) -> "Block":
        """Compresses and digests maps, every field of `schema.FIELDS` of shape [B, *entry shape]."""
        return cls(
            chunks={name: [chunks.encode(entry) for entry in maps[name]] for name in schema.MAP_FIELDS},
            values={name: maps[name] for name in schema.FIELDS if name not in schema.MAP_FIELDS},
            digests=schema.entry_digests(maps),
        )

    def __len__(self) -> int:
        """Number of maps B."""
        return len(self.digests)

    def save(self, path: Path) -> None:
        """Writes the block to a file of its own, behind the SHA-256 of what follows."""
        packed: dict[str, np.ndarray] = {"digests": self.digests, **self.values}
        for name, encoded in self.chunks.items():
            packed[f"{name}.bytes"] = np.frombuffer(b"".join(encoded), np.uint8)
            packed[f"{name}.ends"] = np.cumsum([len(chunk) for chunk in encoded])
        content = safetensors.numpy.save(packed)
        with replacing(path, durable=False) as partial, open(partial, "wb") as file:
            file.write(hashlib.sha256(content).digest())
            file.write(content)

    @staticmethod
    def is_whole(path: Path) -> bool:
        """Tells whether there is a file from `save`, and the disk kept all of it."""
        if not path.exists():
            return False
        digest, content = _open_saved(path)
        return hashlib.sha256(content).digest() == digest

    @classmethod
    def load(cls, path: Path) -> "Block":
        """Reads what `save` wrote."""
        packed = safetensors.numpy.load(_open_saved(path)[1])
        return cls(
            chunks={name: _cut(packed, name) for name in schema.MAP_FIELDS},
            values={name: packed[name] for name in schema.FIELDS if name not in schema.MAP_FIELDS},
            digests=packed["digests"],
        )


def spans(maps: int, size: int) -> Iterator[tuple[int, int]]:
    """Cuts `maps` maps into stretches of `size`: the first of each, and one past its last."""
    return ((start, min(start + size, maps)) for start in range(0, maps, size))


def new_split(file: h5py.File, name: str, maps: int, height: int, width: int) -> dict[str, h5py.Dataset]:
    """Makes the empty arrays of a split, to be filled by `write`.

    Returns:
        The arrays by name. To be kept until all is written: HDF5 writes an array out when it is let go.
    """
    group, arrays = file.create_group(name), {}
    for field_name, field in schema.FIELDS.items():
        entry = field.entry_shape(height, width)
        new = chunks.new_array if field_name in schema.MAP_FIELDS else _new_values
        arrays[field_name] = new(group, field_name, maps, entry, field.dtype)
        arrays[field_name].attrs["unit"] = field.unit
        arrays[field_name].attrs["meaning"] = field.meaning
    digests = (len(schema.FIELDS), schema.DIGEST_BYTES)
    arrays[schema.ENTRY_DIGESTS] = _new_values(group, schema.ENTRY_DIGESTS, maps, digests, "|u1")
    return arrays


def write(arrays: Mapping[str, h5py.Dataset], start: int, block: Block) -> None:
    """Puts a block into a split from `new_split`, from map `start` on."""
    for name, encoded in block.chunks.items():
        chunks.write(arrays[name], start, encoded)
    for name, values in {**block.values, schema.ENTRY_DIGESTS: block.digests}.items():
        arrays[name][start : start + len(block)] = values


def _new_values(group: h5py.Group, name: str, maps: int, entry: tuple[int, ...], dtype: str) -> h5py.Dataset:
    chunk = (min(maps, _VALUES_A_CHUNK), *entry)
    return group.create_dataset(
        name, (maps, *entry), dtype, chunks=chunk, shuffle=True, compression="gzip", fletcher32=True
    )


def _cut(packed: Mapping[str, np.ndarray], name: str) -> list[bytes]:
    whole, ends = packed[f"{name}.bytes"].tobytes(), packed[f"{name}.ends"].tolist()
    return [whole[start:end] for start, end in zip([0, *ends[:-1]], ends, strict=True)]


def _open_saved(path: Path) -> tuple[bytes, bytes]:
    whole = path.read_bytes()
    return whole[: schema.DIGEST_BYTES], whole[schema.DIGEST_BYTES :]
