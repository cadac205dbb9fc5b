"""Hand-made rows and recordings."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import torch
from scipy.spatial.transform import Rotation

from benchnav.core.tables import Bold, Table
from benchnav.eval.experiment.condition import LABELS
from benchnav.eval.figures.data import RunData
from benchnav.eval.recorded_plans import KnownMap, drawn_plan, footprint_outline
from benchnav.eval.recording import Recording
from benchnav.eval.stats.best import against_best, privileged_models
from benchnav.eval.stats.summary import summarise
from benchnav.metrics import SHIPPED
from benchnav.planning.robots import SkidSteer

PAPER = {
    "world": {"noise": "resampled", "time_budget_s": 100.0},
    "rules": {
        "free_space": {"by": "risk", "above": 0.3},
        "min_traversability": 0.3,
        "goal_radius_m": 1.0,
    },
}


def condition(
    planner: str = "mppi", risk: str = "cvar", **labels: str
) -> dict[str, str]:
    """Labels of a condition."""
    same = {
        "data": "paper-v1",
        "scenario": "std",
        "world": "paper",
        "robot": "unicycle",
    }
    given = (
        same
        | {
            "objective": "goal_distance",
            "model": "paper-v1",
            "planner": planner,
            "risk": risk,
        }
        | labels
    )
    unused = {
        "sensor": given["model"] == "–",
        "ground": True,
        "belief": given["risk"] == "–",
    }
    defaults = {"sensor": "full", "ground": "contact", "belief": "static"}
    return {
        name: "–" if unused[name] else default for name, default in defaults.items()
    } | given


def row(
    labels: dict[str, str],
    map_index: int = 0,
    time_s: float | None = 30.0,
    **changes: Any,
) -> dict[str, Any]:
    """An episode; a time of None is a timeout."""
    success = time_s is not None
    drive = {
        "success": success, "total_time_s": time_s if success else 100.0,
        "end_time_s": time_s if success else 100.0, "traversability": 0.8, "reference_time_s": 25.0,
        "time_ratio": time_s / 25 if success else np.nan, "score": 12.5 / time_s if success else 0.0,
        "path_length_m": 22.0, "stuck_share": 0.1, "roughness_radps2": 2.0, "planning_ms": 1.0,
        "planning_ms_p95": 3.0, "planning_start_ms": 9.0, "rejected_draws": 0,
    }  # fmt: skip
    made: dict[str, Any] = {
        "condition": "+".join(labels[name] for name in LABELS), **labels, "seed": 0, "realisation": 0,
        "map": map_index, "group": map_index, "outcome": "success" if success else "timeout",
        **{metric.column: drive.get(metric.column, np.nan) for metric in SHIPPED},
        "compiled": True, "error": "", "code": "c",
    }  # fmt: skip
    return made | changes


def rows(*episodes: dict[str, Any] | Iterable[dict[str, Any]]) -> pd.DataFrame:
    """A table of episodes."""
    flat = [
        e for group in episodes for e in ([group] if isinstance(group, dict) else group)
    ]
    return pd.DataFrame(flat)


def conditions(
    episodes: pd.DataFrame, **notes: dict[str, Any]
) -> dict[str, dict[str, Any]]:
    """What `run.json` says of the conditions; `follows` and `remarks` by planner."""
    return {
        name: {
            "value": PAPER | _parts(group),
            "labels": {label: group[label].iloc[0] for label in LABELS},
        }
        | {
            "follows": "",
            "remarks": [],
            "changed": [],
            "seeds": sorted(set(group["seed"].tolist())),
        }
        | notes.get(group["planner"].iloc[0], {})
        for name, group in episodes.groupby("condition", sort=False)
    }


def _parts(rows: pd.DataFrame) -> dict[str, Any]:
    """Model, planner and risk by their labels; of planners that look at nothing, the
    stand-in.
    """
    labels = rows[["model", "planner", "risk"]].iloc[0].to_dict()
    if labels["model"] == "–":
        labels["model"] = "oracle"
    return {kind: {"part": label, "options": {}} for kind, label in labels.items()}


def bold_cells(table: Table) -> set[tuple[int, int]]:
    """Row and column of what is set in bold."""
    return {
        (place, column)
        for place, row in enumerate(table.rows)
        for column, cell in enumerate(row)
        if isinstance(cell, Bold)
    }


def summarised(
    episodes: pd.DataFrame, world: dict[str, Any] = PAPER["world"]
) -> pd.DataFrame:
    """A row a condition, all of one world."""
    return summarise(episodes, dict.fromkeys(episodes["condition"].unique(), world))


def summary(episodes: pd.DataFrame) -> pd.DataFrame:
    """What a report makes of rows."""
    table = summarised(episodes)
    return table.merge(
        against_best(episodes, table, privileged_models(conditions(episodes))),
        on="condition",
    )


def run_data(summary: pd.DataFrame | None = None, **more: Any) -> RunData:
    """What figures are drawn from."""
    nothing = pd.DataFrame()
    given = {
        "about": {},
        "summary": nothing if summary is None else summary,
        "episodes": nothing,
    }
    return RunData(**(given | more))


def recording(
    steps: int = 200,
    dt_s: float = 0.1,
    labels: dict[str, str] | None = None,
    **changes: Any,
) -> Recording:
    """An episode on a map that is not square, of a robot with five states and two
    actions.
    """
    labels = labels or condition()
    generator = np.random.default_rng(3)
    x = 2 + np.arange(steps + 1) * dt_s
    states = np.stack((x, 3 + 0.5 * x, np.full(steps + 1, 0.46)), axis=1)
    states = np.concatenate((states, np.zeros((steps + 1, 2))), axis=1).astype(
        np.float32
    )
    predicted = generator.random((40, 60)).astype(np.float32) ** 0.5
    made: dict[str, Any] = {
        "about": {"condition": "t", **labels, "seed": "0", "realisation": "0", "map": "4", "outcome": "success"},
        "resolution_m": 0.5, "rgb": (255 * generator.random((3, 40, 60))).astype(np.uint8),
        "elevation_m": generator.random((40, 60)).astype(np.float32), "predicted": predicted,
        "true_mean": generator.random((40, 60)).astype(np.float32), "time_budget_s": 100.0,
        "free": predicted > 0.3, "free_by": "risk", "free_above": 0.3, "field": None, "soft": np.zeros((40, 60), bool),
        "immobilising": np.zeros((40, 60), bool), "goal_m": np.array([24.0, 15.0], np.float32), "dt_s": dt_s,
        "action_names": ("speed_mps", "steering_rad"),
        "states": states, "actions": generator.random((steps, 2)).astype(np.float32),
        "traversability": generator.random(steps).astype(np.float32),
        "plans": [plan(step, states[min(step, steps)]) for step in range(0, max(steps, 1), 5)],
    }  # fmt: skip
    return Recording(**(made | changes))


def held_recording(steps: int = 80, **changes: Any) -> Recording:
    """An episode on λ that stays, of a robot that was immobilised; no map of it is like
    another's mirror.
    """
    generator = np.random.default_rng(4)
    field = generator.random((40, 60)).astype(np.float32)
    about = {
        "condition": "t",
        **condition(world="stakes"),
        "seed": "0",
        "realisation": "0",
        "map": "4",
    }
    ground = {
        "field": field,
        "soft": generator.random((40, 60)) < 0.2,
        "immobilising": field < 0.15,
    }
    return recording(
        steps, **({"about": about | {"outcome": "immobilised"}} | ground | changes)
    )


def learning_recording(steps: int = 80, every: int = 5, **changes: Any) -> Recording:
    """An episode of a robot that learns twice a second: it sees 6 m and senses λ within
    2 m.
    """
    recording = held_recording(steps, **changes)
    return replace(recording, known=known_maps(recording, range(0, steps + 1, every)))


def known_maps(recording: Recording, steps: Iterable[int]) -> tuple[KnownMap, ...]:
    """What a robot knows that believes in the field where it sensed it, and knows
    little elsewhere.
    """
    rows, columns = np.mgrid[:40, :60]
    known, seen, sensed = [], np.zeros((40, 60), bool), np.zeros((40, 60), bool)
    assert recording.field is not None
    for step in steps:
        x, y = recording.states[step, :2] / 0.5
        away_m = 0.5 * np.hypot(columns + 0.5 - x, rows + 0.5 - y)
        seen, sensed = seen | (away_m < 6), sensed | (away_m < 2)
        mean = np.where(sensed, recording.field, 0.6).astype(np.float16)
        known.append(
            KnownMap(
                step=step, predicted=(0.8 * mean).astype(np.float16), free=mean > 0.3, mean=mean,
                spread=np.where(sensed, 0, 0.3).astype(np.float16), seen=seen, sensed=sensed,
                outline=footprint_outline(away_m < 2, 0.5),
            )
        )  # fmt: skip
    return tuple(known)


def plan(step: int, state: np.ndarray) -> Any:
    """A plan of 20 points ahead, with a reference that has two unused ones, and three
    samples.
    """
    ahead = torch.tensor(state[:2]) + torch.linspace(0, 4, 20)[:, None] * torch.tensor(
        [0.9, 0.45]
    )
    reference = torch.cat((ahead, torch.full((2, 2), torch.nan)))
    spread = torch.stack(
        [ahead + torch.linspace(0, 1, 20)[:, None] * k for k in (-1.0, 0.5, 1.0)]
    )
    layers = {"path": ahead[None], "samples": spread, "reference": reference[None]}
    return drawn_plan(step, layers | {"tree": torch.empty(0, 0, 2)})


def body_recording(
    steps: int = 80, ruts: bool = True, rigid: bool = True, **changes: Any
) -> Recording:
    """An episode of a skid-steered robot: with `rigid`, of a body that tilts more and
    more; with `ruts`, the ruts of its second and third wheel deepen to 5 and 2.5 cm.
    """
    taken = held_recording(steps, **changes)
    states = torch.from_numpy(taken.states[:, :3])
    contacts = SkidSteer().footprint.contacts(states).flatten(1, 2).numpy()
    body = {"contacts_m": contacts}
    if rigid:
        tilt = np.linspace(0, 0.3, steps + 1)
        angles = np.stack((states[:, 2].numpy(), tilt, 0.5 * tilt), axis=1)
        rotation = Rotation.from_euler("ZYX", angles)
        wheels = np.array([(a, b, 0) for a in (0.25, -0.25) for b in (0.25, -0.25)])
        position = np.concatenate((states[:, :2], 1 + tilt[:, None]), axis=1)
        placed = [position + rotation.apply(wheel) for wheel in wheels]
        body |= {
            "position_m": position,
            "rotation": np.roll(rotation.as_quat(), 1, axis=1),
            "wheels_m": np.stack(placed, axis=1),
            "wheel_radius_m": np.full((steps + 1, 4), 0.165),
        }
    if ruts:
        deepest = np.linspace(0, 0.05, steps + 1)[:, None]
        body["ruts_m"] = deepest * np.array([0, 1, 0.5, 0])
    body = {name: values.astype(np.float32) for name, values in body.items()}
    return replace(taken, body=body)
