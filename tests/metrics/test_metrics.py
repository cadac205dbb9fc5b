"""Each metric against its closed form on hand-made episodes."""

import math
import runpy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchnav.core import registry
from benchnav.metrics import (
    SHIPPED,
    Energy,
    Episode,
    LearningRecord,
    Metric,
    MetricError,
)
from benchnav.metrics.base import measure
from benchnav.metrics.check import attribute_faults, sample_episodes
from benchnav.planning.robots import Bicycle, DifferentialDrive, Unicycle
from benchnav.testing import check_metric
from tests.metrics.made import episode

ROOT = Path(__file__).parents[2]
BY_COLUMN = {metric.column: metric for metric in SHIPPED}
AHEAD = np.array([[0.2, -1.0], [np.nan, np.nan], [0.4, 0.5], [np.nan, np.nan]])
LEARNING = LearningRecord(
    revisions=3, seen_cells=40, sensed_cells=7, ahead=AHEAD, step_s=0.02
)
NAN = math.nan


@pytest.mark.parametrize(
    ("column", "success", "failure", "at_once"),
    [
        ("success", True, False, False),
        ("total_time_s", 0.4, 50.0, 50.0),
        ("end_time_s", 0.4, 0.4, 0.0),
        ("traversability", 0.5, 0.5, NAN),
        ("reference_time_s", 2.0, 2.0, 2.0),
        ("time_ratio", 0.2, NAN, NAN),
        ("score", 0.5, 0.0, 0.0),
        ("path_length_m", 0.2, 0.2, NAN),
        ("stuck_share", 0.5, 0.5, NAN),
        ("roughness_radps2", 5.0, 5.0, NAN),
        ("planning_ms", 3.0, 3.0, NAN),
        ("planning_ms_p95", 3.9, 3.9, NAN),
        ("planning_start_ms", 501.0, 501.0, NAN),
        ("revisions", 3, 3, NAN),
        ("seen_cells", 40, 40, NAN),
        ("sensed_cells", 7, 7, NAN),
        ("ahead_rmse", 0.3, 0.3, NAN),
        ("ahead_log_score", -0.25, -0.25, NAN),
        ("learning_ms", 20.0, 20.0, NAN),
        ("rejected_draws", 2, 2, 0),
        ("lower_bound_s", 0.3, 0.3, NAN),
    ],
)
def test_a_shipped_metric_is_its_closed_form(
    column: str, success: float, failure: float, at_once: float
) -> None:
    turning = np.array([0.0, 0.5, 0.0, 0.5])
    changes: dict[str, Any] = {
        "turn_rate_radps": turning, "learning": LEARNING, "rejected_draws": 2, "lower_bound_s": 0.3,
    }  # fmt: skip
    drive = episode([0.2, 0.8, 0.3, 0.7], **changes)
    values = [
        BY_COLUMN[column].value(one)
        for one in (
            drive,
            replace(drive, outcome="timeout"),
            episode([], outcome="model_error"),
        )
    ]
    assert values == [
        pytest.approx(value, nan_ok=True) for value in (success, failure, at_once)
    ]


@pytest.mark.filterwarnings("error")
def test_an_episode_of_one_step_gives_no_warning() -> None:
    short = episode([0.5], learning=replace(LEARNING, ahead=AHEAD[1:2]))
    values = {column: metric.value(short) for column, metric in BY_COLUMN.items()}
    undefined = {column for column, value in values.items() if math.isnan(value)}
    assert {
        "roughness_radps2",
        "planning_ms",
        "planning_ms_p95",
        "ahead_rmse",
        "ahead_log_score",
    } <= undefined


def test_every_shipped_metric_has_a_closed_form() -> None:
    (mark,) = test_a_shipped_metric_is_its_closed_form.pytestmark  # type: ignore[attr-defined]
    assert [column for column, *_ in mark.args[1]] == list(BY_COLUMN)


@pytest.mark.parametrize(
    ("end_s", "score"), [(4, 0.5), (10, 0.5), (20, 0.25), (40, 0.125), (90, 0.125)]
)
def test_score_is_barns(end_s: int, score: float) -> None:
    # OT = 5 s: nothing is better than 10 s, nothing worse than 40 s.
    drive = episode(np.ones(end_s), dt_s=1.0, reference_time_s=10.0)
    assert BY_COLUMN["score"].value(drive) == score


def test_times_are_measured_by_the_robots_top_speed() -> None:
    drive = episode([1, 1], reference_time_s=0.4, robot=Unicycle(speed_mps=(0.0, 2.0)))
    assert BY_COLUMN["time_ratio"].value(drive) == pytest.approx(1.0)
    assert BY_COLUMN["score"].value(drive) == pytest.approx(0.5)


def test_the_path_of_a_circle_is_its_circumference() -> None:
    angle = np.linspace(0, 2 * np.pi, 1001)
    track = np.stack((3 * np.cos(angle), 3 * np.sin(angle), angle), axis=1)
    assert BY_COLUMN["path_length_m"].value(
        episode(np.ones(1000), states=track)
    ) == pytest.approx(6 * np.pi, rel=1e-5)


@given(
    traversability=st.floats(0, 1),
    power_w=st.floats(0.1, 1e4),
    least=st.floats(0.01, 1),
    steps=st.integers(1, 40),
)
def test_energy_on_uniform_terrain_is_power_times_time_over_traversability(
    traversability: float, power_w: float, least: float, steps: int
) -> None:
    drive = episode(np.full(steps, traversability))
    expected = power_w * 0.1 * steps / max(traversability, least)
    assert Energy(power_w, least).value(drive) == pytest.approx(expected)


def test_energy_is_a_sum_over_steps_that_are_commanded_to_move() -> None:
    # 100 W for 0.1 s each: λ of 0.5 and 0.25 cost 20 J and 40 J, a turn in place at λ =
    # 1 costs 10 J, a halt nothing.
    commands = {
        "speed_mps": np.array([1.0, 1, 0, 0]),
        "turn_rate_radps": np.array([0.0, 0, 1, 0]),
    }
    moving = episode([0.5, 0.25, 1.0, 0.2], **commands)
    assert Energy().value(moving) == pytest.approx(70.0)
    # At λ = 0 the floor limits the power to ten times P.
    assert Energy().value(episode([0.0])) == pytest.approx(100.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"power_w": 0}, "`power_w` of metric 'energy' > 0 and finite, got 0"),
        (
            {"min_traversability": 0},
            r"`min_traversability` of metric 'energy' in \(0, 1\], got 0",
        ),
        ({"min_traversability": 1.5}, r"in \(0, 1\], got 1.5"),
    ],
)
def test_energy_rejects_options_without_meaning(
    options: dict[str, float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        registry.make("metric", {"part": "energy", "options": options})


# --- the contract ---


@pytest.mark.parametrize("name", registry.names("metric"))
@pytest.mark.parametrize("robot", ["unicycle", "bicycle", "differential_drive"])
def test_every_registered_metric_keeps_the_contract(name: str, robot: str) -> None:
    check_metric(name, robot)
    assert registry.make("metric", name).name == name


def test_the_shipped_metrics_are_registered_and_those_of_every_run() -> None:
    assert {metric.name for metric in SHIPPED} | {"energy"} <= set(
        registry.names("metric")
    )
    assert len({metric.name for metric in SHIPPED}) == len(BY_COLUMN) == len(SHIPPED)


class Fine(Metric):
    """The number of steps."""

    name = "fine"
    column = "fine_s"
    suffix = "_s"
    meaning = "steps"

    def compute(self, episode: Episode) -> float:
        return float(episode.steps)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": ""}, "Expected `name` as text"),
        ({"meaning": "a\nb"}, "Expected `meaning` as text on one line"),
        ({"unit": None}, "Expected `unit` as text"),
        ({"column": "a b_s"}, "Expected `column` of letters, digits and _"),
        ({"suffix": "_m"}, "Expected `suffix` as the end of column 'fine_s'"),
        ({"better": "more"}, "Expected `better` as 'higher', 'lower' or 'neither'"),
        ({"scale": 0}, "Expected `scale` above 0"),
        ({"min_steps": -1}, "Expected `min_steps` as a whole number ≥ 0"),
    ],
)
def test_attributes_without_meaning_are_named(
    changes: dict[str, Any], message: str
) -> None:
    assert attribute_faults(Fine()) == []
    broken = type("Broken", (Fine,), changes)()
    assert [fault.startswith(message) for fault in attribute_faults(broken)] == [True]
    with pytest.raises(ValueError, match="breaks it"):
        check_metric(broken)


def test_an_attribute_that_is_missing_is_named() -> None:
    class Bare(Metric):
        def compute(self, episode: Episode) -> float:
            return 0.0

    assert [fault.split("`")[1] for fault in attribute_faults(Bare())] == [
        "name",
        "column",
        "meaning",
    ]


def changing(compute: Any) -> Metric:
    return type("Bad", (Fine,), {"compute": compute})()  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("compute", "message"),
    [
        (lambda self, episode: 1 / 0, "ZeroDivisionError"),
        (lambda self, episode: math.inf, "got inf"),
        (lambda self, episode: None, "got None"),
        (lambda self, episode: np.zeros(3), "got array"),
        (lambda self, episode: episode.states.fill(0), "read-only"),
        (lambda self, episode: np.random.rand(), "global generator"),  # noqa: NPY002
    ],
)
def test_a_metric_that_breaks_the_contract_is_named(compute: Any, message: str) -> None:
    from tests.testing.refusal import refusal

    assert message in refusal(check_metric, changing(compute))


def test_a_metric_that_counts_its_calls_is_named() -> None:
    def compute(self: Any, episode: Episode) -> float:
        self.calls = getattr(self, "calls", 0) + 1
        return float(self.calls)

    with pytest.raises(ValueError, match="same value when computed again"):
        check_metric(changing(compute))


@pytest.mark.parametrize(
    "value", [True, np.True_, 3, np.float32(0.5), np.int64(2), math.nan]
)
def test_numbers_of_any_type_are_values(value: Any) -> None:
    found = measure(changing(lambda self, episode: value), episode([1]))
    assert type(found) is float
    assert found == pytest.approx(float(value), nan_ok=True)


def test_a_failure_is_one_line_with_the_remedy() -> None:
    with pytest.raises(MetricError) as raised:
        measure(changing(lambda self, episode: {}["speed"]), episode([1]))
    assert str(raised.value) == (
        "Expected a finite number or NaN from metric 'fine', got KeyError: 'speed'. Return NaN where the value is "
        "undefined."
    )


def test_short_episodes_have_no_value_unless_the_metric_takes_them() -> None:
    assert math.isnan(measure(Fine(), episode([])))
    assert measure(type("Any", (Fine,), {"min_steps": 0})(), episode([])) == 0


def test_an_episode_cannot_be_written_to_and_prints_as_one_line() -> None:
    drive = episode([1, 1])
    with pytest.raises(ValueError, match="read-only"):
        drive.traversability[0] = 0
    assert (
        repr(drive)
        == "Episode(outcome='success', steps=2, end_time_s=0.2, robot=Unicycle)"
    )


@pytest.mark.parametrize("robot", [Unicycle(), Bicycle(), DifferentialDrive()])
def test_sample_episodes_are_drives_of_the_robot(robot: Any) -> None:
    success, stuck, short = sample_episodes(robot)
    assert (success.steps, stuck.steps, short.steps) == (12, 12, 1)
    assert success.states.shape[0] == 13
    assert success.actions.shape == (12, len(robot.action_names))
    assert np.allclose(stuck.positions_m, stuck.positions_m[0])  # λ = 0 moves nothing
    assert success.learning is not None
    assert (success.speed_mps <= robot.top_speed_mps + 1e-5).all()


def test_the_page_of_the_documentation_has_a_row_for_each_registered_metric() -> None:
    page = runpy.run_path(str(ROOT / "tools" / "reference.py"))["metrics_page"]()
    for name in registry.names("metric"):
        quantity = registry.make("metric", name).quantity
        assert f"| `{name}` | `{quantity.column}` | {quantity.unit} |" in page
        assert quantity.meaning in page


def test_descriptions_fall_back_to_the_name() -> None:
    quantity = Fine().quantity
    assert (quantity.words, quantity.heading) == ("fine", "fine")
    assert quantity.summary_column("mean") == "fine_mean_s"
    assert Energy().quantity.heading == "energy [J]"
