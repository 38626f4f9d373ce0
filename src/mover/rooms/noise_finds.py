"""Errors of an instance detector: objects missed, invented, run together, or called by wrong names.

An initial scene has one object for each detection, so that the scene follows the detections.
"""

import dataclasses

import numpy as np
import torch
from jaxtyping import Bool

from ..furniture import make_piece
from ..furniture.library import PIECES, canonical
from ..geometry.camera import project, to_camera
from ..geometry.mesh import fit_box
from ..geometry.placement import place_piece
from ..geometry.runs import decode
from ..types import Capture, Detection, Masks, Piece
from .noise_config import NoiseConfig
from .noise_masks import box_of_mask
from .render import encode

TOUCH = 2  # [px], masks that come nearer than this may run together


def noisy_finds(capture: Capture, floor: float, noise: NoiseConfig, seed: list[int]) -> Capture:
    """What a detector finds of a room whose floor is at a height [m], and what is rebuilt of it."""
    rngs = [np.random.default_rng([*seed, k]) for k in range(4)]
    capture = _merged(capture, noise.merged, rngs[0])
    lost = [d.id for d in capture.detections if float(rngs[1].uniform()) < noise.missed]
    capture = _without(capture, set(lost))
    capture = _renamed(capture, noise.wrong_class, rngs[2])
    count = int(rngs[3].binomial(len(capture.detections), noise.false))
    for index in range(count):
        capture = _with_false(capture, (index, floor), rngs[3])
    return capture


def _without(capture: Capture, lost: set[int]) -> Capture:
    pieces = tuple(p for p in capture.scene.pieces if p.annotation not in lost)
    return dataclasses.replace(
        capture,
        scene=dataclasses.replace(capture.scene, pieces=pieces),
        detections=tuple(d for d in capture.detections if d.id not in lost),
    )


def _merged(capture: Capture, share: float, rng: np.random.Generator) -> Capture:
    """Some objects swallow a neighbour in the image, whose own detection is then missing."""
    gone: set[int] = set()
    found = {d.id: d for d in capture.detections}
    for one in capture.detections:
        swallows = float(rng.uniform()) < share
        if not swallows or one.id in gone:
            continue
        free = [d for d in found.values() if d.id not in gone | {one.id}]
        near = [d.id for d in free if _touch(found[one.id], d)]
        if not near:
            continue
        other = near[int(rng.integers(len(near)))]
        mask = _mask(found[one.id]) | _mask(found[other])
        found[one.id] = dataclasses.replace(one, mask=encode([mask]), box=box_of_mask(mask))
        gone.add(other)
    capture = dataclasses.replace(capture, detections=tuple(found.values()))
    return _without(capture, gone)


def _touch(a: Detection, b: Detection) -> bool:
    """Whether two masks come nearer than `TOUCH`."""
    from scipy.ndimage import binary_dilation

    apart = (a.box[:2] > b.box[2:] + TOUCH) | (b.box[:2] > a.box[2:] + TOUCH)
    if a.mask is None or b.mask is None or bool(apart.any()):
        return False
    return bool((binary_dilation(_mask(a), iterations=TOUCH) & _mask(b)).any())


def _mask(detection: Detection) -> Bool[np.ndarray, "h w"]:
    assert isinstance(detection.mask, Masks), "detections of known rooms have masks"
    return decode(detection.mask, 0).numpy()


def _renamed(capture: Capture, share: float, rng: np.random.Generator) -> Capture:
    """Some objects get another class, and a piece of that class stretched to the same box."""
    if share == 0:
        return capture
    names = {d.id: d.category for d in capture.detections}
    pieces: list[Piece] = []
    for piece in capture.scene.pieces:
        others = [n for n in PIECES if canonical(n) != canonical(piece.category)]
        name = others[int(rng.integers(len(others)))]
        new = make_piece(name, rng)
        if float(rng.uniform()) < share and piece.annotation is not None:
            verts = piece.mesh.verts
            mesh = fit_box(new.mesh, verts.amin(0), verts.amax(0))
            names[piece.annotation] = new.category
            piece = dataclasses.replace(piece, category=new.category, mesh=mesh)
        pieces.append(piece)
    found = [dataclasses.replace(d, category=names[d.id]) for d in capture.detections]
    scene = dataclasses.replace(capture.scene, pieces=tuple(pieces))
    return dataclasses.replace(capture, scene=scene, detections=tuple(found))


def _with_false(capture: Capture, what: tuple[int, float], rng: np.random.Generator) -> Capture:
    """One more object that is not there: a patch of the image, and a piece that it shows."""
    index, floor = what
    camera = capture.scene.camera
    new = make_piece(list(PIECES)[int(rng.integers(len(PIECES)))], rng)
    z = float(rng.uniform(-5.0, -2.8))
    place = torch.tensor([float(rng.uniform(0.4 * z, -0.4 * z)), floor, z])
    yaw = torch.tensor(float(rng.uniform(-np.pi, np.pi)))
    number = 1 + max((d.id for d in capture.detections), default=0)
    piece = Piece(f"false_{index}", new.category, new.mesh, "", number, "ground", place, yaw,
                  torch.ones(3))  # fmt: skip
    pixel = project(to_camera(place_piece(piece).verts, camera.R_cam_world), camera.K)
    centre = (pixel.amin(0) + pixel.amax(0)).numpy() / 2
    half = (pixel.amax(0) - pixel.amin(0)).numpy() / 2
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    patch = ((u - centre[0]) / half[0]) ** 2 + ((v - centre[1]) / half[1]) ** 2 < 1
    if not patch.any():
        return capture
    found = Detection(number, new.category, box_of_mask(patch), encode([patch]), 0.6)
    scene = dataclasses.replace(capture.scene, pieces=(*capture.scene.pieces, piece))
    return dataclasses.replace(capture, scene=scene, detections=(*capture.detections, found))
