"""The command `import-dem`: a dataset of real ground.

This module imports nothing heavy, so that the command's help is quick.
"""


def import_dem(
    dem: str,
    overrides: list[str],
    out: str,
    id: str = "",
    recipe: str = "paper-v1",
    splits: str = "test/real",
    stride: float | None = None,
    scenario: str = "std",
    classes: str = "",
    class_ids: dict[int, str | None] | None = None,
    random_classes: bool = False,
    photo: str = "",
    traversability: str = "",
    solvable: bool = False,
    overwrite: bool = False,
) -> None:
    """Make a dataset from a real elevation model; needs the extra benchnav[geo].

    Rasters may be anything that GDAL opens: files, https:// and s3:// addresses, zip:// archives, mosaics (.vrt).

    Args:
        dem: Raster of elevations in metres, in any coordinate reference system.
        overrides: Changes to the recipe, such as resolution_m=1 goal_m=[50,50].
        out: File .h5 to write, or else a folder of many files.
        id: Id of the dataset; the name of the output when not given.
        recipe: Id or path of a recipe that gives size, resolution, start, goal, class table and light.
        splits: Splits and their shares of the maps, such as train:0.7,valid:0.1,test/site:0.2; no two of them touch.
        stride: Metres from one map to the next; a map's width when not given. Less makes maps of a split overlap.
        scenario: Which of the recipe's scenarios lights the maps.
        classes: Raster of terrain classes; laid out at random when not given.
        class_ids: Class names by value of that raster, such as '{1: gravel, 9: null}', null for no label; else indices.
        random_classes: Allow a photo or measured traversability without classes: these are laid out at random.
        photo: Raster of red, green and blue; painted by the class when not given.
        traversability: Raster of measured traversability in [0, 1]; drawn by the class table when not given.
        solvable: Keep only maps whose goal can be reached, and store the grid reference time.
        overwrite: Replace what is there.
    """
    from benchnav.core.command import show_progress
    from benchnav.core.store import output_path
    from benchnav.datagen.dem.importer import import_dem as import_maps
    from benchnav.datagen.dem.survey import Rasters
    from benchnav.datagen.dem.tiling import read_shares
    from benchnav.datagen.files.describe import say_written
    from benchnav.datagen.files.hdf5 import is_one_file
    from benchnav.datagen.files.reader import TerrainDataset
    from benchnav.datagen.recipe.recipe import load_recipe

    path = output_path(out)
    rasters = Rasters(
        dem=dem,
        classes=classes,
        class_ids=class_ids,
        random_classes=random_classes,
        photo=photo,
        traversability=traversability,
    )
    name = id or (path.stem if is_one_file(path) else path.name)
    chosen = load_recipe(recipe, [f"id={name}", *overrides] if overrides else [])
    steps = import_maps(
        rasters,
        path,
        chosen,
        dataset_id=chosen.id if overrides and not id else name,
        shares=read_shares(splits),
        scenario=scenario,
        stride_m=stride,
        solvable=solvable,
        overwrite=overwrite,
    )
    show_progress(steps, "maps")
    made = TerrainDataset(path)
    say_written(made)
    for split, entry in made.splits.items():
        left_out = entry["parts"][0]["source"]["left_out"]
        between = left_out.pop("between_splits")
        reasons = ", ".join(f"{count} {reason.replace('_', ' ')}" for reason, count in left_out.items())
        print(f"  left out of {split}: {reasons}")
        if "group" in made.fields:
            groups = len(set(made.read(split, fields=["group"])["group"].tolist()))
            print(
                f"  {entry['maps']} maps of {split} overlap and are {groups} group(s), the unit of statistics: for "
                "a test split leave --stride out, so that maps lie side by side"
            )
    if between:
        print(f"  left out between splits: {between}")
