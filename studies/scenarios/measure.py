"""Measurements of the series of shifts `shift-v1`, for docs/studies/scenarios.md.

Every statistic is a function of means over maps, so one bootstrap over maps gives the
standard error of each. The measurements take some minutes on one thread. Letters in
shapes: B maps, H×W cells, C classes, K numbers per map.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from matplotlib.figure import Figure

from benchnav import Observation, TraversabilityMixture
from benchnav.core import rng
from benchnav.datagen import Recipe, generate, load_recipe, recipe_from_dict
from benchnav.datagen.recipe.latent import latent_mean, latent_std
from benchnav.models import find_checkpoint, load_checkpoint
from benchnav.models.fused import FusedModel
from benchnav.models.quality.measure import pit
from studies.scenarios.figures import draw_distributions, draw_examples, draw_series
from studies.scenarios.statistics import SHARE_EDGES, SLOPE_EDGES, Maps, histogram, show
from studies.study import Rows, Work

MODEL = "paper-v1"
COLUMNS = yaml.safe_load(Path(__file__).with_name("tables.yaml").read_text())
LAYERS = ("rgb", "elevation_m", "slope_deg")  # of an observation, in its order
PAIRED_MAPS, CHUNK_MAPS = 200, 20
BEYOND: dict[str, Any] = {
    f"{preset}-150": {"preset": preset, "severity": 1.5} for preset in ("hg", "hs")
}
PAIRS: dict[str, Any] = {
    "std": {"preset": "std"},
    "hg-050": {"preset": "hg", "severity": 0.5},
    "hg-100": {"preset": "hg"},
    "hg-100, only craters": {"preset": "hg", "relief_m": [1.4, 1.7]},
    "hg-100, only relief": {"preset": "hg", "crater_count": [0, 0]},
    "hs-050": {"preset": "hs", "severity": 0.5},
    "hs-100": {"preset": "hs"},
}


def measure_maps(
    model: FusedModel, recipe: Recipe, maps: Maps
) -> dict[str, np.ndarray]:
    """Measure terrain and predictions of maps.

    Returns:
        Numbers per map by name, of shape [B], [B, K] or [B, *, H, W].
    """
    measured = []
    for start in range(0, len(maps["rgb"]), CHUNK_MAPS):
        indices = slice(start, start + CHUNK_MAPS)
        chunk = {name: values[indices] for name, values in maps.items()}
        measured.append(_measure_chunk(model, recipe, chunk))
    return {
        name: np.concatenate([chunk[name] for chunk in measured])
        for name in measured[0]
    }


def _measure_chunk(
    model: FusedModel, recipe: Recipe, maps: Maps
) -> dict[str, np.ndarray]:
    slope = maps["slope_deg"].astype(np.float64)
    ids = maps["class_id"]
    n_classes = len(recipe.classes)
    mean = torch.from_numpy(latent_mean(ids, slope, recipe.classes))[:, None]
    std = torch.from_numpy(latent_std(ids, recipe.classes))[:, None]
    expected = TraversabilityMixture(torch.ones_like(mean), mean, std).mean()
    layers = (torch.from_numpy(maps[name]) for name in LAYERS)
    predicted = model.predict(Observation(*layers, recipe.grid))
    classes = torch.from_numpy(ids.astype(np.int64))
    predicted_class = predicted.weights.argmax(1)
    pair_id = (classes * n_classes + predicted_class).numpy()
    names = [kind.name for kind in recipe.classes]
    full_light = np.array([sum(kind.colour) for kind in recipe.classes])
    result = {
        "rgb": maps["rgb"],
        "brightness": maps["rgb"].sum(1) / full_light[ids],
        "relief": np.ptp(maps["elevation_m"], axis=(1, 2)),
        "slope": histogram(slope, SLOPE_EDGES),
        "slope_deg": slope,
        "lambda": histogram(maps["traversability"], SHARE_EDGES),
        "expected": expected.numpy(),
        "stuck": (expected <= recipe.stuck_threshold).double().numpy(),
        "time": maps["reference_time_s"],
        "weights": predicted.weights.numpy(),
        "right": (predicted_class == classes).double().numpy(),
        "darker": (predicted_class < classes).numpy(),
        "confusion": histogram(pair_id, np.arange(n_classes**2 + 1) - 0.5),
        "wet clay": (predicted_class == names.index("wet_clay")).numpy(),
    }
    one_hot = torch.nn.functional.one_hot(classes, n_classes).movedim(-1, 1)
    true_weights = one_hot.to(predicted.weights)
    sources = {
        "predicted": predicted.weights,
        "true": true_weights,
        "none": torch.full_like(true_weights, 1 / n_classes),
    }
    realised = torch.from_numpy(maps["traversability"])
    for name, weights in sources.items():
        mixture = replace(predicted, weights=weights)
        draws = rng.generator(rng.stream_key(0, "docs", "pit"))
        transformed = pit(mixture, realised, draws).numpy()
        error = (mixture.mean() - expected).numpy()
        result[f"covered {name}"] = np.abs(transformed - 0.5) <= 0.45
        result[f"tail {name}"] = transformed < 0.1
        result[f"error {name}"] = error
        result[f"square {name}"] = error**2
    return result


def by_scenario(pairs: Mapping[str, Maps], name: str) -> Rows:
    """Return a table with a row per scenario and the columns of `name` in tables.yaml."""

    def cell(maps: Maps, of: Sequence[str], **options: Any) -> str:
        return show([maps[key] for key in of], **options)

    rows = []
    for scenario, maps in pairs.items():
        row = {"scenario": scenario}
        for heading, column in COLUMNS[name].items():
            row[heading] = cell(maps, **column)
        rows.append(row)
    return rows


def changes(model: FusedModel, maps: Maps, std: Maps) -> Maps:
    """Return the changes from std on the same maps.

    Squared errors are split by the source of the picture and of the terrain, each of
    which is either that of std or that of the scenario.
    """

    def squares(picture: Maps, terrain: Maps) -> np.ndarray:
        slope = torch.from_numpy(terrain["slope_deg"])
        weights = torch.from_numpy(picture["weights"])
        layers = (weights, *model.table.lookup(slope))
        chunks = zip(*(layer.split(CHUNK_MAPS) for layer in layers), strict=True)
        expected = torch.cat([TraversabilityMixture(*chunk).mean() for chunk in chunks])
        return (expected.numpy() - terrain["expected"]) ** 2

    return {
        **{key: maps[key] - std[key] for key in ("expected", "stuck", "right")},
        "before": squares(std, std),
        "both": squares(maps, maps),
        "ground": squares(std, maps),
        "picture": squares(maps, std),
        "square true": maps["square true"],
        "true before": std["square true"],
    }


def slope_table(std: Maps, hg: Maps) -> Rows:
    """Return the errors of hg-100 by slope."""
    rows = []
    for low, high in pairwise((0, 10, 15, 20, 25, 90)):
        of_std, of_hg = (
            (low < maps["slope_deg"]) & (maps["slope_deg"] <= high)
            for maps in (std, hg)
        )
        inside = {
            name: [values * of_hg, of_hg]
            for name, values in hg.items()
            if values.shape == of_hg.shape
        }
        rows.append(
            {
                "slope [°]": f"{low}–{high}",
                "of std [%]": show([of_std], scale=100, digits=2),
                "of hg-100 [%]": show([of_hg], scale=100, digits=2),
                "accuracy [%]": show(inside["right"], "ratio", 100),
                "predicted": show(inside["square predicted"], "rms", 1000),
                "true": show(inside["square true"], "rms", 1000),
                "bias, true": show(inside["error true"], "ratio", 1000),
                "tail, true [%]": show(inside["tail true"], "ratio", 100),
            }
        )
    return rows


def colour_table(recipe: Recipe) -> Rows:
    """Return the brightness at which a class has the colour of each darker one.

    The brightness is the factor on its colour with the least squared difference.
    """
    rows = []
    colours = np.array([kind.colour for kind in recipe.classes], dtype=np.float64)
    headings = ("as the next darker", "as the second", "as the third")
    for index, kind in enumerate(recipe.classes):
        colour = colours[index]
        row = {
            "class": kind.name.replace("_", " "),
            "colour": ", ".join(map(str, kind.colour)),
        }
        for steps, heading in enumerate(headings, 1):
            row[heading] = ""
            if steps <= index:
                darker = colours[index - steps]
                scale = darker @ colour / (colour @ colour)
                error = np.abs(scale * colour - darker).max()
                row[heading] = f"{scale:.2f} (off by {error:.0f})"
        rows.append(row)
    return rows


def measure_series(
    model: FusedModel, recipe: Recipe
) -> dict[str, dict[str, np.ndarray]]:
    """Measure the splits of shift-v1 and one further severity beyond each end.

    Returns:
        The measurements by name of the scenario.
    """
    data = recipe.to_dict()
    series: dict[str, dict[str, np.ndarray]] = {}
    splits = {
        f"test/{name}": {"scenario": name, "maps": 100, "solvable": True}
        for name in BEYOND
    }
    data |= {"scenarios": data["scenarios"] | BEYOND, "splits": data["splits"] | splits}
    longer = recipe_from_dict(data, "of the study")
    for split in ["test/std", *sorted(set(longer.splits) - {"test/std"})]:
        spec = longer.splits[split]
        unfiltered = replace(longer, splits={split: replace(spec, solvable=False)})
        indices = np.arange(spec.maps)
        maps = generate(longer, split, indices)
        first_draws = generate(unfiltered, split, indices)
        differs = maps["elevation_m"] != first_draws["elevation_m"]
        measured = measure_maps(model, longer, maps)
        measured["rejected_draws"] = differs.any(axis=(1, 2))
        series[spec.scenario] = measured
    return series


def measure_pairs(model: FusedModel, recipe: Recipe) -> dict[str, Maps]:
    """Measure the same maps under several scenarios.

    The maps are the same since all are drawn from the random streams of test/std.
    """
    pairs: dict[str, Maps] = {}
    for name, entry in PAIRS.items():
        split = {"test/std": {"scenario": name, "maps": PAIRED_MAPS}}
        changes = {"scenarios": {name: entry}, "splits": split}
        variant = recipe_from_dict(recipe.to_dict() | changes, name)
        maps = generate(variant, "test/std", np.arange(PAIRED_MAPS))
        pairs[name] = measure_maps(model, variant, maps)
    return pairs


def measure(work: Work, folder: Path) -> dict[str, Rows | Figure]:
    """Return the tables and the figures of the page."""
    recipe = load_recipe("shift-v1")
    checkpoint = load_checkpoint(find_checkpoint(MODEL))
    model = FusedModel.from_checkpoint(checkpoint)
    steepest = max(checkpoint.part("gp").config["steepest_deg"])
    pairs = measure_pairs(model, recipe)
    series = measure_series(model, recipe)
    for maps in series.values():
        maps["beyond"] = maps["slope_deg"] > steepest
    changed = {
        name: changes(model, maps, pairs["std"])
        for name, maps in pairs.items()
        if name != "std"
    }
    ground = by_scenario(series, "ground")
    for row, maps in zip(ground, series.values(), strict=True):
        row["rejected"] = maps["rejected_draws"].sum()
    return {
        "ground": ground,
        "model": by_scenario(series, "model"),
        "calibration": by_scenario(series, "calibration"),
        "pairs": by_scenario(changed, "pairs"),
        "slopes": slope_table(series["std"], series["hg-100"]),
        "colours": colour_table(recipe),
        "examples": draw_examples(pairs, recipe.grid.extent_m),
        "distributions": draw_distributions(series, steepest),
        "severity": draw_series(series),
    }
