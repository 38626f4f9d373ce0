"""Measure real data: i3DB against its truth, and clips without truth by what any room must show.

Of i3DB each scene is reconstructed from library furniture and from the true shapes, beside iMapper.

A clip is a folder with `video.mp4` and `furniture.json` (outlines of furniture in the clean
picture, as labelme writes them). Its room is made as a user makes it, and judged by what is known
of all rooms: people are as tall as people are, furniture as large as its class; beds and sofas run
along a wall; skin rests on seats and soles on the floor; furniture covers its outline.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mover.app.cli.video import VideoArgs, video_to_room
from mover.bodies.corrected import statures
from mover.bodies.keypoints import keypoints_of
from mover.bodies.parts import BodyParts, members, parts_of
from mover.bodies.posture import postures
from mover.bodies.skinning import heights_of, open_body
from mover.core.errors import InputError
from mover.core.observe import Observer, silent
from mover.core.run import Run
from mover.core.types import Bodies, Camera, Capture, Detection, Scene, SceneObject
from mover.evaluate.bodies import shared_rows
from mover.evaluate.scene import Pair, Together, iou3d, iou3d_aligned
from mover.fitting.bodies import FitInputs, fit_bodies
from mover.furniture.library import SEATS, STANDARD, canonical
from mover.geometry.boxes import box_of
from mover.geometry.camera import pitch_roll, project, tilted, to_camera
from mover.geometry.placement import place_object
from mover.geometry.raster import Crops, Topology, look
from mover.geometry.rle import decode
from mover.geometry.rotations import rot_y
from mover.geometry.topology import edges_of
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.scene_file import read_scene
from mover.io.people.keypoints import read_keypoints
from mover.perceive.capture import read_picture_of
from mover.perceive.config import LayoutConfig
from mover.perceive.layout import Picture, first_scene
from mover.perceive.standing import seen_from
from mover.pipeline.reconstruct import reconstruct
from mover_bench.cli import ExperimentArgs
from mover_bench.datasets.i3db import I3dbScene, read_i3db
from mover_bench.experiment.tables import judge_each, markdown
from mover_bench.experiment.variants import VARIANTS, Variant, at_most, names_in, withheld

log = logging.getLogger(__name__)
VIEW = 65.0  # [degrees], horizontal, of a clip whose lens was not measured
STEP_UP = 0.15  # [m] that a seat may reach into its sitter and still be below
LOWEST = 0.1  # of the skin over a seat that may be in it: a mattress gives way
SURE = 0.5  # least confidence of a joint whose distance counts
CLIP_COLUMNS = {
    "stature": "stature [m]", "miss": "joints off [% of the height]", "sole": "soles off [cm]",
    "object": "object", "size": "size [m]", "standard": "off the standard [spreads]",
    "wall": "long side off the wall [°]", "seat": "seat gap [cm]", "iou": "IoU on the outline",
}  # fmt: skip


def judge_clips(args: ExperimentArgs, observe: Observer = silent) -> Path:
    """Make and measure the rooms of all clips below `args.source`; what is finished is kept.

    The summary is OUT/clips/summary.md; the numbers are the .json beside it.

    Raises:
        InputError: If there is no clip.
    """
    source = args.source or Path()
    clips = sorted(p.parent for p in source.glob("*/video.mp4") if args.source)
    if not clips:
        raise InputError("--source: expected a folder of clips, CLIP/video.mp4 and furniture.json")
    out = args.out / "clips"

    def judge(clip: Path) -> dict[str, Any]:
        video_to_room(VideoArgs(
            clip / "video.mp4", out / clip.name, keypoints="mediapipe", fov=VIEW,
            objects=clip / "furniture.json", preset=args.variants[0],
        ))  # fmt: skip
        return judge_room(out / clip.name)

    return judge_each(clips, judge, clips_table, out, observe)


def clips_table(found: dict[str, dict[str, Any]]) -> str:
    """A row for each object of each clip."""
    rows = [(name, {**clip, **row}) for name, clip in found.items() for row in clip["objects"]]
    cells = [(name, *(row.get(key) for key in CLIP_COLUMNS)) for name, row in rows]
    lines = [["" if cell is None else str(cell) for cell in line] for line in cells]
    return markdown(["clip", *CLIP_COLUMNS.values()], lines) + "\n"


def judge_room(folder: Path) -> dict[str, Any]:
    """What a folder of `mover video` shows."""
    capture, room = folder / "capture", folder / "room"
    scene, bodies = read_scene(room / "scene.json"), read_bodies(room / "bodies.npz")
    parts, picture = parts_of(bodies), read_picture_of(capture)
    pose = postures(bodies, parts, scene.ground)
    soles = bodies.verts[:, members(parts, "left_sole", "right_sole"), 1].amin(1)
    on_feet = pose.standing | pose.sitting
    off = 100 * (soles[on_feet] - (scene.ground or 0.0))
    of_shapes = None if bodies.pose is None else statures(bodies.pose)
    tall = None if of_shapes is None else round(float(of_shapes[0]), 3)
    rows = [row_of(thing, scene, picture, bodies, parts) for thing in scene.objects]
    return {
        "stature": tall, "miss": miss_of(capture, tall or heights_of(open_body())[0]),
        "sole": round(float(off.abs().median()), 1) if len(off) else None, "objects": rows,
    }  # fmt: skip


def row_of(
    thing: SceneObject, scene: Scene, picture: Picture, bodies: Bodies, parts: BodyParts
) -> dict[str, Any]:
    """The measures of one object."""
    box, kind = box_of(thing), canonical(thing.category)
    size = box.size.tolist()
    standards = zip(size, STANDARD.get(kind, (None,) * 3), strict=True)
    off = [abs(math.log(x / known[0])) / known[1] for x, known in standards if known is not None]
    wall = None
    if kind in ("bed", "sofa"):  # its long side runs across the view, along the wall behind it
        long = float(thing.yaw) + (math.pi / 2 if size[2] > size[0] else 0.0)
        heading = 0.0 if picture.heading is None else picture.heading.yaw
        across = heading + round(-heading / (math.pi / 2)) * math.pi / 2
        turned = (long - across) % math.pi
        wall = round(math.degrees(min(turned, math.pi - turned)), 1)
    gaps = seat_gaps(thing, bodies, parts, scene) if kind in SEATS else []
    row = [k for k, d in enumerate(picture.detections) if d.id == thing.annotation]
    return {
        "object": thing.id, "size": " x ".join(f"{x:.2f}" for x in size), "wall": wall,
        "standard": round(max(off), 1) if off else None,
        "seat": round(100 * float(torch.tensor(gaps).median()), 1) if gaps else None,
        "iou": outline_iou(thing, scene, picture, row[0]) if row else None,
    }  # fmt: skip


def outline_iou(thing: SceneObject, scene: Scene, picture: Picture, row: int) -> float:
    """Of the object's silhouette with its outline, where no person hides it."""
    camera, mesh = scene.camera, place_object(thing)
    verts = to_camera(mesh.verts, camera.R_cam_world)[None]
    views = Crops(camera.K[None], camera.height, camera.width)
    cover, _ = look(verts, Topology(mesh.faces[None], edges_of(mesh.faces)[None]), views)
    ours, seen = (cover[0] > 0.5) & ~picture.people, picture.masks[row] & ~picture.people
    return round(float((ours & seen).sum() / (ours | seen).sum().clamp_min(1)), 3)


def seat_gaps(thing: SceneObject, bodies: Bodies, parts: BodyParts, scene: Scene) -> list[float]:
    """How far the lowest skin of pelvis and thighs of each sitter is over the object [m]."""
    mesh, sitting = place_object(thing), postures(bodies, parts, scene.ground).sitting
    skin, gaps = members(parts, "seat", "left_thigh", "right_thigh"), list[float]()
    for row in sitting.nonzero()[:, 0].tolist():
        points = bodies.verts[row, skin]
        gap = points[:, 1] - tops_below(points, mesh.verts[mesh.faces])
        if bool(gap.isfinite().any()):
            gaps.append(float(gap[gap.isfinite()].quantile(LOWEST)))
    return gaps


def tops_below(
    points: Float[Tensor, "points 3"], faces: Float[Tensor, "faces 3 3"]
) -> Float[Tensor, " points"]:
    """Height of the highest surface under each point [m]; minus infinity where there is none."""
    a, b, c = (faces[None, :, k] for k in range(3))
    ab, ac, ap = ((x - a)[..., [0, 2]] for x in (b, c, points[:, None]))
    area = ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]
    area = torch.where(area.abs() < 1e-9, torch.full_like(area, math.nan), area)
    v = (ap[..., 0] * ac[..., 1] - ap[..., 1] * ac[..., 0]) / area
    w = (ab[..., 0] * ap[..., 1] - ab[..., 1] * ap[..., 0]) / area
    height = a[..., 1] + v * (b - a)[..., 1] + w * (c - a)[..., 1]
    inside = (v >= 0) & (w >= 0) & (v + w <= 1) & (height < points[:, None, 1] + STEP_UP)
    return torch.where(inside, height, torch.full_like(height, -math.inf)).amax(1)


def miss_of(capture: Path, stature: float) -> float | None:
    """Mean distance of the fitted joints from the detected ones, of the height in the picture."""
    bodies, joints = read_bodies(capture / "bodies.npz"), read_keypoints(capture / "keypoints.npz")
    if bodies.joints is None or bodies.space != "camera":
        return None
    K = read_picture_of(capture).camera.K
    places = keypoints_of(open_body(), bodies.verts, bodies.joints, joints.layout)
    rows, seen = shared_rows(bodies, joints)
    sure = (joints.confidence[seen] > SURE) & places[rows].isfinite().all(-1)
    off = (project(places[rows], K) - joints.points[seen]).norm(dim=-1)
    tall = stature * K[1, 1] / bodies.verts[rows, :, 2].mean(-1, keepdim=True)
    misses = (off / tall)[sure]
    return round(100 * float(misses.mean()), 1) if len(misses) else None


LEVEL = tilted(torch.tensor(0.0), torch.tensor(0.0))
POINTS = 1  # of surfaces, which are not compared
SAME_KIND = {"stool": "chair"}


def judge_i3db(args: ExperimentArgs, observe: Observer = silent) -> Path:
    """Measure the scenes below `args.source` with the first of `args.variants`.

    The summary is OUT/i3db/summary.md; the numbers are the .json beside it.

    Raises:
        InputError: If there is no source, no scene in it, or no such variant.
    """
    if args.source is None or not args.source.is_dir():
        raise InputError("--source: expected the folder i3DB of amonszpart/iMapper for --set i3db")
    variant = at_most(VARIANTS[names_in(args.variants)[0]], args.steps)
    folders = sorted(path for path in args.source.iterdir() if (path / "gt").is_dir())
    if not folders:
        raise InputError(f"{args.source}: has no scene of i3DB, expected folders like Scene04/gt")
    torch.set_num_threads(1)
    out = args.out / "i3db"

    def judge(folder: Path) -> dict[str, Any]:
        return judge_scene(read_i3db(folder), Run(out / folder.name), variant)

    return judge_each(folders, judge, i3db_table, out, observe)


I3DB_COLUMNS = {
    "first": "first scene", "run_image": "by the image", "run": "result",
    "given": "true shapes, wrongly placed", "run_given_image": "by the image",
    "run_given": "result", "imapper": "iMapper's own result", "run_pitch": "pitch [degrees]",
    "run_height": "camera height [share]", "stature": "stature [m]",
}  # fmt: skip
"""What the summary shows: IoU3D, errors of the camera of `run`, the fitted stature."""


def i3db_table(found: dict[str, dict[str, Any]]) -> str:
    """The numbers as a table, with the mean of each overlap over the scenes."""
    lines = [[name, *(f"{row[key]:.3f}" for key in I3DB_COLUMNS)] for name, row in found.items()]
    overlaps = list(I3DB_COLUMNS)[:7]
    means = [f"{sum(row[key] for row in found.values()) / len(found):.3f}" for key in overlaps]
    return (
        markdown(["scene", *I3DB_COLUMNS.values()], [*lines, ["mean", *means, "", "", ""]]) + "\n"
    )


def judge_scene(scene: I3dbScene, run: Run, variant: Variant) -> dict[str, Any]:
    """Reconstruct a scene from both starts, and compare with the truth."""
    starts = starts_of(scene, run)
    bodies = starts[0].bodies
    tall = None if bodies is None or bodies.pose is None else statures(bodies.pose)
    assert tall is not None, "of the open body"
    numbers: dict[str, Any] = {
        "stature": float(tall[0]),
        **overlaps("imapper", by_kind(scene.imapper, scene.truth.objects), scene),
    }
    for start, name, result in zip(starts, ("first", "given"), ("run", "run_given"), strict=True):
        numbers |= overlaps(name, start.scene.objects, scene)
        try:
            room = reconstruct(withheld(start, variant.given, variant.cut), variant.config, run)
            found, image = room.scene, room.image_only
        except InputError as error:  # such as a floor above the camera
            log.warning("%s, %s: %s; it counts 0", scene.name, result, error)
            found = image = Scene(start.scene.camera, math.nan, ())
        numbers |= overlaps(f"{result}_image", image.objects, scene)
        numbers |= overlaps(result, found.objects, scene)
        numbers |= camera_errors(result, found, scene.truth)
    return numbers


def starts_of(scene: I3dbScene, run: Run) -> tuple[Capture, Capture]:
    """Captures with fitted people: furniture of the library, and true shapes wrongly placed."""
    camera = replace(scene.truth.camera, R_cam_world=LEVEL)  # its tilt is not given
    bodies = fit_bodies(FitInputs(scene.keypoints, camera, open_body())).bodies
    first = first_scene(
        seen_from(picture_of(scene.detections, camera), bodies, run), LayoutConfig(), run
    )
    library, shapes = (capture_of(scene, start, bodies)
                       for start in (first.scene, wrongly_placed(scene, camera)))  # fmt: skip
    return replace(library, tilt=first.tilt), shapes


def picture_of(detections: tuple[Detection, ...], camera: Camera) -> Picture:
    """What a picture without people shows: the masks of the furniture."""
    blank = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    masks = [blank if found.mask is None else decode(found.mask, 0) for found in detections]
    return Picture(camera, detections, torch.stack(masks), blank, None, None)


def capture_of(scene: I3dbScene, start: Scene, bodies: Bodies) -> Capture:
    """The capture that starts from a scene."""
    return Capture(
        name=scene.name, scene=start, camera_height=None, detections=scene.detections,
        reference=None, reference_people=None, bodies=bodies, people=None, touch=None, warnings=(),
        keypoints=scene.keypoints,
    )  # fmt: skip


def wrongly_placed(scene: I3dbScene, camera: Camera) -> Scene:
    """The true shapes at wrong distances, sizes and yaws, under a level camera."""
    rng = np.random.default_rng(int("".join(c for c in scene.name if c.isdigit()) or 0))
    common = rng.uniform(0.8, 1.2)
    carry = LEVEL.mT @ scene.truth.camera.R_cam_world
    wrong: list[SceneObject] = []
    for true in scene.truth.objects:
        scale = torch.from_numpy(rng.uniform(0.85, 1.15, 3)).float()
        far = common * float(np.clip(1 + 0.1 * rng.standard_normal(), 0.7, 1.3))
        turn = math.radians(rng.uniform(-20, 20))
        turn += math.pi / 2 * float(rng.choice([-1, 1])) if rng.random() < 0.15 else 0.0
        middle = (true.mesh.verts.amin(0) + true.mesh.verts.amax(0)) / 2
        centre = carry @ (rot_y(true.yaw) @ middle + true.t_world_object) * far
        front = carry @ rot_y(true.yaw)[:, 2]
        yaw = torch.atan2(front[0], front[2]) + turn
        t = centre - rot_y(yaw) @ (scale * middle)
        wrong.append(replace(true, t_world_object=t, yaw=yaw, scale=scale))
    return Scene(camera, None, tuple(wrong))


def by_kind(
    objects: Sequence[SceneObject], truth: Sequence[SceneObject]
) -> tuple[SceneObject, ...]:
    """The nearest object of the same category for each true one, under its annotation."""
    from scipy.optimize import linear_sum_assignment

    def kind(thing: SceneObject) -> str:
        return SAME_KIND.get(thing.category, thing.category)

    cost = np.array([[
        float((a.t_world_object - b.t_world_object).norm()) if kind(a) == kind(b) else 1e3
        for b in objects] for a in truth]).reshape(len(truth), len(objects))  # fmt: skip
    rows, columns = linear_sum_assignment(cost)
    return tuple(
        replace(objects[b], annotation=truth[a].annotation)
        for a, b in zip(rows, columns, strict=True) if cost[a, b] < 1e3
    )  # fmt: skip


def overlaps(name: str, objects: Sequence[SceneObject], scene: I3dbScene) -> dict[str, Any]:
    """Mean IoU3D, a missing object counting 0, as it is and after one similarity."""
    found = {thing.annotation: thing for thing in objects}
    camera, pairs = scene.truth.camera, list[Pair]()
    for true in scene.truth.objects:
        if true.annotation in found:
            pairs.append(Pair(found[true.annotation], camera, true, camera, POINTS))
    missing = len(scene.truth.objects) - len(pairs)
    mean = sum(iou3d(pair) for pair in pairs) / len(scene.truth.objects)
    return {name: mean, f"{name}_aligned": iou3d_aligned(Together(tuple(pairs), missing))}


def camera_errors(name: str, found: Scene, truth: Scene) -> dict[str, float]:
    """Errors of pitch and roll [degrees] and of the camera's height [share]."""
    ours, true = (pitch_roll(scene.camera.R_cam_world.double()) for scene in (found, truth))
    assert found.ground is not None
    assert truth.ground is not None
    return {
        f"{name}_pitch": math.degrees(float(ours[0] - true[0])),
        f"{name}_roll": math.degrees(float(ours[1] - true[1])),
        f"{name}_height": found.ground / truth.ground - 1,
    }
