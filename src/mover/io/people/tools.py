"""One table of the tools that find bodies: a row says where everything lies in their files.

All give SMPL, SMPL-H, SMPL-X or MHR in OpenCV camera axes, but AMASS, whose world has +z up.
Sources: the writers' own code, as of 2026.
"""

import dataclasses
import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.bodies.skinning import FLAT
from mover.core.errors import InputError
from mover.core.types import BodyPose
from mover.io.capture.pose_file import GENDERS, NEEDED, moved
from mover.io.files.fields import At
from mover.io.people import values as v
from mover.io.people.cameras import (
    assumed_lens,
    from_weak,
    lens,
    lens_of,
    movement,
    own_lens,
    tilting,
)
from mover.io.people.found import UNTRACKED, Found, Known, joined
from mover.io.people.values import need

Names = tuple[str, ...]
JOINTS = {"smpl": (24,), "smplh": (52, 22), "smplx": (55, 25, 22)}
HANDS = {
    "smpl": {}, "smplh": {"left_hand_pose": (66, 111), "right_hand_pose": (111, 156)},
    "smplx": {
        "jaw_pose": (66, 69), "left_hand_pose": (75, 120), "right_hand_pose": (120, 165),
    },
}  # fmt: skip
"""Columns behind the body where all joints are in one field; hands count from the flat hand."""
EXTRA = ("left_hand_pose", "right_hand_pose", "jaw_pose", "expression")
CODE = 32  # numbers of a VPoser code
SHAPES = 10  # coefficients where none are given
FOCAL = 5000.0  # [px], SMPLify-X's default, and of HMR2's crops
CROP = 256.0  # [px], a side of these crops
AMASS = {156: "smplh", 165: "smplx", 72: "smpl"}
"""Body models by the numbers of a row of `poses`."""
AMASS_PARTS = {"root_orient": 3, "pose_body": 63, "pose_jaw": 3, "pose_eye": 6, "pose_hand": 90}
"""What newer files have in its place, and the numbers of a row of each."""
NO_CAMERA = "is a motion in a world of its own: where the camera saw the people is not known"
STAGES = ("root_fit", "smpl_fit", "smooth_fit", "motion_fit", "motion_chunks")  # of SLAHMR
Y_UP = np.array([[1, 0, 0, 0, 0, 1, 0, -1, 0]])  # AMASS has +z up


@dataclass(frozen=True)
class Person:
    """One person, with a row for each frame."""

    fields: At
    track: int | None = 0
    """None: the tool lists the people of each image by themselves."""
    frame: int = 0
    """Of the first row, where no field holds the frames."""
    K: At | None = None
    """The lens that the tool assumed, one or a row each [px]."""
    model: str = ""
    """The body model where the file decides, else empty."""
    upright: At | None = None
    """Angles of the root, or of all joints, in a world with +y up."""
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Tool:
    """Where a tool keeps what a body needs; several names of a field are all in use."""

    people: Callable[[Path, Known], Iterator[Person]]
    """Finds the people in the files."""
    model: str
    pose: Names = ()
    """All joints in one field."""
    root: str = "global_orient"
    """The root and the body, where they are two fields."""
    body: str = "body_pose"
    verts: str = ""
    """Vertices about `translation`, in place of parameters."""
    shape: Names = ("betas",)
    widths: tuple[int, ...] = ()
    """Of the shape; empty: any."""
    shapeless: bool = False
    """The shape may be missing."""
    translation: str = "transl"
    camera: Names = ()
    """Rotation and translation from the tool's world into the camera, where bodies lie in it."""
    frames: Names = ()
    rate: Names = ()
    """Frames a second."""
    space: Literal["camera", "world"] = "camera"


def read(path: Path, known: Known, tool: str) -> Found:
    """Bodies that a tool found, as its row of the table says."""
    row = TOOLS[tool]
    found: list[Found] = []
    for person in row.people(path, known):
        try:
            found.append(_rows(row, person, known))
        except InputError as error:  # what is known of the file is said with it
            said = [f"{path.name}: {text}" for text in person.warnings]
            raise InputError("; ".join([str(error), *said])) from error
    if not found:
        raise InputError(f"{path.name}: has no people, expected at least one")
    return joined(found)


def _rows(tool: Tool, person: Person, known: Known) -> Found:
    """The rows of one person."""
    at, model, warnings = person.fields, person.model or tool.model, person.warnings
    frames = v.whole(need(at, *tool.frames)) if tool.frames else None
    gender, rate = "neutral", at.maybe(*tool.rate)
    if tool.verts:
        verts = v.stacked(need(at, tool.verts), 3) + v.rows(need(at, tool.translation), 1, 3)
        values = {"verts": v.tensor(verts)[None]}
    else:
        pose = _pose(tool, at, model, None if frames is None else len(frames), known)
        values = {name: getattr(pose, name) for name in NEEDED} | pose.extra
        gender = pose.gender
        if person.upright is not None:
            turns = v.angles(person.upright, len(pose.transl), 1, *JOINTS[model])
            warnings += tilting(pose.global_orient, turns[:, :3])
    count = len(next(iter(values.values())))
    if frames is None:
        frames = np.arange(person.frame, person.frame + count)
    values["frame"] = torch.from_numpy(frames)
    values["person"] = torch.full((count,), UNTRACKED if person.track is None else person.track)
    if person.K is not None:
        values["K"] = v.tensor(v.rows(person.K, count, 9)).reshape(-1, 3, 3)
    fps = None if rate is None else v.one_number(rate)
    return Found(model, values, gender, fps, tool.space, warnings)


def _pose(tool: Tool, at: At, model: str, count: int | None, known: Known) -> BodyPose:
    """The parameters of one person, in the camera or the upright world."""
    turns, extra = _turns(tool, at, model, count, known)
    need(at, tool.translation, *tool.camera[1:])
    if not tool.shapeless:
        need(at, *tool.shape)
    gender, said = known.gender or "neutral", at.maybe("gender")
    if known.gender is None and said is not None:
        word = v.lone(said)
        word = word.decode(errors="replace") if isinstance(word, bytes) else str(word)
        gender = said.holding(word).choice(GENDERS)

    def part(names: Names, missing: Tensor, *widths: int) -> Tensor:
        if (given := at.maybe(*names)) is None:
            return missing.expand(len(turns), -1)
        return v.tensor(v.rows(given, len(turns), *widths))

    pose = BodyPose(
        model=model, gender=gender, betas=part(tool.shape, torch.zeros(SHAPES), *tool.widths),
        global_orient=turns[:, :3], body_pose=turns[:, 3 : 72 if model == "smpl" else 66],
        transl=part((tool.translation,), torch.zeros(3), 3), extra=extra,
    )  # fmt: skip
    R = part(tool.camera[:1], torch.eye(3).flatten(), 9).reshape(-1, 3, 3)
    return moved(pose, R, part(tool.camera[1:], torch.zeros(3), 3))


def _turns(
    tool: Tool, at: At, model: str, count: int | None, known: Known
) -> tuple[Float[Tensor, "rows angles"], dict[str, Tensor]]:
    """Angles of root and body, and those of hands and face."""
    if tool.pose:
        turns = v.angles(need(at, *tool.pose), count, *JOINTS[model])
        inside = {k: (a, b) for k, (a, b) in HANDS[model].items() if turns.shape[1] >= b}
        extra = {name: turns[:, a:b] for name, (a, b) in inside.items()}
        if "left_hand_pose" in extra:
            extra[FLAT] = torch.ones(len(turns), 1)
        return turns, extra
    body = need(at, tool.body)
    root = v.angles(need(at, tool.root), count, 1)
    count = len(root)
    if v.numbers(body).shape[-1:] == (CODE,):
        turned = _decoded(body, count, known)
    else:
        turned = v.angles(body, count, 23, 21)[:, : 69 if model == "smpl" else 63]
    extra = {n: v.tensor(v.rows(one, count)) for n in EXTRA if (one := at.maybe(n)) is not None}
    return torch.cat([root, turned], 1), extra


def _decoded(at: At, count: int, known: Known) -> Tensor:
    """VPoser's codes as angles, where its weights are known."""
    if known.decode is None:
        at.refuse(
            "63 angles: SMPLify-X stored VPoser's code, which its decoder turns into angles "
            "(vposer.decode(body_pose, output_type='aa')); store these instead, or name VPoser's "
            "weights (--vposer)",
            f"{CODE} numbers",
        )
    with torch.no_grad():
        return known.decode(v.tensor(v.rows(at, count)))


def gvhmr(path: Path, known: Known) -> Iterator[Person]:
    """hmr4d_results.pt of GVHMR, smpl_params.pt of GEM: one person in all frames."""
    at = v.read_one(path, "GVHMR's or GEM's results", "hmr4d_results.pt", "smpl_params.pt")
    body = need(at, "smpl_params_incam", "body_params_incam")
    world = at.maybe("smpl_params_global", "body_params_global")
    root = None if world is None else need(world, "global_orient")
    K, said = own_lens(at.maybe("K_fullimg"), known)
    yield Person(body, K=K, upright=root, warnings=said)


def wham(path: Path, known: Known) -> Iterator[Person]:
    """wham_output.pkl: people by their tracks."""
    K = assumed_lens(known, math.hypot)
    for track, at in v.people_of(v.read_one(path, "WHAM's results", "wham_output.pkl")):
        yield Person(at, track, K=K, upright=at.maybe("pose_world"))


def prompthmr(path: Path, known: Known) -> Iterator[Person]:
    """results.pkl: `people`, and the cameras beside them."""
    source = v.read_one(path, "PromptHMR's results", "results.pkl")
    camera, world = source.maybe("camera", "camera_world"), source.maybe("camera_world")
    K, warnings = own_lens(None if camera is None else _image_lens(camera), known)
    if world is not None:
        R = v.stacked(need(world, "Rcw"), 3, 3)
        warnings += movement(R, v.rows(need(world, "Tcw"), len(R), 3))
    for track, one in v.people_of(need(source, "people")):
        body = v.with_fields(need(one, "smplx_cam"), frames=need(one, "frames").value)
        yield Person(body, track, K=K, warnings=warnings)


def tram(path: Path, known: Known) -> Iterator[Person]:
    """A folder with camera.npy and hps/hps_track_<k>.npy."""
    tracks = v.files_of(path, "TRAM's results", "hps/hps_track_*.npy")
    file = tracks[0].parent.parent / "camera.npy"
    lens_of_all, warnings = None, ()
    if file.is_file():
        source = v.read_any(file)
        lens_of_all, turn = _image_lens(source), source.maybe("world_cam_R")
        if turn is not None:  # x_world = R x_cam + t
            R = np.swapaxes(v.stacked(turn, 3, 3), 1, 2)
            t = v.rows(need(source, "world_cam_T"), len(R), 3)
            warnings = movement(R, -np.einsum("tij,tj->ti", R, t))
    lens_of_all, said = own_lens(lens_of_all, known)
    for k, one in enumerate(tracks):
        yield Person(v.read_any(one), k, K=lens_of_all, warnings=said + warnings)


def _image_lens(at: At) -> At:
    """The lens that a file gives as `img_focal` and `img_center` [px]."""
    focal = v.one_number(need(at, "img_focal"))
    return lens(focal, focal, *v.stacked(need(at, "img_center"), 2)[0].tolist())


def pare(path: Path, known: Known) -> Iterator[Person]:
    """pare_output.pkl or vibe_output.pkl of a video, or one pickle an image with a row a person.

    Raises:
        InputError: If the lens is not known, for these networks have none.
    """
    if known.camera is None:
        raise InputError(f"{path.name}: PARE knows no lens: --camera names a camera.json")
    files = v.files_of(path, "PARE's results", "pare_output.pkl", "vibe_output.pkl", "*.pkl")
    for file, frame in zip(files, v.frames_in(files, path, known), strict=True):
        at, people = v.read_one(file, "PARE's results"), list[tuple[int | None, At]]()
        if at.maybe("orig_cam", "pred_pose") is None:  # of a video: people by track
            people += v.people_of(at)
        else:
            count = len(v.rows(need(at, "orig_cam"), None, 4))
            people.append((None, v.with_fields(at, frame_ids=np.full(count, frame))))
        for track, one in people:
            crop = torch.from_numpy(v.rows(need(one, "orig_cam"), None, 4).copy())
            place = from_weak(crop, known.camera).numpy()
            yield Person(v.with_fields(one, transl=place), track)


def phalp(path: Path, known: Known) -> Iterator[Person]:
    """results/demo_<video>.pkl of 4D-Humans: frames by name, whose lists go person by person.

    People who are only predicted in a frame, not detected, are left out. Bodies were seen in crops
    of 256 px at 5000 px, the image padded to a square.
    """
    source = v.read_one(path, "the results of PHALP", "**/*.pkl")
    for index, name in enumerate(sorted(source.mapping(), key=lambda key: v.natural(Path(key)))):
        at = source.get(name)
        bodies, tracks = need(at, "smpl").items(), v.whole(need(at, "tid")).tolist()
        camera, ages = need(at, "camera"), at.maybe("tracked_time")
        listed = list(camera.value) if isinstance(camera.value, np.ndarray) else camera.value
        cameras = camera.holding(listed).items()
        if not len(bodies) == len(cameras) == len(tracks):
            n = f"{len(tracks)} tracks, {len(bodies)} bodies and {len(cameras)} cameras"
            raise InputError(f"{at.place} has {n}, expected as many of each")
        age = np.zeros(len(tracks)) if ages is None else v.numbers(ages).reshape(-1)
        sizes, time = at.maybe("size"), at.maybe("time")
        size = v.stacked(sizes, 2)[0, ::-1].tolist() if sizes is not None and tracks else None
        K = assumed_lens(known, lambda *sides: FOCAL / CROP * max(sides), size)
        frame = index if time is None or v.one_number(time) < 0 else int(v.one_number(time))
        for k, track in enumerate(tracks):
            if len(age) != len(tracks) or age[k] == 0:
                body = at.holding({**bodies[k].mapping(), "camera": cameras[k].value})
                yield Person(body, track, frame, K=K)


def slahmr(path: Path, _: Known) -> Iterator[Person]:
    """The highest *_world_results.npz of the last stage: arrays of (people, frames, numbers).

    track_info.json beside it gives the tracks and the frames in which a person is visible.

    Raises:
        InputError: If it is the prior's file, or another.
    """
    stage = {name: rank for rank, name in enumerate(STAGES)}
    files = v.files_of(path, "SLAHMR's results", "**/*_world_results.npz")
    path = max(files, key=lambda f: (stage.get(f.parent.name, -1), v.natural(Path(f.name))))
    chosen = f"of {len(files)} results {path.parent.name}/{path.name} is read"
    notes, source = (chosen,) if len(files) > 1 else (), v.read_any(path)
    if "prior_results" in path.name and source.maybe("trans") is None:
        raise InputError(
            f"{path.name}: is SLAHMR's motion prior, without positions; expected the file "
            "*_world_results.npz of the same number beside it"
        )
    names = ("trans", "root_orient", "pose_body", "cam_R", "cam_t")
    fields = {name: v.numbers(need(source, name)) for name in names}
    for name, value in fields.items():
        if value.ndim < 3 or not value.size or value.shape[:2] != fields["trans"].shape[:2]:
            wanted = "(people, frames, n) numbers, as many as of 'trans'"
            source.get(name).refuse(wanted, f"shape {value.shape}")
    people, count = fields["trans"].shape[:2]
    betas, intrins = v.rows(need(source, "betas"), people), source.maybe("intrins")
    K = None if intrins is None else lens(*v.stacked(intrins, 4)[0].tolist())
    whole = [(who, who, np.arange(count)) for who in range(people)]
    for track, who, frames in [*_visible(path, count, people)] or whole:
        of_one = {name: values[who][frames] for name, values in fields.items()}
        at = At({**of_one, "betas": betas[who], "frames": frames}, source.file)
        R, t = v.stacked(at.get("cam_R"), 3, 3), v.stacked(at.get("cam_t"), 3)
        yield Person(at, track, K=K, warnings=notes + movement(R, t))


def _visible(path: Path, count: int, people: int) -> Iterator[tuple[int, int, NDArray[np.int64]]]:
    """Track, index and visible frames of each person; none without a file of tracks."""
    files = (folder / "track_info.json" for folder in (path.parent, path.parent.parent))
    file = next((file for file in files if file.is_file()), None)
    for track, one in [] if file is None else v.people_of(need(v.read_any(file), "tracks")):
        index = int(v.one_number(need(one, "index")))
        mask = v.numbers(need(one, "vis_mask")).reshape(-1) > 0
        if 0 <= index < people and len(mask) == count and mask.any():
            yield track, index, np.flatnonzero(mask)


def prox(path: Path, known: Known) -> Iterator[Person]:
    """results/<frame>/<person>.pkl or <frame>.pkl of SMPLify-X and PROX, or one such file."""
    files, homes = v.files_of(path, "fits", "**/*.pkl"), (path, path / "results")

    def image_of(file: Path) -> Path:
        inside = file.parent not in homes or re.search(r"\d", file.parent.name)
        return file.parent if inside and re.fullmatch(r"\d{1,3}", file.stem) else file

    images = [image_of(file) for file in files]
    for file, frame in zip(files, v.frames_in(images, path, known), strict=True):
        yield Person(v.read_any(file), None, frame)


def smplifyx(path: Path, known: Known) -> Iterator[Person]:
    """As PROX, under a lens of its own."""
    K = assumed_lens(known, lambda *_: FOCAL)
    return (dataclasses.replace(person, K=K) for person in prox(path, known))


def amass(path: Path, _: Known) -> Iterator[Person]:
    """Motions of AMASS: one npz a person; ours say which, in which frames and which way is up."""
    for rank, file in enumerate(v.files_of(path, "motions of AMASS", "*.npz")):
        at = v.read_any(file)
        count = len(v.stacked(need(at, "trans"), 3))
        person, up, frame = (at.maybe(name) for name in ("person", "up_axis", "frame"))
        track = rank if person is None else int(v.one_number(person))
        turn = Y_UP if up is None or v.lone(up) != "y" else np.eye(3).reshape(1, 9)
        at = v.with_fields(at, turn=turn, frames=np.arange(count) if frame is None else frame.value)
        if at.maybe("poses") is None and at.maybe("pose_body") is not None:
            given = [(at.maybe(name), width) for name, width in AMASS_PARTS.items()]
            rows = [np.zeros((count, n)) if x is None else v.rows(x, count, n) for x, n in given]
            at = v.with_fields(at, poses=np.concatenate(rows, 1))
        width = v.rows(need(at, "poses"), count).shape[1]
        if width not in AMASS:
            need(at, "poses").refuse(f"rows of {' or '.join(map(str, AMASS))} angles")
        yield Person(at, track, model=AMASS[width], warnings=(NO_CAMERA,))


def sam3dbody(path: Path, known: Known) -> Iterator[Person]:
    """Meshes of MHR: a file a person (`<image>_subj00.npz`), or a file with a list of people.

    Names that end in `_subj00` or `_person1` are people of the image before; the last number of
    what is left is the frame. The vertices lie about the origin of the body, whose camera_t is
    added [m].
    """
    files = [path]
    if path.is_dir():
        files = sorted((f for f in path.iterdir() if f.suffix.lower() in v.KINDS), key=v.natural)
    if not files:
        raise InputError(f"{path}: has no files of kind {', '.join(v.KINDS)}")
    images = [f.with_stem(re.sub(r"_?(?:subj|person|human)_?\d+$", "", f.stem)) for f in files]
    for file, frame in zip(files, v.frames_in(images, path, known), strict=True):
        at = v.read_any(file)
        for one in [at] if isinstance(at.value, Mapping) else at.items():
            yield Person(one, None, frame, K=_lens_of_joints(one, known))


def _lens_of_joints(at: At, known: Known) -> At | None:
    """The lens of joints in space and in the image, else that of the focal length."""
    place, focal = v.rows(need(at, "pred_cam_t"), 1, 3), at.maybe("focal_length")
    f = known.focal if focal is None else v.one_number(focal)
    joints, pixels = at.maybe("pred_keypoints_3d"), at.maybe("pred_keypoints_2d")
    if joints is not None and pixels is not None:
        points = v.stacked(joints, 3) + place
        image = v.rows(pixels, len(points), 2)
        if np.isfinite(points).all() and np.isfinite(image).all():
            return lens_of(v.tensor(points), v.tensor(image))
    return None if f is None else assumed_lens(dataclasses.replace(known, focal=f), lambda *_: f)


CROPS = Tool(
    pare, "smpl", pose=("pose", "pred_pose"), shape=("betas", "pred_shape"), widths=(10,),
    frames=("frame_ids",),
)  # fmt: skip
GVHMR = Tool(gvhmr, "smplx", shapeless=True)
HMR2 = Tool(phalp, "smpl", widths=(10,), translation="camera")
FITTED = "camera_rotation", "camera_translation"
TOOLS = {
    "4dhumans": HMR2,
    "amass": Tool(
        amass, "smplx", pose=("poses",), translation="trans", camera=("turn",),
        frames=("frames",), rate=("mocap_frame_rate", "mocap_framerate"), space="world",
    ),
    "gem": GVHMR,
    "gvhmr": GVHMR,
    "pare": CROPS,
    "phalp": HMR2,
    "prompthmr": Tool(
        prompthmr, "smplx", pose=("rotmat",), shape=("shape",), widths=(10, 11, 16),
        translation="trans", frames=("frames",),
    ),
    "prox": Tool(prox, "smplx", camera=FITTED),
    "sam3dbody": Tool(sam3dbody, "mhr", verts="pred_vertices", translation="pred_cam_t"),
    "slahmr": Tool(
        slahmr, "smplh", root="root_orient", body="pose_body", translation="trans",
        camera=("cam_R", "cam_t"), frames=("frames",),
    ),
    "smplifyx": Tool(smplifyx, "smplx", camera=FITTED),
    "tram": Tool(
        tram, "smpl", pose=("pred_rotmat",), shape=("pred_shape",), widths=(10,),
        translation="pred_trans", frames=("frame",),
    ),
    "vibe": CROPS,
    "wham": Tool(
        wham, "smpl", pose=("pose",), widths=(10,), translation="trans",
        frames=("frame_ids",),
    ),
}  # fmt: skip
"""The tools by name; `mover.io.formats` lists them."""
