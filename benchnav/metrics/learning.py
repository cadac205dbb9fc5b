"""Metrics of learning during an episode; NaN if the robot does not learn."""

import math

import numpy as np

from benchnav.metrics.base import Episode, LearningRecord, Metric


class _LearningMetric(Metric):
    """A metric of robots that learn."""

    min_steps = 0

    def compute(self, episode: Episode) -> float:
        """Return the value; NaN if the robot does not learn."""
        if episode.learning is None:
            return math.nan
        return float(self.of(episode.learning))

    def of(self, record: LearningRecord) -> float:
        """Return the attribute of the record that is named like the column."""
        value: float = getattr(record, self.column)
        return value


class Revisions(_LearningMetric):
    """Number of times that the planner received an updated map."""

    name = column = heading = "revisions"
    meaning = "number of times that the planner received an updated map"


class SeenCells(_LearningMetric):
    """Number of cells whose appearance was observed."""

    name = column = "seen_cells"
    heading = "cells seen"
    meaning = "number of cells whose appearance was observed"


class SensedCells(_LearningMetric):
    """Number of cells whose λ was measured."""

    name = column = "sensed_cells"
    heading = "cells sensed"
    meaning = "number of cells whose λ was measured"


class _Ahead(_LearningMetric):
    """Mean of one column of `LearningRecord.ahead` over the updates of an episode.

    Attributes:
        index: index of the column.
    """

    index: int

    def of(self, record: LearningRecord) -> float:
        """Return the mean; NaN if the belief was never updated."""
        updates = record.ahead[~np.isnan(record.ahead[:, 0])]
        if not len(updates):
            return math.nan
        # Average both columns together: the mean of a single column would add values in
        # a different order.
        return updates.mean(0)[self.index]


class AheadRmse(_Ahead):
    """Root mean square error of the posterior mean E[λ] ahead of the robot."""

    name = column = "ahead_rmse"
    heading = "RMSE ahead"
    better = "lower"
    index = 0
    meaning = (
        "root mean square error of the posterior mean E[λ] over the cells ahead of "
        "the robot whose λ was not measured, mean over updates"
    )


class AheadLogScore(_Ahead):
    """Mean log score of the belief ahead of the robot."""

    name = column = "ahead_log_score"
    heading = "log score ahead"
    better = "higher"
    index = 1
    meaning = (
        "mean log score of the belief over the cells ahead of the robot whose λ was not "
        "measured, with at least −10 per cell"
    )


class LearningTime(_LearningMetric):
    """Wall time of sensing and belief update per step."""

    name = "learning_time"
    column = "learning_ms"
    unit = "ms"
    heading = "belief [ms]"
    better = "lower"
    meaning = (
        "wall time per step of sensing and belief update, where the time of a batch is "
        "divided by its number of episodes"
    )

    def of(self, record: LearningRecord) -> float:
        """Return the time in milliseconds."""
        return 1e3 * record.step_s
