"""What models are measured and calibrated on is the device that is asked for, and the
numbers are the same.
"""

import sys
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from benchnav.core.device import CPU, find_device
from benchnav.core.errors import ConfigError
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models import cli
from benchnav.models.checkpoint import load_checkpoint
from benchnav.models.config import ClassifierConfig, MDNConfig
from benchnav.models.fused import FusedModel
from benchnav.models.nets.calibration import (
    fit_pool_temperature,
    fit_temperature,
    sample_logits,
)
from benchnav.models.nets.classifier import TerrainClassifier
from benchnav.models.nets.mdn import MixtureDensityModel
from benchnav.models.predictor import Ideal, Oracle
from benchnav.models.quality import measurement as measurement_module
from benchnav.models.quality.measure import evaluate
from benchnav.models.training import fit as fit_module
from benchnav.models.training import networks
from benchnav.models.training.data import VALID, MapDataset
from benchnav.models.training.fit import FitOptions
from benchnav.models.training.networks import fit_network
from tests.elsewhere.device import elsewhere, waits
from tests.models.conftest import checkpoint_path as _checkpoint_path
from tests.models.conftest import dataset as _dataset
from tests.models.support import scale, trainable

checkpoint_path, dataset = _checkpoint_path, _dataset  # fixtures


def network() -> MixtureDensityModel:
    mean, std = torch.tensor([100.0, 90, 80]), torch.tensor([20.0, 25, 30])
    config = MDNConfig(encoder="mobilenet_v2", hidden=16)
    return MixtureDensityModel(config).build(scale(mean, std, 10.0)).eval()


def pair(checkpoint_path: Path) -> FusedModel:
    """Two members that differ."""
    checkpoint = load_checkpoint(checkpoint_path)
    model = FusedModel.from_checkpoint(checkpoint)
    part = checkpoint.part("classifier")
    other = {
        name: value * 1.1 if value.ndim > 1 else value
        for name, value in part.tensors.items()
    }
    second = TerrainClassifier.from_tensors(part.config, checkpoint.class_names, other)
    return FusedModel((*model.classifiers, second), model.table, model.class_names, 1.5)


def assert_close(found: Any, expected: Any) -> None:
    """Compares nested numbers."""
    assert type(found) is type(expected)
    if isinstance(expected, dict):
        assert found.keys() == expected.keys()
        for name, value in expected.items():
            assert_close(found[name], value)
    elif isinstance(expected, tuple) and expected and isinstance(expected[0], dict):
        for one, other in zip(found, expected, strict=True):
            assert_close(one, other)
    elif expected is not None:
        np.testing.assert_allclose(
            np.asarray(found, float), np.asarray(expected, float), rtol=1e-6
        )


@pytest.mark.parametrize("name", ["oracle", "ideal", "mdn", "pair"])
def test_a_model_is_measured_on_another_device_as_here(
    name: str, dataset: TerrainDataset, checkpoint_path: Path
) -> None:
    model: Any = {
        "oracle": Oracle,
        "ideal": Ideal,
        "mdn": network,
        "pair": lambda: pair(checkpoint_path),
    }[name]()
    here = dict(evaluate(model, dataset))
    with elsewhere() as device:
        there = dict(evaluate(model, dataset, device=device))
        assert waits, "nothing was computed there"
    for split, quality in here.items():
        assert_close(asdict(there[split]), asdict(quality))


def test_temperatures_are_fitted_on_another_device_as_here(
    dataset: TerrainDataset, checkpoint_path: Path
) -> None:
    maps, members = MapDataset(dataset.path, VALID), pair(checkpoint_path).classifiers
    here = (
        fit_temperature(*sample_logits(members[0], maps, 3)),
        fit_pool_temperature(members, maps, 3),
    )
    with elsewhere() as device:
        logits, class_id = sample_logits(members[0], maps, 3, device)
        assert logits.device == class_id.device == device
        there = (
            fit_temperature(logits, class_id),
            fit_pool_temperature(members, maps, 3, device),
        )
        assert {
            value.device for member in members for value in member.parameters()
        } == {device}
        for member in members:
            member.cpu()
    np.testing.assert_allclose(there, here, rtol=1e-6)


def test_networks_are_measured_in_training_on_another_device_as_here(
    dataset: TerrainDataset, checkpoint_path: Path
) -> None:
    classifier, mdn = pair(checkpoint_path).classifiers[0], network()
    maps, all_maps = (
        MapDataset(dataset.path, VALID),
        MapDataset(dataset.path, VALID, ("rgb", "slope_deg", "traversability")),
    )
    here = classifier.measure(maps) | mdn.measure(all_maps)
    with elsewhere() as device:
        there = classifier.to(device).measure(maps) | mdn.to(device).measure(all_maps)
        assert waits
    assert_close(there, here)


@pytest.mark.parametrize(
    "command", ["classifier", "gp", "gp on logs", "all", "mdn", "evaluate"]
)
def test_each_command_uses_the_device_that_it_is_given(
    command: str,
    dataset: TerrainDataset,
    checkpoint_path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Asked for a GPU, all that is computed is asked of it; there is none, so that each
    ends with the first.
    """
    asked: list[torch.device] = []

    class Enough(Exception):
        pass

    def begin(*given: Any, **named: Any) -> Any:
        names = [
            value.device if isinstance(value, FitOptions) else value for value in given
        ]
        asked.append(
            find_device(next(name for name in names if name in ("auto", "cpu", "cuda")))
        )
        raise Enough

    def measure(
        model: Any, dataset: Any, split: str, seed: int, device: torch.device, **_: Any
    ) -> Any:
        asked.append(device)
        raise Enough

    # A trial of the network would ask the GPU that is not there.
    monkeypatch.setattr(
        "benchnav.models.training.networks.check_network", lambda *_: None
    )
    for name in ("networks.fit_network", "gaussian_processes.fit_gps"):
        monkeypatch.setattr(f"benchnav.models.training.{name}", begin)
    monkeypatch.setattr(measurement_module, "measure_split", measure)
    (tmp_path / "logs.csv").write_text(
        "class,slope_deg,traversability\n" + "a,5,0.5\n" * 20
    )
    data = str(tmp_path / "logs.csv") if command == "gp on logs" else str(dataset.path)
    cpu, cuda = ("--device", "cpu"), ("--device", "cuda")
    for there, words, expected in (
        (True, (), "cuda"),
        (True, cpu, "cpu"),
        (True, cuda, "cuda"),
        (False, (), "cpu"),
    ):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        out = str(tmp_path / f"{len(asked)}")
        where = (str(checkpoint_path),) if command == "evaluate" else ("--out", out)
        monkeypatch.setattr(
            sys,
            "argv",
            ["benchnav-train", command.split()[0], *where, "--data", data, *words],
        )
        with pytest.raises(Enough):
            cli.main()
        assert asked[-1].type == expected
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    sys.argv = [*sys.argv, "--device", "cuda"]
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    assert "GPU" in capfd.readouterr().err
    assert len(asked) == 4


def test_the_accelerator_is_the_device_and_has_no_second_name() -> None:
    with pytest.raises(ConfigError, match="Set `device` instead"):
        FitOptions(trainer={"accelerator": "cpu"})
    assert FitOptions(device="cpu").place == torch.device("cpu")


def test_lightning_trains_on_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[str] = []

    class Enough(Exception):
        pass

    def begin(callbacks: Any, **settings: Any) -> Any:
        given.append(settings["accelerator"])
        raise Enough

    monkeypatch.setattr(fit_module, "make_trainer", begin)
    monkeypatch.setattr(fit_module, "default_precision", lambda accelerator: "32-true")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for device in ("cpu", "cuda", "auto"):
        with pytest.raises(Enough):
            fit_module.fit(network(), "x", FitOptions(device=device), {}, [], {})
    assert given == ["cpu", "cuda", "cuda"]


def test_what_was_trained_is_measured_and_calibrated_where_it_was(
    dataset: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[torch.device] = []
    chunks = MapDataset.chunks

    def watched(maps: MapDataset, device: torch.device = CPU) -> Any:
        read.append(device)
        return chunks(maps, device)

    monkeypatch.setattr(MapDataset, "chunks", watched)
    monkeypatch.setattr(networks, "fit", lambda *given, **named: {"epoch": 1.0})
    with elsewhere() as device:
        monkeypatch.setattr(FitOptions, "place", device)
        for config in (
            ClassifierConfig(encoder="mobilenet_v2", batch_size=5),
            MDNConfig(encoder="mobilenet_v2", hidden=16, batch_size=5),
        ):
            trained, _ = fit_network(
                trainable(config),
                dataset,
                0,
                FitOptions(device="cpu"),
                half_precision=True,
            )
            assert {value.device for value in trained.parameters()} == {CPU}
    # Both networks are measured and calibrated; before, layers are read on the CPU.
    assert [place for place in read if place != CPU] == [device] * 4


def test_a_pool_is_calibrated_on_the_device(
    dataset: TerrainDataset, checkpoint_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[torch.device] = []

    def fit_pool(members: Any, maps: Any, seed: int, device: torch.device) -> float:
        assert len(members) == 2
        given.append(device)
        return 1.5

    monkeypatch.setattr(TerrainClassifier, "fit_pool", fit_pool)
    one = load_checkpoint(checkpoint_path)
    pair = one.with_part("classifier-2", one.part("classifier"))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for device in ("cpu", "cuda"):
        target = SimpleNamespace(
            checkpoint=pair,
            options=FitOptions(device=device),
            has_part=lambda *words: True,
            set_pool_temperature=lambda value: None,
        )
        networks.train_parts(
            target,
            trainable(ClassifierConfig()),
            dataset,
            ["classifier", "classifier-2"],
        )  # type: ignore[arg-type]
    assert [place.type for place in given] == ["cpu", "cuda"]
