"""The room seen from above: footprints, fronts, paths of people and what the camera sees."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mover.app.report import fill
from mover.core.colours import colour, css, person_colour
from mover.core.types import Bodies, Scene, SceneObject, rows_by_person
from mover.geometry.boxes import box_of
from mover.geometry.placement import place_object

MARGIN = 0.5  # [m] around everything that is drawn
RANGE = 2.0  # how far beyond the furthest object the camera's cone is drawn
FEW = 8  # bodies whose dots are drawn larger
DOTS = 400  # at most so many bodies are dotted for each person


@dataclass(frozen=True)
class Extent:
    """The part of the floor that a plan shows [m]."""

    left: float
    right: float
    far: float
    near: float


def extent_of(*things: Scene | Bodies | None) -> Extent:
    """Smallest part of the floor that holds all furniture, people and cameras."""
    points = [torch.zeros(1, 2)]
    for thing in things:
        if isinstance(thing, Bodies):
            rows = torch.arange(len(thing.verts))
            points += [_hips(thing, rows), _soles(thing, rows)]
        elif thing is not None:
            points += [place_object(p).verts[:, [0, 2]] for p in thing.objects]
    stands = torch.cat([p.detach().cpu().float() for p in points])
    (left, far), (right, near) = stands.amin(0).tolist(), stands.amax(0).tolist()
    grow = max(0.0, 2.0 - (right - left)) / 2
    return Extent(left - MARGIN - grow, right + MARGIN + grow, far - MARGIN, near + MARGIN)


def draw_top(
    scene: Scene,
    truth: Scene | None = None,
    bodies: Bodies | None = None,
    *,
    extent: Extent | None = None,
) -> str:
    """Plan of `scene` as inline SVG: x to the right, away from the camera upwards.

    Filled footprints with arrows at their fronts; dashed ones of the truth in its own world; dots
    at pelvises and soles of people in the world of `scene`. Without `extent` everything is shown.
    """
    extent, camera = extent or extent_of(scene, truth, bodies), scene.camera
    # The borders of the middle row of the image.
    middle = torch.tensor([[0.0, camera.height / 2, 1.0], [camera.width, camera.height / 2, 1.0]])
    rays = middle.to(camera.K) @ torch.linalg.inv(camera.K).mT @ camera.R_cam_world
    reach = RANGE * abs(extent.far) / rays[:, 2:].abs().clamp_min(1e-3)
    wide = max(extent.right - extent.left, extent.near - extent.far)  # a page may show more
    return fill(
        "plan.svg",
        extent=extent,
        columns=range(math.floor(extent.left - wide), math.ceil(extent.right + wide) + 1),
        rows=range(math.floor(extent.far - wide), math.ceil(extent.near + wide) + 1),
        sight=(reach * rays[:, [0, 2]]).tolist(),
        objects=[
            _footprint(item) | {"tint": css(colour(k))} for k, item in enumerate(scene.objects)
        ],
        truth=[_footprint(item) for item in (() if truth is None else truth.objects)],
        people=[] if bodies is None else _people(bodies),
    )


def _footprint(item: SceneObject) -> dict[str, Any]:
    """Middle, width, depth [m] and turn [degrees] of an object's box; its front is at +depth."""
    box = box_of(item)
    (x, _, z), (width, _, depth) = box.center.tolist(), box.size.tolist()
    turn = -math.degrees(float(box.yaw))
    return {"id": item.id, "x": x, "z": z, "turn": turn, "width": width, "depth": depth}


def _people(bodies: Bodies) -> list[dict[str, Any]]:
    """Where the people's pelvises go (a line with dots) and where their soles are (small dots)."""
    people: list[dict[str, Any]] = []
    for rows in rows_by_person(bodies.frame, bodies.person):
        rows = rows[:: max(1, math.ceil(len(rows) / DOTS))]
        people.append({
            "kind": "person few" if len(rows) < FEW else "person",
            "tint": css(person_colour(int(bodies.person[rows[0]]))),
            "hips": _hips(bodies, rows).tolist(),
            "soles": _soles(bodies, rows).tolist(),
            "walks": bodies.fps is not None,
        })  # fmt: skip
    return people


def _hips(bodies: Bodies, rows: Tensor) -> Float[Tensor, "rows 2"]:
    if bodies.joints is not None and "pelvis" in bodies.joint_names:
        return bodies.joints[rows, bodies.joint_names.index("pelvis")][:, [0, 2]]
    return bodies.verts[rows].mean(1)[:, [0, 2]]


def _soles(bodies: Bodies, rows: Tensor) -> Float[Tensor, "rows 2"]:
    """Position of the lowest vertex of each body [m]."""
    lowest = bodies.verts[rows, :, 1].argmin(1)
    return bodies.verts[rows, lowest][:, [0, 2]]
