"""What other tools read of an exported dataset is what the dataset holds, and it is
there whole or not at all.
"""

import hashlib
import json
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import yaml

from benchnav.core.errors import ConfigError, DatasetError
from benchnav.datagen import schema
from benchnav.datagen.export import parquet
from benchnav.datagen.export.export import Publication, export, is_ours
from benchnav.datagen.files import reader
from benchnav.datagen.files.create import create
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.layers.vegetation import Growth
from tests import factories
from tests.commands import call
from tests.datagen.small import grown, small_stakes

Call = Callable[..., int]
OWN = ("--license", "CC-BY-4.0", "--creator", "The survey")


@pytest.fixture
def datagen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Call:
    """Runs the command in an empty folder and gives its exit status."""
    monkeypatch.chdir(tmp_path)

    return partial(call, "datagen")


def exported(
    path: Path, out: Path, publication: Publication | None = None, **settings: Any
) -> Path:
    """Exports a dataset to its end."""
    for _ in export(
        TerrainDataset(path), out, publication or Publication(), **settings
    ):
        pass
    return out


def metadata(out: Path) -> dict[str, Any]:
    return json.loads((out / "croissant.json").read_text())


def read_back(out: Path, split: str, field: str) -> np.ndarray:
    """Reads a column of a split with pyarrow alone."""
    chunks = []
    for path in sorted((out / "data").glob(f"{split}-*.parquet")):
        table = pq.read_table(path)
        column = table.column(field).combine_chunks()
        while hasattr(column, "flatten") and hasattr(column.type, "list_size"):
            assert column.null_count == 0
            column = column.flatten()
        shape = json.loads(table.schema.field(field).metadata[b"shape"])
        chunks.append(column.to_numpy(zero_copy_only=True).reshape(len(table), *shape))
    return np.concatenate(chunks)


@pytest.mark.parametrize("maps_per_file", [0, 1, 3])
def test_values_are_the_datasets_bit_for_bit(
    dataset_path: Path,
    tmp_path: Path,
    maps_per_file: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Few maps at a time, so that files begin within what is read at once and row groups
    # end within files.
    monkeypatch.setattr(parquet, "_CELLS_PER_ROW_GROUP", 4 * 32 * 32)
    out = exported(dataset_path, tmp_path / "out", maps_per_file=maps_per_file)
    dataset = TerrainDataset(dataset_path)
    for split, name in parquet.split_names(dataset.splits).items():
        count = dataset.map_count(split)
        files = sorted((out / "data").glob(f"{name}-*.parquet"))
        most = maps_per_file or count
        wanted = [min(most, count - first) for first in range(0, count, most)]
        assert [pq.read_metadata(path).num_rows for path in files] == wanted
        assert [path.name for path in files] == [
            f"{name}-{number:05d}-of-{len(wanted):05d}.parquet"
            for number in range(len(wanted))
        ]
        assert read_back(out, name, "map").tolist() == list(range(count))
        stored = dataset.read(split)
        for field, values in stored.items():
            read = read_back(out, name, field)
            assert read.dtype == values.dtype
            assert read.shape == values.shape
            assert read.tobytes() == values.tobytes()
    # Of maps that need not be solvable there is no reference time: NaN, which is not
    # null.
    assert np.isnan(dataset.read("train")["reference_time_s"]).any()


def test_the_metadata_of_parquet_files_makes_the_maps_again(
    dataset_path: Path, tmp_path: Path
) -> None:
    dataset = TerrainDataset(dataset_path)
    out = exported(dataset_path, tmp_path / "out")
    found = pq.read_schema(out / "data" / "test_hg-00000-of-00001.parquet")
    about = json.loads(found.metadata[b"benchnav"])
    assert about["digest"] == dataset.splits["test/hg"]["digest"]
    assert about["recipes"] == json.loads(json.dumps(dataset.manifest["recipes"]))
    assert (about["id"], about["split"], about["maps"]) == (dataset.id, "test/hg", 2)
    assert about["truth"] == "generated"
    assert found.field("elevation_m").metadata == {
        b"shape": b"[32, 32]", b"unit": b"m", b"meaning": b"elevation, in steps of 2^-13 m",
    }  # fmt: skip


def test_pandas_reads_it_without_code_of_ours(
    dataset_path: Path, tmp_path: Path
) -> None:
    out = exported(dataset_path, tmp_path / "out", maps_per_file=3)
    table = pd.read_parquet(out / "data")
    assert len(table) == sum(
        entry["maps"] for entry in TerrainDataset(dataset_path).splits.values()
    )
    picture = np.stack([np.stack(list(rows)) for rows in table["rgb"][0]])
    assert picture.shape == (3, 32, 32)


def test_a_dataset_of_many_files_is_exported_as_that_of_one(
    dataset_path: Path, tmp_path: Path
) -> None:
    for _ in create(
        factories.tiny_recipe(), tmp_path / "shards", shard_cells=2 * 32 * 32
    ):
        pass
    publication = Publication(date="2026-01-02")
    one = exported(dataset_path, tmp_path / "one", publication)
    many = exported(tmp_path / "shards", tmp_path / "many", publication)
    assert {path.relative_to(one) for path in one.rglob("*")} == {
        path.relative_to(many) for path in many.rglob("*")
    }
    for path in one.rglob("*.*"):
        assert path.read_bytes() == (many / path.relative_to(one)).read_bytes()


def test_metadata_has_what_the_specification_requires(
    dataset_path: Path, tmp_path: Path
) -> None:
    publication = Publication(
        license="CC-BY-4.0",
        creator="A. Nother",
        url="https://example.org/maps",
        date="2026-01-02",
    )
    out = exported(dataset_path, tmp_path / "out", publication, maps_per_file=3)
    about = metadata(out)
    assert about["@type"] == "sc:Dataset"
    assert about["conformsTo"] == "http://mlcommons.org/croissant/1.0"
    assert about["name"] == "tiny-v1"
    assert about["license"] == "https://spdx.org/licenses/CC-BY-4.0.html"
    assert about["creator"]["name"] == "A. Nother"
    assert (about["url"], about["datePublished"]) == (
        "https://example.org/maps",
        "2026-01-02",
    )
    assert about["version"] == "1.0.0"
    assert "2405.13318" in about["citeAs"]
    assert "17 maps" in about["description"]
    # Terms of Croissant's own have to be in the context, else they would be read as
    # schema.org's.
    context, own = (
        about["@context"],
        {"recordSet", "field", "dataType", "source", "extract", "column"},
    )
    assert all("cr:" in json.dumps(context[term]) for term in own)


def test_metadata_names_every_file_with_its_digest_and_every_column(
    dataset_path: Path, tmp_path: Path
) -> None:
    out = exported(dataset_path, tmp_path / "out", maps_per_file=3)
    about = metadata(out)
    files = [item for item in about["distribution"] if item["@type"] == "cr:FileObject"]
    assert {item["contentUrl"] for item in files} == {
        path.relative_to(out).as_posix() for path in out.rglob("*.parquet")
    }
    for item in files:
        content = (out / item["contentUrl"]).read_bytes()
        assert item["sha256"] == hashlib.sha256(content).hexdigest()
        assert item["contentSize"] == f"{len(content)} B"
    for item in about["distribution"]:
        if item["@type"] == "cr:FileSet":
            named = {
                path.relative_to(out).as_posix() for path in out.glob(item["includes"])
            }
            assert named == {
                file["contentUrl"]
                for file in files
                if file["name"].startswith(item["@id"][:-6])
            }
    resources = {item["@id"] for item in about["distribution"]}
    records = {item["@id"]: item for item in about["recordSet"]}
    assert set(records) == {
        "classes",
        "train",
        "valid",
        "test_std",
        "test_hg",
        "test_hs",
    }
    ids = [
        *resources,
        *records,
        *(field["@id"] for item in records.values() for field in item["field"]),
    ]
    assert len(ids) == len(set(ids))
    for name in set(records) - {"classes"}:
        fields = {field["name"]: field for field in records[name]["field"]}
        assert list(fields) == ["map", *schema.FIELDS]
        for field in fields.values():
            (source,) = (
                field["source"][key]
                for key in ("fileObject", "fileSet")
                if key in field["source"]
            )
            assert source["@id"] in resources
            assert field["source"]["extract"]["column"] == field["name"]
        assert fields["class_id"]["dataType"] == "sc:Integer"
        assert fields["slope_deg"] | {"source": None} == {
            "@type": "cr:Field", "@id": f"{name}/slope_deg", "name": "slope_deg", "dataType": "sc:Float",
            "repeated": True, "source": None,
            "description": (
                "slope by Horn's method, in steps of 2^-10 deg; in deg; nested lists of shape [32, 32]"
            ),
        }  # fmt: skip
        assert "repeated" not in fields["reference_time_s"]
    classes = TerrainDataset(dataset_path).recipe.classes
    assert [row["classes/name"] for row in records["classes"]["data"]] == [
        item.name for item in classes
    ]
    assert [row["classes/noise"] for row in records["classes"]["data"]] == [
        item.noise for item in classes
    ]


def test_the_card_names_the_splits_as_hubs_read_them(
    dataset_path: Path, tmp_path: Path
) -> None:
    out = exported(
        dataset_path, tmp_path / "out", Publication(license="https://example.org/terms")
    )
    _, head, body = (out / "README.md").read_text().split("---\n", 2)
    about = yaml.safe_load(head)
    assert (about["license"], about["license_link"]) == (
        "other",
        "https://example.org/terms",
    )
    (config,) = about["configs"]
    for item in config["data_files"]:
        assert item["split"].isidentifier()
        assert len(list(out.glob(item["path"]))) == 1
    assert [item["split"] for item in config["data_files"]] == [
        "train",
        "valid",
        "test_std",
        "test_hg",
        "test_hs",
    ]
    assert TerrainDataset(dataset_path).splits["test/hs"]["digest"] in body


def test_without_a_place_the_url_is_of_the_content_and_the_date_is_todays(
    dataset_path: Path, tmp_path: Path
) -> None:
    first, second = (
        metadata(exported(dataset_path, tmp_path / name, splits=splits))
        for name, splits in (("all", None), ("some", ["valid"]))
    )
    assert first["url"].startswith("urn:sha256:")
    assert first["url"] != second["url"]
    assert len(first["datePublished"]) == len("2026-01-02")


def test_the_command_and_its_options(
    datagen: Call,
    dataset_path: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked = (
        "export",
        dataset_path,
        "--out",
        "out",
        "--splits",
        "[test/hs,valid]",
        "--fields",
        "[slope_deg,rgb]",
    )
    assert datagen(*asked, "--maps-per-file", "2", "--license", "CC0-1.0", "--date", "2026-01-02",
                   "--creator", "A. Nother", "--url", "https://example.org") == 0  # fmt: skip
    told = capsys.readouterr()
    assert told.out.startswith("wrote out (")
    assert "in 3 Parquet files" in told.out
    assert "maps: 5/5" in told.err
    assert sorted(path.name for path in Path("out/data").iterdir()) == [
        *(
            "test_hs-00000-of-00001.parquet",
            "valid-00000-of-00002.parquet",
            "valid-00001-of-00002.parquet",
        )
    ]
    assert pq.read_schema("out/data/test_hs-00000-of-00001.parquet").names == [
        "map",
        "rgb",
        "slope_deg",
    ]
    about = metadata(tmp_path / "out")
    assert [item["@id"] for item in about["recordSet"]] == [
        "classes",
        "valid",
        "test_hs",
    ]
    assert about["creator"]["name"] == "A. Nother"
    assert about["license"].endswith("CC0-1.0.html")
    assert (about["url"], about["datePublished"]) == (
        "https://example.org",
        "2026-01-02",
    )


def test_what_is_there_is_refused_and_replaced_only_where_it_is_an_export(
    datagen: Call, dataset_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert datagen("export", dataset_path, "--out", "out", *OWN) == 0
    assert datagen("export", dataset_path, "--out", "out", *OWN) == 2
    assert "Pass --overwrite" in capsys.readouterr().err
    assert (
        datagen(
            "export",
            dataset_path,
            "--out",
            "out",
            "--splits",
            "[valid]",
            "--overwrite",
            *OWN,
        )
        == 0
    )
    assert len(list(Path("out/data").iterdir())) == 1
    Path("own").mkdir()
    Path("own/thesis.tex").write_text("years of work")
    Path("file").write_text("a day's work")
    for own in ("own", "file"):
        assert datagen("export", dataset_path, "--out", own, "--overwrite", *OWN) == 2
        assert "is not an exported dataset" in capsys.readouterr().err
    assert Path("own/thesis.tex").exists()
    assert {path.name for path in Path.cwd().iterdir()} == {"out", "own", "file"}


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--splits", "[test/xx]"], "`splits` among"),
        (["--splits", "[]"], "`splits` among"),
        (["--fields", "[rbg]"], "`fields` among"),
        (["--maps-per-file", "-1"], "`maps_per_file` ≥ 0"),
        (["--license", "my own"], "`license` to be an identifier"),
        (
            ["--license", "foo"],
            "`license` to be an identifier from the SPDX list, such as CC-BY-4.0, or a URL, got 'foo'.",
        ),
        (["--license", "cc-by-4.0"], "got 'cc-by-4.0'. Did you mean 'CC-BY-4.0'?"),
        (["--license", "LicenseRef-mine"], "got 'LicenseRef-mine'"),
        (["--license", "MIT OR CC0-1.0"], "got 'MIT OR CC0-1.0'"),
        (["--creator", " "], "`creator` as printable text"),
        (["--url", "here"], "`url` to begin with https://"),
        (["--date", "tomorrow"], "`date` as YYYY-MM-DD"),
    ],
)
def test_bad_input_is_one_line(
    datagen: Call,
    dataset_path: Path,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    told: str,
) -> None:
    assert datagen("export", dataset_path, "--out", "out", *OWN, *options) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line
    assert list(Path.cwd().iterdir()) == []


def test_imported_maps_need_a_licence_and_a_creator(
    datagen: Call,
    dataset_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    manifest = reader.read_manifest(dataset_path)
    manifest["splits"]["valid"]["parts"] = [{"maps": 3, "source": {"file": "site.tif"}}]
    monkeypatch.setattr(reader, "read_manifest", lambda path: manifest)
    assert (
        datagen("export", dataset_path, "--out", "out", "--license", "CC-BY-4.0") == 2
    )
    assert "maps do not come from a shipped recipe" in capsys.readouterr().err
    assert datagen("export", dataset_path, "--out", "out", *OWN) == 0
    assert "file site.tif" in metadata(Path("out"))["description"]
    about = {
        split: json.loads(
            pq.read_schema(Path(f"out/data/{split}-00000-of-00001.parquet")).metadata[
                b"benchnav"
            ]
        )
        for split in ("train", "valid")
    }
    assert (about["train"]["truth"], about["valid"]["truth"]) == (
        "generated",
        "unknown",
    )


def test_maps_of_others_are_never_ours(
    datagen: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "tiny-v1.h5"
    assert (
        datagen(
            "create", "tiny-v1", "--splits", "[test/std]", "--first", "1", "--out", own
        )
        == 0
    )
    sibling = (
        "create",
        "tiny-v1",
        "--seed",
        "3",
        "--splits",
        "[test/std]",
        "--first",
        "1",
        "--out",
        "sibling.h5",
    )
    assert datagen(*sibling) == 0
    assert datagen("export", "sibling.h5", "--out", "siblings") == 0
    assert metadata(Path("siblings"))["creator"]["name"] == "The BenchNav authors"
    changed = (
        "create",
        "tiny-v1",
        "id=mine-v1",
        "--splits",
        "[test/std]",
        "--first",
        "1",
        "--out",
        "mine.h5",
    )
    assert datagen(*changed) == 0
    for half in (OWN[:2], OWN[2:], ()):
        assert datagen("export", "mine.h5", "--out", "theirs", *half) == 2
        assert "Expected both `license` and `creator`" in capsys.readouterr().err
    assert datagen("export", "mine.h5", "--out", "theirs", *OWN) == 0
    assert datagen("export", own, "--out", "ours") == 0
    ours, theirs = (metadata(Path(name)) for name in ("ours", "theirs"))
    cards = [Path(name, "README.md").read_text() for name in ("ours", "theirs")]
    assert (ours["creator"]["name"], ours["license"][-8:]) == (
        "The BenchNav authors",
        "MIT.html",
    )
    assert theirs["creator"]["name"] == "The survey"
    assert ("endo2024" in ours["citeAs"], "citeAs" in theirs) == (True, False)
    assert (
        ["endo2024" in card for card in cards]
        == ["# BenchNav tiny-v1" in card for card in cards]
        == [True, False]
    )
    both = TerrainDataset(own)
    assert is_ours(both, ["test/std"])
    both.manifest["recipes"] += TerrainDataset(Path("mine.h5")).manifest["recipes"]
    both.manifest["splits"]["test/std"]["parts"].append({"maps": 1, "recipe": 1})
    assert not is_ours(both, ["test/std"])


def test_the_documented_lines_make_arrays_of_parquet(
    dataset_path: Path, tmp_path: Path
) -> None:
    out = exported(dataset_path, tmp_path / "out")
    page = (Path(__file__).parents[3] / "docs/how-to/export-and-read.md").read_text()
    (lines,) = (
        part.split("```")[0]
        for part in page.split("```python\n")[1:]
        if "read_table" in part
    )
    (place,) = out.glob("data/valid*")
    own: dict[str, Any] = {}
    exec(
        lines.replace(
            "exports/stakes-v1/data/test_std-00000-of-00001.parquet", str(place)
        ),
        own,
    )
    np.testing.assert_array_equal(
        own["rgb"], TerrainDataset(dataset_path).read("valid", fields=["rgb"])["rgb"]
    )


def test_splits_of_one_name_in_parquet_are_refused() -> None:
    assert parquet.split_names(["test/hg-025", "train"]) == {
        "test/hg-025": "test_hg_025",
        "train": "train",
    }
    with pytest.raises(DatasetError, match="test/a-1 and test/a_1"):
        parquet.split_names(["train", "test/a-1", "test/a_1"])


def test_publications_are_checked() -> None:
    assert (
        Publication(license="https://example.org/terms").license_url
        == "https://example.org/terms"
    )
    for wrong in ({"license": ""}, {"url": "ftp://x"}, {"date": "2026-13-01"}):
        with pytest.raises(ConfigError):
            replace(Publication(), **wrong)


def test_an_interrupted_export_leaves_nothing_and_what_was_there(
    dataset_path: Path, tmp_path: Path
) -> None:
    out = exported(dataset_path, tmp_path / "out", splits=["valid"])
    before = {path: path.read_bytes() for path in out.rglob("*.*")}
    steps = export(TerrainDataset(dataset_path), out, Publication(), overwrite=True)
    for done, _ in steps:
        if done:
            break
    steps.close()
    assert {path: path.read_bytes() for path in out.rglob("*.*")} == before
    assert list(tmp_path.iterdir()) == [out]


def test_a_killed_export_leaves_nothing_under_its_name(
    dataset_path: Path, tmp_path: Path
) -> None:
    killed = f"""
import os
from pathlib import Path
from benchnav.datagen.export.export import Publication, export, is_ours
from benchnav.datagen.files.reader import TerrainDataset
for done, total in export(TerrainDataset({str(dataset_path)!r}), Path({str(tmp_path / "out")!r}), Publication()):
    if done:
        os.kill(os.getpid(), 9)
"""
    ended = subprocess.run([sys.executable, "-c", killed])
    assert ended.returncode == -signal.SIGKILL
    assert not (tmp_path / "out").exists()
    out = exported(dataset_path, tmp_path / "out")
    assert list(tmp_path.iterdir()) == [out]


def test_a_disk_that_cannot_be_written_is_named(
    datagen: Call,
    dataset_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(parquet.pq, "ParquetWriter", full)
    assert datagen("export", dataset_path, "--out", "out") == 2
    assert "No space left on device" in capsys.readouterr().err
    assert list(Path.cwd().iterdir()) == []


def test_layers_are_columns_and_named(tmp_path: Path) -> None:
    grass = Growth(height_m=(0.1, 0.8), cover=0.5, colour=(60, 110, 30))
    path = factories.tiny_dataset(
        tmp_path / "d.h5", grown(small_stakes(), gravel=grass)
    )
    out = exported(path, tmp_path / "out")
    stored = TerrainDataset(path).read("train")["vegetation_m"]
    np.testing.assert_array_equal(
        read_back(out, "train", "vegetation_m").reshape(stored.shape), stored
    )
    about = metadata(out)
    assert (
        "reference time; layers vegetation_m [m], NaN where missing."
        in about["description"]
    )
    assert "layers vegetation_m [m]" in (out / "README.md").read_text()
    table, train, *_ = about["recordSet"]
    own = {field["name"]: field for field in train["field"]}
    assert "height of the vegetation" in own["vegetation_m"]["description"]
    rows = {row["classes/name"]: row for row in table["data"]}
    keys = ("cover", "least_m", "most_m", "colour")
    assert [rows["gravel"][f"classes/vegetation_{key}"] for key in keys] == [
        0.5,
        0.1,
        0.8,
        "#3c6e1e",
    ]
    assert [rows["basalt"][f"classes/vegetation_{key}"] for key in keys] == [
        0.0,
        0.0,
        0.0,
        "",
    ]
    assert {field["name"] for field in table["field"]} == {
        key.removeprefix("classes/") for key in rows["basalt"]
    }
    plain = metadata(
        exported(
            factories.tiny_dataset(tmp_path / "e.h5", small_stakes()),
            tmp_path / "plain",
        )
    )
    assert "layers" not in plain["description"]
    assert not any("vegetation" in key for key in plain["recordSet"][0]["data"][0])


def test_mlcroissant_reads_the_metadata_and_the_maps(
    dataset_path: Path, tmp_path: Path
) -> None:
    mlcroissant = pytest.importorskip("mlcroissant")
    dataset, out = (
        TerrainDataset(dataset_path),
        exported(dataset_path, tmp_path / "out"),
    )
    read = mlcroissant.Dataset(jsonld=out / "croissant.json")
    assert not read.metadata.ctx.issues.errors
    names = parquet.split_names(dataset.splits)
    for split, name in names.items():
        rows = list(read.records(name))
        assert len(rows) == dataset.map_count(split)
        maps = dataset.read(split)
        for row in rows:
            for field, values in maps.items():
                # a number NaN comes as None
                got = np.array(nested(row[f"{name}/{field}"]), values.dtype)
                np.testing.assert_array_equal(
                    got.reshape(values.shape[1:]), values[int(row[f"{name}/map"])]
                )
    classes = [row["classes/name"] for row in read.records("classes")]
    assert [name.decode() if isinstance(name, bytes) else name for name in classes] == [
        item.name for item in dataset.recipe.classes
    ]


def nested(values: Any) -> Any:
    """Arrays of arrays as lists of lists."""
    return (
        [nested(value) for value in values]
        if isinstance(values, list | np.ndarray)
        else values
    )
