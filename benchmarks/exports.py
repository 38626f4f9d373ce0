"""One picture of every export of a room, each drawn from what its own library reads back.

Needs `mover export OUT --to glb usd mjcf urdf ply holosoma`, then
`MUJOCO_GL=egl python benchmarks/exports.py OUT --to exports.jpg`. MuJoCo's own renderer draws MJCF
and URDF; the rest is read by trimesh and usd-core and drawn by the package's rasteriser.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
import trimesh
from jaxtyping import Float
from numpy.typing import NDArray
from PIL import Image
from pxr import Usd, UsdGeom, UsdSkel
from torch import Tensor

from mover.app.pictures.eye import video_eye
from mover.app.pictures.film import captioned, sized
from mover.app.pictures.paint import Surfaces, ground_under, joined
from mover.app.pictures.render import set_up, show
from mover.core.types import Scene
from mover.geometry.mesh import face_normals
from mover.io.capture.scene_file import read_scene
from mover.io.export.solids import AXES, floor_height

WIDTH = 560  # [px] of one picture
GREY = (0.62, 0.66, 0.72)
FINE = 24  # pieces along the edge of a triangle with a picture
SKIN = (0.85, 0.6, 0.45)
Picture = Float[Tensor, "h w 3"]


@dataclass(frozen=True)
class Shape:
    """Triangles in the world with +y up [m], and their colour in [0, 1]."""

    verts: NDArray[Any]
    faces: NDArray[Any]
    tint: NDArray[Any]
    """Of all triangles, or of each."""


def main() -> None:
    """Write the page of pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="folder of the result")
    parser.add_argument("--to", type=Path, default=Path("exports.jpg"), help="the picture")
    parser.add_argument("--frame", type=int, default=0, help="of the video, for the people")
    args = parser.parse_args()
    scene, home = read_scene(args.out / "scene.json"), args.out / "export"
    pictures = [
        captioned(drawn(list(of_glb(home / "scene.glb")), scene), "GLB, by trimesh: furniture"),
        captioned(
            drawn(list(of_usd(home / "scene.usdc", args.frame)), scene),
            "USD, by usd-core: looks, skeletons",
        ),
        captioned(
            drawn(list(of_usd(home / "scene.usdc", args.frame, purpose="guide")), scene),
            "USD, by usd-core: colliding pieces",
        ),
        captioned(by_mujoco(home / "mjcf" / "room.xml", scene, args.frame), "MJCF, by MuJoCo"),
        captioned(by_mujoco(home / "urdf" / "room.urdf", scene, args.frame), "URDF, by MuJoCo"),
        captioned(
            drawn(list(of_holosoma(home / "holosoma", scene)), scene),
            "Holosoma's files: pieces, 22 joints",
        ),
    ]
    rows = [torch.cat(pictures[k : k + 3], 1) for k in (0, 3)]
    page = (torch.cat(rows, 0) * 255).round().to(torch.uint8).numpy()
    Image.fromarray(page).save(args.to, quality=88)


def drawn(shapes: list[Shape], scene: Scene) -> Picture:
    """Shapes from where the video was taken."""
    parts: list[Surfaces] = []
    for k, shape in enumerate(shapes):
        verts = torch.from_numpy(np.asarray(shape.verts, np.float32))
        faces = torch.from_numpy(np.asarray(shape.faces, np.int64))
        tint = torch.from_numpy(np.asarray(shape.tint, np.float32)).expand(len(faces), 3)
        normals = face_normals(verts, faces)
        parts.append(Surfaces(verts, faces, normals, tint, torch.full((len(faces),), k)))
    surfaces = joined(parts)
    ground = ground_under(surfaces.verts, floor_height(scene))
    return show(set_up(video_eye(scene.camera, WIDTH), ground, surfaces))


def of_glb(file: Path) -> Iterator[Shape]:
    """All meshes but people, whose bones trimesh does not know, and the floor."""
    loaded = trimesh.load_scene(file)
    for node in loaded.graph.nodes_geometry:
        matrix, name = loaded.graph[node]
        part: Any = loaded.geometry[name]
        if "person" in node or node == "ground":
            continue
        verts = np.asarray(part.vertices) @ matrix[:3, :3].T + matrix[:3, 3]
        faces, material = np.asarray(part.faces), part.visual.material
        if material.baseColorTexture is not None:
            yield painted(
                verts[faces], np.asarray(part.visual.uv)[faces], material.baseColorTexture
            )
            continue
        light = np.asarray(material.baseColorFactor)[:3] / 255
        yield Shape(verts, faces, 1.055 * light ** (1 / 2.4) - 0.055)


def painted(corners: NDArray[Any], uv: NDArray[Any], picture: Image.Image) -> Shape:
    """Triangles with a picture on them: each cut into many of one colour."""
    rows = np.arange(FINE)
    grid = [(i, j, k) for i in rows for j in rows for k in (0, 1) if i + j + k < FINE]
    first = [[(i + k, j + k), (i + 1, j), (i, j + 1)] for i, j, k in grid]
    second = np.array(first, float) / FINE
    shares = np.concatenate([1 - second.sum(-1, keepdims=True), second], -1)
    verts = np.einsum("csk,fkx->fcsx", shares, corners)
    middle = np.einsum("csk,fkx->fcsx", shares, uv).mean(2).reshape(-1, 2)
    pixels = np.asarray(picture.convert("RGB"))
    height, width = pixels.shape[:2]
    x, y = (middle[:, 0] % 1 * width).astype(int), ((1 - middle[:, 1]) % 1 * height).astype(int)
    tint = pixels[y.clip(0, height - 1), x.clip(0, width - 1)] / 255
    return Shape(verts.reshape(-1, 3), np.arange(verts.size // 3).reshape(-1, 3), tint)


def of_usd(file: Path, frame: int, purpose: str = "default") -> Iterator[Shape]:
    """All meshes of a purpose, people carried by their bones."""
    stage = Usd.Stage.Open(str(file))
    UsdSkel.BakeSkinning(stage.Traverse())
    cache = UsdGeom.XformCache(float(frame))
    for prim in stage.Traverse():
        mesh = UsdGeom.Mesh(prim)
        if not mesh or str(mesh.ComputePurpose()) != purpose or prim.GetName() == "ground":
            continue
        if mesh.ComputeVisibility(float(frame)) == "invisible":
            continue
        points = np.array(mesh.GetPointsAttr().Get(float(frame)), float)
        matrix = np.array(cache.GetLocalToWorldTransform(prim))
        verts = points @ matrix[:3, :3] + matrix[3, :3]
        tint = mesh.GetDisplayColorAttr().Get() or [GREY]
        faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        picture = stage.GetPrimAtPath(prim.GetPath().AppendPath("look/picture"))
        if not picture:
            yield Shape(verts, faces, np.array(tint[0], float))
            continue
        name = picture.GetAttribute("inputs:file").Get().path
        uv = np.array(UsdGeom.PrimvarsAPI(prim).GetPrimvar("st").Get(), float)
        yield painted(verts[faces], uv[faces], Image.open(file.parent / name))


def of_holosoma(home: Path, scene: Scene) -> Iterator[Shape]:
    """The furniture of the climb, and the joints of a frame in the middle."""
    clip = sorted(path for path in home.iterdir() if path.is_dir())[0]
    whole: Any = trimesh.load(clip / "multi_boxes.obj", force="mesh")
    joints = np.load(home / f"{clip.name}.npz")["global_joint_positions"]
    up = partial(to_world, floor=floor_height(scene))
    yield Shape(up(np.asarray(whole.vertices)), np.asarray(whole.faces), np.array(GREY))
    for place in joints[len(joints) // 2]:
        ball = trimesh.creation.icosphere(2, 0.045)
        yield Shape(up(np.asarray(ball.vertices) + place), np.asarray(ball.faces), np.array(SKIN))


def to_world(points: NDArray[Any], floor: float) -> NDArray[Any]:
    """From +z up with the floor at 0 to the world of scene.json."""
    return points @ AXES.numpy() + np.array([0.0, floor, 0.0])


def by_mujoco(file: Path, scene: Scene, frame: int) -> Picture:
    """A model from where the video was taken, people in the pose of a keyframe."""
    model = mujoco.MjModel.from_xml_path(str(file))
    model.vis.headlight.ambient[:] = 0.4  # URDF has no lamps
    data = mujoco.MjData(model)
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, f"frame_{frame}")
    if key >= 0:
        mujoco.mj_resetDataKeyframe(model, data, key)
    mujoco.mj_forward(model, data)
    size = video_eye(scene.camera, WIDTH)
    renderer = mujoco.Renderer(model, size.height, size.width)
    options = mujoco.MjvOption()
    options.geomgroup[:] = [1, 1, 1, 0, 0, 0]
    camera: Any = "camera" if model.ncam else _camera(scene)
    renderer.update_scene(data, camera, options)
    return sized(Image.fromarray(renderer.render()), (size.width, size.height))


def _camera(scene: Scene) -> Any:  # noqa: ANN401
    """MuJoCo's free camera about where the video's was, for files that have none."""
    R = AXES.numpy() @ scene.camera.R_cam_world.double().numpy().T
    forward = R[:, 2]
    camera = mujoco.MjvCamera()
    camera.distance = 4.0
    eye = np.array([0.0, 0.0, -floor_height(scene)])
    camera.lookat[:] = eye + camera.distance * forward
    camera.azimuth = np.degrees(np.arctan2(forward[1], forward[0]))
    camera.elevation = np.degrees(np.arcsin(forward[2]))
    return camera


if __name__ == "__main__":
    main()
