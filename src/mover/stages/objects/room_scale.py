"""How large the whole room is: what people's size leaves open, furniture and seats constrain.

Not in the paper, whose people have their own size. People of unknown height make floor, places and
sizes too large at once, which no image shows. Three things do: how far away and how large each
object was given, standard dimensions of furniture, and how high people sit, since seats are made
for legs. All of it is one least-squares problem in logarithms, each line with an error of its own:

    people: s = how much larger than theirs,   seats: s = how much too high people sit
    distance, placed / given  = s + m + d          d: error that all given distances share
    size, placed / given      = s + w_i f + x_ik   x: true size / given, w: how little shapes fit
    0                         = x_ik - m - t - o_i t: error of one tool, o: of one object, m: of all
    size, standard / given    = x_ik - g_ck        g: what the objects of one category share
"""

import math
from collections.abc import Collection

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.bodies.parts import BodyParts, members
from mover.bodies.posture import at, landmarks, postures
from mover.core.records import record
from mover.core.types import Bodies, Layout
from mover.energy.prior_terms import AWAY, COMMON, KIND, SIZE, Given
from mover.stages.posterior import Observations, least_squares

DISTANCES = 0.1  # error that all given distances have in common, of the logarithm: as one's own
TOOL = 0.04  # ... and all given sizes of a room: shapes of one tool fill their boxes similarly
FILLED = 0.015  # ... and sizes as placed, of shapes of a weight of 1 (`prior_weights`)
FITTED = 0.06  # error of a logarithm of a distance or size that the image alone finds
SEAT = 0.44  # [m], of a usual seat over the floor
SEATS = 0.06  # standard deviation of its logarithm: chairs .43-.47, sofas .40-.45, offices .42-.50
POSES = 0.04  # the same of how high people seem to sit: all their poses err together
CARRIED = ("seat", "left_thigh", "right_thigh")  # of a seated person
USUAL = 2.0  # seats that SEATS is worth when the spread of a room's seats is estimated
LOWEST = 0.1  # share of a sitter's points below the top of the seat
SAME = 0.3  # [m] between two who sit on one seat
FEWEST = 3  # bodies that give the height of a seat
SOURCES = ("people", "seats", "distances", "sizes", "standards")  #: of knowledge of the scale


@record
class ScaleKnown:
    """What constrains the scale of a room beside its furniture."""

    people: tuple[float, float]
    """Logarithm of how much larger the room is than people of the usual size have it, and its
    standard deviation; 0: their size is known."""
    shared: float = 0.0
    """The same of all that was given, together (`Scene.size_spread`)."""
    seats: tuple[float, float] | None = None
    """Logarithm of how much too high people sit, and its standard deviation."""


def common_scale(
    layout: Layout,
    given: Given,
    categories: tuple[str, ...],
    known: ScaleKnown,
    sources: Collection[str] = SOURCES,
) -> tuple[float, float]:
    """Logarithm of how much too large the whole room is, and its standard deviation.

    Args:
        layout: Where the objects were placed under the people's scale.
        given: What was expected of them.
        categories: Of the objects.
        known: What else is known.
        sources: Which of them count; the errors of the others have no bounds.
    """
    if known.people[1] <= 0:
        return 0.0, 0.0
    count, kinds = len(categories), sorted(set(categories))
    kind = torch.tensor([kinds.index(name) for name in categories])
    unknowns = torch.eye(5 + 4 * count + 3 * len(kinds), dtype=torch.float64)
    scale, common, far, tool, filled = unknowns[:5]
    own, true, usual = unknowns[5:].split((count, 3 * count, 3 * len(kinds)))
    true = true.view(count, 3, -1)
    wide_of = {name: 1.0 if name in sources else math.inf for name in SOURCES}
    seen = Observations()
    seen.add(scale, known.people[0], known.people[1] * wide_of["people"])
    seen.add(common, 0.0, max(known.shared, 1e-6))
    seen.add(far, 0.0, DISTANCES)
    seen.add(tool, 0.0, TOOL)
    seen.add(filled, 0.0, FILLED)
    seen.add(own, 0.0, COMMON)
    seen.add(usual, 0.0, 1.0, robust=True)
    if known.seats is not None:
        seen.add(scale, known.seats[0], known.seats[1] * wide_of["seats"])
    away = (layout.t_world_object.norm(dim=-1) / given.distance).log()
    apart = math.hypot(AWAY, FITTED) * wide_of["distances"]
    seen.add((scale + common + far).expand(count, -1), away, apart, robust=True)
    unfit = given.weight[:, None, None].double()
    seen.add(scale + unfit * filled + true, layout.log_scale, FITTED)
    seen.add(true - common - tool - own[:, None], 0.0, SIZE * wide_of["sizes"])
    known_sizes = given.precision > 0
    wide = given.precision[known_sizes].double().rsqrt()
    shared = KIND**0.5 * wide[:, None] * usual.view(-1, 3, len(unknowns))[kind][known_sizes]
    standard = given.standard[known_sizes]
    spread = (1 - KIND) ** 0.5 * wide * wide_of["standards"]
    seen.add(true[known_sizes] - shared, standard, spread, robust=True)
    found = least_squares(seen)
    return float(found.mean[0]), float(found.covariance[0, 0]) ** 0.5


def seat_height_estimate(
    bodies: Bodies, parts: BodyParts, floor: float
) -> tuple[float, float] | None:
    """Logarithm of the ratio of observed to usual seat height, and its standard deviation.

    Args:
        bodies: In the world, in the people's scale.
        parts: Of their mesh.
        floor: Its height below them [m].

    Returns:
        None where no person is seated.
    """
    carried = members(parts, *CARRIED)
    sits = postures(bodies, parts, floor).sitting
    if not bool(sits.any()) or not bool(carried.any()):
        return None
    height = bodies.verts[sits][:, carried, 1].quantile(LOWEST, dim=1) - floor
    hips = at(landmarks(bodies, parts), "hips")[sits][:, [0, 2]]
    heights = [height[rows].median() for rows in _places(hips) if int(rows.sum()) >= FEWEST]
    heights = [h for h in heights if float(h) > 0]
    if not heights:
        return None
    off = (torch.stack(heights) / SEAT).log()
    apart = (SEATS**2 * USUAL + float((off - off.mean()).square().sum())) / (USUAL + len(off) - 1)
    return float(off.mean()), (apart / len(off) + POSES**2) ** 0.5


def _places(points: Float[Tensor, "rows 2"]) -> list[Bool[Tensor, " rows"]]:
    """People seated on one seat: all that are near to the first that is left."""
    left, found = torch.ones(len(points), dtype=torch.bool), list[Bool[Tensor, " rows"]]()
    while bool(left.any()):
        first = points[left.nonzero()[0, 0]]
        near = left & ((points - first).norm(dim=-1) < SAME).cpu()
        found.append(near)
        left = left & ~near
    return found
