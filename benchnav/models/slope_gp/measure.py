"""How well class-wise GPs know the ground, apart from any classifier."""

from collections.abc import Iterable

import torch

from benchnav.core.terrain import Terrain
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.slope_gp.table import SlopeTable


def measure_latent(table: SlopeTable, chunks: Iterable[Terrain], truth: bool = True) -> dict[str, float]:
    """Measures the GPs apart from the classifier, each cell that has a class read with it.

    Args:
        table: the GPs over slope.
        chunks: the maps, at least one, a few at a time.
        truth: whether the maps' true distribution of λ is known.

    Returns:
        `nll` of λ as realised and, where the truth is known, `latent_rmse` to f_c(ψ) and `noise_error` (largest
        relative error of a class's σ_c that occurs).
    """
    squares, cells, surprise, seen, noise_error = 0.0, 0, 0.0, 0, 0.0
    for terrain in chunks:
        table, labelled = table.to(terrain.class_id.device), terrain.class_id != UNLABELLED
        class_id = torch.where(labelled, terrain.class_id, 0)
        own, known = table.own(class_id, terrain.slope_deg), labelled & ~terrain.traversability.isnan()
        off = (own.means[:, 0] - terrain.truth.means[:, 0])[labelled]
        squares += float(off.double().square().sum())
        cells += off.numel()
        observed = terrain.traversability[known].unsqueeze(0)
        surprise -= float(own.at(known).log_prob(observed).double().sum())
        seen += int(known.sum())
        ratio = (table.noise_std[class_id] / terrain.truth.stds[:, 0])[labelled]
        if len(ratio):
            noise_error = max(noise_error, float((ratio - 1).abs().max()))
    errors = {"latent_rmse": (squares / max(1, cells)) ** 0.5, "noise_error": noise_error} if truth else {}
    return {**errors, "nll": surprise / max(1, seen)}
