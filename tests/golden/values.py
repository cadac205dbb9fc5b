"""Freeze recipes, weights and predictions as digests.

python -m tests.golden.values    # writes tests/golden/values.json
"""

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import load_file

from benchnav.core import registry
from benchnav.datagen import (
    TerrainDataset,
    find_dataset,
    generate,
    load_recipe,
    shipped_recipes,
)
from benchnav.models import load_model, predict
from tests.golden.rows import ROOT, machine

STORED = Path(__file__).parent / "values.json"
MAPS = np.arange(2)
RECIPES = ("paper-v1", "shift-v1", "stakes-v1", "tiny-v1", "vegetation-v1")
# Each model with the shipped maps that it predicts.
MODELS = {
    "paper-v1": "paper-v1",
    "stakes-v1": "stakes-v1",
    "stakes-v1-masked": "stakes-v1",
    "oracle": "stakes-v1",
}
MODELS |= {"ideal": "stakes-v1"}
RISKS = (
    "mean",
    "var:0.9",
    "cvar:0.9",
    "expected-time",
    "time-cvar:0.8",
    "chance",
    "single-class",
)


def recipe_digests() -> dict[str, str]:
    """Digest the first maps of each split of the shipped recipes."""
    digests = {}
    for name in RECIPES:
        recipe = load_recipe(name)
        for split in recipe.splits:
            maps = generate(recipe, split, MAPS)
            digests[f"{name} {split}"] = _digest(maps[field] for field in sorted(maps))
    return digests


def weight_digests() -> dict[str, str]:
    """Digest the tensors of the shipped checkpoints, with their names."""
    digests = {}
    for path in sorted((ROOT / "checkpoints").glob("*/*.safetensors")):
        tensors = load_file(path)
        names = np.array(sorted(tensors))
        digests[f"{path.parent.name}/{path.name}"] = _digest(
            [names, *(tensors[name] for name in names)]
        )
    return digests


def prediction_digests() -> dict[str, str]:
    """Digest λ̂ of the shipped models on shipped maps, under each risk measure that the
    model has.
    """
    digests = {}
    for name, data in MODELS.items():
        terrain = TerrainDataset(find_dataset(data)).terrain("test/std", MAPS)
        distribution = predict(load_model(name), terrain)
        for risk in RISKS:
            measure = registry.make("risk", risk)
            digests[f"{name} {risk}"] = _digest([measure(distribution).numpy()])
    return digests


def compute() -> dict[str, dict[str, str]]:
    """Compute all digests with one thread, whose sums have one order."""
    torch.set_num_threads(1)
    return {
        "recipes": recipe_digests(),
        "weights": weight_digests(),
        "predictions": prediction_digests(),
    }


def _digest(arrays: Iterable[np.ndarray]) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


if __name__ == "__main__":
    assert set(RECIPES) <= set(shipped_recipes())
    STORED.write_text(json.dumps({"machine": machine(), **compute()}, indent=1) + "\n")
    print(f"wrote {STORED}")
