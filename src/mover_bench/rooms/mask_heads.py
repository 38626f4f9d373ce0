"""Masks as networks draw them: by a coarse head in a wrong box, of what is hidden, wobbling."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Bool, Float

from mover.core.types import Detection, People, Scene
from mover.geometry.camera import to_camera
from mover.geometry.placement import place_object
from mover.geometry.raster import first_hit
from mover.geometry.rle import decode
from mover_bench.rooms.config import NoiseConfig
from mover_bench.rooms.render import box_of_mask, encode

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
        mask = decode(one.mask, 0).numpy()
        if draws[0] < noise.amodal and one.id in pieces:
            mask = mask | _whole(truth, pieces[one.id])
        box = _jittered(box_of_mask(mask).double().numpy(), jitter, mask.shape)
        cells = noise.mask_head * (2 if draws[1] < FINER else 1)
        drawn = coarse(mask, box, cells) if cells else mask
        mask = drawn if drawn.any() else mask
        found = box_of_mask(mask) if not noise.mask_box else torch.from_numpy(box).float()
        out.append(dataclasses.replace(one, mask=encode([mask]), box=found))
    return tuple(out)


def _whole(truth: Scene, index: int) -> Bool[np.ndarray, "h w"]:
    """The picture of a piece if nothing hid it."""
    camera, mesh = truth.camera, place_object(truth.objects[index])
    verts = to_camera(mesh.verts, camera.R_cam_world)
    size = (camera.height, camera.width)
    return first_hit(verts, mesh.faces, camera.K, size)[0].isfinite().numpy()


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
    masks = [
        wobbled(decode(people.masks, k).numpy(), pixels, rng) for k in range(len(people.frame))
    ]
    return dataclasses.replace(people, masks=encode(masks)) if masks else people


def wobbled(
    mask: Bool[np.ndarray, "h w"], pixels: float, rng: np.random.Generator
) -> Bool[np.ndarray, "h w"]:
    """The mask with its outline moved by a smooth random field of a spread [px]."""
    from scipy.ndimage import distance_transform_edt, zoom

    rows, cols = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return mask
    pad = int(3 * pixels) + 2
    window = np.s_[max(0, rows[0] - pad) : rows[-1] + pad + 1,
                   max(0, cols[0] - pad) : cols[-1] + pad + 1]  # fmt: skip
    part = mask[window]
    size = [int(np.ceil(side / WOBBLE)) + 2 for side in part.shape]
    field = np.asarray(zoom(rng.normal(size=size), WOBBLE, order=1))
    field = field[: part.shape[0], : part.shape[1]]
    field = field * (pixels / max(float(field.std()), 1e-6))
    near, beyond = (np.asarray(distance_transform_edt(x)) for x in (part, ~part))
    out = np.zeros_like(mask)
    out[window] = np.where(part, near - 0.5, 0.5 - beyond) + field > 0
    return out if out.any() else mask
