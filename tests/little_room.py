"""A room of boxes and a walking capsule, for tests of pictures and files."""

import math

import torch
import trimesh

from mover.core.types import Bodies, Camera, Mesh, Scene, SceneObject
from mover.geometry.camera import tilted

GROUND = -1.5


def mesh_of(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(torch.tensor(shape.vertices).float(), torch.tensor(shape.faces).long())


def box(width: float, height: float, depth: float) -> Mesh:
    """A box that stands on the origin."""
    shape = trimesh.creation.box(extents=(width, height, depth))
    shape.apply_translation([0, height / 2, 0])
    return mesh_of(shape)


def piece(
    name: str, mesh: Mesh, place: tuple[float, float], yaw: float, ground: float
) -> SceneObject:
    t = torch.tensor([place[0], ground, place[1]])
    return SceneObject(
        name, name.split("_")[0], mesh, "", 1, "ground", t, torch.tensor(yaw), torch.ones(3)
    )


def camera(pitch: float = -0.2, roll: float = 0.0) -> Camera:
    K = torch.tensor([[400.0, 0, 320], [0, 400, 180], [0, 0, 1]])
    return Camera(K, tilted(torch.tensor(pitch), torch.tensor(roll)), 640, 360)


def room(shift: float = 0.0, pitch: float = -0.2, ground: float = GROUND) -> Scene:
    """Three boxes; `shift` [m] moves them."""
    meshes = (box(0.5, 0.9, 0.5), box(1.8, 0.8, 0.9), box(1.2, 0.75, 0.7))
    names = ("chair_0", "sofa_0", "table_0")
    places = ((0.9, -3.0), (-1.0, -4.2), (0.3, -4.6))
    yaws = (0.3, 0.8, -0.1)
    pieces = [
        piece(n, m, (x + shift, z - shift), yaw, ground)
        for n, m, (x, z), yaw in zip(names, meshes, places, yaws, strict=True)
    ]
    return Scene(camera(pitch), ground, tuple(pieces))


def walkers(count: int = 40, people: int = 1, ground: float = GROUND) -> Bodies:
    """Capsules that walk along arcs, `count` frames of each person."""
    shape = trimesh.creation.capsule(height=1.3, radius=0.2, count=[24, 48])
    shape.apply_transform(trimesh.transformations.rotation_matrix(-math.pi / 2, [1, 0, 0]))
    shape.apply_translation([0, -shape.bounds[0][1], 0])
    body = mesh_of(shape)
    frame = torch.arange(count).repeat(people)
    person = torch.arange(people).repeat_interleave(count)
    angle = frame / count * 2 + person
    t = torch.stack([angle.sin(), torch.full_like(angle, ground), -3.5 - 0.5 * angle.cos()], -1)
    verts = body.verts + t[:, None]
    return Bodies(verts, body.faces, None, (), frame * 3, person, 15.0, "world", None)
