r"""Body models from the user's own files of the SMPL family, checked; none is shipped.

SMPL bodies of a regressor (PARE) become SMPL-X bodies by the official matrix (Sec. 3.2):

    E = \sum_b mean_k ||x_bk - y_bk||^2 / \sigma_x^2 + ||θ_b - θ_b^SMPL||^2 / \sigma_θ^2
        + ||β||^2 / \sigma_β^2

y = M v are the vertices that the user's `smpl2smplx_deftrafo_setup.pkl` gives from SMPL's, x the
same vertices of SMPL-X. Rows of one shape before share one after it, and the pose starts from the
angles of SMPL, whose 21 joints of the body SMPL-X has, too.
"""

import os
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from mover.bodies.skeleton import BODY, HANDS, JOINTS, PARENTS
from mover.bodies.skinning import FLAT, HAND_POSES, FacePoints, Hands, SkinnedBody, vertex_subset
from mover.core.errors import InputError
from mover.core.files import BROKEN
from mover.core.pickles import load_plain
from mover.core.records import record
from mover.core.types import BodyPose

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


FILE = "smpl2smplx_deftrafo_setup.pkl"
ANGLES = 63  # of the 21 joints of the body that both models have
SAMPLED = 1200  # vertices that stand for the whole mesh
SHAPES = 10  # numbers of shape that are solved
STEPS = 120  # most iterations of L-BFGS, first of shape and position, then of everything
SIGMA_VERTEX = 0.001  # [m]
SIGMA_POSE = 0.15  # expected difference of an angle between the models [rad]
SIGMA_SHAPE = 3.0


@record
class TransferMatrix:
    """Some vertices of SMPL-X as mixtures of some vertices of SMPL."""

    source: Int[Tensor, " source"]
    target: Int[Tensor, " target"]
    mix: Float[Tensor, "target source"]


def find_matrix() -> Path | None:
    """The user's official file in the folder of `MOVER_BODY_MODELS` or its `transfer_data`."""
    home, places = os.environ.get(FOLDER), ("", "transfer_data", "transfer")
    tried = [Path(home, place, FILE) for place in places] if home else []
    return next(filter(Path.is_file, tried), None)


def read_matrix(path: Path) -> TransferMatrix:
    """Evenly chosen rows of the matrix of an official file: its key is `mtx` or `matrix`.

    Columns behind the source's vertices act on normals and are dropped. `smplx_mask_ids.npy` beside
    the file, where it is there, says which vertices of SMPL-X count.

    Raises:
        InputError: If it is not a matrix between these models.
    """
    from scipy import sparse

    found: Any = load_plain(path)
    keys = list(found) if isinstance(found, dict) and found else [type(found).__name__]
    key = next((k for k in ("mtx", "matrix") if k in keys), None)
    if key is None:
        named = ", ".join(keys)
        raise InputError(f"{path.name}: field 'mtx' or 'matrix' is missing; found {named}")
    rows, columns = KINDS["smplx"].verts, KINDS["smpl"].verts
    shape, one, two = np.shape(found[key]), (rows, columns), (rows, 2 * columns)
    if shape not in (one, two):
        raise InputError(f"{path.name}: field '{key}' has shape {shape}, expected {one} or {two}")
    matrix: Any = sparse.csr_matrix(found[key])[:, :columns]
    if not np.isfinite(matrix.data).all():
        raise InputError(f"{path.name}: field '{key}' has numbers that are not finite")
    target = _valid(path.with_name("smplx_mask_ids.npy"), rows)
    count = len(target)
    target = target[torch.linspace(0, count - 1, min(count, SAMPLED)).round().long()]
    some: Any = matrix[target.numpy()]
    source = np.unique(some.indices)
    mix = torch.from_numpy(some[:, source].toarray().astype(np.float32))
    return TransferMatrix(torch.from_numpy(source.astype(np.int64)), target, mix)


def _valid(path: Path, rows: int) -> Int[Tensor, " valid"]:
    """The vertices that count, all where nothing is said."""
    try:
        ids = np.load(path, allow_pickle=False) if path.is_file() else np.arange(rows)
    except BROKEN as error:
        raise InputError(f"{path.name}: cannot be read, expected an .npy file") from error
    if ids.ndim != 1 or ids.dtype.kind not in "iu" or not len(ids) or ids.max() >= rows:
        kind = f"{ids.shape} of {ids.dtype}"
        raise InputError(f"{path.name}: has {kind}, expected vertices of SMPL-X")
    return torch.from_numpy(np.unique(ids.astype(np.int64)))


def as_smplx(
    pose: BodyPose, smpl: SkinnedBody, smplx: SkinnedBody, matrix: TransferMatrix
) -> BodyPose:
    """The same people with the parameters of SMPL-X; rows with equal shape stay one person."""
    with torch.no_grad():
        verts, _ = vertex_subset(smpl, matrix.source).posed(pose)
    goal = torch.einsum("kv,bvi->bki", matrix.mix.to(verts), verts)
    small = vertex_subset(smplx, matrix.target)
    shapes, person = torch.unique(pose.betas, dim=0, return_inverse=True)
    angles = torch.cat([pose.global_orient, pose.body_pose[:, :ANGLES]], -1)
    straight = {name: goal.new_zeros(len(goal), 45) for name in HAND_POSES}
    straight[FLAT] = goal.new_ones(len(goal), 1)

    def laid(at: dict[str, Tensor]) -> BodyPose:
        return BodyPose(
            model="smplx", gender=smplx.gender, betas=at["betas"][person],
            transl=at["transl"],
            global_orient=at["angles"][:, :3], body_pose=at["angles"][:, 3:], extra=straight,
        )  # fmt: skip

    def energy(at: dict[str, Tensor]) -> Float[Tensor, ""]:
        miss = (small.posed(laid(at))[0] - goal).square().sum(-1).mean(1).sum()
        turn = (at["angles"] - angles).square().mean(-1).sum() / SIGMA_POSE**2
        return miss / SIGMA_VERTEX**2 + turn + at["betas"].square().sum() / SIGMA_SHAPE**2

    at = {"betas": goal.new_zeros(len(shapes), SHAPES), "transl": pose.transl}
    at = solved(at, lambda some: energy(some | {"angles": angles}), STEPS)
    return laid(solved(at | {"angles": angles}, energy, STEPS))


def solved(
    start: dict[str, Tensor], energy: Callable[[dict[str, Tensor]], Float[Tensor, ""]], steps: int
) -> dict[str, Tensor]:
    """Lower the energy by at most so many steps of L-BFGS with a strong Wolfe line search.

    Raises:
        ValueError: If the energy is not finite at the start.
    """
    values = {name: value.detach().clone().requires_grad_() for name, value in start.items()}
    solver = torch.optim.LBFGS(
        list(values.values()), max_iter=steps, max_eval=2 * steps, history_size=20,
        tolerance_grad=1e-6, line_search_fn="strong_wolfe",
    )  # fmt: skip

    def closure() -> Tensor:
        solver.zero_grad()
        value = energy(values)
        torch.autograd.backward(value)
        return value

    first = solver.step(closure)  # pyright: ignore[reportArgumentType]
    if not bool(torch.as_tensor(first).isfinite()):
        raise ValueError("the energy of the bodies is not finite")
    return {name: value.detach() for name, value in values.items()}
