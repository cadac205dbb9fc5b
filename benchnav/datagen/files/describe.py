"""Description of a dataset: as plain data, as tables, and as lines after writing."""

from collections.abc import Iterable, Iterator
from dataclasses import asdict
from itertools import compress
from pathlib import Path

from benchnav.core.settings import plain
from benchnav.core.tables import Table
from benchnav.datagen import schema
from benchnav.datagen.files.manifest import READ_ERRORS, damage_error, open_file
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.layers.spec import LayerSpec
from benchnav.datagen.recipe.classes import ClassTable

_DIGESTS = {
    "digest": "content digests",
    "recorded_digest": "digests that models record (content, class table, λ_stuck, "
    "resolution, kind of truth)",
}


def describe(dataset: TerrainDataset) -> schema.Json:
    """Return what the command `show` prints about a dataset, as data for JSON."""
    manifest = dataset.manifest
    recipe = dataset.recipe
    settings = plain(recipe)
    stored = recipe.to_dict()
    names = ("environments", "stuck_threshold", "synthesis", "places", "correlation_m")
    shown = {name: settings[name] for name in names}
    if "vegetation_period_m" in stored:
        shown["vegetation_period_m"] = stored["vegetation_period_m"]
    layers = [_describe_layer(spec, recipe.classes) for spec in recipe.layers]
    splits = {
        name: {
            **entry,
            "stored_bytes": _stored_bytes(dataset, name),
            "truth": dataset.truth_of(name),
            "recorded_digest": dataset.split_digest(name),
        }
        for name, entry in dataset.splits.items()
    }
    return {
        "path": str(dataset.path),
        "bytes": sum(path.stat().st_size for path in dataset.files),
        "files": len(dataset.files),
        "id": dataset.id,
        "format_version": manifest["format_version"],
        "generator": manifest["generator"],
        "grid": asdict(dataset.grid),
        **shown,
        "classes": recipe.class_rows,
        "drawn_layers": layers,
        "splits": splits,
        "fields": manifest["fields"],
        "recipes": manifest["recipes"],
    }


def _stored_bytes(dataset: TerrainDataset, split: str) -> int:
    total = 0
    name = ""
    for piece in dataset.pieces[split]:
        with open_file(piece.path) as file:
            try:
                for name in dataset.field_names:
                    total += file[split][name].id.get_storage_size()
            except READ_ERRORS as error:
                raise damage_error(piece.path, split, name, error) from error
    return total


def tables(described: schema.Json) -> Iterator[Table | str]:
    """Yield lines and tables for a terminal.

    Args:
        described: data from `describe`.
    """
    grid = described["grid"]
    generator = described["generator"]
    files = f" in {described['files']} files" if described["files"] > 1 else ""
    yield (
        f"{described['path']}: {described['id']}, format "
        f"{described['format_version']}, {described['bytes'] / 1e6:.1f} MB{files}, "
        f"written by {generator['package']} {generator['version']}"
    )
    yield (
        f"maps of {grid['height']} × {grid['width']} cells of "
        f"{grid['resolution_m']:g} m, {described['environments']} environments, "
        f"λ_stuck {described['stuck_threshold']:g}"
    )
    generation = f"synthesis {described['synthesis']}"
    if places := described["places"]:
        generation += (
            ", start and goal drawn for each map, at least "
            f"{places['least_distance_m']:g} m apart and {places['margin_m']:g} m from "
            "the edges"
        )
    for layer in described["drawn_layers"]:
        generation += f", {layer['words']}"
    if described["correlation_m"]:
        generation += f", λ correlated over {described['correlation_m']:g} m"
    yield generation
    split_rows = []
    for name, entry in described["splits"].items():
        size = f"{entry['stored_bytes'] / 1e6:.1f}"
        origins = ", ".join(_origin(described, part) for part in entry["parts"])
        maps = str(entry["maps"])
        split_rows.append(
            (name, entry["scenario"], maps, size, entry["truth"], origins)
        )
    yield Table(
        title="splits",
        headings=("split", "scenario", "maps", "MB", "truth of λ", "made from"),
        rows=tuple(split_rows),
    )
    fields = schema.read_field_table(described["fields"])
    layers = schema.layer_names(fields)
    if layers:
        sources = {
            layer["name"]: layer["source"] for layer in described["drawn_layers"]
        }
        layer_rows = []
        for name in layers:
            field = fields[name]
            row = (name, field.unit, field.meaning, sources.get(name, ""))
            layer_rows.append(row)
        yield Table(
            title="layers",
            headings=("layer", "unit", "meaning", "drawn by"),
            rows=tuple(layer_rows),
        )
    extra = [name for name in fields if name not in (*schema.FIELDS, *layers)]
    if extra:
        yield f"optional fields: {', '.join(extra)}"
    name_width = widest(described["splits"])
    for key, title in _DIGESTS.items():
        yield title
        for name, entry in described["splits"].items():
            yield f"  {name:{name_width}} {entry[key]}"
    columns = {layer["name"]: layer["classes"] for layer in described["drawn_layers"]}
    headings = ["id", "class", "colour", "a", "b", "o", "σ", "soft spots", *columns]
    rows = []
    for class_id, item in enumerate(described["classes"]):
        colour = f"#{bytes(item['colour']).hex()}"
        numbers = [f"{item[key]:g}" for key in ("scale", "exponent", "offset", "noise")]
        soft = ""
        if item["soft"]:
            soft = "{weight:.0%} N({mean:g}, {std:g})".format(**item["soft"])
        layer_cells = (texts[item["name"]] for texts in columns.values())
        rows.append((str(class_id), item["name"], colour, *numbers, soft, *layer_cells))
    # Empty columns are omitted.
    filled = [any(column) for column in zip(*rows, strict=True)]
    yield Table(
        title="classes: f(ψ) = 1 − (a·10⁻³·ψ^b + o)",
        headings=tuple(compress(headings, filled)),
        rows=tuple(tuple(compress(row, filled)) for row in rows),
    )


def _describe_layer(spec: LayerSpec, classes: ClassTable) -> schema.Json:
    """Return the description of a layer.

    If the layer's code is not available, its texts on classes are empty.
    """
    layer = spec.available
    texts = {item.name: "" for item in classes}
    if layer:
        texts = {name: layer.describe_class(name) for name in texts}
    source = "benchnav"
    if spec.source:
        source = f"{spec.source}, digest {spec.digest[:12]}"
    return {
        "name": spec.name,
        "words": spec.words,
        "source": source,
        "classes": texts,
    }


def _origin(described: schema.Json, part: schema.Json) -> str:
    """Describe a part of a split: its number of maps, and their source."""
    if "recipe" not in part:
        return f"{part['maps']} of {part['source']['file']}"
    recipe = described["recipes"][part["recipe"]]
    return f"{part['maps']} of {recipe['id']} {part['split']}, seed {recipe['seed']}"


def widest(names: Iterable[str]) -> int:
    """Return the length of the longest name in characters, at least 12."""
    return max([12, *map(len, names)])


def written(path: Path) -> TerrainDataset:
    """Print path, size, splits and digests of a new dataset, and return the dataset."""
    from rich.filesize import decimal

    dataset = TerrainDataset(path)
    size = decimal(sum(file.stat().st_size for file in dataset.files))
    n_files = len(dataset.files)
    files = f" in {n_files} files" if n_files > 1 else ""
    print(f"wrote {path} ({size}{files})")
    name_width = widest(dataset.splits)
    for name, split in dataset.splits.items():
        print(f"  {name:{name_width}} {split['maps']:6} maps  {split['digest']}")
    return dataset
