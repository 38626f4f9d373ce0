"""What a user would pick instead of the engine: one call to each tool, on the engine's inputs."""

from functools import cache
from importlib.util import find_spec

import numpy as np
import torch
from engine import Room
from torch import Tensor

from mover.geometry.raster import Crops

SOFT, LAYERS = 1e-4, 10  # PyTorch3D: softness of an edge, triangles blended in a pixel


@cache
def absent(name: str) -> bool:
    """Whether a package is not here, said in one line."""
    gone = find_spec(name) is None
    if gone:
        print(f"{name} is not installed: its rows are left out")
    return gone


def deodr(room: Room, sigma: float = 1.0, finer: int = 1) -> tuple[Tensor, list[Tensor]]:
    """Silhouettes by DEODR, and how the vertices change their squared difference from the masks.

    Args:
        room: The objects.
        sigma: Width of the band that is drawn along outlines, outwards [pixels].
        finer: Pixels drawn along each side of a pixel; more than one gives no gradient.
    """
    from deodr.differentiable_renderer import Scene2D

    views, images, slopes = room.views, [], []
    size = views.height * finer, views.width * finer
    for item, verts in enumerate(room.verts):
        faces = room.shape.faces[item]
        faces = faces[(faces != 0).any(1)].numpy()
        free = verts.clone().requires_grad_()
        flat = free @ views.K[item].T
        place = flat[:, :2] / flat[:, 2:]
        ij = place.detach().double().numpy() * finer
        count, many = len(verts), len(faces)
        flags = outline(faces, facing(ij, faces))
        drawn = Scene2D(
            faces.astype(np.uint32), np.zeros((many, 3), np.uint32), ij,
            verts[:, 2].double().numpy(), np.zeros(many, bool), np.zeros((1, 2)), np.zeros(count),
            np.ones((count, 1)), np.zeros(many, bool), flags, *size, 1, np.zeros((0, 0, 1)),
            background_image=np.zeros((*size, 1)), backface_culling=True, clockwise=CLOCKWISE,
            integer_pixel_centers=False,
        )  # fmt: skip
        image, _ = drawn.render(sigma)
        if finer == 1:
            drawn.render_backward(2 * (image - room.masks[item].double().numpy()[..., None]))
            torch.autograd.backward(place, torch.from_numpy(drawn.ij_b).float())
            assert free.grad is not None
            slopes.append(free.grad)
        images.append(torch.from_numpy(image[..., 0]).float())
    return torch.stack(images), slopes


CLOCKWISE = False  # of outward triangles that face the camera, on a screen whose y points down


def facing(ij: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Whether each triangle faces the camera."""
    a, b, c = (ij[faces[:, k]] for k in range(3))
    u, v = b - a, c - a
    return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] < 0


@cache
def sides_of(table: bytes) -> tuple[np.ndarray, np.ndarray]:
    """The side that each corner of each triangle begins, and how many share a side; kept."""
    faces = np.frombuffer(table, np.int64).reshape(-1, 3)
    sides = np.sort(np.stack([faces, np.roll(faces, -1, 1)], -1), -1).reshape(-1, 2)
    index = np.unique(sides, axis=0, return_inverse=True)[1].ravel()
    return index, np.bincount(index)


def outline(faces: np.ndarray, front: np.ndarray) -> np.ndarray:
    """For each side of each triangle, whether one of its two triangles faces away."""
    index, total = sides_of(faces.tobytes())
    fronts = np.bincount(index, np.repeat(front, 3))
    edge = (fronts > 0) & ((fronts < total) | (total == 1))
    return edge[index].reshape(-1, 3)


def pytorch3d(room: Room, layers: int = LAYERS) -> tuple[Tensor, Tensor]:
    """Soft silhouettes and first depths by PyTorch3D, and the gradient of the former.

    Its square windows have the corner (1, 1) at the upper left, and x to the left.
    """
    from pytorch3d.renderer.mesh.rasterize_meshes import rasterize_meshes
    from pytorch3d.structures import Meshes

    size = room.views.height
    verts = room.verts.clone().requires_grad_()
    flat = verts @ room.views.K.mT
    screen = torch.cat([1 - 2 * flat[..., :2] / (flat[..., 2:] * size), flat[..., 2:]], -1)
    faces = [f[(f != 0).any(1)] for f in room.shape.faces]
    blur = float(np.log(1 / 1e-4 - 1)) * SOFT
    found, depth, _, off = rasterize_meshes(
        Meshes(list(screen), faces), size, blur, layers, perspective_correct=True
    )
    share = torch.sigmoid(-off / SOFT) * (found >= 0)
    image = 1 - (1 - share).prod(-1)
    torch.autograd.backward((image - room.masks).square().sum())
    hard = (found >= 0) & (off <= 0)
    first = torch.where(hard, depth, torch.inf).amin(-1)
    return image.detach(), first.detach()


def rays(views: Crops) -> np.ndarray:
    """A ray through the centre of each pixel of the first view, one long along z (h w 3)."""
    y, x = torch.meshgrid(
        torch.arange(views.height) + 0.5, torch.arange(views.width) + 0.5, indexing="ij"
    )
    return (torch.stack([x, y, torch.ones_like(x)], -1) @ views.K[0].inverse().T).float().numpy()


def boxed(verts: Tensor, views: Crops) -> tuple[slice, slice]:
    """Rows and columns that a mesh is seen in: outside of them no ray is needed."""
    flat = verts @ views.K[0].T
    flat = flat[:, :2] / flat[:, 2:]
    ends = torch.tensor([views.width, views.height])
    low = torch.minimum(flat.amin(0).clamp_min(0).floor().int(), ends).tolist()
    high = torch.minimum(flat.amax(0).clamp_min(0).ceil().int() + 1, ends).tolist()
    return slice(low[1], high[1]), slice(low[0], high[0])


def embree(verts: Tensor, faces: Tensor, views: Crops, every: np.ndarray) -> Tensor:
    """Depth of the first hit by Embree (embreex); the tree is built for this pose."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, verts[faces].numpy().astype(np.float32))
    window = boxed(verts, views)
    ask = every[window]
    flat = ask.reshape(-1, 3)
    far = np.asarray(scene.run(np.zeros_like(flat), flat, query="DISTANCE"))
    depth = torch.full((views.height, views.width), torch.inf)
    depth[window] = torch.from_numpy(np.where(far < 1e6, far, np.inf)).float().view(ask.shape[:2])
    return depth


def open3d_depth(verts: Tensor, faces: Tensor, views: Crops, every: np.ndarray) -> Tensor:
    """Depth of the first hit by Open3D, which asks Embree too; the tree is built for this pose."""
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(verts.numpy(), faces.numpy().astype(np.uint32))
    window = boxed(verts, views)
    ask = every[window]
    hit = scene.cast_rays(np.concatenate([np.zeros_like(ask), ask], -1))["t_hit"].numpy()
    depth = torch.full((views.height, views.width), torch.inf)
    depth[window] = torch.from_numpy(hit)
    return depth


def open3d_distance(points: Tensor, verts: Tensor, faces: Tensor) -> Tensor:
    """Signed distances by Open3D, whose sign is the parity of a ray's crossings."""
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(verts.numpy(), faces.numpy().astype(np.uint32))
    return torch.from_numpy(scene.compute_signed_distance(points.numpy()).numpy())
