r"""Seats as high in their meshes as people sit and lie on them (not in the paper; its failure A).

The image gives the size of an object, from its feet to the top of its back, but not how high its
seat is in between: that is inside the outline, and a mesh of another design has it elsewhere (7 cm
off, root mean square, in rooms where no mesh is the true one). Seated people give it to 2.5 cm: the
lowest of the skin that carries them is the seat. So the seat of a mesh whose shape does not fit is
raised or lowered until it is there; feet and back stay where they are.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.parts import BodyParts, members
from mover.bodies.posture import postures
from mover.core.records import record
from mover.core.types import Bodies, Layout, Objects, SceneObject, SeatStretch
from mover.geometry.placement import place
from mover.stages.objects.prepare_objects import Prepared
from mover.stages.objects.room_scale import CARRIED, FEWEST

CARRIERS = (CARRIED, ("seat",))  # of seated and of lying people
OBSERVED = 0.025  # [m], usual error of a seat height estimated from people
SHAPE = 0.07  # [m], usual error of the height of a seat in a mesh of another design
LOWEST = 0.15  # share of the supported body points that lie below the top of the seat
NEAR = 20  # points of a seat that are nearest to a body
BETWEEN = (0.15, 0.9)  # shares of the height of an object between which a seat can be moved
MOST = 0.15  # of an object's height, that its seat moves by


@record
class SeatInputs:
    """Placed furniture, its contacts with people, and which seat heights are uncertain."""

    objects: Objects
    layout: Layout
    bodies: Bodies
    """In the world."""
    parts: BodyParts
    ground: float
    """Height of the floor [m]."""
    pairs: Int[Tensor, "pairs 3"]
    """Contacts: body, object, and part as in `ContactPoints.points`."""
    unfit: Bool[Tensor, " objects"]
    """Objects whose shape does not fit the image."""


def find_seat_heights(inputs: SeatInputs) -> Float[Tensor, " objects"]:
    """Height of people above the seats of the meshes, in the objects' frames [m]."""
    objects, layout = inputs.objects, inputs.layout
    tops = place(objects.top, layout)
    posture = postures(inputs.bodies, inputs.parts, inputs.ground)
    lift = torch.zeros_like(layout.yaw)
    for k in (inputs.unfit & objects.is_seat & objects.has_top).nonzero()[:, 0].tolist():
        rows = inputs.pairs[inputs.pairs[:, 1] == k, 0].unique()
        observed: list[Tensor] = []
        for does, names in zip((posture.sitting, posture.lying), CARRIERS, strict=True):
            some, carried = rows[does[rows]], members(inputs.parts, *names)
            if len(some) >= FEWEST and bool(carried.any()):
                observed.append(_higher(inputs.bodies.verts[some][:, carried], tops[k]))
        if observed:  # the mean of what is observed and of the mesh's own height, by precision
            mean = torch.stack(observed).sum() / (len(observed) + (OBSERVED / SHAPE) ** 2)
            lift[k] = mean / layout.log_scale[k, 1].exp()
    return lift


def _higher(skin: Float[Tensor, "bodies points 3"], top: Float[Tensor, "region 3"]) -> Tensor:
    """How much higher than a seat these bodies are carried, in the median [m]."""
    low = skin[..., 1].quantile(LOWEST, dim=1)
    away = torch.cdist(skin.mean(1)[:, [0, 2]], top[:, [0, 2]])
    near = away.topk(min(NEAR, len(top)), largest=False).indices
    return (low - top[near, 1].median(-1).values).median()


def with_lifted_seats(prepared: Prepared, lift: Float[Tensor, " objects"]) -> Prepared:
    """The furniture with its seats higher by so much [m], beside earlier lifts (`stretch`)."""
    straight = prepared.straight or prepared.objects
    height, seat = straight.size[:, 1].clamp_min(1e-9), straight.top[..., 1].median(-1).values
    low, high = (share * height for share in BETWEEN)
    if prepared.stretch is not None:
        lift = lift + prepared.stretch.rise
    rise = lift.clamp(-MOST * height, MOST * height)
    rise = torch.where((seat > low) & (seat < high), (seat + rise).clamp(low, high) - seat, 0.0)
    if not bool(rise.any()):
        return prepared
    stretch = SeatStretch(torch.zeros_like(height), seat, height, rise)
    names = ("verts", "samples", "top", "back")
    lifted = {name: stretch.of(getattr(straight, name)) for name in names}
    objects = replace(prepared.objects, **lifted)
    return replace(prepared, objects=objects, stretch=stretch, straight=straight)


def seat_warnings(objects: tuple[SceneObject, ...]) -> tuple[str, ...]:
    """A sentence for each object whose seat is at another height than in its mesh."""
    return tuple(
        f"{piece.id}: its mesh does not fit the image and its seat is moved to where people sit, by"
        f" {100 * float(abs(piece.stretch.rise * piece.scale[1])):.0f} cm"
        " (`mover run --no-seat-heights` leaves it)"
        for piece in objects
        if piece.stretch is not None
    )
