"""The room in the 3D view: floor, camera, furniture before and after the run, people."""

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mover.app.report.scene_view import Thinning, floor_of, thin, thin_choice
from mover.core.colours import Colour, colour, person_colour
from mover.core.types import Bodies, Camera, Scene, SceneObject

FACES, FACES_BODY = 20_000, 6000  # of an object and of a body, at most
WIDEST = 800  # [px] of the picture in the frustum
World = Literal["after", "before"]


@dataclass
class Drawing:
    """Handles of everything that is drawn."""

    server: Any
    after: dict[str, Any] = field(default_factory=dict[str, Any])
    """Furniture as it is, by id."""
    before: dict[str, Any] = field(default_factory=dict[str, Any])
    """Furniture as it was initially."""
    ground: Any = None
    camera: Any = None
    camera_visible: bool = True
    colours: dict[str, Colour] = field(default_factory=dict[str, Colour])


def draw_room(drawing: Drawing, scene: Scene, world: World) -> None:
    """Draw the furniture of a world; what is drawn already only moves."""
    handles: dict[str, Any] = getattr(drawing, world)
    for name in set(handles) - {item.id for item in scene.objects}:
        handles.pop(name).remove()
    for item in scene.objects:
        tint = drawing.colours.setdefault(item.id, colour(len(drawing.colours)))
        if item.id not in handles:
            small = thin(item.mesh, FACES)
            handles[item.id] = drawing.server.scene.add_mesh_simple(
                f"/{world}/{item.id}", small.verts.detach().numpy(), small.faces.numpy(),
                color=bytes_of(tint), flat_shading=True, side="double",
            )  # fmt: skip
        move_object(handles[item.id], item)


def move_object(handle: Any, item: SceneObject) -> None:  # noqa: ANN401
    """Put a drawn object where it stands."""
    half = float(item.yaw) / 2
    handle.position = tuple(item.t_world_object.detach().tolist())
    handle.wxyz = (math.cos(half), 0.0, math.sin(half), 0.0)
    handle.scale = tuple(item.scale.detach().tolist())


def draw_camera(drawing: Drawing, scene: Scene, image: Float[Tensor, "h w 3"] | None) -> None:
    """Draw the floor and the camera with its picture."""
    for handle in (drawing.ground, drawing.camera):
        if handle is not None:
            handle.remove()
    camera = scene.camera
    picture = None
    if image is not None:
        every = max(1, -(-image.shape[1] // WIDEST))
        picture = (255 * image[::every, ::every]).round().clamp(0, 255).to(torch.uint8).numpy()
    drawing.ground = drawing.server.scene.add_grid(
        "/ground", 40.0, 40.0, plane="xz", cell_size=0.5, section_size=1.0, plane_opacity=0.0,
        position=(0.0, floor_of(scene), 0.0), fade_distance=30.0,
    )  # fmt: skip
    drawing.camera = drawing.server.scene.add_camera_frustum(
        "/camera", fov=2 * math.atan(camera.height / (2 * float(camera.K[1, 1]))),
        aspect=camera.width / camera.height, scale=0.4, thickness=0.006, color=(60, 60, 60),
        image=picture, cast_shadow=False, wxyz=camera_wxyz(camera),
    )  # fmt: skip
    drawing.camera.visible = drawing.camera_visible


def camera_wxyz(camera: Camera) -> Float[np.ndarray, "4"]:
    """The quaternion of the camera's axes in the world."""
    from viser.transforms import SO3  # pyright: ignore[reportMissingImports]

    return SO3.from_matrix(camera.R_cam_world.detach().double().numpy().T).wxyz


def bytes_of(tint: Colour) -> tuple[int, int, int]:
    """A colour in whole numbers up to 255."""
    red, green, blue = (round(255 * c) for c in tint)
    return red, green, blue


@dataclass
class DrawnPeople:
    """The drawn people, at a moment of a time line of all frames that have any."""

    server: Any
    bodies: Bodies | None = None
    frames: Sequence[int] = ()
    rows: dict[tuple[int, int], int] = field(default_factory=dict[tuple[int, int], int])
    """Row of each frame and person."""
    few: Thinning | None = None
    handles: dict[int, Any] = field(default_factory=dict[int, Any])
    visible: bool = True
    lock: threading.RLock = field(default_factory=threading.RLock)

    def replace(self, bodies: Bodies | None) -> None:
        """Take other people, or the same in another world."""
        with self.lock:
            for handle in self.handles.values():
                handle.remove()
            self.handles, self.bodies, self.frames, self.rows = {}, None, (), {}
            if bodies is None or not len(bodies.verts):
                return
            pairs = zip(bodies.frame.tolist(), bodies.person.tolist(), strict=True)
            self.rows = {pair: row for row, pair in enumerate(pairs)}
            self.frames = bodies.frame.unique().tolist()
            middle = bodies.verts[len(bodies.verts) // 2]
            self.few = thin_choice(middle, bodies.faces, FACES_BODY)
            self.bodies = bodies

    def show(self, moment: int) -> None:
        """Draw the bodies of a moment."""
        with self.lock:
            if self.bodies is None:
                return
            frame = self.frames[min(max(moment, 0), len(self.frames) - 1)]
            for person in self.bodies.person.unique().tolist():
                row = self.rows.get((frame, person))
                if row is not None:
                    self._draw(self.bodies, person, row)
                if person in self.handles:
                    self.handles[person].visible = self.visible and row is not None

    def _draw(self, bodies: Bodies, person: int, row: int) -> None:
        assert self.few is not None
        verts = bodies.verts[row, self.few.kept].detach().float().numpy()
        if person in self.handles:
            self.handles[person].vertices = verts
            return
        self.handles[person] = self.server.scene.add_mesh_simple(
            f"/people/{person}", verts, self.few.faces.numpy(),
            color=bytes_of(person_colour(person)), side="double",
        )  # fmt: skip
