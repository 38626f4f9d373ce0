"""Where something would hold a piece that falls: on its floor or support, along a wall behind it.

Gravity brings down what floats over its carrier. It does not bring back what stands half beside
it, lift what is deep in it, or lean on a wall what stands a hand's breadth before it.
"""

import math
from collections.abc import Iterator
from dataclasses import replace

import torch

from mover.app.apart import TOUCH, Hands, base_of
from mover.core.run import Run
from mover.core.types import Scene, SceneObject
from mover.evaluate.stability import modelled
from mover.geometry.boxes import box_of, corners
from mover.geometry.rotations import rot_y
from mover.io.export.mjcf import body_name
from mover.io.export.shell import LINE, TURNED, Wall
from mover.io.export.solids import floor_height, solids_of

AIR = 0.001  # [m], left to a wall
STEP = 0.01  # [m], on the way down to a support
HALVES = 5  # of the last step
STILL = 1e-4  # [m], less is no step


def held_places(
    scene: Scene, run: Run, walls: tuple[Wall, ...], piece: SceneObject
) -> Iterator[tuple[str, SceneObject]]:
    """Places where a piece would be held, and by what: first as it is turned, then along walls.

    Args:
        scene: The piece and the others.
        run: Its folder keeps the convex pieces.
        walls: What it may lean on.
        piece: One of the scene's.
    """
    ground = piece.support == "ground"
    there = _on_floor(scene, piece) if ground else _on_support(scene, run, piece)
    if float((there.t_world_object - piece.t_world_object).norm()) > STILL:
        yield ("the floor" if ground else piece.support), there
    for wall in walls if ground else ():
        beside = _along(wall, there)
        if beside is not None:
            yield f"the wall guessed from {wall.source}", beside


def _on_floor(scene: Scene, piece: SceneObject) -> SceneObject:
    """Its underside at the height of the floor."""
    return _stepped(piece, (0.0, floor_height(scene) - base_of(piece)["y"], 0.0))


def _stepped(piece: SceneObject, by: tuple[float, float, float]) -> SceneObject:
    step = torch.tensor(by).to(piece.t_world_object)
    return replace(piece, t_world_object=piece.t_world_object + step)


def _on_support(scene: Scene, run: Run, piece: SceneObject) -> SceneObject:
    """The shortest level way over its support, then down on to it."""
    support = next(p for p in scene.objects if p.id == piece.support)
    under, own = box_of(support), box_of(piece)
    turn = float(own.yaw - under.yaw)
    c, s = abs(math.cos(turn)), abs(math.sin(turn))
    x, y, z = own.size.tolist()
    needed = torch.tensor([c * x + s * z, 0.0, s * x + c * z]).to(under.size)
    room = ((under.size - needed) / 2).clamp_min(0)
    away = rot_y(-under.yaw) @ (own.center - under.center)
    inside = rot_y(under.yaw) @ torch.minimum(torch.maximum(away, -room), room)
    level = (inside + under.center - own.center).tolist()
    top = float(under.center[1] + under.size[1] / 2 - own.center[1]) + y / 2
    start = _stepped(piece, (level[0], top, level[2]))
    down = _way_down(scene, run, start, float(under.size[1]))
    return _stepped(start, (0.0, -down, 0.0))


def _way_down(scene: Scene, run: Run, piece: SceneObject, most: float) -> float:
    """How far a piece over its support sinks until it touches something [m]."""
    moved = replace(scene, objects=tuple(piece if p.id == piece.id else p for p in scene.objects))
    solids = solids_of(moved, run)
    hands = Hands(*modelled(moved, solids))
    body = hands.model.body(body_name(next(s for s in solids if s.id == piece.id))).id
    height = hands.height(body)
    top = float(height[0])

    def touches(down: float) -> bool:
        height[0] = top - down
        return hands.depths().get(body, 0.0) > TOUCH / 4

    low = 0.0
    while low < most and not touches(low + STEP):
        low += STEP
    step = STEP
    for _ in range(HALVES):
        step /= 2
        low += 0.0 if touches(low + step) else step
    return low


def _along(wall: Wall, piece: SceneObject) -> SceneObject | None:
    """The piece with its back on a wall; None: it turns it elsewhere, or stands too far away."""
    out = wall.out.to(piece.yaw)
    back = torch.stack([-piece.yaw.sin(), -piece.yaw.cos()])
    if float(back @ out) < math.cos(TURNED):
        return None
    turned = replace(piece, yaw=torch.atan2(-out[0], -out[1]))
    x, _, z = (box_of(piece).center - box_of(turned).center).tolist()
    turned = _stepped(turned, (x, 0.0, z))
    edge = float(wall.start @ wall.out)
    gap = edge - AIR - float((corners(box_of(turned))[:, ::2] @ out).max())
    if gap > LINE:
        return None
    return _stepped(turned, (gap * float(out[0]), 0.0, gap * float(out[1])))
