"""Known rooms in which somebody moves as in a clip of motion capture."""

import dataclasses
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from mover.bodies.skinning import open_body
from mover.core.errors import InputError
from mover.core.records import map_tensors
from mover.core.types import BodyPose
from mover.geometry.camera import project, to_camera
from mover_bench.rooms.compose import Plan, draw_plan
from mover_bench.rooms.config import RoomConfig
from mover_bench.rooms.known import Acted, KnownRoom, RefusedError, build, one_thread
from mover_bench.rooms.mocap import retarget
from mover_bench.rooms.placed import distances
from mover_bench.rooms.poses import make_person
from mover_bench.rooms.truth import SINK
from mover_bench.rooms.turns import Y, about, apply, from_vector, to_vector

DRAFTS, PLACES = 60, 30  # rooms, and places in each, that are tried
NEAR = 1.5  # [m], the pelvis is farther from the camera


@one_thread()
def clip_room(
    files: tuple[Path, Path], seed: int, config: RoomConfig | None = None, seconds: float = 0.0
) -> KnownRoom:
    """A known room in which the actor of a clip moves over the floor between the furniture.

    Nothing in the room is made for the clip: what the actor sat on or climbed is not there.

    Args:
        files: The actor's skeleton and the clip.
        seed: Of the room, and of where in it the clip takes place.
        config: How the room is made; None: the usual room, however short the clip.
        seconds: Length of the part that is shown, from the clip's beginning [s]; 0: all of it.

    Raises:
        InputError: If a file is not what it should be, or the clip fits into no room.
    """
    config = config or RoomConfig(least_frames=1, least_touches=0)
    clip = retarget(*files, config.fps)
    frames = min(len(clip.frame), round(seconds * config.fps) or len(clip.frame))
    assert clip.pose is not None, "retargeted bodies have parameters"
    pose = map_tensors(lambda x: x[:frames].double(), clip.pose)
    refused: list[str] = []
    for draft in range(DRAFTS):
        rng = np.random.default_rng([seed, draft])
        size = (config.width, config.height)
        plan = draw_plan(rng, size, config.pieces, config.least_pixels, config.plan)
        act = _somewhere(plan, pose, rng)
        if act is None:
            refused.append(f"draft {draft}: the clip stands in furniture or leaves the view")
            continue
        try:
            return build(plan, (act,), config, f"{files[1].stem}_{seed}", tuple(refused))
        except RefusedError as error:
            refused.append(f"draft {draft}: {error}")
    wide, _, deep = (pose.transl.amax(0) - pose.transl.amin(0)).tolist()
    raise InputError(
        f"{files[1].name}: {frames / config.fps:.1f} s over {wide:.1f} x {deep:.1f} m fit into none"
        f" of {DRAFTS} rooms, expected a clip on a free floor (try a shorter part of it)"
    )


def _somewhere(plan: Plan, pose: BodyPose, rng: np.random.Generator) -> Acted | None:
    """The clip turned and moved to where the skin is in view and out of walls and furniture."""
    origin = make_person([0.0] * 10).origin
    pelvis = pose.transl.numpy() + origin
    middle = (pelvis.max(0) + pelvis.min(0)) / 2 * [1, 0, 1]
    roots = from_vector(pose.global_orient.numpy())
    for _ in range(PLACES):
        turn = about(Y, np.array(rng.uniform(-np.pi, np.pi)))
        x, z = rng.uniform(*plan.walls)
        moved = apply(turn, pelvis - middle) + np.array([x, 0.0, z])
        if not _in_view(moved, plan):
            continue
        placed = dataclasses.replace(
            pose,
            global_orient=torch.from_numpy(to_vector(turn @ roots)),
            transl=torch.from_numpy(moved - origin),
        )
        skin = open_body().posed(placed)[0].numpy().reshape(-1, 3)
        inside = ((skin[:, [0, 2]] > plan.walls[0]) & (skin[:, [0, 2]] < plan.walls[1])).all()
        if inside and all(distances(piece, skin).min() > -SINK for piece in plan.pieces):
            labels = ("clip",) * len(moved)
            return Acted(placed, moved, origin, labels, (-1,) * len(moved))
    return None


def _in_view(pelvis: Float[np.ndarray, "frames 3"], plan: Plan) -> bool:
    """Whether the pelvis is before the camera and inside the image in all frames."""
    view = plan.view
    eye = torch.from_numpy(pelvis - [0.0, view.height, 0.0]).float()
    cam = to_camera(eye, view.camera.R_cam_world)
    pixel = project(cam, view.camera.K)
    size = torch.tensor([view.camera.width, view.camera.height])
    return bool((cam[:, 2] > NEAR).all() and ((pixel > 0) & (pixel < size)).all())
