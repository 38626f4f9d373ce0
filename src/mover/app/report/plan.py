"""The room seen from above: footprints, fronts, paths of people and what the camera sees."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from mover.app.report.templates import fill
from mover.core.colours import colour, css, person_colour
from mover.core.types import Bodies, Camera, Scene, SceneObject
from mover.geometry.boxes import box_of, corners
from mover.geometry.placement import place_object

MARGIN = 0.5  # [m] around everything that is drawn
RANGE = 2.0  # how far beyond the furthest object the camera's cone is drawn
FEW = 8  # bodies whose dots are drawn larger
BASE = (1, 5, 4, 0)  # corners of a box around its bottom, the first two at its front
ARROW = 0.11  # [m]
DOTS = 400  # at most so many bodies are dotted for each person


@dataclass(frozen=True)
class Shape:
    """A path of the plan."""

    kind: str
    """How it looks: a class of report.css."""
    path: str
    """As SVG writes it [m]."""
    tint: str = ""
    """Its own colour, where it has one."""


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

    Args:
        scene: Filled footprints with arrows at their fronts.
        truth: Dashed footprints, in the truth's own world.
        bodies: People in the world of `scene`; their pelvises and soles are dotted.
        extent: Part of the floor to show; None: everything.
    """
    extent = extent or extent_of(scene, truth, bodies)
    shapes = [_grid(extent), *_cone(scene.camera, extent)]
    labels: list[dict[str, str]] = []
    for index, item in enumerate(scene.objects):
        shapes += _footprint(item, css(colour(index)))
        x, z = _corners(item)[:4].mean(0).tolist()
        labels.append({"kind": "name", "x": f"{x:.3f}", "z": f"{z:.3f}", "text": item.id})
    shapes += [_dashed(item) for item in (truth.objects if truth is not None else ())]
    width, height = extent.right - extent.left, extent.near - extent.far
    x, z = extent.left + 0.25, extent.near - 0.2
    bar = Shape("bar", f"M{x:.2f} {z - 0.07:.2f}v.07h1v-.07")
    scale = {"kind": "scale", "x": f"{x + 0.5:.2f}", "z": f"{z - 0.1:.2f}", "text": "1 m"}
    return fill(
        "plan.svg",
        box=f"{extent.left:.3f} {extent.far:.3f} {width:.3f} {height:.3f}",
        shapes=shapes,
        people=[] if bodies is None else _people(bodies),
        labels=[*labels, scale],
        bar=[bar],
    )


def _grid(extent: Extent) -> Shape:
    """One line a metre, beyond the extent as well: a page may show more than it asked for."""
    wide = max(extent.right - extent.left, extent.near - extent.far)
    left, right = math.floor(extent.left - wide), math.ceil(extent.right + wide)
    far, near = math.floor(extent.far - wide), math.ceil(extent.near + wide)
    lines = "".join(f"M{x} {far}V{near}" for x in range(left, right + 1))
    lines += "".join(f"M{left} {z}H{right}" for z in range(far, near + 1))
    return Shape("grid", lines)


def _cone(camera: Camera, extent: Extent) -> tuple[Shape, ...]:
    """What the middle row of the image sees, and the camera itself at the origin."""
    middle = torch.tensor([[0.0, camera.height / 2, 1.0], [camera.width, camera.height / 2, 1.0]])
    rays = middle.to(camera.K) @ torch.linalg.inv(camera.K).mT @ camera.R_cam_world
    ends = []
    for x, z in rays[:, [0, 2]].tolist():
        reach = RANGE * abs(extent.far) / max(abs(z), 1e-3)
        ends.append((reach * x, reach * z))
    (a, b), (c, d) = ends
    return (
        Shape("cone", f"M0 0L{a:.3f} {b:.3f}L{c:.3f} {d:.3f}Z"),
        Shape("sight", f"M{a:.3f} {b:.3f}L0 0L{c:.3f} {d:.3f}"),
        Shape("camera", "M-.13 .2H.13V.02H.05L.1 -.08H-.1L-.05 .02H-.13Z"),
    )


def _corners(item: SceneObject) -> Float[Tensor, "5 2"]:
    """Corners of the box seen from above, front left first, and the middle of the front [m]."""
    base = corners(box_of(item))[list(BASE)][:, [0, 2]]
    return torch.cat([base, base[:2].mean(0, keepdim=True)])


def _footprint(item: SceneObject, tint: str) -> tuple[Shape, ...]:
    """The box of an object and an arrow at its front."""
    points = _corners(item)
    inward, across = (normalize(points[k] - points[0], dim=0, eps=1e-6) for k in (3, 1))
    tip = points[4] - 0.55 * ARROW * inward
    arrow = [tip + ARROW * (inward - across), tip, tip + ARROW * (inward + across)]
    return (
        Shape("foot", _line(points[:4]) + "Z", tint),
        Shape("front", _line(torch.stack(arrow)), tint),
    )


def _dashed(item: SceneObject) -> Shape:
    points = _corners(item)
    inward = 0.12 * normalize(points[3] - points[0], dim=0, eps=1e-6)
    tick = torch.stack([points[4], points[4] - inward])
    return Shape("truth", _line(points[:4]) + "Z" + _line(tick))


def _people(bodies: Bodies) -> list[dict[str, Any]]:
    """Where the people's pelvises go (a line with dots) and where their soles are (small dots)."""
    people: list[dict[str, Any]] = []
    for person in bodies.person.unique().tolist():
        rows = (bodies.person == person).nonzero()[:, 0]
        rows = rows[bodies.frame[rows].argsort()]
        rows = rows[:: max(1, math.ceil(len(rows) / DOTS))]
        hips, feet = _hips(bodies, rows), _soles(bodies, rows)
        walk = () if bodies.fps is None else (Shape("walk", _line(hips)),)
        shapes = (Shape("soles", _dots(feet)), *walk, Shape("hips", _dots(hips)))
        kind = "person few" if len(rows) < FEW else "person"
        people.append({"kind": kind, "tint": css(person_colour(person)), "shapes": shapes})
    return people


def _hips(bodies: Bodies, rows: Tensor) -> Float[Tensor, "rows 2"]:
    if bodies.joints is not None and "pelvis" in bodies.joint_names:
        return bodies.joints[rows, bodies.joint_names.index("pelvis")][:, [0, 2]]
    return bodies.verts[rows].mean(1)[:, [0, 2]]


def _soles(bodies: Bodies, rows: Tensor) -> Float[Tensor, "rows 2"]:
    """Position of the lowest vertex of each body [m]."""
    lowest = bodies.verts[rows, :, 1].argmin(1)
    return bodies.verts[rows, lowest][:, [0, 2]]


def _line(points: Float[Tensor, "points 2"]) -> str:
    return "M" + "L".join(f"{x:.3f} {z:.3f}" for x, z in points.tolist())


def _dots(points: Float[Tensor, "points 2"]) -> str:
    """Lines of no length: their round caps are dots."""
    return "".join(f"M{x:.3f} {z:.3f}h0" for x, z in points.tolist())
