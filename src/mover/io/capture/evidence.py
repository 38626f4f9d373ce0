"""What a capture observes of each object before anything is computed: for `mover check`."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.bodies.corrected import in_world
from mover.bodies.parts import members, parts_of
from mover.bodies.posture import touching
from mover.core.types import Bodies, Camera, Capture, Masks
from mover.energy.human_terms import eroded
from mover.geometry.camera import NEAR, project
from mover.geometry.rle import area, decode, thinned
from mover.io.capture.agreement import partners

FEWEST = 5  # touching vertices inside a mask that make a frame with contact
UNSURE = 0.5  # chance from which on a vertex touches
CELLS = 320  # columns of the grid on which overlaps are counted
ENOUGH = 6000  # bodies with fewer vertices are filled with points between them
LOOKED = 1000  # frames of people at most, evenly spread, in which they are looked at
BORDER = 2  # cells of the grid beside an outline that are no evidence
FEW = 50  # [px], less than that is hardly evidence
Grid = NDArray[np.bool_]


@dataclass(frozen=True)
class ObjectEvidence:
    """What the image and the people observe of one object."""

    id: str
    category: str
    mask_pixels: int
    """Size of its mask; 0: it has only a box, or nothing."""
    near_pixels: int
    """Pixels of the mask in which a person stands before it at some time (it is farther)."""
    far_pixels: int
    """Pixels of the mask in which a body is hidden at some time (it is nearer)."""
    frames: int
    """Frames in which a person's visible mask overlaps it."""
    contacts: int
    """Frames in which a person seems to touch it."""
    missing: tuple[str, ...]
    """What would help and is not there."""


def gather_evidence(capture: Capture) -> tuple[ObjectEvidence, ...]:
    """The evidence of each object, counted on a coarse grid from projected body vertices."""
    known = {d.id: d.mask for d in capture.detections}
    masks = [None if p.annotation is None else known.get(p.annotation)
             for p in capture.scene.objects]  # fmt: skip
    counts = zip(*passing_people(capture, masks), contact_frames(capture, masks), strict=True)
    found: list[ObjectEvidence] = []
    for one, mask, (near, far, frames, contacts) in zip(
        capture.scene.objects, masks, counts, strict=True
    ):
        missing: list[str] = []
        if one.annotation is None:
            missing.append("no annotation")
        elif mask is None:
            missing.append("no mask, only a box")
        elif capture.people is not None and not frames:
            missing.append("no person passes it")
        if frames and capture.bodies is not None:
            missing += ["no near bound"] * (near < FEW) + ["no far bound"] * (far < FEW)
        size = 0 if mask is None else area(mask, 0)
        found.append(
            ObjectEvidence(one.id, one.category, size, near, far, frames, contacts, tuple(missing))
        )
    return tuple(found)


def passing_people(
    capture: Capture, masks: Sequence[Masks | None]
) -> tuple[list[int], list[int], list[int]]:
    """Of each object: pixels where people stand before it, where it hides them, and frames.

    In a long video every n-th frame is looked at, and stands for n.
    """
    camera, people, bodies = capture.scene.camera, capture.people, capture.bodies
    if people is None or all(mask is None for mask in masks):
        return [0] * len(masks), [0] * len(masks), [0] * len(masks)
    step = max(1, camera.width // CELLS)
    shape = len(range(step // 2, camera.height, step)), len(range(step // 2, camera.width, step))
    grids = np.stack([np.zeros(shape, np.bool_) if m is None else thinned(m, 0, step)
                      for m in masks]) if masks else np.zeros((0, *shape), np.bool_)  # fmt: skip
    near, far, frames = np.zeros_like(grids), np.zeros_like(grids), [set[int]() for _ in masks]
    covers = grids.reshape(len(masks), shape[0] * shape[1]).astype(np.float32)
    rows = [-1] * len(people.frame)
    if bodies is not None:
        rows = partners(people.frame, people.person, bodies).tolist()
    all_frames = people.frame.unique().tolist()
    every = -(-len(all_frames) // LOOKED)
    for frame in all_frames[::every]:
        shown = (people.frame == frame).nonzero()[:, 0].tolist()
        visible = [thinned(people.masks, i, step) for i in shown]
        hidden = _shrunk(~np.any(visible, axis=0))
        for i, own in zip(shown, visible, strict=True):
            layers = [own]
            if bodies is not None and rows[i] >= 0:
                body = _silhouette(bodies, rows[i], camera, step)
                layers += [own & body, _shrunk(body) & hidden]
            shares = covers @ np.stack(layers).reshape(len(layers), -1).T  # whole numbers of cells
            for k in np.flatnonzero(shares[:, 0]):
                frames[k].add(frame)
            if len(layers) == 3:
                more = shares[:, 1] - shares[:, 2]  # it hides or is hidden, not both
                near[more > 0] |= layers[1]
                far[more < 0] |= layers[2]
    pixels = (((found & grids).sum((1, 2)) * step**2).tolist() for found in (near, far))
    return *pixels, [every * len(found) for found in frames]


def contact_frames(capture: Capture, masks: Sequence[Masks | None]) -> list[int]:
    """Frames in which touching skin (soles aside) is visible inside each object's mask.

    The initial camera gives the direction up, and the lowest feet the floor.
    """
    bodies, camera = capture.bodies, capture.scene.camera
    if bodies is None:
        return [0] * len(masks)
    parts = parts_of(bodies, camera.R_cam_world[:, 1])
    chance = capture.touch
    if chance is None:
        world = in_world(bodies, camera)
        chance = touching(world, parts, float(world.verts[..., 1].amin(1).quantile(0.05)))
    chance = chance * ~members(parts, "left_sole", "right_sole")
    touched = [project(v[c > UNSURE], camera.K) for v, c in zip(bodies.verts, chance, strict=True)]
    x, y = torch.cat(touched).long().unbind(-1)
    row = torch.arange(len(touched)).repeat_interleave(torch.tensor([*map(len, touched)]))
    shown = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    x, y, row = x[shown], y[shown], row[shown]

    def frames_in(mask: Masks | None) -> int:
        if mask is None:
            return 0
        inside = row[decode(mask, 0)[y, x]].bincount(minlength=len(bodies.frame))
        return len(bodies.frame[inside >= FEWEST].unique())

    return [frames_in(mask) for mask in masks]


def _shrunk(grid: Grid) -> Grid:
    """Without its border: masks and bodies are rarely right to the pixel."""
    return eroded(torch.from_numpy(grid), BORDER).numpy()


def _silhouette(bodies: Bodies, row: int, camera: Camera, step: int) -> Grid:
    """A body's projection, from its vertices, without gaps of a cell; on the grid."""
    import cv2

    verts: Float[Tensor, "points 3"] = bodies.verts[row]
    if len(verts) < ENOUGH:
        corners = verts[bodies.faces]
        between = [corners.mean(1), *((corners + corners.roll(1, 1)) / 2).unbind(1)]
        verts = torch.cat([verts, *between])
    verts = verts[verts[:, 2] > NEAR]
    cells = (project(verts, camera.K) / step).floor().long()
    rows, columns = (len(range(step // 2, n, step)) for n in (camera.height, camera.width))
    inside = ((cells >= 0) & (cells < torch.tensor([columns, rows]))).all(1)
    x, y = cells[inside].numpy().T
    grid = np.zeros((rows + 2, columns + 2), dtype=np.uint8)
    grid[y + 1, x + 1] = 1
    closed = cv2.morphologyEx(grid, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    return closed[1:-1, 1:-1] > 0


def evidence_table(capture: Capture, evidence: Sequence[ObjectEvidence]) -> str:
    """The evidence as a table in plain text, and the capture's warnings."""
    head = (
        "object", "category", "mask px", "near px", "far px", "frames", "contacts", "missing",
    )  # fmt: skip
    fields = [[*map(str, astuple(e)[:-1]), ", ".join(e.missing) or "-"] for e in evidence]
    rows = [head, *fields]
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    lines = ["  ".join(c.ljust(w) for c, w in zip(r, widths, strict=True)).rstrip() for r in rows]
    return "\n".join([*lines, *(f"warning: {text}" for text in capture.warnings)])
