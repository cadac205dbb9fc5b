"""How good a model's predictions are, a split at a time: of classes, and of traversability.

One pass over the maps with sums and counts alone, so that memory does not grow with them. The scores
themselves stand in `scores`. Letters in shapes: B maps, H×W cells, C classes, N
cells of all maps.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torchmetrics import MetricCollection
from torchmetrics.classification import (
    MulticlassAccuracy,
    MulticlassConfusionMatrix,
    MulticlassJaccardIndex,
)

from benchnav.core import rng
from benchnav.core.device import CPU, exact_convolutions
from benchnav.core.errors import CheckpointError, DatasetError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Terrain
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.classes import look_alike_classes
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.base import PrivilegedModel, TraversabilityModel, predict
from benchnav.models.fused import FusedModel
from benchnav.models.nets.classifier import MeanIoU
from benchnav.models.probabilities import class_probabilities
from benchnav.models.quality.scores import (
    LEVEL,
    PIT_BINS,
    BrierScore,
    ErrorRanking,
    LookAlikeQuality,
    LookAlikeTally,
    ReliabilityCurve,
    calibration_error,
    coverage,
    crps,
    mutual_information,
    pit,
    pit_counts,
    predictive_entropy,
    tail_rate,
)


@dataclass(frozen=True, kw_only=True)
class Reliability:
    """How often the most likely class is right, by its probability, in equal bins of [0, 1].

    Args:
        cells: how many cells have their most likely class in each bin.
        confidence: its mean probability; 0 in an empty bin.
        accuracy: how often it is right; 0 in an empty bin.
    """

    cells: tuple[int, ...]
    confidence: tuple[float, ...]
    accuracy: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class ClassQuality:
    """Quality of class probabilities.

    Args:
        accuracy: share of cells whose most likely class is right.
        miou: intersection over union, averaged over the classes that occur in truth.
        miou_predicted: the same over those that are predicted somewhere too, of which each that does not occur
            counts as 0.
        ece: expected calibration error of the most likely class, 15 bins.
        brier: Brier score, the squared distance of the probabilities to the class that is there, 0–2.
        entropy: mean predictive entropy, in nats.
        mutual_information: mean mutual information of class and member, in nats; not a number for a
            model without several members.
        entropy_auroc: how often the entropy is higher in a wrongly than in a rightly classified cell;
            not a number where all or none are wrong.
        mutual_information_auroc: the same of mutual information.
        confusion: cells by true class (row) and most likely class (column), [C][C].
        reliability: the curve that the ECE sums up.
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
    reliability: Reliability
    slope_cells: tuple[tuple[int, ...], ...]
    look_alikes: LookAlikeQuality | None = None


@dataclass(frozen=True, kw_only=True)
class TraversabilityQuality:
    """Quality of predicted distributions of traversability; lower is better but for the last three.

    Args:
        rmse_observed: root mean square of E[λ] − λ as realised.
        rmse_expected: root mean square of E[λ] − E[λ] in truth, of labelled cells; not a number where there is none
            or the truth is not known.
        nll: negative log likelihood of λ as realised, density inside (0, 1) and mass at 0 and 1.
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
        classes: of the class probabilities; empty for a model that predicts no classes, and on maps without any.
    """

    maps: int
    traversability: TraversabilityQuality
    classes: tuple[ClassQuality, ...]


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
    chosen = list(dict.fromkeys(splits)) or [name for name in dataset.splits if name.startswith("test/")]
    if not chosen:
        raise DatasetError(
            f"Expected a test split in {dataset.path}, got {sorted(dataset.splits)}. Name one in `splits`."
        )
    for split in chosen:
        dataset.map_count(split)
    names = tuple(item.name for item in dataset.recipe.classes)
    if model.class_names not in ((), names):
        raise CheckpointError(
            f"Expected a model of the classes {', '.join(names)}, got one of {', '.join(model.class_names)}. "
            "Train it on a dataset with this class table."
        )
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
    alike = look_alike_classes(dataset.recipe.classes)
    for split in choose_splits(model, dataset, splits):
        truth = dataset.truth_of(split) == "generated"
        generator = rng.generator(rng.stream_key(seed, "models", "pit", split))
        chunks = (terrain.to(device) for terrain in dataset.terrain_chunks(split))
        yield split, measure(model, chunks, generator, alike, truth)


def measure(
    model: TraversabilityModel,
    chunks: Iterable[Terrain],
    generator: torch.Generator,
    alike: Sequence[tuple[int, ...]] = (),
    truth: bool = True,
) -> Quality:
    """Measures a model on some maps.

    Args:
        model: any model.
        chunks: the maps, at least one, a few at a time.
        generator: of the draws within atoms, on the CPU.
        alike: of each class those that look like it, itself among them; empty where none do.
        truth: whether the maps' true distribution of λ is known.
    """
    maps, cells, sums = 0, 0, torch.zeros(7, dtype=torch.float64)
    histogram = torch.zeros(PIT_BINS, dtype=torch.int64)
    classes: list[_ClassTally] = []
    for terrain in chunks:
        mixture, members = _predict(model, terrain)
        scores, transformed = _score_cells(mixture, terrain, generator, isinstance(model, PrivilegedModel))
        sums += scores.cpu()
        histogram += pit_counts(transformed)
        maps, cells = maps + len(terrain), cells + transformed.numel()
        if model.class_names:
            classes = classes or [
                _ClassTally(len(model.class_names), terrain.rgb.device, len(members) > 1, alike)
            ]
            probabilities = class_probabilities(mixture, len(model.class_names))
            classes[0].add(probabilities, members, terrain.class_id, terrain.slope_deg)
    if not cells:
        raise DatasetError("Expected maps with an observed λ to measure on, got none.")
    squared_expected = float(sums[5] / sums[6]) if truth else math.nan
    squared_observed, nll, score, covered, in_tail = (sums[:5] / cells).tolist()
    return Quality(
        maps=maps,
        traversability=TraversabilityQuality(
            rmse_observed=squared_observed**0.5,
            rmse_expected=squared_expected**0.5,
            nll=nll,
            crps=score,
            coverage=covered,
            tail_rate=in_tail,
            pit=tuple(histogram.tolist()),
        ),
        classes=tuple(tally.quality() for tally in classes if tally.entropy.cells),
    )


def _predict(model: TraversabilityModel, terrain: Terrain) -> tuple[TraversabilityMixture, Tensor]:
    """The prediction, and the class probabilities of M members, shape [M, B, C, H, W], M = 0 where there are none."""
    if isinstance(model, FusedModel):
        observation = terrain.observe()
        with exact_convolutions():
            members = model.member_probabilities(observation)
        return model.fuse(members, observation), members
    mixture = predict(model, terrain)
    with exact_convolutions():
        found = model.member_probabilities(terrain.observe())
    return mixture, torch.zeros(0) if found is None else found


class _ClassTally:
    """Counts of a model's class probabilities over maps, in the cells whose class is known.

    Args:
        count: number of classes C.
        device: where the maps are.
        several: whether the model has several members.
        alike: of each class those that look like it, itself among them; empty where none do.
    """

    def __init__(
        self, count: int, device: torch.device, several: bool, alike: Sequence[tuple[int, ...]]
    ) -> None:
        self.by_class = MetricCollection(
            {
                "accuracy": MulticlassAccuracy(count, average="micro"),
                "miou": MeanIoU(count),
                "miou_predicted": MulticlassJaccardIndex(count, average="macro"),
                "confusion": MulticlassConfusionMatrix(count),
            }
        ).to(device)
        self.brier, self.reliability = BrierScore().to(device), ReliabilityCurve().to(device)
        self.entropy = _Uncertainty(device)
        self.information = _Uncertainty(device) if several else None
        self.slope_cells = torch.zeros(count, 90, dtype=torch.int64, device=device)
        self.look_alikes = LookAlikeTally(alike, device) if any(len(own) > 1 for own in alike) else None

    def add(self, probabilities: Tensor, members: Tensor, class_id: Tensor, slope_deg: Tensor) -> None:
        """Adds maps: probabilities [B, C, H, W], of members [M, B, C, H, W], true classes and slopes [B, H, W]."""
        labelled = class_id != UNLABELLED
        if not bool(labelled.any()):
            return
        if not bool(labelled.all()):
            probabilities = _in_a_row(probabilities[None], labelled)[0]
            members = _in_a_row(members, labelled) if self.information is not None else members
            class_id, slope_deg = (layer[labelled][None, None] for layer in (class_id, slope_deg))
        found = probabilities.argmax(1)
        wrong = found != class_id
        self.by_class.update(found, class_id)
        self.brier.update(probabilities, class_id)
        self.reliability.update(probabilities, class_id)
        self.entropy.add(predictive_entropy(probabilities), wrong)
        if self.information is not None:
            self.information.add(mutual_information(members), wrong)
        degree = slope_deg.floor().long().clamp(0, 89)
        counted = torch.bincount((90 * class_id + degree).flatten(), minlength=self.slope_cells.numel())
        self.slope_cells += counted.view_as(self.slope_cells)
        if self.look_alikes is not None:
            self.look_alikes.add(probabilities, class_id)

    def quality(self) -> ClassQuality:
        by_class, curve = self.by_class.compute(), self.reliability.compute().cpu()
        return ClassQuality(
            accuracy=float(by_class["accuracy"]),
            miou=float(by_class["miou"]),
            miou_predicted=float(by_class["miou_predicted"]),
            ece=calibration_error(curve),
            brier=float(self.brier.compute()),
            entropy=self.entropy.mean,
            mutual_information=math.nan if self.information is None else self.information.mean,
            entropy_auroc=self.entropy.auroc,
            mutual_information_auroc=math.nan if self.information is None else self.information.auroc,
            confusion=tuple(tuple(row) for row in by_class["confusion"].tolist()),
            reliability=Reliability(
                cells=tuple(int(cells) for cells in curve[0]),
                confidence=tuple(curve[1].tolist()),
                accuracy=tuple(curve[2].tolist()),
            ),
            slope_cells=tuple(tuple(row) for row in self.slope_cells.tolist()),
            look_alikes=None if self.look_alikes is None else self.look_alikes.quality(),
        )


class _Uncertainty:
    """Counts of a measure of uncertainty over cells."""

    def __init__(self, device: torch.device) -> None:
        self._ranking, self._total, self.cells = ErrorRanking().to(device), 0.0, 0

    def add(self, measure: Tensor, wrong: Tensor) -> None:
        """Adds cells: the measure, and whether each is wrongly classified, of one shape."""
        self._ranking.update(measure, wrong)
        self._total += float(measure.double().sum())
        self.cells += measure.numel()

    @property
    def mean(self) -> float:
        return self._total / self.cells

    @property
    def auroc(self) -> float:
        return float(self._ranking.compute())


def _in_a_row(layers: Tensor, which: Tensor) -> Tensor:
    """Takes N cells out of maps, from [M, B, C, H, W] to [M, 1, C, 1, N]."""
    return layers.movedim(2, -1)[:, which].movedim(-1, 1)[:, None, :, None]


def _score_cells(
    mixture: TraversabilityMixture, terrain: Terrain, generator: torch.Generator, privileged: bool
) -> tuple[Tensor, Tensor]:
    """What is summed over cells, float64, shape [7]; and every PIT.

    The sums: squared errors, NLL, CRPS, covered cells, cells in the tail, squared errors of E[λ], and the cells of
    which these are. Cells whose λ was not observed are left out; of a privileged model, which says nothing where no
    class is known, those without a class as well.
    """
    labelled = terrain.class_id != UNLABELLED
    known = ~terrain.traversability.isnan()
    known = known & labelled if privileged else known
    if not bool(known.any()):
        return torch.zeros(7, dtype=torch.float64), torch.zeros(0)
    mixture, observed = mixture.at(known), terrain.traversability[known].unsqueeze(0)
    truth = terrain.truth.at(known).mean()
    expected, transformed = mixture.mean(), pit(mixture, observed, generator)
    cells = transformed.numel()
    errors = (expected - truth)[0, labelled[known]].double().square()
    sums = [
        (expected - observed).double().square().sum(),
        -mixture.log_prob(observed).double().sum(),
        crps(mixture, observed).double().sum(),
        torch.as_tensor(coverage(transformed) * cells, device=observed.device),
        torch.as_tensor(tail_rate(transformed, LEVEL) * cells, device=observed.device),
        errors.sum(),
        torch.as_tensor(errors.numel(), device=observed.device),
    ]
    return torch.stack([total.double() for total in sums]), transformed


def nearest_colour(rgb: Tensor, colours: Tensor) -> Tensor:
    """Takes for each cell the class whose colour in full light is nearest, by Euclidean distance.

    Args:
        rgb: 0–255, shape [B, 3, H, W].
        colours: of the classes, 0–255, shape [C, 3].

    Returns:
        Class indices, int64, shape [B, H, W]; of classes equally near the first.
    """
    pixels = rgb.movedim(1, -1).float()
    return (
        torch.cdist(pixels.flatten(1, 2), colours.float().expand(len(rgb), -1, -1))
        .argmin(-1)
        .view(len(rgb), *rgb.shape[-2:])
    )


def nearest_colour_accuracy(dataset: TerrainDataset, split: str) -> float:
    """Share of a split's labelled cells whose class `nearest_colour` tells."""
    colours = torch.tensor([item.colour for item in dataset.recipe.classes])
    right, cells = 0, 0
    for _, maps in dataset.chunks(split, ("rgb", "class_id")):
        found = nearest_colour(torch.from_numpy(maps["rgb"]), colours)
        class_id = torch.from_numpy(maps["class_id"])
        right += int((found == class_id).sum())
        cells += int((class_id != UNLABELLED).sum())
    return right / max(1, cells)
