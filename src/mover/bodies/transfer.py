r"""SMPL bodies of a regressor (PARE) as SMPL-X bodies, by the official matrix (Sec. 3.2).

    E = \sum_b mean_k ||x_bk - y_bk||^2 / \sigma_x^2 + ||θ_b - θ_b^SMPL||^2 / \sigma_θ^2
        + ||β||^2 / \sigma_β^2

y = M v are the vertices that the user's `smpl2smplx_deftrafo_setup.pkl` gives from SMPL's, x the
same vertices of SMPL-X. Rows of one shape before share one after it, and the pose starts from the
angles of SMPL, whose 21 joints of the body SMPL-X has, too.
"""

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies.skinning import FLAT, SkinnedBody, vertex_subset
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
    given = os.environ.get(FOLDER)
    places = ("", "transfer_data", "transfer") if given else ()
    tried = (Path(given or "") / place / FILE for place in places)
    return next((path for path in tried if path.is_file()), None)


def read_matrix(path: Path) -> TransferMatrix:
    """Evenly chosen rows of the matrix of an official file: its key is `mtx` or `matrix`.

    Columns behind the source's vertices act on normals and are dropped. `smplx_mask_ids.npy` beside
    the file, where it is there, says which vertices of SMPL-X count.

    Raises:
        InputError: If it is not a matrix between these models.
    """
    from scipy import sparse

    found: Any = load_plain(path)
    keys = list(found) if isinstance(found, dict) else []
    key = next((k for k in ("mtx", "matrix") if k in keys), None)
    if key is None:
        named = ", ".join(map(str, keys)) or type(found).__name__
        raise InputError(f"{path.name}: field 'mtx' or 'matrix' is missing; found {named}")
    rows, columns = KINDS["smplx"].verts, KINDS["smpl"].verts
    shape = tuple(np.shape(found[key]))
    if shape not in ((rows, columns), (rows, 2 * columns)):
        raise InputError(
            f"{path.name}: field '{key}' has shape {shape}, expected ({rows}, {columns}) or "
            f"({rows}, {2 * columns})"
        )
    matrix: Any = sparse.csr_matrix(found[key])[:, :columns]
    if not np.isfinite(matrix.data).all():
        raise InputError(f"{path.name}: field '{key}' has numbers that are not finite")
    target = _valid(path.with_name("smplx_mask_ids.npy"), rows)
    if len(target) > SAMPLED:
        target = target[torch.linspace(0, len(target) - 1, SAMPLED).round().long()]
    some: Any = matrix[target.numpy()]
    source = np.unique(some.indices)
    mix = torch.from_numpy(some[:, source].toarray().astype(np.float32))
    return TransferMatrix(torch.from_numpy(source.astype(np.int64)), target, mix)


def _valid(path: Path, rows: int) -> Int[Tensor, " valid"]:
    """The vertices that count, all where nothing is said."""
    if not path.is_file():
        return torch.arange(rows)
    try:
        ids = np.load(path, allow_pickle=False)
    except BROKEN as error:
        raise InputError(f"{path.name}: cannot be read, expected an .npy file") from error
    if ids.ndim != 1 or ids.dtype.kind not in "iu" or not len(ids) or ids.max() >= rows:
        raise InputError(
            f"{path.name}: has {ids.shape} of {ids.dtype}, expected vertices of SMPL-X"
        )
    return torch.from_numpy(np.unique(ids.astype(np.int64)))


def as_smplx(
    pose: BodyPose, smpl: SkinnedBody, smplx: SkinnedBody, matrix: TransferMatrix
) -> BodyPose:
    """The same people with the parameters of SMPL-X; rows with equal shape stay one person."""
    with torch.no_grad():
        verts, _ = vertex_subset(smpl, matrix.source).posed(pose)
    goal = torch.einsum("kv,bvi->bki", matrix.mix.to(verts), verts)
    small, rows = vertex_subset(smplx, matrix.target), len(goal)
    shapes, person = torch.unique(pose.betas, dim=0, return_inverse=True)
    angles = torch.cat([pose.global_orient, pose.body_pose[:, :ANGLES]], -1)
    hands = {f"{side}_hand_pose": goal.new_zeros(rows, 45) for side in ("left", "right")}

    def laid(at: dict[str, Tensor]) -> BodyPose:
        turned = angles + at["turn"]
        return BodyPose(
            model="smplx", gender=smplx.gender, betas=at["betas"][person],
            global_orient=turned[:, :3], body_pose=turned[:, 3:], transl=at["transl"],
            extra=hands | {FLAT: goal.new_ones(rows, 1)},
        )  # fmt: skip

    def energy(at: dict[str, Tensor]) -> Float[Tensor, ""]:
        miss = (small.posed(laid(at))[0] - goal).square().sum(-1).mean(1).sum()
        turn = at["turn"].square().mean(-1).sum() / SIGMA_POSE**2
        return miss / SIGMA_VERTEX**2 + turn + at["betas"].square().sum() / SIGMA_SHAPE**2

    at = {"betas": goal.new_zeros(len(shapes), SHAPES), "transl": goal.new_zeros(rows, 3)}
    at["turn"] = torch.zeros_like(angles)
    with torch.no_grad():
        at["transl"] = (goal - small.posed(laid(at))[0]).mean(1)
    at = solved(at, ("betas", "transl"), energy, STEPS)
    return laid(solved(at, ("betas", "transl", "turn"), energy, STEPS))


def solved(
    start: dict[str, Tensor],
    free: Iterable[str],
    energy: Callable[[dict[str, Tensor]], Float[Tensor, ""]],
    steps: int,
    evaluations: int | None = None,
    flat: float = 1e-7,
) -> dict[str, Tensor]:
    """Lower the energy in some of the unknowns by L-BFGS with a strong Wolfe line search.

    It ends after `evaluations` (None: 1.25 for each step) or where no gradient exceeds `flat`.

    Raises:
        ValueError: If the energy is not finite at the start.
    """
    values = {name: start[name].detach().clone().requires_grad_() for name in free}
    solver = torch.optim.LBFGS(
        list(values.values()), max_iter=steps, max_eval=evaluations, history_size=20,
        tolerance_grad=flat, line_search_fn="strong_wolfe",
    )  # fmt: skip

    def closure() -> Tensor:
        solver.zero_grad()
        value = energy(start | values)
        torch.autograd.backward(value)
        return value

    first = solver.step(closure)  # pyright: ignore[reportArgumentType]
    if not bool(torch.as_tensor(first).isfinite()):
        raise ValueError("the energy of the bodies is not finite")
    return start | {name: value.detach() for name, value in values.items()}
