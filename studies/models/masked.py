"""Quality of stakes-v1-masked and stakes-v1 on partly observed maps.

Both are evaluated on the maps of test/std: fully observed, and masked to a disc of 4, 8
or 16 m radius around a random point, with the sensor noise of `near`. Scores are means
over observed cells. ± is the standard error of a difference over maps, weighted by
their numbers of observed cells. 200 maps take four minutes on one thread.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchnav import Observation, Terrain
from benchnav.core.ground import SEEN
from benchnav.datagen import TerrainDataset
from benchnav.models import TraversabilityModel, load_model
from benchnav.models.base import predict_observation
from benchnav.models.config import Masking
from benchnav.models.predictor import find_ground_statistics
from benchnav.models.quality.scores import pinball_loss_and_width
from benchnav.models.training.map_order import draw_visibility
from benchnav.models.training.masks import RandomMasks
from studies.study import Rows, Work

SPLIT, SEED = "test/std", 0
RADII_M = (4.0, 8.0, 16.0)
MODELS = ("stakes-v1", "stakes-v1-masked")
SCORES = ("NLL", "CRPS", "lower fifth", "class right")


def tables(work: Work, folder: Path, models: Sequence[str] = MODELS) -> dict[str, Rows]:
    """Return the scores of two checkpoints and their difference, by observed radius."""
    dataset = TerrainDataset(work.maps_in / "stakes-v1.h5")
    loaded = [load_model(name) for name in models]
    means = find_ground_statistics(models[0], dataset).layer_means
    rows = []
    for radius_m in (None, *RADII_M):
        masks = radius_m and RandomMasks(
            masking=Masking(share=1.0, radius_m=(radius_m, radius_m)),
            means=means,
            resolution_m=dataset.grid.resolution_m,
        )
        sums = np.concatenate(
            [measure(loaded, *observation) for observation in observed(dataset, masks)],
            1,
        )
        seen = "whole" if radius_m is None else f"{radius_m:g} m"
        rows += [
            {"seen": seen, "model": name, **dict(zip(SCORES, row, strict=True))}
            for name, row in zip((*models, "difference"), lines(sums), strict=True)
        ]
    return {"masked": rows}


def observed(
    dataset: TerrainDataset, masks: RandomMasks | None
) -> Iterator[tuple[Terrain, Observation, Tensor]]:
    """Yield chunks of maps: terrain, observation, mask of observed cells [B, H, W]."""
    visibility = torch.from_numpy(draw_visibility(SEED, 0, dataset.map_count(SPLIT)))
    visibility[:, 6] = 0.0  # no driven path: a disc is observed
    for indices, _ in dataset.chunks(SPLIT, fields=()):
        terrain = dataset.terrain(SPLIT, indices)
        observation = terrain.observe()
        if masks is None:
            yield (
                terrain,
                observation,
                torch.ones_like(terrain.class_id, dtype=torch.bool),
            )
            continue
        maps = {
            name: getattr(observation, name)
            for name in ("rgb", "elevation_m", "slope_deg")
        }
        seen = masks.apply(maps, visibility[indices.start : indices.stop])
        mask = seen[SEEN]
        layers = {name: seen[name] for name in maps}
        yield terrain, replace(observation, **layers, layers={SEEN: mask}), mask == 1


def measure(
    models: list[TraversabilityModel],
    terrain: Terrain,
    observation: Observation,
    seen: Tensor,
) -> np.ndarray:
    """Return sums of scores over observed cells, and the numbers of these cells.

    The shape is [models, B, scores + 1].
    """
    sums_by_model = []
    for model in models:
        predicted, true = (
            predict_observation(model, observation),
            terrain.traversability,
        )
        is_class_right = (
            model.member_probabilities(observation).mean(0).argmax(1)
            == terrain.class_id
        )
        scores = (
            -predicted.log_prob(true),
            predicted.crps(true),
            pinball_loss_and_width(predicted, true)[0],
            is_class_right,
        )
        sums = [
            torch.where(seen, score.double(), 0).sum((1, 2))
            for score in (*scores, torch.ones_like(true))
        ]
        sums_by_model.append(torch.stack(sums, 1).numpy())
    return np.stack(sums_by_model)


def lines(sums_by_model: np.ndarray) -> list[list[str]]:
    """Return rows of mean scores, and of the difference second − first ± its error."""
    sums, cells = sums_by_model[..., :-1], sums_by_model[..., -1:]
    means = sums.sum(1) / cells.sum(1)
    difference = means[1] - means[0]
    # Standard error of a ratio of sums over independent maps.
    residual = (sums[1] - sums[0]) - difference * cells[0]
    error = (
        np.sqrt((residual**2).sum(0) * len(residual) / (len(residual) - 1))
        / cells[0].sum()
    )
    text = [[f"{value:.4f}" for value in row] for row in means]
    return [
        *text,
        [f"{d:+.4f} ± {e:.4f}" for d, e in zip(difference, error, strict=True)],
    ]
