"""What `render` does."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mover.app.cli.config import parsed
from mover.app.cli.console import say
from mover.app.pictures.config import RenderConfig
from mover.core.errors import InputError

WIDTHS = (16, 8192)  # [px]


@dataclass(frozen=True)
class RenderArgs:
    """Draw a result without a screen, as a picture or a film."""

    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Folder of the result."""
    to: Path = Path("room.png")
    """The file: .png or .jpg for one picture, .mp4 for a film."""
    capture: Path | None = None
    """Folder of the capture: its video, or else its reference image, is behind the furniture."""
    config: Annotated[RenderConfig, arg(name="")] = field(default_factory=RenderConfig)


def render(arguments: Sequence[str]) -> None:
    """`mover render`."""
    args = parsed(RenderArgs, "mover render", arguments)
    import torch

    from mover.app.pictures.render import render_result

    low, high = WIDTHS
    if not low <= args.config.width <= high:
        raise InputError(f"--width: {args.config.width}, expected {low} to {high}")
    if not -89 <= args.config.elevation <= 89:
        raise InputError(f"--elevation: {args.config.elevation:g}, expected -89 to 89")
    torch.set_num_threads(1)
    count = render_result(args.out, args.to, args.config, args.capture)
    what = "one picture" if count == 1 else f"{count} pictures"
    say(f"{args.to}: {what}")
