"""The checker of shapes and types that pytest puts around every function of the packages.

jaxtyping by itself checks arguments twice, and enters a scope of shapes where none is stated, too:
that was half of the time of many a test.
"""

import dataclasses
import functools
import inspect

import jaxtyping
from beartype import BeartypeConf, beartype
from jaxtyping._import_hook import Typechecker

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
thorough = jaxtyping.jaxtyped


def once(fn, typechecker):
    """A function, or what builds a dataclass, whose calls are checked once."""
    if inspect.isclass(fn):
        if dataclasses.is_dataclass(fn) and not hasattr(fn.__init__, "__wrapped__"):
            fn.__init__ = once(fn.__init__, typechecker)  # a record looks after itself
        return fn
    hints = fn.__annotations__.values()
    late = any(isinstance(hint, str) or "ForwardRef" in repr(hint) for hint in hints)
    if late or inspect.isgeneratorfunction(fn):
        return thorough(fn, typechecker=typechecker)
    inner = checked(fn)
    if not any("jaxtyping." in repr(hint) for hint in hints):
        return inner

    @functools.wraps(fn)
    def scoped(*args, **kwargs):
        with thorough("context"):
            return inner(*args, **kwargs)

    return scoped


def jaxtyped(*fn, typechecker=None):
    """In place of jaxtyping's, but for what the packages check without pytest."""
    if fn or typechecker not in Typechecker.lookup.values():
        return thorough(*fn, typechecker=typechecker)
    return functools.partial(once, typechecker=typechecker)
