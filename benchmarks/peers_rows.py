"""The rows of `peers.py`: for each stage, what is timed, and how far its results are apart."""

from collections.abc import Callable

import torch
from engine import Room, make_room
from gather import scene as walk
from peers_tools import (
    absent,
    deodr,
    embree,
    open3d_depth,
    open3d_distance,
    pytorch3d,
    rays,
)
from reference import use_engine
from solver import told
from torch import Tensor
from workload import workload

from mover.core.observe import silent
from mover.core.types import Layout
from mover.energy.config import Adam, SceneConfig
from mover.energy.fused.energy import energy_function
from mover.energy.objective import scene_energy
from mover.geometry import raster
from mover.geometry.nearest_warp import clouds, nearest
from mover.geometry.raster import Crops
from mover.geometry.volume import (
    BAND,
    SHELL,
    Volume,
    grid_around,
    sample,
    sample_torch,
    signed_distance,
)
from mover.geometry.volume_warp import union_bodies
from mover.geometry.warp_start import use_threads
from mover.pipeline.presets import ROBUST
from mover.stages.config import GatherConfig
from mover.stages.contacts.gather_cues import gather_cues
from mover.stages.objects.place_objects import descend, with_trees

Work = dict[str, Callable[[], object]]
Figures = dict[str, float]
COUNT, WINDOW, FACES = 10, 256, (2000, 10000, 20000)


def iteration(threads: int) -> tuple[Work, Figures]:
    """All six terms and their gradient, ten objects; and energies that fixed inputs must have."""
    work: Work = {}
    for faces in FACES:
        given = with_trees(workload(COUNT, faces, WINDOW))
        rest = given.objects, given.camera, given.image, given.humans
        scene = SceneConfig(ROBUST.place.weights, ROBUST.place.form)
        fast = energy_function(*rest, scene)

        def one(fast: object = fast, start: Layout = given.starts) -> Tensor:
            with use_threads(threads):
                return told(fast, start)

        def terms(
            engine: str,
            rest: tuple[object, ...] = rest,
            scene: SceneConfig = scene,
            start: Layout = given.starts,
        ) -> Tensor:
            with use_engine(engine), use_threads(threads):
                return told(lambda layout: scene_energy(layout, *rest, scene), start)

        work[f"iteration {faces}: one kernel"] = one
        work[f"iteration {faces}: terms, Warp"] = lambda f=terms: f("warp")
        work[f"iteration {faces}: terms, torch oracle"] = lambda f=terms: f("torch")
    return work, energies()


def energies() -> Figures:
    """Energies of a small scene: where it starts, and after 60 steps of Adam."""
    given = with_trees(workload(4, 2000, 64))
    rest = given.objects, given.camera, given.image, given.humans
    scene = SceneConfig(ROBUST.place.weights, ROBUST.place.form)
    fast = told(energy_function(*rest, scene), given.starts)
    figures = {}
    for engine in ("warp", "torch"):
        with use_engine(engine):
            slow = told(lambda layout: scene_energy(layout, *rest, scene), given.starts)
        off = (fast - slow)[:, 1:].norm() / slow[:, 1:].norm()
        figures[f"energy kernel - {engine}, relative"] = apart(fast[:, 0], slow[:, 0])
        figures[f"energy gradient kernel - {engine}, relative"] = float(off)
    method = Adam(60, 0.01, 0.002, keep_best=True)
    ends = [descend(given, ROBUST.place, given.starts, method, silent).value for _ in range(2)]
    return figures | {
        "energy at a fixed start": float(fast[:, 0].sum()),
        "energy after 60 steps": float(ends[0].sum()),
        "energy of two runs, differing": float((ends[0] != ends[1]).sum()),
    }


def apart(one: Tensor, two: Tensor) -> float:
    """Largest relative difference."""
    return float(((one - two).abs() / two.abs()).max())


def silhouettes(threads: int) -> tuple[Work, Figures]:
    """Ten objects in windows of 256 pixels, and the gradient of their vertices."""
    work: Work = {}
    for faces in FACES:
        room = make_room(COUNT, faces, WINDOW)

        def ours(engine: str, room: Room = room) -> tuple[Tensor, Tensor]:
            free = room.verts.clone().requires_grad_()
            with use_engine(engine), use_threads(threads):
                image = raster.silhouettes(free, room.shape, room.views)
                torch.autograd.backward((image - room.masks).square().sum())
            assert free.grad is not None
            return image.detach(), free.grad

        work[f"silhouette {faces}: Warp"] = lambda f=ours: f("warp")
        work[f"silhouette {faces}: torch oracle"] = lambda f=ours: f("torch")
        if not absent("deodr"):
            work[f"silhouette {faces}: DEODR"] = lambda r=room: deodr(r)
        if faces == FACES[0] and not absent("pytorch3d"):
            work[f"silhouette {faces}: PyTorch3D"] = lambda r=room: pytorch3d(r)
    return work, outlines()


def outlines() -> Figures:
    """How far silhouettes and their gradients are apart, four objects."""
    room = make_room(4, 2000, 128)
    drawn: dict[str, tuple[Tensor, Tensor]] = {}
    for engine in ("warp", "torch"):
        free = room.verts.clone().requires_grad_()
        with use_engine(engine):
            image, depth = raster.look(free, room.shape, room.views)
        assert depth is not None
        near = depth.nearest[depth.covered]
        torch.autograd.backward((image - room.masks).square().sum() + near.sum())
        assert free.grad is not None
        drawn[engine] = image.detach(), free.grad
    (ours, slope), (image, other) = drawn["warp"], drawn["torch"]
    figures = {
        "silhouette Warp - torch": float((ours - image).abs().max()),
        "silhouette gradient Warp - torch, relative": float((slope - other).norm() / other.norm()),
    }
    if not absent("deodr"):
        fine = torch.nn.functional.avg_pool2d(deodr(room, 1e-3, 8)[0][:, None], 8)[:, 0]
        hard, (soft, pulls) = deodr(room, 1e-3)[0], deodr(room)
        figures |= {
            "silhouette Warp - DEODR eight times finer, mean": float((ours - fine).mean().abs()),
            "silhouette Warp - DEODR, centres differing": differing(ours, hard),
        }
        print(
            f"not the same image: at its usual width, DEODR's band lies outside of the outline;"
            f" it covers {float((soft - ours).sum() / ours.sum()):.1%} more than we do, and its"
            f" gradient has a cosine of {alike(pulls, room):.2f} with ours"
        )
    if not absent("pytorch3d"):
        soft, first = pytorch3d(room)
        with torch.no_grad(), use_engine("warp"):
            near = raster.depths(room.verts, room.shape, room.views).nearest
        figures |= compared("Warp - PyTorch3D", near, first)
        print(f"PyTorch3D's soft silhouettes differ by {float((soft - ours).abs().mean()):.1e}")
    return figures


def alike(pulls: list[Tensor], room: Room) -> float:
    """Cosine between another gradient of all vertices and ours, of silhouettes alone."""
    free = room.verts.clone().requires_grad_()
    with use_engine("warp"):
        image = raster.silhouettes(free, room.shape, room.views)
    torch.autograd.backward((image - room.masks).square().sum())
    assert free.grad is not None
    own, other = free.grad.flatten(), torch.stack(pulls).flatten()
    return float(torch.nn.functional.cosine_similarity(own, other, dim=0))


def differing(one: Tensor, two: Tensor) -> float:
    """Share of the covered pixels whose centre only one of two images covers."""
    a, b = one > 0.5, two > 0.5
    return float((a ^ b).sum() / a.sum())


def depth(threads: int) -> tuple[Work, Figures]:
    """Where rays enter a body of 26,756 triangles at 640 x 360, in a new pose each time."""
    given = walk(2)
    cam = given.bodies.verts[:1] @ given.camera.R_cam_world.T
    faces = given.bodies.faces
    views = Crops(given.camera.K[None], given.camera.height, given.camera.width)

    def ours(engine: str) -> Tensor:
        with use_engine(engine), use_threads(threads):
            return raster.layers(cam, faces, views).front[0]

    found, ask = ours("warp"), rays(views)
    work: Work = {
        "depth: Warp, entry and exit": lambda: ours("warp"),
        "depth: torch oracle, entry and exit": lambda: ours("torch"),
    }
    figures = compared("Warp - torch", found, ours("torch"))
    if not absent("embreex"):
        work["depth: Embree, tree anew, entry"] = lambda: embree(cam[0], faces, views, ask)
        figures |= compared("Warp - Embree", found, embree(cam[0], faces, views, ask))
    if not absent("open3d"):
        work["depth: Open3D, tree anew, entry"] = lambda: open3d_depth(cam[0], faces, views, ask)
        figures |= compared("Warp - Open3D", found, open3d_depth(cam[0], faces, views, ask))
    return work, figures


def compared(pair: str, one: Tensor, two: Tensor) -> Figures:
    """Difference where both see a surface (all but one in 1,000), and how often only one does."""
    both = one.isfinite() & two.isfinite()
    only = one.isfinite() ^ two.isfinite()
    return {
        f"depth {pair}": float((one - two)[both].abs().quantile(0.999)),
        f"depth seen by one, {pair}": float(only.sum() / both.sum()),
    }


def distance(threads: int) -> tuple[Work, Figures]:
    """Signed distance to that body on a grid of 96 cells along its longest side."""
    given = walk(2).bodies
    body, faces = given.verts[:1], given.faces
    grid = grid_around(body[0].amin(0), body[0].amax(0), cells=96, padding=0.1)
    axes = [
        o + grid.cell * torch.arange(n) for o, n in zip(grid.origin, grid.values.shape, strict=True)
    ]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)

    def ours() -> Tensor:
        with use_engine("warp"):
            return union_bodies(body, faces, grid, threads).values.reshape(-1)

    found, exact = ours(), signed_distance(points, body[0], faces)
    near = exact < (SHELL - 0.01) * grid.cell
    some = points[near]
    assert float(found.max()) <= BAND * grid.cell + 1e-6
    work: Work = {
        "distance: Warp, inside and shell": ours,
        "distance: libigl, inside and shell": lambda: signed_distance(some, body[0], faces),
        "distance: libigl, all places": lambda: signed_distance(points, body[0], faces),
    }
    beyond = found[~near] < (SHELL - 0.02) * grid.cell
    figures = {
        "distance Warp - libigl": float((found - exact)[near].abs().max()),
        "distance beyond the shell, places": float(beyond.sum()),
    }
    if not absent("open3d"):
        work["distance: Open3D, inside and shell"] = lambda: open3d_distance(some, body[0], faces)
        work["distance: Open3D, all places"] = lambda: open3d_distance(points, body[0], faces)
        theirs = open3d_distance(some, body[0], faces)
        figures["distance Warp - Open3D, unsigned"] = float(
            (found[near].abs() - theirs.abs()).abs().max()
        )
        turned = int(((theirs < 0) != (exact[near] < 0)).sum())
        print(f"the sign of Open3D, by parity, differs at {turned:,} of {len(some):,} places")
    return work, figures


def lookup(threads: int) -> tuple[Work, Figures]:
    """50,000 points in a volume of 256 x 256 x 256, and the gradient."""
    draw = torch.Generator().manual_seed(0)
    axis = torch.linspace(-1, 1, 256)
    x, y, z = axis[:, None, None], axis[None, :, None], axis[None, None, :]
    ball = ((x * x + y * y + z * z).sqrt() - 0.5).clamp_max(0.1)
    volume = Volume(ball, torch.full((3,), -1.0), 2 / 255)
    points = torch.rand(50000, 3, generator=draw) * 1.9 - 0.95

    def ask(engine: str) -> tuple[Tensor, Tensor]:
        free = points.clone().requires_grad_()
        with use_engine(engine), use_threads(threads):
            value = (sample if engine == "warp" else sample_torch)(volume, free)
            torch.autograd.backward(value.clamp_max(0).square().sum())
        assert free.grad is not None
        return value.detach(), free.grad

    (ours, slope), (theirs, other) = ask("warp"), ask("torch")
    work: Work = {
        "lookup: Warp": lambda: ask("warp"),
        "lookup: torch oracle (grid_sample)": lambda: ask("torch"),
    }
    return work, {
        "lookup Warp - torch": float((ours - theirs).abs().max()),
        "lookup gradient Warp - torch, relative": float((slope - other).norm() / other.norm()),
    }


def neighbours(threads: int) -> tuple[Work, Figures]:
    """1,200 places to 1,500 points of each of ten objects whose sizes change at every call."""
    from scipy.spatial import KDTree

    draw = torch.Generator().manual_seed(0)
    points = torch.rand(COUNT, 1500, 3, generator=draw)
    query = torch.rand(COUNT, 1200, 3, generator=draw) * 1.4 - 0.2
    scale = torch.rand(COUNT, 3, generator=draw) + 0.5
    held, placed = clouds(points), (points * scale[:, None]).double().numpy()
    trees, asked = [KDTree(p) for p in placed], query.double().numpy()

    def ours() -> Tensor:
        with use_threads(threads):
            return nearest(held, query, scale)

    def anew() -> list[object]:
        pairs = zip(placed, asked, strict=True)
        return [KDTree(p).query(q, workers=threads) for p, q in pairs]

    def still() -> list[object]:
        pairs = zip(trees, asked, strict=True)
        return [t.query(q, workers=threads) for t, q in pairs]

    def far(index: Tensor) -> Tensor:
        at = torch.from_numpy(placed).gather(1, index[..., None].expand(-1, -1, 3))
        return (query.double() - at).norm(dim=-1)

    pairs = zip(trees, asked, strict=True)
    exact = torch.stack([torch.from_numpy(t.query(q)[0]) for t, q in pairs])
    work: Work = {
        "nearest: Warp, static trees": ours,
        "nearest: SciPy, trees anew": anew,
        "nearest: SciPy, static trees (wrong when a size changes)": still,
    }
    return work, {"nearest Warp - SciPy": float((far(ours()) - exact).abs().max())}


def gathering(threads: int) -> tuple[Work, Figures]:
    """Depth bounds and the volume of six bodies, coarse: whether workers change a bit."""
    given = walk(6)

    def run(workers: int) -> list[Tensor]:
        found = gather_cues(given, GatherConfig(cells=96, workers=workers))
        assert found.maps is not None
        return [found.space.volume.values, found.maps.near, found.maps.far, found.maps.free]

    differ = sum(int((a != b).sum()) for a, b in zip(run(1), run(threads), strict=True))
    return {}, {"gathering by one worker and by two, differing": float(differ)}


STAGES: dict[str, Callable[[int], tuple[Work, Figures]]] = {
    "iteration": iteration,
    "silhouette": silhouettes,
    "depth": depth,
    "distance": distance,
    "lookup": lookup,
    "nearest": neighbours,
    "gathering": gathering,
}
