"""scene.usdc: metres, +y up, objects with their placement, camera, people over time."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from ..export import floor_of, parts_of
from ..geometry.camera import NEAR
from ..records import replacing
from ..report_colours import Colour, colour, person_colour
from ..types import Bodies, Camera, Piece, Scene
from .finished import Exported, Finished
from .keyframes import keyframes
from .people import FPS, Track, seen_from_to, tracks_of
from .pxr_modules import pxr
from .usd_look import add_look

APERTURE = 20.955  # width of the film [tenths of a scene unit by USD's custom: mm]
TOLERANCE = 0.002  # [m], of the straight lines between two samples of time
MOST = 100_000
FAR = 1000.0  # [m]


def export_usd(finished: Finished, folder: Path) -> Exported:
    """Write the room as one binary USD file.

    Objects are transforms (translate, rotateY, scale) with the meshes of the user's file below
    them; people are meshes with samples of time, in frames of the video.

    Raises:
        InputError: If usd-core is not installed.
    """
    Usd = pxr("Usd")
    path = folder / "scene.usdc"
    with replacing(path) as part:
        part.unlink()
        stage = Usd.Stage.CreateNew(str(part))
        _head(stage, finished)
        _add_scene(stage, finished.scene, folder)
        if finished.bodies is not None:
            for track in tracks_of(finished.bodies):
                _add_person(stage, finished.bodies, track)
        stage.GetRootLayer().Save()
    return Exported((path,), ("people's meshes move in straight lines between samples, 2 mm off",))


def _head(stage: Any, finished: Finished) -> None:  # noqa: ANN401
    UsdGeom = pxr("UsdGeom")

    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/room").GetPrim())
    bodies = finished.bodies
    if bodies is not None:
        stage.SetTimeCodesPerSecond(bodies.fps or FPS)
        stage.SetFramesPerSecond(bodies.fps or FPS)
        stage.SetStartTimeCode(int(bodies.frame.min()))
        stage.SetEndTimeCode(int(bodies.frame.max()))


def _add_scene(stage: Any, scene: Scene, folder: Path) -> None:  # noqa: ANN401
    for index, piece in enumerate(scene.pieces):
        _add_piece(stage, piece, colour(index), folder)
    if scene.ground is not None:
        floor = floor_of(scene, scene.ground)
        verts, faces = floor.verts.double().numpy(), floor.faces.numpy()
        _add_mesh(stage, "/room/ground", verts, faces, (0.86, 0.85, 0.83))
    _add_camera(stage, scene.camera)


def _free(stage: Any, parent: str, name: str) -> str:  # noqa: ANN401
    """A path that USD allows and that nothing has yet."""
    Tf = pxr("Tf")

    path = f"{parent}/{Tf.MakeValidIdentifier(name)}"
    while stage.GetPrimAtPath(path):
        path += "_"
    return path


def _add_piece(stage: Any, piece: Piece, tint: Colour, folder: Path) -> None:  # noqa: ANN401
    """A transform in the format's own order: scale, then turn, then shift."""
    Gf, UsdGeom = pxr("Gf"), pxr("UsdGeom")

    node = UsdGeom.Xform.Define(stage, _free(stage, "/room", piece.id))
    prim, double = node.GetPrim(), UsdGeom.XformOp.PrecisionDouble
    prim.SetCustomDataByKey("mover:id", piece.id)
    prim.SetCustomDataByKey("mover:category", piece.category)
    node.AddTranslateOp(double).Set(Gf.Vec3d(*piece.t_world_object.tolist()))
    node.AddRotateYOp(double).Set(float(np.degrees(float(piece.yaw))))
    node.AddScaleOp(double).Set(Gf.Vec3d(*piece.scale.tolist()))
    for part, transform in parts_of(piece, tint):
        path = _free(stage, str(node.GetPath()), "mesh")
        mesh = _add_mesh(stage, path, np.asarray(part.vertices), np.asarray(part.faces), tint)
        mesh.AddTransformOp(double).Set(Gf.Matrix4d(transform.T.tolist()))
        add_look(stage, mesh, part, folder)


def _add_mesh(
    stage: Any,  # noqa: ANN401
    path: str,
    verts: NDArray[Any],
    faces: NDArray[Any],
    tint: Colour,
) -> Any:  # noqa: ANN401
    UsdGeom, Vt = pxr("UsdGeom"), pxr("Vt")

    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(
        Vt.IntArray.FromNumpy(np.ascontiguousarray(faces, np.int32).reshape(-1))
    )
    _set_points(mesh, verts.astype(np.float32), None)
    mesh.CreateDisplayColorAttr([tint])
    return mesh


def _set_points(mesh: Any, points: NDArray[np.float32], time: float | None) -> None:  # noqa: ANN401
    """Places and extent, always or at one time."""
    Usd, Vt = pxr("Usd"), pxr("Vt")

    when = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
    mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points)), when)
    extent = np.stack([points.min(0), points.max(0)])
    mesh.CreateExtentAttr().Set(Vt.Vec3fArray.FromNumpy(extent), when)


def _add_person(stage: Any, bodies: Bodies, track: Track) -> None:  # noqa: ANN401
    UsdGeom = pxr("UsdGeom")

    verts = bodies.verts[track.rows].detach().cpu().float()
    keys, _ = keyframes(verts, track.time, TOLERANCE, MOST)
    path = _free(stage, "/room", f"person_{track.person}")
    tint = person_colour(track.person)
    mesh = _add_mesh(stage, path, verts[0].numpy(), bodies.faces.cpu().numpy(), tint)
    for key in keys:
        _set_points(mesh, verts[key].numpy(), float(track.frame[key]))
    seen = mesh.CreateVisibilityAttr()
    first, fps = int(bodies.frame.min()), bodies.fps or FPS
    for start, end in seen_from_to(track):
        if start > 0:
            seen.Set(UsdGeom.Tokens.invisible, float(first))
        seen.Set(UsdGeom.Tokens.inherited, first + round(start * fps))
        if end < track.last:
            seen.Set(UsdGeom.Tokens.invisible, first + round(end * fps) + 1)


def _add_camera(stage: Any, camera: Camera) -> None:  # noqa: ANN401
    """USD's cameras look along -z with +y up; the film is moved for the principal point."""
    Gf, UsdGeom = pxr("Gf"), pxr("UsdGeom")

    lens = UsdGeom.Camera.Define(stage, _free(stage, "/room", "camera"))
    fx, fy = float(camera.K[0, 0]), float(camera.K[1, 1])
    cx, cy = float(camera.K[0, 2]), float(camera.K[1, 2])
    focal = fx / camera.width * APERTURE
    height = camera.height / fy * focal
    lens.CreateFocalLengthAttr(focal)
    lens.CreateHorizontalApertureAttr(APERTURE)
    lens.CreateVerticalApertureAttr(height)
    lens.CreateHorizontalApertureOffsetAttr(APERTURE * (0.5 - cx / camera.width))
    lens.CreateVerticalApertureOffsetAttr(height * (cy / camera.height - 0.5))
    lens.CreateClippingRangeAttr(Gf.Vec2f(NEAR, FAR))
    lens.AddTransformOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Matrix4d(_to_world(camera)))


def _to_world(camera: Camera) -> list[list[float]]:
    """Rows of the matrix from the camera's axes (+y up) to the world; USD's points are rows."""
    matrix: Float[np.ndarray, "4 4"] = np.eye(4)
    R = camera.R_cam_world.detach().cpu().double().numpy()
    matrix[:3, :3] = (R.T @ np.diag([1.0, -1.0, -1.0])).T
    return matrix.tolist()
