"""Objects that store their constructor's arguments, to be created in other processes."""

from typing import Any, Self

_ARGUMENTS = "_arguments"


class Specified:
    """Base class of all parts: planners, models, risk measures, robots, …

    It stores only the arguments of the constructor; see `arguments_of`.
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
    """Return the positional and keyword arguments of an object's constructor.

    The result is None if the object does not store them.
    """
    return vars(instance).get(_ARGUMENTS) if isinstance(instance, Specified) else None
