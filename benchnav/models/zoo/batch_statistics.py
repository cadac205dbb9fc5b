"""Statistics of batch normalisation for other weights than the trained weights.

Each set of weights needs its own statistics. Letter in shapes: S statistics of all
layers.
"""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call


def norms_of(network: nn.Module) -> dict[str, Any]:
    """Return the batch normalisation layers with running statistics, by name."""
    norms: dict[str, Any] = {}
    for name, module in network.named_modules():
        is_norm = isinstance(module, nn.modules.batchnorm._BatchNorm)
        if is_norm and module.track_running_stats:
            norms[name] = module
    return norms


def size_of(norms: Mapping[str, Any]) -> int:
    """Return S, the number of statistics of all layers."""
    return sum(2 * norm.num_features for norm in norms.values())


def to_buffers(norms: Mapping[str, Any], row: Tensor) -> dict[str, Tensor]:
    """Convert a row of all statistics, shape [S], to buffers by name."""
    names = []
    sizes = []
    for name, norm in norms.items():
        names += [f"{name}.running_mean", f"{name}.running_var"]
        sizes += [norm.num_features, norm.num_features]
    return dict(zip(names, row.split(sizes), strict=True))


@torch.no_grad()
def statistics_of(
    network: nn.Module, weights: Mapping[str, Tensor], batches: Sequence[Any]
) -> Tensor:
    """Return the statistics of a network with other weights, averaged over batches.

    Afterwards the network is in evaluation mode and has its original statistics.

    Args:
        network: network to evaluate.
        weights: weights by name, used instead of the network's weights.
        batches: arguments of the network, one tuple per batch.

    Returns:
        All statistics in one row, shape [S].
    """
    norms = norms_of(network).values()
    originals = [(norm, norm.momentum, deepcopy(norm.state_dict())) for norm in norms]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # for the plain average over all batches
    network.train()
    for batch in batches:
        functional_call(network, dict(weights), batch)
    statistics = [torch.zeros(0)]
    for norm in norms:
        statistics += [norm.running_mean.clone(), norm.running_var.clone()]
    for norm, momentum, state in originals:
        norm.momentum = momentum
        norm.load_state_dict(state)
    network.eval()
    return torch.cat(statistics[1:] or statistics)
