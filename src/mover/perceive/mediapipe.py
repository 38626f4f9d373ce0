r"""People's joints and masks by MediaPipe's networks (BlazePose), without the package mediapipe.

A detector looks at the whole picture, and gives of each person the middle of the hips and a point
that marks size and direction; the landmark network looks at the crop that stands upright about
them, and gives 33 landmarks, a map of where each is likely, and a mask:

    side = 2.5 |q - p|,   turn = pi/2 - atan2(p_y - q_y, q_x - p_x)

Frame by frame: at few frames a second the tracking of MediaPipe loses legs. People are linked by
their place. Written from the model card (BlazePose GHUM 3D) and the public graphs' settings; pixels
are counted as there: whole numbers in a crop are whole numbers in the picture.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from numpy.typing import NDArray
from torch import Tensor

from mover.core.errors import InputError
from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.types import Keypoints, Masks, People
from mover.geometry.rle import decode, encode
from mover.io.people.found import followed
from mover.perceive.config import COMMAND, install, networks
from mover.perceive.steady import Clean
from mover.perceive.video import Clip, read_picture

LAYOUT = "mediapipe33"
CELLS = ((28, 2), (14, 2), (7, 6))  # anchors: cells along a side, and boxes in each
SEEN = 0.5  # least score of the detector, and that the landmark network sees a person
SAME = 0.3  # overlap of boxes of one person
WIDER = 1.25  # of the circle through the detector's two points
KERNEL = 7  # cells of a map about a landmark
LIKELY = 0.5  # least maximum of a map that moves a landmark
INSIDE = 0.5  # least coverage of a mask
TWICE = 0.7  # overlap of two masks, over the smaller one, from which they are one person
NOISE = 5.0  # times the median difference of a frame from the room: what differs less is the room
PATCH, EMPTY = 0.02, 0.75  # of the height: half a square; share of it that looks like the room
SIZES = 224, 256  # [px], of the pictures that the networks see

Array = NDArray[np.floating[Any]]
Runs = Callable[[Array], dict[tuple[int, ...], Array]]
"""A network that is ready: a picture (h, w, 3) in, an array for the shape of each output out."""


@record
class PoseInputs:
    """Frames in which people are looked for."""

    clip: Clip
    networks: tuple[str, str]
    """Files of the detector and of the landmark network,"""
    digest: str
    """and a hash of their content."""


def pose_inputs(clip: Clip) -> PoseInputs:
    """A clip with the networks of this machine.

    Raises:
        InputError: If they are not there.
    """
    found = networks()
    if found is None:
        raise InputError(f"MediaPipe's networks are not here: {COMMAND}")
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in found)).hexdigest()
    return PoseInputs(clip, (str(found[0]), str(found[1])), digest)


def find_poses(
    inputs: PoseInputs, _config: None = None, observe: Observer = silent
) -> tuple[People, Keypoints]:
    """Masks and joints of the people in all frames of a clip, in the same order.

    Raises:
        InputError: If the networks cannot be run.
    """
    detector, landmarks = (loaded(path) for path in inputs.networks)
    clip = inputs.clip
    codes, frames = list[bytes](), list[int]()
    found: list[tuple[Array, Array]] = []
    for frame in range(len(clip.time)):
        for points, sure, mask in people_in(read_picture(clip.path(frame)), detector, landmarks):
            codes.append(encode(torch.from_numpy(mask)))
            frames.append(frame)
            found.append((points, sure))
        observe(Step("find_poses", frame, len(clip.time)))
    points = np.array([p for p, _ in found]).reshape(-1, 33, 2)
    low, high = points.min(1), points.max(1)
    person = followed(frames, (low + high) / 2, np.linalg.norm(high - low, axis=1))
    confidence = np.array([s for _, s in found]).reshape(-1, 33)
    rows = torch.tensor(frames, dtype=torch.long), torch.from_numpy(person)
    tracks = People(Masks(clip.height, clip.width, tuple(codes)), *rows)
    points, confidence = (torch.from_numpy(x).float() for x in (points, confidence))
    return tracks, Keypoints(points, confidence, LAYOUT, *rows, clip.fps)


def people_in(
    picture: NDArray[np.uint8], detector: Runs, landmarks: Runs
) -> list[tuple[Array, Array, NDArray[np.bool_]]]:
    """Landmarks (33, 2) [px], their visibility, and the mask of each person in a picture."""
    import cv2
    from scipy.special import expit

    h, w = picture.shape[:2]
    kept: list[tuple[Array, Array, NDArray[np.bool_]]] = []
    for middle, edge in detected(picture, detector):
        far = edge - middle
        turn = np.pi / 2 - np.arctan2(-far[1], far[0])
        side = 2 * WIDER * float(np.linalg.norm(far))
        crop, M = cropped(picture, middle, side, turn, SIZES[1], cv2.BORDER_REPLICATE)
        out = landmarks(crop / 255)
        if float(out[1, 1][0, 0]) < SEEN:
            continue
        rows = out[1, 195].reshape(39, 5)
        places = refined(rows[:33, :2], out[1, 64, 64, 39][0])
        points = places @ M[:, :2].T + M[:, 2]
        cover = expit(out[1, 256, 256, 1][0, ..., 0])
        mask = cv2.warpAffine(cover.astype(np.float32), M, (w, h)) > INSIDE
        others = [(mask & o).sum() / max(1, min(mask.sum(), o.sum())) for *_, o in kept]
        if mask.any() and not any(shared > TWICE for shared in others):
            kept.append((points, expit(rows[:33, 3]), mask))
    return kept


def detected(picture: NDArray[np.uint8], detector: Runs) -> list[tuple[Array, Array]]:
    """Middle of the hips of each person, and a point on the circle about them [px], surest first.

    Boxes that overlap the surest one are averaged with it by their scores.
    """
    import cv2
    from scipy.special import expit

    h, w = picture.shape[:2]
    side, middle = max(h, w), np.array([w / 2, h / 2])
    crop, M = cropped(picture, middle, side, 0.0, SIZES[0], cv2.BORDER_CONSTANT)
    out = detector(crop / 127.5 - 1)
    score = expit(out[1, 2254, 1][0, :, 0])
    sure = score >= SEEN
    values = out[1, 2254, 12][0, sure].reshape(-1, 6, 2)  # middle, size, four points
    boxes = anchors()[sure] * SIZES[0]
    values = values + np.where(np.arange(6)[:, None] == 1, 0, boxes[:, None])
    found: list[tuple[Array, Array]] = []
    left = np.argsort(-score[sure], kind="stable")
    while len(left):
        low, high = values[left, 0] - values[left, 1] / 2, values[left, 0] + values[left, 1] / 2
        shared = (np.minimum(high, high[0]) - np.maximum(low, low[0])).clip(0).prod(1)
        area = (high - low).prod(1)
        same = shared > SAME * (area + area[0] - shared)
        same[0] = True
        mean = np.average(values[left[same]], axis=0, weights=score[sure][left[same]])
        hips, edge = mean[2:4] @ M[:, :2].T + M[:, 2]
        found.append((hips, edge))
        left = left[~same]
    return found


@lru_cache(maxsize=1)
def anchors() -> Array:
    """Middles of the detector's boxes in the picture, from 0 to 1 (Liu et al., SSD)."""
    rows: list[Array] = []
    for cells, boxes in CELLS:
        y, x = np.mgrid[:cells, :cells]
        rows.append(np.repeat(np.stack([x.ravel(), y.ravel()], -1) + 0.5, boxes, 0) / cells)
    return np.concatenate(rows)


def cropped(
    picture: NDArray[np.uint8], middle: Array, side: float, turn: float, size: int, border: int
) -> tuple[Array, Array]:
    """A square of a picture, turned clockwise [rad], and the matrix (2, 3) to the picture from it.

    `middle` and `side` are in pixels of the picture; OpenCV's `border` is where the picture ends.
    """
    import cv2

    step = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) * side / size
    M = np.column_stack([step, middle - step @ [size / 2, size / 2]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    crop = cv2.warpAffine(picture, M, (size, size), flags=flags, borderMode=border)
    return crop.astype(np.float32), M


def refined(places: Array, maps: Array) -> Array:
    """Landmarks [px of the crop] at the mean of their map (cells, cells, landmarks; logits)."""
    from scipy.special import expit

    cells, half = len(maps), KERNEL // 2
    found = places.copy()
    for k, (x, y) in enumerate((places * cells / SIZES[1]).astype(int)):
        if not (0 <= x < cells and 0 <= y < cells):
            continue
        top, left = max(0, y - half), max(0, x - half)
        near = maps[top : y + half + 1, left : x + half + 1, k]
        likely = expit(near)
        if likely.max() >= LIKELY:
            at = np.array([likely.sum(0) @ np.arange(left, left + near.shape[1]),
                           likely.sum(1) @ np.arange(top, top + near.shape[0])])  # fmt: skip
            found[k] = at / likely.sum() * SIZES[1] / cells
    return found


LIMBS = (
    ((11, 13, 15), 0.045), ((12, 14, 16), 0.045), ((23, 25), 0.065), ((24, 26), 0.065),
    ((25, 27), 0.05), ((26, 28), 0.05), ((27, 29, 31), 0.04), ((28, 30, 32), 0.04),
    ((15, 19), 0.05), ((16, 20), 0.05), ((7, 0, 8), 0.085), ((11, 12, 24, 23, 11), 0.055),
)  # fmt: skip
"""Landmarks along limbs, and how far skin and clothes reach around them [of the height]."""
LOOSE = 1.25  # factor on that
BONES = ((11, 23, 0.3), (12, 24, 0.3), (23, 25, 0.245), (24, 26, 0.245), (25, 27, 0.246),
         (26, 28, 0.246))  # fmt: skip
"""Pairs of landmarks, and how far apart they are [of the height] (Drillis & Contini 1966)."""


def without_room(
    joints: Keypoints, clip: Clip, clean: Clean, furniture: Bool[Tensor, "h w"] | None
) -> Keypoints:
    """The landmarks without confidence where their frame shows the room as it is without people.

    A network takes the legs of a chair for those of the person in front of them, and is as sure
    as of any other. Where most of a person looks like the room, the room has a person in it. Of
    hidden pixels nothing is known, unless there is an outline of furniture.
    """
    import cv2

    known = ~clean.hidden if furniture is None else ~clean.hidden | furniture
    confidence = joints.confidence.clone()
    for frame in joints.frame.unique().tolist():
        picture = torch.from_numpy(read_picture(clip.path(frame))).float() / 255
        off = picture - clean.picture
        off = (off - off.flatten(0, 1).median(0).values).abs()  # the light may change
        same = (off.amax(-1) < NOISE * off.median().clamp_min(1 / 255)) & known
        for row in (joints.frame == frame).nonzero()[:, 0].tolist():
            points = joints.points[row]
            reach = max(2, round(PATCH * float((points.amax(0) - points.amin(0)).amax())))
            share = cv2.blur(same.float().numpy(), (2 * reach + 1, 2 * reach + 1))
            inside = (points >= 0) & (points < torch.tensor([clip.width, clip.height]))
            empty = inside.all(-1)
            x, y = points[empty].long().unbind(-1)
            empty[empty.clone()] = torch.from_numpy(share)[y, x] > EMPTY
            if 2 * int(empty.sum()) < len(points):
                confidence[row, empty] = 0
    return replace(joints, confidence=confidence)


def without_furniture(tracks: People, joints: Keypoints, furniture: Bool[Tensor, "h w"]) -> People:
    """The masks without what they swallow of the furniture: all of it that no limb is near to."""
    import cv2

    kept = list[bytes]()
    seen = joints.confidence > 0
    for row, points in enumerate(joints.points.double().numpy()):
        tall = max(np.linalg.norm(points[a] - points[b]) / share for a, b, share in BONES)
        near = np.zeros(furniture.shape, np.uint8)
        for limb, reach in LIMBS:
            chain = [k for k in limb if seen[row, k]]
            if len(chain) < 2:
                continue
            line = points[chain].round().astype(np.int32)[None]
            width = max(1, round(2 * LOOSE * reach * tall))
            cv2.polylines(near, line, isClosed=False, color=1, thickness=width)
            if chain[0] == chain[-1]:
                cv2.fillPoly(near, line, 1)
        mask = decode(tracks.masks, row)
        less = mask & ~(furniture & ~torch.from_numpy(near).bool())
        kept.append(encode(less if bool(less.any()) else mask))
    return replace(tracks, masks=replace(tracks.masks, counts=tuple(kept)))


@lru_cache(maxsize=4)
def loaded(path: str) -> Runs:
    """A network of TensorFlow Lite, on one thread.

    Raises:
        InputError: If ai-edge-litert is missing, or it cannot read the file.
    """
    try:
        library: Any = import_module("ai_edge_litert.interpreter")
    except ImportError as error:
        raise InputError(f"MediaPipe's networks need LiteRT: {install('mediapipe')}") from error
    try:
        net = library.Interpreter(model_path=path, num_threads=1)
        net.allocate_tensors()
    except (ValueError, RuntimeError) as error:
        raise InputError(f"{Path(path).name}: cannot be read ({error})") from error
    outputs: Sequence[dict[str, Any]] = net.get_output_details()

    def run(picture: Array) -> dict[tuple[int, ...], Array]:
        net.set_tensor(net.get_input_details()[0]["index"], picture[None].astype(np.float32))
        net.invoke()
        return {tuple(o["shape"].tolist()): net.get_tensor(o["index"]) for o in outputs}

    return run
