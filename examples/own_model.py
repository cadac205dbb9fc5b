"""A traversability model of one's own: train it, keep it, check it, and measure it beside the oracle.

A model is a `TraversabilityModel` with one method, `predict(observation) -> TraversabilityMixture`: from colour,
elevation and slope of B maps to a Gaussian mixture of traversability λ in every cell, clipped to
[0, 1]. The model here is a toy: a perceptron that looks at one cell at a time and gives one Gaussian.

    python examples/own_model.py

The commands find a model by its file, here with its first option: `--model examples/own_model.py:ConstantModel:0.5`.
A family of models that are kept in checkpoints, such as `PixelModel`, needs a name instead, since reading a
checkpoint runs no code but what is known by name. Let your own package give it in its pyproject.toml, in
place of the call of `register` below; installed, it is known everywhere:

    [project.entry-points."benchnav.models"]
    pixel = "my_package.own_model:PixelModel"
"""

import tempfile
from pathlib import Path

import torch
from torch import Tensor, nn

from benchnav import Observation, TraversabilityMixture, register
from benchnav.datagen import TerrainDataset, create_dataset, load_recipe
from benchnav.models import (
    Checkpoint,
    ModelFamily,
    Part,
    TraversabilityModel,
    evaluate_model,
    load_checkpoint,
    load_model,
    save_checkpoint,
)
from benchnav.testing import check_model

SEED, STEPS, BATCH, HIDDEN = 0, 400, 4096, 32


class ConstantModel(TraversabilityModel):
    """The least that is a model: the same Gaussian everywhere. Any other should do better."""

    def __init__(self, mean: float = 0.6, std: float = 0.2) -> None:
        self.mean, self.std = mean, std

    def predict(self, observation: Observation) -> TraversabilityMixture:
        ones = torch.ones_like(observation.slope_deg).unsqueeze(1)  # [B, K = 1, H, W], on its device
        return TraversabilityMixture(ones, self.mean * ones, self.std * ones)


class PixelModel(ModelFamily):
    """Mean and standard deviation of λ from the colour and slope of the cell alone."""

    def __init__(self, network: nn.Module) -> None:
        self.network = network.eval()

    def predict(self, observation: Observation) -> TraversabilityMixture:
        self.network.to(observation.rgb.device)
        with torch.no_grad():
            mean, std = gaussian(self.network, observation.rgb, observation.slope_deg)
        return TraversabilityMixture(torch.ones_like(mean), mean, std)

    @classmethod
    def from_checkpoint(cls, checkpoint: Checkpoint) -> "PixelModel":
        """With this a class is a family: `load_model` reads its models from checkpoints that name it."""
        part = checkpoint.part("pixel")
        network = build_network(part.config["hidden"])
        network.load_state_dict(part.tensors)
        return cls(network)


def build_network(hidden: int) -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(4, hidden, 1), nn.SiLU(), nn.Conv2d(hidden, hidden, 1), nn.SiLU(), nn.Conv2d(hidden, 2, 1)
    )


def gaussian(network: nn.Module, rgb: Tensor, slope_deg: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and std before clipping, [B, 1, H, W], of images [B, 3, H, W] and slopes [B, H, W]."""
    seen = torch.cat([rgb / 255, slope_deg.unsqueeze(1) / 30], dim=1)
    mean, width = network(seen).chunk(2, dim=1)
    return mean, nn.functional.softplus(width) + 0.01


def train(dataset: TerrainDataset) -> nn.Module:
    """Maximises the likelihood of λ as observed on the split `train`."""
    terrain = dataset.terrain("train")
    cells = terrain.rgb.movedim(1, -1).reshape(-1, 3, 1, 1), terrain.slope_deg.reshape(-1, 1, 1)
    observed = terrain.traversability.reshape(-1, 1, 1)
    with torch.random.fork_rng():  # a seed of one's own leaves the global generator as it was
        torch.manual_seed(SEED)
        network = build_network(HIDDEN)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    generator = torch.Generator().manual_seed(SEED)
    for _ in range(STEPS):
        batch = torch.randint(len(observed), (BATCH,), generator=generator)
        mean, std = gaussian(network, *(values[batch] for values in cells))
        mixture = TraversabilityMixture(torch.ones_like(mean), mean, std)
        # λ is clipped to [0, 1]: its likelihood is a density inside and a probability at 0 and at 1.
        loss = -mixture.log_prob(observed[batch]).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return network


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for _ in create_dataset(load_recipe("tiny-v1"), folder / "tiny.h5"):
            pass
        dataset = TerrainDataset(folder / "tiny.h5")

        network = train(dataset)
        part = Part(
            config={"hidden": HIDDEN},
            tensors=dict(network.state_dict()),
            seed=SEED,
            metrics={},
            data_id=dataset.id,
            data_digest=dataset.digest,
        )
        # No class names, for it tells no classes. A checkpoint is data alone: reading it runs no code.
        save_checkpoint(folder / "mine", Checkpoint(model="pixel", class_names=(), parts={"pixel": part}))
        print(f"saved a checkpoint of {load_checkpoint(folder / 'mine').model!r}")

        register("model", "pixel", PixelModel)
        own = load_model(folder / "mine")
        check_model(own)  # raises an error that lists whatever breaks the contract
        print("kept the contract")

        observed = dataset.terrain("train").traversability
        constant = ConstantModel(float(observed.mean()), float(observed.std()))
        print(f"{'model':<10}{'split':<10}{'RMSE E[λ]':>10}{'NLL':>10}{'CRPS':>10}")
        for label, model in (("constant", constant), ("own", own), ("oracle", load_model("oracle"))):
            for split, quality in evaluate_model(model, dataset):
                found = quality.traversability
                print(f"{label:<10}{split:<10}{found.rmse_expected:10.4f}{found.nll:10.4f}{found.crps:10.4f}")


if __name__ == "__main__":
    main()
