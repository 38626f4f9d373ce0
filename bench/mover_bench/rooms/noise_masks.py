"""Errors of masks and detections: outlines off by some pixels; objects missed, invented or merged.

An initial scene has one object for each detection, so that the scene follows the detections.
"""

from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float

from mover.core.types import Capture, Detection, Masks, People, Scene, SceneObject
from mover.furniture.library import PIECES, canonical, make_piece
from mover.geometry.camera import project, to_camera
from mover.geometry.mesh import fit_box
from mover.geometry.placement import place_object
from mover.geometry.raster import first_hit
from mover.geometry.rle import decode
from mover.geometry.warp_start import mapped
from mover_bench.rooms.config import NoiseConfig
from mover_bench.rooms.render import box_of_mask, encode

LEAK = 0.2  # radius of a leak as a share of the root of the mask's area


def grown(mask: Bool[np.ndarray, "h w"], pixels: int) -> Bool[np.ndarray, "h w"]:
    """The mask with its outline moved out by so many pixels, in where negative."""
    from scipy.ndimage import distance_transform_edt

    if pixels == 0 or mask.all():
        return mask

    def moved(part: np.ndarray) -> np.ndarray:
        if pixels > 0:
            return np.asarray(distance_transform_edt(~part)) <= pixels
        return np.asarray(distance_transform_edt(part)) > -pixels

    return _near(mask, abs(pixels) + 1, moved)


def _near(
    mask: Bool[np.ndarray, "h w"], pad: int, drawn: Callable[[np.ndarray], np.ndarray]
) -> Bool[np.ndarray, "h w"]:
    """The mask drawn again in its window and `pad` pixels around; as it is if nothing were left."""
    if not mask.any():
        return mask
    rows, cols = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    window = np.s_[
        max(0, rows[0] - pad) : rows[-1] + pad + 1, max(0, cols[0] - pad) : cols[-1] + pad + 1
    ]
    out = np.zeros_like(mask)
    out[window] = drawn(mask[window])
    return out if out.any() else mask


def noisy_people(
    people: People | None, most: int, missed: float, rng: np.random.Generator
) -> People | None:
    """Masks that grow or shrink by 1 to `most` pixels; some are missing."""
    if people is None:
        return None
    count = len(people.frame)
    off = rng.integers(1, max(1, most) + 1, count) * rng.choice([-1, 1], count) * (most > 0)
    keep = np.flatnonzero(rng.uniform(size=count) >= missed)
    masks = people.masks

    def off_by(row: int) -> bytes:
        return encode([grown(decode(masks, row).numpy(), int(off[row]))]).counts[0]

    rows = torch.from_numpy(keep)
    coded = Masks(masks.height, masks.width, tuple(mapped(off_by, keep.tolist())))
    return People(coded, people.frame[rows], people.person[rows], people.heights)


def noisy_detections(
    detections: tuple[Detection, ...], most: int, rng: np.random.Generator
) -> tuple[Detection, ...]:
    """Masks of objects with outlines that are off; the boxes follow."""
    off = [int(rng.integers(-most, most + 1)) for _ in detections]
    return tuple(
        redrawn(one, grown(_mask(one), pixels)) if one.mask is not None and pixels else one
        for one, pixels in zip(detections, off, strict=True)
    )


def leaking(
    detections: tuple[Detection, ...], share: float, rng: np.random.Generator
) -> tuple[Detection, ...]:
    """Some masks of objects run over at one point of their border; the boxes follow."""
    draws = [rng.uniform(size=2) for _ in detections]
    return tuple(
        redrawn(one, leaked(_mask(one), float(where))) if one.mask and leaks < share else one
        for one, (leaks, where) in zip(detections, draws, strict=True)
    )


def redrawn(detection: Detection, mask: Bool[np.ndarray, "h w"]) -> Detection:
    """The detection with another mask and its box."""
    return replace(detection, mask=encode([mask]), box=box_of_mask(mask))


def _mask(detection: Detection) -> Bool[np.ndarray, "h w"]:
    assert isinstance(detection.mask, Masks), "detections of known rooms have masks"
    return decode(detection.mask, 0).numpy()


def leaked(mask: Bool[np.ndarray, "h w"], where: float) -> Bool[np.ndarray, "h w"]:
    """A mask that is not empty and a disc around a point of its border, `where` in [0, 1)."""
    rows, cols = np.nonzero(mask & ~grown(mask, -1))
    if not len(rows):
        return mask
    centre = int(where * len(rows))
    radius = LEAK * np.sqrt(mask.sum())
    v, u = np.mgrid[: mask.shape[0], : mask.shape[1]]
    return mask | ((v - rows[centre]) ** 2 + (u - cols[centre]) ** 2 <= radius**2)


KINDS = tuple(PIECES)  # what a detector has a class for
TOUCH = 2  # [px], masks that come nearer than this may run together


def noisy_finds(capture: Capture, floor: float, noise: NoiseConfig, seed: list[int]) -> Capture:
    """What a detector finds of a room whose floor is at a height [m], and what is rebuilt of it."""
    rngs = [np.random.default_rng([*seed, k]) for k in range(4)]
    capture = _merged(capture, noise.merged, rngs[0])
    lost = [d.id for d in capture.detections if float(rngs[1].uniform()) < noise.missed]
    capture = without(capture, set(lost))
    capture = _renamed(capture, noise.wrong_class, rngs[2])
    count = int(rngs[3].binomial(len(capture.detections), noise.false))
    for index in range(count):
        capture = _with_false(capture, index, floor, rngs[3])
    return capture


def without(capture: Capture, lost: Collection[int | None]) -> Capture:
    """The capture without what some detections show: neither they nor their objects."""
    pieces = tuple(p for p in capture.scene.objects if p.annotation not in lost)
    return replace(
        capture,
        scene=replace(capture.scene, objects=pieces),
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
        found[one.id] = redrawn(one, mask)
        gone.add(other)
    capture = replace(capture, detections=tuple(found.values()))
    return without(capture, gone)


def _touch(a: Detection, b: Detection) -> bool:
    """Whether two masks come nearer than `TOUCH`."""
    from scipy.ndimage import binary_dilation

    apart = (a.box[:2] > b.box[2:] + TOUCH) | (b.box[:2] > a.box[2:] + TOUCH)
    if a.mask is None or b.mask is None or bool(apart.any()):
        return False
    return bool((binary_dilation(_mask(a), iterations=TOUCH) & _mask(b)).any())


def _renamed(capture: Capture, share: float, rng: np.random.Generator) -> Capture:
    """Some objects get another class, and a piece of that class stretched to the same box."""
    if share == 0:
        return capture
    names = {d.id: d.category for d in capture.detections}
    pieces: list[SceneObject] = []
    for piece in capture.scene.objects:
        others = [n for n in KINDS if canonical(n) != canonical(piece.category)]
        name = others[int(rng.integers(len(others)))]
        new = make_piece(name, rng)
        if float(rng.uniform()) < share and piece.annotation is not None:
            verts = piece.mesh.verts
            mesh = fit_box(new.mesh, verts.amin(0), verts.amax(0))
            names[piece.annotation] = new.category
            piece = replace(piece, category=new.category, mesh=mesh)
        pieces.append(piece)
    found = [replace(d, category=names[d.id]) for d in capture.detections]
    scene = replace(capture.scene, objects=tuple(pieces))
    return replace(capture, scene=scene, detections=tuple(found))


def _with_false(capture: Capture, index: int, floor: float, rng: np.random.Generator) -> Capture:
    """One more object that is not there, and a patch of the image as its mask."""
    camera = capture.scene.camera
    new = make_piece(KINDS[int(rng.integers(len(KINDS)))], rng)
    z = float(rng.uniform(-5.0, -2.8))
    place = torch.tensor([float(rng.uniform(0.4 * z, -0.4 * z)), floor, z])
    yaw = torch.tensor(float(rng.uniform(-np.pi, np.pi)))
    number = 1 + max((d.id for d in capture.detections), default=0)
    piece = SceneObject(f"false_{index}", new.category, new.mesh, "", number, "ground", place, yaw,
                  torch.ones(3))  # fmt: skip
    pixel = project(to_camera(place_object(piece).verts, camera.R_cam_world), camera.K)
    centre = (pixel.amin(0) + pixel.amax(0)).numpy() / 2
    half = (pixel.amax(0) - pixel.amin(0)).numpy() / 2
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    patch = ((u - centre[0]) / half[0]) ** 2 + ((v - centre[1]) / half[1]) ** 2 < 1
    if not patch.any():
        return capture
    found = Detection(number, new.category, box_of_mask(patch), encode([patch]), 0.6)
    scene = replace(capture.scene, objects=(*capture.scene.objects, piece))
    return replace(capture, scene=scene, detections=(*capture.detections, found))


FINER = 0.3  # share of masks of a head with twice as many cells a side
BLUR = 0.6  # [cells], how far the head's answer runs over its cells
WOBBLE = 12.0  # [px], over which the error of an outline changes


def headed(
    detections: tuple[Detection, ...], truth: Scene, noise: NoiseConfig, rng: np.random.Generator
) -> tuple[Detection, ...]:
    """Masks of objects as a mask head of few cells gives them, some with what is hidden."""
    out: list[Detection] = []
    pieces = {piece.annotation: index for index, piece in enumerate(truth.objects)}
    for one in detections:
        draws = rng.uniform(size=2)
        jitter = noise.mask_box * rng.normal(size=4)
        if one.mask is None:
            out.append(one)
            continue
        mask = _mask(one)
        if draws[0] < noise.amodal and one.id in pieces:
            mesh, camera = place_object(truth.objects[pieces[one.id]]), truth.camera
            verts, size = to_camera(mesh.verts, camera.R_cam_world), (camera.height, camera.width)
            mask = mask | first_hit(verts, mesh.faces, camera.K, size)[0].isfinite().numpy()
        box = _jittered(box_of_mask(mask).double().numpy(), jitter, mask.shape)
        cells = noise.mask_head * (2 if draws[1] < FINER else 1)
        drawn = coarse(mask, box, cells) if cells else mask
        mask = drawn if drawn.any() else mask
        found = box_of_mask(mask) if not noise.mask_box else torch.from_numpy(box).float()
        out.append(replace(one, mask=encode([mask]), box=found))
    return tuple(out)


def _jittered(
    box: Float[np.ndarray, "4"], jitter: Float[np.ndarray, "4"], shape: tuple[int, int]
) -> Float[np.ndarray, "4"]:
    """A box whose sides are off by shares of its size, inside the image and not empty."""
    size = np.tile(box[2:] - box[:2], 2)
    limit = np.tile([shape[1], shape[0]], 2)
    off = np.clip(box + jitter * size, 0, limit)
    return off if (off[2:] - off[:2] > 2).all() else box


def coarse(
    mask: Bool[np.ndarray, "h w"], box: Float[np.ndarray, "4"], cells: int
) -> Bool[np.ndarray, "h w"]:
    """A mask through a head of `cells` x `cells` over a box, pasted at one half."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    steps = (np.arange(4 * cells) + 0.5) / (4 * cells)
    u = box[0] + steps * (box[2] - box[0]) - 0.5
    v = box[1] + steps * (box[3] - box[1]) - 0.5
    grid = np.meshgrid(v, u, indexing="ij")
    fine = map_coordinates(mask.astype(float), grid, order=0, mode="nearest")
    head = gaussian_filter(fine.reshape(cells, 4, cells, 4).mean((1, 3)), BLUR, mode="nearest")
    rows = np.arange(max(0, int(box[1])), min(mask.shape[0], int(np.ceil(box[3]))))
    cols = np.arange(max(0, int(box[0])), min(mask.shape[1], int(np.ceil(box[2]))))
    at = np.meshgrid(
        (rows + 0.5 - box[1]) / (box[3] - box[1]) * cells - 0.5,
        (cols + 0.5 - box[0]) / (box[2] - box[0]) * cells - 0.5,
        indexing="ij",
    )
    out = np.zeros_like(mask)
    out[np.ix_(rows, cols)] = map_coordinates(head, at, order=1, mode="nearest") >= 0.5
    return out


def wobbling(people: People | None, pixels: float, rng: np.random.Generator) -> People | None:
    """Masks of people whose outlines are off by some pixels (standard deviation), out and in."""
    if people is None or pixels == 0:
        return people
    count = len(people.frame)
    masks = [wobbled(decode(people.masks, k).numpy(), pixels, rng) for k in range(count)]
    return replace(people, masks=encode(masks)) if masks else people


def wobbled(
    mask: Bool[np.ndarray, "h w"], pixels: float, rng: np.random.Generator
) -> Bool[np.ndarray, "h w"]:
    """The mask with its outline moved by a smooth random field of a spread [px]."""
    from scipy.ndimage import distance_transform_edt, zoom

    def moved(part: np.ndarray) -> np.ndarray:
        size = [int(np.ceil(side / WOBBLE)) + 2 for side in part.shape]
        field = np.asarray(zoom(rng.normal(size=size), WOBBLE, order=1))
        field = field[: part.shape[0], : part.shape[1]]
        field = field * (pixels / max(float(field.std()), 1e-6))
        near, beyond = (np.asarray(distance_transform_edt(x)) for x in (part, ~part))
        return np.where(part, near - 0.5, 0.5 - beyond) + field > 0

    return _near(mask, int(3 * pixels) + 2, moved)
