import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from benchnav.core import part_lookup, registry
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.predictor import Oracle
from benchnav.models.quality import baselines, figures
from benchnav.models.quality.baselines import nearest_colour_accuracy
from benchnav.models.quality.measure import evaluate
from tests.commands import call
from tests.models.stub import ColourModel


@pytest.fixture(autouse=True)
def _colour_model(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(part_lookup, "_REGISTERED", {})
    registry.register("model", "colours", ColourModel)


def test_a_table_is_printed_and_nothing_written(
    dataset: TerrainDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert call("train", "evaluate", "colours", "--data", dataset.path) == 0
    out, err = capfd.readouterr()
    quality = dict(evaluate(ColourModel(), dataset))["test/hs"]
    (row,) = [line for line in out.splitlines() if line.startswith("test/hs")]
    for value in (
        quality.classes[0].ece,
        quality.traversability.nll,
        quality.traversability.coverage,
    ):
        assert f"{value:.4f}" in row
    assert f"test/hs {nearest_colour_accuracy(dataset, 'test/hs'):.4f}" in out
    assert (
        out.splitlines()[-1] == "to explain the columns, --out FOLDER writes quality.md"
    )
    assert max(map(len, out.splitlines())) <= 124
    assert err.splitlines() == ["splits: 0/2", "splits: 1/2", "splits: 2/2"]
    assert list(tmp_path.iterdir()) == []


def test_json_alone_is_written_for_other_programs(
    dataset: TerrainDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = tmp_path / "report.json"
    monkeypatch.setenv("HOME", str(tmp_path))
    assert (
        call(
            "train",
            "evaluate",
            "colours",
            "--data",
            dataset.path,
            "--json=~/report.json",
            "--seed",
            5,
        )
        == 0
    )
    found = json.loads(report.read_text())
    assert list(found["splits"]) == ["test/std", "test/hs"]
    assert found["dataset"] == {"id": dataset.id, "digest": dataset.digest}
    assert (found["model"], found["seed"]) == ("colours", 5)
    quality = dict(evaluate(ColourModel(), dataset, seed=5))["test/hs"]
    assert tuple(found["splits"]["test/hs"]["pit"]) == quality.traversability.pit
    assert found["splits"]["test/hs"]["accuracy"] == quality.classes[0].accuracy
    assert found["nearest_colour_accuracy"]["test/hs"] == nearest_colour_accuracy(
        dataset, "test/hs"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["report.json"]


def test_a_folder_holds_report_page_and_figures(
    dataset: TerrainDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("benchnav.models.quality.output.DPI", 30)
    out = tmp_path / "new" / "quality"
    asked = ["colours", "--data", dataset.path, "--out", out, "--maps", 1]
    draw, titles = figures.map_sheet_figure, []
    monkeypatch.setattr(
        figures,
        "map_sheet_figure",
        lambda *given: titles.append(given[-1]) or draw(*given),
    )
    assert call("train", "evaluate", *asked) == 0
    assert titles == ["model colours on dataset tiny-v1"] * 2
    assert {path.name for path in out.iterdir()} == {
        "quality.json",
        "quality.csv",
        "quality.md",
        "figures",
    }
    files = {path.name for path in (out / "figures").iterdir()}
    names = {
        "confusion",
        "reliability",
        "pit",
        "latent",
        "maps-test-std",
        "maps-test-hs",
    }
    assert files == {f"{name}.{kind}" for name in names for kind in ("png", "pdf")}
    printed = capfd.readouterr().out
    assert "no series" in printed
    assert (
        printed.splitlines()[-1]
        == f"columns and figures are explained in {out}/quality.md"
    )
    page = (out / "quality.md").read_text()
    assert all(f"(figures/{name}.png)" in page for name in names)
    assert "nearest colour" in page
    assert len(list(csv.DictReader((out / "quality.csv").open()))) == 2

    # Another evaluation takes its place only when asked to, and leaves no figure of the
    # first.
    assert (
        call("train", "evaluate", "oracle", "--data", dataset.path, "--out", out) == 2
    )
    assert "--overwrite" in capfd.readouterr().err
    assert json.loads((out / "quality.json").read_text())["model"] == "colours"
    assert (
        call(
            "train",
            "evaluate",
            "oracle",
            "--data",
            dataset.path,
            "--out",
            out,
            "--maps",
            0,
            "--overwrite",
        )
        == 0
    )
    assert {path.name for path in (out / "figures").iterdir()} == {"pit.png", "pit.pdf"}
    said = capfd.readouterr().out
    assert "predicts no classes" in said
    assert "no Gaussian processes" in said
    assert "nearest colour" not in said
    assert (
        "accuracy"
        not in json.loads((out / "quality.json").read_text())["splits"]["test/hs"]
    )


def test_a_series_is_drawn_where_there_is_one(
    dataset: TerrainDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchnav.models.quality.output.DPI", 30)
    held = dict(dataset.manifest["splits"])
    monkeypatch.setattr(
        TerrainDataset,
        "splits",
        property(lambda self: {**held, "test/hs-100": held["test/hs"]}),
    )
    read = TerrainDataset.read
    monkeypatch.setattr(
        TerrainDataset,
        "read",
        lambda self, split, *rest: read(self, split.removesuffix("-100"), *rest),
    )
    asked = [
        "oracle",
        "--data",
        dataset.path,
        "--splits",
        "[test/std,test/hs-100]",
        "--maps",
        0,
    ]
    assert call("train", "evaluate", *asked, "--out", tmp_path / "q") == 0
    assert (tmp_path / "q" / "figures" / "severity.png").is_file()
    assert list(
        json.loads((tmp_path / "q" / "quality.json").read_text())["series"]
    ) == ["test/hs"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["colour", "--data", "DATA"], "Did you mean 'colours'"),
        (["oracle", "--data", "nothing.h5"], "nothing.h5"),
        (["oracle", "--data", "DATA", "--splits", "[test/hg]"], "test/hg"),
        (["oracle", "--data", "DATA", "--json", "no/such/folder.json"], "no/such"),
        (["oracle", "--data", "DATA", "--json", "folder"], "folder"),
        (["oracle", "--data", "DATA", "--out", "folder"], "which is not an evaluation"),
        (
            ["oracle", "--data", "DATA", "--out", "folder/file/deeper/out"],
            "folder/file",
        ),
        (["oracle", "--data", "DATA", "--out", "x", "--maps", "-1"], "maps"),
        (
            ["oracle", "--data", "DATA", "--seed", "-1"],
            "Expected `seed` in 0–9223372036854775807, got -1.",
        ),
        (["oracle", "--data", "DATA", "--splits", "[]"], "Expected `splits` among "),
        (
            ["other", "--data", "DATA", "--out", "new/x", "--json", "y.json"],
            "trained on other classes",
        ),
    ],
)
def test_bad_input_is_refused_in_one_line_before_any_work(
    arguments: list[str],
    expected: str,
    dataset: TerrainDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    class Other(ColourModel):
        def __init__(self) -> None:
            super().__init__()
            self.class_names = ("a", "b")

    def never(*arguments: object) -> None:
        raise AssertionError("measured what was to be refused")

    registry.register("model", "other", Other)
    monkeypatch.setattr(Oracle, "predict_terrain", never)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "file").write_text("mine")
    assert (
        call(
            "train",
            "evaluate",
            *(str(dataset.path) if item == "DATA" else item for item in arguments),
        )
        == 2
    )
    out, err = capfd.readouterr()
    assert len(err.strip().splitlines()) == 1, err
    assert err.startswith("benchnav-train: error: ")
    assert expected in err
    assert out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]
    assert (tmp_path / "folder" / "file").read_text() == "mine"


def test_the_command_is_light_to_import() -> None:
    code = (
        "import sys, benchnav.models.quality.command; "
        "print(sorted({'torch', 'torchmetrics', 'matplotlib', 'pandas'} & set(sys.modules)))"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert ran.stdout.strip() == "[]"


def test_maps_that_the_model_was_trained_on_are_named(
    dataset: TerrainDataset,
    checkpoint_path: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    copy = Path(shutil.copy(dataset.path, tmp_path / "renamed.h5"))
    for splits, named in (
        ("[train,test/std]", "train (its train of tiny-v1):"),
        ("[test/std,valid]", "valid (its valid of tiny-v1):"),
        ("[test/std]", ""),
    ):
        report = tmp_path / "report.json"
        asked = ("--data", copy, "--splits", splits, "--json", report)
        assert call("train", "evaluate", checkpoint_path, *asked) == 0
        warned = [
            line
            for line in capfd.readouterr().out.splitlines()
            if "was trained" in line
        ]
        assert warned == [
            note
            for note in json.loads(report.read_text())["notes"]
            if "was trained" in note
        ]
        assert [line.partition("maps of ")[2][: len(named)] for line in warned] == [
            named
        ] * bool(named)
    assert (
        call("train", "evaluate", "colours", "--data", copy, "--splits", "[train]") == 0
    )
    assert "was trained" not in capfd.readouterr().out


def test_a_model_that_is_right_less_often_than_the_nearest_colour_is_told_so(
    dataset: TerrainDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("benchnav.models.quality.output.DPI", 30)
    shares = {"test/std": 0.999, "test/hs": 0.0}
    monkeypatch.setattr(
        baselines, "nearest_colour_accuracy", lambda _, split: shares[split]
    )
    line = (
        "warning: the model's accuracy is below that of the nearest colour on test/std"
    )
    out = tmp_path / "quality"
    assert (
        call(
            "train",
            "evaluate",
            "colours",
            "--data",
            dataset.path,
            "--out",
            out,
            "--maps",
            0,
        )
        == 0
    )
    assert line in capfd.readouterr().out.splitlines()
    assert line in (out / "quality.md").read_text().splitlines()
    shares["test/std"] = 0.0
    assert call("train", "evaluate", "colours", "--data", dataset.path) == 0
    assert "less often" not in capfd.readouterr().out
