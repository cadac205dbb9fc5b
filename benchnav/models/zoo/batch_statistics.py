"""Statistics of batch normalisation for other weights than those that a network was
trained with.

They fit one set of weights alone. Letters in shapes: S numbers of all layers together.
"""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call


def norms_of(network: nn.Module) -> dict[str, Any]:
    """Layers of batch normalisation that keep statistics, by name."""
    kind = nn.modules.batchnorm._BatchNorm
    found = {
        name: part for name, part in network.named_modules() if isinstance(part, kind)
    }
    return {name: norm for name, norm in found.items() if norm.track_running_stats}


def size_of(norms: Mapping[str, Any]) -> int:
    """S."""
    return sum(2 * norm.num_features for norm in norms.values())


def to_buffers(norms: Mapping[str, Any], row: Tensor) -> dict[str, Tensor]:
    """Buffers by name, from a row of all statistics, shape [S]."""
    names = [
        f"{name}.{kind}" for name in norms for kind in ("running_mean", "running_var")
    ]
    sizes = [norm.num_features for norm in norms.values() for _ in range(2)]
    return dict(zip(names, row.split(sizes), strict=True))


@torch.no_grad()
def statistics_of(
    network: nn.Module, weights: Mapping[str, Tensor], batches: Sequence[Any]
) -> Tensor:
    """Averages the statistics of some batches; leaves the network in evaluation, with
    its own.

    Args:
        network: in which the weights are to stand.
        weights: by name.
        batches: arguments of the network, a tuple each.

    Returns:
        A row of all statistics, shape [S].
    """
    norms = norms_of(network)
    kept = [
        (norm, norm.momentum, deepcopy(norm.state_dict())) for norm in norms.values()
    ]
    for norm in norms.values():
        norm.reset_running_stats()
        norm.momentum = None  # the average of all batches
    network.train()
    for batch in batches:
        functional_call(network, dict(weights), batch)
    made = [
        values.clone()
        for norm in norms.values()
        for values in (norm.running_mean, norm.running_var)
    ]
    for norm, momentum, state in kept:
        norm.momentum = momentum
        norm.load_state_dict(state)
    network.eval()
    return torch.cat(made) if made else torch.zeros(0)
