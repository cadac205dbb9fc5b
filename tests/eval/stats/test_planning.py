import numpy as np
import pytest

from benchnav.eval.stats.planning import planning_times
from tests.eval.report import made


def test_each_trial_has_its_own_percentile_over_episodes() -> None:
    times = np.arange(101.0)
    slow = (made.row(made.trial("mppi"), i, planning_ms=10 * time) for i, time in enumerate(times))
    quick = (made.row(made.trial("cl_rrt"), i, planning_ms=time) for i, time in enumerate(times))
    found = planning_times(made.rows(slow, quick))
    assert list(found["planning_ms_p95"]) == pytest.approx([950, 95])
    assert found["trial"].is_unique
