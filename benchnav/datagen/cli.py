"""The command `benchnav-datagen`: make, list, show, check and draw datasets."""

import sys
from dataclasses import replace
from pathlib import Path

from benchnav.command import Command, run


def create(
    recipe: str,
    out: str = "",
    jobs: int = 1,
    seed: int | None = None,
    splits: list[str] | None = None,
    overwrite: bool = False,
) -> None:
    """Make a dataset from a recipe.

    Args:
        recipe: Id of a shipped recipe, such as paper-v1, or path of a YAML file.
        out: File to write; datasets/ID.h5 when not given.
        jobs: Worker processes. The result is the same for any number.
        seed: Root seed in place of the recipe's; makes other maps of the same classes.
        splits: Only these splits, for example [test/std,test/hg].
        overwrite: Replace a file that is there.
    """
    from benchnav.command import show_progress
    from benchnav.datagen.scenario import load_recipe
    from benchnav.datagen.store import TerrainDataset
    from benchnav.datagen.store import create as create_dataset
    from benchnav.errors import ConfigError

    if jobs < 1:
        raise ConfigError(f"Expected `jobs` ≥ 1, got {jobs}.")
    chosen = load_recipe(recipe)
    if seed is not None:
        chosen = replace(chosen, seed=seed)
    if splits is not None:
        unknown = [name for name in splits if name not in chosen.splits]
        if unknown:
            raise ConfigError(f"Expected `splits` among {sorted(chosen.splits)}, got {unknown}.")
        chosen = replace(
            chosen, splits={name: chosen.splits[name] for name in chosen.splits if name in splits}
        )
    path = Path(out or f"datasets/{chosen.id}.h5")
    show_progress(create_dataset(chosen, path, jobs=jobs, overwrite=overwrite), "maps")
    print(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)")
    for name, split in TerrainDataset(path).splits.items():
        print(f"  {name:10} {split['maps']:6} maps  {split['digest']}")


def list_datasets(folder: str = "datasets") -> None:
    """List the shipped recipes and the datasets in a folder.

    Args:
        folder: Where to look for files.
    """
    from benchnav.datagen.scenario import load_recipe, shipped_recipes
    from benchnav.datagen.store import TerrainDataset

    print("recipes:")
    for name in shipped_recipes():
        sizes = ", ".join(f"{split} {spec.maps}" for split, spec in load_recipe(name).splits.items())
        print(f"  {name:12} {sizes}")
    print(f"files in {folder}:")
    for path in sorted(Path(folder).glob("*.h5")):
        dataset = TerrainDataset(path)
        sizes = ", ".join(f"{split} {entry['maps']}" for split, entry in dataset.splits.items())
        print(f"  {path.name:20} {dataset.id:12} {sizes}")


def show(file: str) -> None:
    """Show what a dataset holds: splits, scenarios, class table, provenance, digests.

    Args:
        file: Path or id of a dataset.
    """
    from rich.console import Console
    from rich.table import Table

    from benchnav.datagen.store import TerrainDataset, find_dataset

    dataset = TerrainDataset(find_dataset(file))
    recipe, console = dataset.recipe, Console()
    print(f"{dataset.path}: {dataset.id}, seed {recipe.seed}, format {dataset.manifest['format_version']}")
    print(
        f"made by {dataset.manifest['generator']['package']} {dataset.manifest['generator']['version']}; "
        f"maps of {recipe.height}×{recipe.width} cells of {recipe.resolution_m} m; "
        f"start {recipe.start_m}, goal {recipe.goal_m}; {recipe.environments} environments"
    )
    table = Table("split", "scenario", "maps", "digest", title="splits")
    for name, split in dataset.splits.items():
        table.add_row(name, split["scenario"], str(split["maps"]), split["digest"])
    console.print(table)
    table = Table("id", "class", "colour", "a", "b", "o", "σ", title="classes: f(ψ) = 1 − (a·10⁻³·ψ^b + o)")
    for number, item in enumerate(recipe.classes):
        table.add_row(
            str(number), item.name, str(tuple(item.colour)), f"{item.scale:g}", f"{item.exponent:g}",
            f"{item.offset:g}", f"{item.noise:g}",
        )  # fmt: skip
    console.print(table)


def validate(file: str) -> int:
    """Check a dataset whole; exit status 1 when something is wrong.

    Args:
        file: Path or id of a dataset.
    """
    from benchnav.datagen.store import find_dataset
    from benchnav.datagen.validate import find_faults

    path = find_dataset(file)
    faults = find_faults(path)
    for fault in faults:
        print(fault)
    print(f"{path}: {len(faults)} fault(s)" if faults else f"{path}: sound")
    return 1 if faults else 0


def preview(file: str, split: str = "test/std", maps: list[int] | None = None, out: str = "") -> None:
    """Draw maps of a dataset to a picture.

    Args:
        file: Path or id of a dataset.
        split: Which split.
        maps: Which maps; [0, 1, 2] when not given.
        out: Picture to write; preview-SPLIT.png when not given.
    """
    from benchnav.datagen.preview import save_preview
    from benchnav.datagen.store import TerrainDataset, find_dataset
    from benchnav.errors import ConfigError
    from benchnav.files import replacing

    path = Path(out or f"preview-{split.replace('/', '-')}.png")
    if path.suffix not in (".png", ".pdf", ".svg", ".jpg"):
        raise ConfigError(f"Expected `out` to end in .png, .pdf, .svg or .jpg, got {str(path)!r}.")
    if maps == []:
        raise ConfigError("Expected `maps` with at least one index, got none.")
    dataset = TerrainDataset(find_dataset(file))
    with replacing(path) as partial:
        save_preview(
            dataset, split, sorted(set(maps if maps is not None else [0, 1, 2])), partial, path.suffix[1:]
        )
    print(f"wrote {path}")


def main() -> None:
    """Entry point of `benchnav-datagen`."""
    commands = {
        "create": Command(create, ("recipe",)),
        "list": Command(list_datasets),
        "show": Command(show, ("file",)),
        "validate": Command(validate, ("file",)),
        "preview": Command(preview, ("file",)),
    }
    sys.exit(run("benchnav-datagen", "Make, list, show, check and draw terrain datasets.", commands))
