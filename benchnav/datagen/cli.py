"""Command `benchnav-datagen`: create, inspect, merge, import and export datasets.

Slow modules are imported where they are used, directly or through `datagen`, so that
the command's help is fast.
"""

import sys
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Literal

from benchnav import datagen
from benchnav.core.command import INTERRUPTED, Command, run, tell
from benchnav.core.errors import DatasetError, choose, expect
from benchnav.core.progress import show_progress
from benchnav.core.store import check_workers, read_shard, replacing, write_text
from benchnav.core.tables import Table, print_table
from benchnav.datagen.import_commands import import_dem, import_drives

# Maximum number of cells of a dataset that is one file by default.
_MAX_CELLS_PER_FILE = 2**28


def create(
    recipe: str,
    overrides: list[str],
    out: str = "",
    jobs: int = 1,
    seed: int | None = None,
    splits: list[str] | None = None,
    first: int = 0,
    shard: str = "",
    backend: Literal["local", "dask"] = "local",
    scheduler: str = "",
    overwrite: bool = False,
) -> None:
    """Create a dataset from a recipe.

    Args:
        recipe: Id of a shipped recipe, such as paper-v1, or path of a YAML file.
        overrides: Changes to the recipe, such as id=mine splits.train.maps=50
            scenarios.hs.severity=0.5.
        out: Path of the .h5 file to write, or of a folder for many files. If empty,
            datasets/ID.h5, or datasets/ID for many maps.
        jobs: Number of worker processes on this machine, unless a Dask cluster is used.
            The maps do not depend on this number.
        seed: Root seed that replaces the recipe's, for other maps of the same classes.
            The dataset's id is then ID-seedN.
        splits: Splits to create, for example [test/std,test/hg]. Their maps are the
            same as in the complete dataset. If not given, all.
        first: Number of maps of each split to create, from the first; 0 for all.
        shard: Part of the maps to create, such as 2/5 for the second of five parts. If
            empty, all.
        backend: local for worker processes on this machine, dask for a Dask cluster.
        scheduler: Address of the Dask cluster's scheduler, tcp://HOST:PORT.
        overwrite: Replace an existing dataset.
    """
    from benchnav.datagen.difficulty import table
    from benchnav.datagen.files.describe import written
    from benchnav.datagen.files.manifest import is_dataset

    check_workers(jobs, backend, scheduler)
    expect(first >= 0, f"`first` ≥ 0, got {first}.")
    requested = read_shard(shard)
    loaded = datagen.load_recipe(recipe, overrides)
    if seed is not None and seed != loaded.seed:
        loaded = replace(loaded, seed=seed, id=f"{loaded.id}-seed{seed}")
    sizes = {}
    for name in choose("splits", splits, loaded.splits):
        spec = loaded.splits[name]
        n_maps = spec.maps
        if first:
            n_maps = min(first, n_maps)
        sizes[name] = replace(spec, maps=n_maps)
    loaded = replace(loaded, splits=sizes)
    n_maps = sum(spec.maps for spec in sizes.values())
    n_cells = n_maps * loaded.height * loaded.width
    is_folder = requested is not None or n_cells > _MAX_CELLS_PER_FILE
    suffix = "" if is_folder else ".h5"
    path = Path(out or f"datasets/{loaded.id}{suffix}")
    steps = datagen.create_dataset(loaded, path, jobs, scheduler, requested, overwrite)
    done, total = next(steps)
    if done:
        tell(f"{done} of {total} maps already exist")
    show_progress(chain([(done, total)], steps), "maps")
    if not is_dataset(path):
        print(
            f"{path}: shard {requested} is complete\n"
            "The dataset is finished when all shards in this folder are complete. "
            "Merge shards in several folders with\n"
            f"benchnav-datagen merge {path} OTHER … --out OUT"
        )
        return
    print_table(table(written(path)))


def list_datasets(folder: str = "") -> None:
    """List the shipped recipes and the local datasets.

    Args:
        folder: Folder to search. If empty, the folders that are searched for ids.
    """
    from benchnav.datagen.files.describe import widest
    from benchnav.datagen.files.find import dataset_folders
    from benchnav.datagen.files.manifest import FOLDER_MANIFEST
    from benchnav.datagen.recipe.load import shipped_sizes

    is_valid = not folder or Path(folder).is_dir()
    expect(is_valid, f"`folder` as an existing folder, got {folder!r}.")
    print("recipes:")
    recipes = datagen.shipped_recipes()
    width = widest(recipes)
    for name in recipes:
        sizes = [f"{split} {maps}" for split, maps in shipped_sizes(name).items()]
        print(f"  {name:{width}} {', '.join(sizes)}")
    parents = [Path(folder)] if folder else dataset_folders()
    for parent in parents:
        folders = [manifest.parent for manifest in parent.glob(f"*/{FOLDER_MANIFEST}")]
        files = sorted([*parent.glob("*.h5"), *folders])
        heading = f"files in {parent}:" if files else f"no files in {parent}"
        print(heading)
        width = widest(path.name for path in files)
        for path in files:
            try:
                dataset = datagen.TerrainDataset(path)
            except DatasetError as error:
                print(f"  {path.name:{width}} not readable: {error}")
                continue
            splits = dataset.splits.items()
            text = ", ".join(f"{split} {entry['maps']}" for split, entry in splits)
            if dataset.layer_names:
                text += f"; layers {', '.join(dataset.layer_names)}"
            print(f"  {path.name:{width}} {dataset.id:14} {text}")


def show(file: str, json: bool = False) -> None:
    """Show splits, scenarios, sizes, class table, provenance and digests of a dataset.

    Args:
        file: Path or id of a dataset.
        json: Print the description as JSON.
    """
    from json import dumps

    from benchnav.datagen.files.describe import describe, tables

    described = describe(_opened(file))
    if json:
        print(dumps(described, indent=1))
        return
    for item in tables(described):
        if isinstance(item, Table):
            print_table(item)
        else:
            print(item)


def validate(file: str) -> int:
    """Check all data of a dataset; the exit status is 1 if the dataset has faults.

    Args:
        file: Path or id of a dataset.
    """
    from benchnav.datagen.files.check import find_faults, summarise

    path = datagen.find_dataset(file)
    try:
        faults = find_faults(path)
    except DatasetError as error:
        print(f"{error}\n{path}: 1 fault")
        return 1
    for line in summarise(faults):
        print(line)
    entries = datagen.TerrainDataset(path).splits.values()
    if not faults:
        n_maps = sum(entry["maps"] for entry in entries)
        print(f"{path}: sound, {n_maps} maps in {len(entries)} split(s)")
        return 0
    print(f"{path}: {len(faults)} fault(s)")
    files = sorted({fault.file for fault in faults if fault.file})
    is_generated = all("recipe" in part for entry in entries for part in entry["parts"])
    if not is_generated:
        remedy = "import its maps again."
    elif files:
        names = " ".join(files)
        remedy = f"remove {names} in {path} and run the command that created it again."
    else:
        remedy = (
            "create the file again with --overwrite. The same recipe and version yield "
            "the same digests."
        )
    print(f"To repair the dataset, {remedy}")
    return 1


def merge(files: list[str], out: str, id: str = "", overwrite: bool = False) -> None:
    """Merge datasets of the same grid and classes; splits of the same name are joined.

    Args:
        files: Paths or ids of two or more datasets, or folders with the shards of one
            dataset.
        out: Path of the .h5 file to write, or of a folder for many files.
        id: Id of the new dataset. If empty, the name of the output. Not used for
            shards, which keep the id of their recipe.
        overwrite: Replace an existing dataset.
    """
    from benchnav.datagen.files.describe import written
    from benchnav.datagen.files.merge import merge as merge_datasets

    path = Path(out)
    sources = []
    for file in files:
        is_folder = Path(file).is_dir()
        source = Path(file) if is_folder else datagen.find_dataset(file)
        sources.append(source)
    steps = merge_datasets(sources, path, id, overwrite)
    show_progress(steps, "maps")
    written(path)


def ground(file: str, out: str = "", overwrite: bool = False) -> None:
    """Write terrain statistics over all maps of the split train.

    Beliefs use these statistics for unobserved cells and for look-alike classes.

    Args:
        file: Path or id of a dataset with a split train.
        out: Path of the .json file to write. If empty, DATASET.ground.json next to the
            dataset, where it is found for models without statistics.
        overwrite: Replace an existing file.
    """
    from benchnav.datagen.ground import fit_ground, ground_file

    dataset = _opened(file)
    path = Path(out) if out else ground_file(dataset.path)
    expect(path.suffix == ".json", f"`out` to end in .json, got {out!r}.")
    may_write = overwrite or not path.exists()
    expect(
        may_write,
        f"`out` to be a new file, got {path}, which exists. Pass --overwrite to "
        "replace it.",
    )
    statistics = fit_ground(dataset)
    write_text(path, statistics.to_json())
    pairs = ", ".join(" and ".join(pair) for pair in statistics.look_alikes)
    look_alikes = ""
    if pairs:
        strength = f"{statistics.potts_strength:.2f}"
        look_alikes = f"; {pairs} look alike, coupling of neighbours {strength}"
    n_maps = dataset.map_count("train")
    n_gaussians = len(statistics.weights)
    print(
        f"wrote {path}: λ of {n_maps} maps, a mixture of {n_gaussians} "
        f"Gaussians{look_alikes}"
    )


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
    """Export a dataset to Parquet files with Croissant metadata, for other tools.

    Args:
        file: Path or id of a dataset.
        out: Folder to write.
        splits: Splits to export, for example [test/std,test/hg]. If not given, all.
        fields: Fields to export, for example [rgb,class_id]. If not given, all.
        maps_per_file: Maximum number of maps in a file; if 0, files have up to a few
            hundred MB.
        license: Identifier from the SPDX list, such as CC-BY-4.0, or a URL. If empty,
            MIT for maps of a shipped recipe.
        creator: Creator of the maps. If empty, the BenchNav authors for maps of a
            shipped recipe.
        url: Address at which the dataset will be published.
        date: Date of publication, YYYY-MM-DD. If empty, today.
        overwrite: Replace an existing exported dataset.
    """
    from rich.filesize import decimal

    from benchnav.datagen.export.export import AUTHORS, Publication, is_ours
    from benchnav.datagen.export.export import export as export_dataset

    dataset = _opened(file)
    chosen = choose("splits", splits, dataset.splits)
    has_origin = bool(license and creator) or is_ours(dataset, chosen)
    expect(
        has_origin,
        f"both `license` and `creator` for {dataset.id}, got {license!r} and "
        f"{creator!r}. The maps do not come from a shipped recipe. Pass your licence "
        "and name. For imported maps, pass the licence and creator of the elevation "
        "model, classes and photo.",
    )
    license = license or "MIT"
    creator = creator or AUTHORS
    publication = Publication(license=license, creator=creator, url=url, date=date)
    path = Path(out)
    steps = export_dataset(
        dataset, path, publication, chosen, fields, maps_per_file, overwrite
    )
    show_progress(steps, "maps")
    files = sorted(path.rglob("*.parquet"))
    n_bytes = sum(file.stat().st_size for file in files)
    noun = "file" if len(files) == 1 else "files"
    print(
        f"wrote {path} ({decimal(n_bytes)} in {len(files)} Parquet {noun}, with "
        "croissant.json)"
    )


def preview(
    file: str,
    split: str = "",
    maps: list[int] | None = None,
    out: str = "",
    contact_sheet: bool = False,
) -> None:
    """Draw maps of a dataset to an image file.

    Args:
        file: Path or id of a dataset.
        split: Split to draw. If empty, test/std, or the first split if test/std does
            not exist.
        maps: Indices of the maps. If not given, [0, 1, 2].
        out: Path of the image file to write. If empty, preview-SPLIT.png or
            contact-SPLIT.png.
        contact_sheet: Draw thumbnails of up to 100 maps of the split instead.
    """
    from benchnav.datagen.preview import contact_sheet_figure, preview_figure
    from benchnav.viz.style import save

    dataset = _opened(file)
    if not split:
        names = list(dataset.splits)
        split = "test/std" if "test/std" in names else names[0]
    kind = "contact" if contact_sheet else "preview"
    file_name = f"{kind}-{split.replace('/', '-')}.png"
    path = Path(out or file_name)
    expect(
        path.suffix in (".png", ".pdf", ".svg", ".jpg"),
        f"`out` to end in .png, .pdf, .svg or .jpg, got {str(path)!r}.",
    )
    expect(
        maps is None or not contact_sheet,
        "either `maps` or `contact-sheet`, got both. Leave one out.",
    )
    expect(maps is None or maps, "`maps` with at least one index, got [].")
    if contact_sheet:
        figure = contact_sheet_figure(dataset, split)
    else:
        if maps is None:
            n_maps = min(3, dataset.map_count(split))
            maps = list(range(n_maps))
        figure = preview_figure(dataset, split, sorted(set(maps)))
    with replacing(path) as partial:
        save(figure, partial, path.suffix[1:])
    print(f"wrote {path}")


def _opened(file: str) -> "datagen.TerrainDataset":
    """Return the dataset with a path or an id."""
    return datagen.TerrainDataset(datagen.find_dataset(file))


COMMANDS = {
    "create": Command(create, ("recipe", "overrides")),
    "list": Command(list_datasets),
    "show": Command(show, ("file",)),
    "validate": Command(validate, ("file",)),
    "merge": Command(merge, ("files",)),
    "import-dem": Command(import_dem, ("dem", "overrides"), repeated=("layer",)),
    "import-drives": Command(
        import_drives, ("drives", "overrides"), repeated=("layer",)
    ),
    "ground": Command(ground, ("file",)),
    "export": Command(export, ("file",)),
    "preview": Command(preview, ("file",)),
}


def main() -> None:
    """Entry point of `benchnav-datagen`."""
    description = (
        "Create, list, show, check, merge, import, export and draw terrain datasets."
    )
    status = run("benchnav-datagen", description, COMMANDS)
    if status == INTERRUPTED and sys.argv[1] == "create":
        tell(
            "benchnav-datagen: finished maps are kept; to resume, run the same command "
            "again"
        )
    sys.exit(status)
