"""Where the shipped maps and models are: inside an installed wheel, and beside the
package in a checkout.

`setup.py` puts them into the wheel, under `_shipped`. In a checkout, and where it is
installed as editable, that folder is not there, and they are read from `datasets/` and
`checkpoints/` of the repository.
"""

from pathlib import Path
from typing import Literal

PACKAGE = Path(__file__).parents[1]


def shipped_folder(kind: Literal["datasets", "checkpoints"]) -> Path:
    """The folder of what is shipped of a kind; of an incomplete copy of the package it
    may be missing.
    """
    inside = PACKAGE / "_shipped"
    return (inside if inside.is_dir() else PACKAGE.parent) / kind
