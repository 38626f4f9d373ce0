"""The command line. This file imports nothing heavy: `mover --help` answers at once."""

import importlib
import logging
import sys

from .console import say

COMMANDS = {
    "demo": "Make a known room, reconstruct it, compare it with the truth.",
    "import": "Turn what other tools wrote into a capture folder.",
    "perceive": "From a video to a capture: frames, masks, joints, a first scene.",
    "layout": "Find a first scene of library furniture in one picture's masks or boxes.",
    "bodies": "Turn what another tool found of people into bodies.npz or keypoints.npz.",
    "fit": "Fit bodies to the 2D joints of a video.",
    "check": "Validate a capture, list the evidence of each object, draw the initial overlay.",
    "run": "Reconstruct a room from a capture folder.",
    "refine": "Refine the people of a result with its room: their pose, or their place.",
    "contacts": "Which vertices touch something, by POSA's network or from files.",
    "evaluate": "Compare a result with the truth.",
    "paper-table": "Print the paper's table for your copy of PROX or PiGraphs.",
    "experiment": "Rebuild known rooms with each preset and compare them with the truth.",
    "export": "Write a result for other programs: GLB, USD, MJCF, URDF, PLY, bodies.",
    "render": "Draw a result without a screen: a picture or a film.",
    "view": "Look at a result in the browser, correct it, solve it again.",
    "settle": "Let gravity act on a result: how far does each piece move?",
    "batch": "Run thousands of captures; what is finished is not run again.",
}
USAGE = "usage: mover COMMAND [OPTIONS]; mover COMMAND --help tells more"


def main() -> None:
    """Run the command that is named first."""
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help"):
        lines = [f"  {name:<12} {text}" for name, text in COMMANDS.items()]
        say("\n".join([USAGE, "", "Rooms from the people who move in them.", "", *lines]))
        return
    if arguments[0] == "--version":
        from . import __version__

        say(f"mover {__version__}")
        return
    if arguments[0] not in COMMANDS:
        say(f"mover: no command {arguments[0]!r}; there are {', '.join(COMMANDS)}\n{USAGE}")
        raise SystemExit(2)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    logging.getLogger("mover.geometry.kernels").setLevel(logging.INFO)  # what is compiled, once
    command = importlib.import_module(".commands", __package__)
    raise SystemExit(command.run_command(arguments[0], arguments[1:]))
