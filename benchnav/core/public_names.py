"""Public names of a package, each imported from its module on first access."""

import sys
from collections.abc import Callable, Collection, Mapping
from importlib import import_module
from typing import Any

from benchnav.core.renamed import IMPORTS


def face(
    package: str, modules: Mapping[str, Collection[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package (PEP 562).

    Importing the package then loads nothing else. Editors and type checkers read the
    same names in `__init__.pyi`. A public name may differ from that in the module, as
    in `create as create_dataset`: the parser of the commands looks up the names of
    their functions in the surrounding packages, and would load a module with the name
    of a command.

    Args:
        package: `__name__` of the package.
        modules: public names by module.
    """
    sources = {}
    for module, names in modules.items():
        for name in names:
            module_name, _, public = name.partition(" as ")
            sources[public or module_name] = module, module_name

    def find(name: str) -> Any:
        old = f"{package}.{name}"
        if old in IMPORTS:
            # An ImportError, since `from … import` hides the text of an AttributeError.
            raise ImportError(f"{old} is now {IMPORTS[old]}.")
        if name not in sources:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, module_name = sources[name]
        value = getattr(import_module(module), module_name)
        setattr(sys.modules[package], name, value)  # skips this function from now on
        return value

    def list_names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *sources})

    return find, list_names, sorted(sources)
