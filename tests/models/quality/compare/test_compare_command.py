import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from benchnav.core import part_lookup, registry
from benchnav.core.quantiles import LEVELS, QuantileDistribution
from benchnav.core.terrain import Observation
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.base import TraversabilityModel
from benchnav.models.predictor import Oracle
from benchnav.models.quality import baselines, laboratory
from benchnav.models.quality.measure import evaluate, measure_split
from tests.commands import call
from tests.models.stub import ColourModel

FILES = {"compare.json", "compare.csv", "differences.csv", "compare.md", "figures"}


class Vague(ColourModel):
    """Knows hardly more than that there are classes."""

    def __init__(self) -> None:
        super().__init__((3000.0,))


class Quantiles(TraversabilityModel):
    """λ spread evenly, without classes or density."""

    def predict(self, observation: Observation) -> QuantileDistribution:
        shape = (len(observation.rgb), 1, *observation.grid.shape)
        return QuantileDistribution(
            torch.tensor(LEVELS).view(-1, 1, 1) * torch.ones(shape)
        )


class Foreign(ColourModel):
    """Knows other classes than the maps have."""

    def __init__(self) -> None:
        super().__init__()
        self.class_names = ("a", "b")


@pytest.fixture(autouse=True)
def _models(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(part_lookup, "_REGISTERED", {})
    monkeypatch.setattr("benchnav.models.quality.output.DPI", 30)
    for name, model in (
        ("colours", ColourModel), ("vague", Vague), ("quantiles", Quantiles), ("foreign", Foreign),
    ):  # fmt: skip
        registry.register("model", name, model)


def test_a_table_is_printed_and_nothing_written(
    dataset: TerrainDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert call("train", "compare", "colours", "vague", "--data", dataset.path) == 0
    out, err = capfd.readouterr()
    rows = [line.split() for line in out.splitlines() if line.startswith("test/")]
    named = [("colours", "vague", "oracle", "ideal")] * 2
    assert [row[1] for row in rows] == [name for names in named for name in names]
    assert [row[0] for row in rows] == ["test/std"] * 4 + ["test/hs"] * 4
    assert [row[2] for row in rows[2:4]] == ["†", "†"]
    for model, row in ((ColourModel(), rows[4]), (Vague(), rows[5])):
        quality = dict(evaluate(model, dataset))["test/hs"]
        for value in (
            quality.classes[0].miou,
            quality.traversability.crps,
            quality.traversability.nll,
        ):
            assert f"{value:.4f}" in [cell.rstrip("*") for cell in row]
    assert err.splitlines()[-1] == "models and splits: 8/8"
    assert "too few maps for any difference to be significant: test/std, test/hs" in out
    assert "statistical units: test/std 2 maps, test/hs 2 maps" in out
    assert "with 1 thread" in out or "threads" in out
    assert list(tmp_path.iterdir()) == []


def test_a_folder_holds_numbers_differences_page_and_figures(
    dataset: TerrainDataset,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "new" / "comparison"
    asked = [
        "vague",
        "colours",
        "quantiles",
        "--data",
        dataset.path,
        "--splits",
        "[train]",
        "--out",
        out,
    ]
    assert call("train", "compare", *asked, "--seed", 3) == 0
    assert {path.name for path in out.iterdir()} == FILES
    names = ("measures", "calibration", "sparsification")
    assert {path.name for path in (out / "figures").iterdir()} == {
        f"{name}.{kind}" for name in names for kind in ("png", "pdf")
    }
    found = json.loads((out / "compare.json").read_text())
    assert (found["seed"], found["device"]) == (3, "cpu")
    assert found["threads"] == torch.get_num_threads()
    assert found["dataset"] == {"id": dataset.id, "digest": dataset.digest}
    assert list(found["models"]) == ["vague", "colours", "quantiles", "oracle", "ideal"]
    assert found["models"]["oracle"]["prediction_ms"] is None
    assert found["models"]["colours"]["prediction_ms"] > 0
    split = found["splits"]["train"]
    assert split["units"] == 10
    own = split["models"]["colours"]
    quality = measure_split(ColourModel(), dataset, "train", 3)
    assert own["pit"] == list(quality.traversability.pit)
    assert own["crps"] == pytest.approx(quality.traversability.crps)
    assert own["accuracy"] == pytest.approx(quality.classes[0].accuracy)
    assert own["crps_low"] < own["crps"] < own["crps_high"]
    assert split["models"]["quantiles"]["nll"] is None
    assert (
        "accuracy" not in split["models"]["quantiles"]
        or split["models"]["quantiles"]["accuracy"] is None
    )
    assert split["models"]["oracle"]["rmse_expected"] == 0
    assert len(own["sparsification"]["by_width"]) == 50

    rows = list(csv.DictReader((out / "compare.csv").open()))
    assert [row["model"] for row in rows] == list(found["models"])
    assert [row["privileged"] for row in rows] == ["False"] * 3 + ["True"] * 2
    assert float(rows[1]["pinball"]) == pytest.approx(own["pinball"], rel=1e-5)
    assert float(rows[1]["tail_rate_95"]) == pytest.approx(
        own["tail_rate_95"], rel=1e-5
    )
    assert rows[2]["nll"] == rows[2]["accuracy"] == rows[3]["prediction_ms"] == ""
    pairs = list(csv.DictReader((out / "differences.csv").open()))
    both = [
        row
        for row in pairs
        if (row["one"], row["other"], row["measure"]) == ("vague", "colours", "crps")
    ]
    assert float(both[0]["difference"]) > 0
    assert float(both[0]["p_holm"]) < 0.05

    page = (out / "compare.md").read_text()
    assert all(f"(figures/{name}.png)" in page for name in names)
    headings = [cell.strip() for cell in page.splitlines()[2].strip("|").split("|")]
    explained = [
        line[4:].partition("**: ")[0]
        for line in page.splitlines()
        if line.startswith("- **")
    ]
    assert headings == explained[: len(headings)]
    assert "## Differences from the best model" in page
    (row,) = [
        line for line in page.splitlines() if line.startswith("| train | colours")
    ]
    assert f"**{own['crps']:.4f}**" in row
    (row,) = [line for line in page.splitlines() if line.startswith("| train | vague")]
    assert (
        "**" not in row.partition("0.9")[0]
        or f"**{split['models']['vague']['crps']:.4f}**" not in row
    )

    # Another comparison takes its place only when asked to.
    assert (
        call("train", "compare", "colours", "--data", dataset.path, "--out", out) == 2
    )
    assert "--overwrite" in capfd.readouterr().err
    assert (
        call(
            "train",
            "compare",
            "colours",
            "--data",
            dataset.path,
            "--out",
            out,
            "--overwrite",
        )
        == 0
    )
    assert list(json.loads((out / "compare.json").read_text())["splits"]) == [
        "test/std",
        "test/hs",
    ]
    assert "Differences" not in (out / "compare.md").read_text()


def test_seed_and_device_reach_the_measurement(
    dataset: TerrainDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pits = {}
    for seed in (0, 7):
        out = tmp_path / str(seed)
        asked = (
            "colours",
            "--data",
            dataset.path,
            "--splits",
            "[valid]",
            "--out",
            out,
            "--device",
            "cpu",
        )
        assert call("train", "compare", *asked, "--seed", seed) == 0
        models = json.loads((out / "compare.json").read_text())["splits"]["valid"][
            "models"
        ]
        pits[seed] = models["colours"]["pit"]
        assert pits[seed] == list(
            measure_split(ColourModel(), dataset, "valid", seed).traversability.pit
        )
    assert pits[0] != pits[7]
    asked_for: list[torch.device] = []
    measured = measure_split
    monkeypatch.setattr(laboratory, "find_device", lambda name: torch.device("cpu", 0))

    def spy(
        model: TraversabilityModel,
        data: TerrainDataset,
        split: str,
        seed: int,
        place: torch.device,
        **how: bool,
    ):  # type: ignore[no-untyped-def]
        asked_for.append(place)
        return measured(model, data, split, seed, torch.device("cpu"), **how)

    monkeypatch.setattr("benchnav.models.quality.measurement.measure_split", spy)
    assert (
        call(
            "train", "compare", "colours", "--data", dataset.path, "--splits", "[valid]"
        )
        == 0
    )
    assert asked_for == [torch.device("cpu", 0)] * 3


def test_groups_of_maps_are_the_units(
    dataset: TerrainDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    read, names = TerrainDataset.read, dataset.field_names

    def with_groups(self: TerrainDataset, split: str, indices=None, fields=None):  # type: ignore[no-untyped-def]
        if fields == ("group",):
            return {"group": np.arange(self.map_count(split)) // 2}
        return read(self, split, indices, fields)

    monkeypatch.setattr(TerrainDataset, "read", with_groups)
    monkeypatch.setattr(
        TerrainDataset, "field_names", property(lambda self: (*names, "group"))
    )
    out = tmp_path / "out"
    assert (
        call(
            "train",
            "compare",
            "colours",
            "--data",
            dataset.path,
            "--splits",
            "[train]",
            "--out",
            out,
        )
        == 0
    )
    assert (
        json.loads((out / "compare.json").read_text())["splits"]["train"]["units"] == 5
    )
    assert "train 10 maps in 5 groups" in capfd.readouterr().out


def test_a_model_of_other_classes_is_compared_by_traversability_and_said_to_be(
    dataset: TerrainDataset, capfd: pytest.CaptureFixture[str]
) -> None:
    assert (
        call(
            "train",
            "compare",
            "colours",
            "foreign",
            "--data",
            dataset.path,
            "--splits",
            "[valid]",
        )
        == 0
    )
    out = capfd.readouterr().out
    assert (
        "foreign is compared only by λ, since its classes differ from those of the maps"
        in out
    )
    first, second = (
        line.split()
        for line in out.splitlines()
        if line.startswith("valid ") and "†" not in line
    )
    assert second[2:4] == ["–", "–"]
    assert first[4:10] == second[4:10]  # the same λ


def test_where_the_truth_is_unknown_no_model_is_given_the_class_table_for_it(
    dataset: TerrainDataset,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    truth = TerrainDataset.truth_of
    monkeypatch.setattr(
        TerrainDataset,
        "truth_of",
        lambda self, split: "unknown" if split == "valid" else truth(self, split),
    )
    asked = ("colours", "--data", dataset.path, "--splits", "[valid,test/std]")
    assert call("train", "compare", *asked) == 0
    out = capfd.readouterr().out
    rows = [
        line.split()[:2]
        for line in out.splitlines()
        if line.startswith(("valid ", "test/std ")) and "0." in line
    ]
    assert rows == [
        ["valid", "colours"],
        *(["test/std", name] for name in ("colours", "oracle", "ideal")),
    ]
    assert (
        "oracle and ideal are left out on valid, where the true distribution is unknown"
        in out
    )
    assert (
        "RMSE λ" in " ".join(out.split())
        or "unknown on valid: RMSE E[λ] is a dash" in out
    )


def test_a_model_that_is_worse_than_none_is_told_so(
    dataset: TerrainDataset,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(baselines, "nearest_colour_accuracy", lambda _, split: 0.999)
    monkeypatch.setattr(baselines, "climatology_crps", lambda _, split: 0.15)
    assert (
        call(
            "train",
            "compare",
            "colours",
            "quantiles",
            "--data",
            dataset.path,
            "--splits",
            "[valid]",
        )
        == 0
    )
    out = capfd.readouterr().out.splitlines()
    assert (
        "colours: warning: the model's accuracy is below that of the nearest colour on valid"
        in out
    )
    worse = "warning: the model's CRPS is worse than that of one distribution for all cells on valid"
    crps = {
        name: measure_split(model, dataset, "valid").traversability.crps
        for name, model in (("colours", ColourModel()), ("quantiles", Quantiles()))
    }
    assert [f"{name}: {worse}" in out for name in crps] == [
        score > 0.15 for score in crps.values()
    ]
    assert crps["colours"] < 0.15 < crps["quantiles"]
    assert not any(line.startswith("oracle: ") for line in out)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "at least one model"),
        (["colours", "colours"], "models that differ"),
        (["colour"], "Did you mean 'colours'"),
        (["colours", "--out", "folder"], "is not a comparison"),
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
    def never(*arguments: object) -> None:
        raise AssertionError("measured what was to be refused")

    monkeypatch.setattr(Oracle, "predict_terrain", never)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "file").write_text("mine")
    assert call("train", "compare", *arguments, "--data", dataset.path) == 2
    out, err = capfd.readouterr()
    assert len(err.strip().splitlines()) == 1, err
    assert err.startswith("benchnav-train: error: ")
    assert expected in err
    assert out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]
