"""One picture of the exports that are tables of numbers, and of PLY, each drawn from its own file.

Needs `mover export OUT --to ply bodies amass gmr holosoma contacts --capture CAPTURE`, then
`python benchmarks/exports_people.py OUT --to exports_people.jpg`. The files are read by numpy and
trimesh alone. What has SMPL-X's angles poses the package's own body, so that its shape is not
SMPL-X's: places, height and posture are the file's. Nobody else's program is run.
"""

import argparse
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from exports import GREY, SKIN, Picture, Shape, drawn, to_world
from numpy.typing import NDArray
from PIL import Image

from mover.app.pictures.film import captioned
from mover.bodies.skinning import open_body, zero_pose
from mover.core.colours import colour
from mover.core.types import BodyPose, Scene
from mover.io.capture.scene_file import read_scene
from mover.io.export.humanoid import HEIGHT_STEP, MEAN_HEIGHT, MOCAP_STEPS, PELVIS, RATE
from mover.io.export.solids import floor_height

STEPS = (0.0, 0.45, 0.9)  # moments that are drawn, as shares of the span around the frame
SPAN = 8.0  # [s]
SURE = 0.5  # confidence of contacts that are drawn
BALL, STICK = 0.025, 0.09  # [m]
Arrays = dict[str, NDArray[Any]]


def main() -> None:
    """Write the page of pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="folder of the result")
    parser.add_argument("--to", type=Path, default=Path("exports_people.jpg"), help="the picture")
    parser.add_argument("--frame", type=int, default=0, help="the first of those that are drawn")
    args = parser.parse_args()
    scene, home = read_scene(args.out / "scene.json"), args.out / "export"
    pieces = list(of_ply(home / "objects", scene))
    pale = [Shape(p.verts, p.faces, 0.55 + 0.4 * p.tint) for p in pieces]
    start = (args.frame - int(read(home / "bodies_0.npz")["frame"][0])) / rate_of(home)
    times = [start + share * SPAN for share in STEPS]
    floor = floor_height(scene)
    shapes: dict[str, list[Shape]] = {
        "PLY, by trimesh": pieces,
        "bodies: all parameters, in place": [*pale, *of_bodies(home, times)],
        "AMASS: SMPL-X's angles on our body": [
            *pale, *of_smplx(home / "amass" / "person_0_stageii.npz", times, floor)
        ],
        "GMR: SMPL-X's angles on our body": [
            *pale, *of_smplx(home / "gmr" / "person_0.npz", times, floor)
        ],
        "Holosoma's climb: pieces, 53 joints": [*of_climb(home / "holosoma", times, floor)],
        "contacts: place and normal, all frames": [*pale, *of_contacts(home / "contacts_0.npz")],
    }  # fmt: skip
    pictures: list[Picture] = [captioned(drawn(found, scene), n) for n, found in shapes.items()]
    rows = [torch.cat(pictures[k : k + 3], 1) for k in (0, 3)]
    page = (torch.cat(rows, 0) * 255).round().to(torch.uint8).numpy()
    Image.fromarray(page).save(args.to, quality=88)


def read(file: Path) -> Arrays:
    """All arrays of a file, as numpy reads them."""
    with np.load(file, allow_pickle=False) as found:
        return {name: found[name] for name in found.files}


def rate_of(home: Path) -> float:
    """Frames of the video a second."""
    return float(read(home / "contacts_0.npz")["fps"])


def of_ply(home: Path, scene: Scene) -> Iterator[Shape]:
    """Each piece as its own file has it, in the world."""
    for index, piece in enumerate(scene.objects):
        mesh: Any = trimesh.load_mesh(home / f"{piece.id}.ply")
        yield Shape(mesh.vertices, mesh.faces, np.array(colour(index)))


def of_bodies(home: Path, times: Sequence[float]) -> Iterator[Shape]:
    """The parameters of the body that the result has, which is the package's own."""
    found = read(home / "bodies_0.npz")
    rate = float(found["mocap_frame_rate"])
    for time in times:
        row = min(round(time * rate), len(found["trans"]) - 1)
        pose = posed(found, row, found["betas"])
        verts, _ = open_body().posed(pose)
        yield Shape(float(found["size"][row]) * verts[0].numpy(), faces(), np.array(SKIN))


def of_smplx(file: Path, times: Sequence[float], floor: float) -> Iterator[Shape]:
    """SMPL-X's angles, pelvis and height, by the body that is at hand; +z is up."""
    found, body = read(file), open_body()
    assert float(found["mocap_frame_rate"]) == RATE
    height = MEAN_HEIGHT + HEIGHT_STEP * float(found["betas"][0])
    tall = float(body.verts[:, 1].max() - body.verts[:, 1].min())
    for time in times:
        row = min(round(time * RATE), len(found["trans"]) - 1)
        verts, joints = body.posed(posed(found, row, None))
        pelvis = found["trans"][row] + np.array(PELVIS)
        places = (verts[0] - joints[0, 0]).numpy() * height / tall + pelvis
        yield Shape(to_world(places, floor), faces(), np.array(SKIN))


def posed(found: Arrays, row: int, betas: NDArray[Any] | None) -> BodyPose:
    """One row as a pose of the package's body."""
    zero = zero_pose(1, open_body())

    def of(values: NDArray[Any]) -> torch.Tensor:
        return torch.from_numpy(np.asarray(values, np.float32))[None]

    hands = found["poses"][row, 75:] if "poses" in found else np.zeros(90)
    return BodyPose(
        model=zero.model,
        gender=zero.gender,
        betas=zero.betas if betas is None else of(betas),
        global_orient=of(found["root_orient"][row]),
        body_pose=of(found["pose_body"][row]),
        transl=zero.transl if betas is None else of(found["trans"][row]),
        extra={"left_hand_pose": of(hands[:45]), "right_hand_pose": of(hands[45:])},
    )


def faces() -> NDArray[Any]:
    """Triangles of the package's body."""
    return open_body().faces.numpy()


def of_climb(home: Path, times: Sequence[float], floor: float) -> Iterator[Shape]:
    """Every convex piece of the terrain by itself, and the 53 joints at 120 a second."""
    clip = sorted(path for path in home.iterdir() if path.is_dir())[0]
    up = partial(to_world, floor=floor)
    boxes = sorted((clip / "box_models").glob("*.obj"))
    for k, file in enumerate(boxes):
        mesh: Any = trimesh.load_mesh(file)
        yield Shape(up(np.asarray(mesh.vertices)), mesh.faces, np.array(colour(k)))
    joints = np.load(clip / f"{clip.name}.npy", allow_pickle=False)
    for time in times:
        row = min(round(time * RATE * MOCAP_STEPS), len(joints) - 1)
        for place in joints[row]:
            yield ball(up(np.asarray(place, float)), 2 * BALL, SKIN)


def of_contacts(file: Path) -> Iterator[Shape]:
    """Where each part of the body touches each object, and the object's normal there."""
    found = read(file)
    for part in range(len(found["parts"])):
        sure = found["contact"][:, part] >= SURE
        rows = np.argwhere(sure)[:: max(1, int(sure.sum()) // 40)]
        for row, thing in rows:
            place, normal = (
                found[n][row, part, thing].astype(float) for n in ("position", "normal")
            )
            yield ball(place, BALL, colour(part))
            rod: Any = trimesh.creation.cylinder(
                BALL / 4, segment=np.stack([place, place + STICK * normal])
            )
            yield Shape(rod.vertices, rod.faces, np.array(GREY) / 2)


def ball(place: NDArray[Any], radius: float, tint: Sequence[float]) -> Shape:
    """A point that can be seen."""
    found = trimesh.creation.icosphere(1, radius)
    return Shape(np.asarray(found.vertices) + place, found.faces, np.array(tint))


if __name__ == "__main__":
    main()
