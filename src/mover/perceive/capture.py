"""From a video to a capture folder, step by step; what is finished is not done again.

CAPTURE/perceived/raw      frames as they were taken
CAPTURE/perceived/stages   what each step found
CAPTURE/frames             frames of a camera that stands still
CAPTURE/reference.png, objects.json, people.json, keypoints.npz, camera.json, scene.json, meshes/
"""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.errors import InputError
from mover.core.observe import Observer
from mover.core.records import fingerprint
from mover.core.run import Run
from mover.core.types import Camera, Keypoints, People
from mover.geometry.rle import decode, joined
from mover.io.capture.annotations_file import (
    detections_of,
    detections_to_json,
    people_of,
    people_to_json,
)
from mover.io.capture.camera_file import camera_of, camera_to_json
from mover.io.capture.folder import folder_parts
from mover.io.capture.scene_file import write_hypotheses, write_scene
from mover.io.files.cameras import guessed_view, of_view, read_camera_file, with_spread
from mover.io.files.fields import At, get, maybe, number, read_json, write_json
from mover.io.files.images import find_depth_file, read_depth, write_image
from mover.io.people.keypoints import write_keypoints
from mover.perceive.config import (
    DetectConfig,
    JointsConfig,
    Lens,
    PerceiveConfig,
    SteadyConfig,
    TrackConfig,
)
from mover.perceive.detect import DetectInputs, Finds, find_instances, joined_finds, people_in
from mover.perceive.layout import FirstScene, Picture
from mover.perceive.reference import (
    Clean,
    clip_of_clean,
    detections_in,
    hidden_mask,
    reference_of,
)
from mover.perceive.steady import (
    Drift,
    SteadyInputs,
    cut_warning,
    cuts_of,
    find_drift,
    opencv,
    steady_frames,
    warning_of,
)
from mover.perceive.track import (
    JointsInputs,
    SegmentInputs,
    Tracks,
    find_joints,
    link_people,
    no_people,
    track_people,
)
from mover.perceive.video import Clip, TakeInputs, opened_picture, stamp_of, take_frames

log = logging.getLogger(__name__)
MOST_SHOTS = 20  # that are distinguished: what comes after them counts as one
CHUNK = 50  # frames whose detections are kept together
# How far off a focal length may be, of its logarithm; what a file gives stays as it is.
BY_EXIF = 0.05  # of a photo, while a video is cut by what steadies it
ASSUMED = 0.15  # cameras of phones and rooms are 50 to 75 degrees wide
FULL_FRAME = math.hypot(36, 24)  # [mm], diagonal to which "equivalent" focal lengths refer
SAME_FORMAT = 0.01  # difference of two ratios of width and height
GUESS = "perceived/guess.json"  # the camera before a first scene, and as it left it
SAME_TILT = 1e-6  # elements of a rotation that was read back
USUAL = 60.0  # [degrees], horizontal field of view of phones held level, where nothing is known
EXIF_IFD, FOCAL_35 = 0x8769, 0xA405
Say = Callable[[str], None]


@dataclass(frozen=True)
class Finders:
    """Stages that look at pictures: the networks, or what stands for them."""

    instances: Callable[[DetectInputs, DetectConfig, Observer], Finds] = find_instances
    tracks: Callable[[SegmentInputs, TrackConfig, Observer], Tracks] = track_people
    joints: Callable[[JointsInputs, JointsConfig, Observer], Keypoints] = find_joints


NETWORKS = Finders()


@dataclass(frozen=True)
class Video:
    """What is looked at."""

    source: Path
    """A video, or a folder of pictures."""
    lens: Lens = field(default_factory=Lens)


def perceive(
    video: Video,
    out: Path,
    config: PerceiveConfig,
    run: Run,
    say: Say,
    finders: Finders = NETWORKS,
) -> Camera:
    """Fill a capture folder with all that the pictures of a video give; gives the camera.

    Raises:
        InputError: If the source, OpenCV or a network is missing.
    """
    opencv()
    clip, drift = steady_clip(video.source, out, config, run, say)
    size, lens = (clip.width, clip.height), video.lens
    at, text = lens_of(size, file=lens.file, fov=lens.fov, photo=lens.photo)
    if text is not None:
        say(f"warning: {text}")
    camera = camera_of(at)
    detect = replace(config.detect, models=config.models)
    tracks = people_of_clip(clip, (detect, config), run, finders)
    clean = reference_of(clip, drift, tracks, config.clean)
    say(_summary(clean, tracks))
    clean_clip = clip_of_clean(clean, out / "perceived" / "reference")
    found = run.stage(finders.instances, DetectInputs(clean_clip, (0,)), detect)
    write_image(clean.picture, out / "reference.png")
    objects = detections_to_json(detections_in(found), camera, "reference.png")
    write_json(objects, out / "objects.json")
    write_json(_people_tree(clip, tracks, clean), out / "people.json")
    known = {k: at.value[k] for k in ("height", "focal_spread") if k in at.value}
    write_json({**camera_to_json(camera), **known}, out / "camera.json")
    if config.models.keypoints and len(tracks.frame):
        inputs, joints = JointsInputs(clip, tracks), JointsConfig(config.models)
        found = run.stage(finders.joints, inputs, joints)
        found = replace(found, frame=clip.numbers[found.frame])
        write_keypoints(found, out / "keypoints.npz")
    else:
        (out / "keypoints.npz").unlink(missing_ok=True)  # of another video
    return camera


def _summary(clean: Clean, tracks: Tracks) -> str:
    """What a user should know about people and picture."""
    whole = "no person hides furniture in it"
    if bool(clean.hidden.any()):
        whole = f"{100 * float(clean.hidden.float().mean()):.1f} % of it are never seen empty"
    made = f"frame {clean.frame}" if clean.frame >= 0 else "put together from many frames"
    return f"people: {tracks.people}, {len(tracks.frame)} masks; reference: {made}, {whole}"


def _people_tree(clip: Clip, tracks: Tracks, clean: Clean) -> dict[str, object]:
    people = None
    if tracks.masks.counts:
        people = People(tracks.masks, clip.numbers[tracks.frame], tracks.person, {})
    return people_to_json(people, hidden_mask(clean), clip.fps, clip.numbers.tolist())


def steady_clip(
    source: Path, out: Path, config: PerceiveConfig, run: Run, say: Say
) -> tuple[Clip, Drift]:
    """Frames of a camera that stands still, in CAPTURE/frames."""
    work = out / "perceived"
    whole = run.stage(
        take_frames, TakeInputs(source, stamp_of(source), work / "raw"), config.frames
    )
    raw, drift = one_shot(whole, config.steady, run, say)
    text = warning_of(drift)
    if text is not None:
        say(f"warning: {text}")
    steady = replace(raw, folder=str(out / "frames"), origin=fingerprint(raw.origin, drift))
    if not steady.path(len(raw.time) - 1).is_file() or not run.stages[-1].kept:
        steady_frames(raw, drift, out / "frames", run.observe)
    return steady, drift


def one_shot(whole: Clip, config: SteadyConfig, run: Run, say: Say) -> tuple[Clip, Drift]:
    """The longest part of a video that is not cut, and how its camera moved."""
    drift = run.stage(find_drift, SteadyInputs(whole), config)
    starts, count, cuts = [0], len(whole.time), cuts_of(drift, config)
    while cuts and len(starts) < MOST_SHOTS:
        starts.append(starts[-1] + cuts[0])
        rest = whole.part(starts[-1], count)
        cuts = cuts_of(run.stage(find_drift, SteadyInputs(rest), config), config)
    if len(starts) == 1:
        return whole, drift
    shots = list(pairwise([*starts, count]))
    taken = max(shots, key=lambda shot: shot[1] - shot[0])
    say(f"warning: {cut_warning(whole.time, starts[1:], taken)}")
    clip = whole.part(*taken)
    return clip, run.stage(find_drift, SteadyInputs(clip), config)


def people_of_clip(
    clip: Clip,
    settings: tuple[DetectConfig, PerceiveConfig],
    run: Run,
    finders: Finders = NETWORKS,
) -> Tracks:
    """All people in all frames, segment by segment."""
    detect, config = settings
    count = len(clip.time)
    if not config.models.tracker:
        chunks = [tuple(range(k, min(k + CHUNK, count))) for k in range(0, count, CHUNK)]
        found = [run.stage(finders.instances, DetectInputs(clip, c), detect) for c in chunks]
        return link_people(people_in(joined_finds(found)), config.track)
    track = replace(config.track, models=config.models)
    parts, carried = list[Tracks](), no_people(clip)
    for first in range(0, count, track.segment):
        found = people_in(run.stage(finders.instances, DetectInputs(clip, (first,)), detect))
        last = min(first + track.segment, count - 1)  # it is also the next one's first
        part = run.stage(finders.tracks, SegmentInputs(clip, first, last, found, carried), track)
        carried = where(part, part.frame == last)
        parts.append(part if last == count - 1 else where(part, part.frame != last))
        if last == count - 1:
            break
    return _joined(parts)


def where(tracks: Tracks, keep: Bool[Tensor, " rows"]) -> Tracks:
    """The rows that are kept."""
    counts = tuple(tracks.masks.counts[k] for k in keep.nonzero()[:, 0].tolist())
    masks = replace(tracks.masks, counts=counts)
    return Tracks(masks, tracks.frame[keep], tracks.person[keep], tracks.people)


def _joined(parts: Sequence[Tracks]) -> Tracks:
    return Tracks(
        joined([p.masks for p in parts]),
        torch.cat([p.frame for p in parts]),
        torch.cat([p.person for p in parts]),
        max(p.people for p in parts),
    )


def lens_of(
    size: tuple[int, int], *, file: Path | None, fov: float | None, photo: Path | None
) -> tuple[At, str | None]:
    """The fields of camera.json, and a warning where the lens is a guess.

    Args:
        size: Width and height of the frames [px].
        file: A calibration of any known kind; GeoCalib's also gives pitch and roll.
        fov: Horizontal field of view [degrees].
        photo: A picture whose EXIF gives the focal length.

    Raises:
        InputError: If what is given cannot be used.
    """
    if file is not None:
        return _in_pixels_of(size, read_camera_file(file, size)), None
    if fov is not None:
        return guessed_view(fov, size), None
    focal = None if photo is None else exif_focal(photo, size)
    if focal is not None:
        w, h = size
        fields = {"w": w, "h": h, "fl_x": focal, "fl_y": focal, "cx": w / 2, "cy": h / 2}
        return with_spread(At(fields, "EXIF"), BY_EXIF), None
    text = (
        f"the lens is not known: {USUAL:.0f} degrees across are assumed; give --camera FILE or "
        "--fov DEGREES (GeoCalib, MoGe and others estimate both lens and tilt)"
    )
    return with_spread(of_view(USUAL, size, "assumed"), ASSUMED), text


def _in_pixels_of(size: tuple[int, int], at: At) -> At:
    """The fields of camera.json in the pixels of these frames; a calibration may be of larger ones.

    Raises:
        InputError: If the calibration is of pictures of another format.
    """
    own = tuple(int(number(get(at, name), 1, 1e5)) for name in ("w", "h"))
    if abs(own[0] * size[1] - own[1] * size[0]) > SAME_FORMAT * own[0] * size[1]:
        raise InputError(
            f"{at.file}: is of pictures of {own[0]} x {own[1]} pixels, expected the format of the "
            f"frames, {size[0]} x {size[1]}"
        )
    zoom = {"fl_x": size[0] / own[0], "cx": size[0] / own[0]}
    zoom |= {"fl_y": size[1] / own[1], "cy": size[1] / own[1]}
    scaled = {k: v if k not in zoom else zoom[k] * float(v) for k, v in at.value.items()}
    return At({**scaled, "w": size[0], "h": size[1]}, at.file, at.field)


def exif_focal(photo: Path, size: tuple[int, int]) -> float | None:
    """Focal length of a picture's EXIF [px]; None: it gives none.

    The 35 mm equivalent refers to the diagonal, so it holds for any format and either way up.

    Raises:
        InputError: If it is no picture.
    """
    with opened_picture(photo, large="ignore") as picture:
        found: Any = picture.getexif().get_ifd(EXIF_IFD).get(FOCAL_35)
    if found is None or not 1 <= float(found) <= 2000:
        return None
    return float(found) / FULL_FRAME * math.hypot(*size)


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
    given = read_json(file)  # not the camera of a scene that is made again
    camera = _guessed(folder, camera_of(given))
    detections = detections_of(parts.objects, camera, log.warning)
    blank = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    masks = [blank if d.mask is None else decode(d.mask, 0) for d in detections]
    hidden = blank
    if parts.people is not None:
        reference = people_of(parts.people, camera, log.warning).reference
        for row in range(0 if reference is None else len(reference.counts)):
            assert reference is not None
            hidden = hidden | decode(reference, row)
    known = maybe(given, "height")
    return Picture(
        camera=camera,
        detections=detections,
        masks=torch.stack(masks) if masks else blank[None][:0],
        people=hidden,
        height=None if known is None else number(known, 0.1, 100.0),
        depth=_metric_depth(folder, camera),
        reference=None if parts.load_image is None else parts.load_image(camera),
    )


def _metric_depth(folder: Path, camera: Camera) -> Float[Tensor, "h w"] | None:
    """The capture's depth, where it is in metres."""
    own = find_depth_file(folder)
    return read_depth(own[0], camera) if own is not None and own[1] else None


def _guessed(folder: Path, camera: Camera) -> Camera:
    """The camera with the tilt that it had before a first scene found another one.

    So a first scene that is made again begins where the first did; another tilt in camera.json, of
    the user, counts as it is.
    """
    file = folder / GUESS
    if not file.is_file():
        return camera
    try:
        before, found = (camera_of(get(read_json(file), name)) for name in ("before", "found"))
    except InputError:  # a cache: what is damaged is no news
        return camera
    same = torch.allclose(found.R_cam_world, camera.R_cam_world, rtol=0, atol=SAME_TILT)
    return replace(camera, R_cam_world=before.R_cam_world) if same else camera


def write_first_scene(first: FirstScene, folder: Path, guess: Camera) -> None:
    """Write scene.json with its meshes, the tilt into camera.json, and what else is possible.

    Args:
        first: What was found.
        folder: The capture.
        guess: The camera with which it began.
    """
    write_scene(first.scene, folder / "scene.json")
    parts = folder_parts(folder)
    assert parts.camera is not None
    given = {k: v for k, v in parts.camera.value.items() if k in ("height", "focal_spread")}
    found = camera_to_json(first.scene.camera)
    write_json({**found, **given}, folder / "camera.json")
    write_json({"before": camera_to_json(guess), "found": found}, folder / GUESS)
    groups = {group[0].piece.id: [h.piece for h in group] for group in first.others}
    energies = {group[0].piece.id: [h.energy for h in group] for group in first.others}
    write_hypotheses(folder, groups, energies)
