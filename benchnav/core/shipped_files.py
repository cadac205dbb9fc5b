"""Locations of the shipped maps and models.

`setup.py` copies them into the wheel, under `_shipped`. A checkout or an editable
installation has no such folder, and reads them from `datasets/` and `checkpoints/` of
the repository.
"""

from pathlib import Path
from typing import Literal

PACKAGE = Path(__file__).parents[1]


def shipped_folder(kind: Literal["datasets", "checkpoints"]) -> Path:
    """Return the folder of shipped files, which may be missing in an incomplete copy."""
    inside = PACKAGE / "_shipped"
    return (inside if inside.is_dir() else PACKAGE.parent) / kind
