"""What the user hands in of a video: joints, people's masks, outlines or boxes of furniture.

Files count frames and pixels as in the video; both are carried to the frames that are taken, as the
steadied camera sees them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.errors import InputError
from mover.core.types import Keypoints, Masks, People
from mover.geometry.rle import area, decode, encode, mask_boxes
from mover.io.files.fields import listed
from mover.io.formats import names
from mover.io.masks.instance_files import read_people, read_things
from mover.io.masks.instances import Instance, Instances
from mover.io.people.found import Known
from mover.io.people.keypoints import keypoints_from, read_keypoints
from mover.perceive.config import FramesConfig
from mover.perceive.steady import Drift, moved, warp
from mover.perceive.video import Clip, rate_of

Say = Callable[[str], None]
FEW = 0.5  # share of the frames: with fewer in a file the user is warned
HARDLY, FITS = 0.1, 0.8  # share of joints in masks: of other people; of the same people
MOST = 0.5  # of the picture that a person covers
FAR = 3.0  # times as far as another person: who jumps so has another's number
SAME_RATE, UNEVEN = 0.01, 0.1  # difference of two rates of frames; of the mean of an uneven video
BARE = 2.0  # joints from 0 to 1 are below


@dataclass(frozen=True)
class Video:
    """What is looked at, and what stands in place of what the networks of transformers find."""

    source: Path
    """A video, a folder of pictures, or one picture."""
    camera: Path | None = None
    """A calibration, or a photo of the same camera."""
    fov: float | None = None
    """Horizontal field of view [degrees]."""
    tilt: tuple[float, ...] = ()
    """Measured pitch and roll, and how far off they may be [degrees]."""
    camera_height: float | None = None
    """Of the camera above the floor [m]."""
    keypoints: Callable[[], Path] | None = None
    """Gives the file of people's joints, once the frames are written."""
    of_frames: bool = False
    """Whether it is made of CAPTURE/frames, not of the video."""
    mediapipe: bool = False
    """Whether joints, and masks where none are handed in, are MediaPipe's; no joints then."""
    masks: Path | None = None
    """People's masks."""
    objects: Path | None = None
    """Furniture: COCO, labelme or boxes alone."""
    objects_frame: int | None = None
    """The frame of the video in which it is outlined; None: the clean picture."""
    keep: tuple[str, ...] = ()
    """Files of the capture that the user replaced: they are read, not written."""


def own_keypoints(video: Video, clip: Clip, drift: Drift, say: Say) -> Keypoints | None:
    """Joints of the frames that are taken (by their place in the clip), in steadied pixels.

    Raises:
        InputError: If the file cannot be read or has none of these frames.
    """
    if video.keypoints is None:
        return None
    path = video.keypoints()
    found = _read_joints(path)
    frames = clip.numbers if video.of_frames else clip.in_source
    counted = found.frame if video.of_frames else _counted(found.frame, found.fps, video, path, say)
    rows, at = _taken(counted, frames, path, say)
    points = found.points[rows]
    if not video.of_frames and drift.verdict != "still":
        for k, frame in enumerate(at.tolist()):
            points[k] = torch.from_numpy(
                moved(np.linalg.inv(drift.H[frame].double().numpy()), points[k].numpy())
            )
    sure, person = found.confidence[rows], found.person[rows]
    joints = Keypoints(points, sure, found.layout, at, person, clip.fps)
    for who, frame in swaps(joints) if clip.fps else ():
        say(
            f"warning: {path.name}: persons {who} change places at frame {int(frames[frame])}, "
            "expected one number for each person: correct them from there on"
        )
    return joints


def swaps(joints: Keypoints) -> list[tuple[str, int]]:
    """People who are far nearer to where others of them were one frame before, and that frame."""
    from scipy.optimize import linear_sum_assignment

    sure = (joints.confidence > 0)[..., None]
    middle = (joints.points * sure).sum(1) / sure.sum(1).clamp_min(1)
    tall = ((joints.points - middle[:, None]) * sure).norm(dim=-1).amax(1)
    found = list[tuple[str, int]]()
    for frame in joints.frame.unique().tolist():
        rows = [(joints.frame == k).nonzero()[:, 0].tolist() for k in (frame - 1, frame)]
        before, now = ({int(joints.person[row]): row for row in some} for some in rows)
        people = sorted(before.keys() & now.keys())
        old = [before[who] for who in people]
        way = torch.cdist(middle[old], middle[[now[who] for who in people]])
        nearest = torch.from_numpy(linear_sum_assignment(way)[1])
        other = nearest != torch.arange(len(people))
        jump, step = way.diagonal()[other], way.gather(1, nearest[:, None])[other, 0]
        if (2 * jump > tall[old][other]).any() and jump.sum() > FAR * step.sum():
            names = [str(who) for who, one in zip(people, other, strict=True) if one]
            found.append((" and ".join(names), frame))
    return found


def _read_joints(path: Path) -> Keypoints:
    """A file or folder of joints of any known layout: the first whose reader takes it."""
    if path.suffix == ".npz":
        return read_keypoints(path)
    first: InputError | None = None
    for name in names("keypoints"):
        try:
            return keypoints_from(name, path, Known())
        except InputError as error:
            first = first or error
    raise InputError(f"{first}; known are keypoints.npz and {', '.join(names('keypoints'))}")


def own_masks(video: Video, clip: Clip, drift: Drift, say: Say) -> People:
    """People's masks of the frames that are taken, as the steadied camera sees them.

    Raises:
        InputError: If the file cannot be read, has another size, or none of these frames.
    """
    assert video.masks is not None
    path, size = video.masks, (clip.width, clip.height)
    found = read_people(path, {}, size)
    for note in found.notes:
        say(f"note: {note}")
    items = [item for item in found.items if item.mask is not None]
    frames = torch.tensor([item.frame for item in items], dtype=torch.long)
    frames = _counted(frames, found.fps, video, path, say)
    rows, at = _taken(frames, clip.in_source, path, say)
    codes, kept = list[bytes](), list[int]()
    for k, (row, frame) in enumerate(zip(rows.tolist(), at.tolist(), strict=True)):
        mask = decode(Masks(clip.height, clip.width, (items[row].mask or b"",)), 0)
        mask = mask if drift.verdict == "still" else _carried(mask, drift.H[frame])
        if bool(mask.any()):
            codes.append(encode(mask))
            kept.append(k)
    person = torch.tensor([items[rows[k]].track or 0 for k in kept], dtype=torch.long)
    masks = Masks(clip.height, clip.width, tuple(codes))
    areas = [area(masks, k) / (clip.height * clip.width) for k in range(len(codes))]
    if areas and (usual := float(np.median(areas))) > MOST:
        raise InputError(
            f"{path.name}: masks cover {usual:.0%} of the picture in most frames, expected those "
            "of people: they are inverted (the room is set), so invert them"
        )
    return People(masks, at[kept], person)


def own_objects(video: Video, clip: Clip, drift: Drift, say: Say) -> dict[str, Any]:
    """The fields of objects.json from outlines or boxes.

    Raises:
        InputError: If the file cannot be read, has another size or no object in the picture, or the
            frame is not of the shot.
    """
    assert video.objects is not None
    name = video.objects.name
    size = clip.width, clip.height
    found = read_things(video.objects, {}, size, "reference.png")
    for note in found.notes:
        say(f"note: {note}")
    items = list(found.items)
    if not items:
        raise InputError(f"{name}: has no furniture, expected outlines or boxes")
    if video.objects_frame is not None:
        off, frame = (clip.in_source - video.objects_frame).abs().min(0)
        if off > clip.in_source.diff().amax() if len(clip.time) > 1 else off > 0:
            raise InputError(
                f"--objects-frame: has {video.objects_frame}, expected a frame that is taken of "
                f"the video, {int(clip.in_source[0])} to {int(clip.in_source[-1])}"
            )
        items = [_moved_item(item, drift.H[frame], size) for item in items]
    whole, cut = list[Instance](), list[str]()
    for item in items:
        box = None if item.box is None else tuple(np.clip(item.box, 0, size * 2).tolist())
        whole.append(replace(item, box=box))
        if np.abs(np.subtract(item.box or 0, box or 0)).max() > 1:
            cut.append(item.category)
    if cut:
        say(f"warning: {name}: {listed('outline', cut)} beyond the picture, cut at its border")
    tree = Instances(tuple(whole), size, found.file).objects_tree().value
    inside = {row["id"] for row in tree["annotations"]}
    if lost := [item.category for k, item in enumerate(whole) if k not in inside]:
        text = (
            f"{name}: {listed('object', lost)} outside the picture of {size[0]} x {size[1]} pixels"
        )
        if not inside:
            raise InputError(f"{text}, expected outlines in reference.png or a frame")
        say(f"warning: {text}, left out")
    return {**tree, "images": [{**tree["images"][0], "file_name": "reference.png"}]}


def _moved_item(item: Instance, H: Float[Tensor, "3 3"], size: tuple[int, int]) -> Instance:
    """Outline and box in the pixels of the steadied camera."""
    mask, box = item.mask, item.box
    if mask is not None:
        pixels = _carried(decode(Masks(size[1], size[0], (mask,)), 0), H)
        mask = encode(pixels) if bool(pixels.any()) else None
    if box is not None:
        x0, y0, x1, y1 = box
        corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
        places = moved(np.linalg.inv(H.double().numpy()), corners).clip(0, size)
        box = *places.min(0).tolist(), *places.max(0).tolist()
    return replace(item, mask=mask, box=box)


def _carried(mask: Bool[Tensor, "h w"], H: Float[Tensor, "3 3"]) -> Bool[Tensor, "h w"]:
    """A mask of a frame as the steadied camera sees it."""
    pixels = mask.numpy().astype(np.float32)
    return torch.from_numpy(warp(pixels, H.double().numpy(), mask.shape) > 0.5)


def _counted(
    frames: Int[Tensor, " rows"], fps: float | None, video: Video, path: Path, say: Say
) -> Int[Tensor, " rows"]:
    """Frames of the video from those of a file that has another rate; -1: there is none.

    Raises:
        InputError: If the two rates are no whole multiples.
    """
    rate = None if fps is None else rate_of(video.source, FramesConfig(fps=0.0))
    if rate is None or fps is None or abs(fps / rate - 1) < SAME_RATE:
        return frames
    found = f"{path.name}: has 'fps' {fps:g}, expected {rate:g} as in {video.source.name}"
    more, less = round(max(rate / fps, 1)), round(max(fps / rate, 1))
    off = abs(fps * more / less / rate - 1)
    if off > (SAME_RATE if more * less > 1 else UNEVEN):
        raise InputError(f"{found}: number frames as in the video, or leave 'fps' away")
    say(f"warning: {found}: frame {less} of it is taken as frame {more} of the video")
    return torch.where(frames % less == 0, frames * more // less, -1)


def _taken(
    frames: Int[Tensor, " rows"], wanted: Int[Tensor, " frames"], path: Path, say: Say
) -> tuple[Int[Tensor, " kept"], Int[Tensor, " kept"]]:
    """Rows of a file whose frame is taken, and its place in the clip.

    Raises:
        InputError: If there is none.
    """
    place = {frame: k for k, frame in enumerate(wanted.tolist())}
    rows = [k for k, frame in enumerate(frames.tolist()) if frame in place]
    at = [place[int(frames[k])] for k in rows]
    if not rows:
        few = ", ".join(map(str, wanted.tolist()[:4]))
        raise InputError(
            f"{path.name}: has none of the frames that are taken of the video, expected {few} ... "
            "(from 0; --frames.fps takes others)"
        )
    if len(set(at)) < FEW * len(place):
        say(
            f"warning: {path.name} has {len(set(at))} of the {len(place)} frames that are taken: "
            f"its last is {int(frames.max())}, that of the video {int(wanted[-1])}; if it has only "
            "every n-th, number them as in the video, from 0"
        )
    return torch.tensor(rows), torch.tensor(at)


def same_people(keypoints: Keypoints, tracks: People, video: Video) -> Keypoints:
    """The joints under the numbers of the masks that hold most of them; others are numbered on.

    Raises:
        InputError: If hardly any joint lies in a mask.
    """
    from scipy.optimize import linear_sum_assignment

    people, masks = keypoints.person.unique().tolist(), tracks.person.unique().tolist()
    votes, share = _held(keypoints, tracks)
    if share < FEW and (found := _apart(keypoints, tracks, video, share)):
        raise InputError(found)
    pairs = zip(*linear_sum_assignment(-votes), strict=True)
    number = {people[i]: masks[j] for i, j in pairs if votes[i, j] > 0}
    others = [person for person in people if person not in number]
    number |= {person: max([*masks, -1]) + 1 + k for k, person in enumerate(others)}
    return replace(keypoints, person=torch.tensor([number[p] for p in keypoints.person.tolist()]))


def _held(keypoints: Keypoints, tracks: People) -> tuple[Float[np.ndarray, "people masks"], float]:
    """Joints of each person that each track of masks holds, and the share that any mask holds."""
    people, masks = keypoints.person.unique().tolist(), tracks.person.unique().tolist()
    votes, most = np.zeros((len(people), len(masks))), dict[int, tuple[int, int]]()
    for k, row in (keypoints.frame[:, None] == tracks.frame).nonzero().tolist():
        mask = decode(tracks.masks, row)
        x, y = keypoints.points[k][keypoints.confidence[k] > 0].long().unbind(-1)
        inside = mask[y.clamp(0, mask.shape[0] - 1), x.clamp(0, mask.shape[1] - 1)]
        pair = people.index(int(keypoints.person[k])), masks.index(int(tracks.person[row]))
        votes[pair] += int(inside.sum())
        most[k] = max(most.get(k, (0, 0)), (int(inside.sum()), len(x)))
    held, joints = np.array([*most.values(), (0, 0)]).sum(0)
    return votes, held / joints if joints else 1.0


def _apart(keypoints: Keypoints, tracks: People, video: Video, share: float) -> str:
    """Why joints lie beside the masks: another size, other frames; empty: they do not."""
    sure = (keypoints.confidence > 0)[..., None]
    same = (keypoints.frame[:, None] == tracks.frame) & sure.any(1)
    k, row = same.nonzero().unbind(-1)
    low, high = (keypoints.points.masked_fill(~sure, far) for far in (math.inf, -math.inf))
    middle = (low.amin(1) + high.amax(1))[k] / 2
    boxes = mask_boxes(tracks.masks)[row]
    zoom = (middle * (boxes[:, :2] + boxes[:, 2:]) / 2).sum() / middle.square().sum()
    size = torch.tensor([tracks.masks.width, tracks.masks.height])
    zoom = size if keypoints.points.amax() < BARE else zoom.expand(2)
    why = "are both of this video, and their frames counted from 0 as in it?"
    if _held(replace(keypoints, points=keypoints.points * zoom), tracks)[1] > FITS:
        (w, h), (width, height) = (size / zoom).round().int().tolist(), size.tolist()
        why = f"they fit in pictures of about {w} x {h} pixels: give those of {width} x {height}"
    elif share > HARDLY:
        return ""
    masks = "people's masks" if video.masks is None else f"the masks of {video.masks.name}"
    return f"--keypoints: {share:.0%} of the joints lie in {masks}, expected most of them; {why}"
