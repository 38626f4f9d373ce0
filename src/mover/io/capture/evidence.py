"""In how many frames somebody seems to touch each object: for `mover check`."""

from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass

import numpy as np
import torch
from jaxtyping import Bool
from numpy.typing import NDArray
from torch import Tensor

from mover.bodies.corrected import in_world
from mover.bodies.parts import members, parts_of
from mover.bodies.posture import touching
from mover.core.types import Bodies, Capture, Masks
from mover.geometry.camera import NEAR, project
from mover.geometry.rle import area, decode, thinned

FEWEST = 5  # touching vertices inside a mask that make a frame with contact
UNSURE = 0.5  # chance from which on a vertex touches


def contact_frames(capture: Capture) -> tuple[int, ...]:
    """Frames in which touching skin (soles aside) is seen inside each object's mask.

    The first guess of the camera says where up is, and the lowest feet where the floor is.
    """
    pieces, bodies = capture.scene.objects, capture.bodies
    if bodies is None:
        return (0,) * len(pieces)
    R = capture.scene.camera.R_cam_world
    parts = parts_of(bodies, R[:, 1])
    if capture.touch is not None:
        chance = capture.touch
    else:
        world = in_world(bodies, capture.scene.camera)
        floor = float(world.verts[..., 1].amin(1).quantile(0.05))
        chance = touching(world, parts, floor)
    chance = chance * ~members(parts, "left_sole", "right_sole")
    masks = [None if mask is None else decode(mask, 0) for mask in _masks_of(capture)]
    frames = [set[int]() for _ in pieces]
    for row in range(len(bodies.frame)):
        skin = bodies.verts[row][chance[row] > UNSURE]
        if len(skin) < FEWEST:
            continue
        pixels = project(skin, capture.scene.camera.K).long()
        for i, mask in enumerate(masks):
            if mask is not None and _inside(mask, pixels) >= FEWEST:
                frames[i].add(int(bodies.frame[row]))
    return tuple(len(f) for f in frames)


def _masks_of(capture: Capture) -> list[Masks | None]:
    known = {d.id: d.mask for d in capture.detections}
    return [known.get(-1 if p.annotation is None else p.annotation) for p in capture.scene.objects]


def _inside(mask: Bool[Tensor, "h w"], pixels: Tensor) -> int:
    x, y = pixels.unbind(-1)
    shown = (x >= 0) & (x < mask.shape[1]) & (y >= 0) & (y < mask.shape[0])
    return int(mask[y[shown], x[shown]].sum())


# What a capture knows about each object before anything is computed: for `mover check`.


CELLS = 320  # columns of the grid on which overlaps are counted
ENOUGH = 6000  # bodies with fewer vertices are filled with points between them
BORDER = 2  # cells of the grid beside an outline that tell nothing
FEW = 50  # [px], less than that is no evidence to speak of


@dataclass(frozen=True)
class ObjectEvidence:
    """What the image and the people say about one object."""

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
    """Frames in which somebody seems to touch it."""
    missing: tuple[str, ...]
    """What would help and is not there."""


def gather_evidence(capture: Capture) -> tuple[ObjectEvidence, ...]:
    """The evidence of each object, counted on a coarse grid from projected body vertices."""
    masks = _masks_of(capture)
    step = max(1, capture.scene.camera.width // CELLS)
    grids = _stack(masks, capture, step)
    near, far = np.zeros_like(grids), np.zeros_like(grids)
    frames = [set[int]() for _ in masks]
    for frame, visible, body in _rows(capture, step):
        over = grids & visible
        for i in np.flatnonzero(over.any((1, 2))):
            frames[i].add(frame)
        if body is not None:
            before = over & body
            behind = grids & _shrunk(body) & _shrunk(~_visible_in(capture, frame, step))
            more = before.sum((1, 2)) - behind.sum((1, 2))  # it hides or is hidden, not both
            near |= before & (more > 0)[:, None, None]
            far |= behind & (more < 0)[:, None, None]
    counts = near.sum((1, 2)) * step**2, far.sum((1, 2)) * step**2
    contacts = contact_frames(capture)
    return tuple(
        _object(capture, i, masks[i], (int(counts[0][i]), int(counts[1][i]), len(frames[i]), n))
        for i, n in enumerate(contacts)
    )


def _shrunk(grid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Without its border: masks and bodies are rarely right to the pixel."""
    from scipy.ndimage import binary_erosion

    return np.asarray(binary_erosion(grid, iterations=BORDER, border_value=1), dtype=np.bool_)


def _object(
    capture: Capture, index: int, mask: Masks | None, counts: tuple[int, int, int, int]
) -> ObjectEvidence:
    """The evidence of one object, with what is missing."""
    piece, (near, far, frames, contacts) = capture.scene.objects[index], counts
    missing: list[str] = []
    if piece.annotation is None:
        missing.append("no annotation")
    elif mask is None:
        missing.append("no mask, only a box")
    elif capture.people is not None and not frames:
        missing.append("no person passes it")
    if frames and capture.bodies is not None:
        missing += ["no near bound"] if near < FEW else []
        missing += ["no far bound"] if far < FEW else []
    size = 0 if mask is None else area(mask, 0)
    return ObjectEvidence(
        piece.id, piece.category, size, near, far, frames, contacts, tuple(missing)
    )


def _stack(masks: Sequence[Masks | None], capture: Capture, step: int) -> NDArray[np.bool_]:
    """The objects' masks on the grid, empty where there is none."""
    camera = capture.scene.camera
    shape = len(range(step // 2, camera.height, step)), len(range(step // 2, camera.width, step))
    grids = np.zeros((len(masks), *shape), dtype=np.bool_)
    for grid, mask in zip(grids, masks, strict=True):
        if mask is not None:
            grid[:] = thinned(mask, 0, step)
    return grids


def _rows(
    capture: Capture, step: int
) -> Iterator[tuple[int, NDArray[np.bool_], NDArray[np.bool_] | None]]:
    """Frame, visible mask and body silhouette of each mask of a person; on the grid."""
    people, bodies = capture.people, capture.bodies
    if people is None:
        return
    places: dict[tuple[int, int], int] = {}
    if bodies is not None:
        pairs = zip(bodies.frame.tolist(), bodies.person.tolist(), strict=True)
        places = {pair: row for row, pair in enumerate(pairs)}
    rows = zip(people.frame.tolist(), people.person.tolist(), strict=True)
    for i, (frame, person) in enumerate(rows):
        row = places.get((frame, person))
        body = None if row is None or bodies is None else _silhouette(capture, bodies, row, step)
        yield frame, thinned(people.masks, i, step), body


def _visible_in(capture: Capture, frame: int, step: int) -> NDArray[np.bool_]:
    """Where anyone is visible in a frame; on the grid."""
    assert capture.people is not None
    rows = (capture.people.frame == frame).nonzero()[:, 0].tolist()
    return np.any([thinned(capture.people.masks, i, step) for i in rows], axis=0)


def _silhouette(capture: Capture, bodies: Bodies, row: int, step: int) -> NDArray[np.bool_]:
    """Where a body projects to, from its vertices, without gaps of a cell; on the grid."""
    from scipy.ndimage import binary_closing

    camera, verts = capture.scene.camera, bodies.verts[row]
    if len(verts) < ENOUGH:
        corners = verts[bodies.faces]
        between = [corners.mean(1), *((corners + corners.roll(1, 1)) / 2).unbind(1)]
        verts = torch.cat([verts, *between])
    verts = verts[verts[:, 2] > NEAR]
    cells = (project(verts, camera.K) / step).floor().long()
    rows, columns = (len(range(step // 2, n, step)) for n in (camera.height, camera.width))
    inside = ((cells >= 0) & (cells < torch.tensor([columns, rows]))).all(1)
    x, y = cells[inside].numpy().T
    grid = np.zeros((rows + 2, columns + 2), dtype=np.bool_)
    grid[y + 1, x + 1] = True
    closed = np.asarray(binary_closing(grid, np.ones((3, 3))), dtype=np.bool_)
    return closed[1:-1, 1:-1]


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
