"""The map that is kept for the figure of driven paths, against the recordings of the run."""

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchnav.eval.report.charts.driven import GROUND, DrivenGround, telling_map
from benchnav.eval.report.recorded.recording import Recording
from benchnav.eval.run.driven_ground import keep_ground
from tests.eval.forged import forge_rows
from tests.eval.run.test_recorder import SEEDS, recordings, run
from tests.eval.run.test_recorder import dataset as dataset

PLANNERS = ("straight", "tests.eval.parts:Faulty")


def on_map(folder: Path, about: Mapping[str, Any]) -> list[Recording]:
    """The recordings of a run on one map under one draw of λ."""
    named = ("scenario", "seed", "realisation", "map")
    return [one for one in recordings(folder) if all(one.about[name] == str(about[name]) for name in named)]


def test_the_map_that_is_kept_is_the_telling_one_with_λ_as_robots_met_it(
    dataset: Path, tmp_path: Path
) -> None:
    folder = run(dataset, tmp_path / "run", planners=PLANNERS, risks=("mean",))
    kept = DrivenGround.load(folder / GROUND)
    assert dict(kept.about) == telling_map(pd.read_parquet(folder / "episodes.parquet"))
    same = on_map(folder, kept.about)
    assert len(same) == 2
    for recording in same:
        for name in ("field", "immobilising", "rgb", "goal_m"):
            np.testing.assert_array_equal(getattr(kept, name), getattr(recording, name))


def test_whichever_map_is_telling_is_kept_under_its_own_noise(dataset: Path, tmp_path: Path) -> None:
    folder = run(dataset, tmp_path / "run", planners=PLANNERS, risks=("mean",), maps=2, realisations=2)
    rows = pd.read_parquet(folder / "episodes.parquet")
    fields = set()
    for seed, realisation, map_index in itertools.product(SEEDS, range(2), range(2)):
        here = (rows["seed"] == seed) & (rows["realisation"] == realisation) & (rows["map"] == map_index)
        # All succeed but one of the two on this map.
        arrived = ~here | (rows["planner"] == "straight")
        forge_rows(folder, rows.assign(outcome=np.where(arrived, "success", "timeout")))
        keep_ground(folder)
        kept = DrivenGround.load(folder / GROUND)
        asked = {"seed": seed, "realisation": realisation, "map": map_index}
        assert {name: kept.about[name] for name in asked} == asked
        same = on_map(folder, kept.about)
        assert len(same) == 2
        for recording in same:
            for name in ("field", "immobilising", "rgb", "goal_m"):
                np.testing.assert_array_equal(getattr(kept, name), getattr(recording, name))
        assert kept.field is not None
        fields.add(kept.field.tobytes())
    assert len(fields) == 8


def test_no_map_is_kept_where_no_steps_are(dataset: Path, tmp_path: Path) -> None:
    folder = run(dataset, tmp_path / "run", planners=("straight",), risks=("mean",), record="none")
    assert (folder / "episodes.parquet").exists()
    assert not (folder / GROUND).exists()
