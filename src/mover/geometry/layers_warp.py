"""First entry and first exit of rays as Warp kernels: same result as `raster_torch.layers`."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .kernels.start import kernels, launch, name_of, started
from .raster_records import Layers, Views


def layers(
    verts_cam: Float[Tensor, "items verts 3"], faces: Int[Tensor, "faces 3"], views: Views
) -> Layers:
    """See `raster.layers`. A call works in one thread and leaves Python's lock to others."""
    wp = started()
    items, n_verts, _ = verts_cam.shape
    points = verts_cam.detach().float().contiguous()
    front = points.new_zeros(items, views.height, views.width)
    leave = torch.full_like(front, -0.0)  # whose inverse is what stands for no exit
    if front.numel() * n_verts * len(faces) > 0:
        K = views.K.to(points)
        window = torch.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]], -1).contiguous()
        screen = wp.from_torch(torch.empty_like(points), dtype=wp.vec3)
        table = wp.from_torch(faces.to(points.device).long().contiguous(), dtype=wp.vec3l)
        maps = [wp.from_torch(front), wp.from_torch(leave)]
        exits = kernels("exits", name_of(points.device))
        verts = wp.from_torch(points, dtype=wp.vec3)
        windows = wp.from_torch(window, dtype=wp.vec4)
        launch(exits.project, (items, n_verts), [verts, windows, screen], points.device)
        launch(exits.draw, (items, len(faces)), [screen, table, *maps], points.device)
    return Layers(front.reciprocal_().to(verts_cam), leave.reciprocal_().to(verts_cam))
