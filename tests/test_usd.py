"""Physics and people in USD, read back with usd-core's own schemas and validators."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from furnished import along_the_axes as along_the_axes  # for every test
from furnished import furnished, moved, two_people, write_out
from little_room import GROUND
from PIL import Image
from test_export import textured

from mover.core.run import Run
from mover.core.types import Bodies, Scene
from mover.geometry.placement import place_object
from mover.io.export.finished import Finished, read_finished
from mover.io.export.solids import AXES, solids_of
from mover.io.export.usd import export_usd

Usd = pytest.importorskip("pxr.Usd", reason="needs the extra usd")


def room() -> Scene:
    """A stretched chair, a table that hangs, and a floor lamp."""
    scene = furnished(("chair", "table", "floor lamp"))
    chair, table, lamp = scene.objects
    chair = replace(chair, scale=torch.tensor([1.2, 0.9, 1.1]))
    return replace(scene, objects=(chair, replace(table, support="free"), lamp))


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """The convex pieces of the room, cut once."""
    folder = tmp_path_factory.mktemp("kept")
    solids_of(room(), Run(folder))
    return folder


def in_file(points: np.ndarray, up: str) -> np.ndarray:
    """Points of the world in the file's axes."""
    x, y, z = points.T
    return points if up == "y" else np.stack([x, -z, y - GROUND], -1)


@pytest.fixture
def out(kept, tmp_path):
    shutil.copytree(kept / "stages", tmp_path / "out" / "stages")
    return tmp_path / "out"


def stage_of(out: Path, bodies: Bodies | None = None, **options: Any) -> tuple[Any, Finished]:
    home = read_finished(write_out(out, room(), bodies))
    return opened(home, **options), home


def opened(home: Finished, **options: Any) -> Any:
    return Usd.Stage.Open(str(export_usd(home, home.out / "export", **options).files[0]))


def complaints(stage: Any) -> list[str]:
    """What all validators of usd-core say: geometry, shading, physics, and the rest."""
    from pxr import UsdValidation

    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    names = {str(v.GetMetadata().name) for v in validators}
    assert any("usdPhysics" in name for name in names), names
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    return [f"{error.GetName()}: {error.GetMessage()}" for error in found]


@pytest.mark.slow
@pytest.mark.parametrize("up", ["y", "z"])
def test_the_validators_of_usd_find_nothing(out, up):
    stage, _ = stage_of(out, two_people(), up=up)
    assert complaints(stage) == []


@pytest.mark.slow
def test_the_validators_would_find_a_body_that_has_no_place(out):
    from pxr import UsdPhysics

    stage, _ = stage_of(out)
    UsdPhysics.RigidBodyAPI.Apply(stage.GetPrimAtPath("/room/wood"))
    assert any("RigidBody" in said for said in complaints(stage))


def parsed(stage: Any) -> dict[Any, dict[str, Any]]:
    """What a simulator gets from usd-core's own parser of physics, by kind and path."""
    from pxr import UsdPhysics

    found = UsdPhysics.UsdPhysicsLoadStageFromPrimRange(stage, ["/"])
    return {
        kind: {str(path): desc for path, desc in zip(*rows, strict=True)}
        for kind, rows in found.items()
    }


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_simulator_reads_bodies_pieces_masses_and_a_floor(out, up):
    from pxr import UsdGeom, UsdPhysics

    stage, home = stage_of(out, up=up)
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdPhysics.GetStageKilogramsPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == up.upper()
    kinds = parsed(stage)
    bodies = kinds[UsdPhysics.ObjectType.RigidBody]
    assert set(bodies) == {"/room/chair_0", "/room/floor_lamp_0"}  # the table hangs
    meshes = kinds[UsdPhysics.ObjectType.MeshShape]
    solids = solids_of(home.scene, Run(home.out))
    assert len(meshes) == sum(len(solid.hulls) for solid in solids)
    assert all(desc.approximation == "convexHull" for desc in meshes.values())
    assert all("/collision/" in path for path in meshes)
    for path, desc in bodies.items():
        assert all(str(c).startswith(f"{path}/collision") for c in desc.collisions)
    assert list(kinds[UsdPhysics.ObjectType.PlaneShape]) == ["/room/floor_collision"]
    (laws,) = kinds[UsdPhysics.ObjectType.Scene].values()
    assert list(laws.gravityDirection) == ([0, -1, 0] if up == "y" else [0, 0, -1])
    assert laws.gravityMagnitude == pytest.approx(9.81)


@pytest.mark.parametrize("up", ["y", "z"])
def test_pieces_and_looks_fill_the_same_place_and_the_floor_is_below(out, up):
    from pxr import UsdGeom

    stage, home = stage_of(out, up=up)
    cache = UsdGeom.BBoxCache(0, [UsdGeom.Tokens.default_, UsdGeom.Tokens.guide])
    for piece in home.scene.objects:
        truth = in_file(place_object(piece).verts.double().numpy(), up)
        node = stage.GetPrimAtPath(f"/room/{piece.id}")
        assert node.GetCustomDataByKey("mover:category") == piece.category
        for part, off in (("visual", 1e-5), ("collision", 2e-3)):
            found = points_of(stage, f"/room/{piece.id}/{part}")
            assert found.min(0) == pytest.approx(truth.min(0), abs=off)
            assert found.max(0) == pytest.approx(truth.max(0), abs=off)
    floor = stage.GetPrimAtPath("/room/floor_collision")
    place = cache.ComputeWorldBound(floor).ComputeAlignedRange().GetMidpoint()
    assert place[1 if up == "y" else 2] == pytest.approx(GROUND if up == "y" else 0.0)


def points_of(stage: Any, path: str) -> np.ndarray:
    """All points below a prim, in the world."""
    from pxr import UsdGeom

    every: list[np.ndarray] = []
    for prim in Usd.PrimRange(stage.GetPrimAtPath(path)):
        if prim.IsA(UsdGeom.Mesh):
            points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(), float)
            matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim))
            every.append((np.c_[points, np.ones(len(points))] @ matrix)[:, :3])
    return np.concatenate(every)


def test_mass_centre_and_moments_are_those_of_the_solid(out):
    from pxr import Gf, UsdPhysics

    stage, home = stage_of(out)
    for solid in solids_of(home.scene, Run(home.out)):
        prim = stage.GetPrimAtPath(f"/room/{solid.id}")
        mass = UsdPhysics.MassAPI(prim)
        assert prim.HasAPI(UsdPhysics.MassAPI) == solid.free
        if not solid.free:
            continue
        assert mass.GetMassAttr().Get() == pytest.approx(solid.mass)
        centre = AXES.mT @ solid.centre
        assert list(mass.GetCenterOfMassAttr().Get()) == pytest.approx(centre.tolist(), abs=1e-6)
        axes = np.array(Gf.Matrix3d(Gf.Quatd(mass.GetPrincipalAxesAttr().Get()))).T
        moments = np.diag(list(mass.GetDiagonalInertiaAttr().Get()))
        truth = (AXES.mT @ solid.inertia @ AXES).numpy()
        assert axes @ moments @ axes.T == pytest.approx(truth, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("up", ["y", "z"])
def test_people_are_where_they_were_in_every_frame(out, up):
    from pxr import UsdGeom

    bodies = two_people(6)
    stage, _ = stage_of(out, bodies, up=up)
    for person in (0, 1):
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/room/person_{person}"))
        matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(mesh.GetPrim()))
        for row in (bodies.person == person).nonzero()[:, 0].tolist():
            frame = float(bodies.frame[row])
            points = np.array(mesh.GetPointsAttr().Get(frame), float)
            found = (np.c_[points, np.ones(len(points))] @ matrix)[:, :3]
            truth = in_file(bodies.verts[row].double().numpy(), up)
            assert np.linalg.norm(found - truth, axis=1).max() < 0.0025
            assert mesh.ComputeVisibility(frame) == "inherited"
    assert mesh.ComputeVisibility(float(bodies.frame.min())) == "invisible"
    assert stage.GetTimeCodesPerSecond() == bodies.fps
    assert stage.GetEndTimeCode() == float(bodies.frame.max())


def test_the_camera_sees_the_same_pixels(out):
    from pxr import UsdGeom

    stage, home = stage_of(out)
    camera = home.scene.camera
    frustum = UsdGeom.Camera(stage.GetPrimAtPath("/room/camera")).GetCamera(0).frustum
    point = np.array([0.4, -0.8, -3.5])
    matrix = np.array(frustum.ComputeViewMatrix()) @ np.array(frustum.ComputeProjectionMatrix())
    x, y, _, w = np.append(point, 1.0) @ matrix
    seen = (camera.K @ camera.R_cam_world @ torch.tensor(point).float()).numpy()
    u, v = camera.width * (1 + x / w) / 2, camera.height * (1 - y / w) / 2
    assert [u, v] == pytest.approx(seen[:2] / seen[2], abs=0.01)


def test_textures_stay_and_ids_that_the_file_does_not_allow_or_has_itself_stay_apart(out):
    textured(baseColorFactor=[51, 255, 102, 255]).export(out / "box.glb")
    scene, names = room(), ("ground", "physics", "wood", "0-chair.a", "0-chair_a")
    chair = replace(scene.objects[0], mesh_file=str(out / "box.glb"))
    scene = replace(scene, objects=tuple(replace(chair, id=name) for name in names))
    stage = opened(Finished(out, scene, None, None))
    ids = {p.GetCustomDataByKey("mover:id") for p in stage.Traverse()} - {None}
    assert ids == set(names)
    picture, *_ = (p for p in stage.Traverse() if p.GetName() == "picture")
    scale = picture.GetAttribute("inputs:scale").Get()
    assert list(scale) == pytest.approx([0.2, 1.0, 0.4, 1.0])  # glTF multiplies them, too
    found = Image.open(out / "export" / picture.GetAttribute("inputs:file").Get().path)
    assert np.array_equal(np.asarray(found).ravel(), np.arange(48))


def test_an_object_that_is_moved_stands_still_until_it_stands_elsewhere(out):
    stage = opened(Finished(out, moved(room(), 12), None, None))
    prim = stage.GetPrimAtPath("/room/chair_0")
    move = prim.GetAttribute("xformOp:translate")
    way = [np.subtract(move.Get(time), move.Get(0)).round(6).tolist() for time in (5, 11, 12, 40)]
    assert way == [[0, 0, 0]] * 2 + [[0.3, 0, 1]] * 2
    turn = prim.GetAttribute("xformOp:rotateY")
    assert turn.Get(30) - turn.Get(11) == pytest.approx(np.degrees(1), abs=1e-3)
