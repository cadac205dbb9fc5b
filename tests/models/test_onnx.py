"""An exported graph gives in ONNX Runtime what the model gives, for maps of any size."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.special
import torch

from benchnav.core.conditioned import ConditionedDistribution
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.pooled import PooledDistribution
from benchnav.core.terrain import Observation
from benchnav.models.checkpoint import Checkpoint, Part, save_checkpoint
from benchnav.models.config import ClassifierConfig, MDNConfig
from benchnav.models.fused import FusedModel
from benchnav.models.nets.classifier import TerrainClassifier
from benchnav.models.nets.ensemble import Ensemble
from benchnav.models.nets.mdn import MixtureDensityModel
from benchnav.models.onnx_distributions import (
    _normal_cdf,
    _normal_score,
    cvar_of,
    mean_of,
    parameters_of,
)
from benchnav.models.onnx_graph import export_onnx
from benchnav.models.predictor import Oracle
from benchnav.models.slope_gp.table import SlopeTable, SoftModes
from tests.commands import call
from tests.models.support import NAMES, linear_table, make_terrain, scale
from tests.models.zoo.support import ZOO

SMALL: dict[str, Any] = {"decoder_channels": (16,), "encoder_depth": 1}
KINDS: dict[str, tuple[Any, Any]] = {
    "mdn": (MixtureDensityModel, MDNConfig),
    **{name: (kind, type(config)) for name, (kind, config) in ZOO.items()},
}
COLOURS = scale(torch.full((3,), 127.0), torch.full((3,), 70.0), 20.0)


def fused(soft: bool = True) -> FusedModel:
    """Two members with temperatures, a pool temperature, and a class with a soft mode."""
    members = [
        TerrainClassifier(ClassifierConfig(**SMALL)).build(COLOURS, NAMES, seed)
        for seed in (1, 2)
    ]
    for member, temperature in zip(members, (0.7, 1.6), strict=True):
        member.temperature = temperature
    table = linear_table()
    modes = SoftModes(
        torch.tensor([0.0, 0.3, 0.0]),
        torch.tensor([0.5, 0.1, 0.5]),
        torch.tensor([0.1, 0.05, 0.1]),
    )
    if soft:
        table = SlopeTable(
            mean=table.mean, std=table.std, noise_std=table.noise_std, soft=modes
        )
    return FusedModel([member.eval() for member in members], table, NAMES, 1.4)


def small(name: str, temperature: float = 1.0, seed: int = 1, **settings: Any) -> Any:
    """A model of the zoo with a small network, which is quick to export."""
    kind, config = KINDS[name]
    model = kind(config(hidden=8, encoder_depth=1, **settings)).build(
        COLOURS, seed=seed
    )
    model.temperature = temperature
    return model.eval()


def outputs(path: Path, observation: Observation) -> dict[str, np.ndarray]:
    """What ONNX Runtime makes of a graph."""
    runtime = pytest.importorskip(
        "onnxruntime", reason="the extra onnx is not installed"
    )
    session = runtime.InferenceSession(str(path))
    given = {
        entry.name: getattr(observation, entry.name).numpy()
        for entry in session.get_inputs()
    }
    names = [entry.name for entry in session.get_outputs()]
    return dict(zip(names, session.run(names, given), strict=True))


MODELS = {
    "fused": lambda: fused(),
    "mdn calibrated": lambda: small("mdn", temperature=1.3),
    "mean_variance": lambda: small("mean_variance"),
    "quantile": lambda: small("quantile"),
    "quantile calibrated": lambda: small("quantile", temperature=1.3),
    "mc_dropout": lambda: small("mc_dropout", masks=3),
}


# To write a graph takes ten seconds and more.
QUICK = ("fused",)


@pytest.mark.parametrize(
    "name",
    [
        name if name in QUICK else pytest.param(name, marks=pytest.mark.slow)
        for name in MODELS
    ],
)
def test_the_runtime_gives_what_the_model_gives(name: str, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript", reason="the extra onnx is not installed")
    model, path = MODELS[name](), tmp_path / "model.onnx"
    export_onnx(model, path, name, level=0.8)
    for batch, size in ((2, 24), (3, 17)):
        observation = make_terrain(batch, size).observe()
        found, predicted = outputs(path, observation), model.predict(observation)
        np.testing.assert_allclose(found["mean"], predicted.mean().numpy(), atol=1e-5)
        np.testing.assert_allclose(
            found["cvar"], predicted.cvar(0.8).numpy(), atol=1e-5
        )
        own = parameters_of(predicted)
        assert set(found) == {*own, "mean", "cvar"}
        for parameter, values in own.items():
            np.testing.assert_allclose(found[parameter], values.numpy(), atol=1e-5)
        # the level counts
        assert np.abs(found["cvar"] - predicted.cvar(0.5).numpy()).max() > 1e-3


def test_the_command_writes_what_its_flags_say(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    onnx = pytest.importorskip("onnx", reason="the extra onnx is not installed")
    pytest.importorskip("onnxscript", reason="the extra onnx is not installed")
    model, path = small("quantile"), tmp_path / "model.onnx"
    part = Part(
        config=model.settings(), tensors=dict(model.state_dict()), seed=0, metrics={}, data_id="", data_digest="",
        half_precision=False,
    )  # fmt: skip
    save_checkpoint(
        tmp_path / "c",
        Checkpoint(class_names=(), model="quantile", parts={"quantile": part}),
    )
    path.write_text("mine")
    given = ("export", tmp_path / "c", "--onnx", path, "--level", 0.6, "--opset", 20)
    for words, said in (
        (given, "which exists. Pass --overwrite"),
        ((*given, "--overwrite", "--level", 1), "`level` in [0, 1), got 1"),
        ((*given, "--overwrite", "--opset", 9), "`opset` from 18 to "),
        ((*given, "--onnx", tmp_path / "model.pt"), "`onnx` to end in .onnx"),
    ):
        assert call("train", *words) == 2
        assert said in capsys.readouterr().err
        assert path.read_text() == "mine"
    assert call("train", *given, "--overwrite") == 0
    assert "to quantiles, mean, cvar at level 0.6" in capsys.readouterr().out
    assert {entry.name for entry in tmp_path.iterdir()} == {"c", "model.onnx"}
    observation = make_terrain(2, 24).observe()
    predicted = model.predict(observation)
    np.testing.assert_allclose(
        outputs(path, observation)["cvar"], predicted.cvar(0.6).numpy(), atol=1e-5
    )
    written = onnx.load(path)
    about = json.loads(
        {entry.key: entry.value for entry in written.metadata_props}["benchnav"]
    )
    assert (about["model"], about["cvar_level"]) == (str(tmp_path / "c"), 0.6)
    assert {entry.version for entry in written.opset_import if not entry.domain} == {20}


@pytest.mark.parametrize("temperature", [0.4, 1.25, 3.0])
def test_integrals_are_those_of_the_distribution(temperature: float) -> None:
    generator = torch.Generator().manual_seed(0)
    weights, means, stds = (
        torch.rand(2, 3, 6, 6, generator=generator, dtype=torch.float64)
        for _ in range(3)
    )
    mixture = TraversabilityMixture(
        weights / weights.sum(1, keepdim=True), means, 0.01 + 0.3 * stds**2
    )
    zeros = torch.zeros(2, 6, 6, dtype=torch.float64)
    wide = ConditionedDistribution(mixture, zeros, zeros + temperature)
    pooled = PooledDistribution((wide, mixture))
    x = torch.linspace(0, 1, 40001, dtype=torch.float64).view(-1, 1, 1, 1)
    z = (x - mixture.means.reshape(1, 6, 6, 6)) / mixture.stds.reshape(1, 6, 6, 6)
    for distribution in (mixture, wide, pooled):
        for tail in (0.5, 0.05):  # the base promises 1e-4
            torch.testing.assert_close(
                cvar_of(distribution, tail),
                distribution.cvar(1 - tail),
                atol=1e-4,
                rtol=0,
            )
    # Of the widened one by the trapezium rule, from SciPy's normal numbers.
    below, above = (
        (
            mixture.weights
            * torch.from_numpy(scipy.special.ndtr(sign * z.numpy())).view(
                -1, 2, 3, 6, 6
            )
        ).sum(2)
        for sign in (1, -1)
    )
    prior = np.where(
        below < above, scipy.special.ndtri(below), -scipy.special.ndtri(above)
    )
    share = torch.from_numpy(scipy.special.ndtr(prior / temperature))
    integral = torch.trapezoid(share, dx=1 / 40000, dim=0)
    torch.testing.assert_close(mean_of(wide), 1 - integral, atol=1e-6, rtol=0)


def test_normal_numbers_are_exact_in_the_tails() -> None:
    z = torch.linspace(-35, 8, 4001, dtype=torch.float64)
    share = torch.from_numpy(scipy.special.ndtr(z.numpy()))
    torch.testing.assert_close(_normal_cdf(z), share, atol=0, rtol=1e-7)
    near = z > -7
    torch.testing.assert_close(_normal_cdf(z)[near], share[near], atol=0, rtol=1e-8)
    torch.testing.assert_close(
        _normal_score(share[z < 5]), z[z < 5], atol=1e-7, rtol=1e-8
    )


def test_what_has_no_graph_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("onnxscript", reason="the extra onnx is not installed")

    class Odd(MixtureDensityModel):
        def predict(self, observation: Observation) -> Any:
            mixture: Any = super().predict(observation)
            return TraversabilityMixture(
                mixture.weights, mixture.means - 0.1, mixture.stds
            )

    odd = Odd(MDNConfig(hidden=8, encoder_depth=1)).build(COLOURS).eval()
    refused = (
        (Oracle(), "got Oracle"),
        (odd, "whose exported graph differs from `predict` by up to"),
        (small("swag"), "got SWAGModel, which draws its weights during prediction"),
        (small("evidential"), "got EvidentialModel, which needs the digamma function"),
        (
            Ensemble([small("swag"), small("swag", seed=2)]),
            "got SWAGModel, which draws",
        ),
    )
    for model, said in refused:
        with pytest.raises(ConfigError, match=said):
            export_onnx(model, tmp_path / "model.onnx", "odd")
    with pytest.raises(ConfigError, match="level"):
        export_onnx(small("mdn"), tmp_path / "model.onnx", "mdn", level=1.0)
    assert not list(tmp_path.iterdir())
