"""Print constraints that pin every dependency to its lowest version in pyproject.toml.

`make test-lowest` installs these versions and runs the tests, which shows that the
lower bounds work. This script runs before anything is installed, so it needs only
Python.

    python tools/lowest.py [PYPROJECT] > constraints.txt
"""

import re
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).parents[1]
# Extras that tests need or use if installed; not those that only check the sources.
EXTRAS = ("dask", "geo", "test")


def lowest(requirements: Iterable[str]) -> dict[str, str]:
    """Read the lower bounds of requirements.

    Args:
        requirements: requirements such as `numpy>=2.1` or
            `jsonargparse[signatures]>=4.49`.

    Returns:
        Versions by name of the package, without extras.

    Raises:
        ValueError: If a requirement has no lower bound, or a package has two.
    """
    versions: dict[str, str] = {}
    for requirement in requirements:
        match = re.fullmatch(
            r"([A-Za-z0-9._-]+)(?:\[[^\]]*\])?\s*>=\s*([0-9][0-9.]*)(?:\s*,.*)?",
            requirement,
        )
        if match is None:
            raise ValueError(
                "Expected a requirement with a lower bound, such as numpy>=2.1, got "
                f"{requirement!r}."
            )
        name, version = match.groups()
        if versions.setdefault(name, version) != version:
            raise ValueError(
                f"Expected one lower bound of {name}, got {versions[name]} and {version}."
            )
    return versions


def read_requirements(pyproject: Path) -> list[str]:
    """Return the requirements of the package and of the extras that tests use."""
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
