"""Who sits on what: the weight that people put on furniture, where they put it."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.contact_labels import ContactLabels
from mover.core.types import Scene, SceneObject
from mover.geometry.rotations import rot_y
from mover.io.export.contacts import FILE, read_labels

MASS = 70.0  # [kg], of an adult whose weight nobody told
SEAT_SHARE = 0.85  # of a sitter's weight is on the seat, the rest on the feet
BEARING = ("seat", "left_thigh", "right_thigh")
SURE = 0.5  # confidence of the labels that count
BOUT = 1.0  # [s]; who sits again later may sit elsewhere
SHORTEST = 3  # frames of a bout
FPS = 5.0  # where no rate is known


@dataclass(frozen=True)
class Load:
    """Somebody's weight on an object."""

    id: str
    kilos: float
    place: Float[Tensor, "3"]
    """Where, as a share of the size along the axes of its mesh, from the mesh's origin [m]."""
    person: int
    frame: int
    """The first of the bout."""


def loads_of(out: Path, scene: Scene, fps: float | None) -> tuple[Load, ...]:
    """The weights of all bouts of sitting in a result; none without contacts.npz.

    Args:
        out: Folder of the result.
        scene: Its scene, in which the contacts lie.
        fps: Frames a second.
    """
    return loads_in(read_labels(out / FILE), scene, fps) if (out / FILE).is_file() else ()


def loads_in(labels: ContactLabels, scene: Scene, fps: float | None) -> tuple[Load, ...]:
    """The weights of all bouts of sitting that the labels of a scene tell."""
    names = torch.tensor([name in BEARING for name in labels.parts])
    bears = names[labels.part] & (labels.confidence >= SURE)
    found: list[Load] = []
    for piece in scene.objects:
        if piece.id not in labels.objects:
            continue
        mine = bears & (labels.object == labels.objects.index(piece.id))
        for person in labels.person[mine].unique().tolist():
            found += _bouts(labels, mine & (labels.person == person), piece, fps or FPS)
    return tuple(found)


def _bouts(
    labels: ContactLabels, mine: Bool[Tensor, " rows"], piece: SceneObject, fps: float
) -> list[Load]:
    """One weight for each span in which a person sits on an object."""
    frames = labels.frame[mine].unique()
    breaks = (frames.diff() > BOUT * fps).nonzero()[:, 0] + 1
    found: list[Load] = []
    for span in torch.tensor_split(frames, breaks):
        if len(span) < SHORTEST:
            continue
        rows = mine & (labels.frame >= span[0]) & (labels.frame <= span[-1])
        share = labels.confidence[rows] / labels.confidence[rows].sum()
        middle = (share[:, None] * labels.position[rows]).sum(0)
        own = rot_y(-piece.yaw) @ (middle - piece.t_world_object).to(piece.yaw) / piece.scale
        person = int(labels.person[rows][0])
        found.append(Load(piece.id, MASS * SEAT_SHARE, own, person, int(span[0])))
    return found


def hardest(loads: tuple[Load, ...], piece: SceneObject) -> Load | None:
    """The bout farthest from the middle of an object's mesh, which tips it the most."""
    mine = [load for load in loads if load.id == piece.id]
    if not mine:
        return None
    verts = piece.mesh.verts
    middle = (verts.amin(0) + verts.amax(0)) / 2

    def lever(load: Load) -> float:
        away = (load.place - middle) * piece.scale
        return float(away[[0, 2]].norm())

    return max(mine, key=lever)
