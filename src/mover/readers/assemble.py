"""Put the parts of a capture together and check that they fit one another."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry.rotations import rot_y
from ..types import Bodies, Camera, Capture, Detection, Piece, Scene
from .bodies_file import bodies_of, read_touch
from .camera_file import camera_of
from .fields import At, Warn, get, items, listed, maybe, number, refuse
from .hypotheses_file import hypotheses_of
from .objects_file import detections_of
from .people_file import PeopleFile, people_of
from .pose_file import into_camera
from .scene_file import LoadMesh, scene_of

LEAST_HEIGHT, MOST_HEIGHT = 0.1, 100.0  # [m], of the camera above the floor
NOBODY = PeopleFile(None, None, None, frozenset())


@dataclass(frozen=True)
class Sources:
    """The files of a capture, or the same from memory; None: there is no such file."""

    name: str
    camera: At
    scene: At
    objects: At
    people: At | None
    bodies: At | None
    contacts: At | None
    load_mesh: LoadMesh
    load_image: Callable[[Camera, Warn], Tensor | None]
    n_frames: int | None
    """How many frames the video has, where that is known."""
    hypotheses: At | None = None


def assemble(sources: Sources) -> Capture:
    """Check everything and build the capture.

    Raises:
        InputError: If anything is wrong.
    """
    warnings: list[str] = []
    warn = warnings.append
    other = camera_of(sources.camera)
    scene, turn = scene_of(sources.scene, sources.load_mesh, other, warn)
    detections = detections_of(sources.objects, scene.camera, warn)
    _check_annotations(sources, scene, detections, warn)
    found = NOBODY
    if sources.people is not None:
        found = people_of(sources.people, scene.camera, warn)
    bodies = _bodies_of(sources, scene.camera, turn, found.fps, warn)
    touch = _touch_of(sources, bodies, warn)
    _check_people(sources, found, bodies, warn)
    others: tuple[Piece, ...] = ()
    if sources.hypotheses is not None:
        others = hypotheses_of(sources.hypotheses, sources.load_mesh, scene, warn)
    return Capture(
        name=sources.name,
        scene=scene,
        camera_height=_camera_height(sources.camera),
        detections=detections,
        reference=sources.load_image(scene.camera, warn),
        reference_people=found.reference,
        bodies=bodies,
        people=found.people,
        touch=touch,
        warnings=tuple(warnings),
        hypotheses=others,
    )


def _camera_height(at: At) -> float | None:
    """Known height of the camera above the floor [m]."""
    given = maybe(at, "height")
    return None if given is None else number(given, LEAST_HEIGHT, MOST_HEIGHT)


def _check_annotations(
    sources: Sources, scene: Scene, detections: tuple[Detection, ...], warn: Warn
) -> None:
    """Objects name annotations that exist; what has no partner is told."""
    known, used = {d.id for d in detections}, {p.annotation for p in scene.pieces}
    objects = items(get(sources.scene, "objects"))
    for item, piece in zip(objects, scene.pieces, strict=True):
        if piece.annotation is not None and piece.annotation not in known:
            refuse(get(item, "annotation"), f"the id of an annotation in {sources.objects.file}")
    if bare := [piece.id for piece in scene.pieces if piece.annotation is None]:
        warn(f"scene.json: {listed('object', bare)} without annotation, no evidence in the image")
    if alone := [f"{d.id} {d.category}" for d in detections if d.id not in used]:
        warn(f"{sources.objects.file}: {listed('annotation', alone)} without object in the scene")
    if not scene.pieces:
        warn("scene.json: there are no objects")


def _bodies_of(
    sources: Sources, camera: Camera, turn: float, fps: float | None, warn: Warn
) -> Bodies | None:
    """Bodies in the camera frame."""
    if sources.bodies is None:
        warn("bodies.npz: there is none, so only the image speaks")
        return None
    bodies = bodies_of(sources.bodies, warn)
    if bodies.space == "world":
        # The file's world is that of scene.json, before its heading was taken out.
        bodies = into_camera(bodies, camera.R_cam_world @ rot_y(torch.tensor(turn)))
    if float(bodies.verts[..., 2].median()) <= 0:
        axes = "the camera frame is x right, y down, z forward"
        warn(f"bodies.npz: most of the bodies are behind the camera; {axes}")
    return dataclasses.replace(bodies, fps=fps) if bodies.fps is None else bodies


def _touch_of(
    sources: Sources, bodies: Bodies | None, warn: Warn
) -> Float[Tensor, "bodies verts"] | None:
    """The user's own chances of contact."""
    if sources.contacts is None:
        return None
    if bodies is None:
        warn("contacts.npz: there are no bodies, so it is not used")
        return None
    return read_touch(sources.contacts, bodies)


def _check_people(sources: Sources, found: PeopleFile, bodies: Bodies | None, warn: Warn) -> None:
    """Frames exist; rows of bodies and of masks that have no partner are told."""
    people, count = found.people, sources.n_frames
    if count is not None:
        _check_frames(sources, found, bodies, count)
    if people is None:
        warn("people.json: there are no masks of people, so nothing is known about depth order")
        return
    if bodies is None:
        return
    masks = set(zip(people.frame.tolist(), people.person.tolist(), strict=True))
    rows = set(zip(bodies.frame.tolist(), bodies.person.tolist(), strict=True))
    if alone := len(rows - masks):
        warn(f"people.json: {alone} of {len(rows)} bodies have no mask and no depth order")
    if alone := len(masks - rows):
        warn(f"bodies.npz: {alone} of {len(masks)} masks of people have no body")


def _check_frames(sources: Sources, found: PeopleFile, bodies: Bodies | None, count: int) -> None:
    """No frame lies behind the end of the video."""
    expected = f"a frame from 0 to {count - 1}, as frames/ has {count}"
    if bodies is not None and sources.bodies is not None and bodies.frame.max() >= count:
        refuse(get(sources.bodies, "frame"), expected, f"{int(bodies.frame.max())}")
    if found.frames and sources.people is not None and max(found.frames) >= count:
        refuse(get(sources.people, "images"), expected, f"{max(found.frames)}")
