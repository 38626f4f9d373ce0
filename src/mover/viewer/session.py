"""The state behind the viewer: a result, the edits on top of it, and what is selected."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch

from ..edits import (
    Add,
    Delete,
    Edit,
    Pin,
    Place,
    Placement,
    Relabel,
    edit_scene,
    joined,
    pinned_ids,
    placement_of,
)
from ..geometry.camera import pitch_roll
from ..readers.edits_file import read_edits, write_edits
from ..report_view import EYE_HEIGHT
from ..types import Capture, Piece, Scene
from .result import Shown

Listener = Callable[[], None]


@dataclass
class Session:
    """What the user sees and has changed; every change is saved at once."""

    shown: Shown
    file: Path | None
    """Where the edits are kept; None: nowhere."""
    capture: Capture | None = None
    edits: tuple[Edit, ...] = ()
    done: int = 0
    """So many of the edits are inside of `shown.result`."""
    selected: str | None = None
    on_room: list[Listener] = field(default_factory=lambda: [])
    """Called when objects or their places change."""
    on_select: list[Listener] = field(default_factory=lambda: [])
    lock: threading.RLock = field(default_factory=threading.RLock)

    @property
    def scene(self) -> Scene:
        """The room with the edits that no run has seen yet."""
        return edit_scene(self.shown.result, self.edits[self.done :])

    @property
    def pinned(self) -> tuple[str, ...]:
        """The objects that will not move."""
        return pinned_ids(self.scene, self.edits)

    def piece(self, name: str | None) -> Piece | None:
        """An object of the room by its id."""
        return next((p for p in self.scene.pieces if p.id == name), None)

    def select(self, name: str | None) -> None:
        """Choose the object whose numbers are shown and which can be moved."""
        if name != self.selected:
            self.selected = name
            _call(self.on_select)

    def put(self, moved: Piece) -> None:
        """Record where the user put an object."""
        if _changed(self.piece(moved.id), moved):
            self.record(Place(moved.id, placement_of(moved, self.shown.result)))

    def relabel(self, name: str, category: str) -> None:
        """Record what an object is."""
        piece = self.piece(name)
        if piece is not None and category.strip() and piece.category != category.strip():
            self.record(Relabel(name, category.strip()))

    def pin(self, name: str, pinned: bool) -> None:
        """Hold an object at its present place, or let it go."""
        piece = self.piece(name)
        if piece is None or pinned == (name in self.pinned):
            return
        if pinned:
            self.record(Place(name, placement_of(piece, self.shown.result)))
        self.record(Pin(name, pinned))

    def delete(self, name: str) -> None:
        """Take an object away."""
        if self.piece(name) is not None:
            self.record(Delete(name))
            self.select(None)

    def add(self, name: str, style: int, annotation: int | None, place: tuple[float, float]) -> str:
        """Put a piece of the library on the floor at (x, z) [m]; its new id."""
        scene = self.scene
        taken = {piece.id for piece in scene.pieces}
        stem = name.replace(" ", "_")
        key = next(k for k in (f"{stem}_{i}" for i in range(10_000)) if k not in taken)
        count = sum(isinstance(edit, Add) for edit in self.edits)
        self.record(Add(key, name, style, count, annotation, _on_floor(scene, place)))
        self.select(key)
        return key

    def undo(self) -> Edit | None:
        """Take the last edit back; one that a run has seen acts until the next run."""
        if not self.edits:
            return None
        last, self.edits = self.edits[-1], self.edits[:-1]
        self.done = min(self.done, len(self.edits))
        self._save()
        return last

    def record(self, edit: Edit) -> None:
        """Append an edit; several placements of one object in a row become one."""
        with self.lock:
            fresh = self.edits[self.done :]
            self.edits = (*self.edits[: self.done], *joined(fresh, edit))
            self._save()

    def rebase(self, shown: Shown, done: int) -> None:
        """Go on from a new result."""
        with self.lock:
            self.shown, self.done = shown, done
            _call(self.on_room)
            _call(self.on_select)

    def _save(self) -> None:
        if self.file is not None:
            write_edits(self.edits, self.file)
        if self.piece(self.selected) is None:
            self.selected = None
        _call(self.on_room)
        _call(self.on_select)


def start_session(shown: Shown, file: Path | None, capture: Capture | None) -> Session:
    """A session that goes on with the edits in `file`.

    Raises:
        InputError: If the edits do not fit the result.
    """
    edits = read_edits(file) if file is not None and file.is_file() else ()
    session = Session(shown, file, capture, edits, min(shown.edits_inside, len(edits)))
    assert session.scene is not None  # edits that do not fit are refused here
    return session


def _on_floor(scene: Scene, place: tuple[float, float]) -> Placement:
    """On the floor, facing the camera."""
    ground = scene.ground if scene.ground is not None else -EYE_HEIGHT
    t = torch.tensor([place[0], ground, place[1]])
    pitch, roll = pitch_roll(scene.camera.R_cam_world)
    yaw = torch.atan2(-t[0], -t[2])
    return Placement(t, yaw, torch.ones(3), pitch=float(pitch), roll=float(roll))


def _changed(old: Piece | None, new: Piece) -> bool:
    if old is None:
        return False
    return not all(
        torch.allclose(getattr(old, key), getattr(new, key), atol=1e-5)
        for key in ("t_world_object", "yaw", "scale")
    )


def _call(listeners: list[Listener]) -> None:
    for listener in listeners:
        listener()
