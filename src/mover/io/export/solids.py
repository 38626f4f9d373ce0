"""Furniture for simulators: convex parts, mass and inertia, in a world with +z up.

A chair collides with its legs, not with its box: cuts along the axes are exact for boards and legs;
coacd does the rest where it is installed. Simulators have +z up and a floor at zero: (x, y, z) of
scene.json becomes (x, -z, y - ground). A turn about +y becomes the same turn about +z, and the
front of an object, +z of its mesh, becomes -y.
"""

import dataclasses
import heapq
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import count
from typing import Annotated, Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.core.observe import Observer, silent
from mover.core.records import record
from mover.core.run import Run
from mover.core.settings import float_in, int_in
from mover.core.types import Mesh, Scene, SceneObject
from mover.furniture.library import canonical
from mover.geometry.placement import place_object, placed_at
from mover.geometry.watertight import close_mesh
from mover.io.files.fields import At
from mover.io.files.meshes import read_mesh

PLANES = 24  # cuts that are tried along each axis
SMALLEST = 1e-7  # of the volume; less is a scrap of a cut


def sliced(
    verts: NDArray[np.float64], faces: NDArray[np.int64], concavity: float, most: int
) -> tuple[list[NDArray[np.float64]], float]:
    """Points of convex parts of a closed mesh, and what their hulls add, as a share of its volume.

    The part whose hull is the most too large is cut by the plane that leaves the smallest hulls,
    until all that hulls add is a share `concavity` of the volume, or there are `most` parts.
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

    def excess(rows: list[tuple[float, int, Any]]) -> float:
        return -sum(row[0] for row in rows)

    heap: list[tuple[float, int, Any]] = []
    done: list[Any] = []
    for part in solid.decompose():
        heapq.heappush(heap, (-_excess(part), next(order), part))
    while heap and len(heap) + len(done) < most and excess(heap) > concavity * total:
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


def _excess(part: Any) -> float:  # noqa: ANN401
    """What its hull adds to a part [m³]."""
    return part.hull().volume() - part.volume()


def _best_cut(part: Any) -> tuple[Any, Any] | None:  # noqa: ANN401
    """The two halves with the smallest hulls, None if no cut makes them smaller."""
    verts = np.array(part.to_mesh64().vert_properties[:, :3])
    least, found = _excess(part) * 0.999, None
    for axis, normal in enumerate(np.eye(3)):
        for at in _edges(verts[:, axis]):
            halves = part.split_by_plane(normal, at)
            if any(half.is_empty() for half in halves):
                continue
            excess = sum(_excess(half) for half in halves)
            if excess < least:
                least, found = excess, halves
    return found


def _edges(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where edges lie along an axis, thinned to `PLANES`, without the ends."""
    inner = np.unique(np.round(values, 5))
    span = inner[-1] - inner[0]
    inner = inner[(inner > inner[0] + 0.002 * span) & (inner < inner[-1] - 0.002 * span)]
    if len(inner) <= PLANES:
        return inner
    return inner[np.linspace(0, len(inner) - 1, PLANES).round().astype(int)]


# The parts, by the method that fits.


THINNEST = 0.001  # [m], of a convex part; flatter ones are thickened


@dataclass(frozen=True)
class ConvexConfig:
    """How furniture is cut into convex parts."""

    method: Literal["best", "coacd", "slices"] = "best"
    """slices: cuts along the axes by manifold3d, exact for boards; coacd: any shape, slower; best:
    coacd where slices leave hollows."""
    concavity: Annotated[float, float_in(0.01, 1)] = 0.04
    """How hollow a part may be, as a share of the object's size (coacd) or volume (slices)."""
    most: Annotated[int, int_in(1, 1000)] = 24
    """Parts of one object."""


@record
class ConvexInputs:
    """What is cut."""

    mesh: Mesh
    """Closed, in the coordinates of the object's own mesh [m]."""


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


def convex_of(item: SceneObject, run: Run) -> Convex:
    """The convex parts of an object's mesh at its initial size, kept in the result's folder."""
    config = ConvexConfig("slices" if find_spec("coacd") is None else "best")
    file, mesh = run.folder / "watertight" / f"{item.id}.glb", item.mesh
    if file.is_file():  # the proxy that the run wrote
        mesh, _ = read_mesh(At(file.name, "watertight", item.id), file.parent)
    return run.stage(cut_into_convex, ConvexInputs(close_mesh(mesh)), config)


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
    """Points of each convex part."""
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


# Mass and inertia.


DENSITY = {
    "chair": 500.0, "stool": 450.0, "bench": 450.0, "table": 450.0, "desk": 400.0,
    "coffee table": 400.0, "office chair": 250.0, "armchair": 90.0, "sofa": 80.0, "bed": 90.0,
    "shelf": 450.0, "cabinet": 170.0, "wardrobe": 120.0, "nightstand": 200.0, "floor lamp": 700.0,
}  # fmt: skip
"""Mass over the volume of the closed mesh [kg/m³]. Boards and legs are wood (450 to 700); what is
upholstered is mostly foam, and a cabinet's mesh is full where it is hollow: there the values
give usual weights (a sofa for two 45 kg, a wardrobe 80 kg)."""
OTHER = 250.0
LEAST = 0.05  # [kg]
FRICTION = (0.8, 0.005, 0.0001)  # wood on wood or carpet; slip, spin, roll
AXES = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
"""From +y up to +z up."""


@record
class Solid:
    """One object in the simulator's axes."""

    id: str
    category: str
    place: Float[Tensor, "3"]
    """Of the mesh's origin; the floor is at zero [m]."""
    yaw: float
    """About +z [rad]."""
    free: bool
    """False: it hangs or is built in, so it does not move."""
    hulls: tuple[Mesh, ...]
    """Convex parts in its own axes, at its size [m]."""
    mass: float
    """[kg]"""
    centre: Float[Tensor, "3"]
    """Centre of mass in its own axes [m]."""
    inertia: Float[Tensor, "3 3"]
    """About the centre of mass [kg m²]."""


def floor_height(scene: Scene) -> float:
    """Height of the floor, or of the lowest thing where no floor is known [m]."""
    if scene.ground is not None:
        return scene.ground
    lows = [float(place_object(p).verts[p.mesh.faces.unique(), 1].min()) for p in scene.objects]
    return min(lows, default=0.0)


def solids_of(scene: Scene, run: Run) -> tuple[Solid, ...]:
    """All objects of a scene; the folder of `run` keeps their convex parts."""
    floor = floor_height(scene)
    return tuple(_solid(item, convex_of(item, run), floor) for item in scene.objects)


def _solid(item: SceneObject, convex: Convex, floor: float) -> Solid:
    scale = item.scale.detach().cpu().double()
    place = AXES @ item.t_world_object.detach().cpu().double()
    place = place - torch.tensor([0.0, 0.0, floor], dtype=torch.float64)
    volume = abs(convex.volume) * float(scale.prod())
    mass = max(LEAST, volume * DENSITY.get(canonical(item.category), OTHER))
    inertia = AXES @ _stretched(convex.inertia, scale) @ AXES.mT * mass / max(volume, 1e-9)
    return Solid(
        id=item.id,
        category=item.category,
        place=place,
        yaw=float(item.yaw),
        free=item.support != "free",
        hulls=tuple(Mesh(h.verts.double() * scale @ AXES.mT, h.faces) for h in convex.hulls),
        mass=mass,
        centre=AXES @ (scale * convex.centre),
        inertia=_physical(inertia, mass),
    )


def moved_to(solid: Solid, item: SceneObject, frame: int) -> Solid:
    """The solid of an object where that stands in a frame."""
    there = placed_at(item, frame)
    way = AXES @ (there.t_world_object - item.t_world_object).detach().cpu().double()
    return dataclasses.replace(solid, place=solid.place + way, yaw=float(there.yaw))


def _stretched(inertia: Float[Tensor, "3 3"], scale: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Inertia of a solid that is stretched along its axes, at the same density."""
    spread = torch.eye(3, dtype=inertia.dtype) * inertia.trace() / 2 - inertia
    spread = spread * scale[:, None] * scale[None] * scale.prod()
    return torch.eye(3, dtype=inertia.dtype) * spread.trace() - spread


def _physical(inertia: Float[Tensor, "3 3"], mass: float) -> Float[Tensor, "3 3"]:
    """The inertia, at least that of a ball of 1 cm, so that thin shells stay valid bodies."""
    values, axes = torch.linalg.eigh((inertia + inertia.mT) / 2)
    spread = (values.sum() / 2 - values).clamp_min(mass * 1e-4 / 5)
    values = spread.sum() - spread
    return axes @ torch.diag(values) @ axes.mT


# Numbers and meshes as text.


def numbers(values: Iterable[float]) -> str:
    """Decimals with a space between them."""
    return " ".join(f"{value:.8g}" for value in values)


def mesh_bytes(mesh: Mesh) -> bytes:
    """A mesh as Wavefront OBJ: vertices and triangles."""
    import trimesh
    from trimesh.exchange.obj import export_obj

    shape = trimesh.Trimesh(mesh.verts.numpy(), mesh.faces.numpy(), process=False)
    return export_obj(shape, include_normals=False, header="").encode()
