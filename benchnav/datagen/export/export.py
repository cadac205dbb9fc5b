"""Exports a dataset to a folder of Parquet files with Croissant metadata, whole or not at all."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchnav.core.errors import choose, expect
from benchnav.core.store import building, take_place
from benchnav.datagen.export.croissant import CARD, METADATA, Publication, card, metadata
from benchnav.datagen.export.parquet import FOLDER, split_names, write_split
from benchnav.datagen.files.hdf5 import held
from benchnav.datagen.files.reader import TerrainDataset


def export(
    dataset: TerrainDataset,
    out: Path,
    publication: Publication,
    splits: Sequence[str] | None = None,
    fields: Sequence[str] | None = None,
    maps_a_file: int = 0,
    overwrite: bool = False,
) -> Iterator[tuple[int, int]]:
    """Exports a dataset, yielding (maps done, maps in all) as it goes; to be iterated to the end.

    Args:
        dataset: what to export.
        out: the folder, which takes its name when it is whole.
        publication: licence, creator, place and date; without a date that of today.
        splits: which splits, in the dataset's order; None for all.
        fields: which of its fields, in their order; None for all.
        maps_a_file: most maps of a file; 0 for as many as make a file of a few hundred MB at most.
        overwrite: replace an exported dataset that is there.

    Raises:
        DatasetError: the dataset is damaged, or `out` cannot be written.
        ConfigError: no such split or field, or `out` is taken.
    """
    names = split_names(choose("splits", splits, dataset.splits))
    columns = choose("fields", fields, dataset.fields)
    expect(maps_a_file >= 0, f"`maps_per_file` ≥ 0, got {maps_a_file}.")
    out = out.resolve()
    done, total = 0, sum(dataset.map_count(split) for split in names)
    with held(out, overwrite, _foreign), building(out) as folder:
        (folder / FOLDER).mkdir()
        yield done, total
        for split, name in names.items():
            for maps in write_split(folder / FOLDER, name, dataset, split, columns, maps_a_file):
                done += maps
                yield done, total
        about = metadata(dataset, names, columns, publication, folder)
        (folder / METADATA).write_text(json.dumps(about, indent=1, ensure_ascii=False) + "\n")
        (folder / CARD).write_text(card(dataset, names, publication))
        take_place(folder, out)


def _foreign(out: Path) -> str:
    return "" if (out / METADATA).is_file() else "is no exported dataset"
