"""A known room as a video, and what networks of today would find in it.

Nothing is learnt here: masks and joints are the truth with the errors of detectors, so that the
way from a video to a room can be judged where no weights are. Sources of the errors: people's and
objects' masks as in `NoiseConfig`; joints of COCO's 17 miss by 3 to 6 px on people 400 px tall
(ViTPose: 75 to 79 AP, OKS sigmas of the COCO benchmark), every twentieth visible joint is missed,
every hundredth pair of left and right is swapped.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from mover.bodies.keypoints import LAYOUTS, keypoints_of
from mover.bodies.skinning import open_body
from mover.core.observe import Observer, silent
from mover.core.types import Bodies, Camera, Capture, Keypoints, Masks
from mover.geometry.camera import project
from mover.geometry.rle import decode
from mover.perceive.capture import Finders
from mover.perceive.config import DetectConfig, JointsConfig, TrackConfig
from mover.perceive.detect import PERSON, DetectInputs, Finds
from mover.perceive.track import JointsInputs, SegmentInputs, Tracks
from mover.perceive.video import Clip
from mover_bench.rooms.known import KnownRoom
from mover_bench.rooms.room import draw_frame

COCO = {
    "bed": "bed", "sofa": "couch", "armchair": "chair", "chair": "chair", "office chair": "chair",
    "stool": "chair", "bench": "bench", "table": "dining table", "desk": "dining table",
    "coffee table": "dining table",
}  # fmt: skip
"""What COCO's classes call furniture; it has no shelves, cabinets or lamps."""
JOINT_NOISE = (3.0, 6.0)  # [px], drawn for each person
MISSED, SWAPPED = 0.05, 0.01
HIDDEN = 0.4  # confidence of a joint that furniture hides: detectors guess those


@dataclass(frozen=True)
class Seen:
    """A known room with what is found in it."""

    room: KnownRoom
    noisy: Capture
    """Its masks are the networks' (`add_noise`)."""
    seed: int

    def finders(self) -> Finders:
        """What stands for the networks."""
        return Finders(self.instances, self.tracks, self.joints)

    def frames_of(self, clip: Clip) -> list[int]:
        """The room's frame that each frame of the clip shows."""
        fps = self.room.bodies.fps or 1.0
        return [round(float(t) * fps) for t in clip.time]

    def instances(
        self, inputs: DetectInputs, _config: DetectConfig, _observe: Observer = silent
    ) -> Finds:
        """Furniture in the clean picture, people in frames."""
        if inputs.clip.fps is None:
            return self._furniture()
        frames = self.frames_of(inputs.clip)
        return self._people([(k, frames[k]) for k in inputs.frames])

    def _furniture(self) -> Finds:
        found = [
            (d.mask, COCO[d.category])
            for d in self.noisy.detections
            if d.category in COCO and d.mask is not None
        ]
        height, width = self.noisy.scene.camera.height, self.noisy.scene.camera.width
        return Finds(
            Masks(height, width, tuple(mask.counts[0] for mask, _ in found)),
            torch.zeros(len(found), dtype=torch.long),
            tuple(name for _, name in found),
            torch.linspace(0.99, 0.9, len(found)),
        )

    def _people(self, frames: list[tuple[int, int]]) -> Finds:
        rows = [(k, row) for k, frame in frames for row in self._rows(frame)]
        masks = self._masks([row for _, row in rows])
        frame = torch.tensor([k for k, _ in rows], dtype=torch.long)
        return Finds(masks, frame, (PERSON,) * len(rows), torch.full((len(rows),), 0.95))

    def tracks(
        self, inputs: SegmentInputs, _config: TrackConfig, _observe: Observer = silent
    ) -> Tracks:
        """Everybody through a segment, under their true numbers."""
        frames = self.frames_of(inputs.clip)
        segment = range(inputs.first, inputs.last + 1)
        rows = [(k, row) for k in segment for row in self._rows(frames[k])]
        people = self.noisy.people
        assert people is not None
        person = people.person[[row for _, row in rows]]
        frame = torch.tensor([k for k, _ in rows], dtype=torch.long)
        return Tracks(self._masks([row for _, row in rows]), frame, person, self.people)

    @property
    def people(self) -> int:
        """How many there are."""
        return int(self.room.bodies.person.max()) + 1

    def _rows(self, frame: int) -> list[int]:
        """Rows of the masks of a frame of the room."""
        people = self.noisy.people
        return [] if people is None else (people.frame == frame).nonzero()[:, 0].tolist()

    def _masks(self, rows: list[int]) -> Masks:
        people = self.noisy.people
        assert people is not None
        return replace(people.masks, counts=tuple(people.masks.counts[row] for row in rows))

    def joints(
        self, inputs: JointsInputs, _config: JointsConfig, _observe: Observer = silent
    ) -> Keypoints:
        """COCO's 17 joints of everybody whose mask is known."""
        tracks, frames = inputs.tracks, self.frames_of(inputs.clip)
        which = self._bodies(tracks, frames)
        bodies, camera = self.room.bodies, self.room.truth.camera
        assert bodies.joints is not None
        points = keypoints_of(open_body(), bodies.verts[which], bodies.joints[which], "coco17")
        pixels, sure = spoilt(
            project(points, camera.K), tracks.person, np.random.default_rng([self.seed, 17])
        )
        masks = [decode(tracks.masks, row) for row in range(len(tracks.frame))]
        inside = torch.stack([_near(mask, xy) for mask, xy in zip(masks, pixels, strict=True)])
        return Keypoints(
            points=pixels, confidence=torch.where(inside, sure, HIDDEN * sure), layout="coco17",
            frame=tracks.frame, person=tracks.person, fps=inputs.clip.fps,
        )  # fmt: skip

    def _bodies(self, tracks: Tracks, frames: list[int]) -> Int[Tensor, " rows"]:
        """The true body of each row of the tracks."""
        bodies = self.room.bodies
        keys = list(zip(bodies.frame.tolist(), bodies.person.tolist(), strict=True))
        pairs = zip(tracks.frame.tolist(), tracks.person.tolist(), strict=True)
        return torch.tensor([keys.index((frames[k], person)) for k, person in pairs])


def spoilt(
    pixels: Tensor, person: Int[Tensor, " rows"], rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Joints with a detector's errors [px], and its confidence in them."""
    width = {p: rng.uniform(*JOINT_NOISE) for p in person.unique().tolist()}
    sigma = np.array([width[p] for p in person.tolist()])[:, None, None]
    moved = pixels.double().numpy() + sigma * rng.normal(size=pixels.shape)
    names = LAYOUTS["coco17"]
    lefts = [(k, n) for k, n in enumerate(names) if "left" in n]
    for left, right in ((k, names.index(n.replace("left", "right"))) for k, n in lefts):
        swap = rng.uniform(size=len(moved)) < SWAPPED
        moved[swap, left], moved[swap, right] = moved[swap, right], moved[swap, left].copy()
    seen = rng.uniform(size=moved.shape[:2]) >= MISSED
    sure = np.where(seen, rng.uniform(0.6, 1.0, seen.shape), 0.0)
    return torch.from_numpy(moved).float(), torch.from_numpy(sure).float()


def _near(mask: Tensor, points: Tensor) -> Tensor:
    """Which points lie in a mask."""
    h, w = mask.shape
    x, y = (points[:, i].floor().long() for i in (0, 1))
    there = (x >= 0) & (x < w) & (y >= 0) & (y < h)
    return there & mask[y.clamp(0, h - 1), x.clamp(0, w - 1)]


def write_video(room: KnownRoom, path: Path) -> None:
    """The room as an MP4, drawn frame by frame."""
    from mover.app.pictures.film import save_film

    frames = int(room.bodies.frame.max()) + 1
    save_film((draw_frame(room, k) for k in range(frames)), room.bodies.fps or 5.0, path)


# What OpenPose would see, with legs that furniture hides.


LAYOUT = "openpose25"
LEGS = ("knee", "ankle", "toe", "heel")
NOISE = 3.0  # [px], standard deviation, of an image 960 wide
MISSING = 0.1  # share of the joints


def joints_seen(
    bodies: Bodies, camera: Camera, seated: Bool[Tensor, " bodies"], rng: np.random.Generator
) -> Keypoints:
    """Joints with noise, some missing, none outside of the image, and no legs of seated people.

    The true people are in the axes of the true camera.
    """
    assert bodies.joints is not None, "the open body has joints"
    points = keypoints_of(open_body(), bodies.verts, bodies.joints, LAYOUT)
    pixels = project(points, camera.K).double().numpy()
    seen = rng.uniform(size=pixels.shape[:2]) >= MISSING
    pixels = pixels + NOISE * rng.normal(size=pixels.shape)
    seen &= ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(-1)
    legs = np.array([any(part in name for part in LEGS) for name in LAYOUTS[LAYOUT]])
    seen &= ~(legs & seated.numpy()[:, None])
    sure = np.where(seen, rng.uniform(0.5, 1.0, seen.shape), 0.0)
    return Keypoints(
        torch.from_numpy(pixels * seen[..., None]).float(), torch.from_numpy(sure).float(), LAYOUT,
        bodies.frame, bodies.person, bodies.fps,
    )  # fmt: skip
