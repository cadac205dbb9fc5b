"""What holds of every model of the zoo: it recovers a known distribution, resumes,
keeps the contract, is kept.
"""

import copy
import pickle
from pathlib import Path

import pytest
import torch

from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.base import predict
from benchnav.models.predictor import Oracle
from benchnav.models.training.fit import FitOptions
from benchnav.models.training.networks import fit_network
from benchnav.testing import check_model
from tests.models.nets.test_mdn import draw_two_grounds, layers
from tests.models.zoo.support import EXACT, ZOO, killed_in, make, to_train

# Largest error of the CDF in the mean over a ground: evidential knows no atoms, and its
# tails are heavy.
LIMITS = {"evidential": 0.15, "mc_dropout": 0.11, "quantile": 0.13}
# Hidden channels, and steps. Dropout widens what a narrow network predicts: with 32 it
# erred by 0.15 in the mean of six seeds, with 128 by 0.05, and by 0.086 at most.
# Hidden units, steps and learning rate: the noise of dropout leaves high rates nowhere
# to settle.
TRAINING = {"mc_dropout": (64, 300, 5e-3)}


@pytest.mark.parametrize("name", ZOO)
def test_it_recovers_a_known_distribution(name: str) -> None:
    hidden, steps, rate = TRAINING.get(name, (32, 60, 2e-2))
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    network = make(
        name, hidden=hidden, **({"dropout": 0.05} if name == "mc_dropout" else {})
    ).train()
    optimizer = torch.optim.AdamW(network.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps)
    for _ in range(steps):
        terrain, _ = draw_two_grounds(generator)
        optimizer.zero_grad()
        network.loss(network(layers(terrain)), terrain.traversability).backward()
        optimizer.step()
        schedule.step()
    terrain, grounds = draw_two_grounds(generator)
    # normalised by the batch as in training: running averages are too young
    network.eval().network.train()
    with torch.no_grad():
        found = network.to_distribution(network(layers(terrain)))
    truth = predict(Oracle(), terrain)
    errors = [
        float((found.cdf(value) - truth.cdf(value))[ground].mean().abs())
        for ground in grounds
        for value in (
            0.0,
            0.2,
            0.5,
            0.9,
            1 - 1e-6,
        )  # with both atoms, which are up to 0.31
    ]
    rmse = float((found.mean() - truth.mean()).square().mean().sqrt())
    assert max(errors) < LIMITS.get(name, 0.08)
    assert rmse < 0.05
    assert float(found.crps(terrain.traversability).mean()) < 1.08 * float(
        truth.crps(terrain.traversability).mean()
    )


@pytest.mark.parametrize("name", ZOO)
def test_a_training_that_was_killed_in_each_epoch_ends_with_the_same_weights(
    name: str, dataset: TerrainDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, metrics = fit_network(
        to_train(name), dataset, 3, FitOptions(device="cpu", trainer=EXACT)
    )
    for epoch in range(3):
        options = FitOptions(
            device="cpu", folder=tmp_path, resume=epoch > 0, trainer=EXACT
        )
        with killed_in(epoch, monkeypatch):
            fit_network(to_train(name), dataset, 3, options)
        torch.manual_seed(99)  # what the global generator holds must not matter
    options = FitOptions(device="cpu", folder=tmp_path, resume=True, trainer=EXACT)
    again, resumed = fit_network(to_train(name), dataset, 3, options)
    for key, value in whole.state_dict().items():
        assert torch.equal(value, again.state_dict()[key]), key
    assert again.temperature == whole.temperature
    measured = ("valid_loss", "valid_rmse", "epoch")
    assert [resumed[key] for key in measured] == [metrics[key] for key in measured]

    rebuilt = ZOO[name][0].from_tensors(whole.settings(), (), whole.state_dict())
    seen = dataset.terrain("valid", [0, 1]).observe()
    assert torch.equal(
        rebuilt.predict(seen).quantile(0.3), whole.predict(seen).quantile(0.3)
    )


@pytest.mark.parametrize("name", ZOO)
def test_it_keeps_the_contract_of_trainable_models(name: str) -> None:
    kind, config = ZOO[name]

    class Small(kind):  # type: ignore[valid-type, misc]
        def __init__(self, config: type(config) = config) -> None:  # type: ignore[valid-type]
            super().__init__(config)

    check_model(Small, shapes=((20, 37),))


@pytest.mark.parametrize("name", ZOO)
def test_cells_that_were_not_observed_are_left_out_of_the_loss(name: str) -> None:
    generator = torch.Generator().manual_seed(1)
    terrain, _ = draw_two_grounds(generator)
    network = make(name)
    outputs = network(layers(terrain))
    some = terrain.traversability.clone()
    some[:, :10] = torch.nan
    rows = (
        tuple(value[:, :, 10:] for value in outputs)
        if isinstance(outputs, tuple)
        else outputs[:, :, 10:]
    )
    torch.testing.assert_close(
        network.loss(outputs, some), network.loss(rows, some[:, 10:])
    )
    assert network.loss(outputs, torch.full_like(some, torch.nan)) == 0


@pytest.mark.parametrize("name", ZOO)
def test_slope_is_left_out_where_it_is_no_input(name: str) -> None:
    terrain, _ = draw_two_grounds(torch.Generator().manual_seed(1))
    network = make(name, inputs=("rgb",))
    found = network.predict(terrain.observe()).mean()
    assert found.shape == terrain.traversability.shape
    assert network.joint[0].in_channels == make(name).joint[0].in_channels - 1


@pytest.mark.parametrize("name", ZOO)
def test_a_pickled_or_copied_network_is_the_same_with_a_loss_of_its_own(
    name: str,
) -> None:
    terrain, _ = draw_two_grounds(torch.Generator().manual_seed(1))
    network, seen = make(name), terrain.observe()
    outputs = network(layers(terrain))
    for other in (pickle.loads(pickle.dumps(network)), copy.deepcopy(network)):
        assert torch.equal(
            other.predict(seen).quantile(0.3), network.predict(seen).quantile(0.3)
        )
        for training in (True, False):
            expected = network.train(training).loss(outputs, terrain.traversability)
            network.train(not training)
            assert torch.equal(
                other.train(training).loss(outputs, terrain.traversability), expected
            )
