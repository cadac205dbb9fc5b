"""What the numbers and figures of a model's quality mean, in plain words for who meets them first."""

from collections.abc import Iterable

# By the names of `report.HEADINGS`.
COLUMNS = {
    "accuracy": "share of cells whose most likely class is the true one; 1 is perfect.",
    "miou": "mean intersection over union: the cells where a class is both predicted and true, over those where it is "
    "either, in the mean over the classes that occur in truth; 1 is perfect.",
    "miou_predicted": "the same in the mean over the classes that are true or predicted somewhere; one that never "
    "occurs counts as 0 as soon as a cell is taken for it.",
    "look_alike_accuracy": "accuracy with classes of one colour counted as one, as no image tells them apart; 1 is "
    "perfect.",
    "look_alike_miou": "mean intersection over union with classes of one colour counted as one; 1 is perfect.",
    "look_alike_share_error": "of two classes that share a colour, how far the share of the true one is from ½, which "
    "is all that can be said; 0 is perfect.",
    "look_alike_share_ece": "of two classes that share a colour, the calibration error of the larger share; 0 is "
    "perfect.",
    "ece": "expected calibration error: how far the probability of the most likely class is from how often it is "
    "right, in the mean over cells; 0 is perfect.",
    "brier": "squared distance of the class probabilities to the truth, which is 1 for the true class and 0 for the "
    "rest; 0 is perfect, 2 is sure and wrong.",
    "entropy": "mean uncertainty of the class in nats; 0 is sure.",
    "mutual_information": "the part of the entropy in which the members of an ensemble disagree, in nats.",
    "entropy_auroc": "how often a wrongly classified cell has a higher entropy than a right one: 1 where uncertainty "
    "finds every error, 0.5 where it tells nothing.",
    "mutual_information_auroc": "the same of mutual information.",
    "rmse_observed": "typical distance of the predicted mean to λ as observed; the noise of the ground stays in it, "
    "even for a perfect model.",
    "rmse_expected": "typical distance of the predicted mean to the true mean of λ; 0 is perfect, and – stands where "
    "the true mean is unknown.",
    "nll": "minus the logarithm of the predicted density at λ as observed, in the mean; lower is better, and it may be "
    "negative.",
    "crps": "continuous ranked probability score: distance of the predicted distribution to λ as observed, in units of "
    "λ; lower is better.",
    "coverage": "share of observed λ within the central 90 % of their prediction; 0.9 is perfect, and less means that "
    "the model is too sure.",
    "tail_rate": "share of observed λ under the value at risk (VaR) at level 0.9, under which a tenth should fall; 0.1 "
    "is perfect, and more means that bad ground comes more often than predicted.",
}

# Title and explanation by the name of a figure; those of map sheets go on with the split.
_FIGURES = {
    "confusion": (
        "Which class is taken for which",
        "A row is a true class, a column the most likely one; a number is a share of the row in percent. A perfect "
        "model has 100 along the diagonal, but no model can tell classes of one colour apart. A grey row is of a class "
        "that no map of the split shows.",
    ),
    "reliability": (
        "Whether the class probabilities can be trusted",
        "Above, how often the most likely class is right, over its probability: on the dashed line they are the same, "
        "under it the model is too sure. ECE is the mean gap. Below, how many cells have such a probability.",
    ),
    "pit": (
        "Whether the predicted distribution of λ can be trusted",
        "The probability integral transform (PIT) says where an observed λ lies in its prediction, from 0 at the low "
        "end to 1 at the high end. Calibrated is flat at 1. High at both ends means too sure, high in the middle not "
        "sure enough; high at the left, in orange, that bad ground comes more often than predicted. Each panel has a "
        "scale of its own.",
    ),
    "severity": (
        "Quality over the severity of a shift",
        "The numbers of the table over the severity of each scenario, from 0, the maps of training, to the scenario "
        "itself at 1.",
    ),
    "latent": (
        "What the Gaussian processes have learned",
        "Traversability over slope, class by class, beside the truth in black where it is known. Where it is grey, few "
        "of the measured cells are as steep, or none.",
    ),
    "maps": (
        "Maps of",
        "A row a map, from what the robot sees to the truth, the prediction, its error and its uncertainty; where the "
        "true distribution of λ is unknown, λ as observed stands for it. A quantity has the same scale in all sheets "
        "of an evaluation.",
    ),
}


def caption(figure: str, splits: Iterable[str]) -> tuple[str, str]:
    """Gives the title of a figure, and what it shows.

    Args:
        figure: its name, such as `pit`, or `maps-test-std` of a map sheet.
        splits: names of those that were measured.
    """
    if figure in _FIGURES:
        return _FIGURES[figure]
    title, text = _FIGURES["maps"]
    return f"{title} {next(split for split in splits if sheet_name(split) == figure)}", text


def sheet_name(split: str) -> str:
    """Name of the map sheet of a split."""
    return f"maps-{split.replace('/', '-')}"
