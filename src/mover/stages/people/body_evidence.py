"""What room, masks and feet constrain about bodies, gathered before they are refined."""

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.corrected import spread
from mover.bodies.parts import PARTS, SOLES, BodyParts, members
from mover.bodies.posture import speeds
from mover.core.records import record
from mover.core.types import Bodies, Camera, Capture, Mesh, Room
from mover.energy.body_contact import Surface
from mover.energy.body_terms import OUTLINE_POINTS, Bounds, Outline, Sighting, bounds_of_skin
from mover.geometry.camera import project, to_camera
from mover.geometry.crops import depth_in
from mover.geometry.mesh import sample_surface
from mover.geometry.placement import place_object
from mover.geometry.raster import Crops, first_hit, fronts
from mover.geometry.volume import Volume, grid_around, union_bodies
from mover.stages.contacts.assign_contacts import evenly
from mover.stages.masks import MaskTable, small_camera, small_masks, widened
from mover.stages.objects.find_image_cues import image_evidence

CELL = 0.025  # [m], of the furniture's volume
MOST_CELLS = 320  # along its longest side
SAMPLES = 1500  # points on the surface of each object
SKIN_POINTS = 400  # even points of a body
PART_POINTS = 40  # at most, of each part that touches
LOW = (0.08, 0.03)  # [m] over the lowest point of a body: a sole hangs, surely carries
STILL = (0.5, 0.2)  # [m/s] of a sole: moves, surely at rest; bodies fitted frame by frame tremble
SURFACE_ERROR = 0.2  # [m] error of a surface position where the silhouette does not fit at all
FITS = 0.1  # share of a silhouette that masks of shapes that fit leave
STEEPEST = 4.0  # metres of depth for a metre by which a surface is off, at most
INNER = 2  # [px of an image 640 wide] by which masks shrink before they bound anything
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


@record
class Surroundings:
    """The estimated room, as bodies meet it."""

    camera: Camera
    floor: float
    """Its height in the world [m]."""
    furniture: Volume | None
    """Signed distance to all objects; None: there are none."""
    firm: Volume | None
    """The same to what they surely fill, as far as their shapes are uncertain."""
    surface: Surface
    """Points of their surfaces."""
    front: Float[Tensor, "h w"]
    """Depth of the nearest object in the image 640 wide [m]; inf: none."""
    loose: Float[Tensor, "h w"]
    """How far off that may be, as the shape of the object is uncertain [m]."""
    owned: Bool[Tensor, "h w"]
    """The object that is drawn there is also detected there."""


@dataclass(frozen=True)
class Picked:
    """The vertices that stand for a body."""

    index: Int[Tensor, " picked"]
    even: Bool[Tensor, " picked"]
    """Those that lie evenly over the body."""
    part: Int[Tensor, " picked"]
    """Index into `PARTS`; -1: none."""
    group: Int[Tensor, " picked"]
    """0: no part that is known, then each of `PARTS`."""


def surroundings_of(room: Room, capture: Capture | None) -> Surroundings:
    """The closed furniture of a room where it stands, its volume, surface and picture.

    Raises:
        ValueError: If the room has no floor.
    """
    floor = room.scene.ground
    if floor is None:
        raise ValueError("surroundings_of: the room has no floor")
    camera = room.scene.camera
    meshes = [
        place_object(replace(piece, mesh=proxy))
        for piece, proxy in zip(room.scene.objects, room.proxies, strict=True)
    ]
    small = small_camera(camera)
    front, piece, slant = _drawn(meshes, camera, small)
    owned, uncertain = torch.zeros_like(piece, dtype=torch.bool), torch.zeros(len(meshes))
    if capture is not None and meshes:
        masks = small_masks(image_evidence(capture).masks, capture.scene.camera)
        owned = (piece >= 0) & masks.gather(0, piece.clamp_min(0)[None])[0]
        uncertain = shape_uncertainty(piece, masks)
    furniture, firm = _volumes(meshes, uncertain)
    surface = _surface(meshes, uncertain)
    loose = torch.zeros_like(front) if not meshes else uncertain[piece.clamp_min(0)] * slant
    return Surroundings(camera, floor, furniture, firm, surface, front, loose, owned)


def shape_uncertainty(
    piece: Int[Tensor, "h w"], masks: Bool[Tensor, "objects h w"]
) -> Float[Tensor, " objects"]:
    """Usual error of the surface position of each object, estimated from its silhouette [m].

    `piece` is the index of the drawn object (-1: none), the masks are where each was detected.
    """
    shown = masks.any(0)
    found = torch.zeros(len(masks))
    for k, mask in enumerate(masks):
        drawn = (piece == k) & (mask | ~shown)
        seen = mask & ((piece == k) | (piece < 0))
        union = max(1, int((drawn | seen).sum()))
        overlap = int((drawn & seen).sum()) / union if bool(mask.any()) else 1.0
        found[k] = SURFACE_ERROR * max(0.0, 1 - overlap - FITS)
    return found


def _drawn(meshes: list[Mesh], camera: Camera, small: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Depth and index (-1: none) of the nearest object, and the slant of its surface."""
    size = (small.height, small.width)
    if not meshes:
        none = torch.full(size, torch.inf)
        return none, torch.full(size, -1), torch.zeros(size)
    verts = to_camera(torch.cat([m.verts for m in meshes]), camera.R_cam_world).contiguous()
    starts = torch.tensor([0, *(len(m.verts) for m in meshes[:-1])]).cumsum(0)
    faces = torch.cat([m.faces + s for m, s in zip(meshes, starts, strict=True)])
    owner = torch.cat([torch.full((len(m.faces),), k) for k, m in enumerate(meshes)])
    depth, face = first_hit(verts, faces, small.K, size)
    some = face.clamp_min(0)
    corners = verts[faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = torch.cosine_similarity(normals, corners.mean(1), dim=-1).abs()
    slant = (1 / facing.clamp_min(1 / STEEPEST))[some]  # over the cosine with the ray
    return depth, torch.where(face >= 0, owner[some], torch.full_like(face, -1).long()), slant


def _volumes(
    meshes: list[Mesh], uncertain: Float[Tensor, " pieces"]
) -> tuple[Volume | None, Volume | None]:
    """The signed distance to all objects, and to the volume that they surely fill."""
    if not meshes:
        return None, None
    verts = torch.cat([m.verts for m in meshes]).float()
    low, high = verts.amin(0), verts.amax(0)
    cells = min(MOST_CELLS, max(8, int(float((high - low).max()) / CELL)))
    empty = grid_around(low, high, cells, 0.1)
    whole = firm = empty.values
    for mesh, give in zip(meshes, uncertain.tolist(), strict=True):  # each has its own triangles
        own = union_bodies(mesh.verts.float()[None], mesh.faces, empty, 1).values
        same = firm is whole and not give
        whole = torch.minimum(whole, own)
        firm = whole if same else torch.minimum(firm, own + give)
    return replace(empty, values=whole), replace(empty, values=firm)


def _surface(meshes: list[Mesh], uncertain: Float[Tensor, " pieces"]) -> Surface:
    found = [sample_surface(m, SAMPLES) for m in meshes]
    none = torch.zeros(0, 3)
    pieces = [torch.full((len(p),), k) for k, (p, _) in enumerate(found)]
    return Surface(
        torch.cat([none, *(p.float() for p, _ in found)]),
        torch.cat([none, *(n.float() for _, n in found)]),
        torch.cat([none[:, 0].long(), *pieces]),
        uncertain,
    )


def pick(bodies: Bodies, parts: BodyParts) -> Picked:
    """Even points of the whole skin, and more of the parts that touch."""
    verts = bodies.verts[len(bodies.verts) // 2]
    even = spread(verts, SKIN_POINTS)
    chosen = [even]
    for name in PARTS:
        own = members(parts, name).nonzero()[:, 0]
        if len(own):
            chosen.append(own[spread(verts[own], PART_POINTS)])
    index = torch.cat(chosen).unique()
    part = parts.part_of[index]
    return Picked(index, torch.isin(index, even), part, part + 1)


def resting_soles(
    bodies: Bodies, parts: BodyParts, lying: Bool[Tensor, " bodies"]
) -> Float[Tensor, "bodies feet"]:
    """Chance that each sole is at rest and carries its body, whatever its height over the floor."""
    low = bodies.verts[..., 1].amin(1)
    found: list[Tensor] = []
    for name in SOLES:
        own = members(parts, name)
        if not own.any():
            found.append(torch.zeros_like(low))
            continue
        sole = bodies.verts[:, own]
        speed = speeds(sole.mean(1, keepdim=True), bodies)[:, 0]
        still, carries = (
            ((value - zero) / (one - zero)).clamp(0, 1)
            for value, (zero, one) in ((speed, STILL), (sole[..., 1].amin(1) - low, LOW))
        )
        found.append(still * carries * ~lying)
    return torch.stack(found, 1)


def sure_masks(
    table: MaskTable, camera: Camera, rows: Int[Tensor, " bodies"]
) -> Bool[Tensor, "2 bodies h w"]:
    """What is well inside the mask of each body, and what is well outside all masks."""
    found: list[Tensor] = []
    for row in rows.tolist():
        own, others = small_masks(torch.stack(table.decode(row)), camera)
        both = torch.stack([own, ~(own | others)])
        found.append(~widened(~both, INNER) & (table.own[row] is not None))
    return torch.stack(found, 1)


def order_bounds(
    room: Surroundings,
    masks: Bool[Tensor, "2 bodies h w"],
    skin: Float[Tensor, "bodies points 3"],
    normals: Float[Tensor, "bodies points 3"],
) -> Bounds:
    """Bounds of the depth of skin points where they are now, by `sure_masks` and furniture."""
    small = small_camera(room.camera)
    cam, facing = (to_camera(x, room.camera.R_cam_world) for x in (skin, normals))
    at = project(cam, small.K).floor().long()
    inside = (at >= 0).all(-1) & (at[..., 0] < small.width) & (at[..., 1] < small.height)
    x, y = at[..., 0].clamp(0, small.width - 1), at[..., 1].clamp(0, small.height - 1)
    shown, away = masks
    body = torch.arange(len(skin))[:, None].expand_as(x)
    return bounds_of_skin(
        Sighting(
            torch.where(inside, room.front[y, x], torch.full_like(cam[..., 2], torch.inf)),
            shown[body, y, x],
            away[body, y, x] & room.owned[y, x],
            (cam * facing).sum(-1) < 0,
            room.loose[y, x],
        )
    )


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
        drawn = fronts(some.verts.float(), seen.faces, views)
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
    body, zoom, camera = drawn.isfinite(), float(window[2]), seen.camera
    x, y = ((torch.arange(SIDE) + 0.5) / zoom + float(c) for c in window[:2])  # [px of the image]
    own, others, front = (_sampled(m, x, y, camera) for m in (own, others, seen.front))
    if not bool(own.any()) or not bool(body.any()):
        return None
    depth = drawn[body].median()
    border = (x < 2) | (x > camera.width - 2) | ((y < 2) | (y > camera.height - 2))[:, None]
    blocked = widened((others | (front < depth + BEHIND) | border)[None], SPREAD)[0]
    away = _signed(own)
    normal, rises = _slope(_signed(body)), _slope(away)
    agree = (normal * rises).sum(0) > ALONG
    near = away.abs() < REACH * camera.width * zoom
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


def _sampled(
    image: Tensor, x: Float[Tensor, " side"], y: Float[Tensor, " side"], camera: Camera
) -> Tensor:
    """An image of any size at the pixel centres of a window; its border goes on."""
    height, width = image.shape
    columns = (x * width / camera.width).long().clamp(0, width - 1)
    rows = (y * height / camera.height).long().clamp(0, height - 1)
    return image[rows][:, columns]


def _signed(mask: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Distance from the outline, negative inside [px]."""
    inside = mask.numpy()
    inner = depth_in(inside) if not inside.all() else 1.0
    return torch.from_numpy(np.where(inside, 0.5 - inner, depth_in(~inside) - 0.5)).float()


def _slope(image: Float[Tensor, "h w"]) -> Float[Tensor, "2 h w"]:
    """Direction in which a distance grows, along x and y."""
    smooth = torch.nn.functional.avg_pool2d(image[None], 5, 1, 2, count_include_pad=False)
    down, right = torch.gradient(smooth[0])
    both = torch.stack([right, down])
    return both / torch.hypot(right, down).clamp_min(1e-6)
