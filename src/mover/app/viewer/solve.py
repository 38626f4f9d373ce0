"""Solve again in OUT/edited, and watch the furniture move as it is optimised."""

import dataclasses
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mover.app.results import Origin, write_results
from mover.core.observe import Observer, Step
from mover.core.run import Run
from mover.core.types import Capture, Scene, SceneObject
from mover.geometry.boxes import box_of
from mover.geometry.rotations import rot_y
from mover.io.capture.edits import apply_edits
from mover.pipeline.presets import Config
from mover.pipeline.reconstruct import reconstruct
from mover.pipeline.refinement import refined_room
from mover.stages.objects.place_inputs import Moment

PAUSE = 0.15  # [s] between two pictures


class Stopped(Exception):
    """The user stopped the run."""


@dataclass
class Watch:
    """An observer that shows the room a few times a second."""

    pieces: tuple[SceneObject, ...]
    """Of the scene that the run starts from."""
    show: Callable[[Scene], None]
    tell: Callable[[Step], None]
    """Gets the stage and its progress as often as the room."""
    stop: bool = False
    """Set it to end the run at its next step."""
    last: float = field(default=-1e9)
    energies: list[float] = field(default_factory=lambda: [])
    """Of each room that was shown since furniture began to move, or began anew."""
    stage: str = ""

    def __call__(self, step: Step) -> None:
        """Show the step if it is time.

        Raises:
            Stopped: If `stop` is set.
        """
        if self.stop:
            raise Stopped
        now = time.monotonic()
        if now - self.last < PAUSE and step.index + 1 < step.steps:
            return
        self.last = now
        scene = seen_in(step, self.pieces)
        if scene is not None and step.energy is not None:
            if step.stage != self.stage:
                self.energies.clear()
            self.energies.append(float(step.energy.per_item.detach().amin(0).sum()))
            self.show(scene)
        self.stage = step.stage
        self.tell(step)


def seen_in(step: Step, pieces: tuple[SceneObject, ...]) -> Scene | None:
    """The room of a step of `place_objects`, each object at the best of its starts."""
    if step.at is None or step.energy is None:
        return None
    with torch.no_grad():
        moment: Any = step.at()
    if not isinstance(moment, Moment):
        return None
    best = step.energy.per_item.detach().argmin(0)
    index = torch.arange(len(best))
    layout = moment.layout
    t, yaw = layout.t_world_object[best, index], layout.yaw[best, index]
    scale = layout.log_scale[best, index].exp()
    moved = tuple(
        _standing(piece, t[i].detach(), yaw[i].detach(), scale[i].detach())
        for i, piece in enumerate(pieces)
    )
    return Scene(moment.camera, moment.ground, moved)


def _standing(
    piece: SceneObject, base: Float[Tensor, "3"], yaw: Float[Tensor, ""], grown: Float[Tensor, "3"]
) -> SceneObject:
    """The piece with the centre of its box's bottom at `base` [m]."""
    still = dataclasses.replace(
        piece, t_world_object=torch.zeros(3), yaw=torch.tensor(0.0), scale=piece.scale * grown
    )
    box = box_of(still)
    foot = box.center - torch.tensor([0.0, 0.5, 0.0]) * box.size
    return dataclasses.replace(still, t_world_object=base - rot_y(yaw) @ foot, yaw=yaw)


# Solve again: the main job on the edited capture, in OUT/edited.


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
