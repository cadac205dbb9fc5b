"""The shipped figures, in the order of the report."""

from collections.abc import Sequence

from benchnav.core.specified import arguments_of
from benchnav.eval.figures.between_worlds import WorldAgreement
from benchnav.eval.figures.data import RunData
from benchnav.eval.figures.distributions import Distributions
from benchnav.eval.figures.driven import DrivenPaths
from benchnav.eval.figures.failures import Failures
from benchnav.eval.figures.forest import Forest
from benchnav.eval.figures.knowledge import KnowledgeMaps
from benchnav.eval.figures.learning import Learning
from benchnav.eval.figures.outcomes import Outcomes
from benchnav.eval.figures.over import Over
from benchnav.eval.figures.regret import Regret
from benchnav.eval.figures.same_episode import SameEpisode
from benchnav.eval.figures.success import Success
from benchnav.eval.figures.trajectories import Trajectories
from benchnav.eval.figures.waterfall import Waterfall
from benchnav.viz.figure import Figure, applicable

SHIPPED: tuple[type[Figure], ...] = (
    *(Forest, Success, WorldAgreement, Waterfall, Regret, DrivenPaths, Over),
    *(Outcomes, Distributions),
    *(Failures, Learning, KnowledgeMaps, SameEpisode, Trajectories),
)


def figures_of(data: RunData, more: Sequence[Figure] = ()) -> list[Figure]:
    """List the figures of a run, each with a unique name.

    Args:
        data: data of the run.
        more: further figures, after the shipped ones; shipped figures without
            arguments are ignored.

    Returns:
        Figures whose data the run has.
    """
    figures: list[Figure] = [cls() for cls in SHIPPED]
    figures += [figure for figure in more if not is_shipped(figure)]
    return applicable(figures, data)


def is_shipped(figure: Figure) -> bool:
    """Return whether a figure is drawn for every run: shipped, and without arguments."""
    return type(figure) in SHIPPED and not any(arguments_of(figure) or ())
