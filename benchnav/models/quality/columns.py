"""Columns of the tables of models: their headings, and what they hold."""

# Of the numbers of ClassQuality and TraversabilityQuality: the heading in two lines,
# and what it means to who meets it first.
COLUMNS = {
    "accuracy": (
        "accuracy\n",
        "share of cells whose most likely class is the true one; 1 is perfect.",
    ),
    "miou": (
        "mIoU\n",
        "mean intersection over union of the predicted and the true cells of a class, "
        "averaged over the classes that "
        "occur in truth; 1 is perfect.",
    ),
    "miou_predicted": (
        "mIoU\n∪ pred.",
        "mIoU averaged over all classes that are true or predicted somewhere; a class "
        "that is predicted and never "
        "occurs counts as 0.",
    ),
    "look_alike_accuracy": (
        "accuracy\nlook-alikes=1",
        "accuracy with classes of one colour counted as one, as no image tells them "
        "apart; 1 is perfect.",
    ),
    "look_alike_miou": (
        "mIoU\nlook-alikes=1",
        "mean intersection over union with classes of one colour counted as one; 1 is "
        "perfect.",
    ),
    "look_alike_share_error": (
        "look-alikes\noff ½",
        "distance from ½ of the share that the true one of two look-alike classes is "
        "given; 0 is perfect, since no "
        "image tells them apart.",
    ),
    "look_alike_share_ece": (
        "ECE\nlook-alikes",
        "calibration error of the larger share of two look-alike classes; 0 is "
        "perfect.",
    ),
    "ece": (
        "ECE\n",
        "expected calibration error: mean gap between the probability of the most "
        "likely class and its accuracy; 0 is "
        "perfect.",
    ),
    "brier": (
        "Brier\n",
        "mean squared distance of the class probabilities to the true class; 0 is "
        "perfect, 2 is sure and wrong.",
    ),
    "entropy": (
        "entropy\n[nats]",
        "mean entropy of the class probabilities in nats; 0 is sure.",
    ),
    "mutual_information": (
        "mutual\ninf.",
        "the part of the entropy in which the members of an ensemble disagree, in "
        "nats.",
    ),
    "entropy_auroc": (
        "AUROC\nentropy",
        "probability that a wrong cell has a higher entropy than a right one; 1 is "
        "perfect, 0.5 is chance.",
    ),
    "mutual_information_auroc": (
        "AUROC\nm. inf.",
        "AUROC of mutual information, as for entropy.",
    ),
    "rmse_observed": (
        "RMSE\nλ",
        "root mean squared error of the predicted mean against observed λ; noise of "
        "the ground keeps it above 0 even "
        "for a perfect model.",
    ),
    "rmse_expected": (
        "RMSE\nE[λ]",
        "root mean squared error of the predicted mean against the true mean of λ; 0 "
        "is perfect. A dash: the true mean "
        "is unknown.",
    ),
    "nll": (
        "NLL\nλ",
        "mean negative log-likelihood of observed λ; lower is better, also below 0. A "
        "dash: the predicted distribution "
        "has no density.",
    ),
    "crps": (
        "CRPS\nλ",
        "continuous ranked probability score of the predicted distribution against "
        "observed λ, in units of λ; lower is "
        "better.",
    ),
    "coverage": (
        "in 90 %\n(0.9)",
        "coverage: share of observed λ within the central 90 % interval of its "
        "prediction; 0.9 is perfect, less means "
        "overconfident.",
    ),
    "tail_rate": (
        "< VaR\n(0.1)",
        "share of observed λ below the value at risk VaR₀.₉; 0.1 is perfect, more "
        "means that bad ground is more "
        "frequent than predicted.",
    ),
}
# Where classes look alike.
LOOK_ALIKES = (
    "look_alike_accuracy",
    "look_alike_miou",
    "look_alike_share_error",
    "look_alike_share_ece",
)
# For these a terminal is too narrow.
FILES_ONLY = (
    "miou_predicted",
    "entropy",
    "mutual_information",
    "look_alike_miou",
    "look_alike_share_error",
)
