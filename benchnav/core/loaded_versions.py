"""Versions of installed distributions that are loaded in this process."""

import os
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import lru_cache
from importlib.metadata import packages_distributions, requires, version

from packaging.requirements import InvalidRequirement, Requirement

from benchnav.core.shipped_files import PACKAGE


def loaded_versions(modules: Iterable[str]) -> dict[str, str]:
    """Return versions of the distributions of modules and of their loaded requirements.

    Args:
        modules: dotted names of modules.

    Returns:
        Versions by name of the distribution.
    """
    search_path = _search_path()
    distributions = _distributions(search_path)
    loaded = {name.partition(".")[0] for name in list(sys.modules)}
    loaded_dists: set[str] = set()
    for package in loaded:
        loaded_dists.update(distributions.get(package, ()))
    by_name = {_normal(dist): dist for dist in loaded_dists}
    packages = {name.partition(".")[0] for name in modules} & loaded
    pending: list[str] = []
    for package in packages - {PACKAGE.name}:
        pending += distributions.get(package, ())
    versions: dict[str, str] = {}
    while pending:
        dist = pending.pop()
        if dist in versions or _normal(dist) == PACKAGE.name:
            continue
        versions[dist], required = _metadata(search_path, dist)
        pending += [by_name[name] for name in required if name in by_name]
    return versions


def _search_path() -> tuple[tuple[str, int], ...]:
    """Return the entries of `sys.path`, each with the time of its last change in ns.

    An installation changes this time. As an argument of the cached functions below, it
    makes them search again.
    """
    search_path = []
    for entry in sys.path:
        folder = entry or "."
        changed_ns = os.stat(folder).st_mtime_ns if os.path.exists(folder) else 0
        search_path.append((entry, changed_ns))
    return tuple(search_path)


@lru_cache(maxsize=1)
def _distributions(search_path: tuple[tuple[str, int], ...]) -> Mapping[str, list[str]]:
    """Return the installed distributions of each top-level module.

    The result is cached, because the search takes 0.25 s.
    """
    return packages_distributions()


@lru_cache(maxsize=1024)
def _metadata(
    search_path: tuple[tuple[str, int], ...], dist: str
) -> tuple[str, tuple[str, ...]]:
    """Return the version of a distribution, and its requirements on this platform."""
    required = []
    for text in requires(dist) or ():
        with suppress(InvalidRequirement):
            requirement = Requirement(text)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                required.append(_normal(requirement.name))
    return version(dist), tuple(required)


def _normal(name: str) -> str:
    """Return the normalised name of a distribution, for comparison."""
    return name.lower().replace("_", "-").replace(".", "-")
