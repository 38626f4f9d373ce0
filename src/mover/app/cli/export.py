"""What `export` and `simulate` do."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from mover.app.cli.config import parsed
from mover.app.cli.console import say
from mover.core.errors import InputError
from mover.core.settings import float_in
from mover.io.formats import chosen, names

if TYPE_CHECKING:
    Target = str
else:
    Target = Literal[tuple(names("export"))]  # the table's names are refused or shown by the parser


@dataclass(frozen=True)
class ExportArgs:
    """Write a result for other programs, into OUT/export."""

    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Folder of the result."""
    to: tuple[Target, ...] = ("glb",)
    """What to write; several with spaces between them."""
    capture: Path | None = None
    """Folder of the capture: its bodies.npz tells the parameters of the bodies."""
    stable: bool = False
    """Take OUT/stable.json, which `mover simulate --nudge` writes, in place of scene.json."""
    body: Literal["auto", "skin", "morph", "none"] = "auto"
    """glb, usd: how people move: on bones, by exact shapes of some frames, or not at all (also
    mjcf)."""
    walls: Literal["none", "guess"] = "none"
    """usd, mjcf, urdf: guess walls from a layout that was given (Total3D), else from what stands
    along them; they are marked as guessed."""
    up: Literal["y", "z"] = "y"
    """bodies, usd, contacts: y is the world of scene.json, z that of AMASS and of simulators."""


@dataclass(frozen=True)
class SimulateArgs:
    """Let gravity act on a result; writes OUT/settle.json."""

    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Folder of the result."""
    truth: Path | None = None
    """Folder with the true scene.json, to settle it as well."""
    seconds: Annotated[float, float_in(0.01, 3600)] = 2.0
    """Time of the simulation [s]."""
    walls: Literal["none", "guess"] = "none"
    """Guess walls as `mover export` does; pieces may lean on them."""
    nudge: bool = False
    """Move pieces that would fall to where they stand, as far as their uncertainty allows; writes
    OUT/stable.json."""


def export(arguments: Sequence[str]) -> None:
    """`mover export`."""
    args = parsed(ExportArgs, "mover export", arguments)
    from mover.io.export.finished import Exported, read_finished

    writers = {target: chosen("--to", target, "export") for target in args.to}
    finished, folder = read_finished(args.out, args.capture, args.stable), args.out / "export"
    if finished.walls is not None and args.walls == "none":
        say("pieces were nudged along guessed walls; --walls guess writes these")
    options = {"glb": {"body": args.body}, "bodies": {"up": args.up}, "contacts": {"up": args.up}}
    room = {"body": args.body, "walls": args.walls}
    options |= {"usd": {**room, "up": args.up}, "mjcf": room, "urdf": {"walls": args.walls}}
    for target, write in writers.items():
        found: Exported = write(finished, folder, **options.get(target, {}))
        shown = found.files if len(found.files) <= 3 else found.files[:1]
        more = f" and {len(found.files) - 1} more" if len(found.files) > 3 else ""
        say(f"{target}: {', '.join(str(file) for file in shown)}{more}")
        for note in found.notes:
            say(f"  {note}")


def simulate(arguments: Sequence[str]) -> None:
    """`mover simulate`."""
    args = parsed(SimulateArgs, "mover simulate", arguments)
    from mover.app.simulate import result_walls, simulate_folder, simulation_table
    from mover.evaluate.stability import SimulationConfig
    from mover.io.export.shell import wall_notes

    if not 0 < args.seconds <= 60:
        raise InputError(f"--seconds: {args.seconds:g}, expected more than 0, at most 60")
    config = SimulationConfig(args.seconds)
    walls = result_walls(args.out) if args.walls == "guess" else None
    say(simulation_table(simulate_folder(args.out, args.truth, config, walls)))
    for note in () if walls is None else wall_notes(walls):
        say(note)
    if args.nudge:
        from mover.app.nudge import nudge_folder

        say(f"\n{nudge_folder(args.out, config, walls or ())}")
