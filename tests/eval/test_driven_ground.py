from pathlib import Path

import numpy as np
import pandas as pd

from benchnav.eval.report.driven import GROUND, Ground, telling_map
from benchnav.eval.report.recording import Recording
from tests.eval.test_recorder import dataset as dataset
from tests.eval.test_recorder import run


def test_the_map_that_is_kept_is_the_telling_one_with_λ_as_robots_met_it(
    dataset: Path, tmp_path: Path
) -> None:
    planners = ("straight", "tests.eval.parts:Faulty")
    folder = run(dataset, tmp_path / "run", planners=planners, risks=("mean",))
    kept = Ground.load(folder / GROUND)
    assert dict(kept.about) == telling_map(pd.read_parquet(folder / "episodes.parquet"))
    paths = [Recording.load(path) for path in (folder / "playback").glob("*.npz")]
    named = ("scenario", "seed", "realisation", "instance")
    same = [one for one in paths if all(one.about[name] == str(kept.about[name]) for name in named)]
    assert len(same) == 2
    for recording in same:
        for name in ("field", "holding", "rgb", "goal_m"):
            np.testing.assert_array_equal(getattr(kept, name), getattr(recording, name))
