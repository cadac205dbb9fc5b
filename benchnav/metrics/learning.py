"""Metrics of what a robot learnt during an episode; NaN if it learnt nothing."""

import math

import numpy as np

from benchnav.metrics.base import Episode, Learnt, Metric


class _OfLearnt(Metric):
    """A metric of robots that learn."""

    min_steps = 0

    def compute(self, episode: Episode) -> float:
        """Return the value; NaN if the robot learnt nothing."""
        return math.nan if episode.learnt is None else float(self.of(episode.learnt))

    def of(self, learnt: Learnt) -> float:
        """Return the value of a robot that learnt: what it holds under the name of the
        column.
        """
        value: float = getattr(learnt, self.column)
        return value


class Revisions(_OfLearnt):
    """How often the planner was given another map."""

    name = column = heading = "revisions"
    meaning = "how often its planner was given another map"


class SeenCells(_OfLearnt):
    """Cells whose appearance the robot saw."""

    name = column = "seen_cells"
    heading = "cells seen"
    meaning = "cells whose appearance a robot saw"


class SensedCells(_OfLearnt):
    """Cells whose λ the robot sensed."""

    name = column = "sensed_cells"
    heading = "cells sensed"
    meaning = "cells whose λ it sensed"


class _Ahead(_OfLearnt):
    """A mean over the updates of an episode."""

    index: int

    def of(self, learnt: Learnt) -> float:
        """Return the mean; NaN if nothing was updated."""
        updates = learnt.ahead[~np.isnan(learnt.ahead[:, 0])]
        # Both columns at once: a mean of one column sums in another order.
        return updates.mean(0)[self.index] if len(updates) else math.nan


class AheadRmse(_Ahead):
    """Root mean square error of the believed E[λ] ahead of the robot."""

    name = column = "ahead_rmse"
    heading = "RMSE ahead"
    better = "lower"
    index = 0
    meaning = (
        "root mean square error of the believed E[λ] over the cells ahead of the "
        "robot of which λ was not sensed, mean "
        "over updates"
    )


class AheadLogScore(_Ahead):
    """Mean log score of the belief ahead of the robot."""

    name = column = "ahead_log_score"
    heading = "log score ahead"
    better = "higher"
    index = 1
    meaning = "mean log score of the belief over these cells, at least −10 a cell"


class LearningTime(_OfLearnt):
    """Wall time of sensing and belief."""

    name = "learning_time"
    column = "learning_ms"
    unit = "ms"
    heading = "belief [ms]"
    better = "lower"
    meaning = (
        "time of a step for sensing and belief, of a batch divided by its episodes"
    )

    def of(self, learnt: Learnt) -> float:
        """Return the time in milliseconds."""
        return 1e3 * learnt.step_s
