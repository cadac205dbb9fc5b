import csv
import io
import json
import math
from dataclasses import replace

import pytest
import torch

from benchnav.core.quantiles import LEVELS, QuantileDistribution
from benchnav.core.tables import to_terminal
from benchnav.core.terrain import Observation
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.base import TraversabilityModel
from benchnav.models.predictor import Oracle
from benchnav.models.quality.figures import QualityData, quality_figures
from benchnav.models.quality.measure import Quality, evaluate
from benchnav.models.quality.output import Page
from benchnav.models.quality.report import (
    COLUMNS,
    LOOK_ALIKES,
    numbers,
    quality_csv,
    quality_json,
    quality_table,
)
from tests.models.stub import ColourModel

Qualities = dict[str, Quality]


def page_of(qualities: Qualities) -> str:
    return Page(
        title="title", tables=[quality_table("title", qualities, all_columns=True)]
    ).to_markdown()


@pytest.fixture(scope="module")
def qualities(dataset: TerrainDataset) -> Qualities:
    measured = dict(evaluate(ColourModel(), dataset))
    return {
        "test/std": measured["test/std"],
        "test/hs-050": measured["test/hs"],
        "valid": measured["test/hs"],
    }


def test_the_table_has_a_row_a_split_and_fits(qualities: Qualities) -> None:
    wide = {"test/a-long-name@0.25": qualities["valid"], **qualities}
    lines = to_terminal(quality_table("title", wide), width=124).splitlines()
    assert len(lines) == 4 + len(wide)
    for split, line in zip(wide, lines[4:], strict=True):
        assert line.split()[0] == split
        assert f"{wide[split].classes[0].mutual_information_auroc:.4f}" in line
        assert f"{wide[split].traversability.tail_rate:.4f}" in line
    assert not any("…" in line for line in lines)


def test_what_there_is_not_is_left_out_or_dashed(
    qualities: Qualities, dataset: TerrainDataset
) -> None:
    oracle = dict(evaluate(Oracle(), dataset, ["valid"]))
    page = page_of(oracle)
    assert "mIoU" not in page
    assert f"{oracle['valid'].traversability.crps:.4f}" in page
    nameless = replace(qualities["valid"].classes[0], entropy_auroc=float("nan"))
    mixed = {**qualities, "valid": replace(qualities["valid"], classes=(nameless,))}
    (row,) = [line for line in page_of(mixed).splitlines() if "| valid |" in line]
    assert "–" in row


def test_json_holds_everything_and_nothing_that_is_no_json(
    qualities: Qualities,
) -> None:
    single = replace(qualities["valid"].classes[0], mutual_information=float("nan"))
    whole = {**qualities, "valid": replace(qualities["valid"], classes=(single,))}

    def refuse(text: str) -> None:
        raise AssertionError(text)

    found = json.loads(quality_json({"model": "m"}, whole), parse_constant=refuse)
    assert found["model"] == "m"
    assert found["splits"]["valid"]["mutual_information"] is None
    assert found["series"] == {
        "test/hs": [
            {"severity": 0.0, "split": "test/std"},
            {"severity": 0.5, "split": "test/hs-050"},
        ]
    }
    split, quality = found["splits"]["test/std"], qualities["test/std"]
    assert split["maps"] == quality.maps
    assert split["accuracy"] == quality.classes[0].accuracy
    assert tuple(split["pit"]) == quality.traversability.pit
    assert (
        sum(map(sum, split["confusion"]))
        == sum(split["reliability"]["cells"])
        == sum(split["pit"])
    )
    assert set(COLUMNS) - set(LOOK_ALIKES) <= set(split)


def test_csv_has_scenario_severity_and_every_number(qualities: Qualities) -> None:
    rows = list(csv.DictReader(io.StringIO(quality_csv(qualities))))
    assert [(row["split"], row["scenario"], row["severity"]) for row in rows] == [
        ("test/std", "", "0"), ("test/hs-050", "test/hs", "0.5"), ("valid", "", "")
    ]  # fmt: skip
    for row in rows:
        quality = qualities[row["split"]]
        assert row["maps"] == str(quality.maps)
        found = {name: float(row[name]) for name in COLUMNS if name not in LOOK_ALIKES}
        assert found == pytest.approx(numbers(quality), rel=1e-5)


def test_the_page_shows_table_notes_and_figures(qualities: Qualities) -> None:
    figures = [
        ("figures/pit.png", "PIT", "What it shows."),
        ("figures/maps-a.png", "Maps of a", "Maps."),
    ]
    page = Page(
        title="title",
        tables=[quality_table("title", qualities, all_columns=True)],
        notes=["a note"],
    )
    lines = page.to_markdown(figures).splitlines()
    assert lines[0] == "# title"
    header, rule, *rows = [line for line in lines if line.startswith("|")]
    assert len({line.count("|") for line in (header, rule, *rows)}) == 1
    assert len(rows) == len(qualities)
    images = ["![PIT](figures/pit.png)", "![Maps of a](figures/maps-a.png)"]
    assert {"a note", *images} <= set(lines)
    for image in images:
        under = lines[lines.index(image) + 2]
        assert under.startswith(f"**{image[2 : image.index(']')]}.** ")
        assert under.endswith(".")


def test_every_column_of_the_page_is_explained_and_no_other(
    qualities: Qualities, dataset: TerrainDataset
) -> None:
    oracle = dict(evaluate(Oracle(), dataset, ["valid"]))
    for measured in (qualities, oracle):
        lines = page_of(measured).splitlines()
        headings = [cell.strip() for cell in lines[2].strip("|").split("|")]
        explained = [
            line[4:].partition("**: ") for line in lines if line.startswith("- **")
        ]
        assert [heading for heading, _, _ in explained] == [
            h for h in headings if h != "maps"
        ]
        assert all(sentence.endswith(".") for _, _, sentence in explained)


class Quantiles(TraversabilityModel):
    """A quantile distribution, which has no density."""

    def predict(self, observation: Observation) -> QuantileDistribution:
        share = observation.rgb.float().mean(1, keepdim=True) / 255
        return QuantileDistribution(share * torch.tensor(LEVELS).view(-1, 1, 1))


def test_the_likelihood_of_what_has_no_density_is_a_dash_and_null(
    dataset: TerrainDataset,
) -> None:
    found = dict(evaluate(Quantiles(), dataset, ["valid"]))
    assert math.isnan(found["valid"].traversability.nll)
    assert 0 < found["valid"].traversability.crps < 1
    table = quality_table("title", found)
    assert table.rows[0][table.headings.index(COLUMNS["nll"][0])] == "–"
    assert json.loads(quality_json({}, found))["splits"]["valid"]["nll"] is None
    assert next(csv.DictReader(io.StringIO(quality_csv(found))))["nll"] == ""
    data = QualityData(
        title="title", model=Quantiles(), dataset=dataset, qualities=found, maps=1
    )
    assert [figure.name for figure in quality_figures(data)] == ["pit", "maps-valid"]
    for figure in quality_figures(data):
        figure(data)
