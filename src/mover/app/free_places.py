"""Places for pieces that do not stay: out of each other, on their floor or support, along a wall.

Pieces that stand in each other come apart: the shortest level way out, within stated ranges.

Gravity alone is no help there: it throws such pieces over. Instead places around each are tried,
the nearest first, the least certain piece first, until nothing is inside it; if none is free, it
goes where it is the least deep, and the other piece makes room.
"""

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.run import Run
from mover.core.types import Scene, SceneObject
from mover.evaluate.stability import modelled
from mover.geometry.boxes import box_of, corners
from mover.geometry.rotations import rot_y
from mover.io.export.mjcf import body_name
from mover.io.export.shell import LINE, TURNED, Wall
from mover.io.export.solids import floor_height, solids_of

TOUCH = 0.002  # [m], so deep is no more than a touch
RINGS, STEP = 50, 0.01  # places that are tried: rings of so many metres, at most so many
WAYS = 16  # places on a ring
PASSES = 3
KEYS = ("x", "y", "z", "yaw")
Ranges = dict[str, dict[str, tuple[float, float]]]
"""Lowest and highest place [m] of the middle of objects' undersides, and yaw [rad], by id."""


@dataclass(frozen=True)
class Hands:
    """A simulation whose bodies are moved by hand."""

    mujoco: Any
    model: Any
    data: Any

    def depths(self) -> dict[int, float]:
        """How deep each body is in others and in walls, the floor left out [m]."""
        self.mujoco.mj_kinematics(self.model, self.data)
        self.mujoco.mj_collision(self.model, self.data)
        found, floor = dict[int, float](), self.model.geom("ground").id
        for contact in self.data.contact[: self.data.ncon]:
            pair = [int(self.model.geom_bodyid[geom]) for geom in contact.geom]
            for body in pair if floor not in contact.geom else ():
                found[body] = max(found.get(body, 0.0), -float(contact.dist))
        return found

    def place(self, body: int) -> Any:  # noqa: ANN401
        """(x, y) of a free body, to be changed [m]."""
        return self._free(body)[:2]

    def height(self, body: int) -> Any:  # noqa: ANN401
        """(z,) of a free body, to be changed [m]."""
        return self._free(body)[2:]

    def _free(self, body: int) -> Any:  # noqa: ANN401
        start = self.model.jnt_qposadr[self.model.body_jntadr[body]]
        return self.data.qpos[start : start + 3]


def base_of(piece: SceneObject) -> dict[str, float]:
    """Where the middle of its underside is [m], and its yaw [rad]: what ranges speak of."""
    box = box_of(piece)
    x, y, z = box.center.tolist()
    return {"x": x, "y": y - float(box.size[1]) / 2, "z": z, "yaw": float(piece.yaw)}


def apart(
    scene: Scene,
    run: Run,
    ranges: Ranges,
    loose: Collection[str],
    walls: tuple[Wall, ...] = (),
) -> Scene:
    """The scene with pieces that stand in each other moved level, as far as ranges allow.

    Args:
        scene: A room; what carries others, hangs or has no range stays where it is.
        run: Its folder keeps the convex pieces.
        ranges: Where each piece may be.
        loose: Ids of the pieces that do not stay; they and what they stand in are moved.
        walls: Still walls.
    """
    solids = solids_of(scene, run)
    world = Hands(*modelled(scene, solids, walls))
    carriers = {piece.support for piece in scene.objects}
    pieces = {
        world.model.body(body_name(solid)).id: piece
        for piece, solid in zip(scene.objects, solids, strict=True)
        if solid.free and piece.id not in carriers and ranges.get(piece.id)
    }
    start = {body: np.array(world.place(body)) for body in pieces}
    depths = world.depths()
    if not any(depths.get(b, 0.0) > TOUCH for b, p in pieces.items() if p.id in loose):
        return scene
    least_certain = sorted(pieces, key=lambda b: -_width(ranges[pieces[b].id]))
    for _ in range(PASSES):
        for body in least_certain:
            if world.depths().get(body, 0.0) > TOUCH:
                world.place(body)[:] = _way_out(world, body, pieces[body], ranges, start[body])
    return _moved(scene, {pieces[b].id: world.place(b) - start[b] for b in pieces})


def _width(stated: dict[str, tuple[float, float]]) -> float:
    return sum(high - low for key, (low, high) in stated.items() if key in ("x", "z"))


def _way_out(
    world: Hands, body: int, piece: SceneObject, ranges: Ranges, start: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The nearest place where nothing is inside a body, else where it is the least deep."""
    base, stated = base_of(piece), ranges[piece.id]
    x_range, z_range = (stated.get(key, (base[key], base[key])) for key in ("x", "z"))
    least, best = world.depths().get(body, 0.0), np.array(world.place(body))
    for ring in _rings():
        for x, y in ring:
            if not (_within(base["x"] + x, x_range) and _within(base["z"] - y, z_range)):
                continue
            there = start + np.array((x, y))
            world.place(body)[:] = there
            deep = world.depths().get(body, 0.0)
            if deep < least - 1e-6:
                least, best = deep, there
        if least <= TOUCH:
            break
    return best


def _rings() -> Iterator[list[tuple[float, float]]]:
    """Steps in all directions, the shortest first [m]."""
    yield [(0.0, 0.0)]
    angles = [2 * math.pi * way / WAYS for way in range(WAYS)]
    for ring in range(1, RINGS + 1):
        yield [(ring * STEP * math.cos(a), ring * STEP * math.sin(a)) for a in angles]


def _within(value: float, limits: tuple[float, float]) -> bool:
    return limits[0] - 1e-6 <= value <= limits[1] + 1e-6


def outside(given: SceneObject, now: SceneObject, ranges: dict[str, tuple[float, float]]) -> str:
    """Why a place is beyond what is stated of it; empty: it is not."""
    if not ranges:
        return "its uncertainty is not stated"
    here, there = base_of(given), base_of(now)
    for key in KEYS:
        step = there[key] - here[key]
        step = math.remainder(step, 2 * math.pi) if key == "yaw" else step
        low, high = (limit - here[key] for limit in ranges.get(key, (here[key],) * 2))
        if not low - 1e-6 <= step <= high + 1e-6:
            unit = "rad" if key == "yaw" else "m"
            return f"{key} would change by {step:+.3f} {unit}, stated are {low:+.3f} to {high:+.3f}"
    return ""


def _moved(scene: Scene, steps: dict[str, NDArray[np.float64]]) -> Scene:
    """The scene after level steps in the simulator's axes."""
    ways = [(piece, steps.get(piece.id, np.zeros(2)).tolist()) for piece in scene.objects]
    return replace(scene, objects=tuple(_stepped(piece, (x, 0.0, -y)) for piece, (x, y) in ways))


# Where something would hold a piece that falls: on its floor or support, along a wall behind it.
#
# Gravity brings down what floats over its carrier. It does not bring back what stands half beside
# it, lift what is deep in it, or lean on a wall what stands a hand's breadth before it.


AIR = 0.001  # [m], left to a wall
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
    rise = floor_height(scene) - base_of(piece)["y"]
    there = _stepped(piece, (0.0, rise, 0.0)) if ground else _on_support(scene, run, piece)
    if float((there.t_world_object - piece.t_world_object).norm()) > STILL:
        yield ("the floor" if ground else piece.support), there
    for wall in walls if ground else ():
        beside = _along(wall, there)
        if beside is not None:
            yield f"the wall guessed from {wall.source}", beside


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
