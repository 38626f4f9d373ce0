"""bodies.npz: people's meshes, or the parameters of a body model, or both."""

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from mover.bodies.corrected import has_mean_shape
from mover.core.errors import InputError
from mover.core.types import Bodies
from mover.io.capture.pose_file import NEEDED, pose_of, posed, reproduces
from mover.io.files.fields import (
    AMASS,
    FASTEST,
    SLOWEST,
    At,
    Warn,
    is_amass,
    listed,
    read_npy,
    read_npz,
    write_npz,
)
from mover.io.files.meshes import check_faces
from mover.io.formats import names
from mover.io.people.values import named

log = logging.getLogger(__name__)

TALLEST, SMALLEST = 3.5, 0.2  # [m], of a body that is in metres
SMALL = 1.1  # [m] across, of small people at their largest
ON_HEAD = 0.3  # [m], heads so far below ankles


def read_bodies(path: Path, warn: Warn = log.warning) -> Bodies:
    """Read and check bodies, in the space that the file says."""
    return bodies_of(read_body_arrays(path), warn)


def read_body_arrays(path: Path, fps: float | None = None) -> At:
    """The arrays of bodies.npz as they are, with a frame rate where one is given."""
    if path.is_dir() or path.suffix.lower() not in (".npz", ""):
        cure = f"name the tool that wrote it (--bodies-from {', '.join(names('people'))})"
        raise InputError(f"{named(path).name}: is no bodies.npz; {cure}")
    at = read_npz(path)
    return at if fps is None else At({**at.value, "fps": np.array(fps)}, at.file)


def bodies_of(at: At, warn: Warn) -> Bodies:
    """The bodies of named arrays: meshes where they are given, else the posed model."""
    if is_amass(at):
        raise InputError(f"{at.file}: is {AMASS}; expected bodies.npz")
    if not {"frame", "person", "vertices", "body_pose"} & {*at.value}:
        raise InputError(
            f"{at.file}: has {listed('array', [*at.value])}, expected those of bodies.npz; if"
            " another tool wrote it, name that (mover import-bodies TOOL, or --bodies-from TOOL)"
        )
    frame = torch.from_numpy(at.get("frame").indices("B"))
    person = torch.from_numpy(at.get("person").indices(len(frame)))
    _check_rows(at, frame, person)
    pose = pose_of(at, len(frame))
    given = at.maybe("vertices")
    if given is None and pose is None:
        at.get("vertices").refuse("meshes ('vertices', 'faces') or parameters ('body_pose', ...)")
    if given is None:
        assert pose is not None
        verts, faces, joints, names = posed(pose, at)
    else:
        verts = _places(given, (len(frame), "V", 3))
        faces = _faces(at.get("faces"), verts.shape[1])
        joints, names = None, ()
        if at.maybe("joints", "joint_names") is not None:  # both or neither
            joints = _places(at.get("joints"), (len(frame), "J", 3))
            names = tuple(map(str, at.get("joint_names").array((joints.shape[1],), "text")))
    space = at.get("space")
    word: Any = space.holding(str(space.array((), "text"))).choice(("camera", "world"))
    spread = scalar(at, "size_spread", 0.0, 1.0)
    mean_shape = pose is not None and has_mean_shape(pose)  # before a pose is dropped unchecked
    fps = scalar(at, "fps", SLOWEST, FASTEST)
    reason = reproduces(pose, verts, at) if given is not None and pose is not None else None
    if reason is not None:
        warn(f"{at.file}: {reason}; the bodies can only be refined rigidly")
        pose = None
    bodies = Bodies(
        verts, faces, joints, names, frame, person, fps, word, pose, spread, mean_shape
    )  # fmt: skip
    for text in odd_bodies(bodies):
        warn(f"{at.file}: {text}")
    return bodies


def odd_bodies(bodies: Bodies) -> list[str]:
    """What is unlikely of people: other units, small ones, and people on their heads."""
    found: list[str] = []
    extent = (bodies.verts.amax(1) - bodies.verts.amin(1)).norm(dim=-1)
    middle, large = float(extent.median()), float(extent.quantile(0.9))
    if not SMALLEST < middle < TALLEST:
        found.append(f"the bodies measure {middle:.3g} across; are they in metres?")
    elif large < SMALL:
        cure = "if they are adults, is the focal length that the tool assumed right?"
        found.append(f"people measure {large:.2g} m across, as small children; {cure}")
    ends = [bodies.joint_names.index(name) for name in ("head", "left_ankle", "right_ankle")
            if name in bodies.joint_names]  # fmt: skip
    if bodies.joints is not None and len(ends) == 3:
        y = bodies.joints[:, ends, 1] * (1 if bodies.space == "camera" else -1)
        if float((y[:, 0] - y[:, 1:].mean(1)).median()) > ON_HEAD:
            cure = "turn the video by 180 degrees, or their axes: " + (
                "+y must point down in the camera" if bodies.space == "camera" else "+y is up"
            )
            found.append(f"people stand on their heads; {cure}")
    return found


def _check_rows(at: At, frame: Int[Tensor, " rows"], person: Int[Tensor, " rows"]) -> None:
    """Refuse an empty file and a person who is twice in a frame."""
    if not len(frame):
        at.get("frame").refuse("at least one row", "no rows")
    pairs, times = torch.stack([frame, person], 1).unique(dim=0, return_counts=True)
    if (times > 1).any():
        twice = pairs[times > 1][0].tolist()
        found = f"frame {twice[0]} of person {twice[1]} twice"
        at.get("frame").refuse("one row for each frame and person", found)


def _places(at: At, shape: tuple[int | str, ...]) -> Float[Tensor, "bodies points 3"]:
    """Vertices or joints [m]."""
    value = at.array(shape)
    if not value.shape[1]:
        at.refuse("at least one point", "none")
    return torch.from_numpy(value.astype(np.float32))


def _faces(at: At, n_verts: int) -> Int[Tensor, "faces 3"]:
    value = at.array(("F", 3), "whole").astype(np.int64)
    if not len(value):
        at.refuse("at least one face", "an empty mesh")
    check_faces(at, value, n_verts)
    return torch.from_numpy(value)


def scalar(at: At, name: str, least: float, most: float) -> float | None:
    """A number that may be missing."""
    given = at.maybe(name)
    if given is None:
        return None
    return given.holding(float(given.array(())[()])).number(least, most)


def write_bodies(bodies: Bodies, path: Path) -> None:
    """Write bodies as they are, parameters included."""
    write_npz(bodies_to_arrays(bodies), path)


def bodies_to_arrays(bodies: Bodies) -> dict[str, NDArray[Any]]:
    """The arrays of bodies.npz."""
    arrays: dict[str, NDArray[Any]] = {
        "frame": bodies.frame.cpu().numpy(), "person": bodies.person.cpu().numpy(),
        "space": np.array(bodies.space), "vertices": bodies.verts.detach().cpu().numpy(),
        "faces": bodies.faces.cpu().numpy(),
    }  # fmt: skip
    for name in ("fps", "size_spread"):
        if getattr(bodies, name) is not None:
            arrays[name] = np.array(getattr(bodies, name))
    if bodies.joints is not None:
        arrays["joints"] = bodies.joints.detach().cpu().numpy()
        arrays["joint_names"] = np.array(bodies.joint_names, dtype=np.str_)
    if (pose := bodies.pose) is not None:
        tensors = {key: getattr(pose, key) for key in NEEDED} | pose.extra
        arrays |= {"model": np.array(pose.model), "gender": np.array(pose.gender)}
        arrays |= {key: value.detach().cpu().numpy() for key, value in tensors.items()}
    return arrays


def read_touch(at: At, bodies: Bodies) -> Float[Tensor, "bodies verts"]:
    """contacts.npz: the chance that a body's vertex touches something."""
    field = at.get("probability")
    value = field.array(tuple(bodies.verts.shape[:2]))
    if value.min() < 0 or value.max() > 1:
        field.refuse("probabilities from 0 to 1", f"{value.min():g} to {value.max():g}")
    return torch.from_numpy(value.astype(np.float32))


# Contacts of every vertex from files of other tools (POSA's, DECO's): one file, or one a frame.


KEYS = ("probability", "contact", "contacts", "contact_label_smplx", "contact_label", "prob")
"""Names under which contacts are looked for in .npz files, the first that is there counts."""


def read_contacts(source: Path, bodies: Bodies, first: int = 0) -> Float[Tensor, "bodies verts"]:
    """Chance of touching for each vertex of these bodies, in [0, 1].

    Args:
        source: An array (bodies, vertices) or, of one body, (vertices,) in an .npy or .npz file; or
            a folder with one such file for each frame, whose names begin with the frame's number.
        bodies: Whose vertices these are.
        first: The number in the name of the first frame's file.
    """
    if source.is_dir():
        files = sorted(p for p in source.iterdir() if p.suffix in (".npy", ".npz"))
        numbers = ((re.match(r"\D*(\d+)", p.stem), p) for p in files)
        by_frame = {int(found[1]) - first: p for found, p in numbers if found}
        frames: list[int] = bodies.frame.tolist()
        if missing := sorted(set(frames) - set(by_frame)):
            found = f"has no file for frame {missing[0]}"
            raise InputError(f"{source}: {found}, expected an .npy or .npz")
        if len(set(frames)) < len(frames):
            found = "one file a frame, but the bodies have several people a frame"
            raise InputError(f"{source}: {found}")
        value = np.concatenate([_array(by_frame[k]).reshape(1, -1) for k in frames])
    else:
        value = _array(source)
    rows, verts = bodies.verts.shape[:2]
    if value.dtype.kind not in "biuf" or value.size != rows * verts:
        raise InputError(
            f"{source.name}: has {value.dtype} of shape {value.shape}, expected "
            f"numbers of shape ({rows}, {verts})"
        )
    chance = torch.from_numpy(value.reshape(rows, verts).astype(np.float32))
    if not bool(chance.isfinite().all()):
        raise InputError(f"{source.name}: has values that are not finite, expected chances")
    return chance.clamp(0, 1)


def _array(path: Path) -> np.ndarray:
    """The contacts of a file, as numbers."""
    if path.suffix != ".npz":
        return np.asarray(read_npy(path).value)
    at = read_npz(path)
    if (given := at.maybe(*KEYS)) is None:
        raise InputError(f"{path.name}: has {sorted(at.value)}, expected one of {list(KEYS)}")
    return np.asarray(given.value)
