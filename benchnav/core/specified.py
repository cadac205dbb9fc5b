"""Objects that remember the arguments they were created with, so that another process
can create them again.
"""

from typing import Any, Self

_ARGUMENTS = "_arguments"


class Specified:
    """The base class of all parts: planners, models, risk measures, robots, …

    It changes nothing but that the arguments of the constructor are kept; see
    `arguments_of`.
    """

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Keep the arguments."""
        if cls.__init__ is object.__init__ and (args or kwargs):
            raise TypeError(f"{cls.__name__}() takes no arguments")
        instance = super().__new__(cls)
        # Frozen dataclasses and modules of PyTorch have a `__setattr__` of their own.
        object.__setattr__(instance, _ARGUMENTS, (args, kwargs))
        return instance


def arguments_of(instance: Any) -> tuple[tuple[Any, ...], dict[str, Any]] | None:
    """Return the positional and keyword arguments that an object was created with; None
    if they are unknown.
    """
    return vars(instance).get(_ARGUMENTS) if isinstance(instance, Specified) else None
