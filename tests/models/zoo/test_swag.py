"""SWAG: moments of the weights against NumPy, draws against plain networks of the drawn
weights.
"""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.training import networks
from benchnav.models.training.best import KeepBest
from benchnav.models.training.data import Augmentation, MapData
from benchnav.models.training.fit import FitOptions
from benchnav.models.training.networks import fit_network
from tests.models.zoo.support import EXACT, ZOO, make, to_train

PLACES = ("network.head.1.weight", "joint.0.weight", "head.bias")


class Watched(KeepBest):
    """Notes weights and rate after each step."""

    weights: list[dict[str, Tensor]]
    rates: list[float]

    def on_fit_start(self, trainer: Any, module: Any) -> None:
        Watched.weights, Watched.rates = [], []

    def on_train_batch_end(self, trainer: Any, module: Any, *_: object) -> None:
        named = dict(module.named_parameters())
        Watched.weights.append({name: named[name].detach().clone() for name in PLACES})
        Watched.rates.append(trainer.optimizers[0].param_groups[0]["lr"])


@pytest.fixture(scope="module")
def trained(dataset: TerrainDataset) -> Any:
    """A model of six epochs of two steps, whose last six steps are collected."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(networks, "KeepBest", Watched)
        how = to_train("swag", collect=0.5, max_epochs=6)
        return fit_network(how, dataset, 3, FitOptions(device="cpu", trainer=EXACT))


def test_moments_are_those_of_the_last_steps(trained: Any) -> None:
    model, _ = trained
    assert int(model.collected) == 6
    assert len(Watched.weights) == 12
    for name in PLACES:
        seen = np.stack(
            [weights[name].double().numpy() for weights in Watched.weights[-6:]]
        )
        place = model.weight_names.index(name)
        np.testing.assert_allclose(
            model.get_buffer(f"mean_{place}"), seen.mean(0), rtol=1e-4, atol=1e-6
        )
        np.testing.assert_allclose(
            model.get_buffer(f"std_{place}"), seen.std(0), rtol=2e-3, atol=1e-6
        )
        assert float(model.get_buffer(f"std_{place}").max()) > 1e-4


def test_training_does_not_stop_early_and_keeps_the_last_weights(
    trained: Any, dataset: TerrainDataset
) -> None:
    model, metrics = trained
    assert metrics["epoch"] == 6
    for name in PLACES:
        assert torch.equal(
            dict(model.named_parameters())[name].detach(), Watched.weights[-1][name]
        )
    impatient = to_train("swag", patience=1, learning_rate=0.3, max_epochs=4)
    assert (
        fit_network(impatient, dataset, 3, FitOptions(device="cpu", trainer=EXACT))[1][
            "epoch"
        ]
        == 4
    )


def test_the_rate_falls_and_stays(trained: Any) -> None:
    rate = ZOO["swag"][1].learning_rate
    np.testing.assert_allclose(Watched.rates[6:], 0.25 * rate)
    assert max(Watched.rates) == pytest.approx(rate, rel=0.05)
    assert Watched.rates[0] < max(Watched.rates)


def test_the_share_and_the_rate_are_those_that_were_asked_for(
    dataset: TerrainDataset,
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(networks, "KeepBest", Watched)
        how = to_train("swag", collect=0.2, collect_rate=0.7, max_epochs=5)
        model, _ = fit_network(how, dataset, 3, FitOptions(device="cpu", trainer=EXACT))
    assert int(model.collected) == 2
    np.testing.assert_allclose(Watched.rates[-2:], 0.7 * how.config.learning_rate)


def test_a_prediction_is_the_average_of_plain_networks_of_the_drawn_weights(
    trained: Any, dataset: TerrainDataset
) -> None:
    model, _ = trained
    seen = dataset.terrain("valid", [0, 1]).observe()
    found = model.predict_raw({"rgb": seen.rgb, "slope_deg": seen.slope_deg})
    assert found.means.shape[1] == 3
    # The maps that the statistics were made of: the first epoch's, here all.
    fields = ("rgb", "slope_deg", "traversability")
    data = MapData(dataset, 5, 3, fields, Augmentation(jitter=model.config.jitter))
    batches = list(data.train_dataloader())
    for index in range(3):
        plain = make("mean_variance")
        tensors = {
            name: value
            for name, value in model.state_dict().items()
            if name in plain.state_dict()
        }
        weights = {
            name: value
            for name, value in model.draw(index).items()
            if "running" not in name
        }
        plain.load_state_dict({**tensors, **weights})
        for layer in plain.modules():
            if isinstance(layer, torch.nn.BatchNorm2d):
                layer.reset_running_stats()
                layer.momentum = None
        plain.train()
        with torch.no_grad():
            for batch in batches:
                plain(batch)
        mixture = plain.predict(seen)
        torch.testing.assert_close(
            found.means[:, index], mixture.means[:, 0], rtol=1e-3, atol=1e-4
        )
        torch.testing.assert_close(
            found.stds[:, index], mixture.stds[:, 0], rtol=1e-3, atol=1e-4
        )
    assert float((found.means[:, 0] - found.means[:, 1]).abs().max()) > 1e-4


def test_draws_are_normal_about_the_mean_and_of_the_seed(trained: Any) -> None:
    model, _ = trained
    place = model.weight_names.index("network.head.1.weight")
    mean, std = model.get_buffer(f"mean_{place}"), model.get_buffer(f"std_{place}")
    drawn = torch.stack(
        [model.draw(index)["network.head.1.weight"] for index in range(3)]
    )
    scores = ((drawn - mean) / std)[:, std > 0]
    assert abs(float(scores.mean())) < 0.15
    assert abs(float(scores.std()) - 1) < 0.1
    assert torch.equal(model.draw(1)["head.bias"], model.draw(1)["head.bias"])
    other = ZOO["swag"][0].from_tensors(model.settings(), (), model.state_dict())
    # of the seed that is kept
    assert torch.equal(other.draw(2)["head.bias"], model.draw(2)["head.bias"])
    other.draw_seed += 1
    assert not torch.equal(other.draw(2)["head.bias"], model.draw(2)["head.bias"])


def test_weights_that_are_kept_in_half_precision_keep_their_deviations(
    dataset: TerrainDataset,
) -> None:
    how, options = to_train("swag"), FitOptions(device="cpu", trainer=EXACT)
    whole, half = (
        fit_network(how, dataset, 3, options, half_precision=half)[0]
        for half in (False, True)
    )
    seen = dataset.terrain("valid", [0]).observe()
    layers = {"rgb": seen.rgb, "slope_deg": seen.slope_deg}
    first, second = whole.predict_raw(layers), half.predict_raw(layers)
    torch.testing.assert_close(first.means, second.means, rtol=0.02, atol=0.02)
    place = whole.weight_names.index("joint.0.weight")
    torch.testing.assert_close(
        whole.get_buffer(f"std_{place}"),
        half.get_buffer(f"std_{place}"),
        rtol=1e-2,
        atol=1e-7,
    )


def test_what_is_measured_is_of_the_draws(dataset: TerrainDataset) -> None:
    model, metrics = fit_network(
        to_train("swag"), dataset, 3, FitOptions(device="cpu", trainer=EXACT)
    )
    data = MapData(dataset, 5, 3, ("rgb", "slope_deg", "traversability"))
    measured = model.measure(data.valid)
    assert {name: metrics[name] for name in measured} == pytest.approx(measured)
    model.is_drawn.fill_(False)
    assert model.measure(data.valid)["valid_loss"] != pytest.approx(
        metrics["valid_loss"], rel=1e-4
    )


def test_other_seeds_make_other_draws() -> None:
    first, second = (make("swag", seed=seed) for seed in (1, 2))
    for model in (first, second):
        for name, value in model.named_buffers():
            if name.startswith("std_"):
                value.fill_(1.0)
    assert not torch.equal(first.draw(0)["head.bias"], second.draw(0)["head.bias"])
