"""One world seen by one eye: the furniture is drawn once, people anew in the window they fill."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from mover.app.pictures.eye import RenderCamera, part_of, seen_from
from mover.app.pictures.floor import Ground, backdrop, metre_lines, shadows
from mover.app.pictures.paint import (
    FINE,
    Drawn,
    Ink,
    Surfaces,
    cut,
    draw,
    fine_eye,
    fine_part,
    nearer,
    over,
    paint,
)
from mover.core.records import record

OPACITY = 0.72  # of surfaces over a picture
THICK = 800  # [px] of width for each coarse pixel of an outline's thickness
RIM = 3  # [px] around a window that are drawn but not used: lines need neighbours
NEAR = 0.1  # [m], people nearer to the eye than this fill the whole picture
SHADE = 0.5  # [m], how far the shadow of people reaches


@record
class Tiles:
    """What does not move, drawn once."""

    eye: RenderCamera
    ground: Ground
    ink: Ink
    still: Drawn
    """The furniture in fine pixels."""
    floor: Float[Tensor, "h w 4"]
    """Shadows of the furniture and metre lines."""
    sheet: Float[Tensor, "h w 4"]
    """The furniture."""
    base: Float[Tensor, "h w 3"]
    """What is behind."""


def set_up(
    eye: RenderCamera, ground: Ground, still: Surfaces, base: Float[Tensor, "h w 3"] | None = None
) -> Tiles:
    """Draw the furniture.

    Args:
        eye: From where.
        ground: The floor.
        still: The furniture.
        base: A picture of the size of the eye's; None: a plain room.
    """
    over_picture = base is not None
    ink = Ink(OPACITY if over_picture else 1.0, max(1, round(eye.width / THICK)))
    drawn = draw(still, fine_eye(eye))
    lines = metre_lines(eye, ground, 1.0 if over_picture else 0.58)
    floor = lines if over_picture else over(shadows(eye, ground, still), lines)
    picture = base if base is not None else backdrop(eye, ground)
    return Tiles(eye, ground, ink, drawn, floor, paint(drawn, ink), picture)


def with_base(board: Tiles, base: Float[Tensor, "h w 3"]) -> Tiles:
    """The same world over another picture."""
    return dataclasses.replace(board, base=base)  # type: ignore[type-var]


def show(board: Tiles, moving: Surfaces | None = None) -> Float[Tensor, "h w 3"]:
    """The picture, with people in it."""
    picture = over(board.sheet, over(board.floor, board.base))
    if moving is None or not len(moving.faces):
        return picture.clamp(0, 1)
    window = _window(board, moving)
    left, top, right, bottom = window
    if right <= left or bottom <= top:
        return picture.clamp(0, 1)
    patch = _patch(board, moving, window)
    rim = [RIM if edge else 0 for edge in (left, top)]
    end = [
        RIM if e < size else 0 for e, size in ((right, board.eye.width), (bottom, board.eye.height))
    ]
    inner = patch[rim[1] : bottom - top - end[1], rim[0] : right - left - end[0]]
    picture[top + rim[1] : bottom - end[1], left + rim[0] : right - end[0]] = inner
    return picture.clamp(0, 1)


def _patch(
    board: Tiles, moving: Surfaces, window: tuple[int, int, int, int]
) -> Float[Tensor, "height width 3"]:
    """The window with people in it."""
    left, top, right, bottom = window
    here = (slice(top, bottom), slice(left, right))
    fine = (FINE * edge for edge in window)
    drawn = nearer(cut(board.still, *fine), draw(moving, fine_part(board.eye, window)))
    behind = over(board.floor[here], board.base[here])
    if board.ink.opacity == 1:
        behind = over(shadows(part_of(board.eye, *window), board.ground, moving), behind)
    return over(paint(drawn, board.ink), behind)


def _window(board: Tiles, moving: Surfaces) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of what people and their shadows fill [px]."""
    eye = board.eye
    flat = moving.verts.clone()
    flat[:, 1] = board.ground.height
    around = torch.tensor([[SHADE, 0, SHADE], [-SHADE, 0, SHADE], [SHADE, 0, -SHADE]])
    around = torch.cat([around, -around[:1]])
    corners = (flat[:, None] + around).reshape(-1, 3)
    points = seen_from(eye, torch.cat([moving.verts, corners]))
    whole = (0, 0, eye.width, eye.height)
    if float(seen_from(eye, moving.verts)[:, 2].min()) < NEAR:
        return whole
    points = points[points[:, 2] > NEAR]
    pixel = (points @ eye.K.mT)[:, :2] / points[:, 2:]
    size = torch.tensor([eye.width, eye.height])
    low = (pixel.amin(0).floor() - RIM).long().clamp_min(0).minimum(size)
    high = (pixel.amax(0).ceil() + RIM).long().clamp_min(0).minimum(size)
    (left, top), (right, bottom) = low.tolist(), high.tolist()
    return left, top, right, bottom
