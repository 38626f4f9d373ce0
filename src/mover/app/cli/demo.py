"""What `demo` does: a capture that comes with the package, reconstructed and compared."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mover.app.cli import say
from mover.app.cli.config import Device, parsed, preset_named
from mover.app.cli.run import reconstruct_into


@dataclass(frozen=True)
class DemoArgs:
    """Reconstruct a known room from a capture with realistic noise, and compare with the truth."""

    out: Path = Path("demo")
    """Folder for the capture and the result."""
    preset: str = "robust"
    """paper or robust."""
    device: Device = "cpu"
    """cpu, cuda or auto."""


def demo(arguments: Sequence[str]) -> None:
    """`mover demo`."""
    args = parsed(DemoArgs, "mover demo", arguments)
    config = preset_named(args.preset)
    from mover.app.demo import write_demo
    from mover.app.report.page import write_report
    from mover.app.results import Origin, report_of
    from mover.core.devices import device_of
    from mover.evaluate.evaluation import FIRST, evaluate_folder, table
    from mover.io.capture.scene_file import read_scene
    from mover.io.formats import read

    device, folder = device_of(args.device), args.out / "capture"
    if not folder.exists():
        say("writing the capture of a known room: furniture, a person, masks ...")
        write_demo(folder)
    capture = read("folder", folder)
    origin = Origin(str(folder.resolve()), device=device)
    found, run = reconstruct_into(args.out / "room", capture, config, origin, report=False)
    metrics = evaluate_folder(args.out / "room", folder / "truth", physics=False)
    truth = read_scene(folder / "truth" / "scene.json", None)
    content = report_of(capture, found, config, run, truth=truth, metrics=metrics)
    report = write_report(args.out / "room", content)
    say(f"\n{table(metrics, FIRST)}\n\nreport: {report}")
