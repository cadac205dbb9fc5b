import logging
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import lightning
import pytest
import segmentation_models_pytorch as smp
import torch
from torchmetrics.classification import MulticlassJaccardIndex

from benchnav.core.errors import ConfigError
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.config import ClassifierConfig
from benchnav.models.nets.classifier import MeanIoU, TerrainClassifier, build_network
from benchnav.models.training.best import KeepBest
from benchnav.models.training.fit import FitOptions
from benchnav.models.training.networks import fit_network
from tests.models.support import names, scale, trainable

CPU = FitOptions(device="cpu", trainer={"precision": "32-true"})
MEAN, STD = torch.tensor([100.0, 90.0, 80.0]), torch.tensor([20.0, 25.0, 30.0])


def build(seed: int = 0, **settings: object) -> TerrainClassifier:
    config = ClassifierConfig(**settings)  # type: ignore[arg-type]
    return TerrainClassifier(config).build(scale(MEAN, STD), names(4), seed).eval()


def image(height: int, width: int, batch: int = 1) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(5)
    rgb = torch.randint(
        0, 256, (batch, 3, height, width), generator=generator, dtype=torch.uint8
    )
    return {"rgb": rgb}


@pytest.mark.parametrize("shape", [(8, 8), (33, 20), (32, 64)])
def test_maps_of_any_size_are_classified(shape: tuple[int, int]) -> None:
    with torch.no_grad():
        logits = build()(image(*shape))
    assert logits.shape == (1, 4, *shape)
    assert bool(logits.isfinite().all())


def test_colours_are_normalised_by_the_training_maps() -> None:
    model = build()
    seen: list[torch.Tensor] = []
    model.network.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    maps = image(32, 32)
    with torch.no_grad():
        model(maps)
    expected = (maps["rgb"].float() - MEAN.view(3, 1, 1)) / STD.view(3, 1, 1)
    torch.testing.assert_close(seen[0], expected)


def test_logits_are_divided_by_the_temperature_once_training_is_over() -> None:
    model, rgb = build(), image(32, 32)
    with torch.no_grad():
        plain = model(rgb)
        model.temperature = 2.5
        torch.testing.assert_close(model(rgb), plain / 2.5)


@pytest.mark.parametrize("smoothing", [0.0, 0.2])
@pytest.mark.parametrize("dice", [0.0, 0.7])
def test_the_loss_is_what_the_settings_say(dice: float, smoothing: float) -> None:
    generator = torch.Generator().manual_seed(2)
    logits = torch.randn(2, 4, 8, 8, generator=generator)
    class_id = torch.randint(0, 4, (2, 8, 8), generator=generator)
    chosen = torch.nn.functional.one_hot(class_id, 4).movedim(-1, 1).double()
    log_p = logits.double().log_softmax(1)
    target = (1 - smoothing) * chosen + smoothing / 4
    expected = -(target * log_p).sum(1).mean()
    if dice:
        shares, axes = log_p.exp(), (0, 2, 3)
        overlap = 2 * (shares * chosen).sum(axes) / (shares + chosen).sum(axes)
        expected += dice * (1 - overlap).mean()
    found = build(dice=dice, label_smoothing=smoothing).loss(logits, class_id)
    torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-5)


def test_initial_weights_are_a_function_of_the_seed_alone() -> None:
    before = torch.random.get_rng_state()
    first, second, other = (
        next(build(seed).network.parameters()) for seed in (0, 0, 1)
    )
    assert torch.equal(first, second)
    assert not torch.equal(first, other)
    assert torch.equal(before, torch.random.get_rng_state())


def test_another_architecture_and_encoder_fit() -> None:
    with torch.no_grad():
        assert build(architecture="fpn", encoder="resnet34")(image(32, 32)).shape == (
            1,
            4,
            32,
            32,
        )


@pytest.mark.parametrize(
    ("name", "value"), [("architecture", "unett"), ("encoder", "resnet19")]
)
def test_an_unknown_network_is_refused(name: str, value: str) -> None:
    with pytest.raises(ConfigError, match=value):
        build(**{name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("learning_rate", 0.0),
        ("batch_size", 1),
        ("max_epochs", 0),
        ("max_epochs", "many"),
        ("dice", -1.0),
        ("weight_decay", -1.0),
        ("label_smoothing", 1.0),
        ("jitter", 1.0),
        ("encoder_depth", 0),
        ("encoder_depth", 6),
        ("decoder_channels", (32, 0, 16)),
    ],
)
def test_settings_that_cannot_train_are_refused(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=name):
        ClassifierConfig(**{name: value})  # type: ignore[arg-type]


def test_the_default_size_is_that_of_segmentation_models_itself() -> None:
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(3)
        plain = smp.create_model(
            "unet", "resnet18", encoder_weights=None, in_channels=3, classes=32
        )
    built = build(3).network.network.state_dict()
    assert built.keys() == plain.state_dict().keys()
    assert all(
        torch.equal(built[name], value) for name, value in plain.state_dict().items()
    )


@pytest.mark.parametrize(("depth", "stride"), [(3, 8), (4, 16), (5, 32)])
def test_maps_are_padded_to_the_stride_of_the_encoder(depth: int, stride: int) -> None:
    model = build(encoder_depth=depth)
    seen: list[torch.Tensor] = []
    model.network.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    with torch.no_grad():
        assert model(image(33, 40)).shape == (1, 4, 33, 40)
    assert seen[0].shape[-2:] == (-(-33 // stride) * stride, -(-40 // stride) * stride)


def test_depth_and_channels_reach_encoder_and_decoder() -> None:
    model = build(encoder_depth=3, decoder_channels=(48, 24, 12))
    network = model.network.network
    assert [block.conv1[0].out_channels for block in network.decoder.blocks] == [
        48,
        24,
        12,
    ]
    own = build(encoder_depth=3).network.network
    assert [block.conv1[0].out_channels for block in own.decoder.blocks] == [64, 32, 16]
    # The fourth and fifth stage are not there to be stored.
    assert not list(network.encoder.layer3.parameters()) + list(
        network.encoder.layer4.parameters()
    )
    assert list(network.encoder.layer2.parameters())


@pytest.mark.parametrize("depth", [3, 4])
def test_every_weight_of_a_smaller_network_is_trained(depth: int) -> None:
    model = build(encoder_depth=depth).train()
    assert all(weight.grad is None for weight in model.parameters())
    model(image(32, 32, batch=2)).sum().backward()
    assert all(weight.grad is not None for weight in model.parameters())


@pytest.mark.parametrize("architecture", ["unet", "linknet", "unetplusplus", "manet"])
def test_smaller_networks_of_other_architectures(architecture: str) -> None:
    small = build(architecture=architecture, encoder="mobilenet_v2", encoder_depth=4)
    with torch.no_grad():
        assert small(image(32, 32)).shape == (1, 4, 32, 32)
    assert _weights(small) < _weights(
        build(architecture=architecture, encoder="mobilenet_v2")
    )


def _weights(model: torch.nn.Module) -> int:
    return sum(weight.numel() for weight in model.parameters())


def test_a_smaller_network_is_read_back_from_plain_settings() -> None:
    settings = {"encoder_depth": 3, "decoder_channels": [32, 16, 8]}
    model = build(encoder_depth=3, decoder_channels=(32, 16, 8))
    again = TerrainClassifier.from_tensors(settings, names(4), model.state_dict())
    with torch.no_grad():
        assert torch.equal(model(image(32, 32)), again(image(32, 32)))


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        (
            {"decoder_channels": (32, 16)},
            r"`encoder_depth` 5 and `decoder_channels` \[32, 16\]",
        ),
        ({"architecture": "fpn", "decoder_channels": (9,)}, "no such setting"),
        (
            {"architecture": "fpn", "encoder_depth": 4},
            "output has 128 cells per side, not 64",
        ),
    ],
)
def test_sizes_that_do_not_fit_are_refused(
    settings: dict[str, object], why: str
) -> None:
    with pytest.raises(ConfigError, match=why):
        build(**settings)


def test_training_is_reproducible_and_learns(
    dataset: TerrainDataset,
    capfd: pytest.CaptureFixture[str],
    tmp_path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    config = ClassifierConfig(max_epochs=4, batch_size=5)
    first, metrics = fit_network(trainable(config), dataset, 3, CPU)
    lines = capfd.readouterr().err.strip().splitlines()
    second, _ = fit_network(trainable(config), dataset, 3, CPU)
    for name, value in first.state_dict().items():
        assert torch.equal(value, second.state_dict()[name]), name
    assert metrics["valid_accuracy"] > 0.15
    assert [line.split(",")[0] for line in lines] == [
        f"classifier: epoch {n}/4" for n in (1, 2, 3, 4)
    ]
    assert list(tmp_path.iterdir()) == []


def test_the_best_epoch_is_kept() -> None:
    model, best = torch.nn.Linear(1, 1), KeepBest()
    for epoch, loss in enumerate((2.0, 1.0, 3.0, float("nan"))):
        torch.nn.init.constant_(model.weight, epoch)
        trainer = SimpleNamespace(
            callback_metrics={"valid_loss": torch.tensor(loss)}, current_epoch=epoch
        )
        best.on_validation_epoch_end(trainer, model)  # type: ignore[arg-type]
    best.on_fit_end(trainer, model)  # type: ignore[arg-type]
    assert model.weight.item() == 1
    assert best.best["metrics"] == {"valid_loss": 1.0, "epoch": 2}
    assert trainer.callback_metrics == {"valid_loss": 1.0, "epoch": 2}


def test_training_stops_when_validation_no_longer_gains(
    dataset: TerrainDataset, capfd: pytest.CaptureFixture[str]
) -> None:
    config = ClassifierConfig(
        max_epochs=30, batch_size=5, patience=1, learning_rate=0.3
    )
    fit_network(trainable(config), dataset, 0, CPU)
    assert len(capfd.readouterr().err.strip().splitlines()) < 20


def test_a_loss_that_is_no_number_is_one_error() -> None:
    callback, module = KeepBest(), torch.nn.Linear(1, 1)
    trainer: Any = SimpleNamespace(
        callback_metrics={"valid_loss": torch.tensor(torch.nan)}, current_epoch=0
    )
    with pytest.raises(ConfigError, match="validate more often"):
        callback.on_fit_end(trainer, module)  # type: ignore[arg-type]
    callback.on_validation_epoch_end(trainer, module)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="learning_rate"):
        callback.on_fit_end(trainer, module)  # type: ignore[arg-type]


@pytest.mark.parametrize(("full_resolution", "learns"), [(True, True), (False, False)])
def test_classes_of_single_cells_are_learned_at_full_resolution_alone(
    full_resolution: bool, learns: bool
) -> None:
    # Each cell has a class of its own, told by its own colour; neighbours tell nothing.
    class_id = torch.randint(
        0, 4, (8, 32, 32), generator=torch.Generator().manual_seed(0)
    )
    rgb = (60 + 40 * class_id)[:, None].expand(-1, 3, -1, -1).to(torch.uint8)
    model = build(full_resolution=full_resolution).train()
    optimizer = torch.optim.AdamW(model.parameters(), lr=5e-3)
    for _ in range(30):
        optimizer.zero_grad()
        model.loss(model({"rgb": rgb}), class_id).backward()
        optimizer.step()
    accuracy = (model({"rgb": rgb}).argmax(1) == class_id).float().mean()
    assert (accuracy > 0.95) == learns


def test_weights_without_full_resolution_are_read_back() -> None:
    model = build(full_resolution=False)
    again = TerrainClassifier.from_tensors(
        {"full_resolution": False}, names(4), model.state_dict()
    )
    with torch.no_grad():
        assert torch.equal(model(image(32, 32)), again(image(32, 32)))


@pytest.mark.parametrize("dice", [0.0, 0.7])
def test_cells_without_a_class_are_no_part_of_the_loss_and_the_measures(
    dice: float,
) -> None:
    model = build(dice=dice)
    logits = torch.randn(
        2, 4, 8, 8, generator=torch.Generator().manual_seed(2), requires_grad=True
    )
    class_id = torch.randint(
        0, 4, (2, 8, 8), generator=torch.Generator().manual_seed(3)
    )
    holed = class_id.clone()
    holed[..., 5:] = UNLABELLED
    loss = model.loss(logits, holed)
    torch.testing.assert_close(loss, model.loss(logits[..., :5], class_id[..., :5]))
    (gradient,) = torch.autograd.grad(loss, logits)
    assert bool((gradient[..., 5:] == 0).all())
    assert bool((gradient[..., :5] != 0).any())
    for metric in (model.metrics["accuracy"], model.metrics["miou"]):
        found, wanted = (
            metric(logits.argmax(1), holed),
            metric(logits[..., :5].argmax(1), class_id[..., :5]),
        )
        assert found == wanted


@pytest.mark.parametrize("dice", [0.0, 0.7])
def test_a_batch_without_labels_has_no_loss_and_no_gradient(dice: float) -> None:
    model = build(dice=dice)
    logits = torch.randn(
        2, 4, 8, 8, generator=torch.Generator().manual_seed(2), requires_grad=True
    )
    loss = model.loss(logits, torch.full((2, 8, 8), UNLABELLED))
    assert loss.item() == 0
    (gradient,) = torch.autograd.grad(loss, logits)
    assert bool((gradient == 0).all())


def test_mean_iou_is_over_the_classes_that_occur_in_truth() -> None:
    # Accuracy 0.978 and IoUs of 0.971 and 0.969 must not read 0.32 since four other
    # classes were said once.
    class_id = torch.tensor([0] * 500 + [1] * 500)
    found = class_id.clone()
    found[:4], found[500:502] = torch.tensor([2, 3, 4, 5]), 0
    ious = (496 / 502, 498 / 500)
    assert float(MulticlassJaccardIndex(6)(found, class_id)) == pytest.approx(
        sum(ious) / 6
    )
    metric = MeanIoU(6, average="none", ignore_index=UNLABELLED)
    unknown = torch.full((50,), UNLABELLED)
    for some, true in ((found, class_id), (torch.full((50,), 4), unknown)):
        metric.update(some, true)
    assert float(metric.compute()) == pytest.approx(sum(ious) / 2)
    # as it is logged in training
    logged = build().metrics(found.clamp(max=3), class_id)
    assert float(logged["valid_miou"]) == pytest.approx(sum(ious) / 2)


def test_a_trained_classifier_is_measured_on_labelled_cells_alone() -> None:
    rgb, class_id = (
        image(8, 8, batch=2)["rgb"],
        torch.randint(0, 4, (2, 8, 8), generator=torch.Generator().manual_seed(1)),
    )
    holed = class_id.clone()
    holed[..., 3:] = UNLABELLED

    class Maps:
        shape = (8, 8)

        def __init__(self, ids: torch.Tensor, width: int) -> None:
            self.some = {"rgb": rgb[..., :width], "class_id": ids[..., :width]}

        def __len__(self) -> int:
            return 2

        def chunks(
            self, device: torch.device
        ) -> list[tuple[list[int], dict[str, torch.Tensor]]]:
            return [([0, 1], self.some)]

    class Colour(TerrainClassifier):
        def forward(self, maps: Mapping[str, torch.Tensor]) -> torch.Tensor:
            seen = maps["rgb"]
            return torch.cat((seen.float() / 100, 1 + 0 * seen[:, :1]), dim=1)

    colour = (
        Colour(ClassifierConfig(encoder="mobilenet_v2"))
        .build(map_classes=names(4))
        .eval()
    )
    found, wanted = (
        colour.measure(maps) for maps in (Maps(holed, 8), Maps(class_id, 3))
    )  # type: ignore[arg-type]
    assert found == pytest.approx(wanted)
    assert 0 < found["valid_accuracy"] < 1


def test_losses_of_validation_are_weighed_by_labelled_cells() -> None:
    """Two maps, one with a single labelled cell, one with all: the mean over cells, in
    training and afterwards.
    """
    model, rgb = build(), image(8, 8, batch=3)["rgb"]
    class_id = torch.randint(
        0, 4, (3, 8, 8), generator=torch.Generator().manual_seed(1)
    )
    class_id[0].fill_(UNLABELLED)[0, 0] = 2
    class_id[2] = UNLABELLED
    with torch.no_grad():
        log_p = model({"rgb": rgb}).log_softmax(1).movedim(1, -1)
    labelled = class_id != UNLABELLED
    wanted = -log_p[labelled].gather(1, class_id[labelled][:, None]).double().mean()
    batches = [
        {"rgb": rgb[i : i + 1], "class_id": class_id[i : i + 1].byte()}
        for i in range(3)
    ]

    class Maps:
        def chunks(
            self, device: torch.device
        ) -> list[tuple[list[int], dict[str, torch.Tensor]]]:
            return [([place], batch) for place, batch in enumerate(batches)]

    found = model.measure(Maps())  # type: ignore[arg-type]
    assert found["valid_loss"] == pytest.approx(float(wanted), rel=1e-5)
    trainer = lightning.Trainer(
        accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False,
    )  # fmt: skip
    loader = torch.utils.data.DataLoader(batches, batch_size=None)  # type: ignore[arg-type]
    (logged,) = trainer.validate(model, loader, verbose=False)
    assert logged["valid_loss"] == pytest.approx(float(wanted), rel=1e-5)


def test_what_a_hub_says_of_its_trials_does_not_bury_the_error(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    hub = logging.getLogger("huggingface_hub.utils._http")

    def unreachable(*given: object, **named: object) -> None:
        hub.warning("Retrying in 1s [Retry 1/5].")
        raise OSError("no connection")

    monkeypatch.setattr("segmentation_models_pytorch.create_model", unreachable)
    with pytest.raises(ConfigError, match="ImageNet weights of resnet18"):
        build_network(ClassifierConfig(pretrained=True), 3, 3)
    assert caplog.records == []
    hub.warning("seen again")
    assert len(caplog.records) == 1


@pytest.mark.parametrize("focal", [0.5, 2.0])
def test_the_focal_loss_by_its_definition(focal: float) -> None:
    generator = torch.Generator().manual_seed(0)
    logits = 3 * torch.randn(2, 4, 3, 5, generator=generator)
    class_id = torch.randint(0, 4, (2, 3, 5), generator=generator)
    class_id[0, 0] = UNLABELLED
    known = class_id != UNLABELLED
    share = (
        logits.softmax(1)
        .movedim(1, -1)[known]
        .gather(1, class_id[known][:, None])[:, 0]
    )
    expected = -((1 - share) ** focal * share.log()).mean()
    torch.testing.assert_close(build(focal=focal).loss(logits, class_id), expected)
    torch.testing.assert_close(
        build(focal=0.0).loss(logits, class_id), -share.log().mean()
    )
    assert build(focal=focal).loss(logits, torch.full_like(class_id, UNLABELLED)) == 0
    smooth = build(focal=focal, label_smoothing=0.2).loss(logits, class_id)
    each = torch.nn.functional.cross_entropy(
        logits.movedim(1, -1)[known],
        class_id[known],
        label_smoothing=0.2,
        reduction="none",
    )
    torch.testing.assert_close(smooth, ((1 - share) ** focal * each).mean())


def test_the_focal_loss_has_a_finite_gradient_where_a_class_is_certain() -> None:
    logits = (
        torch.tensor([[200.0, 0.0], [0.0, 200.0]]).view(2, 2, 1, 1).requires_grad_()
    )
    build(focal=0.5).loss(logits, torch.zeros(2, 1, 1, dtype=torch.int64)).backward()
    assert logits.grad is not None
    assert bool(logits.grad.isfinite().all())


@pytest.mark.parametrize("focal", [-1.0, float("inf")])
def test_a_focus_that_is_none_is_refused(focal: float) -> None:
    with pytest.raises(ConfigError, match="focal"):
        ClassifierConfig(focal=focal)
