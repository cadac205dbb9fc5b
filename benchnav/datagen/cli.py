"""The command `benchnav-datagen`: make, list, show, check, combine, import, export and draw datasets."""

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from benchnav.core.command import INTERRUPTED, Command, run
from benchnav.datagen.dem.command import import_dem
from benchnav.datagen.export.command import export

if TYPE_CHECKING:
    from benchnav.datagen.files.check import Fault
    from benchnav.datagen.files.reader import TerrainDataset


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
        overrides: Changes to it, such as id=mine splits.train.maps=50 scenarios.hs.severity=0.5.
        out: File .h5 to write, or else a folder of many files; datasets/ID.h5 if not given, datasets/ID for many maps.
        jobs: Worker processes of this machine; a cluster has its own. The result is the same for any number.
        seed: Root seed in place of the recipe's: a sibling, of id ID-seedN, with other maps of the same classes.
        splits: Only these splits, for example [test/std,test/hg]; the same maps as in the whole.
        first: Only the first so many maps of each split; the same maps as in the whole. 0 makes all.
        shard: Make only this shard of the maps, such as 2/5; the others may be made on other machines.
        backend: Worker processes on this machine, or those of a Dask cluster.
        scheduler: Address of the Dask cluster's scheduler, tcp://HOST:PORT.
        overwrite: Replace what is there.
    """
    from benchnav.core.command import show_progress
    from benchnav.core.errors import ConfigError
    from benchnav.core.store import output_path, read_shard
    from benchnav.core.tables import print_table
    from benchnav.datagen.difficulty import table
    from benchnav.datagen.files.create import create as create_dataset
    from benchnav.datagen.files.describe import say_written
    from benchnav.datagen.files.reader import TerrainDataset, is_dataset
    from benchnav.datagen.recipe.recipe import load_recipe

    if jobs < 1:
        raise ConfigError(f"Expected `jobs` ≥ 1, got {jobs}.")
    if (backend == "dask") != bool(scheduler):
        raise ConfigError("Expected `backend` dask and `scheduler` together, got one without the other.")
    own = read_shard(shard)
    chosen = load_recipe(recipe, overrides)
    if seed is not None and seed != chosen.seed:
        chosen = replace(chosen, seed=seed, id=f"{chosen.id}-seed{seed}")
    if splits is not None:
        unknown = [name for name in splits if name not in chosen.splits]
        if unknown or not splits:
            raise ConfigError(f"Expected `splits` among {sorted(chosen.splits)}, got {unknown or 'none'}.")
        chosen = replace(
            chosen, splits={name: chosen.splits[name] for name in chosen.splits if name in splits}
        )
    if first < 0:
        raise ConfigError(f"Expected `first` ≥ 0, got {first}.")
    if first:
        kept = {name: replace(spec, maps=min(first, spec.maps)) for name, spec in chosen.splits.items()}
        chosen = replace(chosen, splits=kept)
    cells = sum(spec.maps for spec in chosen.splits.values()) * chosen.height * chosen.width
    is_folder = own is not None or cells > _MOST_CELLS_OF_A_FILE
    path = output_path(out or f"datasets/{chosen.id}{'' if is_folder else '.h5'}")
    steps = create_dataset(chosen, path, jobs, scheduler, own, overwrite)
    show_progress(_tell_kept(steps), "maps")
    if not is_dataset(path):
        print(f"{path}: shard {own} is made")
        print(
            f"when the others are: benchnav-datagen merge {path} OTHER … --out OUT, or, where they are made in the"
        )
        print("same folder, nothing more: the last of them finishes it")
        return
    made = TerrainDataset(path)
    say_written(made)
    print_table(table(made))


def list_datasets(folder: str = "") -> None:
    """List the shipped recipes and the datasets at hand.

    Args:
        folder: Where to look for files; where ids are looked up when not given.
    """
    from benchnav.core.errors import DatasetError
    from benchnav.datagen.files.reader import FOLDER_MANIFEST, TerrainDataset, dataset_folders
    from benchnav.datagen.recipe.recipe import shipped_recipes, shipped_sizes

    print("recipes:")
    for name in shipped_recipes():
        sizes = ", ".join(f"{split} {maps}" for split, maps in shipped_sizes(name).items())
        print(f"  {name:12} {sizes}")
    if folder and not Path(folder).is_dir():
        raise DatasetError(f"Expected `folder` to be one, got {folder!r}.")
    for place in [Path(folder)] if folder else dataset_folders():
        files = sorted(
            [*place.glob("*.h5"), *(manifest.parent for manifest in place.glob(f"*/{FOLDER_MANIFEST}"))]
        )
        print(f"files in {place}:" if files else f"no files in {place}")
        for path in files:
            try:
                dataset = TerrainDataset(path)
            except DatasetError as error:
                print(f"  {path.name:20} not readable: {error}")
                continue
            sizes = ", ".join(f"{split} {entry['maps']}" for split, entry in dataset.splits.items())
            print(f"  {path.name:20} {dataset.id:12} {sizes}")


def show(file: str, json: bool = False) -> None:
    """Show what a dataset holds: splits, scenarios, sizes, class table, provenance, digests.

    Args:
        file: Path or id of a dataset.
        json: Print it as JSON.
    """
    from json import dumps

    from benchnav.core.tables import Table, print_table
    from benchnav.datagen.files.describe import describe, tables
    from benchnav.datagen.files.reader import TerrainDataset, find_dataset

    described = describe(TerrainDataset(find_dataset(file)))
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
    from benchnav.core.errors import DatasetError
    from benchnav.datagen.files.check import find_faults, summarise
    from benchnav.datagen.files.reader import TerrainDataset, find_dataset

    path = find_dataset(file)
    try:
        faults = find_faults(path)
    except DatasetError as error:
        print(f"{error}\n{path}: 1 fault")
        return 1
    for line in summarise(faults):
        print(line)
    dataset = TerrainDataset(path)
    if faults:
        print(f"{path}: {len(faults)} fault(s)\n{_remedy(dataset, faults)}")
        return 1
    splits = dataset.splits
    print(f"{path}: sound, {sum(entry['maps'] for entry in splits.values())} maps in {len(splits)} split(s)")
    return 0


def _remedy(dataset: "TerrainDataset", faults: "list[Fault]") -> str:
    """How damaged maps are made anew."""
    if not all("recipe" in part for entry in dataset.splits.values() for part in entry["parts"]):
        return "These maps were imported: import them again."
    files = sorted({fault.file for fault in faults if fault.file})
    if files:
        names = " ".join(files)
        return f"To make them anew, remove {names} in {dataset.path} and give the command again that made it."
    return "To make them anew, make the file again with --overwrite: the same recipe and version give the same digests."


def merge(files: list[str], out: str, id: str = "", overwrite: bool = False) -> None:
    """Combine datasets of the same grid and classes to one; splits of one name are joined.

    Args:
        files: Paths or ids of two or more datasets, or folders with the shards of one.
        out: File .h5 to write, or else a folder of many files.
        id: Id of the new dataset; the name of the file when not given. Shards keep that of their recipe.
        overwrite: Replace what is there.
    """
    from benchnav.core.command import show_progress
    from benchnav.core.store import output_path
    from benchnav.datagen.files.describe import say_written
    from benchnav.datagen.files.merge import merge as merge_datasets
    from benchnav.datagen.files.reader import TerrainDataset, find_dataset

    path = output_path(out)
    sources = [Path(file) if Path(file).is_dir() else find_dataset(file) for file in files]
    show_progress(merge_datasets(sources, path, id, overwrite), "maps")
    say_written(TerrainDataset(path))


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
        contact_sheet: Thumbnails of the split's maps instead; of a large one, of its first 100.
    """
    from benchnav.core.errors import ConfigError
    from benchnav.core.figures import save
    from benchnav.core.store import output_path, replacing
    from benchnav.datagen.files.reader import TerrainDataset, find_dataset
    from benchnav.datagen.preview import contact_sheet_figure, preview_figure

    dataset = TerrainDataset(find_dataset(file))
    split = split or ("test/std" if "test/std" in dataset.splits else next(iter(dataset.splits)))
    path = output_path(out or f"{'contact' if contact_sheet else 'preview'}-{split.replace('/', '-')}.png")
    if path.suffix not in (".png", ".pdf", ".svg", ".jpg"):
        raise ConfigError(f"Expected `out` to end in .png, .pdf, .svg or .jpg, got {str(path)!r}.")
    if maps is not None and contact_sheet:
        raise ConfigError("Expected either `maps` or `contact-sheet`, got both.")
    if maps is not None and not maps:
        raise ConfigError("Expected `maps` with at least one index, got none.")
    if contact_sheet:
        figure = contact_sheet_figure(dataset, split)
    else:
        some = range(min(3, dataset.map_count(split))) if maps is None else sorted(set(maps))
        figure = preview_figure(dataset, split, list(some))
    with replacing(path) as partial:
        save(figure, partial, path.suffix[1:])
    print(f"wrote {path}")


def _tell_kept(steps: Iterator[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Passes the steps of `create` on, and says first what a killed run has left of them."""
    done, total = next(steps)
    if done:
        print(f"{done} of {total} maps were there already", file=sys.stderr)
    yield done, total
    yield from steps


def main() -> None:
    """Entry point of `benchnav-datagen`."""
    commands = {
        "create": Command(create, ("recipe", "overrides")),
        "list": Command(list_datasets),
        "show": Command(show, ("file",)),
        "validate": Command(validate, ("file",)),
        "merge": Command(merge, ("files",)),
        "import-dem": Command(import_dem, ("dem", "overrides")),
        "export": Command(export, ("file",)),
        "preview": Command(preview, ("file",)),
    }
    description = "Make, list, show, check, combine, import, export and draw terrain datasets."
    status = run("benchnav-datagen", description, commands)
    if status == INTERRUPTED and sys.argv[1] == "create":
        print("benchnav-datagen: to go on, give the same command again", file=sys.stderr)
    sys.exit(status)
