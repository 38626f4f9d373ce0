"""The state behind the viewer: a result or a capture, the edits on top of it, what is selected."""

import json
import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mover.app.report.scene_view import EYE_HEIGHT
from mover.app.results import initial_bodies
from mover.app.viewer.layers import Layers, read_layers
from mover.core.errors import InputError
from mover.core.types import Bodies, Capture, Proposal, Scene, SceneObject
from mover.geometry.camera import pitch_roll
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.edits import (
    Add,
    Delete,
    Dismiss,
    Edit,
    Pin,
    Place,
    Placement,
    Relabel,
    edit_scene,
    is_dismissed,
    joined,
    pinned_ids,
    placement_of,
    read_edits,
    write_edits,
)
from mover.io.capture.proposals_file import PROPOSED, read_proposals
from mover.io.capture.scene_file import read_scene


@dataclass(frozen=True)
class Shown:
    """A room as it was given and as it is now."""

    title: str
    result: Scene
    initial: Scene
    bodies: Bodies | None
    """People in the world of `result`."""
    initial_bodies: Bodies | None
    """People in the world of `initial`."""
    image: Float[Tensor, "h w 3"] | None = None
    """The reference image, in [0, 1]."""
    layers: Layers = field(default_factory=Layers)
    log: Mapping[str, Any] = field(default_factory=lambda: {})
    """What run.json holds."""
    metrics: Mapping[str, Any] = field(default_factory=lambda: {})
    """What metrics.json holds."""
    proposals: tuple[Proposal, ...] = ()
    """Supports that no detector saw."""

    @property
    def edits_inside(self) -> int:
        """How many edits of the list the result has in it already."""
        return int(self.log.get("edits", 0))


def read_shown(out: Path, capture: Capture | None = None) -> Shown:
    """Read what `mover run` left in its folder."""
    result = read_scene(out / "scene.json")
    log = _json(out / "run.json")
    first = out / "initial.json"
    return Shown(
        title=out.resolve().name,
        result=result,
        initial=read_scene(first) if first.is_file() else result,
        bodies=_bodies(out / "bodies.npz"),
        initial_bodies=_bodies(out / "initial_bodies.npz"),
        image=None if capture is None else capture.reference,
        layers=read_layers(out, log, result),
        log=log,
        metrics=_json(out / "metrics.json"),
        proposals=read_proposals(out / PROPOSED),
    )


def shown_before(capture: Capture) -> Shown:
    """A capture that has no result yet."""
    people = None if capture.bodies is None else initial_bodies(capture)
    return Shown(
        capture.name, capture.scene, capture.scene, people, people, image=capture.reference
    )


def source_of(log: Mapping[str, Any]) -> tuple[str, Path] | None:
    """Format and place of the capture that a result was made from; None: it is not there."""
    source = str(log.get("source") or "")
    if not source or not Path(source).exists():
        return None
    return str(log.get("source_format") or "folder"), Path(source)


def _bodies(file: Path) -> Bodies | None:
    return read_bodies(file) if file.is_file() else None


def _json(file: Path) -> dict[str, Any]:
    if not file.is_file():
        return {}
    try:
        tree = json.loads(file.read_text())
    except ValueError as error:
        raise InputError(f"{file.name} has no valid JSON ({error})") from error
    if not isinstance(tree, dict):
        raise InputError(f"{file.name} has a {type(tree).__name__}, expected an object")
    return tree


# The edits on top of it, and what is selected.


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
    listeners: list[Callable[[], None]] = field(default_factory=lambda: [])
    lock: threading.RLock = field(default_factory=threading.RLock)

    @property
    def scene(self) -> Scene:
        """The room with the edits that no run has seen yet."""
        return edit_scene(self.shown.result, self.edits[self.done :])

    @property
    def pinned(self) -> tuple[str, ...]:
        """The objects that will not move."""
        return pinned_ids(self.scene, self.edits)

    @property
    def proposals(self) -> tuple[Proposal, ...]:
        """Supports that the user has neither accepted nor dismissed."""
        there = {piece.id for piece in self.scene.objects}
        return tuple(
            one for one in self.shown.proposals
            if one.object.id not in there
            and not is_dismissed(one.object, self.shown.result, self.edits)
        )  # fmt: skip

    def accept(self, name: str) -> None:
        """Make a proposed support an object of the room."""
        for one in self.proposals:
            if one.object.id == name:
                at = placement_of(one.object, self.shown.result)
                self.record(Add(name, one.piece, one.style, one.seed, None, at))
                self.select(name)

    def dismiss(self, name: str) -> None:
        """Say that there is no such support: it is not shown again, whatever runs propose."""
        for one in self.proposals:
            if one.object.id == name:
                self.record(Dismiss(name, placement_of(one.object, self.shown.result)))

    def piece(self, name: str | None) -> SceneObject | None:
        """An object of the room by its id."""
        return next((p for p in self.scene.objects if p.id == name), None)

    def select(self, name: str | None) -> None:
        """Choose the object whose numbers are shown and which can be moved."""
        if name != self.selected:
            self.selected = name
            self.changed()

    def put(self, moved: SceneObject) -> None:
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
        taken = {piece.id for piece in scene.objects}
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
            self.changed()

    def listen(self, listener: Callable[[], None]) -> None:
        """Call it now, and whenever the room, its edits or the choice have changed."""
        self.listeners.append(listener)
        listener()

    def changed(self) -> None:
        """Tell everybody who listens."""
        for listener in self.listeners:
            listener()

    def _save(self) -> None:
        if self.file is not None:
            write_edits(self.edits, self.file)
        if self.piece(self.selected) is None:
            self.selected = None
        self.changed()


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
    pitch, roll = pitch_roll(scene.camera.R_cam_world)
    yaw = math.atan2(-place[0], -place[1])
    return Placement((place[0], ground, place[1]), yaw, (1, 1, 1), float(pitch), float(roll))


def _changed(old: SceneObject | None, new: SceneObject) -> bool:
    if old is None:
        return False
    return not all(
        torch.allclose(getattr(old, key), getattr(new, key), atol=1e-5)
        for key in ("t_world_object", "yaw", "scale")
    )
