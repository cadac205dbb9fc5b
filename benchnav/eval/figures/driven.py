"""Driven paths of several conditions on the map on which outcomes differ most."""

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure as Drawing

from benchnav.eval.figures.data import RunData
from benchnav.eval.recording import RecordedMap
from benchnav.eval.words import (
    NAMING,
    chosen_in_words,
    contender_names,
    outcome_in_words,
)
from benchnav.viz import drives, maps
from benchnav.viz.figure import Figure
from benchnav.viz.style import (
    LINE_COLOURS,
    ONE_COLUMN_IN,
    TWO_COLUMNS_IN,
    condition_colours,
    line_style,
)

_MAX_PATHS = 8
_GREY_OF_ZERO = 0.35  # grey of λ = 0; white is λ = 1


class DrivenPaths(Figure):
    """Driven paths over the λ field, or over faded terrain if λ was resampled."""

    name = "driven"
    trim = True

    def is_available(self, data: RunData) -> bool:
        """Return whether the run has steps and a stored map."""
        return data.driven is not None

    def caption(self, data: RunData) -> str:
        """Return a caption that names the map and the reason for its choice."""
        assert data.driven is not None
        map_keys = data.driven.ground.about
        rows = data.driven.rows
        reason = "Outcomes do not differ on any map."
        if rows["success"].nunique() > 1:
            reason = "Outcomes differ most on this map."
        n_shown = min(len(rows), _MAX_PATHS)
        template = "{scenario}, map {map}, seed {seed}, realisation {realisation}"
        return (
            f"Driven paths on {template.format(**map_keys)}. "
            f"{reason}{chosen_in_words(n_shown, len(rows))}"
        )

    def draw(self, data: RunData) -> Drawing:
        """Draw at most eight paths, with a legend next to or below the map."""
        driven = data.driven
        assert driven is not None
        ground = driven.ground
        indices = driven.chosen(_MAX_PATHS)
        rows = driven.rows.iloc[indices]
        tracks = [driven.tracks[index] for index in indices]
        height, width = ground.grid.shape
        is_wide = width >= 2 * height
        # The legend is to the right of the map, or below a wide map.
        map_width_in = ONE_COLUMN_IN
        legend_in = 0.0
        if is_wide:
            map_width_in = TWO_COLUMNS_IN
            legend_in = 0.15 * (len(rows) + 4)
        map_height_in = min(map_width_in * height / width, 7.0)
        figure_height_in = map_height_in + legend_in + 0.4
        figsize = (TWO_COLUMNS_IN, figure_height_in)
        figure = Drawing(figsize=figsize, layout="compressed")
        panel = figure.subplots()
        maps.show_map(panel, _backdrop(ground), ground.grid.extent_m)
        labels = rows[[name for name in NAMING if name in rows]]
        names = contender_names(labels.to_dict("records"))
        colours = condition_colours(list(rows["planner"]), LINE_COLOURS)
        for index, row in enumerate(rows.to_dict("records")):
            # Later paths are thinner, so that coinciding paths are all visible.
            thickness = 0.9 + 2.2 * (1 - index / max(len(rows), 2))
            outcome = outcome_in_words(row["outcome"])
            label = f"{names[index]}: {outcome}, {row['end_time_s']:.0f} s"
            look = {"ls": line_style(index), "label": label}
            drives.draw_path(panel, tracks[index], thickness, colours[index], **look)
        drives.mark(panel, "start", tracks[0][0])
        drives.mark(panel, "goal", ground.goal_m)
        maps.name_immobilising(panel, ground.immobilising)
        title = "λ field of the episode; lighter is higher"
        if ground.field is None:
            title = "terrain, faded"
        panel.set(xlabel="x [m]", ylabel="y [m]", title=title)
        maps.frame_map(panel)
        failed = np.flatnonzero(~rows["success"].to_numpy(bool))
        outcomes = [rows["outcome"].iloc[index] for index in failed]
        handles, _ = panel.get_legend_handles_labels()
        for name in dict.fromkeys(map(drives.end_mark, outcomes)):
            words = f"{name}, in the colour of its path"
            handles.append(drives.mark_handle(name, label=words))
        corner = (1.02, 1.01)
        if is_wide:
            corner = (0, -0.18 * width / height)
        panel.legend(
            handles=handles,
            loc="upper left",
            bbox_to_anchor=corner,
            borderaxespad=0,
            ncols=2 if is_wide else 1,
        )
        failed_tracks = [tracks[index] for index in failed]
        failed_colours = [colours[index] for index in failed]
        drives.mark_ends(panel, failed_tracks, outcomes, failed_colours)
        return figure


def _backdrop(ground: RecordedMap) -> np.ndarray:
    """Return the colours of the map below the paths, in [0, 1], shape [H, W, 3]."""
    if ground.field is None:
        return 0.4 * np.moveaxis(ground.rgb, 0, -1) / 255 + 0.6
    values = np.repeat(ground.field[..., None], 3, axis=-1)
    grey = _GREY_OF_ZERO + (1 - _GREY_OF_ZERO) * values
    grey[ground.immobilising] = to_rgb(maps.IMMOBILISING)
    return grey
