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
from jaxtyping import Int
from torch import Tensor

from mover.bodies.keypoints import LAYOUTS, keypoints_of
from mover.bodies.skinning import open_body
from mover.core.observe import Observer, silent
from mover.core.types import Capture, Keypoints, Masks
from mover.geometry.camera import project
from mover.geometry.rle import decode
from mover.perceive.capture import Finders
from mover.perceive.config import ModelsConfig, PerceiveConfig
from mover.perceive.networks import PERSON, DetectInputs, Finds, JointsInputs, Tracks
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
        return Finders(self.instances, self.joints)

    def frames_of(self, clip: Clip) -> list[int]:
        """The room's frame that each frame of the clip shows."""
        fps = self.room.bodies.fps or 1.0
        return [round(float(t) * fps) for t in clip.time]

    def instances(
        self, inputs: DetectInputs, _config: PerceiveConfig, _observe: Observer = silent
    ) -> Finds:
        """Furniture in the clean picture, people in frames."""
        if inputs.clip.fps is None:
            found = [
                (d.mask.counts[0], COCO[d.category])
                for d in self.noisy.detections
                if d.category in COCO and d.mask is not None
            ]
            camera = self.noisy.scene.camera
            masks = Masks(camera.height, camera.width, tuple(code for code, _ in found))
            frame = torch.zeros(len(found), dtype=torch.long)
            names = tuple(name for _, name in found)
            return Finds(masks, frame, names, torch.linspace(0.99, 0.9, len(found)))
        people, of_room = self.noisy.people, self.frames_of(inputs.clip)
        assert people is not None
        pairs = [(k, int(r)) for k in inputs.frames for r in (people.frame == of_room[k]).nonzero()]
        masks = replace(people.masks, counts=tuple(people.masks.counts[r] for _, r in pairs))
        frame = torch.tensor([k for k, _ in pairs], dtype=torch.long)
        return Finds(masks, frame, (PERSON,) * len(pairs), torch.full((len(pairs),), 0.95))

    def joints(
        self, inputs: JointsInputs, _config: ModelsConfig, _observe: Observer = silent
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
        """The true body of each row of the tracks, which are numbered as people appear."""
        bodies, people = self.room.bodies, self.noisy.people
        assert people is not None
        keys = list(zip(bodies.frame.tolist(), bodies.person.tolist(), strict=True))
        rows = zip(people.frame.tolist(), people.masks.counts, people.person.tolist(), strict=True)
        known = {(frame, code): person for frame, code, person in rows}
        rows = zip(tracks.frame.tolist(), tracks.masks.counts, strict=True)
        return torch.tensor([keys.index((frames[k], known[frames[k], code])) for k, code in rows])


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
