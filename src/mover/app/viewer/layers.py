"""The evidence as things that can be drawn, read back from the stages that a run left on disk."""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mover.core import records
from mover.core.records import record
from mover.core.types import Camera, Mesh, Scene
from mover.energy.human_terms import ContactPoints, DepthMaps
from mover.geometry.boxes import box_of
from mover.geometry.camera import pitch_roll, tilted, to_camera, to_world
from mover.geometry.placement import LOWEST, hit_floor
from mover.geometry.volume import Volume
from mover.stages.contacts.assign_contacts import ContactAssignment
from mover.stages.contacts.gather_cues import Cues
from mover.stages.masks import small_camera

MOST_POINTS = 30_000  # of each depth map
MOST_CELLS = 96  # along the longest side of the free space, when its surface is drawn
LIKELY = math.sqrt(5.991)  # the ellipse that holds 95 % of a normal distribution in the plane
USUAL = math.sqrt(4.605)  # the same for 90 %
CORNERS = 48  # of an ellipse


@dataclass(frozen=True)
class Layers:
    """What is known of a run's evidence; None and empty: it is not there."""

    near: Float[Tensor, "near 3"] | None = None
    """Nothing of an object is nearer than these points [m]: people passed in front of it."""
    far: Float[Tensor, "far 3"] | None = None
    """An object is at least as near as these points [m]: it hid people."""
    space: Mesh | None = None
    """Surface of all that people's bodies have moved through [m]."""
    contacts: dict[str, Float[Tensor, "points 3"]] = field(default_factory=lambda: {})
    """Points of bodies that touch an object [m], by its id."""
    ellipses: dict[str, Float[Tensor, "corners 3"]] = field(default_factory=lambda: {})
    """95 % of where the floor and camera let an object stand [m], by its id."""
    places: dict[str, Float[Tensor, "corners 3"]] = field(default_factory=lambda: {})
    """90 % of where all evidence together lets the middle of an object stand [m], by its id."""


@record
class DepthPoints:
    """Two depth maps as points in the world."""

    near: Float[Tensor, "near 3"]
    far: Float[Tensor, "far 3"]


def depth_points(maps: DepthMaps, camera: Camera) -> DepthPoints:
    """Where the rays of the pixels reach their bounds [m]; `camera` is that of the video."""
    small = small_camera(camera)
    return DepthPoints(_reached(maps.near, small), _reached(maps.far, small))


def _reached(depth: Float[Tensor, "h w"], camera: Camera) -> Float[Tensor, "points 3"]:
    y, x = torch.nonzero(depth.isfinite() & (depth > 0), as_tuple=True)
    every = max(1, -(-len(x) // MOST_POINTS))
    y, x = y[::every], x[::every]
    pixels = torch.stack([x + 0.5, y + 0.5, torch.ones_like(x)], -1).to(depth)
    rays = pixels @ torch.linalg.inv(camera.K).mT
    return to_world(rays * depth[y, x].unsqueeze(-1), camera.R_cam_world)


def space_surface(volume: Volume) -> Mesh | None:
    """The surface of the bodies' space; thin parts survive the coarser grid. None: it is empty."""
    import igl

    step = max(1, -(-max(volume.values.shape) // MOST_CELLS))
    padded = torch.nn.functional.pad(volume.values[None], (step, step) * 3, value=math.inf)[0]
    small = -torch.nn.functional.max_pool3d(-padded[None], step, step, ceil_mode=True)[0]
    small = small.clamp_max(4 * volume.cell)
    if not bool((small < 0).any()):
        return None
    axes = [torch.arange(n) for n in small.shape]
    z, y, x = torch.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    cells = torch.stack([x, y, z], -1).reshape(-1, 3).double()
    middle = volume.origin.double() + volume.cell * (cells * step - step + (step - 1) / 2)
    level = small.permute(2, 1, 0).reshape(-1).double().numpy()
    found = igl.marching_cubes(level, middle.numpy(), *small.shape, isovalue=0.0)
    verts, faces = np.array(found[0], dtype=np.float32), np.array(found[1], dtype=np.int64)
    return Mesh(torch.from_numpy(verts), torch.from_numpy(faces)) if len(faces) else None


def contact_points(touches: ContactPoints | None, ids: tuple[str, ...]) -> dict[str, Tensor]:
    """The body points that touch each object [m]."""
    if touches is None:
        return {}
    return {
        ids[of]: touches.points[row][touches.weight[row] > 0]
        for row, of in enumerate(touches.object_of.tolist())
    }


def floor_ellipses(
    scene: Scene, covariance: Float[Tensor, "3 3"]
) -> dict[str, Float[Tensor, "corners 3"]]:
    """How far the doubt about the camera and the floor moves each object that stands on it.

    An object stands where the ray to its base meets the floor, so its place on the floor follows
    from pitch, roll and ground; their covariance is carried along by the derivative.

    Args:
        scene: The room with its floor.
        covariance: Of pitch [rad], roll [rad] and ground [m].
    """
    if scene.ground is None:
        return {}
    camera, ground = scene.camera.R_cam_world.double(), float(scene.ground)
    pitch, roll = pitch_roll(camera)
    tilt = torch.stack([pitch, roll, torch.tensor(ground, dtype=torch.float64)])
    found: dict[str, Tensor] = {}
    for piece in scene.objects:
        box = box_of(piece)
        base = box.center.double() - torch.tensor([0.0, 0.5, 0.0]) * box.size.double()
        if piece.support != "ground" or -base[1] <= 2 * LOWEST * base.norm():
            continue
        ray = to_camera(base, camera)

        def stands(at: Tensor, ray: Tensor = ray) -> Tensor:
            return hit_floor(ray, tilted(at[0], at[1]), at[2])[[0, 2]]

        slope = torch.autograd.functional.jacobian(stands, tilt)
        found[piece.id] = _ellipse(base, slope @ covariance.double() @ slope.mT, ground)
    return found


def place_ellipses(rows: Sequence[Mapping[str, Any]]) -> dict[str, Float[Tensor, "corners 3"]]:
    """How well each object's place is known, from the explanations of run.json."""
    found: dict[str, Tensor] = {}
    for row in rows:
        doubt = row["uncertainty"]
        base = torch.tensor(doubt["base"], dtype=torch.float64)
        spread = torch.tensor(doubt["covariance"], dtype=torch.float64)[[0, 2]][:, [0, 2]]
        found[str(row["id"])] = _ellipse(base, spread, float(base[1]), USUAL)
    return found


def _ellipse(
    base: Float[Tensor, "3"], spread: Float[Tensor, "2 2"], ground: float, likely: float = LIKELY
) -> Float[Tensor, "corners 3"]:
    values, axes = torch.linalg.eigh(spread)
    angle = torch.arange(CORNERS, dtype=torch.float64) * (2 * math.pi / CORNERS)
    circle = torch.stack([angle.cos(), angle.sin()], -1)
    flat = base[[0, 2]] + likely * (circle * values.clamp_min(0).sqrt()) @ axes.mT
    return torch.stack([flat[:, 0], torch.full_like(angle, ground), flat[:, 1]], -1).float()


# Read the evidence back from the stages that a run left on disk.


log = logging.getLogger(__name__)
Out = TypeVar("Out")


def read_layers(out: Path, run: Mapping[str, Any], scene: Scene) -> Layers:
    """The evidence of a result; what a run did not leave, or not in today's form, is left out."""
    cues = _last(Cues, "gather_cues", out, run)
    contacts = _last(ContactAssignment, "assign_contacts", out, run)
    points = None
    if cues is not None and cues.maps is not None:
        points = depth_points(cues.maps, scene.camera)
    spread = run.get("camera_covariance")
    return Layers(
        near=None if points is None else points.near,
        far=None if points is None else points.far,
        space=None if cues is None else space_surface(cues.space.volume),
        contacts=contact_points(
            None if contacts is None else contacts.points, tuple(p.id for p in scene.objects)
        ),
        ellipses={} if spread is None else floor_ellipses(scene, torch.tensor(spread)),
        places=place_ellipses(run.get("explanations", ())),
    )


def _last(kind: type[Out], stage: str, out: Path, run: Mapping[str, Any]) -> Out | None:
    """The output of a stage when it last ran."""
    names = [str(s.get("fingerprint") or "") for s in run.get("stages", ()) if s["name"] == stage]
    if not names or not names[-1]:
        return None
    path = out / "stages" / stage / names[-1]
    if not path.with_suffix(".json").is_file():
        return None
    try:
        return records.load(kind, path)
    except Exception as error:  # another version's records may differ in any way
        log.warning("%s of %s cannot be shown: %s", stage, out, error)
        return None
