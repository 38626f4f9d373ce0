"""Sets whose noise is changed in one thing, for the study of sensitivity.

`rooms+scale=0.25` is the set `rooms` with errors of 25 % in the sizes of the objects; its rooms,
people and all other errors stay the same.
"""

from dataclasses import dataclass, replace
from typing import Any

from ..records import InputError
from ..rooms import NoiseConfig
from .sets import SETS, RoomSet


@dataclass(frozen=True)
class Change:
    """An error of the input in growing sizes."""

    title: str
    unit: str
    fields: tuple[str, ...]
    """Of `NoiseConfig`: set to the level."""
    levels: tuple[float, ...]
    """Studied sizes; the first is no error of this kind."""
    without: tuple[str, ...] = ()
    """Fields that are zero, so that this error is the only one of its kind."""
    shown: float = 1.0
    """Factor from a level to the unit."""


CHANGES: dict[str, Change] = {
    "scale": Change("size of objects", "± %", ("scale",), (0.0, 0.05, 0.15, 0.25), shown=100),
    "place": Change(
        "place of objects", "± cm", ("sideways",), (0.0, 0.1, 0.2, 0.3), ("along_ray",), shown=100
    ),
    "turn": Change("orientation of objects", "± °", ("yaw",), (0.0, 15.0, 30.0, 45.0), ("flips",)),
    "focal": Change("focal length", "± %", ("focal",), (0.0, 0.025, 0.05), shown=100),
    "masks": Change("objects' masks", "± px", ("object_masks",), (0, 1, 3, 6)),
    "leaks": Change("objects' masks that leak", "%", ("leaks",), (0.0, 0.2, 0.4), shown=100),
    "people": Change("people's masks", "± px", ("person_masks",), (0, 3, 6)),
    "pose": Change("joints of bodies", "° (sd)", ("pose",), (0.0, 4.0, 8.0)),
    "depth": Change("depth of bodies", "± %", ("depth_bias",), (0.0, 0.03, 0.06), shown=100),
    "feet": Change("lost legs", "%", ("lost_feet",), (0.0, 0.2, 0.4), shown=100),
    "missed": Change("missed objects", "%", ("missed",), (0.0, 0.1, 0.2), shown=100),
}
"""By the name that stands in the name of a set."""
WHOLE = ("object_masks", "person_masks")  # fields that count pixels


def set_named(name: str) -> RoomSet:
    """A set of `SETS`, or one with a changed noise: `rooms+scale=0.25`.

    Raises:
        InputError: If there is none of this name.
    """
    base, plus, change = name.partition("+")
    if base not in SETS:
        raise InputError(f"--set: {base!r} is none of {', '.join(SETS)}")
    if not plus:
        return SETS[base]
    kind, _, level = change.partition("=")
    if kind not in CHANGES:
        raise InputError(f"--set: {name!r} changes {kind!r}, expected one of {', '.join(CHANGES)}")
    try:
        size = float(level)
    except ValueError:
        raise InputError(f"--set: {name!r}, expected a number: {base}+{kind}=LEVEL") from None
    return replace(SETS[base], noise=changed(SETS[base].noise, CHANGES[kind], size))


def changed(noise: NoiseConfig, change: Change, level: float) -> NoiseConfig:
    """The noise with one kind of error of a given size."""
    values: dict[str, Any] = {
        name: round(level) if name in WHOLE else level for name in change.fields
    }
    return replace(noise, **values, **dict.fromkeys(change.without, 0.0))


def changed_set(base: str, kind: str, level: float) -> str:
    """Name of a changed set; the base itself where its noise is that already."""
    same = changed(SETS[base].noise, CHANGES[kind], level) == SETS[base].noise
    return base if same else f"{base}+{kind}={level:g}"
