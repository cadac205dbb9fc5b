"""Scores of models, computed from sums by map (`map_sums`).

Each score states whether higher or lower is better, or neither.
Scores that tables of a single model also show have the headings and meanings of
`columns`.
"""

from typing import Any

import numpy as np

from benchnav.models.quality.columns import COLUMNS
from benchnav.models.quality.scores import LEVEL, TAIL_LEVELS
from benchnav.stats.scores import Score

_COMPARED = {
    "pinball": (
        "pinball\nfifth",
        "pinball loss of the lower fifth: u·(λ − Q(u)) where λ is at least the "
        "quantile Q(u), otherwise (1 − u)·(Q(u) − λ), averaged over the levels u = "
        "0.01, 0.02, …, 0.20. It scores the lower tail of the prediction; lower is "
        "better.",
    ),
    "width": (
        "width\n90 %",
        "sharpness: mean width Q(0.95) − Q(0.05) of the central 90 % interval; "
        "narrower is better if “in 90 %” is calibrated.",
    ),
    "tail_error": (
        "tail\nerror",
        "tail calibration: mean gap between the fractions of observed λ below VaR₀.₈, "
        "VaR₀.₉ and VaR₀.₉₅, and 0.2, 0.1 and 0.05; 0 is perfect.",
    ),
    "ause": (
        "AUSE\n",
        "area under the sparsification error curve: area between the curves of the mean "
        "error |λ − E[λ]| of the remaining cells if cells are removed by uncertainty "
        "and by error, averaged over maps. 0 is perfect; noise of λ keeps it above 0 "
        "for any model.",
    ),
}
_UNDER = {level: f"under_{round(100 * level)}" for level in TAIL_LEVELS}


def _ratio(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    quotient: np.ndarray = numerator.sum(-1) / denominator.sum(-1)
    return quotient


def _root(squares: np.ndarray, cells: np.ndarray) -> np.ndarray:
    return np.sqrt(_ratio(squares, cells))


def _miou(hits: np.ndarray, true: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Return the intersection over union, averaged over the true classes."""
    union = true + predicted - hits
    divisor = np.where(union > 0, union, 1)
    overlap: np.ndarray = np.where(true > 0, hits / divisor, 0.0)
    n_classes = (true > 0).sum(-1)
    mean: np.ndarray = overlap.sum(-1) / n_classes
    return mean


def _tail_error(cells: np.ndarray, *under: np.ndarray) -> np.ndarray:
    """Return the mean over levels of |fraction of λ below the VaR − (1 − level)|."""
    gaps = []
    for count, level in zip(under, TAIL_LEVELS, strict=True):
        fraction = _ratio(count, cells)
        gaps.append(abs(fraction - (1 - level)))
    return np.mean(gaps, axis=0)


def _score(
    name: str, *parts: str, of: Any = _ratio, better: Any = "lower", target: Any = None
) -> Score:
    heading, meaning = (COLUMNS | _COMPARED).get(name, ("", ""))
    return Score(
        name=name,
        parts=parts,
        of=of,
        better=better,
        target=target,
        heading=heading,
        meaning=meaning,
    )


# Neither direction of the width is better: a narrow interval must also cover λ.
COMPARED = (
    _score("accuracy", "hits", "true", better="higher"),
    _score("miou", "hits", "true", "predicted", of=_miou, better="higher"),
    _score("rmse_expected", "expected_squares", "labelled", of=_root),
    _score("rmse_observed", "squares", "cells", of=_root),
    _score("nll", "nll", "cells"),
    _score("crps", "crps", "cells"),
    _score("pinball", "pinball", "cells"),
    _score("coverage", "inside", "cells", better="", target=LEVEL),
    _score("width", "width", "cells", better=""),
    _score("tail_error", "cells", *_UNDER.values(), of=_tail_error),
    _score("ause", "areas", "cells"),
)
# Fractions of λ below the VaR at each level, which `tail_error` summarises.
TAIL_RATES = tuple(
    _score(f"tail_rate_{round(100 * level)}", part, "cells", better="")
    for level, part in _UNDER.items()
)
SCORES = {score.name: score for score in (*COMPARED, *TAIL_RATES)}
