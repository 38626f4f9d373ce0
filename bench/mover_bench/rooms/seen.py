"""A known room as a video, and what networks of today would find in it.

Nothing is learnt here: masks and joints are the truth with the errors of detectors, so that the
way from a video to a room can be judged where no weights are. People's and objects' masks are as in
`NoiseConfig`. Joints are those of another body: where a network has been taught to see hips, knees
and shoulders is lastingly beside the joints of the model, mirrored on both sides, and somewhat
different for each person. Measured on a seated man 320 px tall (three networks): 1.1 to
1.6 px are new in each frame, at least 1.8 px last. Limbs that furniture hides are guessed, for
seconds in the same wrong place, by some networks with full confidence.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.keypoints import LAYOUTS, SIDES, keypoints_of
from mover.bodies.skinning import open_body
from mover.core.observe import Observer, silent
from mover.core.types import Camera, Capture, Keypoints, Masks, People
from mover.geometry.camera import at_pixels, project
from mover.geometry.rle import decode
from mover.perceive.capture import Finders
from mover.perceive.config import ModelsConfig, PerceiveConfig
from mover.perceive.networks import PERSON, Finds, JointsInputs
from mover.perceive.video import Clip
from mover_bench.rooms.known import KnownRoom
from mover_bench.rooms.noise import slow

COCO = {
    "bed": "bed", "sofa": "couch", "armchair": "chair", "chair": "chair", "office chair": "chair",
    "stool": "chair", "bench": "bench", "table": "dining table", "desk": "dining table",
    "coffee table": "dining table",
}  # fmt: skip
"""What COCO's classes call furniture; it has no shelves, cabinets or lamps."""
STATURE = 1.7  # [m], the unit of the errors below
NEW = (0.0035, 0.005)  # of a stature, new in each frame and axis; drawn for each person
LASTING = 0.008  # of a stature and axis of the body, mirrored on both sides
OWN = 0.004  # the same of each joint by itself
GUESSED = (0.04, 1.5)  # of a stature, of hidden limbs, and for how long they are wrong [s]
HARDER = {"knee": 1.3, "ankle": 1.6, "wrist": 1.3, "elbow": 1.1}  # factors of joints
MISSED, SWAPPED = 0.05, 0.01
HIDDEN = (0.4, 1.0)  # factor on the confidence of a guess, drawn for each person


@dataclass(frozen=True)
class Seen:
    """A known room with what is found in it."""

    room: KnownRoom
    noisy: Capture  #: its masks are the networks' (`add_noise`)
    seed: int

    def finders(self) -> Finders:
        """What stands for the networks."""
        return Finders(self.instances, self.joints)

    def frames_of(self, clip: Clip) -> list[int]:
        """The room's frame that each frame of the clip shows."""
        fps = self.room.bodies.fps or 1.0
        return [round(float(t) * fps) for t in clip.time]

    def instances(self, clip: Clip, _config: PerceiveConfig, _observe: Observer = silent) -> Finds:
        """Furniture in the clean picture, people in frames."""
        if clip.fps is None:
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
        people, of_room = self.noisy.people, self.frames_of(clip)
        assert people is not None
        pairs = [(k, int(r)) for k, f in enumerate(of_room) for r in (people.frame == f).nonzero()]
        masks = replace(people.masks, counts=tuple(people.masks.counts[r] for _, r in pairs))
        frame = torch.tensor([k for k, _ in pairs], dtype=torch.long)
        return Finds(masks, frame, (PERSON,) * len(pairs), torch.full((len(pairs),), 0.95))

    def joints(
        self, inputs: JointsInputs, _config: ModelsConfig, _observe: Observer = silent
    ) -> Keypoints:
        """COCO's 17 joints of all people whose masks are known."""
        tracks, frames = inputs.tracks, self.frames_of(inputs.clip)
        which = self._bodies(tracks, frames)
        bodies, camera = self.room.bodies, self.room.truth.camera
        assert bodies.joints is not None
        points = keypoints_of(open_body(), bodies.verts[which], bodies.joints[which], "coco17")
        masks = [decode(tracks.masks, row) for row in range(len(tracks.frame))]
        rng = np.random.default_rng([self.seed, 17])
        exact = project(points, camera.K)
        seen = [at_pixels(m, xy.floor().long()) for m, xy in zip(masks, exact, strict=True)]
        inside = torch.stack([shown & there for shown, there in seen])
        when = tracks.frame.numpy(), tracks.person.numpy()
        seconds = slow(rng, when, (17, 2), (inputs.clip.fps or 1.0) * GUESSED[1])
        pixels, sure = spoilt(points, inside, camera, tracks.person, seconds, rng)
        return Keypoints(
            points=pixels, confidence=sure, layout="coco17",
            frame=tracks.frame, person=tracks.person, fps=inputs.clip.fps,
        )  # fmt: skip

    def _bodies(self, tracks: People, frames: list[int]) -> Int[Tensor, " rows"]:
        """The true body of each row of the tracks, which are numbered as people appear."""
        bodies, people = self.room.bodies, self.noisy.people
        assert people is not None
        keys = list(zip(bodies.frame.tolist(), bodies.person.tolist(), strict=True))
        rows = zip(people.frame.tolist(), people.masks.counts, people.person.tolist(), strict=True)
        known = {(frame, code): person for frame, code, person in rows}
        rows = zip(tracks.frame.tolist(), tracks.masks.counts, strict=True)
        return torch.tensor([keys.index((frames[k], known[frames[k], code])) for k, code in rows])


def spoilt(
    points: Float[Tensor, "rows 17 3"],
    inside: Bool[Tensor, "rows 17"],
    camera: Camera,
    person: Int[Tensor, " rows"],
    wrong: Float[np.ndarray, "rows 17 2"],
    rng: np.random.Generator,
) -> tuple[Float[Tensor, "rows 17 2"], Float[Tensor, "rows 17"]]:
    """Joints (in camera axes [m]) with a detector's errors [px], and its confidence in them.

    Joints that are not `inside` are guessed, with errors `wrong` [standard deviations].
    """
    names = LAYOUTS["coco17"]
    left, right = (
        torch.tensor([k for k, name in enumerate(names) if side in name]) for side in SIDES
    )
    harder = np.array([HARDER.get(name.split("_")[-1], 1.0) for name in names])[:, None]
    mirrored = rng.normal(size=(17, 3)) * LASTING
    mirrored[right] = mirrored[left] * [-1, 1, 1]
    own = rng.normal(size=(int(person.max()) + 1, 17, 3)) * OWN
    fresh = rng.uniform(*NEW, len(own))
    sureness = rng.choice(HIDDEN, len(own))
    who = person.numpy()
    offset = torch.from_numpy(STATURE * harder * (mirrored + own[who])).to(points)
    pixels = project(points + offset @ _attitude(points).mT, camera.K).double().numpy()
    unit = STATURE * camera.K[0, 0] / points[..., 2].mean(-1)  # [px] of the person in each row
    unit = unit.double().numpy()[:, None, None]
    noise = fresh[who][:, None, None] * harder * rng.normal(size=pixels.shape)
    guess = GUESSED[0] * np.where(inside.numpy()[..., None], 0.0, wrong)
    moved = pixels + unit * (noise + guess)
    for one, other in zip(left.tolist(), right.tolist(), strict=True):
        swap = rng.uniform(size=len(moved)) < SWAPPED
        moved[swap, one], moved[swap, other] = moved[swap, other], moved[swap, one].copy()
    found = rng.uniform(size=moved.shape[:2]) >= MISSED
    sure = np.where(found, rng.uniform(0.6, 1.0, found.shape), 0.0)
    sure = np.where(inside.numpy(), sure, sureness[who][:, None] * sure)
    return torch.from_numpy(moved).float(), torch.from_numpy(sure).float()


def _attitude(points: Float[Tensor, "rows 17 3"]) -> Float[Tensor, "rows 3 3"]:
    """Axes of trunks, as columns: to the left, along the spine, to the front."""
    at = {name: points[:, k] for k, name in enumerate(LAYOUTS["coco17"])}
    shoulders = (at["left_shoulder"] + at["right_shoulder"]) / 2
    spine = shoulders - (at["left_hip"] + at["right_hip"]) / 2
    across = at["left_hip"] - at["right_hip"]
    spine = torch.nn.functional.normalize(spine, dim=-1)
    front = torch.nn.functional.normalize(torch.linalg.cross(across, spine), dim=-1)
    return torch.stack([torch.linalg.cross(spine, front), spine, front], -1)
