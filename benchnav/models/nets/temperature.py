"""Temperature scaling: one number by which logits are divided, so that confidence fits accuracy.

It is fitted to the validation maps by maximum likelihood and leaves every most likely class as it is.
The average of several calibrated classifiers is not sure enough of itself, the less so the more they
differ. So it is given a temperature of its own: first pool, then calibrate. Sources: Guo et al. (2017),
"On calibration of modern neural networks"; Rahaman and Thiery (2021), "Uncertainty quantification and
deep ensembles". Letters in shapes: B maps, H×W cells, C classes, N cells.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor, nn

from benchnav.core import rng
from benchnav.core.device import CPU, exact_convolutions
from benchnav.core.errors import DatasetError
from benchnav.datagen.schema import UNLABELLED

_MOST_CELLS = 200_000
_LARGEST = 20.0


def fit_temperature(logits: Tensor, class_id: Tensor) -> float:
    """Finds the temperature of least negative log likelihood, in [0.05, 20].

    Args:
        logits: shape [N, C].
        class_id: true classes, int64, shape [N].
    """
    logits = logits.double()

    def loss(log_temperature: float) -> float:
        scaled = logits / float(np.exp(log_temperature))
        return float(nn.functional.cross_entropy(scaled, class_id))

    reach = float(np.log(_LARGEST))
    return float(np.exp(minimize_scalar(loss, bounds=(-reach, reach), method="bounded").x))


def fit_pool_temperature(
    members: Sequence[nn.Module], maps: Any, seed: int = 0, device: torch.device = CPU
) -> float:
    """Finds the temperature of the average of several classifiers' probabilities, for `models.fused.sharpen`.

    Args:
        members: each calibrated by itself, from uint8 images [B, 3, H, W] to logits [B, C, H, W].
        maps: a `models.training.data.MapDataset` with `rgb` and `class_id`.
        seed: root seed of the cells to fit to.
        device: where to compute, to which the classifiers are moved.
    """
    average, class_id = torch.zeros((), device=device), torch.zeros(0, dtype=torch.int64)
    for member in members:
        logits, class_id = sample_logits(member, maps, seed, device)
        average = average + logits.double().softmax(1) / len(members)
    return fit_temperature(average.log(), class_id)


def sample_logits(
    classifier: nn.Module, maps: Any, seed: int = 0, device: torch.device = CPU
) -> tuple[Tensor, Tensor]:
    """Classifies maps and keeps at most 200 000 cells, the same share of every map.

    Args:
        classifier: from uint8 images [B, 3, H, W] to logits [B, C, H, W].
        maps: a `models.training.data.MapDataset` with `rgb` and `class_id`.
        seed: root seed of the draw.
        device: where to compute, to which the classifier is moved.

    Returns:
        Logits [N, C] and true classes [N], int64, of the cells whose class is known, on that device.

    Raises:
        DatasetError: there is no such cell.
    """
    cells = maps.shape[0] * maps.shape[1]
    kept = max(1, _MOST_CELLS // len(maps))
    key = rng.stream_key(seed, "models", "temperature")
    found, classifier = [], classifier.to(device)
    with torch.inference_mode(), exact_convolutions():
        for indices, some in maps.chunks(device):
            logits, class_id = classifier(some["rgb"]).float().flatten(2), some["class_id"].flatten(1).long()
            for place, which in enumerate(indices):
                order = torch.from_numpy(rng.permutation(key, np.array([which]), cells)[0]).to(device)
                drawn = order[class_id[place, order] != UNLABELLED][:kept]
                found.append((logits[place][:, drawn].T.clone(), class_id[place, drawn]))
    logits, class_id = (torch.cat(parts) for parts in zip(*found, strict=True))
    if not len(class_id):
        raise DatasetError("Expected validation maps with cells whose class is known, got none.")
    return logits, class_id
