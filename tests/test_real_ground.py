"""Real ground from rasters to a measured model, where some cells have no class."""

import json
import re
import shlex
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from benchnav.core.errors import ConfigError
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.checkpoint import load_checkpoint
from benchnav.models.quality import output
from tests.commands import call
from tests.datagen.dem.rasters import SOUTH, WEST, centres, rough, write

rasterio = pytest.importorskip("rasterio")

ROWS, COLUMNS = 32, 32 * 12
QUICK = (
    "--gp.epochs", "1", "--gp.epoch_steps", "5", "--classifier.max_epochs", "1", "--classifier.batch_size", "2",
    "--trainer.precision", "32-true",
)  # fmt: skip


def test_a_model_is_trained_and_measured_on_ground_that_is_labelled_in_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    generator = np.random.default_rng(0)
    classes = generator.integers(0, 3, (ROWS, COLUMNS)).astype(np.uint8)
    photo = np.stack([60 + 60 * classes, 90 + 30 * classes, 200 - 60 * classes]).astype(
        np.uint8
    )
    classes[:8] = 200  # the northern quarter
    write(tmp_path / "dem.tif", rough(ROWS, COLUMNS))
    write(tmp_path / "classes.tif", classes, nodata=200)
    write(tmp_path / "photo.tif", photo)
    rasters = ("dem.tif", "--classes", "classes.tif", "--photo", "photo.tif")
    splits = ("--splits", "train:0.4,valid:0.3,test/site:0.3", "--recipe", "tiny-v1")
    assert call("datagen", "import-dem", *rasters, *splits, "--out", "real.h5") == 0
    dataset = TerrainDataset("real.h5")
    for split in dataset.splits:
        unlabelled = dataset.read(split)["class_id"] == UNLABELLED
        assert unlabelled[:, 24:].all()
        assert not unlabelled[:, :24].any()
    assert call("datagen", "validate", "real.h5") == 0
    assert call("datagen", "show", "real.h5") == 0
    assert call("datagen", "preview", "real.h5", "--out", "sheet.png") == 0
    assert call("train", "all", "--data", "real.h5", "--out", "mine", *QUICK) == 0
    out = ("--out", "quality")
    assert call("train", "evaluate", "mine", "--data", "real.h5", *out) == 0
    (quality,) = (tmp_path / "quality").glob("*.json")
    measured = json.loads(quality.read_text())["splits"]["test/site"]
    maps = dataset.map_count("test/site")
    assert np.sum(measured["confusion"]) == maps * 24 * 32
    capfd.readouterr()
    suite = (
        "--planners",
        "[straight]",
        "--risks",
        "[mean]",
        "--scenarios",
        "[site]",
        "--model",
        "mine",
        "--maps",
        "0",
    )
    assert call("eval", "run", "--data", "real.h5", *suite, "--out", "run") == 2
    (line,) = capfd.readouterr().err.strip().splitlines()
    assert "Expected maps with a class in each cell, got maps with unlabelled" in line
    assert not (tmp_path / "run").exists()
    with pytest.raises(ConfigError, match="a class in each cell"):
        gymnasium.make(
            "benchnav/OffRoad-v0", data="real.h5", split="train", world="paper"
        )


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two classes of measured λ near 0.2 and 0.9, which is not what the recipe's class
    table says of them.

    The first map of the split `test/site` has no class, but colours and a measured λ.
    """
    folder, generator = tmp_path_factory.mktemp("site"), np.random.default_rng(1)
    classes = np.repeat(
        generator.integers(0, 2, (ROWS // 8, COLUMNS // 8)), 8, 0
    ).repeat(8, 1)
    value = np.clip(
        np.where(classes == 0, 0.2, 0.9)
        + 0.03 * generator.standard_normal(classes.shape),
        0,
        1,
    )
    photo = np.stack(
        [60 + 150 * classes, 90 + 30 * classes, 200 - 60 * classes]
    ).astype(np.uint8)
    labels = classes.astype(np.uint8)
    labels[:, 8 * 32 : 9 * 32] = 200
    write(folder / "dem.tif", rough(ROWS, COLUMNS))
    write(folder / "classes.tif", labels, nodata=200)
    write(folder / "photo.tif", photo)
    write(folder / "value.tif", value.astype(np.float32))
    rasters = (
        "dem.tif",
        "--classes",
        "classes.tif",
        "--photo",
        "photo.tif",
        "--traversability",
        "value.tif",
    )
    splits = ("--splits", "train:0.4,valid:0.2,test/site:0.4", "--recipe", "tiny-v1")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert call("datagen", "import-dem", *rasters, *splits, "--out", "real.h5") == 0
        gp = (
            "--gp.epochs",
            "2",
            "--gp.epoch_steps",
            "10",
            "--classifier.encoder_depth",
            "3",
        )
        assert (
            call("train", "all", "--data", "real.h5", "--out", "mine", *QUICK, *gp) == 0
        )
    return folder


def test_nothing_is_scored_against_a_truth_that_is_unknown(
    site: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(site)
    dataset = TerrainDataset("real.h5")
    assert dataset.truth_of("test/site") == "unknown"
    metrics = load_checkpoint("mine").part("gp").metrics
    assert set(metrics) == {"valid_nll"}
    assert metrics["valid_nll"] < -1
    drawn: dict[str, list[object]] = {}

    def save(figure: Figure, path: Path, dpi: float) -> None:
        texts = [text.get_text() for text in figure.findobj(Text)]
        drawn[path.stem] = [texts, [panel.get_label() for panel in figure.axes]]

    monkeypatch.setattr(output, "save_twice", save)
    for model in ("mine", "oracle"):
        out = ("--out", tmp_path / model, "--maps", 1)
        assert call("train", "evaluate", model, "--data", "real.h5", *out) == 0
        said, _ = capfd.readouterr()
        page = (tmp_path / model / "quality.md").read_text()
        for text in (said, page):
            assert (
                "the true distribution of λ is unknown on test/site: RMSE E[λ] is a dash"
                in text
            )
            assert "are computed against measured λ" in text
            assert (
                "this model predicts from the class table of the recipe" in text
            ) == (model == "oracle")
        found = json.loads((tmp_path / model / "quality.json").read_text())
        assert found["truth"] == {"test/site": "unknown"}
        assert found["splits"]["test/site"]["rmse_expected"] is None
        headings, _, row = page.splitlines()[2:5]
        columns = [cell.strip() for cell in headings.split("|")]
        assert row.split("|")[columns.index("RMSE E[λ]")].strip() == "–"
    texts, _ = drawn["latent"]
    assert "GP mean" in texts
    assert not [text for text in texts if "true" in text or "(0" in text]
    _, panels = drawn["maps-test-site"]
    assert {"observed 0", "expected 0", "error_observed 0"} <= set(panels)
    assert not {"expected_true 0", "error 0"} & set(panels)


def test_a_map_without_labels_but_with_a_measured_traversability_is_learned_from(
    site: Path,
) -> None:
    dataset = TerrainDataset(site / "real.h5")
    labels = dataset.read("test/site", fields=["class_id", "traversability"])
    (bare,) = np.flatnonzero((labels["class_id"] == UNLABELLED).all(axis=(1, 2)))
    assert np.isfinite(labels["traversability"][bare]).all()
    reasons = dataset.splits["test/site"]["parts"][0]["source"]["left_out"]
    assert reasons["missing_classes"] == 0


def test_lambda_that_the_class_table_drew_is_not_called_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "dem.tif", rough(ROWS, 32 * 3))
    assert (
        call(
            "datagen",
            "import-dem",
            "dem.tif",
            "--recipe",
            "tiny-v1",
            "--out",
            "real.h5",
        )
        == 0
    )
    capfd.readouterr()
    assert call("train", "evaluate", "oracle", "--data", "real.h5") == 0
    said = capfd.readouterr().out
    assert "λ that is at least partly drawn from the class table, not measured" in said
    # Beside such ground the truth of what a recipe made is as well known as before.
    made = (
        "create",
        "tiny-v1",
        "--splits",
        "[test/std]",
        "--first",
        1,
        "--out",
        "made.h5",
    )
    assert call("datagen", *made) == 0
    assert call("datagen", "merge", "made.h5", "real.h5", "--out", "mixed.h5") == 0
    capfd.readouterr()
    out = ("--out", tmp_path / "std", "--maps", 1)
    assert (
        call(
            "train",
            "evaluate",
            "oracle",
            "--data",
            "mixed.h5",
            "--splits",
            "[test/std]",
            *out,
        )
        == 0
    )
    assert "unknown" not in capfd.readouterr().out
    found = json.loads((tmp_path / "std" / "quality.json").read_text())
    assert found["truth"] == {"test/std": "generated"}
    assert found["splits"]["test/std"]["rmse_expected"] == 0


@pytest.mark.parametrize("cell", [0.8, 0.4, 0.2])
def test_the_page_on_real_ground_is_right_to_the_letter(
    cell: float,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    # The rasters of its first command, on 5 maps of 64 cells, and an elevation model
    # with two cells to spare.
    page = (Path(__file__).parent.parent / "docs/how-to/real-ground.md").read_text()
    block = re.search(r"```sh\nbenchnav-datagen (import-dem .*?)```", page, re.DOTALL)
    assert block
    words = shlex.split(block[1].replace("\\\n", " "))
    monkeypatch.chdir(tmp_path)
    generator = np.random.default_rng(3)
    classes = generator.choice(
        np.array([1, 2, 9], np.uint8), (64, 320), p=[0.6, 0.3, 0.1]
    )
    photo = generator.integers(0, 256, (3, 64, 320), dtype=np.uint8)
    measured, canopy = (
        generator.uniform(0, 1, (64, 320)).astype(np.float32) for _ in range(2)
    )
    spare = round(64 * 0.4 / cell) + 4, round(320 * 0.4 / cell) + 4
    x, y = centres(*spare, cell)
    write(
        tmp_path / "site.tif",
        500 + 0.3 * x + 0.1 * y,
        cell,
        offset=(-2 * cell, -2 * cell),
    )
    for name, values in (
        ("cover", classes),
        ("ortho", photo),
        ("driven", measured),
        ("canopy", canopy),
    ):
        write(tmp_path / f"{name}.tif", values, 0.4)
    # Without an origin the maps begin in the spare cells, and the command says where to
    # begin; or they begin there.
    call("datagen", *words)
    said, _ = capfd.readouterr()
    origin = f"[{WEST:.10g},{SOUTH:.10g}]"
    begins_there = f"from the south-west corner {origin} (" in said
    assert begins_there == (cell == 0.8)
    assert set(re.findall(r"--origin '(.*?)'", said)) == (
        set() if begins_there else {origin}
    )
    assert call("datagen", *words, "--origin", origin, "--overwrite") == 0
    said, _ = capfd.readouterr()
    assert f"from the south-west corner {origin} (" in said
    dataset = TerrainDataset("datasets/site-v1.h5")
    names = [kind.name for kind in dataset.recipe.classes]
    indices = {1: names.index("gravel"), 2: names.index("scree"), 9: UNLABELLED}
    expected = {
        "rgb": photo,
        "class_id": np.vectorize(indices.get)(classes),
        "vegetation_m": canopy,
        "traversability": measured,
    }
    for split, entry in dataset.splits.items():
        source, maps = entry["parts"][0]["source"], dataset.read(split)
        assert source["origin_m"] == [WEST, SOUTH]
        for index, number in enumerate(source["kept"]):
            for name, values in expected.items():
                tile = values[..., ::-1, :][..., 64 * number : 64 * number + 64]
                np.testing.assert_allclose(maps[name][index], tile, atol=2.0**-16)
            np.testing.assert_allclose(
                maps["slope_deg"][index],
                np.degrees(np.arctan(np.hypot(0.3, 0.1))),
                atol=0.02,
            )
        unlabelled = (maps["class_id"] == UNLABELLED).sum()
        cells = maps["class_id"].size
        assert unlabelled > 0
        assert (
            f"unlabelled in {split}: {unlabelled} of {cells} cells, on {len(maps['rgb'])} of {len(maps['rgb'])}"
            in said
        )
