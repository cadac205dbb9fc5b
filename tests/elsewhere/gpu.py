"""What a GPU computes is what the CPU does, but for the last bits; where there is one."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchnav.core.registry import names
from tests.elsewhere.units import made, run_here, unit_of

HORIZON = {"samples": 200, "horizon_s": 2.0, "cost_to_go": "expected-time"}
ON_COST = HORIZON | {"risk_on": "cost", "level": 0.8, "fields": 50}
HOLDS = {"noise": "frozen", "immobile": {"below": 0.2, "for_s": 0.5}}

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")


@pytest.mark.parametrize(
    "changes",
    [
        *({"planners": (name,)} for name in names("planner") if name != "near_optimal"),
        {"planners": ("near_optimal",), "model": "clairvoyant", "world": HOLDS},
        {
            "planners": ({"part": "optimal", "options": {"hazard": True}},),
            "world": HOLDS,
        },
        {"planners": ({"part": "mppi", "options": ON_COST},), "world": HOLDS},
        {
            "planners": ({"part": "mppi", "options": ON_COST | {"entrapment": True}},),
            "world": HOLDS,
        },
        {
            "planners": ({"part": "mppi", "options": HORIZON | {"entrapment": True}},),
            "world": HOLDS,
        },
        {
            "planners": ({"part": "astar_mppi", "options": {"mppi": ON_COST}},),
            "world": HOLDS,
        },
        {"planners": ("astar_dwa",), "risks": ("time-cvar:0.5",)},
        {
            "planners": ("astar_dwa",),
            "sensors": ("near:8",),
            "beliefs": ("copula",),
            "world": HOLDS,
        },
    ],
    ids=str,
)
def test_a_unit_is_the_same_on_a_gpu(
    changes: dict[str, Any], dataset_path: Path, tmp_path: Path
) -> None:
    unit = unit_of(dataset_path, **changes)
    run_here(unit, tmp_path / "here")
    run_here(unit, tmp_path / "there", device="cuda")
    here, there = made(tmp_path / "here"), made(tmp_path / "there")
    assert len(here) > 10
    assert here.keys() == there.keys()
    for name, values in here.items():
        if name.endswith("_ms"):
            continue
        if np.issubdtype(values.dtype, np.floating):
            np.testing.assert_allclose(
                values, there[name], rtol=1e-3, atol=1e-3, err_msg=name
            )
        else:
            np.testing.assert_array_equal(values, there[name], err_msg=name)
