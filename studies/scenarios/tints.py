"""One map under the tints that docs/studies/scenarios.md shows."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchnav.datagen.recipe.recipe import load_recipe, recipe_from_dict
from benchnav.datagen.synth.generate import generate
from benchnav.viz.maps import frame_map, show_map
from benchnav.viz.style import styled
from studies.study import Work

EXAMPLE = 13  # of test/std, as in the other figures of the page
RAIN = {
    "classes": ["wet_clay", "packed_soil", "loose_soil", "fine_sand"],
    "colour": [36, 30, 26],
    "share": 0.5,
}
SCENARIOS: dict[str, Any] = {
    "std": {"preset": "std"},
    "wet": {"preset": "wet"},
    "tint of soil and sand": {"preset": "std", "tints": [RAIN]},
    "snow, severity 0.5": {"preset": "snow", "severity": 0.5},
    "snow": {"preset": "snow"},
}


@styled()
def draw(work: Work, folder: Path) -> dict[str, Figure]:
    """Draw the picture of one map in each scenario."""
    data = load_recipe("shift-v1").to_dict()
    figure = Figure(figsize=(7.2, 1.75), layout="compressed")
    panels = figure.subplots(1, len(SCENARIOS), sharey=True)
    for panel, (title, entry) in zip(panels, SCENARIOS.items(), strict=True):
        splits = {"test/std": {"scenario": "one", "maps": EXAMPLE + 1}}
        recipe = recipe_from_dict(data | {"scenarios": {"one": entry}, "splits": splits}, title)
        maps = generate(recipe, "test/std", np.array([EXAMPLE]))
        show_map(panel, np.moveaxis(maps["rgb"][0], 0, -1), recipe.grid.extent_m)
        frame_map(panel)
        panel.set(title=title, xticks=(0, 16, 32), yticks=(0, 16, 32), xlabel="x [m]")
    panels[0].set_ylabel("y [m]")
    return {"tints": figure}
