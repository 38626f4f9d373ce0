"""Whether a result can be true: a run that ends in what no room is says so and writes nothing."""

import tempfile
from pathlib import Path

import torch

from mover.core.errors import InputError
from mover.core.run import Run
from mover.core.types import Capture, Room

LOWEST, HIGHEST = -30.0, -0.05  # [m] of a floor, below the camera
FARTHEST = 300.0  # [m] from the camera to anything of a room
APART = 1.0  # [m] between the given floor and that of the people, from which it is told


def check_floor(ground: float, capture: Capture) -> tuple[str, ...]:
    """Refuse a floor that no camera stands above; warn where a given one is elsewhere.

    Raises:
        InputError: If the floor is above the camera, or farther below it than in any room.
    """
    if not LOWEST <= ground <= HIGHEST:
        side = "above" if ground > 0 else "below"
        cause = "scene.json: 'ground.height'"
        if capture.bodies is not None:
            cause = "bodies.npz: the feet of the people"
        raise InputError(
            f"{cause} put the floor {abs(ground):.3g} m {side} the camera, expected"
            f" {-HIGHEST:g} to {-LOWEST:g} m below; are places in metres, and is z forward?"
        )
    given = capture.scene.ground
    if given is None or abs(given - ground) <= APART:
        return ()
    return (
        f"scene.json: field 'ground.height' has {given:.3g}, but people stand at {ground:.3g} m,"
        " which is taken",
    )


def check_room(room: Room) -> Room:
    """The room, if everything in it is finite and within reach.

    Raises:
        InputError: If an object or a body ended where nothing of a room is.
    """
    for piece in room.scene.objects:
        numbers = torch.cat([piece.t_world_object, piece.yaw[None], piece.scale])
        if not bool(numbers.isfinite().all()) or float(piece.t_world_object.norm()) > FARTHEST:
            where = [round(float(x), 2) for x in piece.t_world_object]
            raise InputError(
                f"{piece.id}: ended at {where} m, expected a place within {FARTHEST:g} m; is its"
                " place, its size or its mask wrong?"
            )
    if room.bodies is not None and not float(room.bodies.verts.abs().max()) <= FARTHEST:
        raise InputError(f"bodies.npz: bodies ended more than {FARTHEST:g} m away, expected nearer")
    return room


def warnings_of(capture: Capture) -> tuple[str, ...]:
    """What a run would tell of a capture besides its own warnings, before it places anything.

    Raises:
        InputError: What it would refuse.
    """
    from mover.pipeline.people import people_of
    from mover.pipeline.presets import ROBUST

    with tempfile.TemporaryDirectory() as folder:
        people = people_of(capture, ROBUST, Run(Path(folder)))
    if people is not None:
        return people.warnings
    ground = capture.scene.ground
    return () if ground is None else check_floor(ground, capture)
