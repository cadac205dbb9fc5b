"""How ground that is soft, or that immobilises a robot, is drawn, once for figures and playback.

Letters in shapes: H×W cells, N positions, M lines.
"""

from collections.abc import Mapping

import numpy as np

from benchnav.planning.world.outcome import Outcome

# Dark red lies far from all colours of λ, for the colour-blind too.
IMMOBILISING = (160, 0, 0)
SOFT = (255, 255, 255)

_HATCH_CELLS = 4


def field_colours(field: np.ndarray, immobilising: np.ndarray) -> np.ndarray:
    """Colours λ as it is, and cells that immobilise a robot in a colour of their own.

    Args:
        field: λ in [0, 1], shape [H, W].
        immobilising: bool, shape [H, W].

    Returns:
        Red, green and blue, uint8, shape [H, W, 3].
    """
    import matplotlib  # runs record, and draw nothing

    from benchnav.core.figures import TRAVERSABILITY_COLOURS

    shades = matplotlib.colormaps[TRAVERSABILITY_COLOURS](field)[..., :3]
    colours = np.round(255 * shades).astype(np.uint8)
    colours[immobilising] = IMMOBILISING
    return colours


def outline(region: np.ndarray, resolution_m: float) -> np.ndarray:
    """Finds the edges between cells of a region and those that are not of it, the map's border among them.

    Args:
        region: bool, shape [H, W].
        resolution_m: edge length of a cell.

    Returns:
        Both ends (x, y) of each edge in metres, float32, shape [M, 2, 2].
    """
    framed = np.pad(region, 1)
    rows, columns = np.nonzero(framed[1:, 1:-1] != framed[:-1, 1:-1])
    along_x = np.stack((columns, rows, columns + 1, rows), axis=1)
    rows, columns = np.nonzero(framed[1:-1, 1:] != framed[1:-1, :-1])
    along_y = np.stack((columns, rows, columns, rows + 1), axis=1)
    edges = np.concatenate((along_x, along_y)).reshape(-1, 2, 2)
    return (edges * resolution_m).astype(np.float32)


def hatching(region: np.ndarray, resolution_m: float) -> np.ndarray:
    """Draws diagonals through a region, which tell it from what it surrounds.

    Args:
        region: bool, shape [H, W].
        resolution_m: edge length of a cell.

    Returns:
        Both ends (x, y) of each diagonal of a cell in metres, float32, shape [M, 2, 2].
    """
    rows, columns = np.nonzero(region)
    drawn = (rows - columns) % _HATCH_CELLS == 0
    corners = np.stack((columns[drawn], rows[drawn]), axis=1)
    return (np.stack((corners, corners + 1), axis=1) * resolution_m).astype(np.float32)


def immobilised_at(about: Mapping[str, str], track: np.ndarray) -> np.ndarray | None:
    """Where an episode ended on ground that immobilises a robot, (x, y); None where it ended otherwise.

    Args:
        about: with `outcome`.
        track: driven positions to the end, shape [N, 2].
    """
    return track[-1] if about["outcome"] == Outcome.IMMOBILISED.name.lower() else None
