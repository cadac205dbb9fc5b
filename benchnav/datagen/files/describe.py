"""What a dataset holds, as plain data and as tables."""

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from rich.filesize import decimal

from benchnav.core.tables import Table
from benchnav.datagen import schema
from benchnav.datagen.files.reader import READ_ERRORS, TerrainDataset, damage, open_file

_DIGESTS = {
    "digest": "content digests",
    "recorded_digest": "digests that models record: of content, class table, λ_stuck, resolution and kind of truth",
}


def describe(dataset: TerrainDataset) -> dict[str, Any]:
    """Gathers what `show` shows, ready for JSON."""
    manifest, recipe = dataset.manifest, dataset.recipe
    stored = {split: _stored_bytes(dataset, split) for split in dataset.splits}
    files = {piece.path for split in dataset.splits for piece in dataset.pieces(split)}
    return {
        "path": str(dataset.path),
        "bytes": sum(path.stat().st_size for path in files),
        "files": len(files),
        "id": dataset.id,
        "format_version": manifest["format_version"],
        "generator": manifest["generator"],
        "grid": asdict(dataset.grid),
        "environments": recipe.environments,
        "stuck_threshold": recipe.stuck_threshold,
        "synthesis": recipe.synthesis,
        "places": None if recipe.places is None else asdict(recipe.places),
        "correlation_m": recipe.correlation_m,
        "splits": {
            name: {
                **entry,
                "stored_bytes": stored[name],
                "truth": dataset.truth_of(name),
                "recorded_digest": dataset.split_digest(name),
            }
            for name, entry in dataset.splits.items()
        },
        "classes": [asdict(item) for item in recipe.classes],
        "fields": manifest["fields"],
        "recipes": manifest["recipes"],
    }


def _stored_bytes(dataset: TerrainDataset, split: str) -> int:
    total, name = 0, ""
    for piece in dataset.pieces(split):
        with open_file(piece.path) as file:
            try:
                for name in dataset.field_names:
                    total += file[split][name].id.get_storage_size()
            except READ_ERRORS as error:
                raise damage(piece.path, split, name, error) from error
    return total


def tables(described: dict[str, Any]) -> Iterator[Table | str]:
    """Lays out what `describe` gathered, for a terminal."""
    grid, generator = described["grid"], described["generator"]
    files = f" in {described['files']} files" if described["files"] > 1 else ""
    yield (
        f"{described['path']}: {described['id']}, format {described['format_version']}, "
        f"{described['bytes'] / 1e6:.1f} MB{files}, written by {generator['package']} {generator['version']}"
    )
    yield (
        f"maps of {grid['height']} × {grid['width']} cells of {grid['resolution_m']:g} m, "
        f"{described['environments']} environments, λ_stuck {described['stuck_threshold']:g}"
    )
    yield _making(described)
    yield Table(
        title="splits",
        headings=("split", "scenario", "maps", "MB", "truth of λ", "made from"),
        rows=tuple(
            (
                name,
                entry["scenario"],
                str(entry["maps"]),
                f"{entry['stored_bytes'] / 1e6:.1f}",
                entry["truth"],
                ", ".join(_origin(described, part) for part in entry["parts"]),
            )
            for name, entry in described["splits"].items()
        ),
    )
    extra = [name for name in described["fields"] if name not in schema.FIELDS]
    if extra:
        yield f"fields beside those of every dataset: {', '.join(extra)}"
    for key, title in _DIGESTS.items():
        yield title
        yield from (f"  {name:12} {entry[key]}" for name, entry in described["splits"].items())
    soft = any(item["soft"] for item in described["classes"])
    rows = []
    for number, item in enumerate(described["classes"]):
        colour = "#" + "".join(f"{value:02x}" for value in item["colour"])
        numbers = [f"{item[key]:g}" for key in ("scale", "exponent", "offset", "noise")]
        rows.append((str(number), item["name"], colour, *numbers, *[_soft_spots(item["soft"])] * soft))
    yield Table(
        title="classes: f(ψ) = 1 − (a·10⁻³·ψ^b + o)",
        headings=("id", "class", "colour", "a", "b", "o", "σ", *["soft spots"] * soft),
        rows=tuple(rows),
    )


def _making(described: dict[str, Any]) -> str:
    """One line on how the maps were made."""
    words, places = [f"synthesis {described['synthesis']}"], described["places"]
    if places:
        words.append(
            f"start and goal drawn a map, at least {places['least_distance_m']:g} m apart and "
            f"{places['margin_m']:g} m from the edges"
        )
    if described["correlation_m"]:
        words.append(f"λ correlated over {described['correlation_m']:g} m")
    return ", ".join(words)


def _soft_spots(spots: dict[str, float] | None) -> str:
    return f"{spots['weight']:.0%} N({spots['mean']:g}, {spots['std']:g})" if spots else ""


def _origin(described: dict[str, Any], part: dict[str, Any]) -> str:
    if "recipe" not in part:
        return f"{part['maps']} of {part['source']['file']}"
    recipe = described["recipes"][part["recipe"]]
    return f"{part['maps']} of {recipe['id']} {part['split']}, seed {recipe['seed']}"


def say_written(dataset: TerrainDataset) -> None:
    """Prints where a new dataset is, its size, its splits and their digests."""
    files = {piece.path for split in dataset.splits for piece in dataset.pieces(split)}
    size = decimal(sum(path.stat().st_size for path in files))
    print(f"wrote {dataset.path} ({size}{f' in {len(files)} files' if len(files) > 1 else ''})")
    for name, split in dataset.splits.items():
        print(f"  {name:12} {split['maps']:6} maps  {split['digest']}")
