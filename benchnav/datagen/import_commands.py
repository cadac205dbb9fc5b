"""The commands that import real ground: `benchnav-datagen import-dem` and
`import-drives`.

What is heavy is imported where it is called, so that the command's help is quick.
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
from benchnav.datagen.dem.raster import Cut, GroundOptions, Rasters

if TYPE_CHECKING:
    from benchnav.datagen.dem.extent import GroundError

_MOST_BACK = 0.1  # of the rows (choice)
_FEW_REVERSES = 0.01  # of the rows, which noise may show (choice)
_COARSE_M = 0.2  # resolution that is too coarse for speeds of 2 s (choice)


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """What real ground is made into.

    Args:
        out: File .h5 to write, or a folder for many files.
        id: Id of the dataset; the name of the output when not given.
        recipe: Id or path of a recipe that gives size, resolution, start, goal, class
            table and light.
        stride: Metres from one map to the next; a map's width when not given. Less
            makes maps of a split overlap.
        solvable: Keep only maps whose goal can be reached, and store the grid reference
            time.
        overwrite: Replace what is there.
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
    """Make a dataset from a real elevation model; needs the extra benchnav[geo].

    Rasters may be anything that GDAL opens: files, https:// and s3:// addresses, zip://
    archives, mosaics (.vrt).

    Args:
        rasters: What there is of the ground beside its elevation.
        ground: How the elevation model is read and cut.
        options: What is made of it.
        dem: Raster of elevations, in any coordinate reference system.
        overrides: Changes to the recipe, such as resolution_m=1 goal_m=[50,50].
        splits: Splits and their shares of the maps, such as
            train:0.7,valid:0.1,test/site:0.2; no two of them touch.
        scenario: Which of the recipe's scenarios lights the maps.
    """
    dataset = _import(
        options, overrides, splits, ground, scenario, dem=dem, rasters=rasters
    )
    for split, entry in dataset.splits.items():
        left_out = entry["parts"][0]["source"]["left_out"]
        between = left_out.pop("between_splits")
        reasons = ", ".join(
            f"{count} {reason.replace('_', ' ')}" for reason, count in left_out.items()
        )
        print(f"  left out of {split}: {reasons}")
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
    """Make a dataset of measured traversability from a robot's drives; needs the extra
    benchnav[geo].

    Traversability is measured over commanded speed, of each cell the mean. Rasters are
    as for import-dem.

    Args:
        ground: How the elevation model is read and cut.
        options: What is made of them.
        drives: Log, a file .csv, .tsv, one of these with .gz, or .parquet, with the
            columns time_s, x_m and y_m (in the coordinate reference system of the
            elevation model) or longitude_deg and latitude_deg, commanded_m_s,
            measured_m_s and, of several drives, drive.
        dem: Raster of elevations, in any coordinate reference system.
        overrides: Changes to the recipe, such as resolution_m=1 goal_m=[50,50].
        photo: Raster of red, green and blue; painted by the class when not given.
        classes: Raster of terrain classes; no cell has one when not given.
        class_ids: Class names by value of that raster, such as '{1: gravel, 9: null}',
            null for no label; else indices.
        layer: Optional fields as [NAME=RASTER, NAME=RASTER:UNIT], such as
            [vegetation_m=canopy.tif].
        least_speed: Least commanded speed, forward or backward, of rows that are used,
            m/s.
        speed: Source of the speed over ground: positions, or measured as logged,
            whatever positions say. If empty, measured speed that agrees with positions.
        splits: Splits and their shares of the maps; no two of them touch, and each
            drive belongs to one.
    """
    from benchnav.datagen.dem.drive_log import Drives
    from benchnav.datagen.dem.importer import REASONS

    expect(
        photo or classes,
        "`photo` or `classes` with `drives`, got neither, so that no input shows "
        "where λ is low. Pass --photo RASTER.",
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
    about = next(iter(sources.values()))["drives"]
    print(_sum_up(about))
    for split, source in sources.items():
        print(
            f"  {split}: {about['used'][split]} rows of {_few(about['drives'][split])}"
        )
        counts = source["left_out"]
        reasons = [
            f"{counts[reason]} maps {why}"
            for reason, why in REASONS.items()
            if counts.get(reason)
        ]
        if reasons:
            print(f"  left out of {split}: {', '.join(reasons)}")
        if classes:
            _tell_unlabelled(dataset, split)
        _tell_groups(dataset, split)


def _sum_up(about: Mapping[str, Any]) -> str:
    """What was used of a log and what was not, in sentences."""
    from benchnav.datagen.dem.drive_log import REASONS

    lines = [
        f"{sum(about['used'].values())} of {about['rows']} rows of {about['file']} "
        "were used"
    ]
    lines += [
        f"{count} rows are left out: they {REASONS[reason]}"
        for reason, count in about["left_out"].items()
        if count
    ]
    lines.append(_say_motion(about))
    beyond = about["beyond"]
    if any(beyond.values()):
        lines.append(
            f"{beyond['below_0']} rows have λ below 0 (sliding back, or noise) and "
            f"{beyond['above_1']} above 1 (faster "
            "than the command); they are stored as 0 and 1"
        )
    if over := beyond["above_1.2"]:
        lines.append(
            f"{over} rows exceed 1.2 times the command: if steady driving on flat, "
            "firm terrain does, scale "
            "`commanded_m_s`"
        )
    if about["standing"]:
        lines.append(
            f"{about['standing']} rows have a position that stays the same under "
            "command, and no measured speed; the "
            "robot counts as immobilised there"
        )
    return "\n  ".join([*lines, *_doubts(about)])


def _doubts(about: Mapping[str, Any]) -> list[str]:
    """Say what of a log's positions may be wrong, in sentences."""
    from benchnav.datagen.dem.drive_tracks import MAX_PERIOD_S

    doubts, by_positions = [], about["speed"] == "positions"
    below, period_s = about["beyond"]["below_0"], about["period_s"] or 0
    if by_positions and below > _MOST_BACK * sum(about["used"].values()):
        doubts.append(
            f"more than {_MOST_BACK:.0%} of rows slide back by their positions, which "
            "looks wrong: a robot that "
            "turned on the spot under its command looks the same. Log a command of 0 "
            "there"
        )
    if by_positions and period_s > MAX_PERIOD_S:
        doubts.append(
            f"positions come every {period_s:g} s, too seldom to distinguish sliding "
            "back from turning, so that "
            "rows that slide back have λ above 0"
        )
    if not by_positions and about["reverses"] > _FEW_REVERSES * sum(
        about["used"].values()
    ):
        doubts.append(
            f"positions reverse in {about['reverses']} rows, measured_m_s never does: "
            "where the robot did not turn "
            "round, it slid back, and speed has to be negative"
        )
    if about["resolution_m"] > _COARSE_M:
        doubts.append(
            f"positions are multiples of {about['resolution_m']:g} m: log more decimals"
        )
    return doubts


def _say_motion(about: Mapping[str, Any]) -> str:
    """Compare positions with both speeds, in a sentence."""
    ratios = (
        f"{about[name]:g} times as far as {column} says"
        for name, column in (
            ("pace", "measured_m_s"),
            ("commanded_pace", "commanded_m_s"),
        )
        if about[name] is not None
    )
    compared = " and ".join(ratios) or "too little to be compared with speeds"
    source = {
        "": "",
        "positions": "; speeds are those of positions",
        "measured": "; speeds are as logged",
    }
    return f"positions move {compared}{source[about['speed']]}"


def _few(names: Sequence[str]) -> str:
    some = ", ".join(names[:5]) + (", …" if len(names) > 5 else "")
    return f"{len(names)} drive{'s' * (len(names) > 1)} ({some})"


def _import(
    options: ImportOptions,
    overrides: list[str],
    splits: str,
    ground: GroundOptions,
    scenario: str = "std",
    **settings: Any,
) -> "datagen.TerrainDataset":
    """Imports under the id that is asked for, or that the output names."""
    from benchnav.datagen.dem.extent import GroundError
    from benchnav.datagen.dem.importer import import_dem as import_maps
    from benchnav.datagen.dem.tiling import read_shares
    from benchnav.datagen.files.describe import written
    from benchnav.datagen.files.hdf5 import name_of

    path = Path(options.out)
    name = options.id or name_of(path)
    # so that others need not fit the maps
    used = f"splits={{imported: {{scenario: {scenario}, maps: 1}}}}"
    chosen = datagen.load_recipe(
        options.recipe, [f"id={name}", used, *overrides] if overrides else []
    )
    if options.id or not overrides:
        chosen = replace(chosen, id=name)
    cut = Cut(
        shares=read_shares(splits),
        scenario=scenario,
        stride_m=options.stride,
        solvable=options.solvable,
        ground=ground,
    )
    steps = import_maps(
        out=path,
        recipe=chosen,
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
    """Return an error whose message ends in the user's command with settings that fit
    the ground.
    """
    if not error.settings and error.stride_m is None:
        return ConfigError(f"{error.problem} Or take a larger raster.")
    unchanged = [
        text for text in overrides if text.partition("=")[0] not in error.changes
    ]
    words, remaining = [], [word for word in sys.argv[1:] if word not in overrides]
    while remaining:
        word = remaining.pop(0)
        if word == "--stride":
            remaining.pop(0)
        elif not word.startswith("--stride="):
            words.append(word)
    stride = [] if error.stride_m is None else ["--stride", f"{error.stride_m:.10g}"]
    command = shlex.join(
        [Path(sys.argv[0]).name, *words, *unchanged, *error.settings, *stride]
    )
    return ConfigError(error.advise(command))


def _tell_unlabelled(dataset: "datagen.TerrainDataset", split: str) -> None:
    """Print how many cells of maps have no class."""
    entry, grid = dataset.splits[split], dataset.grid
    counts = [
        count for part in entry["parts"] for count in part["source"]["unlabelled"]
    ]
    if any(counts):
        maps = sum(count > 0 for count in counts)
        cells = len(counts) * grid.height * grid.width
        print(
            f"  unlabelled in {split}: {sum(counts)} of {cells} cells, on {maps} of "
            f"{len(counts)} maps"
        )


def _tell_groups(dataset: "datagen.TerrainDataset", split: str) -> None:
    """Says how many units of statistics there are where maps overlap."""
    if "group" in dataset.fields:
        groups = len(set(dataset.read(split, fields=["group"])["group"].tolist()))
        print(
            f"  {dataset.map_count(split)} maps of {split} overlap and form {groups} "
            "group(s), the statistical unit. "
            "Leave --stride out of test splits, so that their maps do not overlap"
        )
