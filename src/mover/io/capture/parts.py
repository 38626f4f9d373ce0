"""Parts of a capture: what one tool knows. Parts of several tools make a capture (build.py)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from jaxtyping import Float
from torch import Tensor

from mover.core.errors import InputError
from mover.core.types import Camera, DepthImage, Mesh
from mover.io.files.fields import At
from mover.io.files.images import image_size, read_image_file

LoadMesh = Callable[[At], tuple[Mesh, str]]
LoadImage = Callable[[Camera], Float[Tensor, "h w 3"]]
LoadDepth = Callable[[Camera], DepthImage | None]
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
    """The fields of objects.json, as below those of people.json and furniture.json."""
    people: At | None = None
    furniture: At | None = None
    bodies: At | None = None
    """The arrays of bodies.npz, as below those of contacts.npz and cameras.npz."""
    contacts: At | None = None
    cameras: At | None = None
    load_mesh: LoadMesh = no_mesh
    """Gives the mesh that a field of `scene` names."""
    load_image: LoadImage | None = None
    no_image: str = "reference.jpg"
    """What the warning names where there is no picture."""
    image_size: tuple[int, int] | None = None
    """Width and height of the image, where it is known [px]."""
    load_depth: LoadDepth | None = None
    """Gives the measured depth of the reference picture."""
    n_frames: int | None = None
    """How many frames the video has, where that is known."""
    hypotheses: At | None = None
    """The fields of hypotheses.json."""
    beside: Mapping[str, Callable[[Path], object]] = field(
        default_factory=dict[str, Callable[[Path], object]]
    )
    """What writes further files (frames, keypoints, truth/scene.json), by their place."""
    notes: tuple[str, ...] = ()
    """Notes of the reader to the user."""


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
    recordings: tuple[str, ...] = ()
    """Several recordings of one room of a data set."""
    boxes: Path | None = None
    """bbox3d.json: the true boxes of MOVER's authors."""
    work: Path = Path()
    """A folder for meshes that a reader makes; it goes away after the import."""


def image_parts(path: Path, *, mirrored: bool = False) -> tuple[LoadImage, tuple[int, int]]:
    """How to load a picture (flipped left to right, where it is stored mirrored), and its size."""

    def load(camera: Camera) -> Float[Tensor, "h w 3"]:
        picture = read_image_file(At(path.name, path.name), path, camera)
        return picture.flip(1) if mirrored else picture

    return load, image_size(path)
