"""Commands that import real data: `benchnav-datagen import-dem` and `import-drives`.

Slow modules are imported where they are used, so that the command's help is fast.
"""

import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from benchnav import datagen
from benchnav.core.errors import ConfigError, expect
from benchnav.core.progress import show_progress
from benchnav.datagen.dem.options import Cut, GroundOptions, Rasters

if TYPE_CHECKING:
    from benchnav.datagen.dem.recipe_fit import GroundError

# Thresholds that this package chooses without a source are marked "(choice)".
# Maximum fraction of rows in which a robot slides back (choice).
_MAX_BACKWARD = 0.1
# Maximum fraction of rows in which noise reverses positions (choice).
_MAX_REVERSES = 0.01
# Maximum resolution of positions that allows speeds over 2 s (choice).
_MAX_RESOLUTION_M = 0.2


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """Options of an import: output, recipe, and selection of maps.

    Args:
        out: Path of the .h5 file to write, or of a folder for many files.
        id: Id of the dataset. If empty, the name of the output.
        recipe: Id or path of the recipe with the maps' size, resolution, start, goal,
            class table and light.
        stride: Distance from one map to the next in metres. Below a map's width, maps
            of a split overlap. If not given, a map's width.
        solvable: Keep only maps whose goal can be reached, and store the grid reference
            time.
        overwrite: Replace an existing dataset.
    """

    out: str
    id: str = ""
    recipe: str = "paper-v1"
    stride: float | None = None
    solvable: bool = False
    overwrite: bool = False


def import_dem(
    rasters: Rasters,
    ground: GroundOptions,
    options: ImportOptions,
    dem: str,
    overrides: list[str],
    splits: str = "test/real",
    scenario: str = "std",
) -> None:
    """Create a dataset from a real elevation model; needs the extra benchnav[geo].

    Rasters may be all that GDAL opens: files, https:// and s3:// addresses, zip://
    archives, mosaics (.vrt).

    Args:
        rasters: Rasters other than the elevation model.
        ground: Options of the elevation model.
        options: Output, recipe, and selection of maps.
        dem: Raster of elevations, in any coordinate reference system.
        overrides: Changes to the recipe, such as resolution_m=1 goal_m=[50,50].
        splits: Splits and their fractions of the maps, such as
            train:0.7,valid:0.1,test/site:0.2. Maps of different splits do not touch.
        scenario: Scenario of the recipe, whose light the maps get.
    """
    dataset = _import(
        options, overrides, splits, ground, scenario, dem=dem, rasters=rasters
    )
    for split, entry in dataset.splits.items():
        source = entry["parts"][0]["source"]
        left_out = source["left_out"]
        between = left_out.pop("between_splits")
        reasons = []
        for reason, count in left_out.items():
            text = reason.replace("_", " ")
            reasons.append(f"{count} {text}")
        print(f"  left out of {split}: {', '.join(reasons)}")
        _tell_unlabelled(dataset, split)
        _tell_groups(dataset, split)
    if between:
        print(f"  left out between splits: {between}")


def import_drives(
    ground: GroundOptions,
    options: ImportOptions,
    drives: str,
    dem: str,
    overrides: list[str],
    photo: str = "",
    classes: str = "",
    class_ids: dict[int, str | None] | None = None,
    layer: tuple[str, ...] = (),
    least_speed: float = 0.1,
    speed: Literal["", "positions", "measured"] = "",
    splits: str = "train:0.6,valid:0.2,test/site:0.2",
) -> None:
    """Create a dataset of traversability measured on drives; needs benchnav[geo].

    Traversability of a cell is the mean ratio of measured to commanded speed. Rasters
    are as in import-dem.

    Args:
        ground: Options of the elevation model.
        options: Output, recipe, and selection of maps.
        drives: Path of the log, a .csv or .tsv file, one of these with .gz, or a
            .parquet file. Its columns are time_s, x_m and y_m (in the coordinate
            reference system of the elevation model) or longitude_deg and latitude_deg,
            commanded_m_s, measured_m_s and, for several drives, drive.
        dem: Raster of elevations, in any coordinate reference system.
        overrides: Changes to the recipe, such as resolution_m=1 goal_m=[50,50].
        photo: Raster of red, green and blue. If empty, cells have the colours of their
            classes.
        classes: Raster of terrain classes. If empty, all cells are unlabelled.
        class_ids: Class names by value of classes, such as '{1: gravel, 9: null}'; null
            for no label. If not given, values are class indices.
        layer: A layer as NAME=RASTER or NAME=RASTER:UNIT, such as
            vegetation_m=canopy.tif; several as a list.
        least_speed: Minimum commanded speed of used rows, forward or backward [m/s].
        speed: Source of the speed over ground: positions, or measured for the logged
            speed without a comparison with positions. If empty, measured speed, which
            must agree with positions.
        splits: Splits and their fractions of the maps. Maps of different splits do not
            touch, and each drive belongs to one split.
    """
    from benchnav.datagen.dem.drive_log import Drives
    from benchnav.datagen.dem.importer import REASONS

    expect(
        photo or classes,
        "`photo` or `classes` with `drives`, got neither. Without both, models have no "
        "input that shows where λ is low. Pass --photo RASTER.",
    )
    rasters = Rasters(
        photo=photo,
        classes=classes,
        class_ids=class_ids,
        layer=layer,
        unlabelled=not classes,
    )
    log = Drives(file=drives, least_speed=least_speed, speed=speed)
    dataset = _import(
        options, overrides, splits, ground, dem=dem, rasters=rasters, drives=log
    )
    sources = {
        split: entry["parts"][0]["source"] for split, entry in dataset.splits.items()
    }
    first_source = next(iter(sources.values()))
    entry = first_source["drives"]
    print(_summary(entry))
    for split, source in sources.items():
        n_rows = entry["used"][split]
        drive_names = _shown_drives(entry["drives"][split])
        print(f"  {split}: {n_rows} rows of {drive_names}")
        left_out = source["left_out"]
        reasons = []
        for reason, text in REASONS.items():
            count = left_out.get(reason)
            if count:
                reasons.append(f"{count} maps {text}")
        if reasons:
            print(f"  left out of {split}: {', '.join(reasons)}")
        if classes:
            _tell_unlabelled(dataset, split)
        _tell_groups(dataset, split)


def _summary(entry: Mapping[str, Any]) -> str:
    """Return a summary of the used and unused rows of a log, in sentences."""
    from benchnav.datagen.dem.drive_log import REASONS

    n_used = sum(entry["used"].values())
    lines = [f"{n_used} of {entry['rows']} rows of {entry['file']} were used"]
    for reason, count in entry["left_out"].items():
        if count:
            lines.append(f"{count} rows are left out: they {REASONS[reason]}")
    lines.append(_motion_text(entry))
    beyond = entry["beyond"]
    if any(beyond.values()):
        lines.append(
            f"{beyond['below_0']} rows have λ below 0 (sliding back, or noise) and "
            f"{beyond['above_1']} rows have λ above 1 (faster than the command); they "
            "are stored as 0 and 1"
        )
    n_fast = beyond["above_1.2"]
    if n_fast:
        lines.append(
            f"{n_fast} rows are faster than 1.2 times the command: if this occurs in "
            "steady driving on flat, firm terrain, calibrate `commanded_m_s`"
        )
    n_standing = entry["standing"]
    if n_standing:
        lines.append(
            f"{n_standing} rows have a position that stays the same under command, and "
            "no measured speed; the robot is regarded as immobilised there"
        )
    lines += _warnings(entry)
    return "\n  ".join(lines)


def _warnings(entry: Mapping[str, Any]) -> list[str]:
    """Return warnings of possible faults of a log's positions, in sentences."""
    from benchnav.datagen.dem.drive_velocity import MAX_PERIOD_S

    warnings = []
    by_positions = entry["speed"] == "positions"
    below = entry["beyond"]["below_0"]
    period_s = entry["period_s"] or 0
    n_used = sum(entry["used"].values())
    slides_often = below > _MAX_BACKWARD * n_used
    reverses_often = entry["reverses"] > _MAX_REVERSES * n_used
    if by_positions and slides_often:
        warnings.append(
            f"in more than {_MAX_BACKWARD:.0%} of rows, the robot slides back "
            "according to its positions, which is unlikely: a robot that turns in "
            "place under a command looks the same. Log a command of 0 there"
        )
    if by_positions and period_s > MAX_PERIOD_S:
        warnings.append(
            f"positions are logged every {period_s:g} s, too rarely to distinguish "
            "sliding back from turning, so that λ is above 0 where the robot slides "
            "back"
        )
    if not by_positions and reverses_often:
        warnings.append(
            f"positions reverse in {entry['reverses']} rows, but measured_m_s never "
            "does: where the robot did not turn round, it slid back, and measured_m_s "
            "must be negative"
        )
    resolution_m = entry["resolution_m"]
    if resolution_m > _MAX_RESOLUTION_M:
        warnings.append(
            f"positions are multiples of {resolution_m:g} m: log more decimals"
        )
    return warnings


def _motion_text(entry: Mapping[str, Any]) -> str:
    """Return a comparison of distances by positions and by both speeds, as text."""
    columns = {"pace": "measured_m_s", "commanded_pace": "commanded_m_s"}
    ratios = []
    for name, column in columns.items():
        ratio = entry[name]
        if ratio is not None:
            ratios.append(f"{ratio:g} times as far as {column} implies")
    compared = " and ".join(ratios) or "too little to be compared with speeds"
    sources = {
        "": "",
        "positions": "; speeds are computed from positions",
        "measured": "; speeds are used as logged",
    }
    source = sources[entry["speed"]]
    return f"positions move {compared}{source}"


def _shown_drives(names: Sequence[str]) -> str:
    """Return the number of drives and up to five of their names, as text."""
    shown = [*names[:5], "…"] if len(names) > 5 else names
    noun = "drive" if len(names) == 1 else "drives"
    return f"{len(names)} {noun} ({', '.join(shown)})"


def _import(
    options: ImportOptions,
    overrides: list[str],
    splits: str,
    ground: GroundOptions,
    scenario: str = "std",
    **settings: Any,
) -> "datagen.TerrainDataset":
    """Import maps, and return the dataset.

    Its id is the requested id, or the name of the output.
    """
    from benchnav.datagen.dem.importer import import_dem as import_maps
    from benchnav.datagen.dem.recipe_fit import GroundError
    from benchnav.datagen.dem.tiling import read_shares
    from benchnav.datagen.files.describe import written
    from benchnav.datagen.files.hdf5 import name_of

    path = Path(options.out)
    name = options.id or name_of(path)
    changes = []
    if overrides:
        # Splits of the recipe are replaced, so that only the used scenario must fit
        # the maps.
        splits_key = f"splits={{imported: {{scenario: {scenario}, maps: 1}}}}"
        changes = [f"id={name}", splits_key, *overrides]
    recipe = datagen.load_recipe(options.recipe, changes)
    if options.id or not overrides:
        recipe = replace(recipe, id=name)
    cut = Cut(
        shares=read_shares(splits),
        scenario=scenario,
        stride_m=options.stride,
        solvable=options.solvable,
        ground=ground,
    )
    steps = import_maps(
        out=path,
        recipe=recipe,
        cut=cut,
        overwrite=options.overwrite,
        announce=print,
        **settings,
    )
    try:
        show_progress(steps, "maps")
    except GroundError as error:
        raise _with_command(error, overrides) from error
    return written(path)


def _with_command(error: "GroundError", overrides: Sequence[str]) -> ConfigError:
    """Return an error that contains the user's command with settings that fit."""
    if not error.settings and error.stride_m is None:
        return ConfigError(f"{error.problem} Or use a larger raster.")
    unchanged = []
    for text in overrides:
        key, _, _ = text.partition("=")
        if key not in error.changes:
            unchanged.append(text)
    words = []
    remaining = [word for word in sys.argv[1:] if word not in overrides]
    while remaining:
        word = remaining.pop(0)
        if word == "--stride":
            remaining.pop(0)
        elif not word.startswith("--stride="):
            words.append(word)
    program = Path(sys.argv[0]).name
    command = [program, *words, *unchanged, *error.settings]
    if error.stride_m is not None:
        command += ["--stride", f"{error.stride_m:.10g}"]
    return ConfigError(error.advise(shlex.join(command)))


def _tell_unlabelled(dataset: "datagen.TerrainDataset", split: str) -> None:
    """Print the number of unlabelled cells of a split."""
    grid = dataset.grid
    counts: list[int] = []
    for part in dataset.splits[split]["parts"]:
        counts += part["source"]["unlabelled"]
    if any(counts):
        n_unlabelled = sum(counts)
        n_cells = len(counts) * grid.height * grid.width
        n_maps = sum(count > 0 for count in counts)
        print(
            f"  unlabelled in {split}: {n_unlabelled} of {n_cells} cells, on {n_maps} "
            f"of {len(counts)} maps"
        )


def _tell_groups(dataset: "datagen.TerrainDataset", split: str) -> None:
    """Print the number of statistical units of a split if its maps overlap."""
    if "group" in dataset.fields:
        groups = dataset.read(split, fields=["group"])["group"]
        n_groups = len(set(groups.tolist()))
        print(
            f"  {dataset.map_count(split)} maps of {split} overlap and form {n_groups} "
            "group(s), the statistical unit. Leave --stride out of test splits, so "
            "that their maps do not overlap"
        )
