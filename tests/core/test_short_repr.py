"""Public values tell what they hold in at most six lines."""

import re
from dataclasses import dataclass, field

import pytest
import torch

from benchnav.core.batch import Batch
from benchnav.core.short_repr import MAX_LINES, short_repr
from benchnav.datagen import TerrainDataset, find_dataset, load_recipe
from benchnav.eval import Suite
from benchnav.models import find_checkpoint, load_checkpoint, load_model, predict
from benchnav.planning import Copula, Plan, World
from tests import factories


@dataclass(frozen=True, kw_only=True)
class Pair(Batch):
    first: torch.Tensor
    second: torch.Tensor | None = None
    names: tuple[str, ...] = ()
    hidden: int = field(default=1, repr=False)


def test_tensors_are_shown_by_dtype_and_shape_and_the_rest_by_value_or_size() -> None:
    assert repr(Pair(first=torch.zeros(2, 3))) == "Pair(first float32 [2, 3], names=())"
    many = Pair(
        first=torch.zeros(1, dtype=torch.int64), names=tuple("abcdefghijklmnop")
    )
    assert repr(many) == "Pair(first int64 [1], names tuple of 16)"
    assert "hidden" not in repr(many)


def test_a_field_stays_on_one_line_and_lines_are_few() -> None:
    values = {f"field_{i}": torch.zeros(2, 3) for i in range(60)}
    Wide = dataclass(
        type("Wide", (), {"__annotations__": dict.fromkeys(values, torch.Tensor)})
    )
    shown = short_repr(Wide(**values))
    assert len(shown.splitlines()) == MAX_LINES
    assert shown.endswith(", …)")
    named = [
        part.strip() for part in re.split(r",\s+(?=field_)", shown.removesuffix(", …)"))
    ]
    assert all(part.endswith(" float32 [2, 3]") for part in named)


@pytest.mark.parametrize(
    "name",
    [
        "terrain",
        "observation",
        "distribution",
        "dataset",
        "recipe",
        "checkpoint",
        "rest",
    ],
)
def test_public_values_are_short(name: str) -> None:
    dataset = TerrainDataset(find_dataset("stakes-v1"))
    terrain = dataset.terrain("test/std", [0])
    values = {
        "terrain": [terrain],
        "observation": [terrain.observe()],
        "distribution": [predict(load_model("oracle"), terrain)],
        "dataset": [dataset],
        "recipe": [load_recipe("full-v1")],
        "checkpoint": [
            load_checkpoint(find_checkpoint("stakes-v1")),
            load_model("stakes-v1"),
        ],
        "rest": [
            Suite(),
            World.stakes(),
            Copula(),
            Plan.empty(2),
            factories.problem(torch.full((1, 16, 16), 0.8)),
        ],
    }[name]
    for value in values:
        assert len(repr(value).splitlines()) <= MAX_LINES
        assert len(repr(value)) <= 700
