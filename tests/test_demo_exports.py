"""Every export of the demo's room, opened by the library that reads it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from furnished import along_the_axes as along_the_axes  # CoACD has a test of its own
from PIL import Image

from mover.app.cli import run_command
from mover.app.results import write_truth
from mover.core.records import rows_of
from mover.io.capture.scene_file import read_scene
from mover.io.export.contacts import write_labels
from mover.io.files.meshes import write_mesh
from mover.io.formats import names
from mover.pipeline.refine import finished_room
from mover.pipeline.result import label_inputs, to_world
from mover.stages.contacts.label_contacts import label_contacts

pytestmark = pytest.mark.slow
TEXTURED = "chair_0"
FRAMES = 60
PICTURE = np.arange(3 * 64, dtype=np.uint8).reshape(8, 8, 3)


@pytest.fixture(scope="module")
def out(demo_room, tmp_path_factory):
    """The true room as a result, one of its meshes with a texture, with all of its exports."""
    folder = tmp_path_factory.mktemp("demo")
    bodies = rows_of(demo_room.bodies, demo_room.bodies.frame < FRAMES)
    write_truth(demo_room.truth, to_world(bodies, demo_room.truth.camera), folder)
    shape = trimesh.load_mesh(folder / "meshes" / f"{TEXTURED}.glb", process=False)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(PICTURE))
    uv = np.asarray(shape.vertices)[:, :2] % 1
    shape.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    shape.export(folder / "meshes" / f"{TEXTURED}.glb")
    for piece in demo_room.truth.objects:
        write_mesh(piece.mesh, folder / "watertight" / f"{piece.id}.glb")
    write_labels(label_contacts(label_inputs(finished_room(folder))), folder / "contacts.npz")
    assert run_command("export", [str(folder), "--to", *names("export"), "--up", "z"]) == 0
    return folder


def ids(out: Path) -> set[str]:
    return {piece.id for piece in read_scene(out / "scene.json").objects}


def opens_glb(out: Path) -> None:
    scene = trimesh.load_scene(out / "export" / "scene.glb")
    assert ids(out) <= set(scene.graph.nodes)
    looks = [part.visual.material for part in scene.geometry.values()]
    pictures = [getattr(look, "baseColorTexture", None) for look in looks]
    assert any(np.array_equal(p.convert("RGB"), PICTURE) for p in pictures if p is not None)


def opens_usd(out: Path) -> None:
    Usd = pytest.importorskip("pxr.Usd", reason="needs the extra usd")
    from pxr import UsdGeom, UsdPhysics

    stage = Usd.Stage.Open(str(out / "export" / "scene.usdc"))
    prims = list(stage.Traverse())
    bodies = [p for p in prims if p.HasAPI(UsdPhysics.RigidBodyAPI)]
    assert {p.GetName() for p in bodies} == ids(out)
    assert all(UsdPhysics.MassAPI(body).GetMassAttr().Get() > 0.5 for body in bodies)
    (person,) = [p for p in prims if p.GetName().startswith("person_")]
    assert len(UsdGeom.Mesh(person).GetPointsAttr().GetTimeSamples()) > 3
    (file,) = [p.GetAttribute("inputs:file").Get() for p in prims if p.GetName() == "picture"]
    assert np.array_equal(np.asarray(Image.open(out / "export" / file.path)), PICTURE)


def opens_mjcf(out: Path) -> None:
    """And stands for two seconds."""
    mujoco = pytest.importorskip("mujoco", reason="needs the extra physics")
    model = mujoco.MjModel.from_xml_path(str(out / "export" / "mjcf" / "room.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    start = {name: np.array(data.body(name).xpos) for name in ids(out)}
    for _ in range(round(2 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    assert all(np.linalg.norm(data.body(n).xpos - place) < 0.01 for n, place in start.items())


def opens_ply(out: Path) -> None:
    for name in ids(out):
        assert len(trimesh.load_mesh(out / "export" / "objects" / f"{name}.ply").faces)


def opens_contacts(out: Path) -> None:
    found = dict(np.load(out / "export" / "contacts_0.npz", allow_pickle=False))
    assert found["contact"].shape == found["position"].shape[:-1] == found["normal"].shape[:-1]
    assert found["object_contact"].shape == (len(found["frame"]), found["contact"].shape[2])
    assert found["object_contact"].any()


def opens_amass(out: Path) -> None:
    """AMASS' SMPL-X files, as their readers index them: trans, root_orient, pose_body, betas."""
    found = dict(np.load(out / "export" / "amass_0.npz", allow_pickle=False))
    widths = {"trans": 3, "root_orient": 3, "pose_body": 63, "pose_hand": 90, "poses": 165}
    (count,) = {len(found[name]) for name in widths}
    assert count > FRAMES / 2
    assert {name: found[name].shape[1:] for name in widths} == {n: (w,) for n, w in widths.items()}
    assert int(found["num_betas"]) == len(found["betas"])
    assert {"gender", "mocap_frame_rate", "surface_model_type"} <= set(found)


OPENS: dict[str, Callable[[Path], None]] = {
    "glb": opens_glb, "usd": opens_usd, "mjcf": opens_mjcf, "ply": opens_ply,
    "amass": opens_amass, "contacts": opens_contacts,
}  # fmt: skip


@pytest.mark.parametrize("target", names("export"))
def test_every_export_of_the_demo_opens(out, target):
    OPENS[target](out)
