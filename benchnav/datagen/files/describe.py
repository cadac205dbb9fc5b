"""What a dataset holds, as plain data, as tables and, of a new one, as lines."""

from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path

from benchnav.core.settings import plain
from benchnav.core.tables import Table
from benchnav.datagen import schema
from benchnav.datagen.files.manifest import READ_ERRORS, open_file
from benchnav.datagen.files.reader import TerrainDataset, damage
from benchnav.datagen.layers.spec import LayerSpec
from benchnav.datagen.recipe.classes import ClassTable

_DIGESTS = {
    "digest": "content digests",
    "recorded_digest": "digests that models record (content, class table, λ_stuck, "
    "resolution, kind of truth)",
}


def describe(dataset: TerrainDataset) -> schema.Json:
    """Gathers what `show` shows, ready for JSON."""
    manifest, recipe = dataset.manifest, dataset.recipe
    about, stored = plain(recipe) | {"classes": recipe.class_rows}, recipe.to_dict()
    made_by = (
        "environments",
        "stuck_threshold",
        "synthesis",
        "places",
        "correlation_m",
    )
    of_vegetation = {
        name: stored[name] for name in ("vegetation_period_m",) if name in stored
    }
    return {
        "path": str(dataset.path),
        "bytes": sum(path.stat().st_size for path in dataset.files),
        "files": len(dataset.files),
        "id": dataset.id,
        "format_version": manifest["format_version"],
        "generator": manifest["generator"],
        "grid": asdict(dataset.grid),
        **{name: about[name] for name in made_by},
        **of_vegetation,
        "classes": about["classes"],
        "drawn_layers": [
            _describe_layer(spec, recipe.classes) for spec in recipe.layers
        ],
        "splits": {
            name: {
                **entry,
                "stored_bytes": _stored_bytes(dataset, name),
                "truth": dataset.truth_of(name),
                "recorded_digest": dataset.split_digest(name),
            }
            for name, entry in dataset.splits.items()
        },
        "fields": manifest["fields"],
        "recipes": manifest["recipes"],
    }


def _stored_bytes(dataset: TerrainDataset, split: str) -> int:
    total, name = 0, ""
    for piece in dataset.pieces[split]:
        with open_file(piece.path) as file:
            try:
                for name in dataset.field_names:
                    total += file[split][name].id.get_storage_size()
            except READ_ERRORS as error:
                raise damage(piece.path, split, name, error) from error
    return total


def tables(described: schema.Json) -> Iterator[Table | str]:
    """Lays out what `describe` gathered, for a terminal."""
    grid, generator = described["grid"], described["generator"]
    files = f" in {described['files']} files" if described["files"] > 1 else ""
    yield (
        f"{described['path']}: {described['id']}, format "
        f"{described['format_version']}, "
        f"{described['bytes'] / 1e6:.1f} MB{files}, written by {generator['package']} "
        f"{generator['version']}"
    )
    yield (
        f"maps of {grid['height']} × {grid['width']} cells of "
        f"{grid['resolution_m']:g} m, "
        f"{described['environments']} environments, λ_stuck "
        f"{described['stuck_threshold']:g}"
    )
    making, places = f"synthesis {described['synthesis']}", described["places"]
    if places:
        making += (
            ", start and goal drawn for each map, at least "
            f"{places['least_distance_m']:g} m apart and "
            f"{places['margin_m']:g} m from the edges"
        )
    making += "".join(f", {layer['words']}" for layer in described["drawn_layers"])
    if described["correlation_m"]:
        making += f", λ correlated over {described['correlation_m']:g} m"
    yield making
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
    fields = schema.read_field_table(described["fields"])
    layers = schema.layer_names(fields)
    if layers:
        code = {layer["name"]: layer["source"] for layer in described["drawn_layers"]}
        yield Table(
            title="layers",
            headings=("layer", "unit", "meaning", "drawn by"),
            rows=tuple(
                (name, fields[name].unit, fields[name].meaning, code.get(name, ""))
                for name in layers
            ),
        )
    extra = [name for name in fields if name not in (*schema.FIELDS, *layers)]
    if extra:
        yield f"optional fields: {', '.join(extra)}"
    for key, title in _DIGESTS.items():
        yield title
        wide = widest(described["splits"])
        yield from (
            f"  {name:{wide}} {entry[key]}"
            for name, entry in described["splits"].items()
        )
    columns = {layer["name"]: layer["classes"] for layer in described["drawn_layers"]}
    headings = ["id", "class", "colour", "a", "b", "o", "σ", "soft spots", *columns]
    rows = []
    for number, item in enumerate(described["classes"]):
        colour = f"#{bytes(item['colour']).hex()}"
        numbers = [f"{item[key]:g}" for key in ("scale", "exponent", "offset", "noise")]
        soft = (
            "{weight:.0%} N({mean:g}, {std:g})".format(**item["soft"])
            if item["soft"]
            else ""
        )
        drawn = (words[item["name"]] for words in columns.values())
        rows.append((str(number), item["name"], colour, *numbers, soft, *drawn))
    # What no class has is left out.
    shown = [place for place, cells in enumerate(zip(*rows, strict=True)) if any(cells)]
    title = "classes: f(ψ) = 1 − (a·10⁻³·ψ^b + o)"
    yield Table(
        title=title,
        headings=tuple(headings[place] for place in shown),
        rows=tuple(tuple(row[place] for place in shown) for row in rows),
    )


def _describe_layer(spec: LayerSpec, classes: ClassTable) -> schema.Json:
    """Describe a layer of a recipe; what it is on each class only where its code is
    here.
    """
    layer = spec.available
    return {
        "name": spec.name,
        "words": spec.words,
        "source": f"{spec.source}, digest {spec.digest[:12]}"
        if spec.source
        else "benchnav",
        "classes": {
            item.name: layer.describe_class(item.name) if layer else ""
            for item in classes
        },
    }


def _origin(described: schema.Json, part: schema.Json) -> str:
    if "recipe" not in part:
        return f"{part['maps']} of {part['source']['file']}"
    recipe = described["recipes"][part["recipe"]]
    return f"{part['maps']} of {recipe['id']} {part['split']}, seed {recipe['seed']}"


def widest(names: Iterable[str]) -> int:
    """Characters of the longest of some names, at least 12, so that what follows them
    stands in one column.
    """
    return max([12, *map(len, names)])


def written(path: Path) -> TerrainDataset:
    """Gives a new dataset and prints where it is, its size, its splits and their
    digests.
    """
    from rich.filesize import decimal

    dataset = TerrainDataset(path)
    size, files = (
        decimal(sum(file.stat().st_size for file in dataset.files)),
        len(dataset.files),
    )
    print(f"wrote {path} ({size}{f' in {files} files' if files > 1 else ''})")
    wide = widest(dataset.splits)
    for name, split in dataset.splits.items():
        print(f"  {name:{wide}} {split['maps']:6} maps  {split['digest']}")
    return dataset
