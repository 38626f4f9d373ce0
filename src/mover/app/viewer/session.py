"""The state behind the viewer: a result, the edits on top of it, and the selected object."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.types import Bodies, Scene, SceneObject
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
