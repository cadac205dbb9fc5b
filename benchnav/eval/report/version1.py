"""Run folders of benchnav 0.1 (format version 1) as format version 2 would hold them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

# 0.1 knew one robot, and its roughness was a change a step of it.
_DT_S = 0.1
_NOISES = {"frozen": "stored"}


def convert_rows(episodes: pd.DataFrame, about: Mapping[str, Any]) -> pd.DataFrame:
    """Gives rows of version 1 the columns of version 2.

    Args:
        episodes: `episodes.parquet` as 0.1 wrote it.
        about: the `run.json` beside it.

    Returns:
        New rows, in the same order; NaN in what 0.1 did not measure.
    """
    suite, world = about["suite"], _world(about)
    trial = episodes["planner"] + "+" + episodes["risk"] + "+" + episodes["scenario"]
    return episodes.drop(columns="roughness").assign(
        trial=trial, data=about["dataset"]["id"], model=suite["model"], robot="unicycle",
        objective="goal_distance", world=world["label"], seed=suite["seed"], realisation=0, score=np.nan,
        roughness_radps2=episodes["roughness"] / _DT_S, planning_ms=np.nan,
        planning_ms_p95=np.nan, planning_start_ms=np.nan, compiled=np.nan, error="",
    )  # fmt: skip


def convert_about(about: Mapping[str, Any], episodes: pd.DataFrame) -> dict[str, Any]:
    """Gives what the report asks of `run.json`: trials by id, and the commands.

    Args:
        about: `run.json` as 0.1 wrote it.
        episodes: from `convert_rows`.
    """
    world = _world(about)
    value = {"world": {"noise": world["noise"], "time_budget_s": world["time_budget_s"]}}
    remark = "0.1 called every robot that stood still stuck, also where it did not drive"
    options = about["suite"]["planner_options"]
    trials = {
        trial: {
            "value": value,
            "labels": {"world": world["label"], "planner": planner},
            "follows": "",
            "remarks": [remark],
            "changed": [f"{name} = {setting}" for name, setting in options.get(planner, {}).items()],
            "seeds": [about["suite"]["seed"]],
        }
        for trial, planner in episodes[["trial", "planner"]].drop_duplicates().itertuples(index=False)
    }
    return {"trials": trials, "commands": [about["command"]]}


def _world(about: Mapping[str, Any]) -> dict[str, Any]:
    noise, time_budget_s = about["suite"]["noise"], about["suite"]["time_budget_s"]
    noise = _NOISES.get(noise, noise)
    changes = [f"noise={noise}"] if noise != "resampled" else []
    changes += [f"time_budget_s={time_budget_s:g}"] if time_budget_s != 100 else []
    return {"noise": noise, "time_budget_s": time_budget_s, "label": " ".join(["paper", *changes])}
