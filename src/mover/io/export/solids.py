"""Furniture for simulators: convex parts, mass and inertia, in a world with +z up.

A chair collides with its legs, not with its box: cuts along the axes are exact for boards and legs;
coacd does the rest where it is installed. Simulators have +z up and a floor at zero: (x, y, z) of
scene.json becomes (x, -z, y - ground). A turn about +y becomes the same turn about +z, and the
front of an object, +z of its mesh, becomes -y.

MuJoCo's room.xml has furniture as free bodies of convex parts, without people. Objects are drawn in
one colour: textures are in scene.glb and in USD.
"""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.core.colours import colour
from mover.core.files import replacing
from mover.core.observe import Observer, silent
from mover.core.records import record
from mover.core.run import Run
from mover.core.types import Mesh, Scene, SceneObject
from mover.furniture.library import canonical
from mover.geometry.placement import place_object, placed_at
from mover.geometry.watertight import close_mesh
from mover.io.export.finished import Exported, Finished
from mover.io.files.fields import At
from mover.io.files.meshes import read_mesh

PLANES = 24  # cuts that are tried along each axis
SMALLEST = 1e-7  # of the volume; less is a scrap of a cut
HOLLOW = 0.04  # of a part, as a share of the object's size (CoACD) or volume (slices)
MOST = 24  # parts of one object
THINNEST = 0.001  # [m], of a convex part; flatter ones are thickened
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


def sliced(
    verts: NDArray[np.float64], faces: NDArray[np.int64]
) -> tuple[list[NDArray[np.float64]], float]:
    """Points of convex parts of a closed mesh, and what their hulls add, as a share of its volume.

    The part whose hull is the most too large is cut by the plane that leaves the smallest hulls,
    until all that hulls add is a share `HOLLOW` of the volume, or there are `MOST` parts.
    """
    import manifold3d

    mesh = manifold3d.Mesh64(
        vert_properties=np.ascontiguousarray(verts),
        tri_verts=np.ascontiguousarray(faces.astype(np.uint64)),
    )
    solid = manifold3d.Manifold(mesh)
    if solid.is_empty():
        return [verts], float("inf")
    total, done = solid.volume(), list[Any]()
    parts = [(_excess(part), part) for part in solid.decompose()]
    while parts and len(parts) + len(done) < MOST and sum(e for e, _ in parts) > HOLLOW * total:
        _, worst = parts.pop(max(range(len(parts)), key=lambda k: parts[k][0]))
        halves = _best_cut(worst)
        if halves is None:
            done.append(worst)
            continue
        smaller = [part for half in halves for part in half.decompose()]
        parts += [(_excess(part), part) for part in smaller if part.volume() > SMALLEST * total]
    done += [part for _, part in parts]
    clouds = [np.array(part.to_mesh64().vert_properties[:, :3]) for part in done]
    return clouds, sum(_excess(part) for part in done) / total


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


@dataclass(frozen=True)
class ConvexConfig:
    """How furniture is cut into convex parts."""

    method: Literal["best", "coacd", "slices"] = "best"
    """slices: cuts along the axes by manifold3d, exact for boards; coacd: any shape, slower; best:
    coacd where slices leave hollows."""


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


def cut_into_convex(
    inputs: ConvexInputs, config: ConvexConfig, observe: Observer = silent
) -> Convex:
    """Cut a closed mesh; one that is convex as it is stays whole."""
    del observe
    import trimesh

    verts = inputs.mesh.verts.double().numpy()
    faces = inputs.mesh.faces.numpy()
    solid = trimesh.Trimesh(verts, faces, process=False)
    whole, method = _hull(verts), config.method
    clouds, excess = [verts], 0.0
    if whole.volume - solid.volume >= 0.01 * whole.volume:
        if method != "coacd":
            clouds, excess = sliced(verts, faces)
        if method == "coacd" or (method == "best" and excess > HOLLOW):
            clouds = _by_coacd(verts, faces)
    return Convex(
        tuple(
            Mesh(torch.from_numpy(np.array(hull.vertices)), torch.from_numpy(np.array(hull.faces)))
            for hull in map(_hull, clouds)
            if hull.volume > 0
        ),
        float(solid.volume),
        torch.from_numpy(np.array(solid.center_mass)),
        torch.from_numpy(np.array(solid.moment_inertia)),
    )


def _by_coacd(verts: NDArray[np.float64], faces: NDArray[np.int64]) -> list[NDArray[np.float64]]:
    """Approximate convex decomposition (Wei et al. 2022)."""
    import coacd  # pyright: ignore[reportMissingImports]

    coacd.set_log_level("error")
    search: dict[str, Any] = {"mcts_iterations": 60, "mcts_nodes": 15, "seed": 0}
    mesh = coacd.Mesh(verts, faces.astype(np.int32))
    parts = coacd.run_coacd(
        mesh, threshold=HOLLOW, max_convex_hull=MOST, preprocess_mode="off", **search
    )
    return [np.asarray(part[0], np.float64) for part in parts]


def _hull(points: NDArray[np.float64]) -> Any:  # noqa: ANN401
    """The convex hull as a closed mesh; of flat points, a thin plate."""
    import trimesh
    from scipy.spatial import ConvexHull, QhullError

    try:
        found = ConvexHull(points)
    except QhullError:
        found = None
    if found is None or 2 * found.volume <= THINNEST * found.area / 2:
        corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, 8).T
        points = (points[:, None] + THINNEST * corners).reshape(-1, 3)
        found = ConvexHull(points)
    kept, faces = np.unique(found.simplices, return_inverse=True)
    shape = trimesh.Trimesh(points[kept], faces.reshape(-1, 3), process=False)
    shape.fix_normals()
    return shape


@record
class Solid:
    """One object in the simulator's axes."""

    id: str
    position: Float[Tensor, "3"]
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
    """Height of the floor, or of the lowest point where no floor is known [m]."""
    if scene.ground is not None:
        return scene.ground
    lows = [float(place_object(p).verts[p.mesh.faces.unique(), 1].min()) for p in scene.objects]
    return min(lows, default=0.0)


def solids_of(scene: Scene, run: Run) -> tuple[Solid, ...]:
    """All objects of a scene; the folder of `run` keeps their convex parts."""
    floor, found = floor_height(scene), list[Solid]()
    config = ConvexConfig("slices" if find_spec("coacd") is None else "best")
    for item in scene.objects:
        file, mesh = run.folder / "watertight" / f"{item.id}.glb", item.mesh
        if file.is_file():  # the proxy that the run wrote
            mesh, _ = read_mesh(At(file.name, "watertight", item.id), file.parent)
        convex = run.stage(cut_into_convex, ConvexInputs(close_mesh(mesh)), config)
        found.append(_solid(item, convex, floor))
    return tuple(found)


def _solid(item: SceneObject, convex: Convex, floor: float) -> Solid:
    scale = item.scale.detach().cpu().double()
    position = AXES @ item.t_world_object.detach().cpu().double()
    position = position - torch.tensor([0.0, 0.0, floor], dtype=torch.float64)
    volume = abs(convex.volume) * float(scale.prod())
    mass = max(LEAST, volume * DENSITY.get(canonical(item.category), OTHER))
    one = torch.eye(3, dtype=scale.dtype)  # of a solid that is stretched at the same density
    spread = one * convex.inertia.trace() / 2 - convex.inertia
    spread = spread * scale[:, None] * scale[None] * scale.prod()
    stretched = one * spread.trace() - spread
    inertia = AXES @ stretched @ AXES.mT * mass / max(volume, 1e-9)
    return Solid(
        id=item.id, position=position, yaw=float(item.yaw), free=item.support != "free",
        hulls=tuple(Mesh(h.verts.double() * scale @ AXES.mT, h.faces) for h in convex.hulls),
        mass=mass, centre=AXES @ (scale * convex.centre), inertia=_physical(inertia, mass),
    )  # fmt: skip


def moved_to(solid: Solid, item: SceneObject, frame: int) -> Solid:
    """The solid of an object where that stands in a frame."""
    there = placed_at(item, frame)
    way = AXES @ (there.t_world_object - item.t_world_object).detach().cpu().double()
    return dataclasses.replace(solid, position=solid.position + way, yaw=float(there.yaw))


def _physical(inertia: Float[Tensor, "3 3"], mass: float) -> Float[Tensor, "3 3"]:
    """The inertia, at least that of a ball of 1 cm, so that thin shells stay valid bodies."""
    values, axes = torch.linalg.eigh((inertia + inertia.mT) / 2)
    spread = (values.sum() / 2 - values).clamp_min(mass * 1e-4 / 5)
    values = spread.sum() - spread
    return axes @ torch.diag(values) @ axes.mT


STEP = 0.002  # [s]
VISUAL, COLLISION = "meshes/visual", "meshes/collision"
RESERVED = "world"


def export_mjcf(finished: Finished, folder: Path) -> Exported:
    """Write `mjcf/room.xml` and its meshes."""
    solids = solids_of(finished.scene, Run(finished.out))
    root, meshes = mjcf_of(finished.scene, solids)
    masses = ", ".join(f"{solid.id} {float(f'{solid.mass:.2g}'):g} kg" for solid in solids)
    notes = ["+z is up and the floor is at 0", masses, "no people"]
    if any(item.segments for item in finished.scene.objects):
        _add_stays(root, finished, solids)
        notes.append("qpos of a keyframe, frame_<number>, puts furniture where it then stands")
    home = folder / "mjcf"
    for name, content in {**meshes, "room.xml": text_of(root).encode()}.items():
        with replacing(home / name) as part:
            part.write_bytes(content)
    return Exported((home / "room.xml",), tuple(notes))


def text_of(root: Element) -> str:
    """The model as a file has it."""
    indent(root)
    return tostring(root, encoding="unicode") + "\n"


def mjcf_of(
    scene: Scene, solids: Sequence[Solid], looks: bool = True
) -> tuple[Element, dict[str, bytes]]:
    """The model, and its mesh files by name; with `looks` also the meshes that are only seen."""
    import trimesh
    from trimesh.exchange.obj import export_obj

    root = Element("mujoco", model="room")
    SubElement(root, "compiler", angle="radian", autolimits="true")
    option = SubElement(root, "option", timestep=f"{STEP}", integrator="implicitfast")
    option.set("cone", "elliptic")
    SubElement(option, "flag", multiccd="enable")
    default = SubElement(root, "default")
    unseen = {"contype": "0", "conaffinity": "0", "mass": "0"}
    for kind, geom in {
        "collide": {"type": "mesh", "group": "3", "friction": numbers(FRICTION), "condim": "4"},
        "look": {"type": "mesh", "group": "2", **unseen},
    }.items():
        SubElement(SubElement(default, "default", {"class": kind}), "geom", geom)
    asset, world = SubElement(root, "asset"), SubElement(root, "worldbody")
    lamp = {"ambient": "0.4 0.4 0.4", "diffuse": "0.5 0.5 0.5"}
    SubElement(SubElement(root, "visual"), "headlight", lamp)
    SubElement(world, "light", pos="0 0 4", dir="0 0 -1", diffuse="0.5 0.5 0.5")
    camera = scene.camera  # MuJoCo's cameras look along -z with +y up
    turn = AXES @ camera.R_cam_world.detach().cpu().double().mT
    axes = numbers((*turn[:, 0].tolist(), *(-turn[:, 1]).tolist()))
    lens = 2 * math.degrees(math.atan(camera.height / (2 * float(camera.K[1, 1]))))
    eye = {"name": "camera", "pos": numbers((0, 0, -floor_height(scene))), "xyaxes": axes}
    SubElement(world, "camera", eye, fovy=f"{lens:.8g}")
    size = 5.0 + max((float(s.position[:2].abs().max()) for s in solids), default=0.0)
    ground = {"name": "ground", "type": "plane", "size": f"{size:g} {size:g} 0.1"}
    SubElement(world, "geom", ground, rgba="0.86 0.85 0.83 1", friction=numbers(FRICTION))
    meshes: dict[str, bytes] = {}
    for index, (item, solid) in enumerate(zip(scene.objects, solids, strict=True)):
        body, name = _add_solid(world, solid), body_name(solid)
        shapes = [(f"{COLLISION}/{name}_{k}.obj", hull) for k, hull in enumerate(solid.hulls)]
        stretch = AXES * item.scale.detach().cpu().double()
        shape = Mesh(item.mesh.verts.detach().cpu().double() @ stretch.mT, item.mesh.faces.cpu())
        drawn = [(f"{VISUAL}/{name}.obj", shape)] if looks else []
        for file, mesh in [*shapes, *drawn]:
            drawing = trimesh.Trimesh(mesh.verts.numpy(), mesh.faces.numpy(), process=False)
            meshes[file] = export_obj(drawing, include_normals=False, header="").encode()
            part = file.removesuffix(".obj").replace("/", "_")
            SubElement(asset, "mesh", name=part, file=file, inertia="shell")
            geom = {"class": "collide", "mesh": part}
            if file.startswith(VISUAL):
                geom = {"class": "look", "mesh": part, "rgba": numbers((*colour(index), 1.0))}
            SubElement(body, "geom", geom)
    return root, meshes


def numbers(values: Iterable[float]) -> str:
    """Decimals with a space between them."""
    return " ".join(f"{value:.8g}" for value in values)


def body_name(solid: Solid) -> str:
    """Its id, but for the one name that MuJoCo keeps for itself."""
    return solid.id if solid.id != RESERVED else f"{solid.id}_"


def _pose_of(solid: Solid) -> tuple[float, ...]:
    """Position [m] and quaternion (w, x, y, z), as a free joint has them."""
    half = torch.tensor(solid.yaw / 2, dtype=torch.float64)
    return (*solid.position.tolist(), float(half.cos()), 0.0, 0.0, float(half.sin()))


def _add_solid(world: Element, solid: Solid) -> Element:
    """A body with its mass, and a joint where it is free."""
    name, pose = body_name(solid), _pose_of(solid)
    body = SubElement(world, "body", name=name, pos=numbers(pose[:3]), quat=numbers(pose[3:]))
    if solid.free:
        SubElement(body, "freejoint", name=name)
    i = solid.inertia
    full = (i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2])
    mass = {"pos": numbers(solid.centre.tolist()), "mass": f"{solid.mass:.8g}"}
    SubElement(body, "inertial", mass, fullinertia=numbers([float(v) for v in full]))
    return body


def _add_stays(root: Element, finished: Finished, solids: Sequence[Solid]) -> None:
    """A keyframe for each change, with the furniture where it then stands."""
    keys, objects = SubElement(root, "keyframe"), finished.scene.objects
    first, fps = finished.clock
    for frame in sorted({s.frame for item in objects for s in item.segments}):
        pairs = zip(objects, solids, strict=True)
        stands = [moved_to(solid, item, frame) for item, solid in pairs if solid.free]
        key = {"name": f"frame_{frame}", "time": f"{max(0.0, (frame - first) / fps):.6g}"}
        key["qpos"] = numbers(value for solid in stands for value in _pose_of(solid))
        SubElement(keys, "key", key)
