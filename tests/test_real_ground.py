"""Real ground from rasters to a measured model, where some cells have no class."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from benchnav.datagen.cli import main as datagen
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.schema import UNLABELLED
from benchnav.errors import ConfigError
from benchnav.eval.cli import main as evaluate
from benchnav.models.cli import main as train
from tests.datagen.dem.rasters import rough, write

rasterio = pytest.importorskip("rasterio")

ROWS, COLUMNS = 32, 32 * 12
QUICK = (
    "--gp.epochs", "1", "--gp.epoch_steps", "5", "--classifier.max_epochs", "1", "--classifier.batch_size", "2",
    "--trainer.precision", "32-true",
)  # fmt: skip


def call(monkeypatch: pytest.MonkeyPatch, main: Callable[[], None], *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["benchnav", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


def test_a_model_is_trained_and_measured_on_ground_that_is_labelled_in_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    generator = np.random.default_rng(0)
    classes = generator.integers(0, 3, (ROWS, COLUMNS)).astype(np.uint8)
    photo = np.stack([60 + 60 * classes, 90 + 30 * classes, 200 - 60 * classes]).astype(np.uint8)
    classes[:8] = 200  # the northern quarter
    write(tmp_path / "dem.tif", rough(ROWS, COLUMNS))
    write(tmp_path / "classes.tif", classes, nodata=200)
    write(tmp_path / "photo.tif", photo)
    rasters = ("dem.tif", "--classes", "classes.tif", "--photo", "photo.tif")
    splits = ("--splits", "train:0.4,valid:0.3,test/site:0.3", "--recipe", "tiny-v1")
    assert call(monkeypatch, datagen, "import-dem", *rasters, *splits, "--out", "real.h5") == 0
    dataset = TerrainDataset("real.h5")
    for split in dataset.splits:
        unlabelled = dataset.read(split)["class_id"] == UNLABELLED
        assert unlabelled[:, 24:].all()
        assert not unlabelled[:, :24].any()
    assert call(monkeypatch, datagen, "validate", "real.h5") == 0
    assert call(monkeypatch, datagen, "show", "real.h5") == 0
    assert call(monkeypatch, datagen, "preview", "real.h5", "--out", "sheet.png") == 0
    assert call(monkeypatch, train, "all", "--data", "real.h5", "--out", "mine", *QUICK) == 0
    out = ("--out", "quality")
    assert call(monkeypatch, train, "evaluate", "mine", "--data", "real.h5", *out) == 0
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
        "--instances",
        "0",
    )
    assert call(monkeypatch, evaluate, "run", "--data", "real.h5", *suite, "--out", "run") == 2
    (line,) = capfd.readouterr().err.strip().splitlines()
    assert "Expected maps with a class in every cell to drive on" in line
    assert not (tmp_path / "run").exists()
    with pytest.raises(ConfigError, match="a class in every cell"):
        gymnasium.make("benchnav/OffRoad-v0", data="real.h5", split="train")
