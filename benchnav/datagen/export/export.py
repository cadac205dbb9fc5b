"""Atomic export of a dataset to a folder of Parquet files with metadata.

Croissant 1.0 metadata (JSON-LD) describe the files for programs; a card describes the
files for people.

Source: Croissant Format Specification 1.0, http://mlcommons.org/croissant/1.0.
"""

import datetime
import hashlib
import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from benchnav.core.errors import ConfigError, check_label, choose, expect
from benchnav.core.sources import digest_of_path
from benchnav.core.store import building, replace_folder
from benchnav.datagen.export.parquet import (
    FOLDER,
    MAP,
    columns_of,
    split_names,
    write_split,
)
from benchnav.datagen.files.hdf5 import exclusive_output
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.load import load_recipe, recipe_from_dict, shipped_recipes

METADATA = "croissant.json"
CARD = "README.md"
AUTHORS = "The BenchNav authors"
_URL = re.compile(r"https?://\S+")

PAPER = """@misc{endo2024benchnav,
  title = {{BenchNav}: Simulation Platform for Benchmarking Off-road Navigation Algorithms with Probabilistic
           Traversability},
  author = {Endo, Masafumi and Honda, Kohei and Ishigami, Genya},
  year = {2024},
  eprint = {2405.13318},
  archivePrefix = {arXiv},
}"""

_TAGS_OF_METADATA = ["robotics", "off-road navigation", "traversability", "terrain"]
_TAGS_OF_CARD = ["robotics", "off-road-navigation", "traversability", "terrain"]

Node = dict[str, Any]  # node of JSON-LD

# Readers of Croissant 1.0 expect all terms in the context, including unused ones.
_CROISSANT_TERMS = (
    "citeAs column extract field fileProperty fileObject fileSet format includes "
    "isLiveDataset jsonPath key md5 parentField path recordSet references regex "
    "repeated replace samplingRate separator source subField transform "
    "equivalentProperty"
)
_CONTEXT: Node = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    **{term: f"cr:{term}" for term in _CROISSANT_TERMS.split()},
}


@dataclass(frozen=True, kw_only=True)
class Publication:
    """Data of a publication that a dataset does not contain.

    Args:
        license: identifier from the SPDX list, such as CC-BY-4.0, or a URL.
        creator: person or organisation that created the dataset.
        url: address of the dataset; empty if it is not published yet.
        date: date of publication, YYYY-MM-DD. If empty, today.
    """

    license: str = "MIT"
    creator: str = AUTHORS
    url: str = ""
    date: str = ""

    def __post_init__(self) -> None:
        """Check the format of the values."""
        from packaging.licenses import (
            InvalidLicenseExpression,
            canonicalize_license_expression,
        )

        for name in ("license", "creator"):
            check_label(f"`{name}`", getattr(self, name))
        try:
            listed = str(canonicalize_license_expression(self.license))
        except InvalidLicenseExpression:
            listed = ""
        advice = ""
        if listed not in ("", self.license):
            advice = f" Did you mean {listed!r}?"
        is_simple = re.fullmatch(r"(?!LicenseRef-)[A-Za-z0-9.+-]+", listed)
        is_listed = listed == self.license and is_simple
        expect(
            self.is_url or is_listed,
            "`license` to be an identifier from the SPDX list, such as CC-BY-4.0, or a "
            f"URL, got {self.license!r}.{advice}",
        )
        is_url_valid = not self.url or _URL.fullmatch(self.url)
        expect(
            is_url_valid,
            f"`url` to begin with https:// or http://, got {self.url!r}.",
        )
        try:
            datetime.date.fromisoformat(self.date or "2024-05-21")
        except ValueError as error:
            raise ConfigError(
                f"Expected `date` as YYYY-MM-DD, got {self.date!r}."
            ) from error

    @property
    def is_url(self) -> bool:
        """Whether the licence is a URL instead of a name."""
        return _URL.fullmatch(self.license) is not None

    @property
    def license_url(self) -> str:
        """Address of the licence's text."""
        if self.is_url:
            return self.license
        return f"https://spdx.org/licenses/{self.license}.html"


def export(
    dataset: TerrainDataset,
    out: Path,
    publication: Publication,
    splits: Sequence[str] | None = None,
    fields: Sequence[str] | None = None,
    maps_per_file: int = 0,
    overwrite: bool = False,
) -> Iterator[tuple[int, int]]:
    """Export a dataset; yield (maps done, total maps). Iterate to the end.

    Args:
        dataset: dataset to export.
        out: path of the folder to write. The folder appears when it is complete.
        publication: licence, creator, address and date.
        splits: names of the splits to export, in the dataset's order; None for all.
        fields: names of the fields to export, in the dataset's order; None for all.
        maps_per_file: maximum number of maps in a file. If 0, it follows from the size
            of the maps, for files of up to a few hundred MB.
        overwrite: whether to replace an exported dataset.

    Raises:
        DatasetError: If the dataset is damaged, or `out` cannot be written.
        ConfigError: If the dataset does not have a split or field, or `out` exists.
    """
    names = split_names(choose("splits", splits, dataset.splits))
    columns = choose("fields", fields, dataset.fields)
    expect(maps_per_file >= 0, f"`maps_per_file` ≥ 0, got {maps_per_file}.")
    out = out.resolve()
    done = 0
    total = sum(dataset.map_count(split) for split in names)
    with exclusive_output(out, overwrite, _foreign_reason), building(out) as folder:
        data_folder = folder / FOLDER
        data_folder.mkdir()
        yield done, total
        for split, name in names.items():
            steps = write_split(
                data_folder, name, dataset, split, columns, maps_per_file
            )
            for n_maps in steps:
                done += n_maps
                yield done, total
        node = metadata(dataset, names, columns, publication, folder)
        text = json.dumps(node, indent=1, ensure_ascii=False)
        (folder / METADATA).write_text(f"{text}\n")
        (folder / CARD).write_text(card(dataset, names, publication))
        replace_folder(folder, out)


def _foreign_reason(out: Path) -> str:
    """Return why a folder must not be replaced; empty if it is an exported dataset."""
    is_exported = (out / METADATA).is_file()
    return "" if is_exported else "is not an exported dataset"


def is_ours(dataset: TerrainDataset, splits: Iterable[str]) -> bool:
    """Return whether all maps of the given splits are generated by shipped recipes.

    The seed and the splits of a recipe may differ from those of the shipped recipe.
    """
    indices = {part.get("recipe") for part in _parts_of(dataset, splits)}
    if None in indices:  # some maps were imported
        return False
    for index in indices:
        data = dataset.manifest["recipes"][index]
        recipe = recipe_from_dict(data, f"in {dataset.path}")
        shipped_id = recipe.id.removesuffix(f"-seed{recipe.seed}")
        if shipped_id not in shipped_recipes():
            return False
        shipped = load_recipe(shipped_id)
        recipe = replace(
            recipe, id=shipped.id, seed=shipped.seed, splits=shipped.splits
        )
        if recipe != shipped:
            return False
    return True


def _parts_of(dataset: TerrainDataset, splits: Iterable[str]) -> list[Node]:
    """Return the manifest entries of the parts of some splits."""
    parts = []
    for split in splits:
        parts += dataset.splits[split]["parts"]
    return parts


def describe(dataset: TerrainDataset, splits: Collection[str]) -> str:
    """Return a description of the maps and of the recipes and files they come from."""
    grid = dataset.grid
    maps = sum(dataset.map_count(split) for split in splits)
    generator = dataset.manifest["generator"]
    recipes: set[str] = set()
    files: set[str] = set()
    for part in _parts_of(dataset, splits):
        if "recipe" in part:
            recipe = dataset.manifest["recipes"][part["recipe"]]
            recipes.add(f"recipe {recipe['id']}, seed {recipe['seed']}")
        if "source" in part:
            files.add(f"file {part['source']['file']}")
    origins = "; ".join(sorted(recipes) + sorted(files))
    layers = []
    for name in dataset.layer_names:
        unit = dataset.fields[name].unit
        layers.append(name if unit == "1" else f"{name} [{unit}]")
    with_layers = ""
    if layers:
        with_layers = f"; layers {', '.join(layers)}, NaN where missing"
    return (
        f"{maps} maps of off-road terrain, {grid.height} × {grid.width} cells of "
        f"{grid.resolution_m:g} m: colour image, terrain class, elevation, slope, and "
        "traversability in [0, 1] (higher is better); with start, goal and reference "
        f"time{with_layers}. Written by {generator['package']} {generator['version']} "
        f"from {origins}."
    )


def metadata(
    dataset: TerrainDataset,
    names: Mapping[str, str],
    fields: Sequence[str],
    publication: Publication,
    folder: Path,
) -> Node:
    """Return the Croissant metadata of exported files.

    Args:
        dataset: exported dataset.
        names: names of splits in the files, by the names in the dataset.
        fields: names of the exported fields.
        publication: licence, creator, address and date.
        folder: folder of the files.
    """
    digests = ",".join(dataset.splits[split]["digest"] for split in names)
    content = hashlib.sha256(digests.encode())
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    version = re.search(r"-v(\d+)", dataset.id)
    node: Node = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": dataset.id,
        "description": describe(dataset, names),
        "license": publication.license_url,
        "creator": {"@type": "sc:Organization", "name": publication.creator},
        "url": publication.url or f"urn:sha256:{content.hexdigest()}",
        "datePublished": publication.date or today,
    }
    if version:
        node["version"] = f"{version[1]}.0.0"
    node["keywords"] = _TAGS_OF_METADATA
    if is_ours(dataset, names):
        node["citeAs"] = PAPER
    files: list[Node] = []
    record_sets = [_classes(dataset)]
    for split, name in names.items():
        files += _distribution(name, folder)
        record_sets.append(_maps(dataset, split, name, fields))
    node["distribution"] = files
    node["recordSet"] = record_sets
    return node


def _node(kind: str, node_id: str, **properties: Any) -> Node:
    """Return a node of a Croissant type; its name is the last part of its id."""
    name = node_id.rpartition("/")[2]
    return {"@type": f"cr:{kind}", "@id": node_id, "name": name, **properties}


def _distribution(name: str, folder: Path) -> Iterator[Node]:
    """Yield the nodes of a split's files, then the node of the set of files."""
    pattern = f"{FOLDER}/{name}-*-of-*.parquet"
    for path in sorted(folder.glob(pattern)):
        yield _node(
            "FileObject",
            path.name,
            contentUrl=path.relative_to(folder).as_posix(),
            contentSize=f"{path.stat().st_size} B",
            encodingFormat="application/x-parquet",
            sha256=digest_of_path(path),
        )
    yield _node(
        "FileSet",
        f"{name}-files",
        encodingFormat="application/x-parquet",
        includes=pattern,
    )


def _maps(
    dataset: TerrainDataset, split: str, name: str, fields: Sequence[str]
) -> Node:
    """Return the record set of a split's maps, with its columns."""
    columns = []
    for column, field in columns_of(dataset, fields).items():
        shape = field.entry_shape(*dataset.grid.shape)
        description = field.meaning
        if field.unit != "1":
            description += f"; in {field.unit}"
        if shape:
            description += f"; nested lists of shape {list(shape)}"
        kind = "sc:Float" if "f" in field.dtype else "sc:Integer"
        properties: Node = {"description": description, "dataType": kind}
        if shape:
            properties["repeated"] = True
        files = {"@id": f"{name}-files"}
        properties["source"] = {"fileSet": files, "extract": {"column": column}}
        columns.append(_node("Field", f"{name}/{column}", **properties))
    entry = dataset.splits[split]
    description = (
        f"Split {split}: {entry['maps']} maps of scenario {entry['scenario']}."
    )
    key = {"@id": f"{name}/{MAP}"}
    return _node("RecordSet", name, description=description, key=key, field=columns)


def _classes(dataset: TerrainDataset) -> Node:
    """Return the record set of the class table, with parameters of latent functions."""
    rows: list[Node] = []
    layers = [spec.available for spec in dataset.recipe.layers]
    for class_id, item in enumerate(dataset.recipe.classes):
        colour = f"#{bytes(item.colour).hex()}"
        row = {"id": class_id, **asdict(item), "colour": colour}
        soft = row.pop("soft") or {}
        for key in ("weight", "mean", "std"):
            row[f"soft_{key}"] = soft.get(key, 0.0)
        for layer in filter(None, layers):
            row |= layer.class_columns(item.name)
        rows.append({f"classes/{key}": value for key, value in row.items()})
    kinds = {}
    for key, value in rows[0].items():
        is_text = isinstance(value, str)
        kinds[key] = "sc:Text" if is_text else "sc:Float"
    kinds["classes/id"] = "sc:Integer"
    fields = [_node("Field", key, dataType=kind) for key, kind in kinds.items()]
    meaning = (
        "Terrain classes. At a slope of ψ degrees traversability is normal with mean "
        "1 − (scale·10⁻³·ψ^exponent + offset), clipped to [0, 1], and standard "
        "deviation noise; with probability soft_weight it is normal with soft_mean and "
        "soft_std instead. It is clipped to [0, 1]."
    )
    identity = {"@id": "classes/id"}
    return _node(
        "RecordSet",
        "classes",
        description=meaning,
        key=identity,
        field=fields,
        data=rows,
    )


def card(
    dataset: TerrainDataset, names: Mapping[str, str], publication: Publication
) -> str:
    """Return the card of an exported dataset: Markdown with YAML front matter.

    Args:
        dataset: exported dataset.
        names: names of splits in the files, by the names in the dataset.
        publication: licence, creator, address and date.
    """
    ours = is_ours(dataset, names)
    title = f"BenchNav {dataset.id}" if ours else dataset.id
    files = [
        {"split": name, "path": f"{FOLDER}/{name}-*-of-*.parquet"}
        for name in names.values()
    ]
    front: Node = {"pretty_name": title, "license": publication.license.lower()}
    if publication.is_url:
        front["license"] = "other"
        front["license_link"] = publication.license
    front["tags"] = _TAGS_OF_CARD
    front["configs"] = [{"config_name": "default", "data_files": files}]
    front_matter = yaml.safe_dump(front, sort_keys=False, allow_unicode=True)
    lines = [
        f"---\n{front_matter}---\n",
        f"# {title}\n",
        f"{describe(dataset, names)}\n",
        f"A row is a map; arrays are nested lists. `{METADATA}` describes the "
        "columns and contains the SHA-256 of",
        "each file. The metadata of each Parquet file contain the recipes that "
        "generate the maps.\n",
        "| split here | split of the dataset | maps | digest of the dataset's "
        "maps |\n|---|---|---|---|",
    ]
    for split, name in names.items():
        n_maps = dataset.map_count(split)
        digest = dataset.splits[split]["digest"]
        lines.append(f"| `{name}` | `{split}` | {n_maps} | `{digest}` |")
    lines.append(f"\nLicence: [{publication.license}]({publication.license_url}).\n")
    if ours:
        lines.append(f"```bibtex\n{PAPER}\n```\n")
    return "\n".join(lines)
