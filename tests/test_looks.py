"""Textures and colours of the user's meshes for simulators, read back corner by corner."""

import dataclasses
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
import trimesh
from furnished import furnished
from PIL import Image

import mover.io.export.solids
from mover.core.types import SceneObject
from mover.io.export.finished import Finished
from mover.io.export.looks import looks_of
from mover.io.export.mjcf import export_mjcf
from mover.io.export.solids import AXES, floor_height

SIDE = 4  # [px] of the picture, no two pixels alike
PICTURE = np.arange(3 * SIDE * SIDE, dtype=np.uint8).reshape(SIDE, SIDE, 3) * 5
Corner = tuple[tuple[float, ...], tuple[int, ...]]
"""A place [mm], and the colour there."""


@pytest.fixture(autouse=True)
def along_the_axes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mover.io.export.solids, "find_spec", lambda _: None)


def textured(kind: str, mode: str = "RGB") -> trimesh.Trimesh:
    """A box whose corners each show another pixel's middle."""
    shape = trimesh.creation.box(extents=(0.5, 0.9, 0.6))
    order = np.arange(len(shape.vertices))
    uv = (np.stack([order % SIDE, order // SIDE], 1) + 0.5) / SIDE
    picture = Image.fromarray(PICTURE).convert(mode)
    pbr = trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
    simple = trimesh.visual.material.SimpleMaterial(image=picture, diffuse=[102, 102, 102, 255])
    material = pbr if kind == "glb" else simple
    shape.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return shape


def finished(tmp_path: Path, *files: Path) -> tuple[Finished, tuple[SceneObject, ...]]:
    scene = furnished(("chair", "table")[: len(files)])
    pieces = tuple(
        dataclasses.replace(p, mesh_file=str(file), scale=torch.tensor([1.2, 0.9, 1.1]))
        for p, file in zip(scene.objects, files, strict=True)
    )
    return Finished(tmp_path, dataclasses.replace(scene, objects=pieces), None, None), pieces


def corner(place: np.ndarray, uv: np.ndarray, picture: np.ndarray) -> Corner:
    """What a renderer shows at a corner: texture coordinates begin at the lower left."""
    height, width = picture.shape[:2]
    row, column = int((1 - uv[1]) * height), int(uv[0] * width)
    return tuple(np.round(1000 * place).tolist()), tuple(picture[row, column, :3].tolist())


def truth(shape: trimesh.Trimesh, piece: SceneObject, ground: float | None) -> set[Corner]:
    """Corners in the simulator's world, or in the piece's own axes."""
    places = np.asarray(shape.vertices) * piece.scale.numpy() @ AXES.numpy().T
    if ground is not None:
        c, s = float(piece.yaw.cos()), float(piece.yaw.sin())
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        places = places @ turn.T + AXES.numpy() @ piece.t_world_object.double().numpy()
        places[:, 2] -= ground
    return {
        corner(p, uv, PICTURE) for p, uv in zip(places, np.asarray(shape.visual.uv), strict=True)
    }


def near(found: set[Corner], expected: set[Corner]) -> bool:
    """Whether each corner has its colour, to a millimetre."""
    if len(found) != len(expected):
        return False
    pairs = zip(
        sorted(found, key=lambda c: c[1]), sorted(expected, key=lambda c: c[1]), strict=True
    )
    return all(a[1] == b[1] and np.allclose(a[0], b[0], atol=1.01) for a, b in pairs)


@pytest.mark.parametrize(("kind", "mode"), [("glb", "RGB"), ("glb", "RGBA"), ("obj", "RGB")])
def test_mujoco_shows_every_corner_in_its_colour(tmp_path: Path, kind: str, mode: str):
    mujoco = pytest.importorskip("mujoco", reason="needs the extra physics")
    shape = textured(kind, mode)
    shape.export(tmp_path / f"box.{kind}")
    home, (piece,) = finished(tmp_path, tmp_path / f"box.{kind}")
    model = mujoco.MjModel.from_xml_path(str(export_mjcf(home, tmp_path).files[0]))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    geom = next(g for g in range(model.ngeom) if model.geom_group[g] == 2)
    mesh, material = model.geom_dataid[geom], model.geom_matid[geom]
    assert model.mat_rgba[material] == pytest.approx([1, 1, 1, 1])
    texture = int(max(model.mat_texid[material]))
    size = (model.tex_height[texture], model.tex_width[texture], model.tex_nchannel[texture])
    start = model.tex_adr[texture]
    picture = np.array(model.tex_data[start : start + np.prod(size)]).reshape(size)
    first, last = model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh]
    places = np.array(model.mesh_vert[model.mesh_vertadr[mesh] :])
    places = places @ np.array(data.geom_xmat[geom]).reshape(3, 3).T + data.geom_xpos[geom]
    uv = np.array(model.mesh_texcoord[model.mesh_texcoordadr[mesh] :])
    found = {
        corner(places[v], np.array([uv[t, 0], 1 - uv[t, 1]]), picture)  # MuJoCo keeps 1 - v
        for face, across in zip(
            model.mesh_face[first:last], model.mesh_facetexcoord[first:last], strict=True
        )
        for v, t in zip(face, across, strict=True)
    }
    assert near(found, truth(shape, piece, floor_height(home.scene)))


def test_parts_keep_their_colours_and_equal_pictures_are_written_once(tmp_path: Path):
    textured("glb").export(tmp_path / "box.glb")
    many = trimesh.Scene()
    for k, rgb in enumerate(([255, 0, 0, 255], [0, 128, 0, 255])):
        part = trimesh.creation.box(extents=(0.2, 0.2, 0.2))
        material = trimesh.visual.material.PBRMaterial(baseColorFactor=rgb)
        part.visual = trimesh.visual.TextureVisuals(material=material)
        many.add_geometry(part, transform=trimesh.transformations.translation_matrix([k, 0, 0]))
    many.export(tmp_path / "parts.glb")
    home, (box, parts) = finished(tmp_path, tmp_path / "box.glb", tmp_path / "parts.glb")
    green, red = sorted(looks_of(parts, (0.5, 0.5, 0.5), "parts"), key=lambda look: look.rgba)
    assert red.rgba == pytest.approx([1, 0, 0, 1])
    assert green.rgba == pytest.approx([0, 0.737, 0, 1], abs=2e-3)  # 128 of light is 188 of sRGB
    assert green.verts[:, 0].min() == pytest.approx(1.2 * 0.9)
    again = dataclasses.replace(box, id="box_1")
    both = dataclasses.replace(home.scene, objects=(box, again, parts))
    home = dataclasses.replace(home, scene=both)
    root = ElementTree.parse(export_mjcf(home, tmp_path).files[0]).getroot()
    assert len(root.findall("asset/texture")) == 1
    assert len(list((tmp_path / "mjcf" / "meshes" / "visual").glob("*.png"))) == 1


def test_a_piece_without_a_file_has_its_own_colour():
    piece = furnished(("chair",)).objects[0]
    (look,) = looks_of(piece, (0.2, 0.4, 0.6), "chair_0")
    assert look.rgba == pytest.approx([0.2, 0.4, 0.6, 1], abs=8e-3)  # 8 bits of light
    assert look.uv is None
