"""What a pickle names: a table of the few classes and functions whose data are understood.

A name that is not in the table is refused as soon as it appears. A name that is in the table is a
word, not the thing: `Part` keeps what the file would do with it, `values` turns it into an array.
"""

from collections.abc import Callable
from typing import Any

from ..records import InputError


class Name:
    """A class or function that a pickle names: its kind in `KINDS` and its full name."""

    __slots__ = ("full", "kind")

    def __init__(self, full: str, kind: str) -> None:
        self.full, self.kind = full, kind


class Part:
    """A thing that a pickle describes: what is made, from which arguments, with which state."""

    __slots__ = ("args", "name", "state")

    def __init__(self, name: Name, args: tuple[Any, ...]) -> None:
        self.name, self.args, self.state = name, args, None


def _kinds() -> dict[str, str]:
    """Kind of each full name that is understood."""
    kinds = {
        "numpy.ndarray": "type", "numpy.memmap": "type", "numpy.dtype": "dtype",
        "joblib.numpy_pickle.NumpyArrayWrapper": "wrapped",
        "torch._utils._rebuild_tensor_v2": "tensor",
        "torch._utils._rebuild_parameter": "parameter",
        "torch.storage._load_from_bytes": "stored",
        "torch.Size": "tuple", "torch.device": "first",
        "_codecs.encode": "encode", "collections.OrderedDict": "dict",
        "collections.defaultdict": "defaultdict",
    }  # fmt: skip
    for core in ("numpy.core", "numpy._core"):
        kinds[f"{core}.multiarray._reconstruct"] = "array"
        kinds[f"{core}.multiarray.scalar"] = "scalar"
        kinds[f"{core}.numeric._frombuffer"] = "buffer"
    for builtin in ("builtins", "__builtin__"):
        names = ("set", "frozenset", "list", "tuple", "dict", "bytearray", "bytes", "complex")
        kinds |= {f"{builtin}.{name}": name for name in names}
        kinds |= {f"{builtin}.{name}": "type" for name in ("object", "int", "float", "str", "bool")}
    for form in ("csc", "csr", "coo"):
        for module in (form, f"_{form}"):
            kinds[f"scipy.sparse.{module}.{form}_matrix"] = f"sparse {form}"
            kinds[f"scipy.sparse.{module}.{form}_array"] = f"sparse {form}"
    for registry in ("copyreg", "copy_reg"):
        kinds[f"{registry}._reconstructor"] = "rebuild"
        kinds[f"{registry}.__newobj__"] = "newobj"
    for path in ("PosixPath", "PurePosixPath", "WindowsPath", "PureWindowsPath"):
        kinds |= {f"pathlib.{path}": "path", f"pathlib._local.{path}": "path"}
    kinds |= {f"torch.{name}Storage": "type" for name in STORAGES}
    kinds |= {"torch.storage.UntypedStorage": "type"}
    for name in ("float64", "float32", "float16", "int64", "int32", "int16", "int8", "uint8"):
        kinds |= {f"torch.{name}": "type", f"numpy.{name}": "type"}
    return kinds | {"torch.bool": "type", "torch.bfloat16": "type"}


STORAGES = {
    "Float": "<f4", "Double": "<f8", "Half": "<f2", "BFloat16": "<u2", "Long": "<i8",
    "Int": "<i4", "Short": "<i2", "Char": "|i1", "Byte": "|u1", "Bool": "|b1",
}  # fmt: skip
"""Type of the numbers in each of torch's storages."""
KINDS = _kinds()


def named(module: str, name: str) -> Name:
    """The name if its data are understood.

    Raises:
        InputError: If they are not; nothing was imported or called.
    """
    full = f"{module}.{name}"
    if module.split(".")[0] == "chumpy" and name.isidentifier():
        return Name(full, f"chumpy {name}")
    if full not in KINDS:
        shown = full if full.isprintable() and len(full) < 200 else "a class with an odd name"
        raise InputError(f"the pickle holds {shown}, expected arrays, numbers, text and containers")
    return Name(full, KINDS[full])


def made(name: Any, args: Any) -> Any:  # noqa: ANN401
    """What `name(*args)` describes: a container, or a part to be understood later.

    Raises:
        ValueError: If the name is none or the arguments do not fit.
    """
    if not isinstance(name, Name) or not isinstance(args, tuple):
        raise ValueError("a call of something that has no name")
    match name.kind, args:
        case ("rebuild", (Name() as kind, Name(full=base), None)) if base.endswith(".object"):
            return Part(kind, ())
        case ("newobj", (Name() as kind, *rest)):
            return Part(kind, tuple(rest))
        case ("defaultdict", _):
            return {}
        case (kind, _) if kind in CONTAINERS:
            return CONTAINERS[kind](*args)
        case ("type" | "rebuild" | "newobj", _):
            raise ValueError(f"a call of {name.full}")
        case _:
            return Part(name, args)


def _bytes(*args: Any) -> bytes:  # noqa: ANN401
    """Bytes from text or bytes, never from a size."""
    match args:
        case ():
            return b""
        case (bytes() | bytearray() as raw,):
            return bytes(raw)
        case (str() as text,) | (str() as text, "latin1" | "latin-1"):
            return text.encode("latin1")
        case (list() as numbers,):
            return bytes(numbers)
        case _:
            raise ValueError("bytes from something else than text")


def _pairs(*args: Any) -> dict[Any, Any]:  # noqa: ANN401
    """A dictionary of pairs."""
    return {key: value for key, value in (args[0] if args else ())}  # noqa: C416


def _of_list(kind: Callable[..., Any]) -> Callable[..., Any]:
    """A container of the items of another one."""

    def build(*args: Any) -> Any:  # noqa: ANN401
        if any(not isinstance(a, list | tuple | set | frozenset) for a in args) or len(args) > 1:
            raise ValueError("a container of something else than a list")
        return kind(*args)

    return build


def _first(*args: Any) -> str:  # noqa: ANN401
    return str(args[0]) if args and isinstance(args[0], str) else ""


def _path(*args: Any) -> str:  # noqa: ANN401
    if not all(isinstance(a, str) for a in args):
        raise ValueError("a path of something else than text")
    return "/".join(args).replace("//", "/")


def _complex(*args: Any) -> complex:  # noqa: ANN401
    if not all(isinstance(a, float | int) for a in args):
        raise ValueError("a complex number of something else than numbers")
    return complex(*args)


CONTAINERS: dict[str, Callable[..., Any]] = {
    "set": _of_list(set),
    "frozenset": _of_list(frozenset),
    "list": _of_list(list),
    "tuple": _of_list(tuple),
    "dict": _pairs,
    "bytes": _bytes,
    "bytearray": _bytes,
    "encode": _bytes,
    "first": _first,
    "path": _path,
    "complex": _complex,
}
"""Makers of what needs no later look; all are written here."""
