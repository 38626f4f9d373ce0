"""Read i3DB: real people among real furniture, modelled by hand (Monszpart et al. 2019, iMapper).

Layout as in the repository amonszpart/iMapper: `intrinsics.json`; `skel_NAME_2d_00.json`, a real
network's joints in pixels of an image 368 rows high; `gt/skel_NAME_GT_objects`, a file
NN_CATEGORY_PART.json for each part of the furniture, oriented boxes in camera axes [m] (`axes` in
columns, `scales` full edges); `iMapper/skel_output_objects`, what the published method placed.
Frames count from 1, ten a second; in some scenes only even ones were annotated, so even ones are
taken of all. The videos are not there: masks are the drawn parts (the paper's protocol "2D GT").
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.errors import InputError
from mover.core.types import Camera, Detection, Keypoints, Masks, Mesh, Scene, SceneObject
from mover.geometry.camera import tilted
from mover.geometry.mesh import bottom_center
from mover.geometry.raster import first_hit
from mover.geometry.rle import encode, tight_box
from mover.geometry.rotations import rot_y
from mover.io.files.fields import read_json
from mover_bench.datasets.true_boxes import FACES, SIGNS

WIDTH, HEIGHT, ROWS, FPS = 1920, 1080, 368, 5.0
JOINTS = (
    "RANK", "RKNE", "RHIP", "LHIP", "LKNE", "LANK", "PELV", "THRX", "NECK", "HEAD", "RWRI", "RELB",
    "RSHO", "LSHO", "LELB", "LWRI",
)  # fmt: skip
HALPE = {
    "HEAD": 17, "THRX": 18, "LSHO": 5, "RSHO": 6, "LELB": 7, "RELB": 8, "LWRI": 9, "RWRI": 10,
    "LHIP": 11, "RHIP": 12, "LKNE": 13, "RKNE": 14, "LANK": 15, "RANK": 16,
}  # fmt: skip
"""Its joints in Halpe-26; PELV and NECK are means that iMapper made, and are left out."""
FEWEST_PIXELS = 400  # objects that show fewer are not annotated
LEG = 0.05  # [m], thickness of the legs that bare table tops get
SAME_FLOOR = 0.1  # [m] above the lowest object
CORNERS, TRIANGLES = torch.from_numpy(SIGNS).float() / 2, torch.from_numpy(FACES)
PEAK = 0.1  # confidences that stay below are peaks of heat maps


@dataclass(frozen=True)
class Part:
    """An oriented box of one object's part, in camera axes."""

    name: str
    axes: Float[Tensor, "3 3"]  #: columns
    centre: Float[Tensor, "3"]
    size: Float[Tensor, "3"]

    def mesh(self) -> Mesh:
        """The box as a mesh in camera axes [m]."""
        return Mesh(CORNERS * self.size @ self.axes.mT + self.centre, TRIANGLES)

    def upright(self) -> int:
        """Which of its axes is vertical."""
        return int(self.axes[1].abs().argmax())


@dataclass(frozen=True)
class I3dbScene:
    """A recording, with its truth."""

    name: str
    truth: Scene  #: what shows `FEWEST_PIXELS` or more
    detections: tuple[Detection, ...]
    keypoints: Keypoints
    imapper: tuple[SceneObject, ...]
    """The published method's own furniture, in the world of `truth`."""


def read_i3db(folder: Path) -> I3dbScene:
    """One scene of the data set.

    Raises:
        InputError: If a file is missing or has another layout.
    """
    truths = sorted(folder.glob("gt/skel_*_GT_objects"))
    found = sorted(folder.glob("skel_*_2d_00.json"))
    if not truths or not found:
        raise InputError(f"{folder}: has no gt/skel_*_GT_objects or skel_*_2d_00.json of i3DB")
    K = torch.tensor(read_json(folder / "intrinsics.json").value, dtype=torch.float32)[:3, :3]
    objects = parts_in(truths[0])
    up = up_of(objects)
    R = tilted(up[2].asin(), torch.atan2(-up[0], -up[1]))
    camera = Camera(K, R, WIDTH, HEIGHT)
    low = torch.stack([lowest(parts, R) for parts in objects.values()])
    floor = float(low[low < low.min() + SAME_FLOOR].median())
    for (_, category), parts in objects.items():
        if category == "table":
            parts += legs_below(parts, R, floor)
    scene = [object_of(key, parts, R) for key, parts in objects.items()]
    masks = visible_masks(objects, camera)
    shown = [k for k, mask in enumerate(masks) if int(mask.sum()) >= FEWEST_PIXELS]
    seen = tuple(replace(scene[k], annotation=n + 1) for n, k in enumerate(shown))
    detections = tuple(
        Detection(
            n + 1, scene[k].category, tight_box(masks[k]),
            Masks(HEIGHT, WIDTH, (encode(masks[k]),)), 1.0,
        )
        for n, k in enumerate(shown)
    )  # fmt: skip
    theirs = joined_parts(parts_in(folder / "iMapper" / "skel_output_objects"), R)
    imapper = tuple(object_of((n, key), parts, R) for n, (key, parts) in enumerate(theirs))
    truth = Scene(camera, floor, seen)
    return I3dbScene(folder.name, truth, detections, keypoints_in(found[0]), imapper)


def parts_in(folder: Path) -> dict[tuple[int, str], list[Part]]:
    """The parts of each object, by its number and category."""
    objects: dict[tuple[int, str], list[Part]] = {}
    for path in sorted(folder.glob("*.json")):
        name = re.fullmatch(r"(\d+)_([a-z]+)_(.+)", path.stem)
        if name is None:
            raise InputError(f"{path}: expected a name like 00_chair_seat.json")
        data = read_json(path).value
        axes, centre, size = (
            torch.tensor(np.asarray(data[key], np.float32))
            for key in ("axes", "centroid", "scales")
        )
        part = Part(name[3], axes, centre.flatten(), size.flatten())
        objects.setdefault((int(name[1]), name[2]), []).append(part)
    return objects


def up_of(objects: dict[tuple[int, str], list[Part]]) -> Float[Tensor, "3"]:
    """The furniture's own vertical axis, in camera axes."""
    ups = [
        -part.axes[:, part.upright()] * part.axes[1, part.upright()].sign()
        for parts in objects.values()
        for part in parts
    ]
    return torch.nn.functional.normalize(torch.stack(ups).median(0).values, dim=0)


def lowest(parts: list[Part], R: Float[Tensor, "3 3"]) -> Float[Tensor, ""]:
    """Height of the lowest corner in the world [m]."""
    return torch.cat([part.mesh().verts for part in parts]).matmul(R)[:, 1].min()


def largest(parts: list[Part]) -> Part:
    """The part of the largest volume, the first of equals."""
    return max(parts, key=lambda part: float(part.size.prod()))


def legs_below(parts: list[Part], R: Float[Tensor, "3 3"], floor: float) -> list[Part]:
    """Four legs of a table of which only the top was modelled."""
    if any(part.name.startswith("leg") for part in parts) or lowest(parts, R) < floor + 0.15:
        return []
    top = largest(parts)
    up, k = R[:, 1], top.upright()
    long = top.centre @ up - floor - top.size[k] / 2
    size = torch.full((3,), LEG)
    size[k] = long
    i, j = (a for a in range(3) if a != k)
    below = top.centre - up * (top.size[k] + long) / 2
    return [
        Part("leg", top.axes, below + top.axes[:, i] * a * (top.size[i] / 2 - LEG)
             + top.axes[:, j] * b * (top.size[j] / 2 - LEG), size)
        for a in (-1, 1) for b in (-1, 1)
    ]  # fmt: skip


def front_of(parts: list[Part], R: Float[Tensor, "3 3"]) -> float:
    """Yaw of the front: away from the back, else of the shorter side to the camera [rad]."""
    seats = [p for p in parts if p.name.startswith(("seat", "top", "shelf", "stool"))] or parts
    seat = largest(seats)
    sides = [
        (sign * R.mT @ seat.axes[:, a], float(seat.size[a]))
        for a in range(3) if a != seat.upright() for sign in (1, -1)
    ]  # fmt: skip
    backs = [part for part in parts if part.name.startswith("back")]
    if backs:
        back = largest(backs)
        flat = [a for a in range(3) if a != back.upright()]
        thin = R.mT @ back.axes[:, min(flat, key=lambda a: float(back.size[a]))]
        thin = thin * (thin @ (R.mT @ (seat.centre - back.centre))).sign()
        front = max(sides, key=lambda side: float(side[0] @ thin))[0]
    else:
        short = min(size for _, size in sides) + 1e-6
        towards = R.mT @ -seat.centre
        front = max((s for s in sides if s[1] <= short), key=lambda s: float(s[0] @ towards))[0]
    return float(torch.atan2(front[0], front[2]))


def object_of(key: tuple[int, str], parts: list[Part], R: Float[Tensor, "3 3"]) -> SceneObject:
    """The parts as one object that stands in the world."""
    yaw = torch.tensor(front_of(parts, R))
    meshes = [part.mesh() for part in parts]
    verts = torch.cat([mesh.verts for mesh in meshes]) @ R @ rot_y(yaw)
    counts = np.cumsum([0, *(len(mesh.verts) for mesh in meshes[:-1])])
    faces = torch.cat([m.faces + int(n) for m, n in zip(meshes, counts, strict=True)])
    base = bottom_center(verts.amin(0), verts.amax(0))
    return SceneObject(
        id=f"{key[1]}_{key[0]}", category=key[1], mesh=Mesh(verts - base, faces), mesh_file="",
        annotation=None, support="ground", t_world_object=rot_y(yaw) @ base, yaw=yaw,
        scale=torch.ones(3),
    )  # fmt: skip


def visible_masks(objects: dict[tuple[int, str], list[Part]], camera: Camera) -> list[Tensor]:
    """What shows of each object before the others."""
    depths: list[Tensor] = []
    for parts in objects.values():
        meshes = [part.mesh() for part in parts]
        drawn = [first_hit(m.verts, m.faces, camera.K, (HEIGHT, WIDTH))[0] for m in meshes]
        depths.append(torch.stack(drawn).amin(0))
    nearest = torch.stack(depths).amin(0)
    return [(depth <= nearest) & depth.isfinite() for depth in depths]


def keypoints_in(path: Path) -> Keypoints:
    """The real network's joints of every other frame [px]."""
    data = read_json(path).value
    frames = sorted(int(key) for key in data["3d"])
    values = data["confidence"]
    confidence = dict(zip(values["frame_ids"], values["values"], strict=True))
    rows = [frame for frame in frames if frame % 2 == 0]
    points, sure = np.zeros((len(rows), 26, 2)), np.zeros((len(rows), 26))
    for row, frame in enumerate(rows):
        at = data["3d"][f"{frame:05d}"]
        for joint, place in HALPE.items():
            number = str(JOINTS.index(joint))
            points[row, place] = (np.array(at[number][:2]) + 0.5) * HEIGHT / ROWS
            sure[row, place] = confidence.get(frame, {}).get(number, 0.0)
    if sure.max() < PEAK:  # iMapper's own curve for peaks of heat maps (pose/confidence.py)
        sure = np.where(sure > 0, 1 / (1 + np.exp(-5000 * sure + 9.5)), 0)
    return Keypoints(
        torch.from_numpy(points).float(), torch.from_numpy(sure.clip(0, 1)).float(), "halpe26",
        torch.tensor([frame // 2 for frame in rows]), torch.zeros(len(rows), dtype=torch.long), FPS,
    )  # fmt: skip


def joined_parts(
    objects: dict[tuple[int, str], list[Part]], R: Float[Tensor, "3 3"]
) -> list[tuple[str, list[Part]]]:
    """IMapper's parts: those of one category whose boxes touch seen from above are one object."""
    groups: list[tuple[str, list[Part]]] = []
    for (_, category), parts in objects.items():
        for part in parts:
            near = [kind == category and _touch(own, part, R) for kind, own in groups]
            merged = [part]
            for (_, own), touches in zip(groups, near, strict=True):
                merged += own if touches else []
            groups = [g for g, touches in zip(groups, near, strict=True) if not touches]
            groups.append((category, merged))
    return groups


def _touch(parts: list[Part], other: Part, R: Float[Tensor, "3 3"]) -> bool:
    """Whether the upright bounds of two parts overlap within 5 cm."""
    ours = other.mesh().verts @ R
    low, high = ours.amin(0) - 0.05, ours.amax(0) + 0.05
    each = (part.mesh().verts @ R for part in parts)
    return any(bool(((v.amin(0) < high) & (v.amax(0) > low))[[0, 2]].all()) for v in each)
