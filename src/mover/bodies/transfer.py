r"""From one body model to another: the pose is copied, shape and place are solved.

    E = \sum_b mean_k ||x_bk - y_bk||^2 / σ_x^2 + ||θ_b - θ_b^copied||^2 / σ_θ^2 + ||β||^2 / σ_β^2

y are points of the source: vertices where both meshes correspond (SMPL and SMPL-H have one mesh;
the user's official matrix gives SMPL-X's from SMPL's), else joints and the points that keypoint
detectors know, at the places that both models have. x are the same points of the target.
Departure from the SMPL-X authors' tool: rows that share a shape before share one after it, and the
pose starts from the copy instead of from edges of the mesh.
"""

import dataclasses
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies.keypoints import marks_of
from mover.bodies.skeleton import BODY, HANDS
from mover.bodies.skinning import SkinnedBody, widths_of
from mover.bodies.smpl_files import FOLDER, KINDS
from mover.bodies.smpl_model import (
    FLAT,
    HAND_POSES,
    Model,
    SmplBody,
    skin_of_model,
    vertex_subset,
    with_full_hands,
)
from mover.core.errors import InputError
from mover.core.pickles import load_plain
from mover.core.records import BROKEN, record
from mover.core.settings import Sigma, Steps
from mover.core.types import BodyPose


@record
class TransferMatrix:
    """A sparse matrix from vertices to vertices, by rows."""

    shape: tuple[int, int]
    """Vertices of the target and of the source."""
    start: Int[Tensor, " rows_and_end"]
    """Where each row's entries start."""
    column: Int[Tensor, " entries"]
    value: Float[Tensor, " entries"]
    valid: Int[Tensor, " valid"]
    """Vertices of the target that the matrix gives well."""

    def rows(
        self, wanted: Int[Tensor, " some"]
    ) -> tuple[Int[Tensor, " used"], Float[Tensor, "some used"]]:
        """The vertices of the source that some rows use, and their shares in these rows."""
        parts = [slice(int(self.start[r]), int(self.start[r + 1])) for r in wanted.tolist()]
        used = torch.unique(torch.cat([self.column[p] for p in parts]))
        mix = torch.zeros(len(wanted), len(used))
        for k, part in enumerate(parts):
            mix[k].index_add_(0, torch.searchsorted(used, self.column[part]), self.value[part])
        return used, mix


def find_matrix(source: str, target: str, folder: Path | None = None) -> Path | None:
    """The user's file `smpl2smplx_deftrafo_setup.pkl` or the like, None if there is none.

    Looked for in `folder`, by default the one of `MOVER_BODY_MODELS`, and in its `transfer_data`.
    """
    if folder is None:
        given = os.environ.get(FOLDER)
        if not given:
            return None
        folder = Path(given)
    name = f"{source}2{target}_deftrafo_setup.pkl"
    tried = [folder / name, folder / "transfer_data" / name, folder / "transfer" / name]
    return next((path for path in tried if path.is_file()), None)


def read_matrix(path: Path, source: str, target: str) -> TransferMatrix:
    """The matrix in an official file: its key is `mtx` or `matrix`.

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
    rows, columns = KINDS[target].verts, KINDS[source].verts
    shape = tuple(np.shape(found[key]))
    if shape not in ((rows, columns), (rows, 2 * columns)):
        raise InputError(
            f"{path.name}: field '{key}' has shape {shape}, expected ({rows}, {columns}) or "
            f"({rows}, {2 * columns})"
        )
    matrix: Any = sparse.csr_matrix(found[key])[:, :columns]
    matrix.sort_indices()
    if not np.isfinite(matrix.data).all():
        raise InputError(f"{path.name}: field '{key}' has numbers that are not finite")
    return TransferMatrix(
        shape=(rows, columns),
        start=torch.from_numpy(matrix.indptr.astype(np.int64)),
        column=torch.from_numpy(matrix.indices.astype(np.int64)),
        value=torch.from_numpy(matrix.data.astype(np.float32)),
        valid=_valid(path.with_name(f"{target}_mask_ids.npy"), rows),
    )


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


# Points that correspond, and the descent to a pose of the other model.


SAMPLED = 1200
"""Vertices that stand for a whole mesh."""


@record
class Pairs:
    """Corresponding points: joints first, then vertices."""

    source_joints: Int[Tensor, " joints"]
    target_joints: Int[Tensor, " joints"]
    source: Int[Tensor, " source_verts"]
    target: Int[Tensor, " target_verts"]
    mix: Float[Tensor, "target_verts source_verts"] | None
    """Share of each of the source's vertices in the points; None: one to one."""


def pairs_of(source: Model, target: Model, matrix: TransferMatrix | None = None) -> Pairs:
    """Corresponding points of two models.

    Vertices where the meshes are the same or a matrix is given, else joints and points by name.

    Raises:
        ValueError: If the matrix is not for these models.
    """
    first, second = skin_of_model(source), skin_of_model(target)
    assert first is not None
    assert second is not None
    none = torch.zeros(0, dtype=torch.long)
    if matrix is not None:
        counts = (len(second.verts), len(first.verts))
        if matrix.shape != counts:
            raise ValueError(f"the matrix is {matrix.shape}, the models have {counts} vertices")
        rows = spread(matrix.valid)
        columns, mix = matrix.rows(rows)
        return Pairs(none, none, columns, rows, mix)
    if torch.equal(first.faces, second.faces):
        rows = spread(torch.arange(len(first.verts)))
        return Pairs(none, none, rows, rows, None)
    names = [n for n in (*BODY, *HANDS) if n in first.joint_names and n in second.joint_names]
    marks = marks_of(first), marks_of(second)
    both = sorted(set(marks[0]) & set(marks[1]))
    return Pairs(
        torch.tensor([first.joint_names.index(n) for n in names]),
        torch.tensor([second.joint_names.index(n) for n in names]),
        torch.tensor([marks[0][n] for n in both]),
        torch.tensor([marks[1][n] for n in both]),
        None,
    )


def spread(rows: Int[Tensor, " rows"]) -> Int[Tensor, " some"]:
    """At most `SAMPLED` of these, evenly."""
    if len(rows) <= SAMPLED:
        return rows
    return rows[torch.linspace(0, len(rows) - 1, SAMPLED).round().long()]


SHAPES = 10
"""Numbers of shape that are solved."""


@dataclass(frozen=True)
class TransferConfig:
    """How a body is laid into another model."""

    steps: Steps = 120
    """Most iterations of L-BFGS, first of shape and place, then of everything."""
    sigma_vertex: Sigma = 0.001
    """Expected distance of corresponding vertices [m]."""
    sigma_joint: Sigma = 0.01
    """Expected distance of joints and keypoints of the same name, which models place apart [m]."""
    sigma_pose: Sigma = 0.15
    """Expected difference of an angle between the models [rad]."""
    sigma_shape: Sigma = 3.0
    """Expected size of a number of the shape."""
    free_pose: bool = True
    """Turn the joints after the copy; else only shape and place are solved."""


@record
class Transferred:
    """A body in another model."""

    pose: BodyPose
    miss: Float[Tensor, " bodies"]
    """Root mean square distance of corresponding points [m]."""


@record
class Unknowns:
    """What is solved."""

    betas: Float[Tensor, "people shape"]
    transl: Float[Tensor, "bodies 3"]
    turn: Float[Tensor, "bodies angles"]
    """Added to the copied angles of the root and the body [rad]."""


def transfer(
    pose: BodyPose,
    source: Model,
    target: Model,
    config: TransferConfig | None = None,
    matrix: TransferMatrix | None = None,
) -> Transferred:
    """The same people in the model `target`.

    Args:
        pose: Parameters of `source`; rows with equal shape are one person and stay so.
        source: The model of the pose.
        target: The model to change to.
        config: Weights and steps.
        matrix: The user's matrix that gives the vertices of `target` from those of `source`.
    """
    config = config or TransferConfig()
    pairs = pairs_of(source, target, matrix)
    goal = _goal(pose, source, pairs)
    person = torch.unique(pose.betas, dim=0, return_inverse=True)[1]
    copied = copy_pose(pose, source, target)
    small = vertex_subset(target, pairs.target)
    sigma = config.sigma_joint if len(pairs.source_joints) else config.sigma_vertex

    def points(at: Unknowns) -> Float[Tensor, "bodies points 3"]:
        verts, joints = small.posed(_laid(at, copied, person))
        return torch.cat([joints[:, pairs.target_joints], verts], 1)

    def energy(at: Unknowns) -> Float[Tensor, ""]:
        return _misfit(points(at), goal, sigma) + _doubt(at, config)

    at = _start(copied, target, person, goal, points)
    at = _solve(at, ("betas", "transl"), energy, config.steps)
    if config.free_pose:
        at = _solve(at, ("betas", "transl", "turn"), energy, config.steps)
    with torch.no_grad():
        miss = (points(at) - goal).square().sum(-1).mean(1).sqrt()
    return Transferred(_laid(at, copied, person), miss)


def _laid(at: Unknowns, copied: BodyPose, person: Int[Tensor, " bodies"]) -> BodyPose:
    """The copied pose with what is solved."""
    angles = torch.cat([copied.global_orient, copied.body_pose], -1) + at.turn
    return dataclasses.replace(
        copied, betas=at.betas[person], global_orient=angles[:, :3],
        body_pose=angles[:, 3:], transl=at.transl,
    )  # fmt: skip


def copy_pose(pose: BodyPose, source: Model, target: Model) -> BodyPose:
    """The angles of all joints that both models have; shape zero, place as it was.

    Hands become 45 angles from flat hands; where the source has none, the target's are at rest.
    """
    full = with_full_hands(source, pose) if isinstance(source, SmplBody) else pose
    widths = widths_of(_skin(target))
    body = full.body_pose[:, :63]
    body = torch.cat([body, body.new_zeros(len(body), widths["body_pose"] - 63)], -1)
    wanted = {*widths} | ({"expression"} if source.name == target.name else set())
    extra = {name: value for name, value in full.extra.items() if name in wanted}
    if any(name in extra for name in HAND_POSES):
        extra[FLAT] = body.new_ones(len(body), 1)
    shapes = min(SHAPES, _skin(target).shape_dirs.shape[-1])
    gender = target.gender if isinstance(target, SmplBody) else "neutral"
    return BodyPose(
        model=target.name, gender=gender, betas=body.new_zeros(len(body), shapes),
        global_orient=full.global_orient, body_pose=body, transl=full.transl, extra=extra,
    )  # fmt: skip


def _skin(model: Model) -> SkinnedBody:
    skin = skin_of_model(model)
    assert skin is not None
    return skin


def _goal(pose: BodyPose, source: Model, pairs: Pairs) -> Float[Tensor, "bodies points 3"]:
    """Where the points of the source are [m]."""
    with torch.no_grad():
        verts, joints = vertex_subset(source, pairs.source).posed(pose)
    if pairs.mix is not None:
        verts = torch.einsum("kv,bvi->bki", pairs.mix.to(verts), verts)
    return torch.cat([joints[:, pairs.source_joints], verts], 1)


def _start(
    copied: BodyPose,
    target: Model,
    person: Int[Tensor, " bodies"],
    goal: Float[Tensor, "bodies points 3"],
    points: Callable[[Unknowns], Float[Tensor, "bodies points 3"]],
) -> Unknowns:
    """The mean shape in the copied pose, with its points about those of the source."""
    people, shapes = int(person.max()) + 1, copied.betas.shape[-1]
    angles = 3 + widths_of(_skin(target))["body_pose"]
    at = Unknowns(
        betas=goal.new_zeros(people, shapes),
        transl=goal.new_zeros(len(goal), 3),
        turn=goal.new_zeros(len(goal), angles),
    )
    with torch.no_grad():
        return dataclasses.replace(at, transl=(goal - points(at)).mean(1))


def _misfit(
    points: Float[Tensor, "bodies points 3"], goal: Float[Tensor, "bodies points 3"], sigma: float
) -> Float[Tensor, ""]:
    """Squared distances of corresponding points over what is expected of them."""
    return (points - goal).square().sum(-1).mean(1).sum() / sigma**2


def _doubt(at: Unknowns, config: TransferConfig) -> Float[Tensor, ""]:
    """Squared turns from the copied pose and sizes of the shape, over what is expected."""
    turn = at.turn.square().mean(-1).sum() / config.sigma_pose**2
    return turn + at.betas.square().sum() / config.sigma_shape**2


def _solve(
    start: Unknowns,
    free: tuple[str, ...],
    energy: Callable[[Unknowns], Float[Tensor, ""]],
    steps: int,
) -> Unknowns:
    """Lower the energy in the fields `free` by L-BFGS with a strong Wolfe line search."""
    values = {name: getattr(start, name).detach().clone().requires_grad_() for name in free}
    solver = torch.optim.LBFGS(
        list(values.values()), max_iter=steps, history_size=20,
        line_search_fn="strong_wolfe",
    )  # fmt: skip

    def closure() -> Tensor:
        solver.zero_grad()
        value = energy(dataclasses.replace(start, **values))
        value.backward()
        return value

    solver.step(closure)
    return dataclasses.replace(start, **{name: value.detach() for name, value in values.items()})
