"""Conformal recalibration in training: halves of `valid` that do not overlap, any
model, resume and checkpoints.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchnav.core.errors import CheckpointError, ConfigError
from benchnav.core.quantiles import QuantileDistribution
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.checkpoint import load_checkpoint
from benchnav.models.config import TrainOptions
from benchnav.models.conformal import ConformalModel, fit_table
from benchnav.models.nets import calibration
from benchnav.models.nets.ensemble import Ensemble
from benchnav.models.predictor import load_model
from benchnav.models.training import networks
from benchnav.models.training.conformal import (
    conformal_table,
    scored_maps,
    stopping_step,
)
from benchnav.models.training.data import MapDataset
from benchnav.models.training.map_order import MapSampler
from benchnav.models.training.networks import fit_model, train_networks
from benchnav.testing import check_model
from tests.commands import call
from tests.models.stub import ColourModel
from tests.models.support import make_dataset
from tests.models.zoo.support import Killed, to_train

OWN = str(Path(__file__).parents[3] / "examples/own_model.py") + ":CellModel"
HOW = TrainOptions(
    device="cpu", trainer={"precision": "32-true"}, conformal=True, half_precision=False
)
FIELDS = ("rgb", "traversability")


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> TerrainDataset:
    return make_dataset(
        tmp_path_factory.mktemp("data") / "halves.h5", train=4, valid=7, test_std=2
    )


def altered(monkeypatch: pytest.MonkeyPatch, which: Callable[[int], bool]) -> Any:
    """Turns λ of some maps of `valid` around, as long as the context lasts."""
    read = TerrainDataset.read

    def changed(
        self: TerrainDataset, split: str, indices: Any = None, fields: Any = None
    ) -> Any:
        found = read(self, split, indices, fields)
        chosen = range(self.map_count(split)) if indices is None else indices
        if split == "valid" and "traversability" in found:
            turned = np.array([which(int(index)) for index in chosen])
            found["traversability"] = found["traversability"].copy()
            found["traversability"][turned] = 1 - found["traversability"][turned]
        return found

    monkeypatch.setattr(TerrainDataset, "read", changed)


@pytest.mark.parametrize("in_memory", [False, True])
def test_one_half_is_every_second_map_and_the_other_is_the_rest(
    maps: TerrainDataset, in_memory: bool
) -> None:
    whole = MapDataset(maps.path, "valid", FIELDS)
    half = MapDataset(
        maps.path, "valid", FIELDS, in_memory, step=stopping_step(conformal=True)
    )
    assert (len(whole), len(half), list(scored_maps(7))) == (7, 4, [1, 3, 5])
    every = whole.read(range(7))["rgb"]
    assert torch.equal(half.read([0, 3])["rgb"], every[[0, 6]])
    chunks = list(half.chunks())
    assert [index for indices, _ in chunks for index in indices] == [0, 1, 2, 3]
    assert torch.equal(torch.cat([batch["rgb"] for _, batch in chunks]), every[::2])
    assert len([half[key] for key in MapSampler(len(half), 1)]) == 4


def test_weights_and_temperatures_do_not_see_the_maps_that_are_scored(
    maps: TerrainDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # a temperature is kept for the smallest gain
    monkeypatch.setattr(calibration, "_MIN_GAIN", -1.0)

    def train(name: str, which: Callable[[int], bool] | None = None) -> Any:
        with monkeypatch.context() as patch:
            if which:
                altered(patch, which)
            train_networks(
                HOW,
                str(maps.path),
                str(tmp_path / name),
                to_train("mean_variance"),
                members=2,
            )
        return load_checkpoint(tmp_path / name)

    plain, scored, stopping = (
        train("a"),
        train("b", lambda at: at % 2 == 1),
        train("c", lambda at: at % 2 == 0),
    )
    assert set(plain.parts) == {"mean_variance", "mean_variance-2"}
    for name, part in plain.parts.items():
        assert scored.parts[name].config["temperature"] == part.config["temperature"]
        assert scored.parts[name].metrics == part.metrics
        for key, value in part.tensors.items():
            assert torch.equal(value, scored.parts[name].tensors[key])
    assert scored.pool_temperature == plain.pool_temperature
    assert scored.conformal != plain.conformal
    assert (
        stopping.parts["mean_variance"].metrics != plain.parts["mean_variance"].metrics
    )
    assert stopping.pool_temperature != plain.pool_temperature


def test_scores_are_the_pit_values_of_the_other_half_drawn_in_atoms(
    maps: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, cpu = ColourModel(), torch.device("cpu")
    table = conformal_table(model, maps, 5, cpu)
    assert table.maps == 3
    scores = []
    for index in (1, 3, 5):
        terrain = maps.terrain("valid", [index])
        lower, upper = model.predict(terrain.observe()).cdf_limits(
            terrain.traversability
        )
        assert bool((upper > lower).any())  # atoms
        scores.append((lower.numpy(), upper.numpy()))
    for ends, less in ((0, np.less_equal), (1, np.greater_equal)):
        bound = fit_table([own[ends].ravel() for own in scores]).values
        assert bool(
            less(np.array(bound), np.array(table.values) + (1e-9, -1e-9)[ends]).all()
        )
    assert conformal_table(model, maps, 5, cpu) == table
    assert conformal_table(model, maps, 6, cpu) != table
    with monkeypatch.context() as patch:
        altered(patch, lambda at: at % 2 == 0)
        assert conformal_table(model, maps, 5, cpu) == table
    with monkeypatch.context() as patch:
        altered(patch, lambda at: at == 3)
        assert conformal_table(model, maps, 5, cpu) != table


def test_a_users_own_model_is_recalibrated_and_kept(
    maps: TerrainDataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "mine"
    fit_model(HOW, OWN, str(maps.path), str(out), {"max_epochs": 1, "batch_size": 2})
    assert (
        "note: quantiles at levels below 1 / 4 = 0.25 are the lowest λ"
        in capsys.readouterr().out
    )
    model = load_model(f"{OWN}@{out}")
    assert isinstance(model, ConformalModel)
    assert not isinstance(model.model, Ensemble)
    assert model.table == conformal_table(model.model, maps, 0, torch.device("cpu"))
    seen = maps.terrain("test/std", [0]).observe()
    found = model.predict(seen)
    assert isinstance(found, QuantileDistribution)
    at = model.table.values[model.table.levels.index(0.5)]
    torch.testing.assert_close(
        found.quantile(0.5), model.model.predict(seen).quantile(at)
    )
    check_model(f"{OWN}@{out}", shapes=((20, 37),))
    card = (out / "README.md").read_text()
    assert "recalibrated on 3 maps" in card
    assert "ensemble" not in card
    assert json.loads((out / "config.json").read_text())["conformal"]["maps"] == 3


def test_the_fused_model_is_recalibrated_as_a_whole(
    maps: TerrainDataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = {
        "encoder": "mobilenet_v2",
        "encoder_depth": 2,
        "max_epochs": 1,
        "batch_size": 2,
    }
    out = tmp_path / "fused"
    settings = {"classifier": small, "gp": {"epochs": 1}}
    fit_model(HOW, "fused", str(maps.path), str(out), settings)
    model = load_model(str(out))
    assert isinstance(model, ConformalModel)
    assert model.model.class_names
    assert model.class_names == ()
    assert model.table == conformal_table(model.model, maps, 0, torch.device("cpu"))
    check_model(str(out), shapes=((20, 37),))

    # A classifier alone has nothing to recalibrate; beside the GPs it has.
    arguments = [
        "classifier",
        "--data",
        maps.path,
        "--conformal",
        "true",
        "--device",
        "cpu",
    ]
    arguments += [f"--classifier.{name}={value}" for name, value in small.items()]

    assert call("train", *arguments, "--out", tmp_path / "alone") == 2
    assert "a complete model for `conformal`" in capsys.readouterr().err
    assert not (tmp_path / "alone").exists()
    before = load_checkpoint(out).conformal
    assert call("train", *arguments, "--out", out, "--overwrite", "--seed", 4) == 0
    after = load_checkpoint(out)
    assert after.conformal
    assert after.conformal != before


def test_an_interrupted_training_ends_with_the_same_table(
    maps: TerrainDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    small, data = to_train("mean_variance", max_epochs=1), str(maps.path)
    train_networks(HOW, data, str(tmp_path / "whole"), small)

    def kill(*_: object) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(networks, "conformal_table", kill)
        with pytest.raises(Killed):
            train_networks(HOW, data, str(tmp_path / "cut"), small)
    assert load_checkpoint(tmp_path / "cut").conformal == {}
    again = replace(HOW, resume=True)
    train_networks(again, data, str(tmp_path / "cut"), small)
    first, second = (load_checkpoint(tmp_path / name) for name in ("whole", "cut"))
    assert first.conformal == second.conformal
    assert first.conformal
    capsys.readouterr()
    train_networks(again, data, str(tmp_path / "cut"), small)
    assert "finished already" in capsys.readouterr().out
    for resumed, made in ((replace(again, conformal=False), "cut"), (again, "other")):
        if made == "other":
            train_networks(
                replace(HOW, conformal=False), data, str(tmp_path / made), small
            )
        with pytest.raises(CheckpointError, match="another `conformal`"):
            train_networks(resumed, data, str(tmp_path / made), small)


def test_too_few_maps_are_refused_before_any_training(tmp_path: Path) -> None:
    few = make_dataset(tmp_path / "few.h5", train=4, valid=3)
    with pytest.raises(ConfigError, match="at least 4 maps in split valid"):
        train_networks(
            HOW, str(few.path), str(tmp_path / "out"), to_train("mean_variance")
        )
    assert not (tmp_path / "out.training").exists()
