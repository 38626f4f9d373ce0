"""Which settings a command line asks for: a preset, a file, and the methods of descents."""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import tyro
from tyro.conf import arg

from mover.app.cli import say
from mover.core.errors import InputError
from mover.core.settings import check_settings
from mover.pipeline.presets import PRESETS, Config, with_methods, with_present_flags

T = TypeVar("T")
C = TypeVar("C")
Device = Literal["auto", "cpu", "cuda"]
"""Where the heavy stages compute, see `core.devices.device_of`."""


def chosen_config(arguments: Sequence[str]) -> tuple[Config, list[str]]:
    """The preset or file is read first, so that the other flags may stand before or after it."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--preset", default="robust")
    early.add_argument("--config", type=Path)
    arguments, renamed = with_present_flags(arguments)
    for sentence in renamed:
        say(f"warning: {sentence}", sys.stderr)
    chosen, _ = early.parse_known_args(arguments)
    if chosen.config is None:
        return with_methods(preset_named(chosen.preset), arguments)
    from mover.app.results import read_config

    return with_methods(read_config(chosen.config), arguments)


def parsed(kind: Callable[..., T], prog: str, arguments: Sequence[str], *markers: Any) -> T:  # noqa: ANN401
    """The arguments of a command as its dataclass, checked before any work starts.

    Args:
        kind: The dataclass, or a function that returns dataclasses.
        prog: The command's name.
        arguments: What was typed after it.
        markers: Of tyro.

    Raises:
        InputError: If a setting is out of its range.
    """
    found = tyro.cli(kind, prog=prog, args=list(arguments), config=markers)
    parts: tuple[Any, ...] = found if isinstance(found, tuple) else (found,)
    for part in parts:
        check_settings(part, "--")
    if sys.stderr.isatty():
        say(f"{prog}: loading ...", sys.stderr)  # of torch and others, some seconds
    return found


def parsed_with(
    kind: type[T],
    config: C,
    prog: str,
    arguments: Sequence[str],
    *markers: Any,  # noqa: ANN401
) -> tuple[T, C]:
    """The same, and the settings of `config` that other flags of the command change."""

    def both(
        args: Annotated[kind, arg(name="")],  # pyright: ignore[reportInvalidTypeForm]
        config: Annotated[type(config), arg(name="")] = config,  # pyright: ignore
    ) -> Any:  # noqa: ANN401
        return args, config

    both.__doc__ = kind.__doc__
    return parsed(both, prog, arguments, *markers)


def preset_of(arguments: Sequence[str], names: Sequence[T]) -> T:
    """The preset that a command line names, whose settings the other flags change.

    Raises:
        InputError: If there is none of that name.
    """
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--preset", default=names[0])
    name = early.parse_known_args(arguments)[0].preset
    if name not in names:
        raise InputError(f"--preset: {name!r} is none of {', '.join(map(str, names))}")
    return name


def preset_named(name: str) -> Config:
    """A preset by its name.

    Raises:
        InputError: If there is none of that name.
    """
    if name not in PRESETS:
        raise InputError(f"--preset: {name!r} is none of {', '.join(PRESETS)}")
    return PRESETS[name]
