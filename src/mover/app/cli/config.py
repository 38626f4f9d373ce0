"""Which settings a command line asks for: a preset or a file, and the flags that change it.

The flags of a command are the fields of its arguments and the settings in a table; all other
settings can be set by a file (`--config`).
"""

import argparse
import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, make_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, cast

import tyro
from tyro.conf import arg

from mover.app.cli import say
from mover.core.errors import InputError
from mover.core.settings import check_settings, settings_of
from mover.pipeline.presets import changed

T = TypeVar("T")
C = TypeVar("C")
Device = Literal["auto", "cpu", "cuda"]
"""Where the heavy stages compute, see `core.devices.device_of`."""

_WEIGHTS = {
    "bbox": "objects fill their detected boxes",
    "silhouette": "objects cover their masks",
    "scale": "objects keep their initial size",
    "depth": "who hides whom bounds the depth",
    "collision": "people move through free space",
    "contact": "touching surfaces meet",
    "heading": "seats face where their sitters face",
    "wall": "furniture along a wall is in one line",
    "given": "objects stay about as they are in the first scene",
    "measured": "surfaces lie where a depth network sees them",
}
RUN_SETTINGS = {
    **{f"place.weights.{term}": f"Weight: {text}." for term, text in _WEIGHTS.items()},
    **{
        f"layout.weights.{term}": f"The same before people are used: {_WEIGHTS[term]}."
        for term in ("bbox", "silhouette", "scale", "wall", "given", "measured")
    },
    "place.method.steps": "Most steps of the descent with people.",
    "layout.method.steps": "Most steps of the descent from the image alone.",
    "layout.yaws": "Initial orientations of each object.",
    "layout.num_hypotheses": "Placements of each object that go on to the second descent.",
    "outer_iterations": "Further passes with contacts and occlusion order renewed.",
    "select.rule": "How frames whose bodies jump are left out.",
    "correct_depth": "Find one depth factor a person.",
    "foot_contacts.speed": "A foot that is slower is at rest [m/s].",
    "align.tilt_prior": "Expected error of the initial pitch and roll [rad].",
    "align.offset_prior": "Expected error of the heights of feet [m].",
    "lens.use": "Find the focal length from lines of the picture.",
    "refine.rounds": "Most rounds in which camera and floor are refined with the objects; 0: none.",
    "sizes.usual": "Standard deviation of the logarithm of given sizes.",
    "height_spread": "The same of people's height, where it is unknown.",
    "seat_heights": "The height of sitters constrains the scale.",
    "prepare.cells": "Cells along the longest side where a mesh is made watertight.",
    "prepare.faces": "Faces of the watertight meshes.",
    "prepare.samples": "Surface samples of an object.",
    "prepare.watertight": "How meshes are made watertight.",
    "prepare.occnet": "Weights of an Occupancy Network, for that.",
    "image.size": "Longest side of an object's crop [px].",
    "gather.cells": "Cells along the longest side of the free space.",
    "gather.erode": "Pixels by which people's masks shrink.",
    "gather.near": "Where the near bound of what a person hides lies.",
    "gather.vote": "An object hides a body in a frame or is hidden, not both.",
    "assign.by": "How touching skin is given to objects.",
    "prepare.regions": "What of the furniture can be touched.",
    "align.votes": "What counts once for the floor.",
    "contacts.given": "Use contacts.npz of the capture.",
    "place.readings.contradiction": "What pixels cost whose bounds cross (`paper`).",
    "place.readings.surface": "What of an object may not be inside people (`paper`).",
    "place.readings.lookup": "How the free space is looked up (`paper`).",
    "place.readings.contact": "How the distances of touching skin add up (`paper`).",
}
"""Settings of `Config` that `mover run` and `mover batch` have as flags, and what they are."""
PERCEIVE_SETTINGS = {
    "frames.fps": "Frames a second that are taken at least.",
    "frames.start": "Where the part of the video starts [s].",
    "frames.end": "Where it ends; 0: with the video [s].",
    "models.masks": "The network of masks.",
    "models.keypoints": "The network of joints.",
    "score": "Least score of a detection.",
}
"""The same of `PerceiveConfig`, of `mover video`."""
REFINE_SETTINGS = {"rounds": "Rounds of the descent with evidence gathered again."}
"""The same of `RefineBodiesConfig`, of `mover refine`."""
LAYOUT_SETTINGS = {
    "shapes": "Shapes of the library that are tried for each object.",
    "keep": "Hypotheses of an object that are kept.",
    "turns": "Orientations in which a shape is tried.",
    "screen.method.steps": "Most steps of the descent of each hypothesis.",
}
"""The same of `LayoutConfig`, of `mover layout`."""


def preset_named(name: str, table: Mapping[Any, T]) -> T:
    """A preset by its name.

    Raises:
        InputError: If there is none of that name.
    """
    if name not in table:
        raise InputError(f"--preset: {name!r} is none of {', '.join(table)}")
    return table[name]


def chosen_config(arguments: Sequence[str], table: Mapping[Any, T]) -> T:
    """The preset or file of settings that a command line names, read before its other flags.

    Raises:
        InputError: If there is none of that name.
    """
    early = argparse.ArgumentParser(prog="mover run", add_help=False, allow_abbrev=False)
    early.add_argument("--preset", default="robust")
    early.add_argument("--config", type=Path)
    chosen, _ = early.parse_known_args(arguments)
    config = preset_named(chosen.preset, table)
    if chosen.config is not None:
        from mover.app.results import read_config

        config = cast(T, read_config(chosen.config))
    return config


def parsed(kind: Callable[..., T], prog: str, arguments: Sequence[str]) -> T:
    """The arguments of a command as its dataclass, checked before any work starts.

    Raises:
        InputError: If a setting is out of its range.
    """
    found = tyro.cli(kind, prog=prog, args=list(arguments))
    _checked(prog, found)
    return found


def _checked(prog: str, *settings: object) -> None:
    for some in settings:
        check_settings(some, "--")
    if sys.stderr.isatty():
        say(f"{prog}: loading ...", sys.stderr)  # of torch and others, some seconds


def parsed_with(
    kind: type[T], config: C, settings: Mapping[str, str], prog: str, arguments: Sequence[str]
) -> tuple[T, C]:
    """The same, and the configuration with the settings that flags change.

    `--help` shows the command's own flags, `--help-all` the settings as well. Those that are flags
    stand in `settings` by their dotted names, with their help.

    Raises:
        InputError: If a setting is out of its range.
    """
    words = ["--help" if word == "--help-all" else word for word in arguments]
    if "--help-all" not in arguments and {"-h", "--help"} & {*arguments} and settings:
        more = f"{kind.__doc__}\n\n`{prog} --help-all` shows {len(settings)} settings more."
        parsed_only: Any = functools.partial(tyro.cli, kind, prog=prog, description=more)
        parsed_only(args=words)
    fields: list[Any] = []
    for name, text in settings.items():
        *way, key = name.split(".")
        owner: Any = functools.reduce(getattr, way, cast(Any, config))
        hint = Annotated[settings_of(type(owner))[key], arg(name=name, help=text)]
        fields.append((name.replace(".", "__"), hint, field(default=getattr(owner, key))))
    flags: Any = make_dataclass("Settings", fields, frozen=True)
    default = flags()

    def both(
        args: Annotated[kind, arg(name="")],  # pyright: ignore[reportInvalidTypeForm]
        flags: Annotated[flags, arg(name="")] = default,  # pyright: ignore
    ) -> Any:  # noqa: ANN401
        return args, flags

    both.__doc__ = kind.__doc__
    args, found = tyro.cli(both, prog=prog, args=words, config=(tyro.conf.AvoidSubcommands,))
    for name in settings:
        config = changed(config, name.split("."), getattr(found, name.replace(".", "__")))
    _checked(prog, args, config)
    return args, config
