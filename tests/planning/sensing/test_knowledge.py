"""What robots know: what they are shown, what their model is given of it, and what is
believed of the rest.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError
from benchnav.core.ground import GroundStatistics
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.quantiles import LEVELS, QuantileDistribution
from benchnav.core.terrain import Observation, Terrain
from benchnav.planning.free_space import FreeSpace, Rules
from benchnav.planning.sensing.belief import Static
from benchnav.planning.sensing.copula import Copula
from benchnav.planning.sensing.knowledge import (
    Knowledge,
    KnowledgeError,
    Truth,
    no_measurement,
    prior_of_unobserved,
)
from benchnav.planning.sensing.learner import Learner
from benchnav.planning.sensing.near import Near
from benchnav.planning.sensing.sensor import (
    Contact,
    Full,
    Measurement,
    NoiseKey,
    Probe,
    Sensor,
)
from benchnav.planning.world.outcome import Outcome
from tests import factories
from tests.planning.sensing import made

BATCH, SIZE = 3, 16
STATISTICS = GroundStatistics(
    weights=(0.7, 0.3), means=(0.8, 0.1), stds=(0.1, 0.05),
    layer_means={"rgb": (10.0, 20.0, 30.0), "elevation_m": (1.5,), "slope_deg": (7.0,)},
)  # fmt: skip
RULES = Rules(free_space=FreeSpace(by="mean", above=0.3))
KEYS = (11, 12, 13)
SEES = Near(range_m=2.0, colour_noise=0.0, elevation_noise=0.0)


def terrain() -> Terrain:
    generator = torch.Generator().manual_seed(3)
    mean = torch.rand(BATCH, SIZE, SIZE, generator=generator)
    rgb = torch.randint(
        256, (BATCH, 3, SIZE, SIZE), generator=generator, dtype=torch.uint8
    )
    return replace(factories.terrain(mean, 0.05), rgb=rgb)


TRUTH = Truth(terrain=terrain(), field=terrain().traversability, keys=KEYS)
START = torch.tensor([[1.25, 1.25, 0.0], [4.1, 4.1, 1.0], [5.75, 1.25, 2.0]])


@dataclass
class Model:
    """Predicts by the red of what it sees, and keeps all that it is given."""

    seen: list[Observation] = field(default_factory=list)

    def __call__(
        self, terrain: Terrain, observation: Observation
    ) -> TraversabilityDistribution:
        self.seen.append(observation)
        means = observation.rgb[:, :1].float() / 255
        return TraversabilityMixture(
            torch.ones_like(means), means, torch.full_like(means, 0.1), (0,)
        )


def learner(model: Any = None, **changes: Any) -> Learner:
    given: dict[str, Any] = {
        "sensor": SEES, "ground": Contact(), "belief": Copula(), "rules": RULES,
        "covariance": replace(made.covariance(SIZE, SIZE), statistics=STATISTICS), "measure": lambda own: own.cvar(0.5),
        "predict": model or Model(),
    }  # fmt: skip
    return Learner(**given | changes)


def begin(how: Learner) -> Knowledge:
    return how.begin(TRUTH, START, None)


def moved(
    how: Learner, known: Knowledge, robot_state: Tensor, step: int = 5
) -> tuple[Knowledge, Tensor]:
    looks = torch.ones(BATCH, dtype=torch.bool)
    return how.update(
        how.sense(known, TRUTH, robot_state, step, looks, torch.ones_like(looks)), TRUTH
    )


def near(robot_state: Tensor = START) -> Tensor:
    appearance = SEES.sense(
        TRUTH.terrain, TRUTH.field, robot_state, NoiseKey(KEYS, 0)
    ).appearance
    assert appearance is not None
    return appearance.seen


def test_a_model_is_given_what_was_seen_and_training_means_elsewhere() -> None:
    model = Model()
    how = learner(model)
    known, seen = begin(how), near()
    (given,) = model.seen
    assert seen.any()
    assert not seen.all()
    assert torch.equal(known.seen, seen)
    truth = TRUTH.terrain.rgb.movedim(1, -1)
    assert torch.equal(given.rgb.movedim(1, -1)[seen], truth[seen])
    assert set(map(tuple, given.rgb.movedim(1, -1)[~seen].tolist())) == {(10, 20, 30)}
    assert (given.elevation_m[~seen] == 1.5).all()
    assert torch.equal(given.elevation_m[seen], TRUTH.terrain.elevation_m[seen])
    assert (given.slope_deg[~seen] == 7.0).all()
    assert torch.equal(given.layers["seen"], seen.float())
    assert given is known.observation
    # Further on it is given both looks, and nothing twice.
    further, _ = moved(how, known, START + 2)
    assert len(model.seen) == 2
    both = seen | near(START + 2)
    assert torch.equal(model.seen[1].layers["seen"], both.float())
    assert torch.equal(further.seen, both)
    moved(how, further, START + 2, 10)
    assert len(model.seen) == 2


def test_what_is_believed_is_the_prediction_where_ground_was_seen_and_the_prior_elsewhere() -> (
    None
):
    known, seen = begin(how := learner()), near()
    believed = how.distribution(known)
    red = TRUTH.terrain.rgb[:, 0].float() / 255
    own = TraversabilityMixture(
        torch.ones_like(red)[:, None], red[:, None], torch.full_like(red, 0.1)[:, None]
    )
    prior = STATISTICS.mixture((BATCH, SIZE, SIZE), red)
    for ask in (lambda d: d.mean(), lambda d: d.cdf(0.4), lambda d: d.cvar(0.5)):
        torch.testing.assert_close(
            ask(believed), torch.where(seen, ask(own), ask(prior)), atol=1e-4, rtol=0
        )
    torch.testing.assert_close(
        known.risk_map,
        torch.where(seen, own.cvar(0.5), prior.cvar(0.5)),
        atol=0.01,
        rtol=0,
    )
    assert torch.equal(
        known.free, torch.where(seen, own.mean() > 0.3, prior.mean() > 0.3)
    )


def test_a_model_of_another_kind_than_mixtures_is_taken_too() -> None:
    def quantiles(
        terrain: Terrain, observation: Observation
    ) -> TraversabilityDistribution:
        red = observation.rgb[:, 0].float() / 255
        return QuantileDistribution(
            torch.stack([(red + 0.2 * (own - 0.5)).clamp(0, 1) for own in LEVELS], 1)
        )

    known = begin(how := learner(quantiles))
    believed, seen = how.distribution(known).mean(), near()
    red = TRUTH.terrain.rgb[:, 0].float() / 255
    assert (believed - red)[seen].abs().max() < 0.06
    torch.testing.assert_close(
        believed[~seen], STATISTICS.mixture((BATCH, SIZE, SIZE), red).mean()[~seen]
    )


def test_privileged_models_tell_of_seen_ground_alone() -> None:
    def oracle(
        terrain: Terrain, observation: Observation
    ) -> TraversabilityDistribution:
        return terrain.truth

    known = begin(how := learner(oracle))
    believed, seen = how.distribution(known).mean(), near()
    torch.testing.assert_close(believed[seen], TRUTH.terrain.truth.mean()[seen])
    prior = STATISTICS.mixture((BATCH, SIZE, SIZE), believed)
    torch.testing.assert_close(believed[~seen], prior.mean()[~seen])

    # One that knows λ itself knows it as it is now.
    def clairvoyant(
        terrain: Terrain, observation: Observation
    ) -> TraversabilityDistribution:
        return factories.certain(terrain.traversability)

    later = learner(clairvoyant)
    now = later.begin(replace(TRUTH, field=1 - TRUTH.field), START, None)
    torch.testing.assert_close(
        later.distribution(now).mean()[seen], 1 - TRUTH.field[seen]
    )


@pytest.mark.parametrize("unseen", ["prior", "optimistic", "pessimistic"])
def test_unseen_ground_is_believed_to_be_what_the_rules_say(unseen: str) -> None:
    like = torch.zeros(2, 4, 5)
    found = prior_of_unobserved(STATISTICS, unseen, like.shape, like)
    assert found.shape == (2, 4, 5)
    assert found.dtype == like.dtype
    prior = STATISTICS.mixture(like.shape, like)
    # CVaR at 0.8 of 0.7 N(0.8, 0.1²) + 0.3 N(0.1, 0.05²), clipped, from its worst
    # fifth.
    grid = torch.linspace(0.0005, 0.1995, 200, dtype=torch.float64)
    worst = torch.stack(
        [STATISTICS.mixture((1, 1, 1), grid).quantile(float(share)) for share in grid]
    ).mean()
    wanted = {
        "prior": float(prior.mean()[0, 0, 0]),
        "optimistic": 1.0,
        "pessimistic": float(worst),
    }[unseen]
    torch.testing.assert_close(
        found.mean(), torch.full_like(like, wanted), atol=2e-3, rtol=0
    )
    if unseen != "prior":  # without doubt
        torch.testing.assert_close(found.cvar(0.9), found.mean(), atol=1e-6, rtol=0)
    assert 0.05 < float(worst) < 0.1


@pytest.mark.parametrize("unseen", ["prior", "optimistic", "pessimistic"])
def test_pessimism_lowers_what_unseen_ground_is_worth_and_closes_none(
    unseen: str,
) -> None:
    known, seen = begin(learner(rules=replace(RULES, unseen=unseen))), near()
    usual = begin(learner())
    assert torch.equal(known.risk_map[seen], usual.risk_map[seen])
    assert torch.equal(known.free[seen], usual.free[seen])
    assert not usual.free[seen].all(), "all of it is free"
    assert known.free[~seen].all()
    lower, higher = (
        (known.risk_map < usual.risk_map)[~seen],
        (known.risk_map > usual.risk_map)[~seen],
    )
    assert (bool(lower.all()), bool(higher.all())) == (
        unseen == "pessimistic",
        unseen == "optimistic",
    )


def test_pessimism_closes_no_unseen_ground_either_when_more_is_known_of_it() -> None:
    how = learner(rules=replace(RULES, unseen="pessimistic"), ground=Probe(4.0))
    known, changed = moved(how, begin(how), START)
    told = changed & ~known.seen
    assert told.any()
    assert known.free[told].all()
    assert not known.free[known.seen].all()


def test_a_sensor_that_looks_and_senses_at_once_does_both_in_the_same_episodes() -> (
    None
):
    class Both(Sensor):
        def sense(
            self,
            terrain: Terrain,
            field: Tensor,
            robot_state: Tensor,
            noise_key: NoiseKey,
        ) -> Measurement:
            sensed = Contact().sense(terrain, field, robot_state, noise_key)
            return replace(
                sensed,
                appearance=SEES.sense(
                    terrain, field, robot_state, noise_key
                ).appearance,
            )

    how = learner(sensor=Both(), belief=Static())
    two = torch.tensor([True, False, True])
    known = how.sense(begin(how), TRUTH, START, 1, two, torch.ones_like(two))
    assert known.ever_sensed.flatten(1).sum(1).tolist() == [1, 0, 1]
    assert known.footprint.flatten(1).any(1).tolist() == [True, False, True]


def test_ground_that_turns_out_bad_is_closed_once_it_is_seen() -> None:
    how = learner(rules=replace(RULES, unseen="pessimistic"), belief=Static())
    known = begin(how)
    red = TRUTH.terrain.rgb[:, 0].float() / 255
    further, changed = moved(how, known, START + 2)
    new = further.seen & ~known.seen
    assert changed[new].all()
    own = TraversabilityMixture(
        torch.ones_like(red)[:, None], red[:, None], torch.full_like(red, 0.1)[:, None]
    )
    assert torch.equal(further.free[new], (own.mean() > 0.3)[new])
    assert not further.free[new].all()


@pytest.mark.parametrize("belief", [Copula(), Static()])
def test_sensors_are_asked_when_it_is_due_and_where_robots_are(belief: Any) -> None:
    asked: list[str] = []

    class Asked(Sensor):
        def __init__(self, inner: Sensor) -> None:
            self.inner = inner

        def sense(
            self,
            terrain: Terrain,
            field: Tensor,
            robot_state: Tensor,
            noise_key: NoiseKey,
        ) -> Measurement:
            asked.append(type(self.inner).__name__)
            return self.inner.sense(terrain, field, robot_state, noise_key)

    how = learner(sensor=Asked(SEES), ground=Asked(Contact()), belief=belief)
    known = begin(how)
    assert asked == ["Near"]
    ground = ["Contact"] if belief.learns else []
    none, two = torch.zeros(BATCH, dtype=torch.bool), torch.tensor([True, False, True])
    sensed = how.sense(known, TRUTH, START + 2, 1, none, torch.ones_like(none))
    assert asked == ["Near", *ground]
    assert torch.equal(sensed.seen, known.seen)
    assert int(sensed.ever_sensed.sum()) == BATCH * len(ground)
    looked = how.sense(known, TRUTH, START + 2, 1, two, torch.ones_like(two))
    assert asked == ["Near", *ground, "Near", *ground]
    more = (looked.seen & ~known.seen).flatten(1).any(1)
    assert more.tolist() == two.tolist() == looked.has_new_appearance.tolist()
    wanted = known.seen | near(START + 2) & two[:, None, None]
    assert torch.equal(looked.seen, wanted)
    # In a later step that tells nothing new, all is as it was.
    still, changed = how.update(known, TRUTH)
    assert still is known
    assert not changed.any()


def test_all_looks_between_two_updates_count_and_of_one_cell_the_later() -> None:
    how = learner(sensor=Full(), ground=Probe(0.8, 0.3))
    known = how.begin(TRUTH, START, TRUTH.terrain.truth)
    every = torch.ones(BATCH, dtype=torch.bool)
    one = how.sense(known, TRUTH, START, 1, every, torch.ones_like(every))
    both = how.sense(one, TRUTH, START + 0.5, 2, every, torch.ones_like(every))
    first = Probe(0.8, 0.3).sense(TRUTH.terrain, TRUTH.field, START, NoiseKey(KEYS, 1))
    second = Probe(0.8, 0.3).sense(
        TRUTH.terrain, TRUTH.field, START + 0.5, NoiseKey(KEYS, 2)
    )
    assert torch.equal(both.ever_sensed, first.mask | second.mask)
    assert torch.equal(both.footprint, second.mask)
    wanted = torch.where(second.mask, second.traversability, first.traversability)
    assert torch.equal(both.sensed.traversability.nan_to_num(-1), wanted.nan_to_num(-1))
    assert (both.sensed.std[both.sensed.mask] == 0.3).all()
    assert not known.ever_sensed.any()
    after, changed = how.update(both, TRUTH)
    assert not after.sensed.mask.any()
    assert torch.equal(after.ever_sensed, both.ever_sensed)
    assert changed[both.ever_sensed].any()
    at_once = Copula().update(
        Copula().init(TRUTH.terrain.truth, how.covariance), both.sensed
    )
    torch.testing.assert_close(
        how.distribution(after).mean(), Copula().distribution(at_once).mean()
    )
    assert torch.equal(after.risk_map[~changed], known.risk_map[~changed])


def test_episodes_are_kept_and_take_the_places_of_others() -> None:
    how = learner()
    known, _ = moved(how, begin(how), START + 1)
    last = torch.tensor([2, 0])
    kept = how.select(known, last)
    assert torch.equal(kept.risk_map, known.risk_map[last])
    assert torch.equal(kept.seen, known.seen[last])
    torch.testing.assert_close(
        how.distribution(kept).mean(), how.distribution(known).mean()[last]
    )
    turned = how.put(known, torch.tensor([0, 2]), kept)
    order = torch.tensor([2, 1, 0])
    torch.testing.assert_close(
        how.distribution(turned).mean(), how.distribution(known).mean()[order]
    )
    assert torch.equal(turned.observation.rgb, known.observation.rgb[order])
    truth = TRUTH.put(torch.tensor([0, 2]), TRUTH.select(last))
    assert truth.keys == (13, 12, 11)
    assert torch.equal(truth.field, TRUTH.field[order])


def test_without_statistics_nothing_is_known_of_unseen_ground() -> None:
    with pytest.raises(
        ConfigError,
        match=r"`CovarianceModel\.statistics` for a sensor that does not observe the whole map, got None",
    ):
        begin(learner(covariance=made.covariance(SIZE, SIZE)))


def test_nothing_is_sensed_where_nothing_was() -> None:
    nothing = no_measurement(torch.ones(2, 3, 4))
    assert not nothing.mask.any()
    assert nothing.mask.shape == (2, 3, 4)


@pytest.mark.parametrize("said", [None, "short"])
def test_a_belief_whose_distribution_is_none_is_to_blame(said: str | None) -> None:
    class Odd(Copula):
        def distribution(self, state: Any) -> Any:
            found = super().distribution(state)
            return found.select(torch.tensor([0])) if said else None

    how = learner(belief=Odd())
    known = begin(how)
    with pytest.raises(
        KnowledgeError, match="Expected `distribution` of the belief to return"
    ) as error:
        how.distribution(known)
    assert error.value.outcome == Outcome.BELIEF_ERROR


def fails(*given: Any, **named: Any) -> Any:
    raise ValueError("no")


@pytest.mark.parametrize(
    ("changes", "outcome"),
    [
        ({"sensor": type("Blind", (Near,), {"sense": fails})()}, Outcome.SENSOR_ERROR),
        ({"model": fails}, Outcome.MODEL_ERROR),
        (
            {"belief": type("Broken", (Copula,), {"init": fails})()},
            Outcome.BELIEF_ERROR,
        ),
        ({"measure": fails}, Outcome.MODEL_ERROR),
    ],
)
def test_who_fails_at_the_start_is_named(
    changes: dict[str, Any], outcome: Outcome
) -> None:
    with pytest.raises(KnowledgeError, match="no") as error:
        begin(learner(**changes))
    assert error.value.outcome == outcome
