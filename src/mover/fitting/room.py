r"""What an estimated room says of people who are fitted in it (Sec. "HPS estimation", after PROX).

    E = E_Body + w_sdf Σ_{v: Φ(v) < 0} |Φ(v)|                      (+SDF)
      + w_contact mean_{v touches} ρ(d(v); 5 cm)                   (+Contact)
      + w_under max_v [y_gp - v_y]_+ + w_feet mean_{soles} ρ(|v_y - y_gp|; 5 cm)     (+CamGP)

Φ is the signed distance to the room's furniture, d the distance to its nearest surface point, taken
where both normals agree within 45 degrees, whatever their sign; ρ(r; σ) = r² / (r² + σ²). Skin that
may touch is that of seat, thighs, back and palms; soles that touch are those that carry the body.
The room of the paper is the one that it has estimated, where PROX has a scan.
Departure: Φ is looked up at points that lie evenly over the skin, each of which stands for as many
vertices as there are to a point.
"""

from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.records import record
from mover.fitting.config import Stage
from mover.fitting.unknowns import Points
from mover.geometry.camera import to_world
from mover.geometry.nearest import nearest_points
from mover.geometry.volume import Volume, sample

RHO = 0.05  # [m], PROX's constant of the contact, and of soles in the authors' second fit
ANGLE = 0.7071  # cosine of PROX's 45 degrees


@record
class FitRoom:
    """The estimated room, and which skin meets it."""

    R_cam_world: Float[Tensor, "3 3"]
    floor: float
    """Its height in the world [m]."""
    furniture: Volume | None
    """Signed distance to all pieces; None: there are none."""
    surface: Float[Tensor, "points 3"]
    """Points of their surfaces in the world [m]."""
    normals: Float[Tensor, "points 3"]
    picked: Int[Tensor, " picked"]
    """Vertices of the body model that stand for the skin."""
    even: Bool[Tensor, " picked"]
    """Those that lie evenly over it."""
    share: float
    """Vertices of the whole skin for each even one."""
    may_touch: Bool[Tensor, " picked"]
    """Skin that touches furniture."""
    stands: Bool[Tensor, "bodies picked"]
    """Soles that carry their body."""


def room_terms(
    points: Points, room: FitRoom | None, stage: Stage
) -> dict[str, Float[Tensor, " bodies"]]:
    """The weighted terms of the room, those that a stage asks for."""
    if room is None:
        return {}
    skin, facing = (to_world(x, room.R_cam_world.to(x)) for x in (points.skin, points.facing))
    floor, found = room.floor, dict[str, Tensor]()
    if stage.under:
        found["under"] = stage.under * under_term(skin, floor)
    if stage.feet:
        found["feet"] = stage.feet * feet_term(skin, room.stands, floor)
    if stage.sdf and room.furniture is not None:
        found["sdf"] = stage.sdf * room.share * sdf_term(skin[:, room.even], room.furniture)
    if stage.contact and len(room.surface):
        some = room.may_touch
        found["contact"] = stage.contact * contact_term(skin[:, some], facing[:, some], room)
    return found


def under_term(skin: Float[Tensor, "bodies points 3"], floor: float) -> Float[Tensor, " bodies"]:
    """Depth of the lowest point below the floor [m]."""
    return (floor - skin[..., 1]).clamp_min(0).amax(-1)


def feet_term(
    skin: Float[Tensor, "bodies points 3"],
    stands: Bool[Tensor, "bodies points"],
    floor: float,
) -> Float[Tensor, " bodies"]:
    """Mean distance of soles that carry the body from the floor, robust; 0 without any."""
    return _mean_where((skin[..., 1] - floor).square(), stands)


def sdf_term(skin: Float[Tensor, "bodies points 3"], furniture: Volume) -> Float[Tensor, " bodies"]:
    """Sum of the depths inside the furniture [m]."""
    return (-sample(furniture, skin)).clamp_min(0).sum(-1)


def contact_term(
    skin: Float[Tensor, "bodies points 3"], facing: Float[Tensor, "bodies points 3"], room: FitRoom
) -> Float[Tensor, " bodies"]:
    """Mean distance of skin from the nearest point of furniture of like direction, robust."""
    _, index = nearest_points(skin.flatten(0, 1), room.surface)
    place, normal = (x.to(skin)[index].view_as(skin) for x in (room.surface, room.normals))
    near = (facing * normal).sum(-1).abs() >= ANGLE
    return _mean_where((skin - place).square().sum(-1), near)


def _mean_where(
    squared: Float[Tensor, "bodies points"], counts: Bool[Tensor, "bodies points"]
) -> Float[Tensor, " bodies"]:
    """Mean of r² / (r² + ρ²) over the points that count; 0 where none does."""
    there = counts.to(squared)
    return (squared / (squared + RHO**2) * there).sum(-1) / there.sum(-1).clamp_min(1)
