"""Capture folders (FORMAT.md): camera, initial scene, annotations, bodies, people."""

import re
from collections.abc import Callable
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from ..records import InputError
from ..types import Camera, Capture, Mesh
from .assemble import Sources, assemble
from .bodies_file import write_bodies
from .camera_file import camera_to_json
from .fields import At, Warn, read_json, write_json
from .hypotheses_file import FILE as HYPOTHESES
from .hypotheses_file import write_hypotheses
from .image_file import read_image, write_image
from .mesh_file import read_mesh
from .npz_file import read_npz, write_npz
from .objects_file import detections_to_json, image_name
from .people_file import people_to_json
from .scene_file import write_scene

REFERENCE = "reference.jpg"


def read_capture(folder: Path) -> Capture:
    """Read and check a capture folder; its truth is not looked at.

    Raises:
        InputError: If any field of any file is wrong.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder, expected a capture")
    objects = read_json(folder / "objects.json")

    def load_mesh(at: At) -> tuple[Mesh, str]:
        return read_mesh(at, folder)

    def load_image(camera: Camera, warn: Warn) -> Float[Tensor, "h w 3"] | None:
        named = image_name(objects)
        if named is None and not (folder / REFERENCE).is_file():
            warn(f"{REFERENCE}: there is no picture to draw on")
            return None
        at = At(REFERENCE, "objects.json", "images[0].file_name") if named is None else named
        return read_image(at, folder, camera)

    return assemble(
        Sources(
            name=folder.resolve().name,
            camera=read_json(folder / "camera.json"),
            scene=read_json(folder / "scene.json"),
            objects=objects,
            people=_if_there(folder / "people.json", read_json),
            bodies=_if_there(folder / "bodies.npz", read_npz),
            contacts=_if_there(folder / "contacts.npz", read_npz),
            load_mesh=load_mesh,
            load_image=load_image,
            n_frames=_count_frames(folder / "frames"),
            hypotheses=_if_there(folder / HYPOTHESES, read_json),
        )
    )


def _if_there(path: Path, read: Callable[[Path], At]) -> At | None:
    """The content of an optional file."""
    return read(path) if path.exists() else None


def _count_frames(folder: Path) -> int | None:
    """One more than the last numbered picture, None without pictures."""
    if not folder.is_dir():
        return None
    names = (re.fullmatch(r"([0-9]{6,8})\.(jpg|jpeg|png)", p.name) for p in folder.iterdir())
    numbers = [int(name[1]) for name in names if name]
    return max(numbers) + 1 if numbers else None


def write_capture(capture: Capture, folder: Path) -> None:
    """Write a capture folder, without frames; reading it gives the same capture.

    The picture is kept with 8 bits a channel.

    Raises:
        ValueError: If the folder has a file that this capture lacks: the two would mix.
    """
    _check_room_for(capture, folder)
    camera = camera_to_json(capture.scene.camera)
    if capture.camera_height is not None:
        camera["height"] = capture.camera_height
    name = None
    if capture.reference is not None:
        name = "reference.png"
        write_image(capture.reference, folder / name)
    bodies, people = capture.bodies, capture.people
    if bodies is not None:
        write_bodies(bodies, folder / "bodies.npz")
    if people is not None or capture.reference_people is not None:
        frames = [] if bodies is None else bodies.frame.tolist()
        fps = None if bodies is None else bodies.fps
        tree = people_to_json(people, capture.reference_people, fps, frames)
        write_json(tree, folder / "people.json")
    if capture.touch is not None:
        touch = capture.touch.detach().cpu().numpy()
        write_npz({"probability": touch}, folder / "contacts.npz")
    objects = detections_to_json(capture.detections, capture.scene.camera, name)
    write_json(objects, folder / "objects.json")
    write_json(camera, folder / "camera.json")
    write_scene(capture.scene, folder / "scene.json")
    if capture.hypotheses:
        own = {piece.id: [piece] for piece in capture.scene.pieces}
        for piece in capture.hypotheses:
            own[piece.id].append(piece)
        write_hypotheses(folder, {k: v for k, v in own.items() if len(v) > 1}, {})


def _check_room_for(capture: Capture, folder: Path) -> None:
    """Refuse a folder whose optional files would join a capture that has none."""
    wanted = {
        "bodies.npz": capture.bodies is not None,
        "people.json": capture.people is not None or capture.reference_people is not None,
        "contacts.npz": capture.touch is not None,
    }
    for name, is_written in wanted.items():
        if not is_written and (folder / name).exists():
            raise ValueError(f"{folder} has {name}, which the capture lacks; choose a new folder")
