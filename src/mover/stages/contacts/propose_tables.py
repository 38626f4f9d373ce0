"""Tables that no detector saw: where people lean on their hands, again and again, on nothing known.

The height is that of the palms, drawn towards that of tables and desks where people sit; the front
looks at who uses it most. The top is a rectangle that holds all palms, as large as such pieces
usually are, whose near edge is some centimetres before the palms of each side from which it is
used; no body may pass through it, and nothing may be seen through it (a person, or a known object,
behind the place of the top); what nothing known hides of people, it should. Among all rectangles of
a grid the likeliest is taken.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from mover.bodies.posture import at, facing, landmarks
from mover.furniture.library import SEEDS, STANDARD, make_piece
from mover.geometry.boxes import beyond
from mover.geometry.camera import at_pixels, project, to_camera
from mover.geometry.rotations import rot_y
from mover.stages.contacts.resting import Place
from mover.stages.masks import small_camera

HIGH = 0.84  # [m]: what standing people lean on from here on is a sideboard, not a table
SITS = 0.2  # share of the rests that make a place one at which people sit
PALM = 0.03  # [m], error of the height of a palm over some seconds
SIDES = 0.2  # share of the rests on a side from which a table is used
EDGE = (0.11, 0.06)  # [m] from the near edge to the nearest skin of a palm, and its deviation
SPREAD = (0.2, 0.22)  # deviation of the logarithms of a piece's width and depth
OFF = 0.3  # [m], deviation of the middle of a top along the edge from that of the palms
CELL = 0.04  # [m]
FAR = 2.0  # [m] from the palms to the end of the grid
BAND = (0.09, 0.02)  # [m] under the top in which bodies would stand in it
TAKEN = 60.0  # nats for each square metre that cannot be a table
WITHIN = 0.22  # [m] from the hips: what is farther are arms, and a sitter's knees
SLACK = (0.05, 0.02)  # [m], and share of the depth, by which a ray may seem free behind a top
TRIED = 3000  # rectangles, the likeliest by all else, that are asked what they hide
RAYS, LEVELS = 300, 6  # of hidden bodies, and heights at which a ray may enter a piece
ENDS = 0.02  # share of the points beyond each end

Ranges = tuple[Float[Tensor, " n"], Float[Tensor, " n"]]


@dataclass(frozen=True, eq=False)
class HandPlace(Place):
    """All hands that rest at one place."""

    @cached_property
    def seated(self) -> bool:
        """People sit here."""
        return float(self.inputs.pose.sitting[self.rows].float().mean()) > SITS

    @cached_property
    def kind(self) -> str:
        """A name of `furniture.library.PIECES`."""
        if not self.seated and float(self.heights.median()) > HIGH:
            return "cabinet"
        return "table" if int((self.sides > SIDES).sum()) > 1 else "desk"

    @cached_property
    def height(self) -> float:
        """Of the top over the floor [m]."""
        found, usual = float(self.heights.median()), STANDARD[self.kind][1]
        if usual is None:
            return found
        spread = usual[0] * usual[1]
        share = spread**2 / (spread**2 + PALM**2)
        return share * found + (1 - share) * usual[0]

    @cached_property
    def _ways(self) -> Float[Tensor, " rests"]:
        """Where its users look, about +y from +z [rad]."""
        front = facing(landmarks(self.inputs.bodies, self.inputs.parts))[self.rows]
        return torch.atan2(front[:, 0], front[:, 2])

    @cached_property
    def sides(self) -> Float[Tensor, "4"]:
        """Share of the rests on each side: the front, and on, counter-clockwise from above."""
        quarter = ((self._ways - self._axis) / (torch.pi / 2)).round().long() % 4
        share = torch.bincount(quarter, minlength=4) / len(quarter)
        return share.roll(-int(share.argmax()))

    @cached_property
    def _axis(self) -> Float[Tensor, ""]:
        """One of the four directions that most of them nearly look in [rad]."""
        return torch.atan2((4 * self._ways).sin().sum(), (4 * self._ways).cos().sum()) / 4

    @cached_property
    def yaw(self) -> Float[Tensor, ""]:
        """Of the piece, whose front looks at those who use it most [rad]."""
        quarter = ((self._ways - self._axis) / (torch.pi / 2)).round().long() % 4
        most = int(torch.bincount(quarter, minlength=4).argmax())
        return self._axis + most * torch.pi / 2 + torch.pi

    @cached_property
    def palms(self) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
        """Least and largest x and z of the palms from their middle, in the piece's axes [m]."""
        points = torch.cat([rest.points for rest in self.rests]) - self.middle
        ends = torch.tensor([ENDS, 1 - ENDS])
        low, high = torch.quantile((points @ rot_y(self.yaw))[:, [0, 2]], ends, dim=0)
        return low, high


@dataclass(frozen=True)
class Top:
    """The likeliest top: its height, the middle of its footprint and its edges [m]."""

    middle: Float[Tensor, "3"]
    size: tuple[float, float]
    """Along x and z of the piece."""


def usual_size(kind: str) -> tuple[float, float]:
    """Width and depth of a piece of the library, in the mean [m]."""
    pieces = [make_piece(kind, np.random.default_rng(seed), 0).size for seed in range(SEEDS)]
    return float(np.mean([s[0] for s in pieces])), float(np.mean([s[2] for s in pieces]))


def likeliest_top(place: HandPlace) -> Top:
    """The rectangle around the palms that agrees best with all that is seen."""
    taken = _summed(_taken(place))
    wide, deep = usual_size(place.kind)
    low, high = place.palms
    used = (place.sides > SIDES).tolist()  # front (+z), right (+x), back, left of the piece
    x = _spans((wide, SPREAD[0]), (low[0], high[0]), (used[3], used[1]))
    z = _spans((deep, SPREAD[1]), (low[1], high[1]), (used[2], used[0]))
    area = _boxes(taken, x[0], z[0]) * CELL**2
    energy = (TAKEN * area + x[1][:, None] + z[1]).flatten()
    some = energy.topk(min(TRIED, len(energy)), largest=False).indices
    across, along = x[0][some // len(z[1])], z[0][some % len(z[1])]
    best = int((energy[some] + TAKEN * _unexplained(place, across, along)).argmin())
    flat = torch.stack([across[best].mean(), torch.zeros(()), along[best].mean()])
    size = float(across[best].diff()), float(along[best].diff())
    return Top(place.middle + flat @ rot_y(place.yaw).mT, size)


def _unexplained(
    place: HandPlace, x: Float[Tensor, "boxes 2"], z: Float[Tensor, "boxes 2"]
) -> Float[Tensor, " boxes"]:
    """Area of the bodies that something unknown hides, and that would not be these boxes [m²]."""
    far, camera = place.inputs.hidden, small_camera(place.inputs.camera)
    v, u = far.isfinite().nonzero(as_tuple=True)
    keep = torch.linspace(0, max(len(u) - 1, 0), min(len(u), RAYS)).long()
    u, v = u[keep], v[keep]
    pixel = torch.stack([u + 0.5, v + 0.5, torch.ones_like(u)], -1)
    rays = pixel @ torch.linalg.inv(camera.K).mT
    area = (far[v, u] / camera.K[0, 0]).square() * (far.isfinite().sum() / max(len(u), 1))
    down = rays @ camera.R_cam_world  # in the world, for a depth of 1 m
    foot = float(place.inputs.under[place.rows].median())
    height = foot + place.height * torch.linspace(1, 0, LEVELS)
    depth = height[:, None] / down[:, 1]
    there = depth[..., None] * down - place.middle
    flat = (there @ rot_y(place.yaw))[..., [0, 2]]
    before = (depth > 0) & (depth < far[v, u] - SLACK[0])
    inside = before.expand(len(x), -1, -1)
    for axis, spans in ((0, x), (1, z)):
        at = flat[..., axis]
        inside = inside & (at > spans[:, :1, None]) & (at < spans[:, 1:, None])
    return (~inside.any(1) * area).sum(1)


def _spans(
    usual: tuple[float, float], palms: tuple[Tensor, Tensor], used: tuple[bool, bool]
) -> tuple[Float[Tensor, "spans 2"], Float[Tensor, " spans"]]:
    """Where a top may begin and end along one axis, and how unlikely each is [nats].

    Args:
        usual: Length of such pieces [m], and the deviation of its logarithm.
        palms: Ends of what touches [m].
        used: Whether people stand or sit before the lower and the upper edge.
    """
    ends = torch.arange(-FAR, FAR + CELL / 2, CELL)
    low, high = ends[ends <= palms[0]], ends[ends >= palms[1]]
    spans = torch.cartesian_prod(low, high)
    length = spans[:, 1] - spans[:, 0]
    energy = 0.5 * ((length / usual[0]).log() / usual[1]).square()
    for edge, gap in ((0, palms[0] - spans[:, 0]), (1, spans[:, 1] - palms[1])):
        if used[edge]:
            energy = energy + 0.5 * ((gap - EDGE[0]) / EDGE[1]).square()
    if not any(used):
        middle = spans.mean(1) - (palms[0] + palms[1]) / 2
        energy = energy + 0.5 * (middle / OFF).square()
    return spans, energy


def _boxes(
    summed: Float[Tensor, "x z"], x: Float[Tensor, "a 2"], z: Float[Tensor, "b 2"]
) -> Float[Tensor, "a b"]:
    """Sum of the cells in each rectangle, from the sums up to each corner."""
    i, k = (((ends + FAR) / CELL).round().long() for ends in (x, z))
    part = summed[i[:, 1]] - summed[i[:, 0]]
    return part[:, k[:, 1]] - part[:, k[:, 0]]


def _summed(cells: Bool[Tensor, "x z"]) -> Float[Tensor, "nx nz"]:
    """Sums of the cells up to each corner."""
    whole = torch.zeros(cells.shape[0] + 1, cells.shape[1] + 1)
    whole[1:, 1:] = cells.float().cumsum(0).cumsum(1)
    return whole


def _taken(place: HandPlace) -> Bool[Tensor, "x z"]:
    """Cells around the palms that cannot be the top: people pass, things stand, or one sees."""
    count = round(2 * FAR / CELL)
    line = (torch.arange(count) + 0.5) * CELL - FAR
    flat = torch.stack(torch.meshgrid(line, line, indexing="ij"), -1)
    local = torch.stack([flat[..., 0], torch.zeros_like(flat[..., 0]), flat[..., 1]], -1)
    cells = local @ rot_y(place.yaw).mT + place.middle
    top = float(place.inputs.under[place.rows].median()) + place.height
    cells[..., 1] = top
    found = _passed(place, top, count) | _seen_through(cells, place) | _filled(cells, place)
    share = avg_pool2d(found[None].float(), 3, 1, 1, count_include_pad=False)[0]
    return share > 0.5  # single cells are noise


def _passed(place: HandPlace, top: float, count: int) -> Bool[Tensor, "x z"]:
    """Cells in which trunks or thighs of two moments are at the height of the top."""
    inputs = place.inputs
    bodies, high = inputs.bodies, inputs.bodies.verts[..., 1]
    hips = at(landmarks(bodies, inputs.parts), "hips")
    aside = (bodies.verts - hips[:, None])[..., [0, 2]].norm(dim=-1)
    inside = (high > top - BAND[0]) & (high < top - BAND[1]) & (aside < WITHIN)
    row, vertex = inside.nonzero(as_tuple=True)
    flat = ((bodies.verts[row, vertex] - place.middle) @ rot_y(place.yaw))[:, [0, 2]]
    index = ((flat + FAR) / CELL).floor().long()
    near = ((index >= 0) & (index < count)).all(1)
    key = (row[near] * count + index[near, 0]) * count + index[near, 1]
    found = torch.bincount(key.unique() % count**2, minlength=count**2)
    return found.reshape(count, count) > 1


def _seen_through(cells: Float[Tensor, "x z 3"], place: HandPlace) -> Bool[Tensor, "x z"]:
    """Cells behind which something is seen."""
    free = place.inputs.known.free
    if not free.numel():
        return torch.zeros(cells.shape[:2], dtype=torch.bool)
    camera = small_camera(place.inputs.camera)
    points = to_camera(cells, camera.R_cam_world)
    depth = points[..., 2]
    far, shown = at_pixels(free, project(points, camera.K).long())
    return shown & (depth > 0) & (depth < far * (1 - SLACK[1]) - SLACK[0])


def _filled(cells: Float[Tensor, "x z 3"], place: HandPlace) -> Bool[Tensor, "x z"]:
    """Cells in which a known piece stands that is no seat, and reaches above the top."""
    boxes = place.inputs.known.boxes
    found = torch.zeros(cells.shape[:2], dtype=torch.bool)
    for index in (~place.inputs.known.sat_on).nonzero()[:, 0].tolist():  # a few in a room
        box = type(boxes)(boxes.center[index], boxes.size[index], boxes.yaw[index])
        if float(box.center[1] + box.size[1] / 2) > float(cells[0, 0, 1]) - BAND[0]:
            found |= (beyond(box, cells) < 0).all(-1)
    return found
