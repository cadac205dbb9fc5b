"""Objects that store the arguments of their constructor, for other processes."""

from typing import Any, Self

_ARGUMENTS = "_arguments"


class Specified:
    """Base class of all parts: planners, models, risk measures, robots, …

    It only stores the arguments of the constructor, see `arguments_of`.
    """

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Store the arguments."""
        if cls.__init__ is object.__init__ and (args or kwargs):
            raise TypeError(f"{cls.__name__}() takes no arguments")
        instance = super().__new__(cls)
        # Frozen dataclasses and modules of PyTorch have a `__setattr__` of their own.
        object.__setattr__(instance, _ARGUMENTS, (args, kwargs))
        return instance


def arguments_of(instance: Any) -> tuple[tuple[Any, ...], dict[str, Any]] | None:
    """Return an object's positional and keyword arguments; None if unknown."""
    return vars(instance).get(_ARGUMENTS) if isinstance(instance, Specified) else None
