r"""SMPL bodies of a regressor (PARE) as SMPL-X bodies, by the official matrix (Sec. 3.2).

    E = \sum_b mean_k ||x_bk - y_bk||^2 / \sigma_x^2 + ||θ_b - θ_b^SMPL||^2 / \sigma_θ^2
        + ||β||^2 / \sigma_β^2

y = M v are the vertices that the user's `smpl2smplx_deftrafo_setup.pkl` gives from SMPL's, x the
same vertices of SMPL-X. Rows of one shape before share one after it, and the pose starts from the
angles of SMPL, whose 21 joints of the body SMPL-X has, too.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies.skinning import FLAT, HAND_POSES, SkinnedBody, vertex_subset
from mover.bodies.smpl_files import FOLDER, KINDS
from mover.core.errors import InputError
from mover.core.pickles import load_plain
from mover.core.records import BROKEN, record
from mover.core.types import BodyPose

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
