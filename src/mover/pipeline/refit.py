"""Refine people as the paper does: SMPLify-X again, in the room that they helped to find (Sec. 4).

`PROX` has a scanned scene; here it is the estimated one. The bodies of the result are where the
descent begins, keypoints are what it is held to, and floor, soles, furniture and contact are added
(`fitting.room`).
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies import load_model
from mover.bodies.parts import parts_of
from mover.bodies.posture import touching
from mover.bodies.skin import PARTS
from mover.bodies.skinning import SkinnedBody
from mover.bodies.smpl_model import SmplBody
from mover.core.errors import InputError
from mover.core.observe import Observer, silent
from mover.core.records import map_tensors, rows_of
from mover.core.types import Bodies, Keypoints, Room
from mover.fitting.bodies import FitInputs, fit_bodies
from mover.fitting.config import FitConfig
from mover.fitting.presets import PAPER_ROOM
from mover.fitting.prior import ANGLES, PosePrior
from mover.fitting.room import FitRoom
from mover.geometry.camera import project
from mover.io.capture.pose_file import into_camera
from mover.pipeline.outcome import to_world
from mover.stages.people.body_evidence import Picked, pick, surroundings_of

SITTING = ("seat", "left_thigh", "right_thigh", "back", "left_palm", "right_palm")
"""Skin that touches furniture, PROX's parts."""
SURE = 0.5  # chance above which a sole touches, the paper's


@dataclass(frozen=True)
class Refit:
    """People fitted again."""

    bodies: Bodies
    """In the room's world: those with keypoints."""
    rows: Int[Tensor, " bodies"]
    """Their rows among the people of the room."""
    warnings: tuple[str, ...]


def refit_bodies(
    room: Room,
    keypoints: Keypoints,
    touch: Float[Tensor, "bodies verts"] | None = None,
    settings: tuple[FitConfig, PosePrior] = (PAPER_ROOM, ANGLES),
    observe: Observer = silent,
) -> Refit:
    """Fit the people of a room to keypoints again, with its floor and its furniture.

    Args:
        room: With people whose parameters are known.
        keypoints: What is seen of them.
        touch: Chance that each vertex touches something; None: from their posture.
        settings: Weights of the fit, and the prior of poses.
        observe: Called after each stage.

    Raises:
        InputError: If people have no parameters, or there is no floor or nobody is seen.
    """
    bodies, model = _people(room)
    camera, (config, prior) = room.scene.camera, settings
    given = replace(into_camera(bodies, camera.R_cam_world), space="camera")
    pairs = pairs_of(given, keypoints, camera.K)
    if not len(pairs):
        raise InputError("keypoints: none is of a frame of bodies.npz, expected the same numbers")
    rows = pairs[:, 1]
    seen = replace(rows_of(keypoints, pairs[:, 0]), person=bodies.person[rows])
    start = rows_of(given, rows)
    around = rows_of(room_around(room, bodies, touch), rows)
    found = fit_bodies(FitInputs(seen, camera, model, start, prior, room=around), config, observe)
    rows, refitted = rows[found.rows], to_world(found.bodies, camera)
    lost = len(bodies.frame) - len(rows.unique())
    left = (f"{lost} of {len(bodies.frame)} bodies have no keypoints: left out",) if lost else ()
    return Refit(refitted, rows, (*found.warnings, *left))


def pairs_of(
    bodies: Bodies, keypoints: Keypoints, K: Float[Tensor, "3 3"]
) -> Int[Tensor, "pairs 2"]:
    """Rows of keypoints and of bodies that are one person, by where they are in their frame.

    Detectors lose people and find them again under another number: numbers count for nothing.
    """
    from scipy.optimize import linear_sum_assignment

    points = bodies.joints if bodies.joints is not None else bodies.verts[:, ::50]
    theirs = project(points, K.to(points)).mean(1)
    known = (keypoints.confidence > 0) & keypoints.points.isfinite().all(-1)
    ours = keypoints.points.where(known[..., None], torch.nan).nanmean(1)
    found: list[tuple[int, int]] = []
    for frame in keypoints.frame[known.any(1)].unique().tolist():  # some people each
        mine = ((keypoints.frame == frame) & known.any(1)).nonzero()[:, 0]
        there = (bodies.frame == frame).nonzero()[:, 0]
        cost = torch.cdist(ours[mine].double(), theirs[there].double())
        rows, columns = linear_sum_assignment(cost.nan_to_num(1e6).numpy())
        found += zip(mine[rows].tolist(), there[columns].tolist(), strict=True)
    return torch.tensor(sorted(found)).reshape(-1, 2).long()


def _people(room: Room) -> tuple[Bodies, SkinnedBody | SmplBody]:
    """The people of a room with their body model."""
    bodies = room.bodies
    if bodies is None or not len(bodies.frame) or room.scene.ground is None:
        lack = "bodies" if room.scene.ground is not None else "floor"
        raise InputError(f"the room has no {lack}: there is nothing to refine")
    if bodies.pose is None:
        raise InputError(
            "bodies.npz: has no parameters of a body model, expected 'body_pose', 'betas', ...: "
            "SMPLify-X fits them anew"
        )
    model = load_model(bodies.pose.model, bodies.pose.gender)
    assert isinstance(model, SkinnedBody | SmplBody)
    return map_tensors(lambda x: x.float() if x.is_floating_point() else x, bodies), model


def room_around(room: Room, bodies: Bodies, touch: Float[Tensor, "bodies verts"] | None) -> FitRoom:
    """The room (its closed furniture) as the fit meets it, with one row for each body.

    Contacts that are not given follow from the postures.
    """
    parts = parts_of(bodies)
    picked = pick(bodies, parts)
    around = surroundings_of(room, None)
    if touch is None or touch.shape != bodies.verts.shape[:2]:
        touch = touching(bodies, parts, around.floor)
    sole = _of(picked, ("left_sole", "right_sole"))
    return FitRoom(
        R_cam_world=around.camera.R_cam_world.float(), floor=around.floor,
        furniture=around.furniture, surface=around.surface.points, normals=around.surface.normals,
        picked=picked.index, even=picked.even,
        share=bodies.verts.shape[1] / float(picked.even.sum()),
        may_touch=_of(picked, SITTING), stands=(touch[:, picked.index] > SURE) & sole,
    )  # fmt: skip


def _of(picked: Picked, names: tuple[str, ...]) -> Bool[Tensor, " picked"]:
    return torch.isin(picked.part, torch.tensor([PARTS.index(name) for name in names]))
