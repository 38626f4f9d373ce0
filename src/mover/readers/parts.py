"""Parts of a capture: what one tool knows. Parts of several tools make a capture (merge.py)."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from jaxtyping import Float
from torch import Tensor

from ..records import InputError
from ..types import Bodies, Camera, Mesh, Scene
from .assemble import Sources
from .fields import At, Warn, read_json
from .image_file import image_size, read_image_file
from .mesh_file import read_mesh
from .npz_file import read_npz
from .objects_file import image_name

LoadMesh = Callable[[At], tuple[Mesh, str]]
LoadImage = Callable[[Camera, Warn], Float[Tensor, "h w 3"] | None]
UNKNOWN = "object"
"""The category of what a tool gives no name; it fits any other."""


def no_mesh(at: At) -> NoReturn:
    """There are no meshes."""
    raise InputError(f"{at.place} names a mesh, expected none here")


@dataclass(frozen=True)
class Parts:
    """What a source knows of a capture; None: nothing of that file of the format."""

    name: str
    camera: At | None = None
    """The fields of camera.json; the rotation may be missing."""
    scene: At | None = None
    """The fields of scene.json, without its camera."""
    tilt: Any = None
    """R_cam_world of the world in which `scene` is, where it is not that of `camera`."""
    objects: At | None = None
    """The fields of objects.json."""
    people: At | None = None
    """The fields of people.json."""
    bodies: At | None = None
    """The arrays of bodies.npz."""
    contacts: At | None = None
    """The arrays of contacts.npz."""
    load_mesh: LoadMesh = no_mesh
    """Gives the mesh that a field of `scene` names."""
    load_image: LoadImage | None = None
    image_size: tuple[int, int] | None = None
    """Width and height of the image, where it is known [px]."""
    n_frames: int | None = None
    hypotheses: At | None = None
    """The fields of hypotheses.json."""
    copies: Mapping[str, Path] = field(default_factory=dict[str, Path])
    """Files that are taken as they are, by their place in the capture."""
    trees: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """JSON files beside the rest, by their place in the capture."""
    scenes: Mapping[str, Scene] = field(default_factory=dict[str, Scene])
    """Scenes beside the initial one, by their folder: `truth`, ..."""
    people_of: Mapping[str, Bodies] = field(default_factory=dict[str, Bodies])
    """People of those scenes, by their folder."""
    notes: tuple[str, ...] = ()
    """What a reader wants to tell."""


@dataclass(frozen=True)
class Hints:
    """What the user says beside the source itself."""

    camera: At | None = None
    """The fields of camera.json, complete or in part."""
    image: Path | None = None
    """The reference image."""
    up: str = ""
    """Which way is up in the source, where its format leaves that open: y, -y or z."""
    names: Mapping[str, str] = field(default_factory=dict[str, str])
    """Categories by number, file name or index, where the source has none."""
    recording: str = ""
    """Which recording of a data set."""
    boxes: Path | None = None
    """bbox3d.json: the true boxes of MOVER's authors."""
    work: Path = Path()
    """A folder for meshes that a reader makes; it goes away after the import."""


def image_parts(path: Path, *, mirrored: bool = False) -> tuple[LoadImage, tuple[int, int]]:
    """How to load a picture, and its size.

    Args:
        path: Of the picture.
        mirrored: It is stored mirrored and must be flipped left to right.

    Raises:
        InputError: If it cannot be read.
    """
    size = image_size(path)

    def load(camera: Camera, warn: Warn) -> Float[Tensor, "h w 3"]:
        del warn
        picture = read_image_file(At(path.name, path.name), path, camera)
        return picture.flip(1) if mirrored else picture

    return load, size


def folder_parts(folder: Path) -> Parts:
    """What is already in a capture's folder; the camera of scene.json is taken out of it.

    Raises:
        InputError: If a file is no JSON or no .npz.
    """
    trees = {n: _tree(folder / f"{n}.json") for n in ("camera", "scene", "objects", "people")}
    camera, scene = trees["camera"], trees["scene"]
    if scene is not None and isinstance(scene.value, dict):
        own: Any = scene.value.get("camera")
        base: Any = {} if camera is None else camera.value
        if isinstance(own, dict) and isinstance(base, dict):
            camera = At({**base, **own}, scene.file, "camera")
        scene = At({k: v for k, v in scene.value.items() if k != "camera"}, scene.file)
    load, size = _reference(folder, trees["objects"])
    return Parts(
        name=folder.resolve().name,
        camera=camera,
        scene=scene,
        objects=trees["objects"],
        people=trees["people"],
        bodies=read_npz(path) if (path := folder / "bodies.npz").exists() else None,
        contacts=read_npz(path) if (path := folder / "contacts.npz").exists() else None,
        load_mesh=lambda at: read_mesh(at, folder),
        load_image=load,
        image_size=size,
    )


def _tree(path: Path) -> At | None:
    return read_json(path) if path.exists() else None


def _reference(folder: Path, objects: At | None) -> tuple[LoadImage | None, tuple[int, int] | None]:
    """The picture of a folder."""
    names = ["reference.png", "reference.jpg"]
    named = None if objects is None else image_name(objects)
    if named is not None and isinstance(named.value, str):
        names = [named.value, *names]
    for name in names:
        path = (folder / name).resolve()
        if path.is_relative_to(folder.resolve()) and path.is_file():
            return image_parts(path)
    return None, None


def sources_of(parts: Parts) -> Sources:
    """The parts as a whole capture; camera, scene and objects must be there."""
    assert parts.camera is not None
    assert parts.scene is not None
    assert parts.objects is not None
    return Sources(
        name=parts.name,
        camera=parts.camera,
        scene=parts.scene,
        objects=parts.objects,
        people=parts.people,
        bodies=parts.bodies,
        contacts=parts.contacts,
        load_mesh=parts.load_mesh,
        load_image=parts.load_image or _no_image,
        n_frames=parts.n_frames,
        hypotheses=parts.hypotheses,
    )


def _no_image(camera: Camera, warn: Warn) -> None:
    del camera
    warn("reference.jpg: there is no picture to draw on")


def parts_of(sources: Sources) -> Parts:
    """A whole capture as parts."""
    known: dict[str, Any] = {f.name: getattr(sources, f.name) for f in dataclasses.fields(Sources)}
    return Parts(**known)
