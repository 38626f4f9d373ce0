"""Small scenes and bodies whose metrics are known."""

from dataclasses import replace
from typing import Literal

import torch
import trimesh

from mover.bodies.skinning import open_body, zero_pose
from mover.core.types import Bodies, Camera, Mesh, Scene, SceneObject
from mover.evaluate.evaluation import EvaluateConfig
from mover.evaluate.scene import Pair
from mover.geometry.camera import tilted

F64 = torch.float64
K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=F64)
CAMERA = Camera(K, tilted(torch.tensor(-0.2, dtype=F64), torch.tensor(0.02, dtype=F64)), 640, 480)
GROUND = -1.4
FAST = EvaluateConfig(samples=200, bodies=4)
SELF_CONTAINED = {"non_collision", "contact"}  # they judge an estimate by itself


def mesh_of(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(torch.tensor(shape.vertices, dtype=F64), torch.tensor(shape.faces))


def cuboid(x: float, y: float, z: float) -> Mesh:
    """A closed box on the origin."""
    mesh = mesh_of(trimesh.creation.box((x, y, z)))
    return Mesh(mesh.verts + torch.tensor([0, y / 2, 0], dtype=F64), mesh.faces)


def piece(mesh: Mesh, t: tuple[float, ...], yaw: float = 0.0, name: str = "a") -> SceneObject:
    return SceneObject(
        id=name, category="chair", mesh=mesh, mesh_file="", annotation=None, support="ground",
        t_world_object=torch.tensor(t, dtype=F64), yaw=torch.tensor(yaw, dtype=F64),
        scale=torch.ones(3, dtype=F64),
    )  # fmt: skip


def pair(estimate: SceneObject, truth: SceneObject, samples: int = 2000) -> Pair:
    return Pair(estimate, CAMERA, truth, CAMERA, samples)


def moved(item: SceneObject, *shift: float) -> SceneObject:
    return replace(item, t_world_object=item.t_world_object + torch.tensor(shift, dtype=F64))


def room() -> Scene:
    """A chair, a table and a rug without thickness before the camera."""
    cube = cuboid(1, 1, 1)
    rug = Mesh(cube.verts * torch.tensor([1.5, 0, 1.0], dtype=F64), cube.faces)
    pieces = (
        piece(cuboid(0.5, 0.9, 0.5), (-0.6, GROUND, -2.5), 0.4, "chair"),
        piece(cuboid(1.2, 0.7, 0.8), (0.8, GROUND, -3), -0.2, "table"),
        piece(rug, (0, GROUND, -3), 0.1, "rug"),
    )
    return Scene(CAMERA, GROUND, tuple(replace(one, category=one.id) for one in pieces))


def people(frames: int = 3, detail: Literal["small", "full"] = "small") -> Bodies:
    """A person who stands on the floor, a little more to the right each time."""
    model = open_body(detail)
    verts, joints = model.posed(zero_pose(frames, model))
    lift = GROUND - verts[..., 1].min()
    place = torch.tensor([[0.3 * i - 0.9, float(lift), -1.7] for i in range(frames)])[:, None]
    index = torch.arange(frames)
    return Bodies(
        verts + place, model.faces, joints + place, model.joint_names, index,
        torch.zeros_like(index), 30.0, "world", None,
    )  # fmt: skip


def some_people(verts: torch.Tensor, faces: torch.Tensor | None = None) -> Bodies:
    index = torch.arange(len(verts))
    faces = torch.tensor([[0, 1, 2]]) if faces is None else faces
    none = torch.zeros_like(index)
    return Bodies(verts, faces, None, (), index, none, None, "world", None)


def grid_body(low: float, high: float, n: int = 5) -> torch.Tensor:
    """A body: a square sheet of points between two heights above a unit cube's base."""
    x, y = torch.meshgrid(torch.linspace(-0.2, 0.2, n), torch.linspace(low, high, n), indexing="ij")
    return torch.stack([x, y, torch.zeros_like(x)], -1).reshape(1, -1, 3).double()


def random_piece(v: list[float]) -> SceneObject:
    mesh = cuboid(1 + 0.6 * v[0], 1 + 0.6 * v[1], 1 + 0.6 * v[2])
    mesh = Mesh(mesh.verts + 0.3 * torch.tensor(v[3:6], dtype=F64), mesh.faces)
    shape = piece(mesh, (0.5 * v[6], 0.3 * v[7] - 1, -3 + 0.5 * v[8]), 3 * v[9])
    return replace(shape, scale=torch.tensor([1 + 0.3 * v[9], 1.0, 1 - 0.3 * v[8]], dtype=F64))
