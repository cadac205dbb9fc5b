"""The command `export`: a dataset for other tools.

This module imports nothing heavy, so that the command's help is quick.
"""


def export(
    file: str,
    out: str,
    splits: list[str] | None = None,
    fields: list[str] | None = None,
    maps_per_file: int = 0,
    license: str = "",
    creator: str = "",
    url: str = "",
    date: str = "",
    overwrite: bool = False,
) -> None:
    """Export a dataset to Parquet files with Croissant metadata, which other tools read without this package.

    Args:
        file: Path or id of a dataset.
        out: Folder to write.
        splits: Only these splits, for example [test/std,test/hg].
        fields: Only these fields, for example [rgb,class_id].
        maps_per_file: Most maps of a file; 0 makes files of a few hundred MB at most.
        license: Name in the SPDX list, such as CC-BY-4.0, or a URL; of maps of a shipped recipe MIT when not given.
        creator: Who made the maps; of maps of a shipped recipe the BenchNav authors when not given.
        url: Where the dataset will be found.
        date: Date of publication, YYYY-MM-DD; today when not given.
        overwrite: Replace an exported dataset that is there.
    """
    from rich.filesize import decimal

    from benchnav.core.command import show_progress
    from benchnav.core.errors import ConfigError
    from benchnav.core.store import output_path
    from benchnav.datagen.export.croissant import AUTHORS, Publication, is_ours
    from benchnav.datagen.export.export import export as export_dataset
    from benchnav.datagen.files.reader import TerrainDataset, find_dataset

    dataset = TerrainDataset(find_dataset(file))
    chosen = list(dataset.splits) if splits is None else [name for name in splits if name in dataset.splits]
    if not is_ours(dataset, chosen) and not (license and creator):
        raise ConfigError(
            f"Expected `license` and `creator` of {dataset.id}, whose maps are not of a shipped recipe, got none. Pass "
            "yours; of imported maps those of the elevation model, its classes and photo."
        )
    publication = Publication(license=license or "MIT", creator=creator or AUTHORS, url=url, date=date)
    path = output_path(out)
    steps = export_dataset(dataset, path, publication, splits, fields, maps_per_file, overwrite)
    show_progress(steps, "maps")
    files = sorted(path.rglob("*.parquet"))
    size = decimal(sum(item.stat().st_size for item in files))
    print(f"wrote {path} ({size} in {len(files)} Parquet file{'s' * (len(files) > 1)}, with croissant.json)")
