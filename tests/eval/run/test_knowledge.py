"""Robots that learn on their way: what they are told, when, and what that changes."""

import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError
from benchnav.core.ground import GroundStatistics
from benchnav.core.terrain import Terrain
from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.run.isolation import IsolatedPlanner
from benchnav.eval.run.knowledge import KnowledgeTracker, Learning
from benchnav.eval.run.rollout import Episodes, run_episodes
from benchnav.models.predictor import Oracle
from benchnav.planning import risk
from benchnav.planning.free_space import FreeSpace, Immobile, Rules, cells_at_goal
from benchnav.planning.objective import TravelTime
from benchnav.planning.planners.astar.astar_dwa import AStarDWA, AStarDWAConfig
from benchnav.planning.planners.astar.dwa import DWAConfig
from benchnav.planning.problem import Prediction, Problem, Task, pose_problem
from benchnav.planning.robots import Unicycle
from benchnav.planning.sensing.belief import Belief, Predicted, Static
from benchnav.planning.sensing.classes import Classes
from benchnav.planning.sensing.copula import Copula
from benchnav.planning.sensing.knowledge import KnowledgeError, Truth
from benchnav.planning.sensing.learner import Learner
from benchnav.planning.sensing.near import Near
from benchnav.planning.sensing.score_table import TabulatedDistribution
from benchnav.planning.sensing.sensor import (
    Contact,
    Full,
    Measurement,
    NoiseKey,
    Probe,
    Sensor,
)
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.realisation import are_connected
from benchnav.planning.world.simulation import Simulation
from benchnav.planning.world.world import Endpoints, World
from tests.planning.planners.driving import generator
from tests.planning.planners.test_planners import NAMES, make
from tests.planning.sensing import made

BATCH, SIZE = 8, 24
IMMOBILE = Immobile()
WORLD = World(noise="stored", immobile=IMMOBILE, time_budget_s=24.0)
RULES = Rules(free_space=FreeSpace(by="mean", above=0.1), min_traversability=0.05)
COVARIANCE = made.covariance(SIZE, SIZE, 1.5)
KEYS = tuple(range(BATCH))
# which uses no map, and which plans once
SHIPPED = sorted(set(NAMES) - {"straight", "optimal"})
# few arcs, which is quick
CONFIG = AStarDWAConfig(dwa=DWAConfig(speeds=5, turn_rates=11, horizon_s=4.0))


def astar_dwa() -> AStarDWA:
    return AStarDWA(CONFIG)


def measure(distribution: TraversabilityDistribution) -> Tensor:
    return risk.ExpectedTime(0.05)(distribution)


@dataclass
class Drives:
    """A batch of episodes on ground whose soft spots no map shows."""

    problem: Problem
    simulation: Simulation
    learning: Learning

    def run(self, planner: Any, learning: Learning | None, **options: Any) -> Episodes:
        return run_episodes(
            planner,
            self.problem,
            self.simulation,
            generator(),
            learning=learning,
            **options,
        )


def learning(problem: Problem, truth: Truth, **changes: Any) -> Learning:
    """How robots learn on ground of the law, and what they know when they set out."""
    given: dict[str, Any] = {
        "sensor": Full(), "ground": Probe(1.5), "belief": Copula(), "covariance": COVARIANCE, "measure": measure,
        "rules": problem.task.rules, "predict": fails(),
    }  # fmt: skip
    learner = Learner(**given | changes)
    return Learning(
        learner=learner,
        start=learner.begin(truth, problem.start, problem.distribution),
        truth=truth,
    )


def drives(seed: int = 0, replan_every_s: float = 0.5, **changes: Any) -> Drives:
    # The first draws with a feasible path.
    truth = made.mixture(40, SIZE, SIZE, seed=3)
    truth = type(truth)(
        truth.weights.float(), truth.means.float(), truth.stds.float(), (0, 1)
    )
    start, goal = (
        torch.tensor([place] * 40) for place in ((1.25, 1.25), (10.25, 9.75))
    )
    places = Endpoints(
        start_m=start, goal_m=goal, reference_time_s=torch.full((40,), torch.nan)
    )
    field = truth.from_normal(made.scores(COVARIANCE, 40, seed).float())
    kept = are_connected(field >= IMMOBILE.below, COVARIANCE.grid, places).nonzero()[
        :BATCH, 0
    ]
    truth, field, places = truth.select(kept), field[kept], places.select(kept)
    start, goal, terrain = places.start_m, places.goal_m, made.terrain(truth, field)
    rules = replace(RULES, replan_every_s=replan_every_s)
    task = Task(
        robot=Unicycle(),
        objective=TravelTime(robot=Unicycle(), goal_radius_m=1.0),
        rules=rules,
    )
    simulation = Simulation(
        terrain, task, WORLD, places, rng.stream_key(0, "noise"), range(BATCH)
    )
    problem = pose_problem(
        task, Prediction(terrain.observe(), truth, measure(truth)), start, goal, 24.0
    )
    known = Truth(terrain=terrain, field=field, keys=KEYS)
    how = learning(problem, known, **changes)
    believed = how.learner.distribution(how.start)
    return Drives(replace(problem, distribution=believed), simulation, how)


@pytest.fixture(scope="module")
def probed() -> Episodes:
    """Episodes of robots that probe, to the end of the last."""
    given = drives()
    return given.run(astar_dwa(), given.learning)


def same(one: Episodes, other: Episodes) -> bool:
    names = ("states", "actions", "traversability", "outcome", "steps")
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in names)


@dataclass(frozen=True)
class Deaf(Static):
    """Told all, and believing what it did: a belief that updates to no purpose."""

    learns = True

    def changed(self, before: Predicted, after: Predicted) -> Tensor:
        return torch.zeros(after.prior.shape, dtype=torch.bool)


@dataclass(frozen=True)
class Same(Static):
    """Says that all has changed, and believes what it did."""

    learns = True


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("belief", [Deaf(), Same()])
def test_a_belief_that_learns_nothing_drives_as_if_there_were_none(
    name: str, belief: Belief[Any]
) -> None:
    given = drives(belief=belief)
    options: dict[str, Any] = {"stop": lambda step: step == 12}
    found = given.run(make(name), given.learning, **options)
    assert same(given.run(make(name), None, **options), found)
    assert (found.revisions == 0).all()


def test_who_probes_the_ground_is_immobilised_less_often(probed: Episodes) -> None:
    given, contact = drives(), drives(ground=Contact())
    static = given.run(astar_dwa(), None)
    # With contact the test is only that robots learn.
    touched = contact.run(astar_dwa(), contact.learning, stop=lambda step: step == 40)
    for found, learns in ((static, False), (touched, True), (probed, True)):
        assert bool((found.revisions > 0).any()) == learns
        assert (found.learning_s > 0.01) == learns
    assert int((static.outcome == Outcome.IMMOBILISED).sum()) >= 2
    assert int((probed.outcome == Outcome.IMMOBILISED).sum()) == 0
    both = (static.outcome == Outcome.SUCCESS) & (probed.outcome == Outcome.SUCCESS)
    assert int(both.sum()) >= 5
    assert (
        float(probed.steps[both].double().mean())
        < float(static.steps[both].double().mean()) - 3
    )


class Noting(Sensor):
    """Senses as another does, and notes of which cells it told; the other may see all."""

    def __init__(self, inner: Sensor, noted: Tensor) -> None:
        self.inner, self.noted, self.sees_all = inner, noted, inner.sees_all  # type: ignore[misc]

    def sense(
        self, terrain: Any, field: Tensor, robot_state: Tensor, noise_key: NoiseKey
    ) -> Measurement:
        sensed = self.inner.sense(terrain, field, robot_state, noise_key)
        members = torch.tensor([KEYS.index(key) for key in noise_key.keys])
        self.noted[members] |= (
            sensed.mask if sensed.appearance is None else sensed.appearance.seen
        )
        return sensed


ALIKE = replace(
    COVARIANCE,
    statistics=GroundStatistics(
        weights=(0.3, 0.7), means=(0.1, 0.75), stds=(0.1, 0.1), look_alikes=(("soft", "firm"),), potts_strength=0.5,
        layer_means={"rgb": (10.0, 20.0, 30.0), "elevation_m": (0.5,), "slope_deg": (7.0,)},
    ),
    class_names=("soft", "firm"),
)  # fmt: skip
BELIEFS = {"static": Static(), "copula": Copula(), "classes": Classes()}
SENSES = [
    (sensor, ground, belief)
    for sensor in (Full(), Near(range_m=3.0, fov_deg=200))
    for ground in (Contact(), Probe(1.0))
    for belief in BELIEFS
    if (sensor.sees_all, belief) != (True, "static")  # which is told nothing
]


# Every planner meets every sensor, ground sensor and belief, and every combination some
# planner.
@pytest.mark.parametrize(
    ("name", "sensor", "ground", "belief"),
    [
        (name, *sense)
        for place, name in enumerate(SHIPPED)
        for number, sense in enumerate(SENSES)
        if (place + number) % 3 == 0
    ],
)
def test_what_was_not_sensed_changes_no_action(
    name: str, sensor: Sensor, ground: Sensor, belief: str
) -> None:
    few, steps = torch.arange(3), 11
    given = drives()
    before, posed = given.learning.truth.terrain.select(few), given.problem.select(few)
    posed = replace(posed, distribution=before.truth)
    # what it looks like, and its λ
    sensed = torch.zeros(2, len(few), SIZE, SIZE, dtype=torch.bool)
    sensed[0] = sensor.sees_all

    def drive(terrain: Terrain, noted: Tensor) -> Episodes:
        truth = Truth(
            terrain=terrain, field=terrain.traversability, keys=KEYS[: len(few)]
        )
        how = learning(
            posed, truth, sensor=Noting(sensor, noted[0]), ground=Noting(ground, noted[1]), belief=BELIEFS[belief],
            covariance=ALIKE, predict=lambda terrain, seen: Oracle().predict_terrain(terrain),
        )  # fmt: skip
        known = how.start
        problem = replace(
            posed, risk_map=known.risk_map, observation=known.observation,
            free=known.free | cells_at_goal(posed.grid, posed.goal_m, posed.goal_radius_m),
            distribution=how.learner.distribution(known),
        )  # fmt: skip
        nan = torch.full((len(few),), torch.nan)
        places = Endpoints(
            start_m=problem.start[:, :2], goal_m=problem.goal_m, reference_time_s=nan
        )
        simulation = Simulation(
            terrain, problem.task, WORLD, places, 1, range(len(few))
        )
        return run_episodes(
            make(name),
            problem,
            simulation,
            generator(),
            learning=how,
            stop=lambda step: step == steps,
        )

    first = drive(before, sensed)
    # Robots met the λ of the cells that they drove on.
    row, column = before.grid.cell_of(first.states[..., 0], first.states[..., 1])
    met = (
        torch.zeros_like(sensed[1])
        .flatten(1)
        .scatter(1, row * SIZE + column, True)
        .view_as(sensed[1])
    )
    seen, known = sensed[0], sensed[1] | met
    assert bool((~known).any())
    other = made.mixture(len(few), SIZE, SIZE, seed=9)
    # A model that sees all has the true distribution of each cell, and the noise of
    # sensed λ is by it.
    kept = (seen | known)[:, None]
    after = replace(
        before,
        traversability=torch.where(
            known, before.traversability, 1 - before.traversability
        ),
        truth=replace(
            before.truth,
            weights=torch.where(kept, before.truth.weights, other.weights.float()),
            means=torch.where(kept, before.truth.means, other.means.float()),
        ),
        rgb=torch.where(seen[:, None], before.rgb, 200),
        # What is hidden may hide nothing else: lower ground.
        elevation_m=torch.where(seen, before.elevation_m, before.elevation_m - 1),
        slope_deg=torch.where(seen, before.slope_deg, 30.0),
    )
    assert same(first, drive(after, torch.zeros_like(sensed)))


def told(how: Learning, problem: Problem, steps: int) -> list[tuple[int, Problem]]:
    """When robots that drive along x are told of another map, and of which."""
    knowledge, state, found = KnowledgeTracker(how, problem), problem.start.clone(), []
    for step in range(steps):
        revised = knowledge.learn(step, state, torch.ones(BATCH, dtype=torch.bool))
        if revised is not None:
            found.append((step, revised))
        state = state + torch.tensor([0.1, 0.0, 0.0])
    return found


@pytest.mark.parametrize("every", [0.1, 1.0])
def test_maps_are_revised_when_it_is_due_and_where_something_is_known(
    every: float,
) -> None:
    given = drives(replan_every_s=every)
    found = told(given.learning, given.problem, 30)
    assert found
    assert all(step % round(every / 0.1) == 0 for step, _ in found)
    assert len(found) > 0.6 * 30 / round(every / 0.1)
    step, last = found[-1]
    # The planner's λ̂ is that of the belief, within the least change.
    belief, seen = Copula(), given.learning.truth
    state = belief.init(given.problem.distribution, COVARIANCE)
    sensed: Measurement | None = None
    at = given.problem.start.clone()
    for now in range(step + 1):
        new = Probe(1.5).sense(seen.terrain, seen.field, at, NoiseKey(KEYS, now))
        sensed = (
            new
            if sensed is None
            else Measurement(
                traversability=torch.where(
                    new.mask, new.traversability, sensed.traversability
                ),
                std=new.std,
            )
        )
        if now % round(every / 0.1) == 0:
            state, sensed = belief.update(state, sensed), None
        at = at + torch.tensor([0.1, 0.0, 0.0])
    few = torch.arange(2)
    believed = belief.distribution(state.select(few))
    mean = believed.mean()
    assert (last.risk_map[few] - measure(believed)).abs().max() < 0.035
    assert (last.risk_map - given.problem.risk_map).abs().max() > 0.3
    before = given.problem.free[few]
    closed = (mean < 0.09) & ~before
    assert not last.free[few][(mean < 0.09) & before].any() or bool(closed.any())
    revised = last.distribution.mean()[few]
    torch.testing.assert_close(revised, mean, atol=1e-5, rtol=0)
    assert torch.equal(last.start[:, 1:], given.problem.start[:, 1:])
    assert float(last.start[0, 0] - given.problem.start[0, 0]) == pytest.approx(
        0.1 * step, abs=1e-5
    )


def test_the_goal_stays_free_whatever_is_known_of_it() -> None:
    given = drives(ground=Probe(30.0))
    column, row = (given.problem.goal_m[0] / 0.5).long().tolist()
    truth = given.learning.truth
    field = truth.field.clone()
    field[:, row - 4 : row + 5, column - 4 : column + 5] = 0
    (_, first), *_ = told(
        replace(given.learning, truth=replace(truth, field=field)), given.problem, 3
    )
    assert first.free[:, row, column].all()
    assert not first.free[:, row - 3, column - 2].any()
    at_goal = cells_at_goal(COVARIANCE.grid, given.problem.goal_m, RULES.goal_radius_m)
    assert first.free[at_goal].all()
    assert (~first.free)[(field < 0.02) & ~at_goal].double().mean() > 0.9


def test_the_goal_that_stays_free_is_that_of_the_episode_that_is_left() -> None:
    given = drives(ground=Probe(30.0))
    goal = given.problem.goal_m.clone()
    goal[1] = torch.tensor([5.25, 8.25])
    truth = replace(
        given.learning.truth, field=torch.zeros_like(given.learning.truth.field)
    )
    knowing = KnowledgeTracker(
        replace(given.learning, truth=truth), replace(given.problem, goal_m=goal)
    )
    knowing.keep(torch.tensor([1]))
    told = knowing.learn(0, given.problem.start[1:2], torch.ones(1, dtype=torch.bool))
    assert told is not None
    assert torch.equal(
        told.free, cells_at_goal(COVARIANCE.grid, goal[1:2], RULES.goal_radius_m)
    )


def test_a_robot_that_has_ended_sees_and_senses_nothing_more() -> None:
    """Also where it is moved on, as a loop might that goes on for the others."""
    given = drives(
        sensor=Near(range_m=2.0), ground=Probe(1.0), covariance=ALIKE,
        predict=lambda terrain, seen: Oracle().predict_terrain(terrain),
    )  # fmt: skip
    knowing, running = (
        KnowledgeTracker(given.learning, given.problem),
        torch.arange(BATCH) < 3,
    )
    before = knowing.known
    knowing.learn(0, given.problem.start + torch.tensor([3.0, 3.0, 0.0]), running)
    for name in ("seen", "ever_sensed"):
        more = (getattr(knowing.known, name) & ~getattr(before, name)).flatten(1).any(1)
        assert torch.equal(more, running), name


def test_episodes_that_left_do_not_change_the_others(probed: Episodes) -> None:
    given = drives()
    assert sorted(probed.steps.tolist())[3] < 160, "nobody left early"

    class Stays(AStarDWA):
        def select(self, plan_state: Any, members: Tensor) -> Any:
            return NotImplemented

    stayed = given.run(Stays(CONFIG), given.learning)
    torch.testing.assert_close(probed.states, stayed.states, atol=1e-3, rtol=0)
    assert torch.equal(probed.outcome, stayed.outcome)
    assert torch.equal(probed.revisions, stayed.revisions)


def fails(error: str = "no echo") -> Callable[..., Any]:
    def call(*given: Any, **named: Any) -> Any:
        raise ValueError(error)

    return call


class Wrong(Sensor):
    def __init__(self, said: Callable[..., Any]) -> None:
        self.said = said

    def sense(
        self, terrain: Any, field: Tensor, robot_state: Tensor, noise_key: NoiseKey
    ) -> Any:
        return self.said(field)


@pytest.mark.parametrize(
    ("said", "words"),
    [
        (fails(), "ValueError: no echo"),
        (lambda field: None, "Expected a Measurement from `sense`, got NoneType."),
        (
            lambda field: Measurement(traversability=field[:1], std=field),
            "`Measurement.traversability`",
        ),
        (
            lambda field: Measurement(traversability=field, std=field.double()),
            "`Measurement.std`",
        ),
        (lambda field: Measurement(traversability=field + 1, std=field), "in [0, 1]"),
    ],
)
def test_a_sensor_that_fails_ends_its_episodes(
    said: Callable[..., Any], words: str
) -> None:
    given = drives(ground=Wrong(said))
    found = given.run(astar_dwa(), given.learning)
    assert (found.outcome == Outcome.SENSOR_ERROR).all()
    assert all(words in error for error in found.errors), found.errors[0]
    assert (found.traceback != "") == (found.errors[0] != "")


def test_a_sensor_under_the_key_of_the_other_kind_is_refused() -> None:
    given = drives()
    truth = given.learning.truth
    with pytest.raises(
        KnowledgeError, match="measures traversability, list it under `grounds`"
    ):
        learning(given.problem, truth, sensor=Probe(1.0), covariance=ALIKE)
    # What senses both may stand under either.
    both = Wrong(
        lambda field: Measurement(
            traversability=field,
            std=torch.full_like(field, 0.1),
            appearance=looks_of(truth, field),
        )
    )
    assert learning(
        given.problem,
        truth,
        sensor=both,
        covariance=ALIKE,
        predict=lambda t, o: t.truth,
    )
    found = given.run(
        astar_dwa(),
        learning(given.problem, truth, ground=both),
        stop=lambda step: step == 6,
    )
    assert set(found.errors) == {""}


def looks_of(truth: Truth, field: Tensor) -> Any:
    noise_key = NoiseKey(KEYS, 0)
    return (
        Full()
        .sense(truth.terrain, field, torch.zeros(len(field), 3), noise_key)
        .appearance
    )


@pytest.mark.parametrize("call", ["update", "at", "changed"])
def test_a_belief_that_fails_ends_its_episodes(call: str) -> None:
    class Broken(Copula):
        pass

    setattr(Broken, call, fails("lost"))
    given = drives(belief=Broken())
    found = given.run(astar_dwa(), given.learning)
    assert (found.outcome == Outcome.BELIEF_ERROR).all()
    assert set(found.errors) == {"ValueError: lost"}


@pytest.mark.parametrize("said", ["shape", "mean"])
def test_a_belief_whose_cells_are_none_is_to_blame_itself(said: str) -> None:
    class Misfit(Copula):
        def at(self, state: Any, cells: Tensor) -> Any:
            found = super().at(state, cells)
            return self.distribution(state) if said == "shape" else _NoMean(found.below)

    given = drives(belief=Misfit())
    found = given.run(astar_dwa(), given.learning)
    assert (found.outcome == Outcome.BELIEF_ERROR).all()
    expected = (
        "a distribution of shape [1, " if said == "shape" else "ValueError: no mean"
    )
    assert all(expected in error for error in found.errors), found.errors[0]


class _NoMean(TabulatedDistribution):
    """Has an expected time, by which risk is told, and no mean, by which ground is
    free.
    """

    def mean(self) -> Tensor:
        raise ValueError("no mean")


def test_cells_that_are_no_map_are_the_beliefs_fault() -> None:
    class Counts(Copula):
        def changed(self, before: Any, after: Any) -> Any:
            return super().changed(before, after).long()

    given = drives(belief=Counts())
    found = given.run(astar_dwa(), given.learning)
    assert (found.outcome == Outcome.BELIEF_ERROR).all()
    assert "cells from `changed` as torch.bool" in found.errors[0]


def test_a_planner_in_a_process_of_its_own_learns_as_one_here() -> None:
    suite = Suite(
        model="oracle",
        planners=({"part": "astar_dwa", "options": asdict(CONFIG)},),
        risks=("mean",),
    )
    (condition,) = conditions_of(suite, lambda data: ["std"])
    given = drives()
    options: dict[str, Any] = {"stop": lambda step: step == 25}
    with closing(IsolatedPlanner(condition, 20.0)) as isolated:
        found = given.run(isolated, given.learning, **options)
    assert (found.revisions > 0).any()
    assert same(given.run(astar_dwa(), given.learning, **options), found)


def test_a_measure_that_fails_on_what_is_believed_is_a_model_error() -> None:
    def on_whole_maps(distribution: TraversabilityDistribution) -> Tensor:
        if distribution.shape[1] == 1:
            raise ValueError("no tail")
        return measure(distribution)

    given = drives(measure=on_whole_maps)
    found = given.run(astar_dwa(), given.learning)
    assert (found.outcome == Outcome.MODEL_ERROR).all()


def test_a_planner_that_raises_while_robots_learn_is_a_planner_error() -> None:
    class Raises(AStarDWA):
        def revise(self, plan_state: Any, problem: Problem) -> Any:
            raise ValueError("stuck")

    given = drives()
    found = given.run(Raises(CONFIG), given.learning)
    assert set(found.outcome.tolist()) == {Outcome.PLANNER_ERROR}


def test_a_sensor_and_a_belief_may_write_into_what_they_are_given() -> None:
    class Scribbles(Sensor):
        def sense(
            self, terrain: Any, field: Tensor, robot_state: Tensor, noise_key: NoiseKey
        ) -> Measurement:
            sensed = Probe(1.5).sense(terrain, field, robot_state, noise_key)
            field.zero_()
            robot_state.zero_()
            terrain.truth.means.zero_()
            return sensed

    class Scrawls(Copula):
        def update(self, state: Any, sensed: Measurement, prior: Any = None) -> Any:
            found = super().update(state, sensed, prior)
            sensed.traversability.zero_()
            return found

    given = drives()
    options: dict[str, Any] = {"stop": lambda step: step == 16}
    wanted = given.run(astar_dwa(), given.learning, **options)
    scribbled = learning(
        given.problem, given.learning.truth, ground=Scribbles(), belief=Scrawls()
    )
    wrote = given.run(astar_dwa(), scribbled, **options)
    assert same(wanted, wrote)


def test_a_planner_that_begins_anew_learns_too() -> None:
    class Forgets(AStarDWA):
        def revise(self, plan_state: Any, problem: Problem) -> Any:
            return NotImplemented

    given = drives()
    options: dict[str, Any] = {"stop": lambda step: step == 36}
    found = given.run(Forgets(CONFIG), given.learning, **options)
    assert (found.revisions > 5).all()
    assert not same(given.run(Forgets(CONFIG), None, **options), found)
    # All that A*+DWA keeps is a velocity: begun anew from it, the unicycle takes the
    # same way.
    assert same(given.run(astar_dwa(), given.learning, **options), found)


@pytest.mark.parametrize("every", [0.0, float("inf")])
def test_times_that_never_come_are_refused(every: float) -> None:
    with pytest.raises(ConfigError, match="replan_every_s"):
        drives(replan_every_s=every)


@pytest.mark.parametrize("call", ["init", "distribution"])
def test_the_error_keeps_how_episodes_end(call: str) -> None:
    with pytest.raises(KnowledgeError) as error:
        drives(belief=type("Broken", (Copula,), {call: fails()})())
    assert error.value.outcome == Outcome.BELIEF_ERROR


def test_what_is_measured_ahead_is_what_each_cell_ahead_tells() -> None:
    given = drives(ground=Probe(1.0))
    problem, truth, how = given.problem, given.learning.truth, given.learning.learner
    knowing = KnowledgeTracker(given.learning, problem)
    states = problem.start.clone()
    states[:, 2] = torch.linspace(-3, 3, BATCH)
    states[3, :2] = torch.tensor([6.1, 5.7])
    running = torch.arange(BATCH) != 5
    for step in range(6):
        knowing.learn(step, states, running)
    knowing.look_ahead(5, states, running)
    found, believed = knowing.ahead[5], how.distribution(knowing.known)
    mean, probability = believed.mean(), believed.log_prob(truth.field).clamp(min=-10)
    assert found[5].isnan().all()
    for own in (0, 3, 7):
        errors, scores = [], []
        x, y, heading = states[own].tolist()
        for row in range(SIZE):
            for column in range(SIZE):
                away = (column + 0.5) / 2 - x, (row + 0.5) / 2 - y
                turn = math.atan2(away[1], away[0]) - heading
                turn = (turn + math.pi) % (2 * math.pi) - math.pi
                known = bool(knowing.known.ever_sensed[own, row, column])
                if math.hypot(*away) <= 5 and abs(turn) <= math.pi / 4 and not known:
                    errors.append(
                        float(mean[own, row, column] - truth.field[own, row, column])
                    )
                    scores.append(float(probability[own, row, column]))
        assert len(errors) >= 3
        rmse = math.sqrt(sum(error**2 for error in errors) / len(errors))
        assert float(found[own, 0]) == pytest.approx(rmse, abs=0.005)
        assert float(found[own, 1]) == pytest.approx(
            sum(scores) / len(scores), abs=0.01
        )


def part_of(given: Drives, members: list[int]) -> Drives:
    """Some of the episodes, as if there were no others."""
    kept, truth = torch.tensor(members), given.learning.truth
    problem, own = given.problem.select(kept), truth.select(kept)
    places = Endpoints(
        start_m=problem.start[:, :2], goal_m=problem.goal_m,
        reference_time_s=torch.full((len(members),), torch.nan),
    )  # fmt: skip
    simulation = Simulation(own.terrain, problem.task, WORLD, places, 0, members)
    learner = given.learning.learner
    start = learner.begin(own, problem.start, own.terrain.truth)
    return Drives(
        problem, simulation, Learning(learner=learner, start=start, truth=own)
    )


EXPLORES = AStarDWA(replace(CONFIG, explore=1.0))


@pytest.mark.parametrize("planner", [*SHIPPED, EXPLORES], ids=[*SHIPPED, "explores"])
def test_what_an_episode_learns_depends_on_no_other(planner: Any) -> None:
    given = drives(ground=Contact())
    options: dict[str, Any] = {"stop": lambda step: step == 16}
    one = make(planner) if isinstance(planner, str) else planner
    whole = given.run(one, given.learning, **options)
    for members in ([2], [7, 1]):
        part = part_of(given, members)
        alone = part.run(one, part.learning, **options)
        torch.testing.assert_close(
            alone.states, whole.states[members], atol=1e-4, rtol=0
        )
        assert torch.equal(alone.revisions, whole.revisions[members])
        assert alone.ahead is not None
        assert whole.ahead is not None
        torch.testing.assert_close(
            alone.ahead, whole.ahead[members], atol=1e-4, rtol=0, equal_nan=True
        )


def test_who_has_ended_senses_nothing_more_whenever_it_leaves_the_batch(
    probed: Episodes,
) -> None:
    given, whole = drives(), probed
    first = int(whole.steps.argmin())
    part = part_of(given, [first])
    alone = part.run(astar_dwa(), part.learning)
    assert int(whole.steps[first]) == int(alone.steps) < int(whole.steps.max()) - 5
    assert whole.sensed_cells is not None
    assert alone.sensed_cells is not None
    assert int(alone.sensed_cells) == int(whole.sensed_cells[first])


def test_planners_are_told_nothing_of_episodes_whose_map_stays() -> None:
    given = drives(ground=Probe(1.0))
    knowing = KnowledgeTracker(given.learning, given.problem)
    running = torch.arange(BATCH) < 3
    (told,) = [knowing.learn(0, given.problem.start, running)]
    assert told is not None
    assert knowing.revisions.tolist() == [1] * 3 + [0] * (BATCH - 3)
    before, after = given.problem.distribution.mean(), told.distribution.mean()
    torch.testing.assert_close(after[3:], before[3:])
    assert torch.equal(told.risk_map[3:], given.problem.risk_map[3:])
    assert torch.equal(told.free[3:], given.problem.free[3:])
    assert ((after - before)[:3].abs().flatten(1).amax(1) > 0.1).all()
    # A change that is too small for a new plan comes with the next that is not.
    believed = given.learning.learner.distribution(knowing.known).mean()
    torch.testing.assert_close(after[:3], believed[:3])


@pytest.mark.parametrize("belief", [Copula(), Static()])
def test_λ_that_is_drawn_anew_is_what_it_is_in_each_step(belief: Belief[Any]) -> None:
    given, drawn = drives(ground=Contact(), belief=belief), list[int]()

    def field_at(step: int) -> Tensor:
        drawn.append(step)
        return torch.full((BATCH, SIZE, SIZE), 0.1 * (step + 1))

    knowing = KnowledgeTracker(
        replace(given.learning, field_at=field_at), given.problem
    )
    knowing.keep(torch.tensor([3, 1, 0]))
    running = torch.ones(3, dtype=torch.bool)
    for step in range(8):
        knowing.learn(step, given.problem.start[:3], running)
        told = knowing.known.sensed
        if belief.learns and step % 5:
            assert told.mask.sum() == 3
            assert told.traversability[told.mask].tolist() == pytest.approx(
                [0.1 * (step + 1)] * 3
            )
    assert drawn == (list(range(8)) if belief.learns else [0, 5])
