"""How good a model's predictions are, a split at a time: of classes, and of
traversability.

One pass over the maps with sums and counts alone, so that memory does not grow with
them. The scores themselves stand in `scores`. Letters in shapes: B maps, H×W cells, C
classes, N cells of all maps.
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

# Scores of `TraversabilityQuality` that it has by their own names.
_OF_CELLS = ("rmse_observed", "rmse_expected", "nll", "crps", "coverage")


@dataclass(frozen=True, kw_only=True)
class ClassQuality:
    """Quality of class probabilities.

    Args:
        accuracy: share of cells whose most likely class is right.
        miou: intersection over union, averaged over the classes that occur in truth.
        miou_predicted: the same over those that are predicted somewhere too, of which
            each that does not occur counts as 0.
        ece: expected calibration error of the most likely class, 15 bins.
        brier: Brier score, the squared distance of the probabilities to the class that
            is there, 0–2.
        entropy: mean predictive entropy, in nats.
        mutual_information: mean mutual information of class and member, in nats; not a
            number for a model without several members.
        entropy_auroc: how often the entropy is higher in a wrongly than in a rightly
            classified cell; not a number where all or none are wrong.
        mutual_information_auroc: the same of mutual information.
        confusion: cells by true class (row) and most likely class (column), [C][C].
        reliability: the curve that the ECE sums up: in 15 equal bins of the probability
            of the most likely class how many `cells` there are, their mean
            `confidence`, and the `accuracy`, both 0 in an empty bin.
        slope_cells: cells by true class and whole degree of slope, [C][90].
        look_alikes: with classes that look alike merged; None where no two do.
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
    """Quality of predicted distributions of traversability; lower is better but for the
    last three.

    Args:
        rmse_observed: root mean square of E[λ] − λ as realised.
        rmse_expected: root mean square of E[λ] − E[λ] in truth, of labelled cells; not
            a number where there is none or the truth is not known.
        nll: negative log likelihood of λ as realised, density inside (0, 1) and mass at
            0 and 1; not a number for distributions without a density.
        crps: continuous ranked probability score of λ as realised.
        coverage: share of λ in the central 90 % of its prediction; ideally 0.9.
        tail_rate: share of λ under the VaR at level 0.9; ideally 0.1.
        pit: cells in 20 equal bins of the randomised PIT; ideally all alike.
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
        maps: how many maps were predicted.
        traversability: of the distributions.
        classes: of the class probabilities; empty for a model that predicts no classes,
            and on maps without any.
        by_map: what a comparison needs, where it was asked for.
    """

    maps: int
    traversability: TraversabilityQuality
    classes: tuple[ClassQuality, ...]
    by_map: MapTally | None = field(default=None, compare=False, repr=False)


def choose_splits(
    model: TraversabilityModel, dataset: TerrainDataset, splits: Iterable[str] = ()
) -> list[str]:
    """Tells which splits are to be measured, and refuses what cannot be.

    Args:
        model: any model.
        dataset: the maps.
        splits: which splits; every test split when empty.

    Raises:
        DatasetError: there is no such split, or no test split.
        CheckpointError: the model was trained on another class table.
    """
    chosen = known_splits(dataset, splits)
    if why := class_mismatch(model, dataset.recipe):
        raise CheckpointError(f"{why}. Train it on a dataset with this class table.")
    return chosen


def known_splits(dataset: TerrainDataset, splits: Iterable[str] = ()) -> list[str]:
    """Tells which splits are to be measured, as `choose_splits`, whatever the model.

    Raises:
        DatasetError: there is no such split, or no test split.
    """
    chosen = list(dict.fromkeys(splits)) or [
        name for name in dataset.splits if name.startswith("test/")
    ]
    if not chosen:
        raise DatasetError(
            f"Expected a test split in {dataset.path}, got {sorted(dataset.splits)}. "
            "Name one in `splits`."
        )
    for split in chosen:
        dataset.map_count(split)  # refuses an unknown one
    return chosen


def evaluate(
    model: TraversabilityModel,
    dataset: TerrainDataset,
    splits: Iterable[str] = (),
    seed: int = 0,
    device: torch.device = CPU,
) -> Iterator[tuple[str, Quality]]:
    """Measures a model, a split at a time.

    Args:
        model: any model.
        dataset: the maps.
        splits: which splits; every test split when empty.
        seed: root seed of the draws within atoms.
        device: where to compute.

    Yields:
        Name of the split and the quality on it.

    Raises:
        DatasetError: there is no such split, or no test split.
        CheckpointError: the model was trained on another class table.
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
    """Measures a model on one split; by its λ alone where it knows other classes than
    the maps.

    Args:
        model: any model.
        dataset: the maps.
        split: which split.
        seed: root seed of the draws within atoms, the same for every model.
        device: where to compute.
        by_map: keep what a comparison needs, which takes quantiles of every cell.
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
    """Measures a model on some maps.

    Args:
        model: any model.
        chunks: the maps, at least one, a few at a time.
        generator: of the draws within atoms, on the CPU.
        alike: of each class those that look like it, itself among them; empty where
            none do.
        truth: whether the maps' true distribution of λ is known.
        by_map: keep what a comparison needs, which takes quantiles of every cell.
        classes: measure the model's classes, where it tells any.
    """
    maps = 0
    tally = _ClassTally(len(model.class_names) if classes else 0, alike)
    kept = MapTally(tally.count, truth, quantiles=by_map)
    for terrain in chunks:
        predicted, members = _predict(model, terrain)
        kept.add(
            _score_cells(
                predicted, terrain, generator, isinstance(model, PrivilegedModel)
            ),
            len(terrain),
        )
        maps += len(terrain)
        if tally.count:
            probabilities = predicted.class_probabilities(tally.count)
            tally.add(probabilities, members, terrain.class_id, terrain.slope_deg)
            if by_map:
                kept.add_classes(probabilities, terrain.class_id)
    sums = kept.sums() if maps else {}
    if not maps or not sums["cells"].any():
        raise DatasetError("Expected maps with an observed λ to measure on, got none.")
    values = {name: SCORES[name].value(sums) for name in _OF_CELLS}
    return Quality(
        maps=maps,
        traversability=TraversabilityQuality(
            **values,
            tail_rate=SCORES["tail_rate_90"].value(sums),
            pit=tuple(kept.pit.tolist()),
        ),
        classes=(tally.quality(),) if tally.confusion.any() else (),
        by_map=kept if by_map else None,
    )


def _predict(
    model: TraversabilityModel, terrain: Terrain
) -> tuple[TraversabilityDistribution, Tensor]:
    """The prediction, and the class probabilities of M members, shape [M, B, C, H, W],
    M = 0 where there are none.
    """
    observation = terrain.observe()
    with exact_convolutions():
        members = model.member_probabilities(observation)
    if isinstance(model, FusedModel) and members is not None:
        return model.fuse(members, observation), members
    return predict(model, terrain), torch.zeros(0) if members is None else members


class _ClassTally:
    """Counts of a model's class probabilities over maps, in the cells whose class is
    known.

    Args:
        count: number of classes C, 0 of a model without any.
        alike: of each class those that look like it, itself among them; empty where
            none do.
    """

    def __init__(self, count: int, alike: Sequence[tuple[int, ...]]) -> None:
        self.count, self.brier = count, 0.0
        self.confusion = torch.zeros(count, count, dtype=torch.int64)
        self.slope_cells = torch.zeros(count, 90, dtype=torch.int64)
        self.reliability, self.look_alikes = ReliabilityCurve(), LookAlikeTally(alike)
        self.entropy, self.information = ErrorRanking(), ErrorRanking()

    def add(
        self,
        probabilities: Tensor,
        members: Tensor,
        class_id: Tensor,
        slope_deg: Tensor,
    ) -> None:
        """Adds maps: probabilities [B, C, H, W], of members [M, B, C, H, W], true
        classes and slopes [B, H, W].
        """
        labelled = class_id != UNLABELLED
        if not bool(labelled.any()):
            return
        if not bool(labelled.all()):
            probabilities = _in_a_row(probabilities[None], labelled)[0]
            members = _in_a_row(members, labelled) if len(members) > 1 else members
            class_id, slope_deg = (
                layer[labelled][None, None] for layer in (class_id, slope_deg)
            )
        found = probabilities.argmax(1)
        wrong = found != class_id
        self.confusion += multiclass_confusion_matrix(found, class_id, self.count).cpu()
        self.brier += float(brier_score(probabilities, class_id).double().sum())
        self.reliability.update(probabilities, class_id)
        self.entropy.update(predictive_entropy(probabilities), wrong)
        if len(members) > 1:
            self.information.update(mutual_information(members), wrong)
        degree = slope_deg.floor().long().clamp(0, 89)
        counted = torch.bincount(
            (90 * class_id + degree).flatten(), minlength=self.slope_cells.numel()
        )
        self.slope_cells += counted.view_as(self.slope_cells).cpu()
        if self.look_alikes.groups:
            self.look_alikes.add(probabilities, class_id)

    def quality(self) -> ClassQuality:
        accuracy, miou, miou_predicted = class_scores(self.confusion)
        entropy, entropy_auroc = self.entropy.compute()
        information, information_auroc = self.information.compute()
        curve = self.reliability.compute()
        cells, confidence, right = curve.tolist()
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
            reliability={
                "cells": tuple(map(int, cells)),
                "confidence": tuple(confidence),
                "accuracy": tuple(right),
            },
            slope_cells=tuple(map(tuple, self.slope_cells.tolist())),
            look_alikes=self.look_alikes.quality() if self.look_alikes.groups else None,
        )


def _in_a_row(layers: Tensor, which: Tensor) -> Tensor:
    """Takes N cells out of maps, from [M, B, C, H, W] to [M, 1, C, 1, N]."""
    return layers.movedim(2, -1)[:, which].movedim(-1, 1)[:, None, :, None]


def _score_cells(
    predicted: TraversabilityDistribution,
    terrain: Terrain,
    generator: torch.Generator,
    privileged: bool,
) -> CellScores | None:
    """What is said of each cell whose λ was observed, None where there are none.

    Of a privileged model, which says nothing where no class is known, cells without a
    class are left out as well.
    """
    labelled = terrain.class_id != UNLABELLED
    known = ~terrain.traversability.isnan()
    known = known & labelled if privileged else known
    if not bool(known.any()):
        return None
    predicted, observed = (
        predicted.at(known),
        terrain.traversability[known].unsqueeze(0),
    )
    expected, transformed = predicted.mean(), pit(predicted, observed, generator)
    labelled = labelled[known]
    return CellScores(
        predicted=predicted,
        observed=observed,
        expected=expected,
        transformed=transformed,
        maps=known.nonzero()[:, 0],
        scores={
            "squares": (expected - observed).double().square(),
            "nll": -predicted.log_prob(observed).double(),
            "crps": predicted.crps(observed).double(),
        },
        labelled=labelled,
        expected_squares=(expected - terrain.truth.at(known).mean())[0, labelled]
        .double()
        .square(),
    )
