"""A reader of pickle's opcodes that knows data only: there is nothing in it that could call.

The opcodes and their arguments are parsed by the standard library's `pickletools`.
"""

import pickletools
import warnings
from collections.abc import Callable
from io import BytesIO
from typing import Any

from .parts import Name, Part, made, named

MARK = object()
Act = Callable[["Machine", Any], None]


class Machine:
    """The stack and the memo while one pickle is read."""

    __slots__ = ("memo", "stack", "storages", "stream")

    def __init__(self, stream: BytesIO) -> None:
        self.stream = stream
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}
        self.storages: dict[str, Part] = {}

    def run(self) -> Any:  # noqa: ANN401
        """Read one pickle from the stream; parts are not understood yet.

        Raises:
            ValueError: If an opcode is not one of data.
            InputError: If a class is named that is not in the table.
        """
        with warnings.catch_warnings():  # of escapes that are none, in texts that are broken
            warnings.simplefilter("ignore", DeprecationWarning)
            for opcode, arg, _ in pickletools.genops(self.stream):
                if opcode.name == "STOP":
                    return self.stack.pop()
                act = ACTS.get(opcode.name)
                if act is None:
                    raise ValueError(f"opcode {opcode.name}")
                act(self, arg)
        raise ValueError("no end")

    def marked(self) -> list[Any]:
        """Take all items above the last mark off the stack, and the mark."""
        stack = self.stack
        at = len(stack) - 1
        while stack[at] is not MARK:
            at -= 1
            if at < 0:
                raise ValueError("no mark")
        items = stack[at + 1 :]
        del stack[at:]
        return items


def _push(machine: Machine, arg: Any) -> None:  # noqa: ANN401
    machine.stack.append(arg)


def _make(value: Callable[[], Any]) -> Act:
    def act(machine: Machine, arg: Any) -> None:  # noqa: ANN401, ARG001
        machine.stack.append(value())

    return act


def _nothing(machine: Machine, arg: Any) -> None:  # noqa: ANN401
    pass


def _pop(machine: Machine, arg: Any) -> None:  # noqa: ANN401, ARG001
    machine.stack.pop()


def _pop_mark(machine: Machine, arg: Any) -> None:  # noqa: ANN401, ARG001
    machine.marked()


def _twice(machine: Machine, arg: Any) -> None:  # noqa: ANN401, ARG001
    machine.stack.append(machine.stack[-1])


def _last(count: int) -> Act:
    def act(machine: Machine, arg: Any) -> None:  # noqa: ANN401, ARG001
        if len(machine.stack) < count:
            raise ValueError("too few items")
        items = tuple(machine.stack[-count:])
        machine.stack[-count:] = [items]

    return act


def _gather(kind: Callable[[list[Any]], Any]) -> Act:
    def act(machine: Machine, arg: Any) -> None:  # noqa: ANN401, ARG001
        items = machine.marked()
        machine.stack.append(kind(items))

    return act


def _paired(items: list[Any]) -> dict[Any, Any]:
    return dict(zip(items[::2], items[1::2], strict=True))


def _put(machine: Machine, arg: Any) -> None:  # noqa: ANN401
    machine.memo[int(arg)] = machine.stack[-1]


def _memoize(machine: Machine, arg: Any) -> None:  # noqa: ANN401, ARG001
    machine.memo[len(machine.memo)] = machine.stack[-1]


def _get(machine: Machine, arg: Any) -> None:  # noqa: ANN401
    machine.stack.append(machine.memo[int(arg)])


def _append(machine: Machine, items: list[Any]) -> None:
    if type(machine.stack[-1]) is not list:
        raise ValueError("items for something else than a list")
    machine.stack[-1].extend(items)


def _update(machine: Machine, items: list[Any]) -> None:
    if type(machine.stack[-1]) is not dict:
        raise ValueError("items for something else than a dictionary")
    machine.stack[-1].update(_paired(items))


def _add(machine: Machine, items: list[Any]) -> None:
    if type(machine.stack[-1]) is not set:
        raise ValueError("items for something else than a set")
    machine.stack[-1].update(items)


def _with_last(count: int, act: Callable[[Machine, list[Any]], None]) -> Act:
    def wrapped(machine: Machine, arg: Any) -> None:  # noqa: ANN401, ARG001
        items = machine.stack[-count:]
        del machine.stack[-count:]
        act(machine, items)

    return wrapped


def _with_marked(act: Callable[[Machine, list[Any]], None]) -> Act:
    def wrapped(machine: Machine, arg: Any) -> None:  # noqa: ANN401, ARG001
        act(machine, machine.marked())

    return wrapped


def _global(machine: Machine, arg: str) -> None:
    module, _, name = arg.partition(" ")
    machine.stack.append(named(module, name))


def _stack_global(machine: Machine, arg: Any) -> None:  # noqa: ANN401, ARG001
    name, module = machine.stack.pop(), machine.stack.pop()
    if not isinstance(name, str) or not isinstance(module, str):
        raise ValueError("a class without a name")
    machine.stack.append(named(module, name))


def _reduce(machine: Machine, arg: Any) -> None:  # noqa: ANN401, ARG001
    args, name = machine.stack.pop(), machine.stack.pop()
    machine.stack.append(made(name, args))


def _new(machine: Machine, arg: Any) -> None:  # noqa: ANN401, ARG001
    args, name = machine.stack.pop(), machine.stack.pop()
    if not isinstance(name, Name) or not isinstance(args, tuple):
        raise ValueError("an object without a class")
    machine.stack.append(Part(name, args) if name.kind != "dict" else {})


def _build(machine: Machine, arg: Any) -> None:  # noqa: ANN401, ARG001
    state, part = machine.stack.pop(), machine.stack[-1]
    if isinstance(part, dict):  # attributes of an OrderedDict
        return
    if not isinstance(part, Part) or part.state is not None:
        raise ValueError("a state for something that has none")
    part.state = state
    if part.name.kind == "wrapped":
        from .values import unwrapped

        part.state = unwrapped(machine.stream, state)


def _stored(machine: Machine, arg: Any) -> None:  # noqa: ANN401, ARG001
    match machine.stack.pop():
        case ("storage", Name(kind="type") as kind, key, _, int() as count, *_):
            part = Part(kind, (str(key), count))
            machine.stack.append(part)
            machine.storages[str(key)] = part
        case _:
            raise ValueError("a reference to something outside")


ACTS: dict[str, Act] = {
    **dict.fromkeys(("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4"), _push),
    **dict.fromkeys(("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE"), _push),
    **dict.fromkeys(("SHORT_BINUNICODE", "BINUNICODE8", "FLOAT", "BINFLOAT"), _push),
    **dict.fromkeys(("BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"), _push),
    **dict.fromkeys(("PROTO", "FRAME", "READONLY_BUFFER"), _nothing),
    "NONE": _make(lambda: None), "NEWTRUE": _make(lambda: True), "NEWFALSE": _make(lambda: False),
    "EMPTY_LIST": _make(list), "EMPTY_TUPLE": _make(tuple), "EMPTY_DICT": _make(dict),
    "EMPTY_SET": _make(set), "MARK": _make(lambda: MARK), "POP": _pop, "POP_MARK": _pop_mark,
    "DUP": _twice, "TUPLE1": _last(1), "TUPLE2": _last(2), "TUPLE3": _last(3),
    "TUPLE": _gather(tuple), "LIST": _gather(list), "DICT": _gather(_paired),
    "FROZENSET": _gather(frozenset), "APPEND": _with_last(1, _append),
    "APPENDS": _with_marked(_append), "SETITEM": _with_last(2, _update),
    "SETITEMS": _with_marked(_update), "ADDITEMS": _with_marked(_add),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT"), _put), "MEMOIZE": _memoize,
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), _get), "GLOBAL": _global,
    "STACK_GLOBAL": _stack_global, "REDUCE": _reduce, "NEWOBJ": _new, "BUILD": _build,
    "BINPERSID": _stored,
}  # fmt: skip
"""What each opcode does; INST, OBJ, EXT and the like are refused."""
