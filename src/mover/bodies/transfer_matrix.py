"""The user's official matrices that give the vertices of one body model from another's."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies.smpl_files import FOLDER, KINDS
from mover.core.errors import InputError
from mover.core.pickles import load_plain
from mover.core.records import BROKEN, record


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
