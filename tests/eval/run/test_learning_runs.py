"""Runs of robots that learn on their way: what suites ask for reaches them; rows are
the same whoever makes them.
"""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from torch import Tensor

from benchnav.core.errors import ConfigError
from benchnav.datagen.files.find import find_dataset
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.load import load_recipe
from benchnav.eval.experiment.condition import KNOWLEDGE
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.find_episodes import find_episodes
from benchnav.eval.folder.provenance import describe_parts
from benchnav.eval.folder.run_folder import (
    EPISODES,
    ERRORS,
    differences,
    open_run,
    read_table,
)
from benchnav.eval.folder.steps import read_steps
from benchnav.eval.run.recordings import find_recording
from benchnav.eval.run.rerun import compare, rerun
from benchnav.eval.run.runner import run_suite
from benchnav.eval.run.unit import Settings, build
from benchnav.planning.free_space import Immobile
from benchnav.planning.robots import Unicycle
from benchnav.planning.sensing.knowledge import sensor_keys
from benchnav.planning.sensing.sensor import NoiseKey, Probe
from benchnav.planning.world.lower_bound import Motion, lower_bound_s
from tests import factories
from tests.commands import call

DRIVES = {
    "part": "tests.eval.parts:Faulty",
    "label": "ahead",
    "options": {"after_s": 1e9},
}
SEARCHES = {
    "part": "astar_dwa",
    "options": {"dwa": {"turn_rates": 7, "horizon_s": 1.5}},
}
NEAR = {"part": "near", "options": {"range_m": 3.0}}
KEYS = ["planner", *KNOWLEDGE, "seed", "realisation", "map"]
OWN = """
from dataclasses import dataclass, replace

import torch

from benchnav.core.batch import Batch
from benchnav.core.chosen import choose
from benchnav.core.mixture import TraversabilityMixture
from benchnav.planning import Belief, Near, Probe, Sensor


@dataclass(frozen=True)
class Feeler(Sensor):
    reach_m: float = 1.0
    fault: str = ""

    def sense(self, terrain, field, robot_state, moment):
        if self.fault and moment.step == 7:
            raise ValueError(self.fault)
        return Probe(self.reach_m, 0.2).sense(terrain, field, robot_state, moment)


class Eye(Near):
    pass


@dataclass(frozen=True, kw_only=True)
class Known(Batch):
    prior: object
    value: torch.Tensor


@dataclass(frozen=True)
class Remembers(Belief[Known]):
    fault: str = ""

    def init(self, prior, covariance):
        return Known(prior=prior, value=torch.full(prior.shape, torch.nan))

    def update(self, state, sensed, prior=None):
        if self.fault and bool((~state.value.isnan()).any()):
            raise ValueError(self.fault)
        value = torch.where(sensed.mask, sensed.traversability, state.value)
        return Known(prior=state.prior if prior is None else prior, value=value)

    def distribution(self, state):
        known = ~state.value.isnan()
        means = state.value.nan_to_num(0.5)[:, None]
        exact = TraversabilityMixture(torch.ones_like(means), means, 0.01 + 0 * means)
        return choose(known, exact, state.prior)

    def sample_fields(self, state, count, keys):
        return self.distribution(state).mean()[:, None].expand(-1, count, -1, -1)
"""


def suite_on(dataset: Path, **changes: Any) -> Suite:
    given: dict[str, Any] = {
        "data": str(dataset), "model": "oracle", "planners": (DRIVES, SEARCHES), "risks": ("mean",),
        "scenarios": ("std",), "maps": 2, "record": "steps", "sensors": ("full", NEAR), "grounds": ("probe",),
        "beliefs": ("static", "copula"), "world": {"preset": "stakes", "immobile": None, "time_budget_s": 4.0},
    }  # fmt: skip
    return Suite(**(given | changes))


def finish(suite: Suite, folder: Path, jobs: int = 1, **options: Any) -> pd.DataFrame:
    for _ in run_suite(suite, folder, jobs, **options):
        pass
    return pd.read_parquet(folder / "episodes.parquet")


def same(first: pd.DataFrame, second: pd.DataFrame) -> bool:
    cells, lacking = differences(first, second)
    return cells.empty and lacking.empty


@pytest.fixture(scope="module")
def finished(
    dataset_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Suite, Path]:
    """A run of two planners that see all or what is near, and learn of the ground or do
    not.
    """
    suite, folder = suite_on(dataset_path), tmp_path_factory.mktemp("learning") / "run"
    finish(suite, folder)
    return suite, folder


@pytest.fixture
def own(tmp_path: Path) -> Path:
    path = tmp_path / "own.py"
    path.write_text(OWN)
    return path


def unit_of(folder: Path, **labels: str) -> tuple[Unit, pd.DataFrame]:
    """The unit of a condition, and its rows."""
    rows = pd.read_parquet(folder / "episodes.parquet")
    for name, label in labels.items():
        rows = rows[rows[name] == label]
    (condition_id,) = rows["condition"].unique()
    condition, _ = open_run(folder).conditions[condition_id]
    unit = Unit(condition=condition, seed=0, realisation=0, maps=(0, 1))
    return unit, rows.reset_index(drop=True)


def driven(folder: Path, unit: Unit, member: int) -> Tensor:
    """States of an episode, shape [N + 1, 3]."""
    steps = read_steps(folder, condition=unit.condition.id, map=member)
    return torch.from_numpy(steps[["x_m", "y_m", "heading_rad"]].to_numpy().copy())


def test_rows_tell_who_learnt_what(finished: tuple[Suite, Path]) -> None:
    _, folder = finished
    rows = pd.read_parquet(folder / "episodes.parquet")
    found = set(zip(rows["sensor"], rows["ground"], rows["belief"], strict=True))
    assert found == {
        (s, *rest)
        for s in ("full", "near")
        for rest in (("–", "static"), ("probe", "copula"))
    }
    assert len(rows) == 16
    learnt = [
        "revisions",
        "seen_cells",
        "sensed_cells",
        "ahead_rmse",
        "ahead_log_score",
        "learning_ms",
    ]
    still = (rows["sensor"] == "full") & (rows["belief"] == "static")
    assert rows.loc[still, learnt].isna().all(axis=None)
    moving = rows[~still]
    assert moving[learnt].notna().all(axis=None)
    cells = load_recipe("tiny-v1").grid.height ** 2
    assert (moving.loc[moving["sensor"] == "full", "seen_cells"] == cells).all()
    assert (moving.loc[moving["sensor"] == "near", "seen_cells"] < cells).all()
    assert ((moving["sensed_cells"] > 0) == (moving["belief"] == "copula")).all()
    updates = np.ceil(moving["end_time_s"].round(3) / 0.5)
    assert (moving["revisions"] <= updates).all()
    assert (moving["revisions"] > 2).all()
    assert (moving["learning_ms"] > 0).all()


def test_what_was_sensed_is_what_sensors_told_on_the_driven_path(
    finished: tuple[Suite, Path],
) -> None:
    _, folder = finished
    for planner in ("ahead", "astar_dwa"):
        unit, rows = unit_of(folder, planner=planner, sensor="full", belief="copula")
        built = build(unit, Settings().origins().of(unit))
        assert built.learning is not None
        truth = built.learning.truth
        assert torch.equal(truth.field, built.simulation.field)
        for member in range(2):
            track = driven(folder, unit, member)
            steps = len(track) - 1
            own = truth.select(torch.tensor([member]))
            sensed = torch.zeros_like(own.field, dtype=torch.bool)
            for step in range((steps - 1) // 5 * 5 + 1):
                sensed |= (
                    Probe()
                    .sense(
                        own.terrain,
                        own.field,
                        track[step][None],
                        NoiseKey(own.keys, step),
                    )
                    .mask
                )
            assert rows["sensed_cells"][member] == int(sensed.sum())
            kept = read_steps(folder, condition=unit.condition.id, map=member)
            due = np.arange(steps + 1) % 5 == 0
            due[-1] = False
            assert (kept["ahead_rmse"].notna().to_numpy() == due).all()
            assert rows["ahead_rmse"][member] == pytest.approx(
                kept["ahead_rmse"].mean(), rel=1e-6
            )
            assert rows["ahead_log_score"][member] == pytest.approx(
                kept["ahead_log_score"].mean(), rel=1e-6
            )


def test_rows_do_not_depend_on_workers(
    finished: tuple[Suite, Path], tmp_path: Path
) -> None:
    suite, folder = finished
    finish(suite, tmp_path / "two", jobs=2)
    assert same(*(read_table(place, EPISODES) for place in (folder, tmp_path / "two")))
    pd.testing.assert_frame_equal(
        *(read_steps(place) for place in (folder, tmp_path / "two"))
    )


def test_a_run_that_is_not_whole_goes_on_to_the_same_rows(
    finished: tuple[Suite, Path], tmp_path: Path
) -> None:
    suite, whole = finished
    folder = shutil.copytree(whole, tmp_path / "run")
    (folder / EPISODES).unlink()
    for planner in ("ahead", "astar_dwa"):
        unit, _ = unit_of(whole, planner=planner, sensor="near", belief="copula")
        for path in folder.glob(f"units/{unit.condition.id}/*"):
            path.unlink()
    said: list[str] = []
    finish(suite, folder, say=said.append)
    assert "6 of 8 units were already finished" in said
    assert same(*(read_table(place, EPISODES) for place in (whole, folder)))


def test_a_learning_run_is_repeated(
    finished: tuple[Suite, Path], tmp_path: Path
) -> None:
    _, folder = finished
    list(rerun(folder, tmp_path / "again"))
    alike, lines = compare(folder, tmp_path / "again")
    assert alike, lines


def test_an_episode_that_was_not_recorded_is_repeated_with_what_was_known(
    finished: tuple[Suite, Path], tmp_path: Path
) -> None:
    _, folder = finished
    asked = {
        "planner": ["astar_dwa"],
        "sensor": ["near"],
        "belief": ["copula"],
        "ground": ["probe"],
    }
    ((unit, member),) = find_episodes(folder, asked, 0, 0, 1)
    _, rows = unit_of(folder, planner="astar_dwa", sensor="near", belief="copula")
    found = find_recording(folder, unit, member, tmp_path)
    np.testing.assert_array_equal(found.track, driven(folder, unit, 1)[:, :2].numpy())
    assert [known.step for known in found.known][:3] == [0, 5, 10]
    last = found.known[-1]
    assert int(last.seen.sum()) == rows["seen_cells"][1]
    assert int(last.sensed.sum()) == rows["sensed_cells"][1]
    assert found.about["ground"] == "probe"


def test_everyone_meets_the_same_noise(finished: tuple[Suite, Path]) -> None:
    _, folder = finished
    keys = {}
    for planner in ("ahead", "astar_dwa"):
        unit, _ = unit_of(folder, planner=planner, sensor="near", belief="copula")
        origins = Settings().origins()
        for name, changed in (
            ("same", unit),
            ("alone", replace(unit, maps=(1,))),
            ("seed", replace(unit, seed=1)),
            ("draw", replace(unit, realisation=1)),
        ):
            learning = build(changed, origins.of(changed)).learning
            assert learning is not None
            keys[planner, name] = learning.truth.keys
    assert all(
        keys["ahead", name] == keys["astar_dwa", name]
        for name in ("same", "alone", "seed", "draw")
    )
    whole = keys["ahead", "same"]
    assert keys["ahead", "alone"] == whole[1:]
    assert len({*whole, *keys["ahead", "seed"], *keys["ahead", "draw"]}) == 6
    assert sensor_keys(5, [7, 8])[1:] == sensor_keys(5, [8])


@pytest.mark.parametrize("every", [0.2, 1.0])
def test_what_a_suite_says_of_updates_is_obeyed(
    every: float, dataset_path: Path, tmp_path: Path
) -> None:
    suite = suite_on(
        dataset_path,
        planners=(DRIVES,),
        sensors=("full",),
        beliefs=("copula",),
        task={"replan_every_s": every},
    )
    finish(suite, tmp_path / "run")
    steps = read_steps(tmp_path / "run")
    known = steps[steps["ahead_rmse"].notna()]
    wanted = round(every / 0.1)
    assert set(known["step"] % wanted) == {0}
    ends = steps.groupby("map")["step"].max()
    assert known.groupby("map").size().tolist() == [-(-end // wanted) for end in ends]


@pytest.mark.parametrize("unseen", ["prior", "optimistic"])
def test_a_planner_is_given_what_was_seen_and_what_the_rules_say_of_the_rest(
    unseen: str, dataset_path: Path, tmp_path: Path
) -> None:
    (tmp_path / "log").mkdir()
    noting = {
        "part": "tests.eval.parts:Noting",
        "options": {"log": str(tmp_path / "log")},
    }
    suite = suite_on(
        dataset_path, planners=(noting,), sensors=({"part": "near", "options": {"range_m": 3.0, "colour_noise": 0.0}},),
        beliefs=("static",), task={"unseen": unseen}, world={"noise": "stored", "time_budget_s": 1.0},
    )  # fmt: skip
    finish(suite, tmp_path / "run")
    first = torch.load(sorted((tmp_path / "log").iterdir())[0])
    seen = first["seen"].bool()
    truth = TerrainDataset(find_dataset(str(dataset_path))).terrain("test/std", (0, 1))
    assert torch.equal(
        first["rgb"].movedim(1, -1)[seen], truth.rgb.movedim(1, -1)[seen]
    )
    dark = first["rgb"].movedim(1, -1)[~seen]
    assert len(dark.unique(dim=0)) == 1
    believed = first["risk_map"][~seen].unique()
    assert len(believed) == 1
    assert (float(believed) == 1) == (unseen == "optimistic")
    torch.testing.assert_close(
        first["risk_map"][seen], truth.truth.mean()[seen], atol=1e-5, rtol=0
    )


def rows_of_own(
    own: Path, dataset: Path, folder: Path, *words: str, status: int = 0
) -> pd.DataFrame:
    asked = (
        "--planners", "['tests.eval.parts:Faulty',straight]", "--risks", "[mean]", "--scenarios", "[std]",
        "--maps", "2",
        "--model", "oracle", "--world", "{preset: stakes, immobile: null, time_budget_s: 3}", "--record", "none",
    )  # fmt: skip
    assert (
        call("eval", "run", "--data", dataset, "--out", folder, *asked, *words)
        == status
    )
    return read_table(folder, EPISODES)


def parts_of(own: Path, **faults: str) -> tuple[str, ...]:
    given = {"grounds": "Feeler", "beliefs": "Remembers"}
    words: list[str] = []
    for kind, name in given.items():
        fault = f", options: {{fault: {faults[kind]}}}" if kind in faults else ""
        words += [f"--{kind}", f"[{{part: '{own}:{name}'{fault}}}]"]
    return tuple(words)


def test_an_own_sensor_and_an_own_belief_from_a_file_run_in_two_processes(
    own: Path, dataset_path: Path, tmp_path: Path
) -> None:
    words = (*parts_of(own), "--sensors", f"[full, '{own}:Eye']")
    one = rows_of_own(own, dataset_path, tmp_path / "one", *words)
    two = rows_of_own(own, dataset_path, tmp_path / "two", *words, "--jobs", "2")
    assert same(one, two)
    drove = one[one["planner"] == "Faulty"]
    assert set(drove["sensor"]) == {"full", "Eye"}
    assert set(drove["ground"]) == {"Feeler"}
    assert set(drove["belief"]) == {"Remembers"}
    assert (drove["sensed_cells"] > 10).all()
    assert (drove["revisions"] > 1).all()
    parts = open_run(tmp_path / "one").manifest["codes"].values()
    names = {name.rpartition(":")[2] for code in parts for name in code["parts"]}
    assert {"Feeler", "Remembers", "Eye", "statistics of the ground"} <= names


@pytest.mark.parametrize(
    ("kind", "outcome"), [("grounds", "sensor_error"), ("beliefs", "belief_error")]
)
def test_an_own_part_that_fails_ends_its_episodes_with_its_name(
    kind: str, outcome: str, own: Path, dataset_path: Path, tmp_path: Path
) -> None:
    rows = rows_of_own(
        own, dataset_path, tmp_path / "run", *parts_of(own, **{kind: "lost"}), status=1
    )
    drove, blind = (rows[rows["planner"] == name] for name in ("Faulty", "straight"))
    assert drove["outcome"].tolist() == [outcome] * 2
    assert drove["error"].tolist() == ["ValueError: lost"] * 2
    assert drove["total_time_s"].tolist() == [3.0, 3.0]
    assert (blind["error"] == "").all()
    text = (tmp_path / "run" / ERRORS).read_text()
    assert "raise ValueError(self.fault)" in text
    # What was known by then is told.
    assert drove["end_time_s"].tolist() == pytest.approx(
        [0.7, 0.7] if kind == "grounds" else [0.5, 0.5]
    )


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            ("--risks", "[single-class]", "--beliefs", "[copula]"),
            "Expected a belief that does not learn",
        ),
        (
            ("--grounds", "['probe:-1']", "--beliefs", "[copula]"),
            "`radius_m` of sensor 'probe' > 0",
        ),
        (("--grounds", "['probe:-1']"), "`radius_m`"),  # which `static` does not ask
        (
            (
                "--grounds",
                "[{part: probe, options: {noise_std: 0}}]",
                "--beliefs",
                "[copula]",
            ),
            "`noise_std`",
        ),
        (("--sensors", "[{part: near, options: {fov_deg: 0}}]"), "`fov_deg`"),
        (("--beliefs", "[{part: copula, options: {window: 0}}]"), "`window`"),
    ],
)
def test_what_robots_cannot_learn_by_is_refused_before_the_run_in_a_line(
    words: tuple[str, ...], told: str, dataset_path: Path, tmp_path: Path, capsys: Any
) -> None:
    asked = (
        "--planners",
        "['tests.eval.parts:Faulty']",
        "--scenarios",
        "[std]",
        "--maps",
        "1",
        "--model",
        "oracle",
    )
    chosen = asked if "--risks" in words else (*asked, "--risks", "[mean]")
    assert (
        call(
            "eval",
            "run",
            "--data",
            dataset_path,
            "--out",
            tmp_path / "run",
            *chosen,
            *words,
        )
        == 2
    )
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert told in line
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("jobs", [1, 2])
def test_near_without_statistics_of_the_ground_is_refused_before_the_run(
    jobs: int, tmp_path: Path
) -> None:
    recipe = load_recipe("tiny-v1")
    first, *rest = recipe.classes
    other = replace(
        factories.tiny_recipe(), classes=(replace(first, noise=0.123), *rest)
    )
    dataset = factories.tiny_dataset(tmp_path / "other.h5", other)
    suite = suite_on(dataset, planners=(DRIVES,), record="none", maps=1)
    with pytest.raises(
        ConfigError,
        match=r"Expected statistics of the ground in .*other\.ground\.json, got none",
    ):
        finish(suite, tmp_path / "run", jobs)
    assert not (tmp_path / "run").exists()
    # A blind planner, and one that sees all, need none.
    rows = finish(
        replace(suite, planners=(DRIVES, "straight"), sensors=("full",)),
        tmp_path / "run",
        jobs,
    )
    assert (rows["error"] == "").all()


def test_other_statistics_of_the_ground_are_another_origin(
    dataset_path: Path, tmp_path: Path
) -> None:
    dataset = tmp_path / "tiny.h5"
    dataset.write_bytes(dataset_path.read_bytes())
    suite = suite_on(dataset, planners=(DRIVES,), record="none", maps=1)
    finish(suite, tmp_path / "run")
    conditions = [
        condition for condition, _ in open_run(tmp_path / "run").conditions.values()
    ]
    before = {
        condition.id: describe_parts(condition)["parts"] for condition in conditions
    }
    recipes = Path(load_recipe.__code__.co_filename).parent
    text = (recipes / "ground" / "tiny-v1.json").read_text()
    (tmp_path / "tiny.ground.json").write_text(
        text.replace('"potts_strength": ', '"potts_strength": 1')
    )
    said: list[str] = []
    for condition in conditions:
        changed = describe_parts(condition)["parts"] != before[condition.id]
        assert changed == (condition.sensor.part == "near")
    finish(suite, tmp_path / "run", say=said.append)
    assert any(
        "(statistics of the ground) and are run again" in line for line in said
    ), said


def test_the_time_of_a_planner_alone_is_measured_by_what_it_knows(
    finished: tuple[Suite, Path],
) -> None:
    _, folder = finished
    entries = [
        e
        for e in open_run(folder).manifest["conditions"].values()
        if e["labels"]["planner"] == "astar_dwa"
    ]
    assert len(entries) == 4
    assert len({entry["latency"]["median_ms"] for entry in entries}) == 4


def test_rows_of_a_planner_that_is_given_the_ground_have_a_lower_bound_and_others_none(
    dataset_path: Path, tmp_path: Path
) -> None:
    world = {
        "noise": "stored",
        "time_budget_s": 60.0,
        "immobile": {"below": 0.75, "for_s": 0.3},
    }
    suite = Suite(
        data=str(dataset_path), models=("clairvoyant",), planners=("near_optimal", SEARCHES), risks=("mean",),
        scenarios=("std",), maps=1, record="none", world=(world,), task=({"min_traversability": 0.05},),
        objectives=("travel_time",),
    )  # fmt: skip
    list(run_suite(suite, tmp_path / "run"))
    rows = read_table(tmp_path / "run", EPISODES)
    known = rows[rows["planner"] == "near_optimal"]
    assert rows.loc[rows["planner"] != "near_optimal", "lower_bound_s"].isna().all()
    arrived = known[known["success"]]
    assert len(arrived) > 0
    assert (arrived["lower_bound_s"] <= arrived["total_time_s"]).all()
    assert (arrived["lower_bound_s"] > 0.7 * arrived["total_time_s"]).all()
    dataset = TerrainDataset(dataset_path)
    places = dataset.read("test/std", fields=["start_m", "goal_m", "traversability"])
    motion = Motion(
        robot=Unicycle(), goal_radius_m=1.0, immobile=Immobile(below=0.75, for_s=0.3)
    )
    for row in known.to_dict("records"):
        field, start_m, goal_m = (
            places[name][row["map"]] for name in ("traversability", "start_m", "goal_m")
        )
        expected = lower_bound_s(field, dataset.recipe.grid, motion, start_m, goal_m)
        assert row["lower_bound_s"] == pytest.approx(expected, rel=1e-3)
