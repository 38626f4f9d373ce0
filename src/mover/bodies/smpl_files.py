"""Body models from the user's own files of the SMPL family, checked; none is shipped."""

import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mover.bodies.skeleton import BODY, HANDS, JOINTS, PARENTS
from mover.bodies.skinning import FacePoints, Hands, SkinnedBody
from mover.core.errors import InputError
from mover.core.pickles import load_plain
from mover.core.records import BROKEN

Array = NDArray[Any]


@dataclass(frozen=True)
class Kind:
    """What every file of one model has."""

    verts: int
    joints: tuple[str, ...]
    hands: bool


KINDS = {
    "smpl": Kind(6890, (*BODY, "left_hand", "right_hand"), False),
    "smplh": Kind(6890, (*BODY, *HANDS), True),
    "smplx": Kind(10475, JOINTS, True),
}
"""The models of the family by name."""
NEEDED = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f")
HAND_KEYS = ("hands_componentsl", "hands_componentsr", "hands_meanl", "hands_meanr")
FACE_KEYS = ("lmk_faces_idx", "lmk_bary_coords")
CORE = 10  # numbers of shape and of expression of SMPL-X in files of version 1.0
SHAPE_1_1 = 300  # numbers of shape of SMPL-X in files of version 1.1; 100 of expression follow


def keys_of(name: str) -> tuple[str, ...]:
    """The arrays that a file of this model must have."""
    return (*NEEDED, *(HAND_KEYS if KINDS[name].hands else ()))


def body_from(arrays: Mapping[str, Any], name: str, gender: str, file: str) -> SkinnedBody:
    """The body model in the arrays of a file, which are checked first."""
    kind = KINDS[name]
    _check_model(arrays, name, file)
    verts, joints = kind.verts, len(kind.joints)
    template = _numbers(arrays, "v_template", (verts, 3), file)
    dirs = _numbers(arrays, "shapedirs", (verts, 3, None), file)
    poses = _numbers(arrays, "posedirs", (verts, 3, 9 * (joints - 1)), file)
    regressor = _numbers(arrays, "J_regressor", (joints, verts), file)
    weights = _numbers(arrays, "weights", (verts, joints), file)
    shape, expression = _split(dirs, name, file)
    faces = _indices(arrays, "f", (None, 3), verts, file)
    hands = face = None
    if kind.hands:
        components = [_numbers(arrays, key, (None, 45), file) for key in HAND_KEYS[:2]]
        mean = [_numbers(arrays, key, (45,), file) for key in HAND_KEYS[2:]]
        if len(components[0]) != len(components[1]):
            raise InputError(f"{file}: fields 'hands_componentsl' and 'hands_componentsr' differ")
        hands = Hands(_tensor(np.stack(mean)), _tensor(np.stack(components)))
    if all(key in arrays for key in FACE_KEYS):
        index = _indices(arrays, "lmk_faces_idx", (51,), len(faces), file)
        share = _numbers(arrays, "lmk_bary_coords", (51, 3), file)
        face = FacePoints(torch.from_numpy(faces[index]), _tensor(share))
    at_joints = (regressor @ dirs.reshape(verts, -1)).reshape(joints, 3, -1)
    return SkinnedBody(
        name=name, faces=torch.from_numpy(faces), joint_names=kind.joints,
        parents=_parents(arrays, name, file), verts=_tensor(template),
        joints=_tensor(regressor @ template), weights=_tensor(weights),
        shape_dirs=_tensor(dirs[..., shape]), joint_dirs=_tensor(at_joints[..., shape]),
        tpose=torch.eye(3).expand(joints, 3, 3).clone(),
        pose_dirs=_tensor(poses.transpose(2, 0, 1)), expression_dirs=_tensor(dirs[..., expression]),
        expression_joint_dirs=_tensor(at_joints[..., expression]),
        hands=hands, face=face, gender=gender,
    )  # fmt: skip


def _tensor(value: Array) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(value, np.float32))


def _check_model(arrays: Mapping[str, Any], name: str, file: str) -> None:
    """Refuse a file without the arrays of this model, or with the mesh of another one."""
    needed = keys_of(name)
    missing = [key for key in needed if key not in arrays]
    if missing:
        found = ", ".join(sorted(str(key) for key in arrays)[:30]) or "nothing"
        raise InputError(
            f"{file}: field '{missing[0]}' is missing, expected {', '.join(needed)} "
            f"for the model '{name}'; found {found}"
        )
    shape = np.shape(arrays["v_template"])
    others = [other for other, kind in KINDS.items() if shape == (kind.verts, 3)]
    if others and name not in others:
        raise InputError(
            f"{file}: field 'v_template' has {shape[0]} vertices, those of {' and '.join(others)}, "
            f"expected {KINDS[name].verts} of '{name}'"
        )


def _numbers(
    arrays: Mapping[str, Any], key: str, shape: tuple[int | None, ...], file: str
) -> NDArray[np.float64]:
    """An array, if it is one of finite numbers of this shape; None stands for any size."""
    value = arrays[key]
    if hasattr(value, "toarray") and _fits(value.shape, shape):  # else it may be huge
        value = value.toarray()
    array: Array = np.asarray(value)
    found = ""
    if array.dtype.kind not in "fiu" or not _fits(array.shape, shape):
        found = f"shape {tuple(getattr(value, 'shape', array.shape))} of {array.dtype}"
    elif not np.isfinite(array).all():
        found = "numbers that are not finite"
    if found:
        sizes = ", ".join("N" if n is None else str(n) for n in shape)
        expected = f"expected finite numbers of shape ({sizes})"
        raise InputError(f"{file}: field '{key}' has {found}, {expected}")
    return array.astype(np.float64)


def _fits(found: tuple[int, ...], shape: tuple[int | None, ...]) -> bool:
    return len(found) == len(shape) and all(
        want in (None, have) for have, want in zip(found, shape, strict=True)
    )


def _indices(
    arrays: Mapping[str, Any], key: str, shape: tuple[int | None, ...], below: int, file: str
) -> NDArray[np.int64]:
    value = _numbers(arrays, key, shape, file)
    if not value.size or value.min() < 0 or value.max() >= below:
        raise InputError(f"{file}: field '{key}' has odd numbers, expected 0 to {below - 1}")
    return value.astype(np.int64)


def _parents(arrays: Mapping[str, Any], name: str, file: str) -> tuple[int, ...]:
    """Parents of the joints; the files differ in the number that the root has."""
    count = len(KINDS[name].joints)
    table = _numbers(arrays, "kintree_table", (2, count), file)
    parents = (-1, *(int(p) for p in table[0, 1:]))
    expected = {"smplx": PARENTS, "smpl": (*PARENTS[:22], 20, 21)}.get(
        name, (*PARENTS[:22], *(p if p < 22 else p - 3 for p in PARENTS[25:]))
    )
    if parents != expected:
        raise InputError(f"{file}: field 'kintree_table' is not the skeleton of '{name}'")
    return parents


def _split(dirs: NDArray[np.float64], name: str, file: str) -> tuple[slice, slice]:
    """Which displacements are of the shape and which of the expression."""
    count = dirs.shape[-1]
    if name != "smplx":
        return slice(0, count), slice(0, 0)
    if count < 2 * CORE:
        found = f"has {count} components"
        raise InputError(f"{file}: field 'shapedirs' {found}, expected 20 (v1.0) or 400 (v1.1)")
    if count < SHAPE_1_1 + 100:
        return slice(0, CORE), slice(CORE, 2 * CORE)
    return slice(0, SHAPE_1_1), slice(SHAPE_1_1, count)


FOLDER = "MOVER_BODY_MODELS"
"""Environment variable with the folder of the user's body models."""
ENDINGS = (".npz", ".pkl")
LARGEST = 2 << 30  # [bytes], of an array
OFFICIAL = {
    "neutral": ("basicModel_neutral_lbs_10_207_0_v1.0.0", "basicmodel_neutral_lbs_10_207_0_v1.1.0"),
    "male": ("basicmodel_m_lbs_10_207_0_v1.0.0", "basicmodel_m_lbs_10_207_0_v1.1.0",
             "basicModel_m_lbs_10_207_0_v1.0.0"),
    "female": ("basicModel_f_lbs_10_207_0_v1.0.0", "basicmodel_f_lbs_10_207_0_v1.1.0"),
}  # fmt: skip
"""Names that SMPL's own downloads have."""


def load_smpl(name: str, gender: str = "neutral", place: Path | None = None) -> SkinnedBody:
    """A body of the SMPL family from the user's file.

    Args:
        name: `smpl`, `smplh` or `smplx`.
        gender: `neutral`, `female` or `male`.
        place: The file, or the folder of the models (`smplx/SMPLX_NEUTRAL.npz` and so on); if not
            given, the folder that the environment variable `MOVER_BODY_MODELS` names.

    Raises:
        InputError: If the file is not there or is not one of this model.
    """
    path = find_file(name, gender, place)
    return _read(path, name, gender, path.stat().st_mtime_ns)


def find_file(name: str, gender: str, place: Path | None = None) -> Path:
    """The user's file of a model; an error names where it was looked for."""
    if place is None:
        given = os.environ.get(FOLDER)
        if not given:
            raise InputError(
                f"the body model '{name}' is licensed and not shipped, expected its files in the "
                f"folder that {FOLDER} names ({_names(name, gender)[0]}.npz); meshes ('vertices' "
                "and 'faces') are enough without a model"
            )
        place = Path(given)
    if place.is_file():
        return place
    tried = [place / f"{stem}{end}" for stem in _names(name, gender) for end in ENDINGS]
    for path in tried:
        if path.is_file():
            return path
    there = sorted(p.name for p in place.glob("*"))[:8] if place.is_dir() else []
    raise InputError(
        f"{place}: has no file of the body model '{name}' ({gender}), expected "
        f"{_names(name, gender)[0]}.npz or .pkl; found {', '.join(there) or 'nothing'}"
    )


def _names(name: str, gender: str) -> list[str]:
    """Where a file may be in the folder, without its ending."""
    stem = f"{name.upper()}_{gender.upper()}"
    stems = [f"{name}/{stem}", stem, f"models/{name}/{stem}", f"{name}/{gender}/model"]
    if name == "smpl":
        stems += [f"{root}{stem}" for root in ("smpl/", "") for stem in OFFICIAL[gender]]
    return stems


@lru_cache(maxsize=4)
def _read(path: Path, name: str, gender: str, _changed: int) -> SkinnedBody:
    """The model in a file; read again when the file changes."""
    if path.suffix == ".npz":
        arrays: dict[str, Any] = _npz(path, name)
    else:
        found = load_plain(path)
        if not isinstance(found, dict):
            raise InputError(f"{path.name}: is no dictionary, expected a file of '{name}'")
        arrays = {str(key): value for key, value in found.items()}
    return body_from(arrays, name, gender, path.name)


def _npz(path: Path, name: str) -> dict[str, Any]:
    """The arrays that the model needs; others, pickled or not, are not opened.

    Raises:
        InputError: If the file is broken, or one of them is a pickled object or too large.
    """
    file = path.name
    wanted = {*keys_of(name), *FACE_KEYS}
    try:
        with zipfile.ZipFile(path) as archive:
            sizes = {e.filename.removesuffix(".npy"): e.file_size for e in archive.infolist()}
        for key in wanted & set(sizes):
            if sizes[key] > LARGEST:
                raise InputError(f"{file}: field '{key}' has {sizes[key]} bytes, too many")
        arrays: dict[str, Any] = dict.fromkeys(sizes)
        with np.load(path, allow_pickle=False) as data:
            for key in sorted(wanted & set(sizes)):
                try:
                    arrays[key] = data[key]
                except ValueError as error:
                    if "allow_pickle" not in str(error):
                        raise
                    found = f"{file}: field '{key}' is a pickled object, expected plain numbers"
                    raise InputError(found) from error
    except BROKEN as error:
        why = " ".join(f"{type(error).__name__}: {error}".split())[:160]
        raise InputError(f"{file}: cannot be read ({why}), expected an .npz file") from error
    return arrays
