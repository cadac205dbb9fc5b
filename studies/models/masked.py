"""Quality of models on maps of which they see a part: stakes-v1-masked next to
stakes-v1.

Both are measured on the maps of test/std, whole and masked by a disc of 4, 8 and 16 m
radius about a point that is drawn for each map, with the sensor noise of `near`. It
takes four minutes on one thread for 200 maps. Cells that are not seen do not count.
Scores are means over all cells that count; ± is the standard error of a difference over
the maps, each of which is weighed by how many of its cells count.
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
from benchnav.models.quality.scores import lower_fifth_and_width
from benchnav.models.training.map_order import draw_visibility
from benchnav.models.training.masks import RandomMasks
from studies.study import Rows, Work

SPLIT, SEED = "test/std", 0
RADII_M = (4.0, 8.0, 16.0)
MODELS = ("stakes-v1", "stakes-v1-masked")
SCORES = ("NLL", "CRPS", "lower fifth", "class right")


def tables(work: Work, folder: Path, models: Sequence[str] = MODELS) -> dict[str, Rows]:
    """Return the scores of two checkpoints by what is seen of a map, the plain one
    first.
    """
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
    """Maps some at a time: the truth, what is seen of it, and which cells these are."""
    looks = torch.from_numpy(draw_visibility(SEED, 0, dataset.map_count(SPLIT)))
    looks[:, 6] = 0.0  # none of the path is driven, so that a disc is seen
    for indices, _ in dataset.chunks(SPLIT, fields=()):
        terrain = dataset.terrain(SPLIT, indices)
        whole = terrain.observe()
        if masks is None:
            yield terrain, whole, torch.ones_like(terrain.class_id, dtype=torch.bool)
            continue
        maps = {
            name: getattr(whole, name) for name in ("rgb", "elevation_m", "slope_deg")
        }
        seen = masks.apply(maps, looks[indices.start : indices.stop])
        mask = seen[SEEN]
        shown = {name: seen[name] for name in maps}
        yield terrain, replace(whole, **shown, layers={SEEN: mask}), mask == 1


def measure(
    models: list[TraversabilityModel],
    terrain: Terrain,
    observation: Observation,
    seen: Tensor,
) -> np.ndarray:
    """Sums of the scores over the seen cells of each map, and how many these are; shape
    [models, B, scores + 1].
    """
    found = []
    for model in models:
        given, true = predict_observation(model, observation), terrain.traversability
        right = (
            model.member_probabilities(observation).mean(0).argmax(1)
            == terrain.class_id
        )
        scores = (
            -given.log_prob(true),
            given.crps(true),
            lower_fifth_and_width(given, true)[0],
            right,
        )
        sums = [
            torch.where(seen, score.double(), 0).sum((1, 2))
            for score in (*scores, torch.ones_like(true))
        ]
        found.append(torch.stack(sums, 1).numpy())
    return np.stack(found)


def lines(found: np.ndarray) -> list[list[str]]:
    """Mean scores of each model, and the difference of the second to the first with its
    standard error.
    """
    sums, cells = found[..., :-1], found[..., -1:]
    means = sums.sum(1) / cells.sum(1)
    difference = means[1] - means[0]
    # Of a ratio of sums over independent maps.
    left = (sums[1] - sums[0]) - difference * cells[0]
    error = np.sqrt((left**2).sum(0) * len(left) / (len(left) - 1)) / cells[0].sum()
    text = [[f"{value:.4f}" for value in row] for row in means]
    return [
        *text,
        [f"{d:+.4f} ± {e:.4f}" for d, e in zip(difference, error, strict=True)],
    ]
