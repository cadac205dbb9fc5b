"""Measures the series of shifts `shift-v1` for docs/studies/scenarios.md: its tables and its figures.

    .venv/bin/python benchmarks/scenarios.py

takes some minutes on one thread, prints the tables and writes them between the markers of
docs/studies/scenarios.md, and draws docs/figures/scenarios-*.png. Every statistic is a function of means
over maps, so that one bootstrap over maps gives the standard error of each. Letters in shapes: B
maps, H×W cells, C classes, K numbers a map.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from textwrap import indent
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchnav.core import rng
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Observation
from benchnav.datagen.recipe.latent import latent_mean, latent_std
from benchnav.datagen.recipe.recipe import Recipe, load_recipe, recipe_from_dict
from benchnav.datagen.synth.generate import generate
from benchnav.models.checkpoint import load_checkpoint
from benchnav.models.fused import FusedModel
from benchnav.models.predictor import find_checkpoint
from benchnav.models.quality.measure import pit

DOCS, MODEL = Path(__file__).parents[1] / "docs", "paper-v1"
RESAMPLES, PAIRED_MAPS, CHUNK_MAPS, EXAMPLE = 1000, 200, 20, 13
BEYOND: dict[str, Any] = {f"{preset}-150": {"preset": preset, "severity": 1.5} for preset in ("hg", "hs")}
PAIRS: dict[str, Any] = {
    "std": {"preset": "std"},
    "hg-050": {"preset": "hg", "severity": 0.5},
    "hg-100": {"preset": "hg"},
    "hg-100, craters alone": {"preset": "hg", "relief_m": [1.4, 1.7]},
    "hg-100, relief alone": {"preset": "hg", "crater_count": [0, 0]},
    "hs-050": {"preset": "hs", "severity": 0.5},
    "hs-100": {"preset": "hs"},
}
SLOPE_EDGES, SHARE_EDGES = np.linspace(0, 60, 6001), np.linspace(0, 1, 2001)
COLOURS = {"std": "#222222", "hg": "#D55E00", "hs": "#0072B2"}  # of Okabe and Ito, distinct for everyone
SIZES = {
    "font.size": 8,
    "axes.titlesize": 8,
    "legend.fontsize": 7,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
}
NOTE: dict[str, Any] = {"fontsize": 7, "color": "0.35"}

Maps = Mapping[str, np.ndarray]
Statistic = Callable[[np.ndarray], np.ndarray]
Columns = Mapping[str, Callable[[Maps], str]]


def measure(model: FusedModel, recipe: Recipe, maps: Maps) -> dict[str, np.ndarray]:
    """Measures ground and prediction: numbers a map by name, shape [B], [B, K] or [B, *, H, W]."""
    pieces = []
    for start in range(0, len(maps["rgb"]), CHUNK_MAPS):
        chunk = {name: values[start : start + CHUNK_MAPS] for name, values in maps.items()}
        pieces.append(_measure_chunk(model, recipe, chunk))
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


def _measure_chunk(model: FusedModel, recipe: Recipe, maps: Maps) -> dict[str, np.ndarray]:
    slope, ids, count = maps["slope_deg"].astype(np.float64), maps["class_id"], len(recipe.classes)
    latent = latent_mean(ids, slope, recipe.classes), latent_std(ids, recipe.classes)
    mean, std = (torch.from_numpy(values)[:, None] for values in latent)
    expected = TraversabilityMixture(torch.ones_like(mean), mean, std).mean()
    rgb, elevation, inclination = (torch.from_numpy(maps[k]) for k in ("rgb", "elevation_m", "slope_deg"))
    predicted = model.predict(Observation(rgb, elevation, inclination, recipe.grid))
    classes, found = torch.from_numpy(ids.astype(np.int64)), predicted.weights.argmax(1)
    own = torch.nn.functional.one_hot(classes, count).movedim(-1, 1).to(predicted.weights)
    result = {
        "rgb": maps["rgb"],
        "brightness": maps["rgb"].sum(1) / np.array([sum(c.colour) for c in recipe.classes])[ids],
        "relief": np.ptp(maps["elevation_m"], axis=(1, 2)),
        "slope": histogram(slope, SLOPE_EDGES),
        "slope_deg": slope,
        "lambda": histogram(maps["traversability"], SHARE_EDGES),
        "expected": expected.numpy(),
        "stuck": (expected <= recipe.stuck_threshold).double().numpy(),
        "time": maps["reference_time_s"],
        "weights": predicted.weights.numpy(),
        "right": (found == classes).double().numpy(),
        "darker": (found < classes).numpy(),
        "confusion": histogram((classes * count + found).numpy(), np.arange(count**2 + 1) - 0.5),
    }
    sources = {"predicted": predicted.weights, "true": own, "none": torch.full_like(own, 1 / count)}
    for name, weights in sources.items():
        mixture, draws = replace(predicted, weights=weights), rng.generator(rng.stream_key(0, "docs", "pit"))
        place = pit(mixture, torch.from_numpy(maps["traversability"]), draws).numpy()
        result[f"held {name}"], result[f"tail {name}"] = np.abs(place - 0.5) <= 0.45, place < 0.1
        result[f"error {name}"] = (mixture.mean() - expected).numpy()
        result[f"square {name}"] = result[f"error {name}"] ** 2
    return result


def histogram(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Counts the cells of each map in bins, shape [B, bins]."""
    return np.stack([np.histogram(entry, edges)[0] for entry in values])


def estimate(columns: Sequence[np.ndarray], statistic: Statistic) -> tuple[float, float]:
    """A statistic of means over maps, and its standard error by the bootstrap over maps.

    Args:
        columns: [B], [B, K] or, to be averaged over the cells, [B, H, W]; put side by side.
        statistic: from means [*, K] to values [*].
    """
    flat = [c.reshape(len(c), -1) if c.ndim < 3 else c.mean(axis=(1, 2))[:, None] for c in columns]
    numbers = np.hstack(flat).astype(np.float64)
    maps = len(numbers)
    drawn = rng.uniform(rng.stream_key(0, "docs", "bootstrap"), np.arange(RESAMPLES), (maps,)) * maps
    times = np.stack([np.bincount(row, minlength=maps) for row in drawn.astype(np.int64)])
    return float(statistic(numbers.mean(0))), float(statistic(times @ numbers / maps).std(ddof=1))


def show(columns: Sequence[np.ndarray], statistic: Statistic, scale: float = 1, digits: int = 1) -> str:
    """Writes `value ± standard error`, or the value alone where it cannot vary."""
    value, error = (scale * number for number in estimate(columns, statistic))
    return f"{value:.{digits}f}".replace("-", "−") + (f" ± {error:.{digits}f}" if error > 0 else "")


def first(means: np.ndarray) -> np.ndarray:
    """The first of the means."""
    return means[..., 0]


def ratio(means: np.ndarray) -> np.ndarray:
    """The first of the means over the second."""
    return means[..., 0] / means[..., 1]


def rms(means: np.ndarray) -> np.ndarray:
    """Root mean square from a mean square; over the cells of the second column, if there is one."""
    return np.sqrt(first(means) if means.shape[-1] == 1 else ratio(means))


def excess(means: np.ndarray) -> np.ndarray:
    """By how much the first root mean square exceeds the second, from mean squares."""
    return np.sqrt(means[..., 0]) - np.sqrt(means[..., 1])


def quantile(share: float, edges: np.ndarray) -> Statistic:
    """The statistic that reads a quantile off a histogram."""
    return lambda counts: edges[1 + (counts.cumsum(-1) < share * counts.sum(-1, keepdims=True)).sum(-1)]


def mean_iou(confusion: np.ndarray) -> np.ndarray:
    """Intersection over union, averaged over the classes, from confusion counts [*, C·C]."""
    count = round(confusion.shape[-1] ** 0.5)
    square = confusion.reshape(*confusion.shape[:-1], count, count)
    both = np.diagonal(square, axis1=-2, axis2=-1)
    return (both / (square.sum(-1) + square.sum(-2) - both)).mean(-1)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Lays out a markdown table."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows))


def by_scenario(pairs: Mapping[str, Maps], columns: Columns) -> str:
    """A table with a row a scenario."""
    rows = [[name, *(column(maps) for column in columns.values())] for name, maps in pairs.items()]
    return table(["scenario", *columns], rows)


def ground_columns(steepest: float) -> Columns:
    """The ground itself, whatever model looks at it."""
    return {
        "relief [m]": lambda m: show([m["relief"]], first, digits=2),
        "median slope [°]": lambda m: show([m["slope"]], quantile(0.5, SLOPE_EDGES)),
        "95 % [°]": lambda m: show([m["slope"]], quantile(0.95, SLOPE_EDGES)),
        "beyond [10⁻⁵]": lambda m: show([m["slope_deg"] > steepest], first, 1e5, 0),
        "E[λ]": lambda m: show([m["expected"]], first, digits=3),
        "λ, 5 %": lambda m: show([m["lambda"]], quantile(0.05, SHARE_EDGES), digits=2),
        "stuck [%]": lambda m: show([m["stuck"]], first, 100),
        "time [s]": lambda m: show([m["time"]], first),
        "rejected": lambda m: f"{m['rejected_draws'].sum()}",
    }


def model_columns() -> Columns:
    """The light, what the classifier gets right, and the error of E[λ] by where the classes come from."""
    return {
        "brightness": lambda m: show([m["brightness"]], first, digits=2),
        "accuracy [%]": lambda m: show([m["right"]], first, 100),
        "mIoU [%]": lambda m: show([m["confusion"]], mean_iou, 100),
        "too dark [%]": lambda m: show([m["darker"]], first, 100),
        "no class": lambda m: show([m["square none"]], rms, 1000),
        "predicted": lambda m: show([m["square predicted"]], rms, 1000),
        "true": lambda m: show([m["square true"]], rms, 1000),
        "predicted − true": lambda m: show([m["square predicted"], m["square true"]], excess, 1000),
    }


def calibration_columns(recipe: Recipe) -> Columns:
    """How often realised λ lies in the central 90 % interval, and under VaR 0.9, by source of classes."""
    count, clay = len(recipe.classes), [c.name for c in recipe.classes].index("wet_clay")
    return {
        "coverage, predicted": lambda m: show([m["held predicted"]], first, 100, 2),
        "coverage, true": lambda m: show([m["held true"]], first, 100, 2),
        "tail, predicted": lambda m: show([m["tail predicted"]], first, 100, 2),
        "tail, true": lambda m: show([m["tail true"]], first, 100, 2),
        "bias [10⁻³]": lambda m: show([m["error predicted"]], first, 1000),
        "found wet clay": lambda m: show(
            [m["confusion"][:, clay::count].sum(1) / m["rgb"][0, 0].size], first, 100
        ),
    }


def paired_columns(model: FusedModel, std: Maps) -> Columns:
    """Changes from std on the same maps, and whether ground or picture brings them about."""

    def squares(seen: Maps, ground: Maps) -> np.ndarray:
        layers = (
            torch.from_numpy(seen["weights"]),
            *model.table.lookup(torch.from_numpy(ground["slope_deg"])),
        )
        chunks = zip(*(layer.split(CHUNK_MAPS) for layer in layers), strict=True)
        found = torch.cat([TraversabilityMixture(*chunk).mean() for chunk in chunks])
        return (found.numpy() - ground["expected"]) ** 2

    before = squares(std, std)
    return {
        "E[λ]": lambda m: show([m["expected"] - std["expected"]], first, digits=3),
        "stuck [%]": lambda m: show([m["stuck"] - std["stuck"]], first, 100),
        "accuracy [%]": lambda m: show([m["right"] - std["right"]], first, 100),
        "both": lambda m: show([squares(m, m), before], excess, 1000),
        "ground alone": lambda m: show([squares(std, m), before], excess, 1000),
        "picture alone": lambda m: show([squares(m, std), before], excess, 1000),
        "true classes": lambda m: show([m["square true"], std["square true"]], excess, 1000),
    }


def slope_table(std: Maps, hg: Maps) -> str:
    """Where on the slopes of hg-100 the errors are made."""
    rows = []
    for low, high in pairwise((0, 10, 15, 20, 25, 90)):
        of_std, of_hg = ((low < m["slope_deg"]) & (m["slope_deg"] <= high) for m in (std, hg))
        inside = {name: [hg[name] * of_hg, of_hg] for name in hg if hg[name].shape == of_hg.shape}
        cells = [show([of_std], first, 100, 2), show([of_hg], first, 100, 2)]
        errors = [show(inside[f"square {source}"], rms, 1000) for source in ("predicted", "true")]
        shares = [
            show(inside[key], ratio, k)
            for key, k in (("right", 100), ("error true", 1000), ("tail true", 100))
        ]
        rows.append([f"{low}–{high}", *cells, shares[0], *errors, *shares[1:]])
    head = ("slope [°]", "of std [%]", "of hg-100 [%]", "accuracy [%]")
    return table([*head, "predicted", "true", "bias, true", "tail, true [%]"], rows)


def colour_table(recipe: Recipe) -> str:
    """At which brightness a class looks as the next darker ones: the scale of least squared difference."""
    rows, colours = [], np.array([c.colour for c in recipe.classes], dtype=np.float64)
    for i, (terrain, colour) in enumerate(zip(recipe.classes, colours, strict=True)):
        row = [terrain.name.replace("_", " "), ", ".join(map(str, terrain.colour))]
        for target in (i - 1, i - 2, i - 3):
            scale = colours[target] @ colour / (colour @ colour)
            left = np.abs(scale * colour - colours[target]).max()
            row.append(f"{scale:.2f} (off by {left:.0f})" if target >= 0 else "")
        rows.append(row)
    return table(["class", "colour", "as the next darker", "as the second", "as the third"], rows)


def draw_examples(pairs: Mapping[str, Maps], extent_m: tuple[float, float]) -> Figure:
    """One map in hg, std and hs: its picture, its slope, and the error of its predicted E[λ]."""
    titles = ("hg, severity 1", "hg, severity 0.5", "std (severity 0)", "hs, severity 0.5", "hs, severity 1")
    names = ("hg-100", "hg-050", "std", "hs-050", "hs-100")
    looks = {"slope_deg": ("cividis", 0.0, 25.0, "slope [°]", "max")}
    looks["error predicted"] = ("PuOr", -0.4, 0.4, "error of E[λ]", "both")
    figure = Figure(figsize=(7.2, 4.25), layout="compressed")
    panels = figure.subplots(3, len(names), sharex=True, sharey=True)
    where: dict[str, Any] = {"extent": (0, extent_m[0], 0, extent_m[1]), "origin": "lower"}
    for panel, name, title in zip(panels[0], names, titles, strict=True):
        panel.imshow(np.moveaxis(pairs[name]["rgb"][EXAMPLE], 0, -1), **where)
        panel.set(title=title, xticks=(0, 16, 32), yticks=(0, 16, 32))
    for row, (layer, (colours, low, high, label, extend)) in zip(panels[1:], looks.items(), strict=True):
        for panel, name in zip(row, names, strict=True):
            image = panel.imshow(pairs[name][layer][EXAMPLE], cmap=colours, vmin=low, vmax=high, **where)
        figure.colorbar(image, ax=row, label=label, extend=extend, pad=0.015, aspect=14, extendfrac=0.06)
    for panel in panels[:, 0]:
        panel.set_ylabel("y [m]")
    for panel in panels[-1]:
        panel.set_xlabel("x [m]")
    return figure


def draw_distributions(series: Mapping[str, Maps], steepest: float) -> Figure:
    """Slope, λ and brightness of all cells in std, hg and hs."""
    figure, panels = _three_panels(2.5)
    for name, dashes in (("std", "-"), ("hg-100", "-"), ("hs-100", (0, (4, 1.5)))):
        maps: Maps = series[name]
        look: dict[str, Any] = {"color": COLOURS[name.split("-")[0]], "ls": dashes, "lw": 1.3, "label": name}
        counts = [maps["slope"], maps["lambda"], histogram(maps["brightness"], SHARE_EDGES)]
        slope, traversability, light = (np.r_[0, c.sum(0).cumsum()] / c.sum() for c in counts)
        panels[0].plot(SLOPE_EDGES[slope < 1], 1 - slope[slope < 1], **look)
        panels[1].plot(SHARE_EDGES, traversability, **look)
        panels[2].plot(SHARE_EDGES, light, **look)
    panels[0].axvline(steepest, color="0.5", lw=0.8, ls=":")
    panels[0].text(steepest - 0.4, 0.6, "steepest in training", rotation=90, ha="right", va="top", **NOTE)
    panels[0].set(xlabel="slope ψ [°]", ylabel="share of cells steeper than ψ", yscale="log")
    panels[0].set(xlim=(0, 38), ylim=(1e-5, 1))
    panels[1].set(xlabel="realised traversability λ", ylabel="share of cells at or under λ")
    panels[2].set(xlabel="brightness [share of full light]", ylabel="share of cells at or under it")
    for panel, start in zip(panels[1:], (0, 0.2), strict=True):
        panel.set(xlim=(start, 1), ylim=(0, 1))
    panels[1].legend(frameon=False, loc="upper left")
    return figure


def draw_series(series: Mapping[str, Maps]) -> Figure:
    """Accuracy and error over severity, and the accuracy of each map in low light over its brightness."""
    figure, panels = _three_panels(2.6)
    sources = {"none": ("no class known", "", ":"), "predicted": ("classes predicted", "o", "-")}
    sources["true"] = ("true classes", "s", "--")
    for preset, colour in list(COLOURS.items())[1:]:
        pairs = {0.0: series["std"]} | {_severity(n): m for n, m in series.items() if n.startswith(preset)}
        curves = [(panels[0], [estimate([100 * m["right"]], first) for m in pairs.values()], "o", "-")]
        for source, (_, marker, dashes) in sources.items():
            values = [estimate([m[f"square {source}"]], rms) for m in pairs.values()]
            curves.append((panels[1], values, marker, dashes))
        for panel, values, marker, dashes in curves:
            look = {"color": colour, "marker": marker, "ls": dashes, "label": preset, "mfc": "white"}
            panel.errorbar(list(pairs), *zip(*values, strict=True), lw=1.2, ms=3.5, capsize=2, **look)
    keys = [
        Line2D([], [], color="0.3", mfc="white", ms=3.5, label=n, marker=m, ls=d)
        for n, m, d in sources.values()
    ]
    panels[0].legend(frameon=False, loc="lower left")
    panels[1].legend(handles=keys, frameon=False, loc="upper left", handlelength=2.6)
    dark = [name for name in series if name.startswith("hs")]
    shades = matplotlib.colormaps["viridis_r"](np.linspace(0.1, 1, len(dark)))
    for name, shade in zip(dark, shades, strict=True):
        light, right = (
            np.median(series[name]["brightness"], axis=(1, 2)),
            series[name]["right"].mean(axis=(1, 2)),
        )
        panels[2].plot(light, 100 * right, "o", ms=2.4, mew=0, color=shade, label=f"{_severity(name):g}")
    lit = np.median(series["std"]["brightness"], axis=(1, 2))
    panels[2].axvspan(lit.min(), lit.max(), color="0.88", lw=0)
    panels[2].text(lit.mean(), 4, "light\nof std", ha="center", **NOTE)
    panels[2].legend(frameon=False, loc="upper left", title="severity of hs", title_fontsize=7)
    for panel in panels[:2]:
        panel.set(xlabel="severity", xticks=(0, 0.5, 1, 1.5))
    panels[0].set(ylabel="pixel accuracy [%]", ylim=(0, 100))
    panels[1].set(ylabel="RMS error of E[λ]", ylim=(0, 0.15))
    panels[2].set(xlabel="median brightness of a map", ylabel="pixel accuracy of a map [%]")
    panels[2].set(xlim=(0, 1), ylim=(-2, 100))
    return figure


def _three_panels(height_in: float) -> tuple[Figure, Any]:
    figure = Figure(figsize=(7.2, height_in), layout="constrained")
    panels = figure.subplots(1, 3)
    for panel, letter in zip(panels, "abc", strict=True):
        panel.set_title(f"({letter})", loc="left")
        panel.grid(alpha=0.25, lw=0.5)
        panel.spines[["top", "right"]].set_visible(False)
    return figure, panels


def _severity(name: str) -> float:
    return int(name[-3:]) / 100


def rewrite(path: Path, tables: Mapping[str, str]) -> None:
    """Puts each table between its markers `<!-- NAME -->` and `<!-- end -->` in a document.

    A table in a fold is indented, and there needs empty lines around it.
    """
    text = path.read_text()
    for name, lines in tables.items():
        found = re.search(rf"^( *)<!-- {name} -->\n.*?<!-- end -->", text, re.DOTALL | re.MULTILINE)
        if found is None:
            raise ValueError(f"Expected `<!-- {name} -->` and `<!-- end -->` in {path}. Add them.")
        body = f"\n{lines}\n" if found[1] else lines
        block = indent(f"<!-- {name} -->\n{body}\n<!-- end -->", found[1])
        text = text[: found.start()] + block + text[found.end() :]
    path.write_text(text)


def measure_series(model: FusedModel, recipe: Recipe) -> dict[str, Maps]:
    """Measures the splits of shift-v1 and, made alike, a severity beyond each end, by name of the scenario."""
    data = recipe.to_dict()
    series: dict[str, Maps] = {}
    splits = {f"test/{name}": {"scenario": name, "maps": 100, "solvable": True} for name in BEYOND}
    data |= {"scenarios": data["scenarios"] | BEYOND, "splits": data["splits"] | splits}
    longer = recipe_from_dict(data, "of benchmarks/scenarios.py")
    for split in ["test/std", *sorted(set(longer.splits) - {"test/std"})]:
        spec = longer.splits[split]
        unasked = replace(longer, splits={split: replace(spec, solvable=False)})
        maps, drawn_first = (generate(made, split, np.arange(spec.maps)) for made in (longer, unasked))
        rejected_draws = (maps["elevation_m"] != drawn_first["elevation_m"]).any(axis=(1, 2))
        series[spec.scenario] = measure(model, longer, maps) | {"rejected_draws": rejected_draws}
    return series


def measure_pairs(model: FusedModel, recipe: Recipe) -> dict[str, Maps]:
    """Measures the same maps under several scenarios: all are drawn on the random streams of test/std."""
    pairs: dict[str, Maps] = {}
    for name, entry in PAIRS.items():
        split = {"test/std": {"scenario": name, "maps": PAIRED_MAPS}}
        one = recipe_from_dict(recipe.to_dict() | {"scenarios": {name: entry}, "splits": split}, name)
        pairs[name] = measure(model, one, generate(one, "test/std", np.arange(PAIRED_MAPS)))
    return pairs


def main() -> None:
    """Measures, prints and writes the tables, and draws the figures."""
    torch.set_num_threads(1)
    recipe, checkpoint = load_recipe("shift-v1"), load_checkpoint(find_checkpoint(MODEL))
    model = FusedModel.from_checkpoint(checkpoint)
    steepest = max(checkpoint.part("gp").config["steepest_deg"])
    series, pairs = measure_series(model, recipe), measure_pairs(model, recipe)
    changed = {name: pair for name, pair in pairs.items() if name != "std"}
    tables = {
        "ground": by_scenario(series, ground_columns(steepest)),
        "model": by_scenario(series, model_columns()),
        "calibration": by_scenario(series, calibration_columns(recipe)),
        "pairs": by_scenario(changed, paired_columns(model, pairs["std"])),
        "slopes": slope_table(series["std"], series["hg-100"]),
        "colours": colour_table(recipe),
    }
    for name, lines in tables.items():
        print(f"{name}\n{lines}\n")
    with matplotlib.rc_context(SIZES):  # type: ignore[arg-type]
        figures = {
            "examples": draw_examples(pairs, recipe.grid.extent_m),
            "distributions": draw_distributions(series, steepest),
            "series": draw_series(series),
        }
        for name, figure in figures.items():
            figure.savefig(
                DOCS / f"figures/scenarios-{name}.png",
                dpi=300,
                metadata={"Software": None},
                pil_kwargs={"optimize": True},
            )
    rewrite(DOCS / "studies" / "scenarios.md", tables)


if __name__ == "__main__":
    main()
