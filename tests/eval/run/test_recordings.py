"""What is made again of a run: the map of driven paths and the ground of failures,
against what the run was on.
"""

import itertools
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchnav.core.errors import BenchnavError
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.failures import failures_table
from benchnav.eval.folder.run_folder import open_run, read_table, write_run
from benchnav.eval.folder.steps import read_steps
from benchnav.eval.recording import GROUND, RecordedMap, Recording
from benchnav.eval.report.write import write_report
from benchnav.eval.run.recordings import most_differing_map, record_driven, write_ground
from benchnav.eval.run.runner import run_suite
from benchnav.eval.run.unit import Settings, build
from tests.eval.forged import forge_rows
from tests.eval.report import made
from tests.eval.run.test_recorder import SEEDS, recordings, run
from tests.eval.run.test_recorder import dataset as dataset

PLANNERS = ("straight", "tests.eval.parts:Faulty")


def on_map(folder: Path, about: Mapping[str, Any]) -> list[Recording]:
    """The recordings of a run on one map under one draw of λ."""
    named = ("scenario", "seed", "realisation", "map")
    return [
        one
        for one in recordings(folder)
        if all(one.about[name] == str(about[name]) for name in named)
    ]


def test_the_map_that_is_kept_is_the_telling_one_with_λ_as_robots_met_it(
    dataset: Path, tmp_path: Path
) -> None:
    folder = run(dataset, tmp_path / "run", planners=PLANNERS, risks=("mean",))
    kept = RecordedMap.load(folder / GROUND)
    assert dict(kept.about) == most_differing_map(
        pd.read_parquet(folder / "episodes.parquet")
    )
    same = on_map(folder, kept.about)
    assert len(same) == 2
    for recording in same:
        for name in ("field", "immobilising", "rgb", "goal_m"):
            np.testing.assert_array_equal(getattr(kept, name), getattr(recording, name))


def test_whichever_map_is_telling_is_kept_under_its_own_noise(
    dataset: Path, tmp_path: Path
) -> None:
    folder = run(
        dataset,
        tmp_path / "run",
        planners=PLANNERS,
        risks=("mean",),
        maps=2,
        realisations=2,
    )
    rows = pd.read_parquet(folder / "episodes.parquet")
    fields = set()
    for seed, realisation, map_index in itertools.product(SEEDS, range(2), range(2)):
        here = (
            (rows["seed"] == seed)
            & (rows["realisation"] == realisation)
            & (rows["map"] == map_index)
        )
        # All succeed but one of the two on this map.
        arrived = ~here | (rows["planner"] == "straight")
        forge_rows(folder, rows.assign(outcome=np.where(arrived, "success", "timeout")))
        write_ground(folder)
        kept = RecordedMap.load(folder / GROUND)
        asked = {"seed": seed, "realisation": realisation, "map": map_index}
        assert {name: kept.about[name] for name in asked} == asked
        same = on_map(folder, kept.about)
        assert len(same) == 2
        for recording in same:
            for name in ("field", "immobilising", "rgb", "goal_m"):
                np.testing.assert_array_equal(
                    getattr(kept, name), getattr(recording, name)
                )
        assert kept.field is not None
        fields.add(kept.field.tobytes())
    assert len(fields) == 8


def test_no_map_is_kept_where_no_steps_are(dataset: Path, tmp_path: Path) -> None:
    folder = run(
        dataset,
        tmp_path / "run",
        planners=("straight",),
        risks=("mean",),
        record="none",
    )
    assert (folder / "episodes.parquet").exists()
    assert not (folder / GROUND).exists()


RISKS = ("mean", "cvar:0.5", "cvar:0.9")


def episodes(ended: dict[int, list[bool]]) -> pd.DataFrame:
    """Rows of three risk settings: of each map, which of them succeeded."""
    return made.rows(
        made.row(
            made.condition(risk=risk, world="stakes"),
            map_index,
            30.0 + place if success else None,
        )
        for map_index, successes in ended.items()
        for place, (risk, success) in enumerate(zip(RISKS, successes, strict=False))
    )


@pytest.mark.parametrize(
    ("ended", "map_index"),
    [
        ({0: [True] * 3, 1: [True, False, True], 2: [False] * 3}, 1),
        ({0: [True] * 3, 1: [False] * 3}, 0),
        ({0: [True, False], 4: [False, False, True]}, 4),  # more conditions
    ],
)
def test_the_map_is_one_on_which_outcomes_differ(
    ended: dict[int, list[bool]], map_index: int
) -> None:
    about = most_differing_map(episodes(ended))
    assert about == {"data": "paper-v1", "scenario": "std", "world": "stakes", "seed": 0, "realisation": 0,
                     "map": map_index}  # fmt: skip
    assert type(about["seed"]) is int


def test_noise_and_worlds_tell_maps_apart() -> None:
    labels = [
        made.condition(risk=risk, world=world) for world in ("a", "b") for risk in RISKS
    ]
    rows = made.rows(
        made.row(one, seed=seed, realisation=draw, time_s=None if (seed, draw, one["risk"], one["world"]) ==
                 (7, 1, "mean", "b") else 9.0)
        for one in labels for seed in (0, 7) for draw in (0, 1)
    )  # fmt: skip
    about = most_differing_map(rows)
    assert (about["world"], about["seed"], about["realisation"]) == ("b", 7, 1)


FAILED_BELOW = 0.6


@pytest.fixture(scope="module")
def failed(dataset_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with failures: robots are held by much of the ground, at once."""
    folder = tmp_path_factory.mktemp("failed") / "run"
    world: dict[str, Any] = {
        "preset": "stakes",
        "immobile": {"below": FAILED_BELOW, "for_s": 0.1},
        "time_budget_ratio": 1.0,
    }
    suite = Suite(
        data=str(dataset_path), scenarios=("std",), model="oracle", planners=("tests.eval.parts:Faulty",),
        risks=("cvar",), world=world, maps=2, seeds=(0, 1), realisations=2,
        record="steps",
    )  # fmt: skip
    for _ in run_suite(suite, folder):
        pass
    return folder


def test_the_ground_is_that_of_each_episode_under_its_own_noise(failed: Path) -> None:
    # whether they failed does not matter here
    rows = read_table(failed, "episodes.parquet")
    assert len(rows) == 8
    mixed = rows.sort_values("map")
    taken = record_driven(failed, mixed)
    (condition, _) = next(iter(open_run(failed).conditions.values()))
    for recording, row in zip(taken, mixed.to_dict("records"), strict=True):
        noise = {name: row[name] for name in ("seed", "realisation")}
        unit = Unit(condition=condition, maps=(row["map"],), **noise)
        built = build(unit, Settings().origins().of(unit))
        problem, simulation = built.problem, built.simulation
        np.testing.assert_array_equal(recording.predicted, problem.risk_map[0].numpy())
        assert simulation.field is not None
        np.testing.assert_array_equal(
            recording.immobilising, (simulation.field[0] < FAILED_BELOW).numpy()
        )
        np.testing.assert_array_equal(recording.goal_m, problem.goal_m[0].numpy())
        assert recording.about["outcome"] == row["outcome"]
        steps = read_steps(failed, map=row["map"], **noise)
        np.testing.assert_array_equal(recording.track, steps[["x_m", "y_m"]])
        np.testing.assert_array_equal(
            recording.traversability, steps["traversability"].iloc[:-1]
        )
    # Each is held elsewhere, so that no ground passes for another's.
    assert all(recording.immobilising.any() for recording in taken)
    assert len({recording.immobilising.tobytes() for recording in taken}) == 8


def test_the_report_shows_failures_and_says_what_the_planner_was_told(
    failed: Path,
) -> None:
    report = write_report(failed, partial(record_driven, failed))
    assert (failed / "figures" / "failures.png").stat().st_size > 5000
    assert "![failures](figures/failures.png)" in (failed / "summary.md").read_text()
    assert any(
        "these episodes ended, λ̂ was " in said
        for said in next(iter(report.findings.values()))
    )
    assert report.warnings == () or "No sheet" not in report.warnings[-1]


@pytest.mark.parametrize("part", ["datasets", "codes"])
def test_other_maps_and_models_than_those_of_the_run_are_not_shown(
    part: str, failed: Path
) -> None:
    about = json.loads((failed / "run.json").read_text())
    before = json.dumps(about)
    if part == "datasets":
        (data,) = about[part].values()
        data["maps"]["test/std"] = ["0" * 16 for _ in data["maps"]["test/std"]]
    else:
        (code,) = about[part].values()
        code["parts"]["planner tests.eval.parts:Faulty"] = "another"
    write_run(failed, about)
    try:
        rows = failures_table(failed, read_table(failed, "episodes.parquet"))
        with pytest.raises(BenchnavError, match="Expected"):
            record_driven(failed, rows)
        report = write_report(failed, partial(record_driven, failed))
        assert report.warnings[-1].startswith(
            "note: a figure of failures is missing: Expected"
        )
    finally:
        (failed / "run.json").write_text(before)
