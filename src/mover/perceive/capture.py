"""From a video to a capture folder, step by step; what is finished is not done again.

CAPTURE/perceived/raw      frames as they were taken
CAPTURE/perceived/stages   what each step found
CAPTURE/frames             frames of a camera that stands still
CAPTURE/reference.png, objects.json, people.json, keypoints.npz, camera.json, scene.json, meshes/
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from ..readers.camera_file import camera_of, camera_to_json
from ..readers.fields import write_json
from ..readers.image_file import write_image
from ..readers.objects_file import detections_to_json
from ..readers.people.keypoints_file import write_keypoints
from ..readers.people_file import people_to_json
from ..records import fingerprint
from ..run import Run
from ..types import Camera, People
from .clean import Clean, CleanConfig
from .detect import DetectConfig, DetectInputs, find_instances, joined_finds, people_in
from .joints import JointsConfig, JointsInputs, find_joints
from .lens import lens_of
from .models import ModelsConfig
from .reference import detections_in, furniture_of, hidden_mask, reference_of
from .steady import Drift, SteadyConfig, SteadyInputs, find_drift, steady_frames, warning_of
from .track import SegmentInputs, TrackConfig, Tracks, link_people, nobody, track_people
from .video import Clip, FramesConfig, TakeInputs, stamp_of, take_frames

CHUNK = 50  # frames whose detections are kept together
Say = Callable[[str], None]


@dataclass(frozen=True)
class PerceiveConfig:
    """How a video is read."""

    frames: FramesConfig = field(default_factory=FramesConfig)
    """Which frames."""
    steady: SteadyConfig = field(default_factory=SteadyConfig)
    """What counts as a camera that stands still."""
    clean: CleanConfig = field(default_factory=CleanConfig)
    """The reference picture without people."""
    models: ModelsConfig = field(default_factory=ModelsConfig)
    """Which networks do what."""
    detect: DetectConfig = field(default_factory=DetectConfig)
    """Furniture and people in pictures (its models are those above)."""
    track: TrackConfig = field(default_factory=TrackConfig)
    """People through the video (its models are those above)."""


@dataclass(frozen=True)
class Lens:
    """What is known of the camera."""

    file: Path | None = None
    fov: float | None = None
    photo: Path | None = None


def perceive(
    source: Path, out: Path, lens: Lens, config: PerceiveConfig, run: Run, say: Say
) -> Camera:
    """Fill a capture folder with all that a video tells of its pictures; gives the camera.

    Raises:
        InputError: If the source or a network is missing.
    """
    clip, drift = steady_clip(source, out, config, run, say)
    size = clip.width, clip.height
    at, text = lens_of(size, file=lens.file, fov=lens.fov, photo=lens.photo)
    if text is not None:
        say(f"warning: {text}")
    camera = camera_of(at)
    detect = replace(config.detect, models=config.models)
    tracks = people_of_clip(clip, detect, config, run)
    clean = reference_of(clip, drift, tracks, config.clean)
    say(_told(clean, tracks))
    found = furniture_of(clean, out / "perceived" / "reference", detect, run)
    write_image(clean.picture, out / "reference.png")
    objects = detections_to_json(detections_in(found), camera, "reference.png")
    write_json(objects, out / "objects.json")
    write_json(_people_tree(clip, tracks, clean), out / "people.json")
    height = {"height": at.value["height"]} if "height" in at.value else {}
    write_json({**camera_to_json(camera), **height}, out / "camera.json")
    if config.models.keypoints and len(tracks.frame):
        inputs, joints = JointsInputs(clip, tracks), JointsConfig(config.models)
        write_keypoints(run.stage(find_joints, inputs, joints), out / "keypoints.npz")
    return camera


def _told(clean: Clean, tracks: Tracks) -> str:
    """What a user should know about people and picture."""
    whole = "nobody hides furniture in it"
    if bool(clean.hidden.any()):
        whole = f"{100 * float(clean.hidden.float().mean()):.1f} % of it are never seen empty"
    made = f"frame {clean.frame}" if clean.frame >= 0 else "put together from many frames"
    return f"people: {tracks.people}, {len(tracks.frame)} masks; reference: {made}, {whole}"


def _people_tree(clip: Clip, tracks: Tracks, clean: Clean) -> dict[str, object]:
    people = None
    if tracks.masks.counts:
        people = People(tracks.masks, tracks.frame, tracks.person, {})
    frames = range(len(clip.time))
    return people_to_json(people, hidden_mask(clean), clip.fps, frames)


def steady_clip(
    source: Path, out: Path, config: PerceiveConfig, run: Run, say: Say
) -> tuple[Clip, Drift]:
    """Frames of a camera that stands still, in CAPTURE/frames."""
    work = out / "perceived"
    raw = run.stage(take_frames, TakeInputs(source, stamp_of(source), work / "raw"), config.frames)
    drift = run.stage(find_drift, SteadyInputs(raw), config.steady)
    text = warning_of(drift)
    if text is not None:
        say(f"warning: {text}")
    done = out / "frames" / f"{len(raw.time) - 1:06d}.jpg"
    origin = fingerprint(raw.origin, drift)
    steady = replace(raw, folder=str(out / "frames"), origin=origin)
    if not done.is_file() or not run.stages[-1].kept:
        steady_frames(raw, drift, out / "frames", run.observe)
    return steady, drift


def people_of_clip(clip: Clip, detect: DetectConfig, config: PerceiveConfig, run: Run) -> Tracks:
    """Everybody in all frames, segment by segment."""
    count = len(clip.time)
    if not config.models.tracker:
        chunks = [tuple(range(k, min(k + CHUNK, count))) for k in range(0, count, CHUNK)]
        found = [run.stage(find_instances, DetectInputs(clip, c), detect) for c in chunks]
        return link_people(people_in(joined_finds(found)), config.track)
    track = replace(config.track, models=config.models)
    parts, carried = list[Tracks](), nobody(clip)
    for first in range(0, count, track.segment):
        found = people_in(run.stage(find_instances, DetectInputs(clip, (first,)), detect))
        last = min(first + track.segment, count - 1)  # it is also the next one's first
        part = run.stage(track_people, SegmentInputs(clip, first, last, found, carried), track)
        carried = rows_at(part, last)
        own = part if last == count - 1 else without_frame(part, last)
        parts.append(own)
        if last == count - 1:
            break
    return _joined(parts)


def rows_at(tracks: Tracks, frame: int) -> Tracks:
    """The rows of one frame."""
    return _some(tracks, (tracks.frame == frame).nonzero()[:, 0].tolist())


def without_frame(tracks: Tracks, frame: int) -> Tracks:
    """The rows of all other frames."""
    return _some(tracks, (tracks.frame != frame).nonzero()[:, 0].tolist())


def _some(tracks: Tracks, rows: Sequence[int]) -> Tracks:
    index = torch.tensor(list(rows), dtype=torch.long)
    masks = replace(tracks.masks, counts=tuple(tracks.masks.counts[k] for k in rows))
    return Tracks(masks, tracks.frame[index], tracks.person[index], tracks.people)


def _joined(parts: Sequence[Tracks]) -> Tracks:
    counts = tuple(c for p in parts for c in p.masks.counts)
    return Tracks(
        replace(parts[0].masks, counts=counts),
        torch.cat([p.frame for p in parts]),
        torch.cat([p.person for p in parts]),
        max(p.people for p in parts),
    )
