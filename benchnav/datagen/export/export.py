"""Exports a dataset to a folder, whole or not at all: Parquet files, and what they are.

For programs that is Croissant 1.0 metadata (JSON-LD), for hubs and people a card.

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
from benchnav.core.store import building, take_place
from benchnav.datagen.export.parquet import (
    FOLDER,
    MAP,
    columns_of,
    split_names,
    write_split,
)
from benchnav.datagen.files.hdf5 import held
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.recipe import (
    load_recipe,
    recipe_from_dict,
    shipped_recipes,
)

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

Node = dict[str, Any]  # of JSON-LD

# The context that readers of version 1.0 look for, whether or not a term is used.
_OWN_TERMS = (
    "citeAs column extract field fileProperty fileObject fileSet format includes "
    "isLiveDataset jsonPath key md5 "
    "parentField path recordSet references regex repeated replace samplingRate "
    "separator source subField transform "
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
    **{term: f"cr:{term}" for term in _OWN_TERMS.split()},
}


@dataclass(frozen=True, kw_only=True)
class Publication:
    """What a dataset does not know of itself.

    Args:
        license: name in the SPDX list, such as CC-BY-4.0, or a URL.
        creator: who made it.
        url: where it is to be found; empty where it is nowhere yet.
        date: of publication, YYYY-MM-DD; that of today when empty.
    """

    license: str = "MIT"
    creator: str = AUTHORS
    url: str = ""
    date: str = ""

    def __post_init__(self) -> None:
        """Checks what programs read."""
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
        near = f" Did you mean {listed!r}?" if listed not in ("", self.license) else ""
        is_listed = listed == self.license and re.fullmatch(
            r"(?!LicenseRef-)[A-Za-z0-9.+-]+", listed
        )
        expect(
            self.is_url or is_listed,
            "`license` as a name of the SPDX list, such as CC-BY-4.0, or a URL, got "
            f"{self.license!r}.{near}",
        )
        expect(
            _URL.fullmatch(self.url) or not self.url,
            f"`url` to begin with https://, got {self.url!r}.",
        )
        try:
            datetime.date.fromisoformat(self.date or "2024-05-21")
        except ValueError as error:
            raise ConfigError(
                f"Expected `date` as YYYY-MM-DD, got {self.date!r}."
            ) from error

    @property
    def is_url(self) -> bool:
        """Whether the licence is a URL, and no name."""
        return _URL.fullmatch(self.license) is not None

    @property
    def license_url(self) -> str:
        """Where the licence is to be read."""
        return (
            self.license
            if self.is_url
            else f"https://spdx.org/licenses/{self.license}.html"
        )


def export(
    dataset: TerrainDataset,
    out: Path,
    publication: Publication,
    splits: Sequence[str] | None = None,
    fields: Sequence[str] | None = None,
    maps_a_file: int = 0,
    overwrite: bool = False,
) -> Iterator[tuple[int, int]]:
    """Exports a dataset, yielding (maps done, maps in all) as it goes; to be iterated
    to the end.

    Args:
        dataset: what to export.
        out: the folder, which takes its name when it is whole.
        publication: licence, creator, place and date; without a date that of today.
        splits: which splits, in the dataset's order; None for all.
        fields: which of its fields, in their order; None for all.
        maps_a_file: most maps of a file; 0 for as many as make a file of a few hundred
            MB at most.
        overwrite: replace an exported dataset that is there.

    Raises:
        DatasetError: the dataset is damaged, or `out` cannot be written.
        ConfigError: no such split or field, or `out` is taken.
    """
    names = split_names(choose("splits", splits, dataset.splits))
    columns = choose("fields", fields, dataset.fields)
    expect(maps_a_file >= 0, f"`maps_per_file` ≥ 0, got {maps_a_file}.")
    out = out.resolve()
    done, total = 0, sum(dataset.map_count(split) for split in names)
    with held(out, overwrite, _foreign), building(out) as folder:
        (folder / FOLDER).mkdir()
        yield done, total
        for split, name in names.items():
            for maps in write_split(
                folder / FOLDER, name, dataset, split, columns, maps_a_file
            ):
                done += maps
                yield done, total
        about = metadata(dataset, names, columns, publication, folder)
        (folder / METADATA).write_text(
            json.dumps(about, indent=1, ensure_ascii=False) + "\n"
        )
        (folder / CARD).write_text(card(dataset, names, publication))
        take_place(folder, out)


def _foreign(out: Path) -> str:
    return "" if (out / METADATA).is_file() else "is no exported dataset"


def is_ours(dataset: TerrainDataset, splits: Iterable[str]) -> bool:
    """Whether all maps of some splits were made by shipped recipes as they are, but for
    their seed and splits.
    """
    used = {
        part.get("recipe")
        for split in splits
        for part in dataset.splits[split]["parts"]
    }
    if None in used:  # some were imported
        return False
    for number in used:
        recipe = recipe_from_dict(
            dataset.manifest["recipes"][number], f"in {dataset.path}"
        )
        shipped_id = recipe.id.removesuffix(f"-seed{recipe.seed}")
        if shipped_id not in shipped_recipes():
            return False
        shipped = load_recipe(shipped_id)
        if (
            replace(recipe, id=shipped.id, seed=shipped.seed, splits=shipped.splits)
            != shipped
        ):
            return False
    return True


def describe(dataset: TerrainDataset, splits: Collection[str]) -> str:
    """One sentence or two on what the maps are and where they come from."""
    grid, maps = dataset.grid, sum(dataset.map_count(split) for split in splits)
    generator = dataset.manifest["generator"]
    parts = [part for split in splits for part in dataset.splits[split]["parts"]]
    recipes = [
        dataset.manifest["recipes"][part["recipe"]]
        for part in parts
        if "recipe" in part
    ]
    origins = sorted(
        {f"recipe {recipe['id']}, seed {recipe['seed']}" for recipe in recipes}
    )
    origins += sorted(
        {f"file {part['source']['file']}" for part in parts if "source" in part}
    )
    units = {name: dataset.fields[name].unit for name in dataset.layer_names}
    layers = [
        name if unit == "1" else f"{name} [{unit}]" for name, unit in units.items()
    ]
    with_layers = (
        f"; layers {', '.join(layers)}, NaN where nothing is known" if layers else ""
    )
    return (
        f"{maps} maps of off-road terrain, {grid.height} × {grid.width} cells of "
        f"{grid.resolution_m:g} m: colour "
        "image, terrain class, elevation, slope, and traversability in [0, 1], of "
        "which higher is better; with start, "
        f"goal and reference time{with_layers}. "
        f"Written by {generator['package']} {generator['version']} from "
        f"{'; '.join(origins)}."
    )


def metadata(
    dataset: TerrainDataset,
    names: Mapping[str, str],
    fields: Sequence[str],
    publication: Publication,
    folder: Path,
) -> Node:
    """Makes the metadata of files that are written.

    Args:
        dataset: what was exported.
        names: of its splits, as files are called, by their names in the dataset.
        fields: which fields were exported.
        publication: licence, creator, place and date.
        folder: where the files are.
    """
    content = hashlib.sha256(
        ",".join(dataset.splits[split]["digest"] for split in names).encode()
    )
    found = re.search(r"-v(\d+)", dataset.id)
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": dataset.id,
        "description": describe(dataset, names),
        "license": publication.license_url,
        "creator": {"@type": "sc:Organization", "name": publication.creator},
        "url": publication.url or f"urn:sha256:{content.hexdigest()}",
        "datePublished": publication.date
        or datetime.datetime.now(datetime.UTC).date().isoformat(),
        **({"version": f"{found[1]}.0.0"} if found else {}),
        "keywords": ["robotics", "off-road navigation", "traversability", "terrain"],
        **({"citeAs": PAPER} if is_ours(dataset, names) else {}),
        "distribution": [
            item for name in names.values() for item in _distribution(name, folder)
        ],
        "recordSet": [
            _classes(dataset),
            *(_maps(dataset, split, name, fields) for split, name in names.items()),
        ],
    }


def _node(kind: str, node_id: str, **about: Any) -> Node:
    """A node of Croissant's own, named by the last part of its id."""
    return {
        "@type": f"cr:{kind}",
        "@id": node_id,
        "name": node_id.rpartition("/")[2],
        **about,
    }


def _distribution(name: str, folder: Path) -> Iterator[Node]:
    """The files of a split, and all of them as a set."""
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
    """The rows of a split, and what its columns are."""
    columns = []
    for of, field in columns_of(dataset, fields).items():
        shape = field.entry_shape(*dataset.grid.shape)
        words = [field.meaning] + ([f"in {field.unit}"] if field.unit != "1" else [])
        words += [f"nested lists of shape {list(shape)}"] if shape else []
        about = {
            "description": "; ".join(words),
            "dataType": "sc:Float" if "f" in field.dtype else "sc:Integer",
            **({"repeated": True} if shape else {}),
            "source": {"fileSet": {"@id": f"{name}-files"}, "extract": {"column": of}},
        }
        columns.append(_node("Field", f"{name}/{of}", **about))
    entry = dataset.splits[split]
    description = (
        f"Split {split}: {entry['maps']} maps of scenario {entry['scenario']}."
    )
    key = {"@id": f"{name}/{MAP}"}
    return _node("RecordSet", name, description=description, key=key, field=columns)


def _classes(dataset: TerrainDataset) -> Node:
    """The class table, whose numbers give the latent traversability of a cell."""
    rows: list[Node] = []
    layers = [spec.available for spec in dataset.recipe.layers]
    for number, item in enumerate(dataset.recipe.classes):
        row = {"id": number, **asdict(item), "colour": f"#{bytes(item.colour).hex()}"}
        soft = row.pop("soft") or {}
        row |= {f"soft_{key}": soft.get(key, 0.0) for key in ("weight", "mean", "std")}
        for layer in filter(None, layers):
            row |= layer.class_columns(item.name)
        rows.append({f"classes/{key}": value for key, value in row.items()})
    kinds = {
        key: "sc:Text" if isinstance(value, str) else "sc:Float"
        for key, value in rows[0].items()
    }
    kinds["classes/id"] = "sc:Integer"
    fields = [_node("Field", key, dataType=kind) for key, kind in kinds.items()]
    meaning = (
        "Terrain classes. At a slope of ψ degrees traversability is normal with mean "
        "1 − (scale·10⁻³·ψ^exponent + "
        "offset), clipped to [0, 1], and standard deviation noise; with probability "
        "soft_weight it is normal with "
        "soft_mean and soft_std instead. It is clipped to [0, 1]."
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
    """Writes the card of the exported dataset: Markdown, with what hubs read at its
    head.

    Args:
        dataset: what was exported.
        names: of its splits, as files are called, by their names in the dataset.
        publication: licence, creator, place and date.
    """
    ours = is_ours(dataset, names)
    title = f"BenchNav {dataset.id}" if ours else dataset.id
    files = [
        {"split": name, "path": f"{FOLDER}/{name}-*-of-*.parquet"}
        for name in names.values()
    ]
    head = {
        "pretty_name": title,
        "license": "other" if publication.is_url else publication.license.lower(),
        **({"license_link": publication.license} if publication.is_url else {}),
        "tags": ["robotics", "off-road-navigation", "traversability", "terrain"],
        "configs": [{"config_name": "default", "data_files": files}],
    }
    rows = [
        f"| `{name}` | `{split}` | {dataset.map_count(split)} | "
        f"`{dataset.splits[split]['digest']}` |"
        for split, name in names.items()
    ]
    return "\n".join(
        [
            f"---\n{yaml.safe_dump(head, sort_keys=False, allow_unicode=True)}---\n",
            f"# {title}\n",
            f"{describe(dataset, names)}\n",
            f"A row is a map; arrays are nested lists. `{METADATA}` describes the "
            "columns and holds the SHA-256 of",
            "each file. The metadata of each Parquet file holds the recipes that make "
            "the maps again.\n",
            "| split here | split of the dataset | maps | digest of the dataset's "
            "maps |\n|---|---|---|---|",
            *rows,
            f"\nLicence: [{publication.license}]({publication.license_url}).\n",
            *([f"```bibtex\n{PAPER}\n```\n"] if ours else []),
        ]
    )
