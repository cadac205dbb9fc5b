"""Training a mixture density network."""

from dataclasses import asdict

import torch

from benchnav.core.mixture import TraversabilityMixture
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.checkpoint import Part
from benchnav.models.config import MDNConfig
from benchnav.models.nets.mdn import MDN, MixtureDensityNetwork, censored_nll
from benchnav.models.training.data import MapData, MapDataset, check_known, training_digest
from benchnav.models.training.fit import FitOptions, check_network, fit_network, say

_DEFAULT = FitOptions()


def fit_mdn(
    config: MDNConfig,
    dataset: TerrainDataset,
    seed: int = 0,
    options: FitOptions = _DEFAULT,
    half_precision: bool = False,
) -> tuple[MixtureDensityNetwork, dict[str, float]]:
    """Trains a network on the split `train` until the split `valid` no longer gains.

    Args:
        config: what to train.
        dataset: the maps.
        seed: root seed of weights, order and augmentation.
        options: how to train; precision is bf16-mixed where it is fast unless they say otherwise.
        half_precision: whether its kernels will be kept as float16, to which they are rounded before it is
            measured.

    Returns:
        The network with its best weights, on the CPU, and what was measured on `valid`.
    """
    data = MapData(
        dataset, config.batch_size, seed, config.jitter, ("slope_deg", "traversability"),
        in_memory=options.in_memory, workers=options.workers,
    )  # fmt: skip
    # Flat ground alone would have no scale.
    squares = sum(maps["slope_deg"].double().square().sum() for _, maps in data.train.chunks())
    cells = len(data.train) * data.train.shape[0] * data.train.shape[1]
    scale = (torch.as_tensor(squares) / cells).sqrt().clamp(min=1).float()
    network = MixtureDensityNetwork(config, *data.colour_statistics(), scale, seed)
    metrics = fit_network(network, MDN, config, data, seed, options, half_precision, measure_network)
    return network.cpu(), metrics


def check_mdn(config: MDNConfig, dataset: TerrainDataset, options: FitOptions) -> None:
    """Refuses a network that could not be trained, before anything is.

    Raises:
        ConfigError: its settings or those of the trainer do not fit.
        DatasetError: the maps are too few, or no traversability was observed in them.
    """
    check_known(dataset, "traversability")
    network = MixtureDensityNetwork(config, torch.zeros(3), torch.ones(3), torch.ones(()))
    image = torch.zeros(1, 3, *dataset.grid.shape, dtype=torch.uint8)
    check_network(network, [image, torch.zeros(1, *dataset.grid.shape)], config, dataset, options)


def measure_network(network: MixtureDensityNetwork, maps: MapDataset) -> dict[str, float]:
    """Measures a network as training does: `valid_loss` and `valid_rmse`.

    Args:
        network: in evaluation, on any device.
        maps: with `rgb`, `slope_deg` and `traversability`.
    """
    device, loss, squares, cells = network.device, 0.0, 0.0, 0
    with torch.inference_mode():
        for _, some in maps.chunks(device):
            log_weights, means, stds = network(some["rgb"], some["slope_deg"])
            observed = some["traversability"]
            seen = observed.isfinite()
            count = int(seen.sum())
            loss += float(censored_nll(log_weights, means, stds, observed)) * count
            gap = TraversabilityMixture(log_weights.exp(), means, stds).mean()[seen] - observed[seen]
            squares += float(gap.double().square().sum())
            cells += count
    return {"valid_loss": loss / max(1, cells), "valid_rmse": (squares / max(1, cells)) ** 0.5}


def train_mdn_part(
    config: MDNConfig, dataset: TerrainDataset, seed: int, options: FitOptions, half_precision: bool
) -> Part:
    """Trains a network and gives it as a part of a checkpoint."""
    network, metrics = fit_mdn(config, dataset, seed, options, half_precision)
    say(
        f"mdn: best epoch {metrics['epoch']:.0f}, validation NLL {metrics['valid_loss']:.4f}, "
        f"RMSE {metrics['valid_rmse']:.4f}"
    )
    return Part(
        config=asdict(config),
        tensors=dict(network.state_dict()),
        seed=seed,
        metrics=metrics,
        data_id=dataset.id,
        data_digest=training_digest(dataset),
        half_precision=half_precision,
        trainer=options.trainer_settings,
    )
