"""The room in the 3D view before and after the run, and the edits on top of the result."""

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mover.app.pictures.film import pixels
from mover.app.report.scene_view import Thinning, floor_of, thin, thin_choice
from mover.core.colours import Colour, colour, person_colour
from mover.core.types import Bodies, Camera, Scene, SceneObject
from mover.io.capture import edits as editing
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.scene_file import read_scene
from mover.io.files.fields import At, read_json
from mover.io.files.images import read_image_file


@dataclass(frozen=True)
class Shown:
    """A room before and after the run."""

    title: str
    result: Scene
    initial: Scene
    bodies: Bodies | None  #: people in the world of `result`
    initial_bodies: Bodies | None  #: people in the world of `initial`
    image: Float[Tensor, "h w 3"] | None = None  #: the reference image, in [0, 1]
    log: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """What run.json holds; `edits`: how many of the list are part of the result already."""


def read_shown(out: Path) -> Shown:
    """Read what `mover run` left in its folder."""
    result = read_scene(out / "scene.json")
    log = read_json(out / "run.json").mapping() if (out / "run.json").is_file() else {}
    first = out / "initial.json"
    people = [
        read_bodies(file) if (file := out / name).is_file() else None
        for name in ("bodies.npz", "initial_bodies.npz")
    ]
    image, picture = None, Path(str(log.get("source") or ".")) / "reference.png"
    if picture.is_file():
        image = read_image_file(At(picture.name, "run.json", "source"), picture, result.camera)
    return Shown(
        title=out.resolve().name,
        result=result,
        initial=read_scene(first) if first.is_file() else result,
        bodies=people[0],
        initial_bodies=people[1],
        image=image,
        log=log,
    )


@dataclass
class Session:
    """What the user sees and has changed; every change is saved at once."""

    shown: Shown
    file: Path  #: where the edits are kept
    edits: tuple[editing.Edit, ...] = ()
    done: int = 0  #: number of edits that are part of `shown.result`
    selected: str | None = None
    listeners: list[Callable[[], None]] = field(default_factory=list[Callable[[], None]])

    @property
    def scene(self) -> Scene:
        """The room with the edits that no run has used yet."""
        return editing.edit_scene(self.shown.result, self.edits[self.done :])

    @property
    def pinned(self) -> tuple[str, ...]:
        """The objects that the next run will not move."""
        return editing.pinned_ids(self.scene, self.edits)

    def object_named(self, name: str | None) -> SceneObject | None:
        """An object of the room by its id."""
        return next((o for o in self.scene.objects if o.id == name), None)

    def select(self, name: str | None) -> None:
        """Choose the object whose numbers are shown and which can be moved."""
        if name != self.selected:
            self.selected = name
            self.changed()

    def put(self, moved: SceneObject) -> None:
        """Record where the user put an object."""
        old = self.object_named(moved.id)
        if old is not None and not all(
            torch.allclose(getattr(old, key), getattr(moved, key), atol=1e-5)
            for key in ("t_world_object", "yaw", "scale")
        ):
            self.record(editing.placement_of(moved, self.shown.result))

    def pin(self, name: str, pinned: bool) -> None:
        """Fix an object at its present position, or let runs move it again."""
        item = self.object_named(name)
        if item is None or pinned == (name in self.pinned):
            return
        if pinned:
            self.record(editing.placement_of(item, self.shown.result))
        self.record(editing.Pin(name, pinned))

    def delete(self, name: str) -> None:
        """Take an object away."""
        if self.object_named(name) is not None:
            self.record(editing.Delete(name))

    def undo(self) -> None:
        """Take the last edit back; one that a run has used acts until the next run."""
        if self.edits:
            self.edits = self.edits[:-1]
            self.done = min(self.done, len(self.edits))
            self._save()

    def record(self, edit: editing.Edit) -> None:
        """Append an edit; several placements of one object in a row become one."""
        self.edits = (*self.edits[: self.done], *editing.joined(self.edits[self.done :], edit))
        self._save()

    def listen(self, listener: Callable[[], None]) -> None:
        """Call it now, and whenever the room, its edits or the choice have changed."""
        self.listeners.append(listener)
        listener()

    def changed(self) -> None:
        """Call all listeners."""
        for listener in self.listeners:
            listener()

    def _save(self) -> None:
        editing.write_edits(self.edits, self.file)
        if self.object_named(self.selected) is None:
            self.selected = None
        self.changed()


def start_session(shown: Shown, file: Path) -> Session:
    """A session that goes on with the edits in `file`.

    Raises:
        InputError: If the edits do not fit the result.
    """
    edits = editing.read_edits(file) if file.is_file() else ()
    session = Session(shown, file, edits, min(int(shown.log.get("edits", 0)), len(edits)))
    assert session.scene is not None  # edits that do not fit are refused here
    return session


FACES, FACES_BODY = 20_000, 6000  # of an object and of a body, at most
WIDEST = 800  # [px] of the picture in the frustum
World = Literal["after", "before"]


@dataclass
class DrawnPeople:
    """The drawn people, at a moment of a time line of all frames that have any."""

    server: Any
    bodies: Bodies | None = None
    frames: Sequence[int] = ()
    few: Thinning | None = None
    handles: dict[int, Any] = field(default_factory=dict[int, Any])
    visible: bool = True
    lock: threading.RLock = field(default_factory=threading.RLock)

    def replace(self, bodies: Bodies | None) -> None:
        """Take other people, or the same in another world."""
        with self.lock:
            for handle in self.handles.values():
                handle.remove()
            self.handles, self.bodies, self.frames = {}, None, ()
            if bodies is None or not len(bodies.verts):
                return
            self.bodies, self.frames = bodies, bodies.frame.unique().tolist()
            middle = bodies.verts[len(bodies.verts) // 2]
            self.few = thin_choice(middle, bodies.faces, FACES_BODY)

    def show(self, moment: int) -> None:
        """Draw the bodies of a moment."""
        with self.lock:
            if self.bodies is None:
                return
            frame = self.frames[min(max(moment, 0), len(self.frames) - 1)]
            rows = (self.bodies.frame == frame).nonzero()[:, 0].tolist()
            shown = {int(self.bodies.person[row]): row for row in rows}
            for person, row in shown.items():
                self._draw(self.bodies, person, row)
            for person, handle in self.handles.items():
                handle.visible = self.visible and person in shown

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


@dataclass
class RoomWindow:
    """Server, state and handles of what is drawn in one viewer."""

    server: Any
    session: Session
    people: DrawnPeople
    furniture: dict[World, dict[str, Any]] = field(
        default_factory=lambda: {"after": {}, "before": {}}
    )
    """As it is and as it was initially, by id."""
    colours: dict[str, Colour] = field(default_factory=dict[str, Colour])
    ground: Any = None
    camera: Any = None
    camera_visible: bool = True
    gizmo: Any = None  #: what the mouse holds
    moment: int = 0  #: position on the time line
    world: World = "after"  #: whose furniture, people, floor and camera are shown

    def set_world(self, world: World) -> None:
        """Show the room before or after the run."""
        shown, self.world = self.session.shown, world
        self.draw_furniture()
        self._draw_camera()
        self.people.replace(shown.bodies if world == "after" else shown.initial_bodies)
        self.people.show(self.moment)

    def redraw(self) -> None:
        """Draw the furniture as it is now, and let the mouse hold the selected object."""
        self.draw_furniture()
        self._hold_selected()

    def draw_furniture(self) -> None:
        """Draw both worlds' furniture, of which one is visible; what is drawn only moves."""
        scenes = {"after": self.session.scene, "before": self.session.shown.initial}
        for world, handles in self.furniture.items():
            for name in set(handles) - {item.id for item in scenes[world].objects}:
                handles.pop(name).remove()
            for item in scenes[world].objects:
                if item.id not in handles:
                    handles[item.id] = self._added(world, item)
                move_object(handles[item.id], item)
                handles[item.id].visible = world == self.world

    def _added(self, world: World, item: SceneObject) -> Any:  # noqa: ANN401
        """A new mesh, which a click selects in the room as it is."""
        tint = self.colours.setdefault(item.id, colour(len(self.colours)))
        small = thin(item.mesh, FACES)
        handle = self.server.scene.add_mesh_simple(
            f"/{world}/{item.id}", small.verts.detach().numpy(), small.faces.numpy(),
            color=bytes_of(tint), flat_shading=True, side="double",
        )  # fmt: skip
        if world == "after":
            handle.on_click(lambda _event: self.session.select(item.id))
        return handle

    def _draw_camera(self) -> None:
        """Draw the floor and the camera with its picture."""
        for handle in (self.ground, self.camera):
            if handle is not None:
                handle.remove()
        shown = self.session.shown
        scene = shown.result if self.world == "after" else shown.initial
        camera, picture = scene.camera, None
        if shown.image is not None:
            every = max(1, -(-shown.image.shape[1] // WIDEST))
            picture = pixels(shown.image[::every, ::every])
        self.ground = self.server.scene.add_grid(
            "/ground", 40.0, 40.0, plane="xz", cell_size=0.5, section_size=1.0, plane_opacity=0.0,
            position=(0.0, floor_of(scene), 0.0), fade_distance=30.0,
        )  # fmt: skip
        self.camera = self.server.scene.add_camera_frustum(
            "/camera", fov=2 * math.atan(camera.height / (2 * float(camera.K[1, 1]))),
            aspect=camera.width / camera.height, scale=0.4, thickness=0.006, color=(60, 60, 60),
            image=picture, cast_shadow=False, wxyz=camera_wxyz(camera),
        )  # fmt: skip
        self.camera.visible = self.camera_visible

    def _hold_selected(self) -> None:
        """Give the selected object a gizmo; the last one loses its own."""
        if self.gizmo is not None:
            self.gizmo.remove()
            self.gizmo = None
        item = self.session.object_named(self.session.selected)
        if item is None:
            return
        handle = self.furniture["after"][item.id]
        self.gizmo = gizmo = self.server.scene.add_transform_controls(
            "/gizmo", scale=0.9, active_axes=(True, item.support == "free", True),
            depth_test=False, position=handle.position, wxyz=handle.wxyz,
        )  # fmt: skip

        @gizmo.on_update
        async def _(event: Any) -> None:  # noqa: ANN401
            now = self.session.object_named(item.id)
            if now is None:
                return
            w, x, y, z = (float(v) for v in gizmo.wxyz)
            yaw = math.atan2(2 * (w * y + x * z), 1 - 2 * (x * x + y * y))
            position = torch.tensor([float(v) for v in gizmo.position])
            moved = replace(now, t_world_object=position, yaw=torch.tensor(yaw))
            move_object(handle, moved)
            if event.phase == "end":  # the mouse lets it go
                self.session.put(moved)


def move_object(handle: Any, item: SceneObject) -> None:  # noqa: ANN401
    """Put a drawn object where it stands."""
    half = float(item.yaw) / 2
    handle.position = tuple(item.t_world_object.detach().tolist())
    handle.wxyz = (math.cos(half), 0.0, math.sin(half), 0.0)
    handle.scale = tuple(item.scale.detach().tolist())


def camera_wxyz(camera: Camera) -> Float[np.ndarray, "4"]:
    """The quaternion of the camera's axes in the world."""
    from viser.transforms import SO3  # pyright: ignore[reportMissingImports]

    return SO3.from_matrix(camera.R_cam_world.detach().double().numpy().T).wxyz


def bytes_of(tint: Colour) -> tuple[int, int, int]:
    """A colour in whole numbers up to 255."""
    red, green, blue = (round(255 * c) for c in tint)
    return red, green, blue
