"""From a video to a capture folder, step by step; what is finished is not done again.

CAPTURE/perceived/raw      frames as they were taken
CAPTURE/perceived/stages   what each step found
CAPTURE/frames             frames of a camera that stands still
CAPTURE/reference.png, objects.json, people.json, keypoints.npz, camera.json, scene.json, meshes/
"""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from mover.bodies.keypoints import LAYOUTS
from mover.bodies.skeleton import SIDES
from mover.core.errors import InputError
from mover.core.observe import Observer
from mover.core.records import fingerprint
from mover.core.run import Run
from mover.core.types import Camera, Keypoints, People, rows_by_person
from mover.geometry.rle import decode
from mover.io.capture.annotations_file import (
    detections_of,
    detections_to_json,
    people_of,
    people_to_json,
)
from mover.io.capture.camera_file import camera_of, camera_to_json, measured_tilt
from mover.io.capture.folder import folder_parts
from mover.io.capture.scene_file import write_hypotheses, write_scene
from mover.io.files.cameras import (
    camera_of_photo,
    guessed_view,
    of_view,
    read_camera_file,
    with_known,
    with_spread,
)
from mover.io.files.fields import At, read_json, write_json
from mover.io.files.images import find_depth_file, read_depth, reference_frame, write_image
from mover.io.people.keypoints import write_keypoints
from mover.perceive import mediapipe, networks
from mover.perceive.config import PICTURES, ModelsConfig, PerceiveConfig
from mover.perceive.layout import FirstScene, Picture
from mover.perceive.mediapipe import PoseInputs, find_poses
from mover.perceive.networks import Finds, JointsInputs
from mover.perceive.own import FEW, Say, Video, own_keypoints, own_masks, own_objects, same_people
from mover.perceive.steady import (
    Clean,
    Drift,
    detections_in,
    find_drift,
    hidden_mask,
    reference_of,
    steady_frames,
    warnings_of,
)
from mover.perceive.video import (
    Clip,
    TakeInputs,
    pictures_of,
    rate_of,
    stamp_of,
    take_frames,
    write_jpeg,
)
from mover.stages.camera.find_lens import LensInputs, find_lens, zoomed
from mover.stages.camera.room_lines import find_segments
from mover.stages.config import LensConfig
from mover.stages.masks import pixels_of

log = logging.getLogger(__name__)
BEND, OFTEN = 0.15, 0.9  # of the height: second difference of the trunk, and of how many frames
DENSEST = 20.0  # frames a second
CHUNK = 50  # frames whose detections are kept together
# How far off a focal length may be, of its logarithm; what a file gives stays as it is.
ASSUMED = 0.15  # cameras of phones and rooms are 50 to 75 degrees wide
GUESS = "perceived/guess.json"  # the camera before a first scene, and as it left it
LENS_FIELDS = ("height", "focal_spread", "focal_by_lines", "tilt_spread")
"""Of camera.json, beside the camera."""
SAME_TILT = 1e-6  # elements of a rotation that was read back
TILT = math.radians(8)  # of a camera on a shelf, before anything is seen of it
CLEARLY = 2.0  # standard deviations by which lines contradict a lens before any body is seen
USUAL = 60.0  # [degrees], horizontal field of view of phones held level, where nothing is known


@dataclass(frozen=True)
class Finders:
    """Stages that look at pictures: the networks, or what stands for them."""

    instances: Callable[[Clip, PerceiveConfig, Observer], Finds] = networks.find_instances
    joints: Callable[[JointsInputs, ModelsConfig, Observer], Keypoints] = networks.find_joints
    poses: Callable[[PoseInputs, None, Observer], tuple[People, Keypoints]] = find_poses


def perceive(
    video: Video, out: Path, config: PerceiveConfig, run: Run, say: Say, finders: Finders
) -> None:
    """Fill a capture folder with all that the pictures of a video give.

    Raises:
        InputError: If the source, a file or a network is missing; if it is only that of furniture,
            all else is written.
    """
    clip, drift, tracks, joints = moving_people(video, out, config, run, say, finders)
    size, keep = (clip.width, clip.height), video.keep
    own = "camera.json" in keep
    at, text = lens_of(size, out / "camera.json") if own else camera_by(video, size)
    if text is not None:
        say(f"warning: {text}")
    camera = camera_of(at)
    clean = reference_of(clip, drift, tracks)
    lacking: InputError | None = None
    kept = read_json(out / "objects.json").value if "objects.json" in keep else None
    try:
        if kept is not None or video.objects is not None:
            objects = own_objects(video, clip, drift, say) if kept is None else kept
        else:
            objects = furniture_in(clean, camera, config, run, finders, out)
    except InputError as error:  # all else is written
        objects, lacking = None, error
        (out / "objects.json").unlink(missing_ok=True)  # of another video
    if joints is not None and video.mediapipe and video.masks is None:
        outlines = outlined(objects, camera)
        joints = mediapipe.without_room(joints, clip, clean, outlines)
        if outlines is not None:
            tracks = mediapipe.without_furniture(tracks, joints, outlines)
            clean = reference_of(clip, drift, tracks)
    say(people_found(tracks, clip, clean))
    write_image(clean.picture, out / "reference.png")
    if not own:
        given = {name: at.value[name] for name in LENS_FIELDS if at.value.get(name) is not None}
        camera, by_lines = lens_by_lines(camera, given.get("focal_spread"), clean, say)
        write_json({**camera_to_json(camera), **given, **by_lines}, out / "camera.json")
    write_people(tracks, joints, clip, clean, out, keep)
    if lacking is not None:
        raise lacking
    if "objects.json" not in keep:
        write_json(objects, out / "objects.json")


def people_found(tracks: People, clip: Clip, clean: Clean) -> str:
    """What is said of the people, with a warning where most frames have none."""
    unseen, seen = 100 * float(clean.hidden.float().mean()), len(tracks.frame.unique())
    said = (
        f"people: {len(tracks.person.unique())}, {len(tracks.frame)} masks; {unseen:.1f} % of the "
        "room are never seen without a person"
    )
    if not 0 < seen < FEW * len(clip.time):
        return said
    return (
        f"{said}\nwarning: people are found in {seen} of {len(clip.time)} frames: if some were "
        "missed in the others, reference.png may show them as part of the room; --people-masks "
        "FILE of another tool or a closer view helps"
    )


def write_people(
    tracks: People, joints: Keypoints | None, clip: Clip, clean: Clean, out: Path,
    keep: tuple[str, ...],
) -> None:  # fmt: skip
    """Write people.json and keypoints.npz, by the numbers of the frames, unless they are kept."""
    if "people.json" not in keep:
        people = replace(tracks, frame=clip.numbers[tracks.frame]) if tracks.masks.counts else None
        tree = people_to_json(people, hidden_mask(clean), clip.fps, clip.numbers.tolist())
        write_json(tree, out / "people.json")
    if "keypoints.npz" not in keep:
        if joints is not None and len(joints.frame):
            joints = replace(joints, frame=clip.numbers[joints.frame])
            write_keypoints(joints, out / "keypoints.npz")
        else:
            (out / "keypoints.npz").unlink(missing_ok=True)  # of another video


def outlined(objects: dict[str, Any] | None, camera: Camera) -> Bool[Tensor, "h w"] | None:
    """Where the furniture of objects.json is; None: nothing of it has an outline."""
    if objects is None:
        return None
    furniture = detections_of(At(objects, "objects.json"), camera, log.warning)
    masks = [decode(d.mask, 0) for d in furniture if d.mask is not None]
    return torch.stack(masks).any(0) if masks else None


def moving_people(
    video: Video, out: Path, config: PerceiveConfig, run: Run, say: Say, finders: Finders
) -> tuple[Clip, Drift, People, Keypoints | None]:
    """The steadied clip, and the people in it, at as many frames a second as their motion needs."""
    most = min(DENSEST, rate_of(video.source, replace(config.frames, fps=0.0)) or 0.0)
    while True:
        clip, drift = steady_clip(video.source, out, config, run, say)
        tracks, joints = people_of_clip(clip, drift, video, config, run, say, finders)
        faster = min(2 * (clip.fps or 0.0), most)
        enough = video.keypoints is not None or faster <= (clip.fps or 0.0)
        if joints is None or enough or not restless(joints):
            return clip, drift, tracks, joints
        say(f"people move fast: {faster:.3g} frames a second are taken")
        config = replace(config, frames=replace(config.frames, fps=faster))


def restless(joints: Keypoints) -> bool:
    """Whether people turn back between two frames: a jump would be flattened."""
    names = LAYOUTS[joints.layout]
    trunk = [names.index(f"{side}_{part}") for side in SIDES for part in ("shoulder", "hip")]
    bends = [torch.zeros(1)]
    for mine in rows_by_person(joints.frame, joints.person):
        points, frame = joints.points[mine], joints.frame[mine]
        tall = (points.amax(1) - points.amin(1)).amax(-1).median()
        middle = points[:, trunk].mean(1)
        bend = (middle[2:] - 2 * middle[1:-1] + middle[:-2]).norm(dim=-1) / tall
        bends.append(bend[frame[2:] - frame[:-2] == 2])
    return float(torch.cat(bends).quantile(OFTEN)) > BEND


def steady_clip(
    source: Path, out: Path, config: PerceiveConfig, run: Run, say: Say
) -> tuple[Clip, Drift]:
    """The longest shot of a video, as a camera that stands still saw it, in CAPTURE/frames."""
    raw = out / "perceived" / "raw" / f"{config.frames.fps:g}"
    taken = TakeInputs(source, stamp_of(source), raw)
    whole = run.stage(take_frames, taken, config.frames)
    drift = run.stage(find_drift, whole, None)
    for text in warnings_of(drift, whole.time):
        say(f"warning: {text}")
    raw = whole.part(drift.first, drift.first + len(drift.agree))
    steady = replace(raw, folder=str(out / "frames"), origin=fingerprint(raw.origin, drift))
    made = out / "perceived" / "frames.txt"  # of which clip the files there are
    if not made.is_file() or made.read_text() != steady.origin:
        steady_frames(raw, drift, out / "frames", run.observe)
        made.write_text(steady.origin)
    return steady, drift


def people_of_clip(
    clip: Clip,
    drift: Drift,
    video: Video,
    config: PerceiveConfig,
    run: Run,
    say: Say,
    finders: Finders,
) -> tuple[People, Keypoints | None]:
    """People's masks and joints in all frames: those of the user, of MediaPipe, or of networks."""
    joints = own_keypoints(video, clip, drift, say)
    tracks: People | None = None
    if video.mediapipe:
        tracks, joints = run.stage(finders.poses, mediapipe.pose_inputs(clip), None)
    if video.masks is not None:
        tracks = own_masks(video, clip, drift, say)
    elif tracks is None:
        starts = range(0, len(clip.time), CHUNK)
        parts = [run.stage(finders.instances, clip.part(k, k + CHUNK), config) for k in starts]
        whole = [replace(f, frame=f.frame + k) for f, k in zip(parts, starts, strict=True)]
        tracks = networks.link_people(networks.joined_finds(whole))
    if joints is None and config.models.keypoints and tracks.masks.counts:
        joints = run.stage(finders.joints, JointsInputs(clip, tracks), config.models)
    if joints is not None and not (video.keypoints is None and video.masks is None):
        joints = same_people(joints, tracks, video)
    return tracks, joints


def furniture_in(
    clean: Clean, camera: Camera, config: PerceiveConfig, run: Run, finders: Finders, out: Path
) -> dict[str, Any]:
    """The fields of objects.json as a network finds furniture in the clean picture.

    Raises:
        InputError: If the network is not there.
    """
    picture, mark = clean.picture, fingerprint(clean.picture)  # another picture is another input
    folder = out / "perceived" / "reference" / mark
    write_jpeg((picture * 255).round().to(torch.uint8).numpy(), folder / "000000.jpg")
    clip = Clip(str(folder), picture.shape[1], picture.shape[0], torch.zeros(1), None)
    try:
        found = run.stage(finders.instances, clip, config)
    except InputError as error:
        raise InputError(
            f"furniture is not known yet: outline it in {out / 'reference.png'} (labelme, COCO, or "
            f"boxes alone), and add --objects FILE to the command; or a network finds it: {error}"
        ) from error
    return detections_to_json(detections_in(found), camera, "reference.png")


def lens_by_lines(
    camera: Camera, spread: float | None, clean: Clean, say: Say
) -> tuple[Camera, dict[str, Any]]:
    """The camera with the focal length of the picture's own lines, if the given one is a guess.

    Bodies are fitted under it, so it counts before they are. What it leaves open is handed on, with
    the fact that the lines are in it: counted again in the room, they would count twice.
    """
    if not spread:
        return camera, {}
    segments = find_segments(clean.picture, clean.hidden, camera.K[:2, 2])
    found = find_lens(LensInputs(segments, camera, spread, TILT), LensConfig())
    if abs(math.log(found.zoom)) < CLEARLY * found.spread:  # the feet will say more
        return camera, {}
    say(
        f"lens: the lines of the picture show a focal length {100 * (found.zoom - 1):+.1f} ± "
        f"{100 * found.spread:.1f} % of the guess; it is taken (--camera FILE keeps a measured one)"
    )
    return zoomed(camera, found.zoom), {"focal_spread": found.spread, "focal_by_lines": True}


def camera_by(video: Video, size: tuple[int, int]) -> tuple[At, str | None]:
    """The fields of camera.json by all that is given, and a warning where the lens is a guess.

    A single picture may be a photo, whose EXIF counts.
    """
    pictures = pictures_of(video.source)
    photo = pictures[0] if len(pictures) == 1 else None
    file = photo if video.camera is None and video.fov is None else video.camera
    at, text = lens_of(size, file, video.fov)
    return with_known(at, video.tilt, video.camera_height, photo), text


def lens_of(
    size: tuple[int, int], file: Path | None = None, fov: float | None = None
) -> tuple[At, str | None]:
    """The fields of camera.json, and a warning where the lens is a guess.

    Args:
        size: Width and height of the frames [px].
        file: A calibration of any known kind (GeoCalib's also gives pitch and roll), or a picture
            whose EXIF gives the focal length.
        fov: Horizontal field of view [degrees].

    Raises:
        InputError: If what is given cannot be used.
    """
    photo = file if file is not None and file.suffix.lower() in PICTURES else None
    if file is not None and photo is None:
        return read_camera_file(file, size), None
    if fov is not None:
        return guessed_view(fov, size), None
    known = None if photo is None else camera_of_photo(photo, size)
    if known is not None:
        return known, None
    who = "" if photo is None else f" ({photo.name} has no focal length)"
    text = (
        f"the lens is not known{who}: {USUAL:.0f} degrees across are assumed; give --camera FILE "
        "or --fov DEGREES (GeoCalib, MoGe and others estimate both lens and tilt)"
    )
    return with_spread(of_view(USUAL, size, "assumed"), ASSUMED), text


def read_picture_of(folder: Path) -> Picture:
    """Camera, annotations and hidden pixels of a capture that needs no scene yet.

    Raises:
        InputError: If camera.json or objects.json is missing or wrong.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder, expected a capture")
    parts = folder_parts(folder)
    file = folder / "camera.json"
    if not file.exists() or parts.objects is None:
        raise InputError(f"{folder}: a first scene needs camera.json and objects.json in it")
    given = _before(folder, read_json(file))  # not the camera of a scene that is made again
    camera, tilt = camera_of(given), measured_tilt(given)
    detections = detections_of(parts.objects, camera, log.warning)
    blank = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    masks = [blank if d.mask is None else decode(d.mask, 0) for d in detections]
    people = None if parts.people is None else people_of(parts.people, camera, log.warning)
    reference = None if people is None else people.reference
    known, depth = given.maybe("height"), find_depth_file(folder)
    return Picture(
        camera=camera,
        detections=detections,
        masks=torch.stack(masks) if masks else blank[None][:0],
        people=blank if reference is None else pixels_of(reference),
        height=None if known is None else known.number(0.1, 100.0),
        depth=None
        if depth is None or not depth[1]  # in metres
        else read_depth(depth[0], camera, frame=reference_frame(folder)),
        reference=None if parts.load_image is None else parts.load_image(camera),
        tilt_spread=None if tilt is None else tilt.spread,
    )


def _before(folder: Path, given: At) -> At:
    """The camera with the tilt that it had before a first scene found another one.

    So a first scene that is made again begins where the first did; another tilt in camera.json, of
    the user, counts as it is.
    """
    file = folder / GUESS
    if not file.is_file():
        return given
    try:
        known = read_json(file)
        before, found = (camera_of(known.get(name)) for name in ("before", "found"))
    except InputError:  # a cache: what is damaged is no news
        return given
    turn, own = before.R_cam_world, camera_of(given).R_cam_world
    if not torch.allclose(found.R_cam_world, own, rtol=0, atol=SAME_TILT):
        return given
    fields = {name: value for name, value in given.value.items() if name != "tilt_spread"}
    return given.holding({**fields, "R_cam_world": turn.tolist()})


def write_first_scene(first: FirstScene, folder: Path, guess: Picture) -> None:
    """Write scene.json with its meshes into a capture, and the tilt where `guess` had none."""
    write_scene(first.scene, folder / "scene.json")
    parts = folder_parts(folder)
    assert parts.camera is not None
    given = {k: v for k, v in parts.camera.value.items() if k in LENS_FIELDS}
    before, found = (camera_to_json(camera) for camera in (guess.camera, first.scene.camera))
    if guess.tilt_spread is None:
        given["tilt_spread"] = first.tilt.spread
        write_json({"before": before, "found": found}, folder / GUESS)
    else:  # it was measured
        given["R_cam_world"] = before["R_cam_world"]
        (folder / GUESS).unlink(missing_ok=True)
    write_json({**found, **given}, folder / "camera.json")
    groups = {group[0].piece.id: [h.piece for h in group] for group in first.others}
    write_hypotheses(folder, groups)
