"""What room, masks and feet constrain about bodies, gathered before they are refined."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.corrected import spread
from mover.bodies.parts import BodyParts, members
from mover.bodies.posture import speeds
from mover.bodies.skin import PARTS, SOLES
from mover.core.records import record
from mover.core.types import Bodies, Camera, Capture, Mesh, Room
from mover.energy.body_contact import Surface
from mover.energy.body_terms import Bounds, Sighting, bounds_of_skin
from mover.geometry.camera import project, to_camera
from mover.geometry.mesh import sample_surface
from mover.geometry.placement import place_object
from mover.geometry.raster import first_hit
from mover.geometry.volume import Volume, grid_around
from mover.geometry.volume_warp import union_bodies
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

    Args:
        piece: Index of the drawn object; -1: none.
        masks: Where each was detected.
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


def order_bounds(
    room: Surroundings,
    table: MaskTable,
    rows: Int[Tensor, " bodies"],
    skin: Float[Tensor, "bodies points 3"],
    normals: Float[Tensor, "bodies points 3"],
) -> Bounds:
    """Bounds of the depth of skin points where they are now, by people's masks and furniture."""
    small = small_camera(room.camera)
    cam, facing = (to_camera(x, room.camera.R_cam_world) for x in (skin, normals))
    at = project(cam, small.K).floor().long()
    inside = (at >= 0).all(-1) & (at[..., 0] < small.width) & (at[..., 1] < small.height)
    x, y = at[..., 0].clamp(0, small.width - 1), at[..., 1].clamp(0, small.height - 1)
    masks: list[Tensor] = []  # well inside the body's mask, and well outside all
    for row in rows.tolist():
        own, others = small_masks(torch.stack(table.decode(row)), room.camera)
        both = torch.stack([own, ~(own | others)])
        masks.append(~widened(~both, INNER) & (table.own[row] is not None))
    shown, away = torch.stack(masks, 1)
    body = torch.arange(len(rows))[:, None].expand_as(x)
    return bounds_of_skin(
        Sighting(
            torch.where(inside, room.front[y, x], torch.full_like(cam[..., 2], torch.inf)),
            shown[body, y, x],
            away[body, y, x] & room.owned[y, x],
            (cam * facing).sum(-1) < 0,
            room.loose[y, x],
        )
    )
