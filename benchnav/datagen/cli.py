"""The command `benchnav-datagen`: make, list, show, check, combine, import, export and
draw datasets.

What is heavy is imported where it is called, or asked of `datagen` there, so that the
command's help is quick.
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

# A dataset of more becomes a folder of files.
_MOST_CELLS_OF_A_FILE = 2**28


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
    """Make a dataset from a recipe.

    Args:
        recipe: Id of a shipped recipe, such as paper-v1, or path of a YAML file.
        overrides: Changes to it, such as id=mine splits.train.maps=50
            scenarios.hs.severity=0.5.
        out: File .h5, or a folder for many files; datasets/ID.h5 if not given,
            datasets/ID for many maps.
        jobs: Worker processes of this machine; a cluster has its own. The result is the
            same for any number.
        seed: Root seed in place of the recipe's; makes other maps of the same classes,
            under the id ID-seedN.
        splits: Only these splits, for example [test/std,test/hg]; the same maps as in
            the whole.
        first: Number of maps of each split to make, the first of the whole dataset; 0
            makes all.
        shard: Make only this shard of the maps, such as 2/5; the others may be made on
            other machines.
        backend: Worker processes on this machine, or those of a Dask cluster.
        scheduler: Address of the Dask cluster's scheduler, tcp://HOST:PORT.
        overwrite: Replace what is there.
    """
    from benchnav.datagen.difficulty import table
    from benchnav.datagen.files.describe import written
    from benchnav.datagen.files.manifest import is_dataset

    check_workers(jobs, backend, scheduler)
    expect(first >= 0, f"`first` ≥ 0, got {first}.")
    own = read_shard(shard)
    chosen = datagen.load_recipe(recipe, overrides)
    if seed is not None and seed != chosen.seed:
        chosen = replace(chosen, seed=seed, id=f"{chosen.id}-seed{seed}")
    sizes = {}
    for name in choose("splits", splits, chosen.splits):
        spec = chosen.splits[name]
        sizes[name] = replace(spec, maps=min(first or spec.maps, spec.maps))
    chosen, maps = (
        replace(chosen, splits=sizes),
        sum(spec.maps for spec in sizes.values()),
    )
    is_folder = (
        own is not None or maps * chosen.height * chosen.width > _MOST_CELLS_OF_A_FILE
    )
    path = Path(out or f"datasets/{chosen.id}{'' if is_folder else '.h5'}")
    steps = datagen.create_dataset(chosen, path, jobs, scheduler, own, overwrite)
    done, total = next(steps)
    if done:
        tell(f"{done} of {total} maps were there already")
    show_progress(chain([(done, total)], steps), "maps")
    if not is_dataset(path):
        print(
            f"{path}: shard {own} is made\n"
            "The last shard made in this folder finishes the dataset. Join shards of "
            "several folders with\n"
            f"benchnav-datagen merge {path} OTHER … --out OUT"
        )
        return
    print_table(table(written(path)))


def list_datasets(folder: str = "") -> None:
    """List the shipped recipes and the datasets at hand.

    Args:
        folder: Where to look for files; where ids are looked up when not given.
    """
    from benchnav.datagen.files.describe import widest
    from benchnav.datagen.files.find import dataset_folders
    from benchnav.datagen.files.manifest import FOLDER_MANIFEST
    from benchnav.datagen.recipe.recipe import shipped_sizes

    expect(
        not folder or Path(folder).is_dir(),
        f"`folder` as a folder that exists, got {folder!r}.",
    )
    print("recipes:")
    wide = widest(datagen.shipped_recipes())
    for name in datagen.shipped_recipes():
        sizes = ", ".join(
            f"{split} {maps}" for split, maps in shipped_sizes(name).items()
        )
        print(f"  {name:{wide}} {sizes}")
    for place in [Path(folder)] if folder else dataset_folders():
        folders = [manifest.parent for manifest in place.glob(f"*/{FOLDER_MANIFEST}")]
        files = sorted([*place.glob("*.h5"), *folders])
        print(f"files in {place}:" if files else f"no files in {place}")
        wide = widest(path.name for path in files)
        for path in files:
            try:
                dataset = datagen.TerrainDataset(path)
            except DatasetError as error:
                print(f"  {path.name:{wide}} not readable: {error}")
                continue
            sizes = ", ".join(
                f"{split} {entry['maps']}" for split, entry in dataset.splits.items()
            )
            layers = (
                f"; layers {', '.join(dataset.layer_names)}"
                if dataset.layer_names
                else ""
            )
            print(f"  {path.name:{wide}} {dataset.id:14} {sizes}{layers}")


def show(file: str, json: bool = False) -> None:
    """Show what a dataset holds: splits, scenarios, sizes, class table, provenance,
    digests.

    Args:
        file: Path or id of a dataset.
        json: Print it as JSON.
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
    """Check a dataset whole; exit status 1 when something is wrong.

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
        print(
            f"{path}: sound, {sum(entry['maps'] for entry in entries)} maps in "
            f"{len(entries)} split(s)"
        )
        return 0
    print(f"{path}: {len(faults)} fault(s)")
    files = sorted({fault.file for fault in faults if fault.file})
    if not all("recipe" in part for entry in entries for part in entry["parts"]):
        print("To mend it, import its maps again.")
    elif files:
        print(
            f"To mend it, remove {' '.join(files)} in {path} and give the command "
            "that made it again."
        )
    else:
        print(
            "To mend it, make the file again with --overwrite. The same recipe and "
            "version give the same digests."
        )
    return 1


def merge(files: list[str], out: str, id: str = "", overwrite: bool = False) -> None:
    """Combine datasets of the same grid and classes to one; splits of one name are
    joined.

    Args:
        files: Paths or ids of two or more datasets, or folders with the shards of one.
        out: File .h5 to write, or a folder for many files.
        id: Id of the new dataset; the name of the file when not given. Shards keep that
            of their recipe.
        overwrite: Replace what is there.
    """
    from benchnav.datagen.files.describe import written
    from benchnav.datagen.files.merge import merge as merge_datasets

    path = Path(out)
    sources = [
        Path(file) if Path(file).is_dir() else datagen.find_dataset(file)
        for file in files
    ]
    show_progress(merge_datasets(sources, path, id, overwrite), "maps")
    written(path)


def ground(file: str, out: str = "", overwrite: bool = False) -> None:
    """Write what is known of ground before any of it is seen: statistics of all maps of
    the split train together.

    Beliefs need them of cells that a robot has not seen yet, and of classes that look
    alike.

    Args:
        file: Path or id of a dataset with a split train.
        out: File .json to write; beside the dataset, as DATASET.ground.json, when not
            given. There they are found of any model that brings none of its own.
        overwrite: Replace a file that is there.
    """
    from benchnav.datagen.ground import fit_ground, ground_file

    dataset = _opened(file)
    path = Path(out) if out else ground_file(dataset.path)
    expect(path.suffix == ".json", f"`out` as a file .json, got {out!r}.")
    expect(
        overwrite or not path.exists(),
        f"`out` as a new file, got {path}, which exists. Pass --overwrite to replace "
        "it.",
    )
    found = fit_ground(dataset)
    write_text(path, found.to_json())
    pairs = ", ".join(" and ".join(pair) for pair in found.look_alikes)
    alike = (
        f"; {pairs} look alike, strength of the field {found.potts_strength:.2f}"
        if pairs
        else ""
    )
    print(
        f"wrote {path}: λ of {dataset.map_count('train')} maps by "
        f"{len(found.weights)} Gaussians{alike}"
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
    """Export a dataset to Parquet files with Croissant metadata, which other tools read
    without this package.

    Args:
        file: Path or id of a dataset.
        out: Folder to write.
        splits: Only these splits, for example [test/std,test/hg].
        fields: Only these fields, for example [rgb,class_id].
        maps_per_file: Most maps of a file; 0 makes files of a few hundred MB at most.
        license: Name in the SPDX list, such as CC-BY-4.0, or a URL; of maps of a
            shipped recipe MIT when not given.
        creator: Who made the maps; of maps of a shipped recipe the BenchNav authors
            when not given.
        url: Where the dataset will be found.
        date: Date of publication, YYYY-MM-DD; today when not given.
        overwrite: Replace an exported dataset that is there.
    """
    from rich.filesize import decimal

    from benchnav.datagen.export.export import AUTHORS, Publication, is_ours
    from benchnav.datagen.export.export import export as export_dataset

    dataset = _opened(file)
    chosen = choose("splits", splits, dataset.splits)
    expect(
        (license and creator) or is_ours(dataset, chosen),
        f"`license` and `creator` of {dataset.id}, whose maps are not of a shipped "
        "recipe, got none. Pass yours; of "
        "imported maps those of the elevation model, its classes and photo.",
    )
    publication = Publication(
        license=license or "MIT", creator=creator or AUTHORS, url=url, date=date
    )
    path = Path(out)
    steps = export_dataset(
        dataset, path, publication, chosen, fields, maps_per_file, overwrite
    )
    show_progress(steps, "maps")
    files = sorted(path.rglob("*.parquet"))
    size = sum(item.stat().st_size for item in files)
    print(
        f"wrote {path} ({decimal(size)} in {len(files)} Parquet "
        f"file{'s' * (len(files) > 1)}, with croissant.json)"
    )


def preview(
    file: str,
    split: str = "",
    maps: list[int] | None = None,
    out: str = "",
    contact_sheet: bool = False,
) -> None:
    """Draw maps of a dataset to a picture.

    Args:
        file: Path or id of a dataset.
        split: Which split; test/std, or else the first, when not given.
        maps: Which maps; [0, 1, 2] when not given.
        out: Picture to write; preview-SPLIT.png or contact-SPLIT.png when not given.
        contact_sheet: Thumbnails of the split's maps instead; of a large one, of its
            first 100.
    """
    from benchnav.datagen.preview import contact_sheet_figure, preview_figure
    from benchnav.viz.style import save

    dataset = _opened(file)
    split = split or (
        "test/std" if "test/std" in dataset.splits else next(iter(dataset.splits))
    )
    path = Path(
        out
        or f"{'contact' if contact_sheet else 'preview'}-{split.replace('/', '-')}.png"
    )
    expect(
        path.suffix in (".png", ".pdf", ".svg", ".jpg"),
        f"`out` to end in .png, .pdf, .svg or .jpg, got {str(path)!r}.",
    )
    expect(maps is None or not contact_sheet, "`maps` or `contact-sheet`, got both.")
    expect(maps is None or maps, "`maps` with at least one index, got none.")
    if contact_sheet:
        figure = contact_sheet_figure(dataset, split)
    else:
        some = (
            range(min(3, dataset.map_count(split)))
            if maps is None
            else sorted(set(maps))
        )
        figure = preview_figure(dataset, split, list(some))
    with replacing(path) as partial:
        save(figure, partial, path.suffix[1:])
    print(f"wrote {path}")


def _opened(file: str) -> "datagen.TerrainDataset":
    """The dataset of a path or an id."""
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
        "Make, list, show, check, combine, import, export and draw terrain datasets."
    )
    status = run("benchnav-datagen", description, COMMANDS)
    if status == INTERRUPTED and sys.argv[1] == "create":
        tell(
            "benchnav-datagen: finished maps are kept; to go on, give the same "
            "command again"
        )
    sys.exit(status)
