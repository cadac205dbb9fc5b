"""The cards of what is shipped, the citation and the versions say what files say: no
number of theirs is their own.
"""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

import benchnav
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.checkpoint import digests_of
from benchnav.models.checkpoint_folders import find_checkpoint
from benchnav.models.predictor import load_model

ROOT = Path(__file__).parents[1]
MODELS = [
    ROOT / "checkpoints" / name
    for name in ("paper-v1", "stakes-v1", "stakes-v1-masked")
]
CARDS = [
    *(ROOT / "datasets" / f"{name}-test.md" for name in ("paper-v1", "stakes-v1")),
    *(folder / "README.md" for folder in MODELS),
]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def read_card(path: Path) -> tuple[dict[str, Any], str]:
    before, head, body = path.read_text().split("---\n", 2)
    assert before == ""
    return yaml.safe_load(head), body


@pytest.mark.parametrize(
    "path", CARDS, ids=lambda path: path.relative_to(ROOT).as_posix()
)
def test_a_card_has_what_hubs_and_people_look_for(path: Path) -> None:
    head, body = read_card(path)
    assert head["license"] == PROJECT["license"].lower()
    assert head["tags"]
    for title in (
        "## How it was made",
        "## What it is for",
        "## What it is not for",
        "## Licence and citation",
    ):
        assert title in body
    for link in re.findall(r"\]\(([^)#]+)", body):
        assert (path.parent / link).exists(), link


@pytest.mark.parametrize("path", MODELS, ids=lambda path: path.name)
def test_what_a_model_card_measures_is_in_the_readme_of_the_models(path: Path) -> None:
    _, body = read_card(path / "README.md")
    known = (ROOT / "checkpoints" / "README.md").read_text()
    rows = re.findall(r"^\| test/.*\|$", body, re.MULTILINE)
    assert len(rows) == 3
    for row in rows:
        split, *numbers = [cell.strip() for cell in row.strip("|").split("|")]
        wanted = [line for line in known.splitlines() if line.startswith(f"| {split} ")]
        assert any(
            set(numbers) <= {cell.strip() for cell in line.split("|")}
            for line in wanted
        ), row
    for command in re.findall(r"^benchnav-.*$", body, re.MULTILINE):
        assert command in known


@pytest.mark.parametrize("path", MODELS, ids=lambda path: path.name)
def test_a_card_in_its_folder_does_not_change_a_model(path: Path) -> None:
    assert find_checkpoint(str(path)) == path
    assert load_model(path).class_names
    assert set(digests_of(path)) == {
        "config.json",
        "classifier.safetensors",
        "gp.safetensors",
    }


@pytest.mark.parametrize("name", ["paper-v1", "stakes-v1"])
def test_a_dataset_card_counts_maps_as_the_file_does(name: str) -> None:
    dataset = TerrainDataset(ROOT / "datasets" / f"{name}-test.h5")
    _, body = read_card(ROOT / "datasets" / f"{name}-test.md")
    told = {
        split: int(maps)
        for split, maps in re.findall(r"^\| `(\S+)` \| (\d+) \|", body, re.MULTILINE)
    }
    assert told == {split: entry["maps"] for split, entry in dataset.splits.items()}
    assert f"{sum(told.values())} synthetic maps" in body
    (command,) = re.findall(r"^benchnav-.*$", body, re.MULTILINE)
    assert command in (ROOT / "datasets" / "README.md").read_text()
    assert f"seed, {dataset.recipe.seed}." in body


def test_the_citation_is_of_this_version_and_of_the_paper() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0"
    assert (citation["version"], citation["license"]) == (
        PROJECT["version"],
        PROJECT["license"],
    )
    assert [author["name"] for author in citation["authors"]] == [
        item["name"] for item in PROJECT["authors"]
    ]
    (paper,) = citation["references"]
    assert [author["family-names"] for author in paper["authors"]] == [
        "Endo",
        "Honda",
        "Ishigami",
    ]
    assert (paper["year"], paper["identifiers"][0]["value"]) == (
        2024,
        "arXiv:2405.13318",
    )


def test_no_shipped_weights_began_at_those_of_others() -> None:
    page = (ROOT / "docs" / "reference" / "licences.md").read_text()
    for folder in MODELS:
        parts = json.loads((folder / "config.json").read_text())["parts"]
        assert parts["classifier"]["config"]["pretrained"] is False
        assert f"`{folder.name}`" in page
    assert '`config.json` of each checkpoint says `"pretrained": false`' in page
    assert PROJECT["license"] in page


def test_one_version_and_one_date_are_everywhere() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    newest = re.search(
        r"^## (?!Unreleased)(.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE
    )
    (entry,) = re.findall(
        r"@software\{.*?^\}", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL
    )
    date = citation["date-released"]
    assert benchnav.__version__ == citation["version"] == PROJECT["version"]
    assert newest
    assert newest[1] == f"{PROJECT['version']} ({date})"
    assert f"version = {{{PROJECT['version']}}}" in entry
    assert f"year = {{{date.year}}}" in entry
    assert f"title = {{{citation['title']}}}" in entry
