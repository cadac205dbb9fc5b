"""Headings and meanings of the columns in tables of models."""

# Heading, in two lines, and meaning of each number of ClassQuality and
# TraversabilityQuality.
COLUMNS = {
    "accuracy": (
        "accuracy\n",
        "fraction of cells whose most likely class is the true class; 1 is perfect.",
    ),
    "miou": (
        "mIoU\n",
        "mean intersection over union of the predicted and the true cells of a class, "
        "averaged over the classes that occur in the truth; 1 is perfect.",
    ),
    "miou_predicted": (
        "mIoU\n∪ pred.",
        "mIoU averaged over all classes that are true or predicted in any cell; a class "
        "that is predicted but never true counts as 0.",
    ),
    "look_alike_accuracy": (
        "accuracy\nlook-alikes=1",
        "accuracy with classes of the same colour merged, since images cannot "
        "distinguish them; 1 is perfect.",
    ),
    "look_alike_miou": (
        "mIoU\nlook-alikes=1",
        "mean intersection over union with classes of the same colour merged; 1 is "
        "perfect.",
    ),
    "look_alike_share_error": (
        "look-alikes\noff ½",
        "mean distance from ½ of the true class's fraction of the probability of two "
        "look-alike classes; 0 is perfect, since images cannot distinguish them.",
    ),
    "look_alike_share_ece": (
        "ECE\nlook-alikes",
        "calibration error of the more likely of two look-alike classes; 0 is perfect.",
    ),
    "ece": (
        "ECE\n",
        "expected calibration error: mean gap between the probability of the most "
        "likely class and its accuracy; 0 is perfect.",
    ),
    "brier": (
        "Brier\n",
        "mean squared distance of the class probabilities from the true class; 0 is "
        "perfect, 2 is certain and wrong.",
    ),
    "entropy": (
        "entropy\n[nats]",
        "mean entropy of the class probabilities in nats; 0 is certain.",
    ),
    "mutual_information": (
        "mutual\ninf.",
        "part of the entropy that is due to disagreement between an ensemble's members, "
        "in nats.",
    ),
    "entropy_auroc": (
        "AUROC\nentropy",
        "probability that a misclassified cell has a higher entropy than a correct "
        "one; 1 is perfect, 0.5 is chance.",
    ),
    "mutual_information_auroc": (
        "AUROC\nm. inf.",
        "as AUROC entropy, with mutual information instead of entropy.",
    ),
    "rmse_observed": (
        "RMSE\nλ",
        "root mean squared error of the predicted mean against observed λ; noise of λ "
        "keeps it above 0 even for a perfect model.",
    ),
    "rmse_expected": (
        "RMSE\nE[λ]",
        "root mean squared error of the predicted mean against the true mean of λ; 0 "
        "is perfect. A dash: the true mean is unknown.",
    ),
    "nll": (
        "NLL\nλ",
        "mean negative log-likelihood of observed λ; lower is better, also below 0. A "
        "dash: the predicted distribution has no density.",
    ),
    "crps": (
        "CRPS\nλ",
        "continuous ranked probability score of the predicted distribution against "
        "observed λ, in units of λ; lower is better.",
    ),
    "coverage": (
        "in 90 %\n(0.9)",
        "coverage: fraction of observed λ within the central 90 % interval of its "
        "prediction; 0.9 is perfect, less means overconfident.",
    ),
    "tail_rate": (
        "< VaR\n(0.1)",
        "fraction of observed λ below the value at risk VaR₀.₉; 0.1 is perfect, more "
        "means that low λ is more frequent than predicted.",
    ),
}
# Columns that are shown only if there are look-alike classes.
LOOK_ALIKES = (
    "look_alike_accuracy",
    "look_alike_miou",
    "look_alike_share_error",
    "look_alike_share_ece",
)
# Columns that are not shown in terminals, which are too narrow.
FILES_ONLY = (
    "miou_predicted",
    "entropy",
    "mutual_information",
    "look_alike_miou",
    "look_alike_share_error",
)
