"""The public names of a package, each imported from its module when it is first asked
for.
"""

import sys
from collections.abc import Callable, Collection, Mapping
from importlib import import_module
from typing import Any

from benchnav.core.renamed import IMPORTS


def face(
    package: str, modules: Mapping[str, Collection[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Gives a package its `__getattr__`, `__dir__` and `__all__` (PEP 562), so that
    importing it loads nothing else.

    Editors and type checkers read the same names in the `__init__.pyi` beside it. A
    name may differ from that in its
    module, `create as create_dataset`: the parser of the commands looks for its
    functions' names in the packages around them, and would load what bears the name of
    a command.

    Args:
        package: its `__name__`.
        modules: for each module the names that users are to import from the package.
    """
    places = {}
    for module, names in modules.items():
        for name in names:
            own, _, public = name.partition(" as ")
            places[public or own] = module, own

    def find(name: str) -> Any:
        old = f"{package}.{name}"
        if (
            old in IMPORTS
        ):  # an ImportError, since `from … import` hides the text of an AttributeError
            raise ImportError(f"{old} is now {IMPORTS[old]}.")
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, own = places[name]
        value = getattr(import_module(module), own)
        setattr(sys.modules[package], name, value)  # found at once from now on
        return value

    return find, lambda: sorted({*vars(sys.modules[package]), *places}), sorted(places)
