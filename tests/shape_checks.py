"""The checker of shapes and types that pytest puts around every function of the packages."""

import dataclasses
import functools
import inspect
from collections.abc import Callable

import jaxtyping
from beartype import BeartypeConf, beartype
from jaxtyping._import_hook import Typechecker

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
_eager = jaxtyping.jaxtyped


def late(fn: Callable | None = None, *, typechecker: Callable) -> Callable:
    """As `jaxtyping.jaxtyped`, but a function's checks are made when it is first called.

    Most functions are never called by most workers, and making their checks takes longer than
    importing all else.
    """
    if typechecker not in Typechecker.lookup.values():  # the program's own: not of the hook
        return (
            _eager(typechecker=typechecker) if fn is None else _eager(fn, typechecker=typechecker)
        )
    if fn is None:
        return functools.partial(late, typechecker=typechecker)
    if inspect.isclass(fn):
        if dataclasses.is_dataclass(fn) and "__init__" in vars(fn):
            fn.__init__ = late(fn.__init__, typechecker=typechecker)  # pyright: ignore
        return fn
    real: Callable | None = None

    @functools.wraps(fn)
    def first(*args: object, **given: object) -> object:
        __tracebackhide__ = True
        nonlocal real
        if real is None:
            real = _eager(fn, typechecker=typechecker)
        return real(*args, **given)

    return first
