"""The room in the 3D view: floor, camera, furniture before and after, evidence, people."""

import math
import threading
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float

from mover.app.report.scene_view import Thinning, floor_of, thin, thin_choice
from mover.app.viewer.layers import Layers
from mover.core.colours import Colour, colour, person_colour
from mover.core.types import Bodies, Camera, Mesh, Scene, SceneObject

FACES = 20_000  # of an object, at most
WIDEST = 800  # pixels of the picture in the frustum
NEAR, FAR, SPACE = (60, 120, 220), (225, 80, 60), (120, 200, 190)
GHOST = 0.3  # opacity of what is shown beside the room


@dataclass
class Drawing:
    """Handles of everything that is drawn."""

    server: Any
    after: dict[str, Any] = field(default_factory=lambda: {})
    """Furniture as it is, by id."""
    before: dict[str, Any] = field(default_factory=lambda: {})
    """Furniture as it was given."""
    proposed: dict[str, Any] = field(default_factory=lambda: {})
    """Supports that no detector saw."""
    fixed: dict[str, Any] = field(default_factory=lambda: {})
    """Floor and camera."""
    layers: dict[str, list[Any]] = field(default_factory=lambda: {})
    """Evidence by the name of its layer."""
    camera_visible: bool = True
    colours: dict[str, Colour] = field(default_factory=lambda: {})


LAYERS = ("near", "far", "free space", "contacts", "doubt", "place")


def draw_room(drawing: Drawing, scene: Scene, kind: Literal["after", "before", "proposed"]) -> None:
    """Draw furniture as `after`, `before` or, faintly, `proposed`; what is there only moves."""
    handles: dict[str, Any] = getattr(drawing, kind)
    gone = set(handles) - {piece.id for piece in scene.objects}
    for name in gone:
        handles.pop(name).remove()
    for piece in scene.objects:
        tint = drawing.colours.setdefault(piece.id, colour(len(drawing.colours)))
        if piece.id not in handles:
            handles[piece.id] = _mesh(drawing.server, f"/{kind}/{piece.id}", piece.mesh, tint)
            if kind == "proposed":
                handles[piece.id].opacity = GHOST
        move_object(handles[piece.id], piece)


def move_object(handle: Any, piece: SceneObject) -> None:  # noqa: ANN401
    """Put a drawn object where the piece stands."""
    half = float(piece.yaw) / 2
    handle.position = _triple(piece.t_world_object)
    handle.wxyz = (math.cos(half), 0.0, math.sin(half), 0.0)
    handle.scale = _triple(piece.scale)


def draw_fixed(drawing: Drawing, scene: Scene, image: torch.Tensor | None) -> None:
    """Draw the floor and the camera with its picture."""
    for handle in drawing.fixed.values():
        handle.remove()
    server = drawing.server
    ground = floor_of(scene)
    drawing.fixed = {
        "ground": server.scene.add_grid(
            "/ground", 40.0, 40.0, plane="xz", cell_size=0.5, section_size=1.0,
            plane_opacity=0.0, position=(0.0, ground, 0.0), fade_distance=30.0,
        ),
        "camera": _frustum(server, scene.camera, image),
    }  # fmt: skip
    drawing.fixed["camera"].visible = drawing.camera_visible


def _frustum(server: Any, camera: Camera, image: torch.Tensor | None) -> Any:  # noqa: ANN401
    shown = None if image is None else _picture(image)
    return server.scene.add_camera_frustum(
        "/camera",
        fov=2 * math.atan(camera.height / (2 * float(camera.K[1, 1]))),
        aspect=camera.width / camera.height,
        scale=0.4,
        thickness=0.006,
        color=(60, 60, 60),
        image=shown,
        cast_shadow=False,
        wxyz=camera_wxyz(camera),
    )


def camera_wxyz(camera: Camera) -> Float[np.ndarray, "4"]:
    """The quaternion of the camera's axes in the world."""
    from viser.transforms import SO3  # pyright: ignore[reportMissingImports]

    matrix = camera.R_cam_world.detach().double().numpy().T
    return SO3.from_matrix(matrix).wxyz


def _picture(image: torch.Tensor) -> np.ndarray:
    every = max(1, -(-image.shape[1] // WIDEST))
    small = image.detach()[::every, ::every]
    return (small * 255).round().clamp(0, 255).to(torch.uint8).numpy()


def draw_layers(drawing: Drawing, layers: Layers) -> None:
    """Draw the evidence, hidden at first."""
    for handles in drawing.layers.values():
        for handle in handles:
            handle.remove()
    scene = drawing.server.scene
    drawing.layers = {name: [] for name in LAYERS}
    for name, points, tint in (("near", layers.near, NEAR), ("far", layers.far, FAR)):
        if points is not None and len(points):
            drawing.layers[name].append(_points(scene, f"/evidence/{name}", points, tint))
    if layers.space is not None:
        drawing.layers["free space"].append(
            scene.add_mesh_simple(
                "/evidence/space", layers.space.verts.numpy(), layers.space.faces.numpy(),
                color=SPACE, opacity=GHOST, side="double", visible=False,
            )
        )  # fmt: skip
    for name, points in layers.contacts.items():
        drawn = _points(scene, f"/evidence/contacts/{name}", points, _tint(drawing, name), 0.025)
        drawing.layers["contacts"].append(drawn)
    _draw_rings(drawing, "doubt", layers.ellipses)
    _draw_rings(drawing, "place", layers.places)


def _draw_rings(drawing: Drawing, layer: str, rings: dict[str, torch.Tensor]) -> None:
    """Outlines on the floor, in the colours of their objects."""
    scene = drawing.server.scene
    for name, outline in rings.items():
        ring = torch.stack([outline, outline.roll(-1, 0)], 1).numpy()
        raised = ring + np.array([0.0, 0.01, 0.0], dtype=np.float32)
        path, tint = f"/evidence/{layer}/{name}", _tint(drawing, name)
        drawn = scene.add_line_segments(path, raised, tint, thickness=0.02, visible=False)
        drawing.layers[layer].append(drawn)


def _tint(drawing: Drawing, name: str) -> tuple[int, int, int]:
    return bytes_of(drawing.colours.setdefault(name, colour(len(drawing.colours))))


def _points(
    scene: Any,  # noqa: ANN401
    name: str,
    points: torch.Tensor,
    tint: tuple[int, int, int],
    size: float = 0.012,
) -> Any:  # noqa: ANN401
    return scene.add_point_cloud(
        name, points.numpy(), tint, point_size=size, point_shape="circle", precision="float32",
        visible=False,
    )  # fmt: skip


def _mesh(server: Any, name: str, mesh: Mesh, tint: Colour) -> Any:  # noqa: ANN401
    small = thin(mesh, FACES)
    return server.scene.add_mesh_simple(
        name, small.verts.detach().numpy(), small.faces.numpy(), color=bytes_of(tint),
        flat_shading=True, side="double",
    )  # fmt: skip


def bytes_of(tint: Colour) -> tuple[int, int, int]:
    """A colour in whole numbers up to 255."""
    red, green, blue = (round(255 * c) for c in tint)
    return red, green, blue


def _triple(values: torch.Tensor) -> tuple[float, float, float]:
    x, y, z = values.detach().tolist()
    return x, y, z


# People on a time line.


FACES_BODY = 6000  # of a body, at most


@dataclass
class Cast:
    """The people of one world, ready to be drawn."""

    bodies: Bodies
    few: Thinning
    frames: list[int]
    rows: dict[tuple[int, int], int]
    """Row of each frame and person."""


def cast_of(bodies: Bodies | None) -> Cast | None:
    """Thin the bodies out; None: there is nobody."""
    if bodies is None or not len(bodies.verts):
        return None
    pairs = zip(bodies.frame.tolist(), bodies.person.tolist(), strict=True)
    rows = {pair: row for row, pair in enumerate(pairs)}
    few = thin_choice(bodies.verts[len(bodies.verts) // 2], bodies.faces, FACES_BODY)
    return Cast(bodies, few, bodies.frame.unique().tolist(), rows)


@dataclass
class People:
    """The drawn people."""

    server: Any
    cast: Cast | None = None
    handles: dict[int, Any] = field(default_factory=lambda: {})
    visible: bool = True
    lock: threading.RLock = field(default_factory=threading.RLock)


def show_people(people: People, moment: int) -> None:
    """Draw the bodies of a moment, counted along the frames that have any."""
    with people.lock:
        cast = people.cast
        if cast is None:
            return
        frame = cast.frames[min(max(moment, 0), len(cast.frames) - 1)]
        for person in cast.bodies.person.unique().tolist():
            row = cast.rows.get((frame, person))
            if row is not None:
                _draw(people, cast, person, row)
            if person in people.handles:
                people.handles[person].visible = people.visible and row is not None


def replace_cast(people: People, cast: Cast | None) -> None:
    """Take other people, or the same in another world."""
    with people.lock:
        for handle in people.handles.values():
            handle.remove()
        people.handles, people.cast = {}, cast


def _draw(people: People, cast: Cast, person: int, row: int) -> None:
    verts = cast.bodies.verts[row, cast.few.kept].detach().to(torch.float32).numpy()
    if person in people.handles:
        people.handles[person].vertices = verts
        return
    people.handles[person] = people.server.scene.add_mesh_simple(
        f"/people/{person}", verts, cast.few.faces.numpy(),
        color=bytes_of(person_colour(person)), side="double",
    )  # fmt: skip
