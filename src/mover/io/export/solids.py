"""Furniture as physics wants it: convex pieces, mass, inertia, in a world with +z up.

Simulators and robots have +z up and a floor at zero: (x, y, z) of scene.json becomes
(x, -z, y - ground). A turn about +y becomes the same turn about +z, and the front of a piece, +z of
its mesh, becomes -y.
"""

import dataclasses
from collections.abc import Iterable
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.records import record
from mover.core.run import Run
from mover.core.types import Mesh, Scene, SceneObject
from mover.furniture.library import canonical
from mover.geometry.placement import place_object, placed_at
from mover.io.export.convex import Convex, convex_of

DENSITY = {
    "chair": 500.0, "stool": 450.0, "bench": 450.0, "table": 450.0, "desk": 400.0,
    "coffee table": 400.0, "office chair": 250.0, "armchair": 90.0, "sofa": 80.0, "bed": 90.0,
    "shelf": 450.0, "cabinet": 170.0, "wardrobe": 120.0, "nightstand": 200.0, "floor lamp": 700.0,
    "step": 450.0,
}  # fmt: skip
"""Mass over the volume of the closed mesh [kg/m³]. Boards and legs are wood (450 to 700); what is
upholstered is mostly foam, and a cabinet's mesh is full where the piece is hollow: there the values
give usual weights (a sofa for two 45 kg, a wardrobe 80 kg)."""
OTHER = 250.0
LEAST = 0.05  # [kg]
FRICTION = (0.8, 0.005, 0.0001)  # wood on wood or carpet; slip, spin, roll
AXES = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
"""From +y up to +z up."""


@record
class Solid:
    """One piece of furniture in the simulator's axes."""

    id: str
    category: str
    place: Float[Tensor, "3"]
    """Of the mesh's origin; the floor is at zero [m]."""
    yaw: float
    """About +z [rad]."""
    free: bool
    """False: it hangs or is built in, so it does not move."""
    hulls: tuple[Mesh, ...]
    """Convex pieces in its own axes, at its size [m]."""
    mass: float
    """[kg]"""
    centre: Float[Tensor, "3"]
    """Centre of mass in its own axes [m]."""
    inertia: Float[Tensor, "3 3"]
    """About the centre of mass [kg m²]."""


def floor_height(scene: Scene) -> float:
    """Height of the floor, or of the lowest thing where no floor is known [m]."""
    if scene.ground is not None:
        return scene.ground
    lows = [float(place_object(p).verts[p.mesh.faces.unique(), 1].min()) for p in scene.objects]
    return min(lows, default=0.0)


def solids_of(scene: Scene, run: Run) -> tuple[Solid, ...]:
    """All pieces of a scene.

    Args:
        scene: Initial, result or truth.
        run: Its folder keeps the convex pieces.
    """
    floor = floor_height(scene)
    return tuple(_solid(piece, convex_of(piece, run), floor) for piece in scene.objects)


def _solid(piece: SceneObject, convex: Convex, floor: float) -> Solid:
    scale = piece.scale.detach().cpu().double()
    place = AXES @ piece.t_world_object.detach().cpu().double()
    place = place - torch.tensor([0.0, 0.0, floor], dtype=torch.float64)
    volume = abs(convex.volume) * float(scale.prod())
    mass = max(LEAST, volume * DENSITY.get(canonical(piece.category), OTHER))
    inertia = AXES @ _stretched(convex.inertia, scale) @ AXES.mT * mass / max(volume, 1e-9)
    return Solid(
        id=piece.id,
        category=piece.category,
        place=place,
        yaw=float(piece.yaw),
        free=piece.support != "free",
        hulls=tuple(_turned(hull, scale) for hull in convex.hulls),
        mass=mass,
        centre=AXES @ (scale * convex.centre),
        inertia=_physical(inertia, mass),
    )


def moved_to(solid: Solid, piece: SceneObject, frame: int) -> Solid:
    """The solid of a piece where that stands in a frame."""
    there = placed_at(piece, frame)
    way = AXES @ (there.t_world_object - piece.t_world_object).detach().cpu().double()
    return dataclasses.replace(solid, place=solid.place + way, yaw=float(there.yaw))


def _turned(mesh: Mesh, scale: Float[Tensor, "3"]) -> Mesh:
    return Mesh((mesh.verts.detach().cpu().double() * scale) @ AXES.mT, mesh.faces.cpu())


def _stretched(inertia: Float[Tensor, "3 3"], scale: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Inertia of a solid that is stretched along its axes, at the same density."""
    spread = torch.eye(3, dtype=inertia.dtype) * inertia.trace() / 2 - inertia
    spread = spread * scale[:, None] * scale[None] * scale.prod()
    return torch.eye(3, dtype=inertia.dtype) * spread.trace() - spread


def _physical(inertia: Float[Tensor, "3 3"], mass: float) -> Float[Tensor, "3 3"]:
    """The inertia, at least that of a ball of 1 cm, so that thin shells stay valid bodies."""
    values, axes = torch.linalg.eigh((inertia + inertia.mT) / 2)
    spread = (values.sum() / 2 - values).clamp_min(mass * 1e-4 / 5)
    values = spread.sum() - spread
    return axes @ torch.diag(values) @ axes.mT


# Numbers and meshes as text for the formats of simulators.


def numbers(values: Iterable[float]) -> str:
    """Decimals with a space between them."""
    return " ".join(f"{value:.8g}" for value in values)


def mesh_bytes(mesh: Mesh, kind: Literal["obj", "stl"]) -> bytes:
    """A mesh as Wavefront OBJ (places and triangles) or as binary STL."""
    import trimesh
    from trimesh.exchange.obj import export_obj
    from trimesh.exchange.stl import export_stl

    shape = trimesh.Trimesh(mesh.verts.numpy(), mesh.faces.numpy(), process=False)
    if kind == "stl":
        return export_stl(shape)
    return export_obj(shape, include_normals=False, header="").encode()
