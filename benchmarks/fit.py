"""Bodies fitted to 2D joints alone: PYTHONPATH=src python benchmarks/fit.py --rooms 0 1 2.

Known rooms give the joints that OpenPose would see (BODY_25): noise of 3 px in an image 960 wide,
a tenth of the joints missing, none outside the image, and no legs while people sit. They are
written as OpenPose's JSON, read as a user's would be, and fitted. PJE is the mean distance of the
22 joints of the body from the truth: absolute, and with both pelvises laid on each other.

`--detected` takes the joints of `benchmarks/video.py` instead: COCO's 17 with 3 to 6 px of noise,
missed and swapped ones, guesses of hidden ones, and a camera whose tilt is 3 degrees off; the table
distinguishes postures, and heights. Without `--rooms` it takes 24 development rooms, in twelve of
which a person lies and in twelve of which a person is half hidden. `--height` gives the fit the
heights of the people.

`--second` measures the second pass: the first has a camera whose tilt is guessed (3 degrees off),
camera and floor are found from its feet, and all people are fitted again under them.
"""

import argparse
import dataclasses
import json
import os
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mover.bodies.parts import parts_of
from mover.bodies.skinning import open_body, shaped
from mover.core.types import Bodies, Camera, Keypoints
from mover.evaluate.bodies import procrustes
from mover.fitting.bodies import FitInputs, Fitted, fit_bodies
from mover.geometry.camera import pitch_roll, project
from mover.geometry.rle import decode
from mover.io.people.found import Known
from mover.io.people.keypoints import keypoints_from
from mover.perceive.config import JointsConfig
from mover.perceive.track import JointsInputs, Tracks
from mover.perceive.video import Clip
from mover.stages.camera.align_camera import AlignInputs, Alignment, align_camera
from mover.stages.camera.find_foot_contacts import FootContactInputs, find_foot_contacts
from mover.stages.people.select_frames import SelectInputs, select_frames
from mover_bench.rooms.config import NoiseConfig, RoomConfig
from mover_bench.rooms.known import KnownRoom
from mover_bench.rooms.noise import add_noise, hidden_rows
from mover_bench.rooms.render import see, see_body
from mover_bench.rooms.room import make_room
from mover_bench.rooms.seen import Seen, joints_seen

DETECTED = (*range(100, 110), 112, 114, 120, 122, 123, 124, 125, 126, 128, 130, 132, 133, 134, 136)
SEATED, LYING = ("sit", "lean"), ("lie", "lie down", "get up")


def triples_seen(room: KnownRoom, rng: np.random.Generator) -> np.ndarray:
    """Triples x, y, confidence of each body; zeros for what is not seen."""
    seated = torch.tensor([action in SEATED for action in room.actions])
    found = joints_seen(room.bodies, room.truth.camera, seated, rng)
    return torch.cat([found.points, found.confidence[..., None]], -1).double().numpy()


def write_openpose(room: KnownRoom, triples: np.ndarray, folder: Path) -> None:
    """A JSON file for each frame."""
    for frame in range(int(room.bodies.frame.max()) + 1):
        rows = torch.nonzero(room.bodies.frame == frame)[:, 0].tolist()
        people = [{"pose_keypoints_2d": triples[k].reshape(-1).tolist()} for k in rows]
        (folder / f"{frame:06d}_keypoints.json").write_text(json.dumps({"people": people}))


def errors(found: Fitted, room: KnownRoom) -> tuple[Tensor, Tensor, list[str]]:
    """Absolute and pelvis-aligned PJE of each body [m], and what it does."""
    where = {int(f): k for k, f in enumerate(room.bodies.frame.tolist())}
    rows = [where[f] for f in found.bodies.frame.tolist()]
    joints, truth = found.bodies.joints[:, :22], room.bodies.joints[rows][:, :22]
    off = joints - truth
    return (
        off.norm(dim=-1).mean(1),
        (off - off[:, :1]).norm(dim=-1).mean(1),
        [room.actions[k] for k in rows],
    )


def draw(room: KnownRoom, found: Fitted, path: Path) -> None:
    """Fitted bodies (red) over the true visible masks (green)."""
    from PIL import Image

    background, tiles = see(room.plan).picture * 0.6 + 0.3, []
    faces = found.bodies.faces
    for k in np.linspace(0, len(found.rows) - 1, 12).astype(int):
        picture, verts = background.clone(), found.bodies.verts[k]
        mask = decode(room.capture.people.masks, int(room.bodies.frame.tolist().index(
            int(found.bodies.frame[k]))))  # fmt: skip
        picture[mask] = 0.3 * picture[mask] + 0.7 * torch.tensor([0.1, 0.75, 0.2])
        _, face = see_body(room.plan, verts, faces)
        a, b, c = (verts[faces[:, i]] for i in range(3))
        normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
        shade = 0.35 + 0.65 * (-normal[:, 2]).clamp_min(0)
        red = shade[face.clamp_min(0)][..., None] * torch.tensor([0.95, 0.35, 0.25])
        picture[face >= 0] = (0.3 * picture + 0.7 * red)[face >= 0]
        tiles.append(picture[::2, ::2])
    rows = [torch.cat(tiles[i : i + 3], 1) for i in range(0, 12, 3)]
    Image.fromarray((torch.cat(rows).clamp(0, 1) * 255).byte().numpy()).save(path)


def keypoints_seen(room: KnownRoom, seed: int, fps: float) -> Keypoints:
    """The joints that a detector sees, read from its files."""
    with tempfile.TemporaryDirectory() as folder:
        write_openpose(room, triples_seen(room, np.random.default_rng(seed)), Path(folder))
        return keypoints_from("openpose", Path(folder), Known(fps=fps))


def aligned_by(bodies: Bodies, camera: Camera) -> Alignment:
    """Camera and floor from the feet of fitted bodies, as `mover run` finds them."""
    keep = select_frames(SelectInputs(bodies)).keep
    parts = parts_of(bodies, camera.R_cam_world[:, 1])
    soles = find_foot_contacts(FootContactInputs(bodies, parts, keep, camera))
    return align_camera(AlignInputs(soles, camera, None, None))


def second(seed: int, fps: float) -> None:
    """One room, fitted twice: the second time from keypoints alone, and from the first bodies."""
    room = make_room(seed, RoomConfig(fps=fps))
    keypoints = keypoints_seen(room, seed, fps)
    guess = add_noise(room, NoiseConfig(), seed + 1000).scene.camera
    inputs = FitInputs(keypoints, guess, open_body())
    first = fit_bodies(inputs)
    by = aligned_by(first.bodies, guess)
    tilts = (pitch_roll(c.R_cam_world) for c in (by.camera, room.truth.camera))
    off = [float(torch.rad2deg(a - b)) for a, b in zip(*tilts, strict=True)]
    floor = room.truth.ground or 0.0
    print(
        f"room {seed}: camera found {off[0]:+.1f}, {off[1]:+.1f} degrees off, floor "
        f"{1e3 * (by.ground - floor):+.0f} mm",
        flush=True,
    )
    again = dataclasses.replace(inputs, camera=by.camera, ground=by.ground)
    rows = {
        "first pass": first,
        "second, keypoints alone": fit_bodies(again),
        "second, first bodies": fit_bodies(dataclasses.replace(again, start=first.bodies)),
    }
    for name, found in rows.items():
        absolute, aligned, actions = errors(found, room)
        print(f"  {name:24} {means(absolute, aligned, actions)}", flush=True)


def means(absolute: Tensor, aligned: Tensor, actions: list[str]) -> str:
    """Means and medians of all, and the means of seated and lying people [mm]."""
    groups = [
        f"PJE {1e3 * aligned.mean():.0f} mm aligned (median {1e3 * aligned.median():.0f}), "
        f"{1e3 * absolute.mean():.0f} mm absolute (median {1e3 * absolute.median():.0f})"
    ]
    for name, some in (("seated", SEATED), ("lying", LYING)):
        mine = torch.tensor([a in some for a in actions])
        if mine.any():
            groups.append(
                f"{name} {1e3 * aligned[mine].mean():.0f}/{1e3 * absolute[mine].mean():.0f}"
            )
    return "; ".join(groups)


def measure(seed: int, fps: float, ground: bool, picture: Path | None) -> str:
    """One row of the table."""
    room = make_room(seed, RoomConfig(fps=fps))
    keypoints = keypoints_seen(room, seed, fps)
    floor = room.truth.ground if ground else None
    inputs = FitInputs(keypoints, room.truth.camera, open_body(), ground=floor)
    wall, processor = time.perf_counter(), time.process_time()
    found = fit_bodies(inputs)
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    absolute, aligned, actions = errors(found, room)
    if picture is not None:
        draw(room, found, picture / f"fit_{seed}.png")
    n = len(absolute)
    return (
        f"room {seed}, {fps:g} fps{', floor known' if ground else ''}: {n} bodies, "
        f"{means(absolute, aligned, actions)}; {n / wall:.0f} frames/s by the clock, "
        f"{n / processor:.0f} by the processor, load {os.getloadavg()[0]:.1f}"
    )


def detected(room: KnownRoom, seed: int, fps: float) -> tuple[Keypoints, Camera]:
    """COCO's joints as `mover video` gets them in the benchmark, and the camera that it guesses."""
    noisy = add_noise(room, NoiseConfig(), seed)
    people, camera = noisy.people, noisy.scene.camera
    assert people is not None, "a known room has masks"
    count = int(people.frame.max()) + 1
    clip = Clip("", camera.width, camera.height, torch.arange(count) / fps, fps)
    seen = Seen(room, noisy, seed)
    tracks = Tracks(people.masks, people.frame, people.person, seen.people)
    return seen.joints(JointsInputs(clip, tracks), JointsConfig()), camera


def postures(room: KnownRoom, rows: list[int]) -> dict[str, list[int]]:
    """Which of some bodies do what, and of which less is seen."""
    camera, bodies = room.truth.camera, room.bodies
    assert bodies.joints is not None
    flat = project(bodies.joints[:, :22], camera.K)
    size = torch.tensor([camera.width, camera.height])
    cut = ((flat < 0) | (flat > size)).any(-1).any(-1)
    actions = [room.actions[k] for k in rows]
    hidden = hidden_rows(room)
    still = (*SEATED, *LYING)
    return {
        "all": list(range(len(rows))),
        "upright": [k for k, a in enumerate(actions) if a not in still],
        "seated": [k for k, a in enumerate(actions) if a in SEATED],
        "lying": [k for k, a in enumerate(actions) if a in LYING],
        "half hidden": [k for k, row in enumerate(rows) if hidden[row]],
        "cut": [k for k, row in enumerate(rows) if cut[row]],
    }


def stature(room: KnownRoom) -> tuple[float, ...]:
    """How tall the people are [m]."""
    assert room.bodies.pose is not None
    people = room.bodies.person.unique()
    first = [int((room.bodies.person == one).nonzero()[0, 0]) for one in people]
    y = shaped(open_body(), room.bodies.pose.betas[first].float())[0][..., 1]
    return tuple((y.amax(-1) - y.amin(-1)).tolist())


def too_tall(found: Fitted, heights: tuple[float, ...]) -> Tensor:
    """How much taller than they are people were fitted [%]."""
    assert found.bodies.pose is not None
    people = found.bodies.person
    first = [int((people == one).nonzero()[0, 0]) for one in people.unique()]
    y = shaped(open_body(), found.bodies.pose.betas[first].float())[0][..., 1]
    return 100 * ((y.amax(-1) - y.amin(-1)) / torch.tensor(heights) - 1)


def misses(joints: Tensor, truth: Tensor) -> Tensor:
    """PJE of each body, absolute and after Procrustes [m]."""
    joints, truth = joints[:, :22].double(), truth[:, :22].double()
    pairs = [(some - truth).norm(dim=-1).mean(1) for some in (joints, procrustes(joints, truth))]
    return torch.stack(pairs, -1)


def by_posture(seed: int, fps: float, tall: bool) -> tuple[dict[str, Tensor], Tensor]:
    """Absolute and Procrustes-aligned PJE of bodies by posture [mm], and errors of heights [%]."""
    room = make_room(seed, RoomConfig(fps=fps))
    keypoints, camera = detected(room, seed, fps)
    heights = stature(room)
    inputs = FitInputs(keypoints, camera, open_body(), heights=heights if tall else ())
    found = fit_bodies(inputs)
    where = {int(f): k for k, f in enumerate(room.bodies.frame.tolist())}
    rows = [where[f] for f in found.bodies.frame.tolist()]
    assert found.bodies.joints is not None
    assert room.bodies.joints is not None
    pairs = misses(found.bodies.joints, room.bodies.joints[rows])
    found = {name: 1e3 * pairs[which] for name, which in postures(room, rows).items() if which}
    means = ", ".join(
        f"{n} {len(v)}: {v[:, 0].mean():.0f} / {v[:, 1].mean():.0f}" for n, v in found.items()
    )
    off = too_tall(found, heights)
    print(f"room {seed}: {means}, height {off.mean():+.1f} %", flush=True)
    return found, off


def table(seeds: list[int], fps: float, tall: bool) -> None:
    """Postures over rooms, PJE absolute / after Procrustes: means of bodies, and of rooms."""
    every = [by_posture(seed, fps, tall) for seed in seeds]
    rooms, off = [room for room, _ in every], torch.cat([some for _, some in every])
    print(f"heights: {off.mean():+.1f} % in the mean, {off.square().mean().sqrt():.1f} % rms")
    for name in dict.fromkeys(name for room in rooms for name in room):
        each = [room[name] for room in rooms if name in room]
        rows = [torch.cat(each), torch.stack([room.mean(0) for room in each])]
        body, equal = (f"{a:.0f} / {p:.0f}" for a, p in (row.mean(0).tolist() for row in rows))
        head = f"{name}: {len(rows[0])} bodies of {len(each)} rooms"
        print(f"{head}, {body} mm; rooms weighted equally {equal}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", type=int, nargs="+")
    parser.add_argument("--fps", type=float, default=5.0)
    parser.add_argument("--ground", action="store_true", help="give the fit the true floor")
    parser.add_argument("--second", action="store_true", help="measure the second pass")
    parser.add_argument("--detected", action="store_true", help="a detector's joints, by posture")
    parser.add_argument(
        "--height", action="store_true", help="give the fit the heights of the people"
    )
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the fits")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.detected:
        table(args.rooms or list(DETECTED), args.fps, args.height)
        return
    for seed in args.rooms or (0, 1):
        if args.second:
            second(seed, args.fps)
        else:
            print(measure(seed, args.fps, args.ground, args.pictures), flush=True)


if __name__ == "__main__":
    main()
