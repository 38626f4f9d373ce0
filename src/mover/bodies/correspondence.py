"""Which points of two body models are the same point of a person."""

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..records import record
from .marks import marks_of
from .skeleton import BODY, HANDS
from .skinning import SkinnedBody
from .smpl_model import SmplBody, skin_of_model
from .transfer_matrix import TransferMatrix

Model = SkinnedBody | SmplBody
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


def thinned(model: Model, verts: Int[Tensor, " some"]) -> Model:
    """The same body with some of its vertices only, in this order, and no triangles."""
    if isinstance(model, SmplBody):
        return dataclasses.replace(
            model,
            skin=_thinned(model.skin, verts),
            pose_dirs=model.pose_dirs[:, verts],
            expression_dirs=model.expression_dirs[verts],
        )
    return _thinned(model, verts)


def _thinned(skin: SkinnedBody, verts: Int[Tensor, " some"]) -> SkinnedBody:
    return dataclasses.replace(
        skin,
        faces=skin.faces[:0],
        verts=skin.verts[verts],
        weights=skin.weights[verts],
        shape_dirs=skin.shape_dirs[verts],
    )
