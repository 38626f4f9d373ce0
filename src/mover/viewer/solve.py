"""Solve again: the main job on the edited capture, in OUT/edited."""

import os
import shutil
from pathlib import Path

import torch

from ..edits import Edit, apply_edits
from ..minimize import Observer
from ..pipeline import reconstruct
from ..presets import Config
from ..refinement import refined_room
from ..results import Origin, write_results
from ..run import Run
from ..types import Capture

FOLDER = "edited"


def solve_again(
    capture: Capture, origin: Origin, config: Config, out: Path, observe: Observer
) -> Path:
    """Run the main job with the edits of `origin`; the folder of the new result.

    What the people of the capture told the first run is not computed again: the stages that do not
    depend on the edited objects are taken from OUT.

    Raises:
        InputError: If an edit does not fit the capture.
    """
    edited, pinned = apply_edits(capture, origin.edits)
    folder = out / FOLDER
    share_stages(out, folder)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        run = Run(folder, observe, device=origin.device)
        room = reconstruct(edited, config, run, pinned)
        if origin.refine:
            room = refined_room(room, edited, observe)
    finally:
        torch.set_num_threads(threads)
    write_results(edited, room, config, run, origin)
    return folder


def started_from(capture: Capture, edits: tuple[Edit, ...]) -> Capture:
    """The capture that `solve_again` starts from."""
    return apply_edits(capture, edits)[0]


def share_stages(out: Path, folder: Path) -> None:
    """Give a folder the finished stages of another, without using more disk where that works."""
    for file in (out / "stages").glob("*/*"):
        target = folder / "stages" / file.parent.name / file.name
        if target.exists():
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(file, target)
        except OSError:
            shutil.copyfile(file, target)
