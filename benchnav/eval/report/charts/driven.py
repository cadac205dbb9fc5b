"""The figure of whole driven paths: every setting of a run on one map, the one on which outcomes differ most."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from benchnav.core.errors import ConfigError
from benchnav.core.store import replacing
from benchnav.eval.folder.folder import EPISODES, damaged, read_table
from benchnav.eval.folder.steps import STEPS, read_steps
from benchnav.eval.report.contenders import NAMING, condition_colours, contender_names
from benchnav.eval.report.recorded.ground import IMMOBILISING

if TYPE_CHECKING:  # runs keep the map of the figure, and draw nothing
    from matplotlib.figure import Figure

GROUND = "ground.npz"
# What one map under one draw of λ is known by.
MAP = ("data", "scenario", "world", "seed", "realisation", "map")
MOST_PATHS = 16

_ARRAYS = ("rgb", "immobilising", "goal_m")
_STYLES = ("solid", "dashed")
_DARKEST = 0.35  # grey of λ = 0


@dataclass(frozen=True, kw_only=True)
class DrivenGround:
    """The map of the figure.

    Args:
        about: which map and draw, by the names of `MAP`.
        resolution_m: edge length of a cell.
        rgb: uint8, shape [3, H, W].
        field: λ as it was, shape [H, W]; None where it was resampled.
        immobilising: cells of the field that immobilise a robot, bool, shape [H, W].
        goal_m: (x, y).
    """

    about: Mapping[str, Any]
    resolution_m: float
    rgb: np.ndarray
    field: np.ndarray | None
    immobilising: np.ndarray
    goal_m: np.ndarray

    def save(self, path: Path) -> None:
        """Writes the map, whole or not at all."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        arrays |= {} if self.field is None else {"field": self.field}
        text = json.dumps({"about": dict(self.about), "resolution_m": self.resolution_m})
        with replacing(path) as partial, open(partial, "wb") as file:
            np.savez_compressed(file, scalars=np.array(text), **arrays)

    @classmethod
    def load(cls, path: Path) -> "DrivenGround":
        """Reads what `save` wrote.

        Raises:
            ConfigError: the file is damaged.
        """
        remedy = "Remove it; the run's command makes it again."
        with damaged(path, remedy), np.load(path, allow_pickle=False) as stored:
            scalars = json.loads(str(stored["scalars"]))
            arrays = {name: stored[name] for name in _ARRAYS}
            return cls(**scalars, field=stored.get("field"), **arrays)


def telling_map(episodes: pd.DataFrame) -> dict[str, Any]:
    """Chooses the map and the draw of λ on which about as many conditions succeed as fail.

    Of several such the one that most conditions were run on, then the first.

    Args:
        episodes: rows of a run.

    Returns:
        What the map is known by, by the names of `MAP`.
    """
    groups = episodes.groupby(list(MAP), sort=False)["success"]
    counted = pd.DataFrame({"conditions": groups.size(), "successes": groups.sum()}).reset_index()
    counted["differing"] = np.minimum(counted["successes"], counted["conditions"] - counted["successes"])
    best = counted.sort_values(["differing", "conditions"], ascending=False, kind="stable").iloc[0]
    return {
        name: value.item() if hasattr(value, "item") else value for name, value in best[list(MAP)].items()
    }


def write_driven(folder: Path, out: Path) -> dict[str, str]:
    """Writes the figure of a run that stored the steps it shows; a caption by name, or none.

    Args:
        folder: a finished run.
        out: where `figures/` is.
    """
    path = folder / GROUND
    if not path.exists() or not (folder / STEPS).is_dir():
        return {}
    ground, rows = DrivenGround.load(path), read_table(folder, EPISODES)
    for name in MAP:
        rows = rows[rows[name] == ground.about[name]]
    tracks = {}
    for condition in rows["condition"]:
        place = {name: ground.about[name] for name in ("seed", "realisation", "map")}
        steps = read_steps(folder, condition=condition, **place)
        if len(steps):
            tracks[condition] = steps[["x_m", "y_m"]].to_numpy()
    from benchnav.eval.report.figure_style import save

    shown = rows[rows["condition"].isin(tracks)].iloc[:MOST_PATHS]
    if shown.empty:
        return {}
    save(
        driven_figure(ground, shown, [tracks[condition] for condition in shown["condition"]]),
        out / "figures" / "driven.png",
    )
    about = ground.about
    words = [f"Whole driven paths on {about['scenario']} {about['map']}, seed {about['seed']},"]
    differ = rows["success"].nunique() > 1
    words += [
        f"realisation {about['realisation']}: "
        + (
            "of all maps the one on which outcomes differ most."
            if differ
            else "on no map did outcomes differ."
        )
    ]
    words += [f"{len(shown)} of {len(rows)} conditions."] if len(shown) < len(rows) else []
    return {"driven": " ".join(words)}


def driven_figure(ground: DrivenGround, rows: pd.DataFrame, tracks: Sequence[np.ndarray]) -> "Figure":
    """Draws paths over λ as it was, or over faded terrain where it was resampled.

    Args:
        ground: the map.
        rows: an episode a condition.
        tracks: positions of each, shape [N + 1, 2].
    """
    from matplotlib.figure import Figure

    if rows.empty:
        raise ConfigError("Expected one or more driven paths, got none.")
    high, wide = (count * ground.resolution_m for count in ground.immobilising.shape)
    figure = Figure(figsize=(6.6, max(3.6, min(3.8 * high / wide + 0.3, 7.0))), layout="constrained")
    panel = figure.subplots()
    panel.imshow(_backdrop(ground), origin="lower", extent=(0, wide, 0, high), interpolation="nearest")
    names = contender_names(rows[list(NAMING)].to_dict("records"))
    colours = condition_colours(len(rows))
    for place, (row, track) in enumerate(zip(rows.to_dict("records"), tracks, strict=True)):
        colour = tuple(value / 255 for value in colours[place])
        # Later ones are thinner, so that paths that coincide are all seen.
        width = 3.4 - 2.2 * place / max(len(rows) - 1, 1)
        style = _STYLES[place // 8 % len(_STYLES)]
        outcome = row["outcome"].replace("_", " ")
        panel.plot(*track.T, color="white", lw=width + 1.2, alpha=0.7, zorder=1.5)
        panel.plot(
            *track.T, color=colour, lw=width, ls=style, zorder=2,
            label=f"{names[place]}: {outcome}, {row['end_time_s']:.0f} s",
        )  # fmt: skip
        if not row["success"]:
            panel.plot(*track[-1], "X", color=colour, mec="white", ms=11, zorder=4)
    panel.plot(*tracks[0][0], "o", color="red", mec="white", ms=8, zorder=3, ls="none", label="start")
    panel.plot(*ground.goal_m, "*", color="magenta", mec="white", ms=14, zorder=3, ls="none", label="goal")
    panel.set(
        xlim=(0, wide), ylim=(0, high), aspect="equal", xlabel="x [m]", ylabel="y [m]", title=_title(ground)
    )
    panel.title.set_fontsize(9)
    figure.legend(loc="outside right upper", fontsize=8, frameon=False)
    return figure


def _title(ground: DrivenGround) -> str:
    if ground.field is None:
        return "terrain, faded"
    return "λ as it was: the lighter the faster" + (
        "; dark red immobilises a robot" if ground.immobilising.any() else ""
    )


def _backdrop(ground: DrivenGround) -> np.ndarray:
    """Colours in [0, 1] that paths stand out from, shape [H, W, 3]."""
    if ground.field is None:
        return 0.4 * np.moveaxis(ground.rgb, 0, -1) / 255 + 0.6
    grey = _DARKEST + (1 - _DARKEST) * np.repeat(ground.field[..., None], 3, axis=-1)
    grey[ground.immobilising] = [value / 255 for value in IMMOBILISING]
    return grey
