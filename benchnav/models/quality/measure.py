"""Quality of a model's class probabilities and predicted λ, per split.

Only sums and counts are stored, in one pass over the maps, so memory does not grow with
the number of maps. The scores are defined in `scores`. Letters in shapes: M members, B
maps, H×W cells, C classes, N cells of all maps.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torchmetrics.functional.classification import multiclass_confusion_matrix

from benchnav.core import rng
from benchnav.core.device import CPU, exact_convolutions
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import CheckpointError, DatasetError
from benchnav.core.terrain import Terrain
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.classes import look_alike_classes
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.base import PrivilegedModel, TraversabilityModel, predict
from benchnav.models.fused import FusedModel
from benchnav.models.predictor import class_mismatch
from benchnav.models.quality.map_sums import CellScores, MapTally
from benchnav.models.quality.scores import (
    ErrorRanking,
    LookAlikeQuality,
    LookAlikeTally,
    ReliabilityCurve,
    brier_score,
    calibration_error,
    class_scores,
    mutual_information,
    pit,
    predictive_entropy,
)
from benchnav.models.quality.scores_of_maps import SCORES

# Fields of `TraversabilityQuality` that have the same names in `SCORES`.
_SHARED_SCORES = ("rmse_observed", "rmse_expected", "nll", "crps", "coverage")
_MAX_SLOPE_DEG = 90


@dataclass(frozen=True, kw_only=True)
class ClassQuality:
    """Quality of class probabilities.

    Args:
        accuracy: fraction of cells whose most likely class is correct.
        miou: intersection over union, averaged over the classes that are true in any cell.
        miou_predicted: intersection over union, averaged over the classes that are true or
            predicted in any cell; a class that is predicted but never true counts as 0.
        ece: expected calibration error of the most likely class, from 15 bins.
        brier: Brier score, squared distance of the probabilities from the true class, 0–2.
        entropy: mean predictive entropy, in nats.
        mutual_information: mean mutual information of class and member, in nats; NaN for a
            model with fewer than two members.
        entropy_auroc: probability that a misclassified cell has a higher entropy than a
            correct cell; NaN if all cells or no cells are misclassified.
        mutual_information_auroc: the same probability for mutual information.
        confusion: number of cells by true class (row) and most likely class (column),
            [C][C].
        reliability: the curve that the ECE summarises: number of `cells`, mean
            `confidence` and `accuracy` in 15 equal bins of the probability of the most
            likely class; all three are 0 in an empty bin.
        slope_cells: number of cells by true class and whole degree of slope, [C][90].
        look_alikes: quality with look-alike classes merged; None if no classes look alike.
    """

    accuracy: float
    miou: float
    miou_predicted: float
    ece: float
    brier: float
    entropy: float
    mutual_information: float
    entropy_auroc: float
    mutual_information_auroc: float
    confusion: tuple[tuple[int, ...], ...]
    reliability: dict[str, tuple[float, ...]]
    slope_cells: tuple[tuple[int, ...], ...]
    look_alikes: LookAlikeQuality | None = None


@dataclass(frozen=True, kw_only=True)
class TraversabilityQuality:
    """Quality of predicted distributions of traversability.

    For `rmse_observed`, `rmse_expected`, `nll` and `crps`, lower is better.

    Args:
        rmse_observed: root mean square of E[λ] − observed λ.
        rmse_expected: root mean square of E[λ] − true E[λ] over labelled cells; NaN
            if there are no such cells or the truth is not available.
        nll: negative log-likelihood of observed λ, from the density in (0, 1) and the mass
            at 0 and 1; NaN for distributions without a density.
        crps: continuous ranked probability score of observed λ.
        coverage: fraction of cells whose observed λ is in the central 90 % interval of
            the prediction; ideally 0.9.
        tail_rate: fraction of cells whose observed λ is below the VaR at level 0.9;
            ideally 0.1.
        pit: number of cells in 20 equal bins of the randomised PIT; ideally all equal.
    """

    rmse_observed: float
    rmse_expected: float
    nll: float
    crps: float
    coverage: float
    tail_rate: float
    pit: tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class Quality:
    """Quality of a model on one split.

    Args:
        maps: number of predicted maps.
        traversability: quality of the predicted distributions of λ.
        classes: quality of the class probabilities; empty if the model predicts no classes
            or the maps have no labels.
        by_map: sums by map for a comparison; None if they are not requested.
    """

    maps: int
    traversability: TraversabilityQuality
    classes: tuple[ClassQuality, ...]
    by_map: MapTally | None = field(default=None, compare=False, repr=False)


def choose_splits(
    model: TraversabilityModel, dataset: TerrainDataset, splits: Iterable[str] = ()
) -> list[str]:
    """Return the splits to measure, and check that the model's classes are those of the maps.

    Args:
        model: any model.
        dataset: dataset of the maps.
        splits: names of splits; if empty, all test splits.

    Raises:
        DatasetError: If a split does not exist or there is no test split.
        CheckpointError: If the model was trained on other classes.
    """
    chosen = known_splits(dataset, splits)
    mismatch = class_mismatch(model, dataset.recipe)
    if mismatch:
        raise CheckpointError(
            f"{mismatch}. Train the model on a dataset with the classes of the maps."
        )
    return chosen


def known_splits(dataset: TerrainDataset, splits: Iterable[str] = ()) -> list[str]:
    """Return the splits to measure: the given splits, or by default all test splits.

    Raises:
        DatasetError: If a split does not exist or there is no test split.
    """
    chosen = list(dict.fromkeys(splits))
    if not chosen:
        chosen = [name for name in dataset.splits if name.startswith("test/")]
    if not chosen:
        raise DatasetError(
            f"Expected a test split in {dataset.path}, got {sorted(dataset.splits)}. "
            "Choose one or more of these with `splits`."
        )
    for split in chosen:
        dataset.map_count(split)  # raises an error if there is no such split
    return chosen


def evaluate(
    model: TraversabilityModel,
    dataset: TerrainDataset,
    splits: Iterable[str] = (),
    seed: int = 0,
    device: torch.device = CPU,
) -> Iterator[tuple[str, Quality]]:
    """Measure a model on several splits.

    Args:
        model: any model.
        dataset: dataset of the maps.
        splits: names of splits; if empty, all test splits.
        seed: root seed of the random PIT values within atoms.
        device: device of the computation.

    Yields:
        Name of a split and quality of the model on the split.

    Raises:
        DatasetError: If a split does not exist or there is no test split.
        CheckpointError: If the model was trained on other classes.
    """
    for split in choose_splits(model, dataset, splits):
        yield split, measure_split(model, dataset, split, seed, device)


def measure_split(
    model: TraversabilityModel,
    dataset: TerrainDataset,
    split: str,
    seed: int = 0,
    device: torch.device = CPU,
    by_map: bool = False,
) -> Quality:
    """Measure a model on one split.

    Only λ is measured if the model's classes differ from those of the maps.

    Args:
        model: any model.
        dataset: dataset of the maps.
        split: name of the split.
        seed: root seed of the random PIT values within atoms; all models of a comparison
            have the same seed.
        device: device of the computation.
        by_map: whether to return sums by map for a comparison; they need quantiles of
            the predictions in all cells.
    """
    alike = look_alike_classes(dataset.recipe.classes)
    truth = dataset.truth_of(split) == "generated"
    generator = rng.generator(rng.stream_key(seed, "models", "pit", split))
    chunks = (terrain.to(device) for terrain in dataset.terrain_chunks(split))
    classes = not class_mismatch(model, dataset.recipe)
    return measure(model, chunks, generator, alike, truth, by_map, classes)


def measure(
    model: TraversabilityModel,
    chunks: Iterable[Terrain],
    generator: torch.Generator,
    alike: Sequence[tuple[int, ...]] = (),
    truth: bool = True,
    by_map: bool = False,
    classes: bool = True,
) -> Quality:
    """Measure a model on maps.

    Args:
        model: any model.
        chunks: chunks of maps; at least one map.
        generator: generator of the random PIT values within atoms, on the CPU.
        alike: ids of each class and its look-alikes, by class; empty if no classes look
            alike.
        truth: whether the true distribution of λ is available.
        by_map: whether to return sums by map for a comparison; they need quantiles of
            the predictions in all cells.
        classes: whether to measure class probabilities, if the model predicts classes.
    """
    n_maps = 0
    n_classes = len(model.class_names) if classes else 0
    class_tally = _ClassTally(n_classes, alike)
    map_tally = MapTally(class_tally.count, truth, quantiles=by_map)
    is_privileged = isinstance(model, PrivilegedModel)
    for terrain in chunks:
        n_maps += len(terrain)
        predicted, members = _predict(model, terrain)
        cells = _score_cells(predicted, terrain, generator, is_privileged)
        map_tally.add(cells, len(terrain))
        if class_tally.count:
            probabilities = predicted.class_probabilities(class_tally.count)
            class_tally.add(probabilities, members, terrain.class_id, terrain.slope_deg)
            if by_map:
                map_tally.add_classes(probabilities, terrain.class_id)
    sums = map_tally.sums() if n_maps else {}
    if not n_maps or not sums["cells"].any():
        raise DatasetError(
            "Expected maps with observed λ in some cells, got none. Record λ in some "
            "cells."
        )
    values = {name: SCORES[name].value(sums) for name in _SHARED_SCORES}
    traversability = TraversabilityQuality(
        **values,
        tail_rate=SCORES["tail_rate_90"].value(sums),
        pit=tuple(map_tally.pit.tolist()),
    )
    class_qualities = []
    if class_tally.confusion.any():
        class_qualities.append(class_tally.quality())
    return Quality(
        maps=n_maps,
        traversability=traversability,
        classes=tuple(class_qualities),
        by_map=map_tally if by_map else None,
    )


def _predict(
    model: TraversabilityModel, terrain: Terrain
) -> tuple[TraversabilityDistribution, Tensor]:
    """Return the prediction and the members' class probabilities [M, B, C, H, W].

    M is 0 for a model without members.
    """
    observation = terrain.observe()
    with exact_convolutions():
        members = model.member_probabilities(observation)
    if members is None:
        return predict(model, terrain), torch.zeros(0)
    if isinstance(model, FusedModel):
        return model.fuse(members, observation), members
    return predict(model, terrain), members


class _ClassTally:
    """Sums of a model's class probabilities over the labelled cells of maps.

    Args:
        count: number of classes C; 0 for a model without classes.
        alike: ids of each class and its look-alikes, by class; empty if no classes look
            alike.
    """

    def __init__(self, count: int, alike: Sequence[tuple[int, ...]]) -> None:
        self.count = count
        self.brier = 0.0
        self.confusion = torch.zeros(count, count, dtype=torch.int64)
        self.slope_cells = torch.zeros(count, _MAX_SLOPE_DEG, dtype=torch.int64)
        self.reliability = ReliabilityCurve()
        self.look_alikes = LookAlikeTally(alike)
        self.entropy = ErrorRanking()
        self.information = ErrorRanking()

    def add(
        self,
        probabilities: Tensor,
        members: Tensor,
        class_id: Tensor,
        slope_deg: Tensor,
    ) -> None:
        """Add B maps.

        Args:
            probabilities: class probabilities of the model, shape [B, C, H, W].
            members: class probabilities of the members, shape [M, B, C, H, W].
            class_id: true classes, shape [B, H, W].
            slope_deg: slopes in degrees, shape [B, H, W].
        """
        labelled = class_id != UNLABELLED
        if not bool(labelled.any()):
            return
        has_members = len(members) > 1
        if not bool(labelled.all()):
            probabilities = _in_a_row(probabilities[None], labelled)[0]
            if has_members:
                members = _in_a_row(members, labelled)
            class_id = class_id[labelled][None, None]
            slope_deg = slope_deg[labelled][None, None]
        predicted = probabilities.argmax(1)
        is_wrong = predicted != class_id
        confusion = multiclass_confusion_matrix(predicted, class_id, self.count)
        self.confusion += confusion.cpu()
        brier = brier_score(probabilities, class_id).double()
        self.brier += float(brier.sum())
        self.reliability.update(probabilities, class_id)
        self.entropy.update(predictive_entropy(probabilities), is_wrong)
        if has_members:
            self.information.update(mutual_information(members), is_wrong)
        degree = slope_deg.floor().long().clamp(0, _MAX_SLOPE_DEG - 1)
        index = (_MAX_SLOPE_DEG * class_id + degree).flatten()
        counts = torch.bincount(index, minlength=self.slope_cells.numel())
        self.slope_cells += counts.view_as(self.slope_cells).cpu()
        if self.look_alikes.groups:
            self.look_alikes.add(probabilities, class_id)

    def quality(self) -> ClassQuality:
        accuracy, miou, miou_predicted = class_scores(self.confusion)
        entropy, entropy_auroc = self.entropy.compute()
        information, information_auroc = self.information.compute()
        curve = self.reliability.compute()
        cells, confidence, bin_accuracy = curve.tolist()
        reliability = {
            "cells": tuple(map(int, cells)),
            "confidence": tuple(confidence),
            "accuracy": tuple(bin_accuracy),
        }
        look_alikes = None
        if self.look_alikes.groups:
            look_alikes = self.look_alikes.quality()
        return ClassQuality(
            accuracy=accuracy,
            miou=miou,
            miou_predicted=miou_predicted,
            ece=calibration_error(curve),
            brier=self.brier / int(self.confusion.sum()),
            entropy=entropy,
            mutual_information=information,
            entropy_auroc=entropy_auroc,
            mutual_information_auroc=information_auroc,
            confusion=tuple(map(tuple, self.confusion.tolist())),
            reliability=reliability,
            slope_cells=tuple(map(tuple, self.slope_cells.tolist())),
            look_alikes=look_alikes,
        )


def _in_a_row(layers: Tensor, mask: Tensor) -> Tensor:
    """Return N selected cells of layers [M, B, C, H, W], shape [M, 1, C, 1, N]."""
    selected = layers.movedim(2, -1)[:, mask]
    return selected.movedim(-1, 1)[:, None, :, None]


def _score_cells(
    predicted: TraversabilityDistribution,
    terrain: Terrain,
    generator: torch.Generator,
    is_privileged: bool,
) -> CellScores | None:
    """Score each cell with observed λ; return None if no cell is observed.

    For a privileged model, which predicts only labelled cells, other cells are left out.
    """
    labelled = terrain.class_id != UNLABELLED
    mask = ~terrain.traversability.isnan()
    if is_privileged:
        mask = mask & labelled
    if not bool(mask.any()):
        return None
    labelled = labelled[mask]
    predicted = predicted.at(mask)
    observed = terrain.traversability[mask].unsqueeze(0)
    expected = predicted.mean()
    transformed = pit(predicted, observed, generator)
    true_expected = terrain.truth.at(mask).mean()
    expected_error = (expected - true_expected)[0, labelled]
    error = expected - observed
    scores = {
        "squares": error.double().square(),
        "nll": -predicted.log_prob(observed).double(),
        "crps": predicted.crps(observed).double(),
    }
    return CellScores(
        predicted=predicted,
        observed=observed,
        expected=expected,
        transformed=transformed,
        maps=mask.nonzero()[:, 0],
        scores=scores,
        labelled=labelled,
        expected_squares=expected_error.double().square(),
    )
