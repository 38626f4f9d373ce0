"""Compare the outlines of bodies, where they stand now, with their masks."""

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.types import Camera
from mover.energy.body_terms import OUTLINE_POINTS, Outline
from mover.geometry.camera import project
from mover.geometry.raster import Crops, layers
from mover.stages.contacts.assign_contacts import evenly
from mover.stages.masks import MaskTable, widened

SIDE = 160  # [px] of a body's window
AROUND = 1.3  # window over the longer side of the body's box
REACH = 0.02  # [image widths], farther no outline is looked for
ALONG = 0.6  # least cosine between the drawn outline's normal and the way to the mask's outline
MOST = 48  # points of one body's outline
LEAST = 12  # fewer say nothing
BEHIND = 0.1  # [m] by which an object has to be behind a body to be surely no occluder
SPREAD = 2  # [px of the window] around what may end a mask
WIDER = 3.0  # [px], usual error of a mask's border that is the same all around
SHIFT = 8.0  # [px], usual shift of a body against its mask
LARGER = 0.04  # usual error of the size that a body is seen with, as a share
ERROR = 2.0  # [px], usual error of one place of an outline
INDEPENDENT = 16.0  # places of an outline


@dataclass(frozen=True)
class SeenBodies:
    """Bodies in camera axes, and what may hide them."""

    verts: Float[Tensor, "bodies verts 3"]
    faces: Int[Tensor, "faces 3"]
    skin: Float[Tensor, "bodies points 3"]
    """The skin points that carry the outline [m]."""
    camera: Camera
    front: Float[Tensor, "h w"]
    """Depth of the nearest object, in a picture of any size [m]; inf: none."""


def gather_outlines(seen: SeenBodies, table: MaskTable, rows: Int[Tensor, " bodies"]) -> Outline:
    """How far each body's outline is from that of its mask."""
    found: list[Outline] = []
    for first in range(0, len(rows), 64):  # 64 windows at a time, for memory
        part = slice(first, first + 64)
        some = replace(seen, verts=seen.verts[part], skin=seen.skin[part])
        views, corner = _windows(some)
        drawn = layers(some.verts.float(), seen.faces, views).front
        for k, row in enumerate(rows[part].tolist()):  # masks are decoded one by one
            if table.own[row] is None:
                continue
            one = _compare(some, k, drawn[k], corner[k], *table.decode(row))
            if one is not None:
                found.append(replace(one, body=one.body + first))
    pair, one = seen.skin.new_zeros(0, 2).float(), torch.zeros(0, dtype=torch.long)
    found.append(Outline(one, one, pair, pair, pair[:, 0], pair[:, 0]))
    names = (field.name for field in fields(Outline))
    return Outline(**{name: torch.cat([getattr(o, name) for o in found]) for name in names})


def _windows(seen: SeenBodies) -> tuple[Crops, Float[Tensor, "bodies 3"]]:
    """A square window around each body; its corner [px] and its zoom."""
    at = project(seen.verts, seen.camera.K.to(seen.verts))
    low, high = at.amin(1), at.amax(1)
    side = AROUND * (high - low).amax(-1).clamp_min(8)
    zoom, corner = SIDE / side, (low + high) / 2 - side[:, None] / 2
    K = seen.camera.K.to(at).expand(len(at), 3, 3).clone()
    K[:, :2, 2] = K[:, :2, 2] - corner
    K[:, :2] = K[:, :2] * zoom[:, None, None]
    return Crops(K.float(), SIDE, SIDE), torch.cat([corner, zoom[:, None]], -1)


def _compare(
    seen: SeenBodies,
    k: int,
    drawn: Float[Tensor, "side side"],
    window: Float[Tensor, "3"],
    own: Bool[Tensor, "h w"],
    others: Bool[Tensor, "h w"],
) -> Outline | None:
    """The outline of one body; None where too little of it can be compared."""
    body, zoom = drawn.isfinite(), float(window[2])
    own, others = (_sampled(m, window, seen.camera) for m in (own, others))
    if not bool(own.any()) or not bool(body.any()):
        return None
    depth = drawn[body].median()
    front = _sampled(seen.front, window, seen.camera)
    outside = _outside(window, seen.camera)
    blocked = widened((others | (front < depth + BEHIND) | outside)[None], SPREAD)[0]
    away = _signed(own)
    normal, rises = _slope(_signed(body)), _slope(away)
    agree = (normal * rises).sum(0) > ALONG
    near = away.abs() < REACH * seen.camera.width * zoom
    edge = body & widened(~body[None], 1)[0]
    y, x = (edge & ~blocked & agree & near).nonzero(as_tuple=True)
    if len(y) < LEAST:
        return None
    gap = (away[y, x] + 0.5) / zoom
    gap = gap - _wider(gap, normal[:, y, x].mT, torch.stack([x, y], -1) / zoom)
    some = evenly(torch.arange(len(y)), MOST)
    y, x = y[some], x[some]
    pixel = torch.stack([x, y], -1).float().add(0.5) / zoom + window[:2]
    skin = project(seen.skin[k], seen.camera.K.to(seen.skin))
    carrier = torch.cdist(pixel, skin.float()).argmin(-1)
    weight = torch.full_like(gap[some], OUTLINE_POINTS / len(some))
    return Outline(
        torch.full_like(carrier, k), carrier, skin[carrier].float(), normal[:, y, x].mT,
        gap[some], weight,
    )  # fmt: skip


def _wider(
    gap: Float[Tensor, " points"], normal: Float[Tensor, "points 2"], at: Float[Tensor, "points 2"]
) -> Tensor:
    """By how much the mask is narrower all around, apart from a body that is off or too large [px].

    Least squares with a usual size for each: the border, two shifts, and the share of the size.
    """
    middle = at - at.mean(0)
    size = middle.norm(dim=-1).amax().clamp_min(1.0)
    ways = torch.cat([torch.ones_like(gap)[:, None], normal], -1)
    ways = torch.cat([ways, (normal * middle).sum(-1, keepdim=True) / size], -1)
    usual = gap.new_tensor([WIDER, SHIFT, SHIFT, LARGER * float(size)])
    design = (ways * usual).double()
    ridge = torch.eye(4, dtype=torch.float64) * ERROR**2
    inner = design.mT @ design + ridge * len(gap) / INDEPENDENT
    share = torch.linalg.solve(inner, design.mT @ gap.double())
    return share[0].to(gap) * WIDER


def _sampled(image: Tensor, window: Float[Tensor, "3"], camera: Camera) -> Tensor:
    """An image of any size at the pixel centres of the window; its border goes on."""
    x, y = ((torch.arange(SIDE) + 0.5) / float(window[2]) + float(c) for c in window[:2])
    height, width = image.shape
    columns = (x * width / camera.width).long().clamp(0, width - 1)
    rows = (y * height / camera.height).long().clamp(0, height - 1)
    return image[rows][:, columns]


def _outside(window: Float[Tensor, "3"], camera: Camera) -> Bool[Tensor, "side side"]:
    """Beyond the border of the image, or right at it."""
    x, y = ((torch.arange(SIDE) + 0.5) / float(window[2]) + float(c) for c in window[:2])
    rows, columns = (y < 2) | (y > camera.height - 2), (x < 2) | (x > camera.width - 2)
    return rows[:, None] | columns[None]


def _signed(mask: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Distance from the outline, negative inside [px]."""
    from scipy.ndimage import distance_transform_edt

    inside = mask.numpy()
    outer = np.asarray(distance_transform_edt(~inside)) if not inside.all() else 0.0 * inside
    inner = np.asarray(distance_transform_edt(inside)) if not inside.all() else inside + 0.0
    return torch.from_numpy(np.where(inside, 0.5 - inner, outer - 0.5)).float()


def _slope(image: Float[Tensor, "h w"]) -> Float[Tensor, "2 h w"]:
    """Direction in which a distance grows, along x and y."""
    smooth = torch.nn.functional.avg_pool2d(image[None], 5, 1, 2, count_include_pad=False)
    down, right = torch.gradient(smooth[0])
    both = torch.stack([right, down])
    return both / both.norm(dim=0).clamp_min(1e-6)
