"""Class probabilities: out of a mixture whose components belong to classes, and made surer as a whole.

Letters in shapes: B maps, H×W cells, C classes, K components.
"""

import torch
from torch import Tensor

from benchnav.core.mixture import TraversabilityMixture


def class_probabilities(mixture: TraversabilityMixture, class_count: int) -> Tensor:
    """Probability of each class: the sum of the weights of its components.

    Args:
        mixture: without `group` its components are the classes; parameters of shape [*B, K, H, W].
        class_count: C.

    Returns:
        Shape [*B, C, H, W]; the weights themselves where each class has one component, in order.
    """
    classes = tuple(range(class_count))
    if mixture.group is None or mixture.group == classes:
        return mixture.weights
    weights = mixture.weights.movedim(-3, 0)
    total = torch.zeros_like(weights[:1]).repeat(class_count, *(1,) * (weights.ndim - 1))
    total.index_add_(0, torch.tensor(mixture.group, device=weights.device), weights)
    return total.movedim(0, -3)


def sharpen(probabilities: Tensor, temperature: float) -> Tensor:
    """Divides the logarithms of class probabilities by a temperature, under 1 to make them surer.

    Args:
        probabilities: shape [B, C, H, W].
        temperature: > 0; at 1 nothing is changed.
    """
    if temperature == 1:
        return probabilities
    return (probabilities.log() / temperature).softmax(1)
