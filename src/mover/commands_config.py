"""Which settings a command line asks for: a preset, a file, and the methods of descents."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from .presets import PRESETS, Config, with_methods
from .records import InputError
from .results import read_config


def chosen_config(arguments: Sequence[str]) -> tuple[Config, list[str]]:
    """The preset or file is read first, so that the other flags may stand before or after it."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--preset", default="robust")
    early.add_argument("--config", type=Path)
    chosen, _ = early.parse_known_args(list(arguments))
    config = preset_named(chosen.preset) if chosen.config is None else read_config(chosen.config)
    return with_methods(config, arguments)


def preset_named(name: str) -> Config:
    """A preset by its name.

    Raises:
        InputError: If there is none of that name.
    """
    if name not in PRESETS:
        raise InputError(f"--preset: {name!r} is none of {', '.join(PRESETS)}")
    return PRESETS[name]
