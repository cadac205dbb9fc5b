"""Calibration on the validation maps by one parameter, fitted by maximum likelihood.

For class probabilities, the parameter is the temperature by which logits are divided, so
that confidence matches accuracy; the most likely classes do not change. The average of
several calibrated classifiers is underconfident, the more so the more the classifiers
differ. The average therefore has its own temperature: pool first, then calibrate.

For distributions of λ, the parameter is the temperature T by which normal scores are
multiplied: F⁻¹(Φ(T·Φ⁻¹(u))). If the predictions are correct, the scores z = Φ⁻¹(F(λ)) of
the observations are standard normal. Where F has a density, the likelihood of a score is
φ(z / T) / T; at an atom it is Φ(upper / T) − Φ(lower / T).

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

_MAX_CELLS = 200_000
_MAX_TEMPERATURE = 20.0
_MAX_SCORE = 8.0  # the normal probability beyond this score is below 10⁻¹⁵
_MIN_ATOM = 1e-9  # smaller masses are rounding errors of a CDF without an atom
_MIN_GAIN = 1e-3  # nats per cell; with a smaller gain, a distribution is left unchanged


def fit_temperature(logits: Tensor, class_id: Tensor) -> float:
    """Return the temperature that minimises the negative log-likelihood, in [0.05, 20].

    Args:
        logits: shape [N, C].
        class_id: true classes, int64, shape [N].
    """
    logits = logits.double()

    def loss(temperature: float) -> float:
        return float(nn.functional.cross_entropy(logits / temperature, class_id))

    return _minimise(loss)


def fit_pool_temperature(
    members: Sequence[nn.Module], maps: Any, seed: int = 0, device: torch.device = CPU
) -> float:
    """Fit the temperature for the average of classifiers, for `models.fused.sharpen`.

    Args:
        members: calibrated classifiers; each returns logits [B, C, H, W] from the layers
            of maps by name.
        maps: a `models.training.data.MapDataset` with the inputs of the classifiers and
            `class_id`.
        seed: root seed for sampling cells.
        device: device of the computation, to which the classifiers are moved.
    """
    average = torch.zeros((), device=device)
    class_id = torch.zeros(0, dtype=torch.int64)
    for member in members:
        logits, class_id = sample_logits(member, maps, seed, device)
        average = average + logits.double().softmax(1) / len(members)
    return fit_temperature(average.log(), class_id)


def fit_width(lower: Tensor, upper: Tensor) -> float:
    """Return the temperature of normal scores; 1 if its gain is below 0.001 nats per cell.

    Args:
        lower: normal scores of P(λ < observed), shape [N].
        upper: normal scores of P(λ ≤ observed), equal to `lower` except at atoms,
            shape [N].
    """
    low = lower.double().cpu().numpy()
    high = upper.double().cpu().numpy()
    is_atom = ndtr(high) - ndtr(low) > _MIN_ATOM
    score = high.clip(-_MAX_SCORE, _MAX_SCORE)
    # Cells without an atom get placeholders, so that `mass` is finite in all cells.
    low = np.where(is_atom, low, -1.0)
    high = np.where(is_atom, high, 1.0)
    # Mirror positive scores to the lower tail, where differences of Φ lose no digits.
    flip = low > 0
    near_tail = np.where(flip, -high, low)
    far_tail = np.where(flip, -low, high)

    def loss(temperature: float) -> float:
        density = 0.5 * (score / temperature) ** 2 + np.log(temperature)
        log_upper = log_ndtr(far_tail / temperature)
        log_lower = log_ndtr(near_tail / temperature)
        log_ratio = np.minimum(log_lower - log_upper, -1e-12)
        mass = log_upper + np.log1p(-np.exp(log_ratio))
        return float(np.where(is_atom, -mass, density).mean())

    temperature = _minimise(loss)
    return temperature if loss(1.0) - loss(temperature) > _MIN_GAIN else 1.0


def _minimise(loss: Callable[[float], float]) -> float:
    """Return the temperature that minimises a loss, in [0.05, 20]."""
    bound = float(np.log(_MAX_TEMPERATURE))
    result = minimize_scalar(
        lambda log: loss(float(np.exp(log))), bounds=(-bound, bound), method="bounded"
    )
    return float(np.exp(result.x))


def sample_logits(
    classifier: nn.Module, maps: Any, seed: int = 0, device: torch.device = CPU
) -> tuple[Tensor, Tensor]:
    """Classify maps and return a sample of at most 200 000 cells.

    Each map contributes at most the same number of cells.

    Args:
        classifier: function that returns logits [B, C, H, W] from the layers of maps by
            name.
        maps: a `models.training.data.MapDataset` with the inputs of the classifier and
            `class_id`.
        seed: root seed for sampling cells.
        device: device of the computation, to which the classifier is moved.

    Returns:
        Logits [N, C] and true classes [N], int64, of labelled cells, on that device.

    Raises:
        DatasetError: If no cell is labelled.
    """
    classifier = classifier.to(device)
    logits_per_map = []
    labels_per_map = []
    n_per_map = _cells_per_map(maps)
    with torch.inference_mode(), exact_convolutions():
        for batch, orders in _shuffled(maps, seed, device):
            logits = classifier(batch).float().flatten(2)
            class_id = batch["class_id"].flatten(1).long()
            for i, order in enumerate(orders):
                is_labelled = class_id[i, order] != UNLABELLED
                cells = order[is_labelled][:n_per_map]
                logits_per_map.append(logits[i][:, cells].T.clone())
                labels_per_map.append(class_id[i, cells])
    class_id = torch.cat(labels_per_map)
    if not len(class_id):
        raise DatasetError(
            "Expected validation maps with labelled cells, got only unlabelled cells. "
            "Check `class_id`."
        )
    return torch.cat(logits_per_map), class_id


def sample_scores(
    predict: Callable[[dict[str, Tensor]], TraversabilityDistribution],
    maps: Any,
    inputs: Iterable[str],
    seed: int = 0,
    device: torch.device = CPU,
) -> tuple[Tensor, Tensor]:
    """Predict maps and return the normal scores of at most 200 000 observed cells.

    Each map contributes at most the same number of cells.

    Args:
        predict: function that returns distributions [B, H, W] from the layers of maps
            by name.
        maps: a `models.training.data.MapDataset` with the inputs and `traversability`.
        inputs: layers that the model receives.
        seed: root seed for sampling cells.
        device: device of the computation.

    Returns:
        Scores of P(λ < observed) and of P(λ ≤ observed), each of shape [N], on that
        device.

    Raises:
        DatasetError: If λ is not observed in any cell.
    """
    inputs = tuple(inputs)
    lower_scores = []
    upper_scores = []
    n_per_map = _cells_per_map(maps)
    with torch.inference_mode(), exact_convolutions():
        for batch, orders in _shuffled(maps, seed, device):
            observed = batch["traversability"]
            is_observed = observed.isfinite().flatten(1)
            is_selected = torch.zeros_like(is_observed)
            for i, order in enumerate(orders):
                cells = order[is_observed[i, order]][:n_per_map]
                is_selected[i, cells] = True
            is_selected = is_selected.view_as(observed)
            if not bool(is_selected.any()):
                continue
            layers = {name: batch[name] for name in inputs}
            distribution = predict(layers).at(is_selected)
            values = observed[is_selected].unsqueeze(0)
            lower, upper = distribution.to_normal(values)
            lower_scores.append(lower.flatten().clone())
            upper_scores.append(upper.flatten().clone())
    if not lower_scores:
        raise DatasetError(
            "Expected validation maps with observed λ, got NaN in every cell. Record "
            "λ in some cells."
        )
    return torch.cat(lower_scores), torch.cat(upper_scores)


def _cells_per_map(maps: Any) -> int:
    """Return the maximum number of sampled cells per map."""
    return max(1, _MAX_CELLS // len(maps))


def _shuffled(
    maps: Any, seed: int, device: torch.device
) -> Iterator[tuple[dict[str, Tensor], list[Tensor]]]:
    """Yield chunks of maps, and a random order of the cells of each map."""
    key = rng.stream_key(seed, "models", "temperature")
    for indices, batch in maps.chunks(device):
        field = "class_id" if "class_id" in batch else "traversability"
        n_cells = batch[field][0].numel()
        orders = []
        for index in indices:
            order = rng.permutation(key, np.array([index]), n_cells)[0]
            orders.append(torch.from_numpy(order).to(device))
        yield batch, orders
