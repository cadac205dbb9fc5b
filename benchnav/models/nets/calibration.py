"""Calibration on the validation maps by one number, fitted by maximum likelihood.

Of class probabilities it is the temperature by which logits are divided, so that
confidence fits accuracy; it leaves every most likely class as it is. The average of
several calibrated classifiers is not sure enough of itself, the less so the more they
differ. So it is given a temperature of its own: first pool, then calibrate.

Of distributions of λ it is the temperature T that the normal scores are multiplied by:
F⁻¹(Φ(T·Φ⁻¹(u))). Where the predictions are right, the scores z = Φ⁻¹(F(λ)) of what was
observed are standard normal; a density has φ(z / T) / T, an atom Φ(upper / T) − Φ(lower
/ T).

Sources: Guo et al. (2017), "On calibration of modern neural networks"; Rahaman and
Thiery (2021), "Uncertainty quantification and deep ensembles". Letters in shapes: B
maps, H×W cells, C classes, N cells.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize_scalar
from scipy.special import log_ndtr, ndtr
from torch import Tensor, nn

from benchnav.core import rng
from benchnav.core.device import CPU, exact_convolutions
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import DatasetError
from benchnav.datagen.schema import UNLABELLED

_MOST_CELLS = 200_000
_LARGEST = 20.0
_LARGEST_SCORE = 8.0  # beyond which a normal distribution has less than 10⁻¹⁵
_LEAST_GAIN = 1e-3  # nats a cell, for which a distribution is changed at all


def fit_temperature(logits: Tensor, class_id: Tensor) -> float:
    """Finds the temperature of least negative log likelihood, in [0.05, 20].

    Args:
        logits: shape [N, C].
        class_id: true classes, int64, shape [N].
    """
    logits = logits.double()
    return _least(
        lambda temperature: float(
            nn.functional.cross_entropy(logits / temperature, class_id)
        )
    )


def fit_pool_temperature(
    members: Sequence[nn.Module], maps: Any, seed: int = 0, device: torch.device = CPU
) -> float:
    """Finds the temperature of the average of several classifiers' probabilities, for
    `models.fused.sharpen`.

    Args:
        members: each calibrated by itself, from maps by field to logits [B, C, H, W].
        maps: a `models.training.data.MapDataset` with their inputs and `class_id`.
        seed: root seed of the cells to fit to.
        device: where to compute, to which the classifiers are moved.
    """
    average, class_id = (
        torch.zeros((), device=device),
        torch.zeros(0, dtype=torch.int64),
    )
    for member in members:
        logits, class_id = sample_logits(member, maps, seed, device)
        average = average + logits.double().softmax(1) / len(members)
    return fit_temperature(average.log(), class_id)


def fit_width(lower: Tensor, upper: Tensor) -> float:
    """Finds the temperature of normal scores; exactly 1 where none gains 0.001 nats a
    cell.

    Args:
        lower: normal score of P(λ < observed), shape [N].
        upper: of P(λ ≤ observed), which is the same but at an atom, shape [N].
    """
    low, high = (scores.double().cpu().numpy() for scores in (lower, upper))
    # Under 10⁻⁹ it is the rounding of a CDF that has none there.
    is_atom, score = (
        ndtr(high) - ndtr(low) > 1e-9,
        high.clip(-_LARGEST_SCORE, _LARGEST_SCORE),
    )
    # of which the mass is defined
    low, high = (
        np.where(is_atom, low, -1.0),
        np.where(is_atom, high, 1.0),
    )

    def loss(temperature: float) -> float:
        density = 0.5 * (score / temperature) ** 2 + np.log(temperature)
        # Of both tails the one in which the difference keeps its digits.
        flip = low > 0
        first, second = (
            np.where(flip, -high, low) / temperature,
            np.where(flip, -low, high) / temperature,
        )
        above, below = log_ndtr(second), log_ndtr(first)
        mass = above + np.log1p(-np.exp(np.minimum(below - above, -1e-12)))
        return float(np.where(is_atom, -mass, density).mean())

    found = _least(loss)
    return found if loss(1.0) - loss(found) > _LEAST_GAIN else 1.0


def _least(loss: Callable[[float], float]) -> float:
    """The temperature in [0.05, 20] of least loss."""
    reach = float(np.log(_LARGEST))
    found = minimize_scalar(
        lambda log: loss(float(np.exp(log))), bounds=(-reach, reach), method="bounded"
    )
    return float(np.exp(found.x))


def sample_logits(
    classifier: nn.Module, maps: Any, seed: int = 0, device: torch.device = CPU
) -> tuple[Tensor, Tensor]:
    """Classifies maps and keeps at most 200 000 cells, the same share of every map.

    Args:
        classifier: from maps by field to logits [B, C, H, W].
        maps: a `models.training.data.MapDataset` with its inputs and `class_id`.
        seed: root seed of the draw.
        device: where to compute, to which the classifier is moved.

    Returns:
        Logits [N, C] and true classes [N], int64, of the cells whose class is known, on
        that device.

    Raises:
        DatasetError: there is no such cell.
    """
    found, classifier = [], classifier.to(device)
    with torch.inference_mode(), exact_convolutions():
        for batch, cells in _sampled(maps, seed, device):
            logits, class_id = (
                classifier(batch).float().flatten(2),
                batch["class_id"].flatten(1).long(),
            )
            for place, drawn in enumerate(cells):
                drawn = drawn[class_id[place, drawn] != UNLABELLED][: _kept(maps)]
                found.append(
                    (logits[place][:, drawn].T.clone(), class_id[place, drawn])
                )
    logits, class_id = (torch.cat(parts) for parts in zip(*found, strict=True))
    if not len(class_id):
        raise DatasetError(
            "Expected validation maps with cells whose class is known, got none."
        )
    return logits, class_id


def sample_scores(
    predict: Callable[[dict[str, Tensor]], TraversabilityDistribution],
    maps: Any,
    inputs: Iterable[str],
    seed: int = 0,
    device: torch.device = CPU,
) -> tuple[Tensor, Tensor]:
    """Predicts maps and keeps the normal scores of at most 200 000 observed cells, the
    same share of every map.

    Args:
        predict: from layers by name to distributions [B, H, W].
        maps: a `models.training.data.MapDataset` with the inputs and `traversability`.
        inputs: layers that the model is given.
        seed: root seed of the draw.
        device: where to compute.

    Returns:
        Scores of P(λ < observed) and of P(λ ≤ observed), each of shape [N], on that
        device.

    Raises:
        DatasetError: there is no such cell.
    """
    found, inputs = [], tuple(inputs)
    with torch.inference_mode(), exact_convolutions():
        for batch, cells in _sampled(maps, seed, device):
            observed = batch["traversability"]
            known, kept = (
                observed.isfinite().flatten(1),
                torch.zeros_like(observed, dtype=torch.bool).flatten(1),
            )
            for place, drawn in enumerate(cells):
                kept[place, drawn[known[place, drawn]][: _kept(maps)]] = True
            kept = kept.view_as(observed)
            if bool(kept.any()):
                distribution = predict({name: batch[name] for name in inputs}).at(kept)
                found.append(
                    [
                        s.flatten().clone()
                        for s in distribution.to_normal(observed[kept].unsqueeze(0))
                    ]
                )
    if not found:
        raise DatasetError("Expected validation maps with an observed λ, got none.")
    lower, upper = (torch.cat(parts) for parts in zip(*found, strict=True))
    return lower, upper


def _kept(maps: Any) -> int:
    """Cells that are kept of each map."""
    return max(1, _MOST_CELLS // len(maps))


def _sampled(
    maps: Any, seed: int, device: torch.device
) -> Iterator[tuple[dict[str, Tensor], list[Tensor]]]:
    """Maps some at a time, each with its cells in an order drawn for it."""
    key = rng.stream_key(seed, "models", "temperature")
    for indices, batch in maps.chunks(device):
        size = (
            batch["class_id"][0].numel()
            if "class_id" in batch
            else batch["traversability"][0].numel()
        )
        orders = [rng.permutation(key, np.array([index]), size)[0] for index in indices]
        yield batch, [torch.from_numpy(order).to(device) for order in orders]
