"""Prints constraints that hold every dependency at the lowest version that
pyproject.toml allows.

`make test-lowest` installs these and runs the tests, so that the lower bounds are
versions that really work. It needs nothing but Python itself, since it runs before
anything is installed.

    python tools/lowest.py [PYPROJECT] > constraints.txt
"""

import re
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).parents[1]
# What tests need, and what they try where it is there; not what only checks the
# sources.
EXTRAS = ("dask", "geo", "test")


def lowest(requirements: Iterable[str]) -> dict[str, str]:
    """Reads the lower bounds of requirements.

    Args:
        requirements: such as `numpy>=2.1` or `jsonargparse[signatures]>=4.49`.

    Returns:
        Versions by name, without extras.

    Raises:
        ValueError: a requirement has no lower bound, or one package has two.
    """
    found: dict[str, str] = {}
    for requirement in requirements:
        read = re.fullmatch(
            r"([A-Za-z0-9._-]+)(?:\[[^\]]*\])?\s*>=\s*([0-9][0-9.]*)(?:\s*,.*)?",
            requirement,
        )
        if read is None:
            raise ValueError(
                "Expected a requirement with a lower bound, such as numpy>=2.1, got "
                f"{requirement!r}."
            )
        name, version = read.groups()
        if found.setdefault(name, version) != version:
            raise ValueError(
                f"Expected one lower bound of {name}, got {found[name]} and {version}."
            )
    return found


def read_requirements(pyproject: Path) -> list[str]:
    """The requirements of the package and of the extras that tests use."""
    project = tomllib.loads(pyproject.read_text())["project"]
    extras = (project["optional-dependencies"][name] for name in EXTRAS)
    return [
        *project["dependencies"],
        *(requirement for extra in extras for requirement in extra),
    ]


if __name__ == "__main__":
    pyproject = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "pyproject.toml"
    try:
        versions = lowest(read_requirements(pyproject))
    except (OSError, KeyError, ValueError) as error:
        sys.exit(f"{pyproject}: {error}")
    for name, version in versions.items():
        print(f"{name}=={version}")
