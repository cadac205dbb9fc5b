import json
import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torchmetrics
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm
from torch import Tensor

from benchnav.core.errors import CheckpointError, ConfigError
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.mixture_density import LogNormalCDF
from benchnav.core.terrain import Observation, Terrain
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.base import predict
from benchnav.models.checkpoint import Checkpoint, Part, as_stored, load_checkpoint
from benchnav.models.config import MDNConfig
from benchnav.models.nets import mdn
from benchnav.models.nets import trainable as trainable_module
from benchnav.models.nets.mdn import MixtureDensityModel, censored_nll
from benchnav.models.predictor import Oracle, load_model, open_checkpoint
from benchnav.models.training import networks
from benchnav.models.training.best import KeepBest
from benchnav.models.training.data import MapData
from benchnav.models.training.fit import FitOptions
from benchnav.models.training.networks import fit_network
from tests.commands import call
from tests.factories import normal
from tests.models.support import make_terrain, scale, trainable

EXACT = {"precision": "32-true"}
SMALL = MDNConfig(
    encoder="mobilenet_v2", hidden=16, max_epochs=3, batch_size=5, jitter=0.2
)
QUICK = [
    "--mdn.encoder",
    "mobilenet_v2",
    "--mdn.batch_size",
    "5",
    "--trainer.precision",
    "32-true",
]


def build(seed: int = 0, **changes: object) -> MixtureDensityModel:
    config = replace(SMALL, **changes)  # type: ignore[arg-type]
    scales = scale(torch.tensor([100.0, 90, 80]), torch.tensor([20.0, 25, 30]), 10.0)
    return MixtureDensityModel(config).build(scales, seed=seed).eval()


def layers(seen: Any, slope_deg: Tensor | None = None) -> dict[str, Tensor]:
    """What the network is given of an observation or a terrain."""
    return {
        "rgb": seen.rgb,
        "slope_deg": seen.slope_deg if slope_deg is None else slope_deg,
    }


def observe(batch: int, height: int, width: int) -> Observation:
    generator = torch.Generator().manual_seed(3)
    return Observation(
        torch.randint(
            0, 256, (batch, 3, height, width), generator=generator, dtype=torch.uint8
        ),
        torch.zeros(batch, height, width),
        30 * torch.rand(batch, height, width, generator=generator),
        Grid(height, width, 0.5),
    )


def parameters(
    weights: Tensor, means: Tensor, stds: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """As the loss takes them: [1, K, 1, N] of [K] components in each of N cells."""
    return (
        weights.log().view(1, -1, 1, 1),
        means.view(1, -1, 1, 1),
        stds.view(1, -1, 1, 1),
    )


# --- the loss ---


@settings(max_examples=60, deadline=None)
@given(
    components=st.lists(
        st.tuples(st.floats(0.05, 1), st.floats(-0.5, 1.5), st.floats(0.01, 0.6)),
        min_size=1,
        max_size=4,
    ),
    observed=st.lists(
        st.one_of(st.sampled_from([0, 2**16]), st.integers(0, 2**16)),
        min_size=1,
        max_size=6,
    ),
)
def test_the_loss_is_the_mean_negative_log_likelihood_of_the_mixture(
    components: list[tuple[float, float, float]], observed: list[int]
) -> None:
    weights, means, stds = torch.tensor(components, dtype=torch.float64).unbind(1)
    weights = weights / weights.sum()
    seen = torch.tensor(observed, dtype=torch.float64).view(1, 1, -1) / 2**16
    shape = (1, len(components), 1, len(observed))
    mixture = TraversabilityMixture(
        *(t.view(1, -1, 1, 1).expand(shape) for t in (weights, means, stds))
    )
    expected = -mixture.log_prob(seen).mean()
    found = censored_nll(*parameters(weights, means, stds), seen)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
    single = censored_nll(
        *(t.float() for t in parameters(weights, means, stds)), seen.float()
    )
    torch.testing.assert_close(single.double(), expected, rtol=1e-4, atol=1e-4)


def test_mass_of_a_clipped_gaussian_by_hand() -> None:
    # N(1, 0.2) has one half above 1; N(0.5, 0.5) has Φ(−1) under 0.
    one = censored_nll(
        *parameters(torch.ones(1), torch.ones(1), torch.tensor([0.2])),
        torch.ones(1, 1, 1),
    )
    half = torch.tensor([0.5])
    zero = censored_nll(*parameters(torch.ones(1), half, half), torch.zeros(1, 1, 1))
    torch.testing.assert_close(one, -torch.tensor(0.5).log())
    torch.testing.assert_close(zero, -torch.special.ndtr(torch.tensor(-1.0)).log())


@pytest.mark.parametrize("observed", [0.0, 1e-7, 0.5, 1 - 1e-7, 1.0])
@pytest.mark.parametrize("mean", [-1e3, -1.0, 0.0, 0.5, 1.0, 2.0, 1e3])
@pytest.mark.parametrize("std", [mdn.MIN_STD, 0.2, 1e3])
def test_loss_and_gradients_are_finite_at_the_extremes(
    observed: float, mean: float, std: float
) -> None:
    logits = torch.tensor([[0.0, -200.0]]).view(1, 2, 1, 1).requires_grad_()
    means = torch.tensor([mean, 0.5]).view(1, 2, 1, 1).requires_grad_()
    stds = torch.tensor([std, mdn.MIN_STD]).view(1, 2, 1, 1).requires_grad_()
    loss = censored_nll(
        logits.log_softmax(1), means, stds, torch.full((1, 1, 1), observed)
    )
    loss.backward()
    assert bool(loss.isfinite())
    for value in (logits, means, stds):
        assert value.grad is not None
        assert bool(value.grad.isfinite().all())


def test_the_gradient_of_the_clipped_mass_is_right_far_out() -> None:
    z = torch.tensor([-1e6, -1e5, -1e4, -1e3, -30.0, -5.0, -1.0, 0.0, 2.0, 8.0, 1e5])
    leaf = z.clone().requires_grad_()
    value = LogNormalCDF.apply(leaf)
    value.sum().backward()
    far = z.double().numpy()
    expected = norm.logcdf(far)
    torch.testing.assert_close(
        value.detach().double(), torch.from_numpy(expected), rtol=1e-5, atol=1e-9
    )
    # φ/Φ, which towards −∞ is −z, but for its rounding
    hazard = np.exp(norm.logpdf(far) - expected)
    hazard[far < -1e3] = -far[far < -1e3]
    assert leaf.grad is not None
    torch.testing.assert_close(
        leaf.grad.double(), torch.from_numpy(hazard), rtol=1e-5, atol=1e-9
    )


def test_cells_that_were_not_observed_are_left_out() -> None:
    terrain = make_terrain()
    some = terrain.traversability.clone()
    some[:, :5] = float("nan")
    raw = [
        torch.randn(2, 3, 16, 16, generator=torch.Generator().manual_seed(k))
        for k in range(3)
    ]

    def loss(observed: Tensor, rows: slice) -> tuple[Tensor, list[Tensor]]:
        leaves = [value[:, :, rows].clone().requires_grad_() for value in raw]
        found = censored_nll(
            leaves[0].log_softmax(1), leaves[1], leaves[2].exp(), observed[:, rows]
        )
        found.backward()
        return found.detach(), [leaf.grad for leaf in leaves if leaf.grad is not None]

    with_holes, gradients = loss(some, slice(None))
    without, expected = loss(some, slice(5, None))
    torch.testing.assert_close(with_holes, without)
    for found, right in zip(gradients, expected, strict=True):
        assert not bool(found[:, :, :5].any())
        torch.testing.assert_close(found[:, :, 5:], right)
    assert loss(torch.full_like(some, float("nan")), slice(None))[0] == 0


# --- the network ---


@pytest.mark.parametrize("shape", [(8, 8), (33, 20)])
def test_maps_of_any_size_are_predicted(shape: tuple[int, int]) -> None:
    mixture = build(components=4).predict(observe(2, *shape))
    assert mixture.weights.shape == (2, 4, *shape)
    assert mixture.weights.dtype == torch.float32
    assert not mixture.weights.is_inference()


def test_the_network_is_moved_to_the_observations_device(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, moved = build(), list[torch.device]()
    monkeypatch.setattr(model, "to", moved.append)
    model.predict(observe(2, 32, 32))
    assert moved == [torch.device("cpu")]


def test_components_begin_apart_within_the_range() -> None:
    mixture = build(components=4).predict(observe(2, 32, 32))
    centres = torch.tensor([0.125, 0.375, 0.625, 0.875])
    assert float((mixture.means.mean((0, 2, 3)) - centres).abs().max()) < 0.1
    assert bool((mixture.weights > 0.1).all())
    assert bool(((mixture.stds > 0.1) & (mixture.stds < 0.4)).all())


def test_no_component_is_narrower_than_the_least() -> None:
    network = build()
    with torch.no_grad():
        network.head.bias[-1] = -1000
        _, _, stds = network(layers(observe(1, 32, 32)))
    assert bool((stds[:, -1] == mdn.MIN_STD).all())


def test_initial_weights_are_a_function_of_the_seed_alone() -> None:
    before = torch.random.get_rng_state()
    first, second, other = (build(seed).state_dict() for seed in (0, 0, 1))
    assert torch.equal(before, torch.random.get_rng_state())
    for name, value in first.items():
        assert torch.equal(value, second[name]), name
    for name in ("joint.0.weight", "head.weight", "network.head.1.weight"):
        assert not torch.equal(first[name], other[name]), name


def test_slope_counts_in_its_own_cell_alone_and_by_its_scale() -> None:
    network, seen = build(), observe(1, 32, 32)
    steeper = seen.slope_deg.clone()
    steeper[0, 7, 9] += 20
    with torch.no_grad():
        _, before, _ = network(layers(seen))
        _, after, _ = network(layers(seen, steeper))
        changed = (before != after).any(1)[0]
        assert changed.nonzero().tolist() == [[7, 9]]
        network.slope_scale_deg *= 2
        torch.testing.assert_close(network(layers(seen, 2 * seen.slope_deg))[1], before)


def test_chunks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    model, seen = build(), observe(5, 16, 24)
    whole = model.predict(seen)
    sizes: list[int] = []
    model.register_forward_pre_hook(
        lambda _, inputs: sizes.append(len(inputs[0]["rgb"]))
    )
    monkeypatch.setattr(trainable_module, "CHUNK_CELLS", 2 * 16 * 24)
    pieces = model.predict(seen)
    assert sizes == [2, 2, 1]
    for name in ("weights", "means", "stds"):
        torch.testing.assert_close(
            getattr(whole, name), getattr(pieces, name), rtol=1e-4, atol=1e-5
        )


def test_the_likelihood_is_in_single_precision_under_autocast() -> None:
    network, terrain = build(), make_terrain(size=32)
    with torch.autocast("cpu", torch.bfloat16):
        parts = network(layers(terrain))
        loss = network.training_step(
            {
                "rgb": terrain.rgb,
                "slope_deg": terrain.slope_deg,
                "traversability": terrain.traversability,
            },
            0,
        )
    assert {part.dtype for part in parts} == {torch.float32}
    # Numbers that bfloat16 cannot hold: its neighbours are 2⁻⁸ of the value apart.
    assert bool((parts[1] != parts[1].bfloat16().float()).any())
    torch.testing.assert_close(loss, censored_nll(*parts, terrain.traversability))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("components", 0),
        ("hidden", 0),
        ("encoder_depth", 6),
        ("learning_rate", 0.0),
        ("weight_decay", 1.0),
        ("jitter", -0.1),
        ("batch_size", 1),
        ("max_epochs", 0),
        ("patience", 0),
    ],
)
def test_settings_that_cannot_train_are_refused(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=name):
        MDNConfig(**{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "value"), [("architecture", "unett"), ("encoder", "resnet19")]
)
def test_an_unknown_network_is_refused(name: str, value: str) -> None:
    with pytest.raises(ConfigError, match=value):
        build(**{name: value})


# --- training ---


def draw_two_grounds(generator: torch.Generator) -> tuple[Terrain, list[Tensor]]:
    """Terrain of two grounds told by colour, cell by cell, and where each of three
    distributions holds.

    λ of the bright one is N(0.9, 0.2), clipped at 1; of the dark one N(0.3, 0.1) where
    it is flat and N(0.1, 0.1), clipped at 0, on slopes of 20°.
    """
    shape = (4, 32, 32)
    bright, steep = (torch.rand(shape, generator=generator) < 0.5 for _ in range(2))
    mean = torch.where(bright, 0.9, torch.where(steep, 0.1, 0.3))
    std = torch.where(bright, 0.2, 0.1)
    terrain = Terrain(
        rgb=torch.where(bright, 180, 60)[:, None]
        .expand(-1, 3, -1, -1)
        .to(torch.uint8)
        .contiguous(),
        class_id=bright.long(),
        elevation_m=torch.zeros(shape),
        slope_deg=torch.where(steep, 20.0, 0.0),
        truth=normal(mean, std),
        traversability=(mean + std * torch.randn(shape, generator=generator)).clamp(
            0, 1
        ),
        grid=Grid(32, 32, 0.5),
    )
    return terrain, [bright, ~bright & steep, ~bright & ~steep]


def test_it_recovers_a_known_distribution() -> None:
    generator, steps = torch.Generator().manual_seed(0), 40
    network = build(hidden=32).train()
    optimizer = torch.optim.AdamW(network.parameters(), lr=2e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-2, total_steps=steps)
    for _ in range(steps):
        terrain, _ = draw_two_grounds(generator)
        optimizer.zero_grad()
        censored_nll(*network(layers(terrain)), terrain.traversability).backward()
        optimizer.step()
        schedule.step()
    terrain, grounds = draw_two_grounds(generator)
    with (
        torch.no_grad()
    ):  # normalised by the batch as in training: running averages are too young
        log_weights, means, stds = network(layers(terrain))
    found = TraversabilityMixture(log_weights.exp(), means, stds)
    truth = predict(Oracle(), terrain)
    assert float((found.mean() - truth.mean()).square().mean().sqrt()) < 0.04
    nearly_one = 1 - 1e-6
    for ground in grounds:
        for value in (
            0.0,
            0.2,
            0.5,
            0.9,
            nearly_one,
        ):  # with both atoms, which are up to 0.31
            error = (found.cdf(value) - truth.cdf(value))[ground].mean()
            assert abs(float(error)) < 0.08, value
    excess = (
        truth.log_prob(terrain.traversability).mean()
        - found.log_prob(terrain.traversability).mean()
    )
    assert -0.02 < float(excess) < 0.08


class Killed(Exception):
    pass


class KillInTheThirdEpoch(KeepBest):
    def on_train_batch_end(self, trainer, *_: object) -> None:  # type: ignore[no-untyped-def, override]
        if trainer.current_epoch == 2:
            raise Killed


def test_training_is_reproducible_and_a_resumed_one_ends_with_the_same_weights(
    dataset: TerrainDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, metrics = fit_network(
        trainable(SMALL), dataset, 3, FitOptions(device="cpu", trainer=EXACT)
    )
    assert set(metrics) == {"train_loss", "valid_loss", "valid_rmse", "epoch"}
    with monkeypatch.context() as patch:
        patch.setattr(networks, "KeepBest", KillInTheThirdEpoch)
        with pytest.raises(Killed):
            fit_network(
                trainable(SMALL),
                dataset,
                3,
                FitOptions(device="cpu", folder=tmp_path, trainer=EXACT),
            )
    torch.manual_seed(99)  # what the global generator holds must not matter
    again, resumed = fit_network(
        trainable(SMALL),
        dataset,
        3,
        FitOptions(device="cpu", folder=tmp_path, resume=True, trainer=EXACT),
    )
    measured = ("valid_loss", "valid_rmse", "epoch")
    assert [resumed[name] for name in measured] == [metrics[name] for name in measured]
    for name, value in whole.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name
    with pytest.raises(CheckpointError, match="Use the settings of that training"):
        fit_network(
            trainable(replace(SMALL, components=2)),
            dataset,
            3,
            FitOptions(device="cpu", folder=tmp_path, resume=True, trainer=EXACT),
        )


def test_a_network_kept_in_half_precision_is_measured_as_it_is_kept(
    dataset: TerrainDataset,
) -> None:
    network, metrics = fit_network(
        trainable(replace(SMALL, max_epochs=1)),
        dataset,
        0,
        FitOptions(device="cpu", trainer=EXACT),
        half_precision=True,
    )
    whole, before = fit_network(
        trainable(replace(SMALL, max_epochs=1)),
        dataset,
        0,
        FitOptions(device="cpu", trainer=EXACT),
    )
    for name, value in as_stored(whole.state_dict(), True).items():
        assert torch.equal(value, network.state_dict()[name]), name
    valid = MapData(dataset, 2, 0, fields=("rgb", "slope_deg", "traversability")).valid
    assert network.measure(valid).items() <= metrics.items()
    # Measured in the same way as in training, of which the rounding is all that changes
    # it.
    for name, value in whole.measure(valid).items():
        assert value == pytest.approx(before[name], rel=1e-4), name
        assert value != metrics[name]


def test_maps_are_jittered_and_slopes_scaled_by_the_training_maps(
    dataset: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    jitters: list[float] = []

    class Watched(MapData):
        def __init__(self, *arguments: Any, **named: Any) -> None:
            super().__init__(*arguments, **named)
            jitters.append(self.augmentation.jitter)

    monkeypatch.setattr(networks, "MapData", Watched)
    network, _ = fit_network(
        trainable(replace(SMALL, max_epochs=1)),
        dataset,
        0,
        FitOptions(device="cpu", trainer=EXACT),
    )
    assert jitters == [SMALL.jitter]
    slopes = torch.from_numpy(dataset.read("train", fields=["slope_deg"])["slope_deg"])
    torch.testing.assert_close(network.slope_scale_deg, slopes.square().mean().sqrt())


def test_what_is_measured_in_validation_leaves_out_what_was_not_observed() -> None:
    network, terrain = build(), make_terrain(size=32)
    observed = terrain.traversability.clone()
    observed[:, ::2] = float("nan")
    logged: dict[str, torchmetrics.Metric] = {}
    network.log_dict = lambda metrics, **_: logged.update(metrics)  # type: ignore[method-assign, assignment]
    batch = {
        "rgb": terrain.rgb,
        "slope_deg": terrain.slope_deg,
        "traversability": observed,
    }
    with torch.no_grad():
        network.validation_step(batch, 0)
    mixture = network.predict(terrain.observe())
    error = (mixture.mean() - observed)[:, 1::2].square().mean().sqrt()
    nll = -mixture.log_prob(terrain.traversability)[:, 1::2].mean()
    torch.testing.assert_close(logged["valid_rmse"].compute(), error)
    torch.testing.assert_close(logged["valid_loss"].compute(), nll)


# --- checkpoints and the command ---


def checkpoint(network: MixtureDensityModel) -> Checkpoint:
    part = Part(
        config=asdict(network.config),
        tensors=dict(network.state_dict()),
        seed=0,
        metrics={},
        data_id="x",
        data_digest="y",
    )
    return Checkpoint(model="mdn", class_names=("a", "b"), parts={"mdn": part})


def test_a_checkpoint_gives_the_network_back() -> None:
    network, seen = build(seed=5).train(), observe(1, 32, 32)
    again = open_checkpoint(checkpoint(network))
    first, second = network.predict(seen), again.predict(seen)
    assert isinstance(again, MixtureDensityModel)
    assert not network.training
    assert not MixtureDensityModel.from_tensors(
        asdict(network.config), (), network.state_dict()
    ).training
    for name in ("weights", "means", "stds"):
        assert torch.equal(getattr(first, name), getattr(second, name))


def test_a_checkpoint_of_a_pretrained_network_downloads_nothing() -> None:
    network = build()
    settings = {**asdict(network.config), "pretrained": True}
    again = MixtureDensityModel.from_tensors(settings, (), network.state_dict())
    assert not again.config.pretrained


@pytest.mark.parametrize(
    "change", [{"components": 7}, {"encoder": "resnet19"}, {"width": 3}, {"hidden": 0}]
)
def test_tensors_that_do_not_fit_are_refused(change: dict[str, object]) -> None:
    whole = checkpoint(build())
    part = replace(whole.part("mdn"), config={**whole.part("mdn").config, **change})
    with pytest.raises(CheckpointError, match="Train the model again"):
        open_checkpoint(whole.with_part("mdn", part))


def test_a_checkpoint_without_the_network_says_how_to_train_it() -> None:
    with pytest.raises(CheckpointError, match="benchnav-train fit mdn"):
        open_checkpoint(Checkpoint(model="mdn", class_names=()))


def test_the_command_trains_a_checkpoint_that_is_evaluated(
    dataset: TerrainDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    where = ["mdn", "--data", dataset.path, "--out", "mine", *QUICK]
    assert (
        call(
            "train",
            *where,
            "--trainer.max_epochs",
            2,
            "--seed",
            7,
            "--mdn.components",
            2,
        )
        == 0
    )
    out, err = capfd.readouterr()
    assert re.search(r"validation loss -?[\d.]+, rmse [\d.]+", out)
    assert "wrote mine with mdn" in out
    assert [line.split(",")[0] for line in err.strip().splitlines()] == [
        "mdn: epoch 1/2",
        "mdn: epoch 2/2",
    ]
    there = load_checkpoint("mine")
    part = there.part("mdn")
    assert (there.model, part.seed, part.data_id) == ("mdn", 7, "tiny-v1")
    assert json.loads(Path("mine.training/mdn/settings.json").read_text())["seed"] == 7
    assert (
        part.config["max_epochs"],
        part.config["components"],
        part.half_precision,
    ) == (2, 2, True)
    seen = observe(1, 32, 32)
    own: Any = load_model("mine")
    assert own.predict_raw(layers(seen)).weights.shape == (1, 2, 32, 32)
    assert own.predict(seen).shape == (1, 32, 32)
    assert own.temperature == part.config["temperature"]
    # What it says of itself was measured on what is kept.
    kept = MixtureDensityModel.from_tensors(part.config, (), part.tensors)
    valid = MapData(dataset, 2, 0, fields=("rgb", "slope_deg", "traversability")).valid
    assert kept.measure(valid).items() <= dict(part.metrics).items()

    assert (
        call(
            "train",
            "evaluate",
            "mine",
            "--data",
            dataset.path,
            "--splits",
            "[test/std]",
        )
        == 0
    )
    assert "test/std" in capfd.readouterr().out

    settings = ["--trainer.max_epochs", 2, "--seed", 7, "--mdn.components", 2]
    assert call("train", *where, *settings, "--resume") == 0  # nothing is left to do
    assert capfd.readouterr().err == ""
    for wrong in ([], ["--resume"], ["--resume", "--seed", 8]):
        assert call("train", *where, *wrong) == 2
        lines = capfd.readouterr().err.strip().splitlines()
        assert len(lines) == 1
        assert "--overwrite" in lines[0]
    assert load_checkpoint("mine").part("mdn").seed == 7
    replaced = ["--overwrite", "--trainer.max_epochs", 1, "--half_precision", "false"]
    assert call("train", *where, *replaced) == 0
    after = load_checkpoint("mine").part("mdn")
    assert (after.seed, after.config["components"], after.half_precision) == (
        0,
        3,
        False,
    )


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--out", "x", "--mdn.components", "0"], "components"),
        (["--out", "x", "--mdn.encoder", "resnet19"], "resnet19"),
        (["--out", "x", "--trainer.logger", "1"], "logger"),
        (["--out", "."], "contains no config.json"),
        ([], "out"),
    ],
)
def test_bad_input_is_refused_in_one_line(
    arguments: list[str],
    expected: str,
    dataset: TerrainDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    assert call("train", "mdn", "--data", dataset.path, *arguments) == 2
    lines = capfd.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert expected in lines[0]
    assert not (tmp_path / "x").exists()
