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

    Importing the package then imports no module. Editors and type checkers read the
    same names in `__init__.pyi`.

    Args:
        package: `__name__` of the package.
        modules: public names by module that defines them. `create as create_dataset`
            gives the name `create` of the module the public name `create_dataset`.
            This is needed for functions of commands: the parser looks up their names
            in the surrounding packages, and would import a module of the same name.
    """
    sources = {}
    for module, names in modules.items():
        for name in names:
            defined_name, _, public_name = name.partition(" as ")
            sources[public_name or defined_name] = module, defined_name

    def find(name: str) -> Any:
        full_name = f"{package}.{name}"
        if full_name in IMPORTS:
            # `from … import` would hide the text of an AttributeError.
            raise ImportError(f"{full_name} is now {IMPORTS[full_name]}.")
        if name not in sources:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, defined_name = sources[name]
        value = getattr(import_module(module), defined_name)
        # Later accesses find the attribute and do not call this function.
        setattr(sys.modules[package], name, value)
        return value

    def list_names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *sources})

    return find, list_names, sorted(sources)
