"""Convex pieces of furniture, for physics: a chair collides with its legs, not with its box.

Cuts along the axes are exact for boards and legs; coacd does the rest where it is installed.
"""

import heapq
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray

from mover.core.observe import Observer, silent
from mover.core.records import record
from mover.core.run import Run
from mover.core.settings import float_in, int_in
from mover.core.types import Mesh, SceneObject
from mover.geometry.watertight import close_mesh
from mover.io.files.fields import At
from mover.io.files.meshes import read_mesh

PLANES = 24  # places that are tried along each axis
SMALLEST = 1e-7  # of the volume; less is a scrap of a cut


def sliced(
    verts: NDArray[np.float64], faces: NDArray[np.int64], concavity: float, most: int
) -> tuple[list[NDArray[np.float64]], float]:
    """Points of convex pieces of a closed mesh, and what their hulls add, as a share of its volume.

    The piece whose hull is the most too large is cut by the plane that leaves the smallest hulls,
    until all that hulls add is a share `concavity` of the volume, or there are `most` pieces.
    """
    import manifold3d

    mesh = manifold3d.Mesh64(
        vert_properties=np.ascontiguousarray(verts),
        tri_verts=np.ascontiguousarray(faces.astype(np.uint64)),
    )
    solid = manifold3d.Manifold(mesh)
    if solid.is_empty():
        return [verts], float("inf")
    total, order = solid.volume(), count()
    heap: list[tuple[float, int, Any]] = []
    done: list[Any] = []
    for part in solid.decompose():
        heapq.heappush(heap, (-_excess(part), next(order), part))
    while heap and len(heap) + len(done) < most and _sum(heap) > concavity * total:
        _, _, worst = heapq.heappop(heap)
        halves = _best_cut(worst)
        if halves is None:
            done.append(worst)
            continue
        for half in halves:
            for part in half.decompose():
                if part.volume() > SMALLEST * total:
                    heapq.heappush(heap, (-_excess(part), next(order), part))
    parts = [*done, *(part for _, _, part in heap)]
    clouds = [np.array(part.to_mesh64().vert_properties[:, :3]) for part in parts]
    return clouds, sum(_excess(part) for part in parts) / total


def _sum(heap: list[tuple[float, int, Any]]) -> float:
    return -sum(excess for excess, _, _ in heap)


def _excess(part: Any) -> float:  # noqa: ANN401
    """What its hull adds to a piece [m³]."""
    return part.hull().volume() - part.volume()


def _best_cut(part: Any) -> tuple[Any, Any] | None:  # noqa: ANN401
    """The two halves with the smallest hulls, None if no cut makes them smaller."""
    verts = np.array(part.to_mesh64().vert_properties[:, :3])
    least, found = _excess(part) * 0.999, None
    for axis, normal in enumerate(np.eye(3)):
        for place in _places(verts[:, axis]):
            halves = part.split_by_plane(normal, place)
            if any(half.is_empty() for half in halves):
                continue
            excess = sum(_excess(half) for half in halves)
            if excess < least:
                least, found = excess, halves
    return found


def _places(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where edges lie along an axis, thinned to `PLANES`, without the ends."""
    inner = np.unique(np.round(values, 5))
    span = inner[-1] - inner[0]
    inner = inner[(inner > inner[0] + 0.002 * span) & (inner < inner[-1] - 0.002 * span)]
    if len(inner) <= PLANES:
        return inner
    return inner[np.linspace(0, len(inner) - 1, PLANES).round().astype(int)]


# The pieces, by whichever way fits.


THINNEST = 0.001  # [m], of a convex piece; flatter ones are thickened


@dataclass(frozen=True)
class ConvexConfig:
    """How furniture is cut into convex pieces."""

    method: Literal["best", "coacd", "slices"] = "best"
    """slices: cuts along the axes by manifold3d, exact for boards; coacd: any shape, slower; best:
    coacd where slices leave hollows."""
    concavity: Annotated[float, float_in(0.01, 1)] = 0.04
    """How hollow a piece may be, as a share of the object's size (coacd) or volume (slices)."""
    most: Annotated[int, int_in(1, 1000)] = 24
    """Pieces of one object."""


@record
class ConvexInputs:
    """What is cut."""

    mesh: Mesh
    """Closed, in the coordinates of the piece's own mesh [m]."""


@record
class Convex:
    """Closed convex meshes that together fill an object."""

    hulls: tuple[Mesh, ...]
    volume: float
    """Of the object [m³]; the hulls overlap and fill hollows."""
    centre: Float[torch.Tensor, "3"]
    """Centre of mass of the object as a solid [m]."""
    inertia: Float[torch.Tensor, "3 3"]
    """About that centre, of a density of one [m^5]."""


def convex_of(piece: SceneObject, run: Run) -> Convex:
    """The convex pieces of a piece's mesh at its initial size, kept in the result's folder."""
    config = ConvexConfig("slices" if find_spec("coacd") is None else "best")
    return run.stage(cut_into_convex, ConvexInputs(_closed(piece, run.folder)), config)


def _closed(piece: SceneObject, out: Path) -> Mesh:
    """The proxy that the run wrote, or the mesh closed anew."""
    file = out / "watertight" / f"{piece.id}.glb"
    if file.is_file():
        mesh, _ = read_mesh(At(file.name, "watertight", piece.id), file.parent)
        return close_mesh(mesh)
    return close_mesh(piece.mesh)


def cut_into_convex(
    inputs: ConvexInputs, config: ConvexConfig, observe: Observer = silent
) -> Convex:
    """Cut a closed mesh; one that is convex as it is stays whole."""
    del observe
    import trimesh

    verts = inputs.mesh.verts.double().numpy()
    faces = inputs.mesh.faces.numpy()
    solid = trimesh.Trimesh(verts, faces, process=False)
    whole = _hull(verts)
    if whole.volume - solid.volume < 0.01 * whole.volume:
        clouds = [verts]
    else:
        clouds = _cut(verts, faces, config)
    hulls = [_hull(cloud) for cloud in clouds]
    return Convex(
        tuple(_mesh_of(hull) for hull in hulls if hull.volume > 0),
        float(solid.volume),
        torch.from_numpy(np.array(solid.center_mass)),
        torch.from_numpy(np.array(solid.moment_inertia)),
    )


def _cut(
    verts: NDArray[np.float64], faces: NDArray[np.int64], config: ConvexConfig
) -> list[NDArray[np.float64]]:
    """Points of each convex piece."""
    if config.method == "coacd":
        return _by_coacd(verts, faces, config)
    clouds, excess = sliced(verts, faces, config.concavity, config.most)
    if config.method == "best" and excess > config.concavity:
        return _by_coacd(verts, faces, config)
    return clouds


def _by_coacd(
    verts: NDArray[np.float64], faces: NDArray[np.int64], config: ConvexConfig
) -> list[NDArray[np.float64]]:
    """Approximate convex decomposition (Wei et al. 2022)."""
    import coacd  # pyright: ignore[reportMissingImports]

    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(verts, faces.astype(np.int32)),
        threshold=config.concavity,
        max_convex_hull=config.most,
        preprocess_mode="off",
        mcts_iterations=60,
        mcts_nodes=15,
        seed=0,
    )
    return [np.asarray(part[0], np.float64) for part in parts]


def _hull(points: NDArray[np.float64]) -> Any:  # noqa: ANN401
    """The convex hull as a closed mesh; of flat points, a thin plate."""
    import trimesh
    from scipy.spatial import ConvexHull, QhullError

    for grow in (0.0, THINNEST):
        cloud = points
        if grow:
            corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, 8).T
            cloud = (points[:, None] + grow * corners).reshape(-1, 3)
        try:
            found = ConvexHull(cloud)
        except QhullError:
            continue
        if grow or 2 * found.volume > THINNEST * found.area / 2:
            break
    else:
        raise AssertionError("a thickened cloud has a hull")
    kept, faces = np.unique(found.simplices, return_inverse=True)
    shape = trimesh.Trimesh(cloud[kept], faces.reshape(-1, 3), process=False)
    shape.fix_normals()
    return shape


def _mesh_of(shape: Any) -> Mesh:  # noqa: ANN401
    return Mesh(
        torch.from_numpy(np.array(shape.vertices, np.float64)),
        torch.from_numpy(np.array(shape.faces, np.int64)),
    )
