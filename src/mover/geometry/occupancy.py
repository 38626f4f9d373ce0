"""A closed mesh from an Occupancy Network for point clouds (Mescheder et al., CVPR 2019).

The paper closes the meshes of its detector with it. The parameters have the names and shapes of
the authors' checkpoints (`onet_pcl2mesh`), so that a published file loads by its keys; widths are
read off the file. Encoder: a ResNet-PointNet. Decoder: five residual blocks whose batch norms take
scale and shift from the shape's code. The surface is found by multiresolution extraction and
marching cubes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from mover.core.errors import InputError
from mover.core.settings import float_in, int_in
from mover.core.types import Mesh
from mover.geometry.mesh import box, fit_box, sample_surface, used

BLOCKS = 5
PADDING = 1.1  # side of the box around the unit cube, as MOVER runs it; so is the next
POINTS = 2048  # of the cloud that is encoded
OUTSIDE = -1e6  # logit beyond the box, so that every surface closes
AT_ONCE = 100_000  # points that the network sees
Inside = Callable[[Float[Tensor, "points 3"]], Float[Tensor, " points"]]


class _Residual(nn.Module):
    """Two linear layers beside a shortcut."""

    def __init__(self, size_in: int, size_out: int) -> None:
        super().__init__()
        inner = min(size_in, size_out)
        self.fc_0, self.fc_1 = nn.Linear(size_in, inner), nn.Linear(inner, size_out)
        self.shortcut = nn.Linear(size_in, size_out, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return self.shortcut(x) + self.fc_1(self.fc_0(x.relu()).relu())


class _Encoder(nn.Module):
    """Code of a point cloud; each block sees its own point and the largest value of all."""

    def __init__(self, hidden: int, code: int) -> None:
        super().__init__()
        self.fc_pos, self.fc_c = nn.Linear(3, 2 * hidden), nn.Linear(hidden, code)
        for k in range(BLOCKS):
            self.add_module(f"block_{k}", _Residual(2 * hidden, hidden))

    def forward(self, points: Float[Tensor, "shapes points 3"]) -> Float[Tensor, "shapes code"]:
        x = self.get_submodule("block_0")(self.fc_pos(points))
        for k in range(1, BLOCKS):
            pooled = x.amax(1, keepdim=True).expand_as(x)
            x = self.get_submodule(f"block_{k}")(torch.cat([x, pooled], -1))
        return self.fc_c(x.amax(1).relu())


class _Norm(nn.Module):
    """Batch norm whose scale and shift are linear in the code."""

    def __init__(self, code: int, size: int) -> None:
        super().__init__()
        self.conv_gamma, self.conv_beta = nn.Conv1d(code, size, 1), nn.Conv1d(code, size, 1)
        self.bn = nn.BatchNorm1d(size, affine=False)

    def forward(self, x: Tensor, code: Tensor) -> Tensor:
        return self.conv_gamma(code) * self.bn(x) + self.conv_beta(code)


class _Block(nn.Module):
    """Two layers, each after a conditional norm, added to what came in."""

    def __init__(self, code: int, size: int) -> None:
        super().__init__()
        self.bn_0, self.bn_1 = _Norm(code, size), _Norm(code, size)
        self.fc_0, self.fc_1 = nn.Conv1d(size, size, 1), nn.Conv1d(size, size, 1)

    def forward(self, x: Tensor, code: Tensor) -> Tensor:
        inner = self.fc_0(self.bn_0(x, code).relu())
        return x + self.fc_1(self.bn_1(inner, code).relu())


class _Decoder(nn.Module):
    """Is a point inside the shape of a code? A latent code, where there is one, is at its mean."""

    def __init__(self, code: int, hidden: int, latent: int) -> None:
        super().__init__()
        if latent:
            self.fc_z = nn.Linear(latent, hidden)
        self.latent = latent
        self.fc_p, self.fc_out = nn.Conv1d(3, hidden, 1), nn.Conv1d(hidden, 1, 1)
        for k in range(BLOCKS):
            self.add_module(f"block{k}", _Block(code, hidden))
        self.bn = _Norm(code, hidden)

    def forward(
        self, points: Float[Tensor, "shapes points 3"], code: Float[Tensor, "shapes code"]
    ) -> Float[Tensor, "shapes points"]:
        x, column = self.fc_p(points.mT), code[..., None]
        if self.latent:
            x = x + self.fc_z(x.new_zeros(len(x), self.latent))[..., None]
        for k in range(BLOCKS):
            x = self.get_submodule(f"block{k}")(x, column)
        return self.fc_out(self.bn(x, column).relu())[:, 0]


class OccupancyNetwork(nn.Module):
    """Encoder and decoder."""

    def __init__(self, code: int, encoder: int, decoder: int, latent: int = 0) -> None:
        super().__init__()
        self.encoder, self.decoder = _Encoder(encoder, code), _Decoder(code, decoder, latent)

    def forward(
        self, cloud: Float[Tensor, "shapes cloud 3"], points: Float[Tensor, "shapes points 3"]
    ) -> Float[Tensor, "shapes points"]:
        """Logits of points being inside the shape of a point cloud."""
        return self.decoder(points, self.encoder(cloud))


def load_occupancy(path: Path) -> OccupancyNetwork:
    """The network of a checkpoint (`model.pt`, `onet_pcl2mesh-*.pt`), ready for use.

    No code in the file is executed.

    Raises:
        InputError: If the file is missing, is no checkpoint of a point-cloud network, or keys are
            missing, unknown, or of another shape.
    """
    name = path.name
    if not path.is_file():
        raise InputError(f"{path}: there is no such file, expected an Occupancy Network")
    try:
        tree: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises what the damage happens to cause
        text = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise InputError(f"{name}: cannot be read ({text}), expected a checkpoint") from error
    state: Any = tree.get("model", tree) if isinstance(tree, dict) else None
    if not isinstance(state, dict) or not all(isinstance(v, Tensor) for v in state.values()):
        raise InputError(f"{name}: holds no parameters, expected the field 'model' of a checkpoint")
    try:
        return network_of(state)
    except (KeyError, ValueError, RuntimeError, IndexError) as error:
        text = str(error).splitlines()[0][:120]
        raise InputError(
            f"{name}: is not an Occupancy Network for point clouds ({text}), expected "
            "pointnet_resnet and cbatchnorm, as in onet_pcl2mesh"
        ) from error


def network_of(state: dict[str, Tensor]) -> OccupancyNetwork:
    """The network whose parameters have these names and shapes.

    Raises:
        KeyError, ValueError, RuntimeError, IndexError: If it is another network's.
    """
    state = {key.removeprefix("module."): value for key, value in state.items()}
    code, encoder = state["encoder.fc_c.weight"].shape
    decoder = state["decoder.fc_p.weight"].shape[0]
    latent = state["decoder.fc_z.weight"].shape[1] if "decoder.fc_z.weight" in state else 0
    network = OccupancyNetwork(code, encoder, decoder, latent)
    kept = {k: v for k, v in state.items() if not k.startswith("encoder_latent.")}
    counts = {k: v for k, v in network.state_dict().items() if k.endswith("num_batches_tracked")}
    network.load_state_dict({**counts, **kept})  # checkpoints of old torch do not count batches
    return network.eval()


@dataclass(frozen=True)
class ExtractConfig:
    """How finely the surface is searched: as MOVER runs it."""

    coarse: Annotated[int, int_in(2, 1024)] = 32
    """Cells along a side at first."""
    levels: Annotated[int, int_in(0, 8)] = 2
    """How often cells are halved near the surface."""
    threshold: Annotated[float, float_in(1e-6, 1 - 1e-6)] = 0.2
    """Probability of the surface."""


def extract(inside: Inside, config: ExtractConfig) -> Mesh:
    """The surface of logits in the unit cube, found cell by cell where they change sign.

    Raises:
        ValueError: If nothing is inside.
    """
    import igl

    limit = float(np.log(config.threshold) - np.log1p(-config.threshold))
    field = refined(lambda p: inside(p) - limit, config)
    if not bool((field > 0).any()):
        raise ValueError("extract: nothing is inside")
    padded = torch.nn.functional.pad(field, (1,) * 6, value=OUTSIDE).double().numpy()
    n = padded.shape[0]
    axis = np.arange(n, dtype=np.float64)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")  # x runs fastest, as igl has it
    grid = np.stack([x.ravel(), y.ravel(), z.ravel()], -1)
    values = np.maximum(padded, -20.0).transpose(2, 1, 0).ravel()
    points, faces, _ = igl.marching_cubes(-values, grid, n, n, n, isovalue=0.0)
    verts = (torch.from_numpy(np.asarray(points)) - 1) * (PADDING / (n - 3)) - PADDING / 2
    return Mesh(verts.float(), torch.from_numpy(np.asarray(faces, dtype=np.int64)))


def refined(field: Inside, config: ExtractConfig) -> Float[Tensor, "n n n"]:
    """Values on the finest grid; away from the surface they are interpolated from coarser ones.

    Cells whose corners differ in sign are halved. Where a new value changes the sign of a cell that
    was taken for uniform, its corners are evaluated, too, until nothing changes: what hangs
    together with anything found is found wholly.
    """
    cells, axis = config.coarse, torch.arange(config.coarse + 1)
    values = _evaluated(field, torch.cartesian_prod(axis, axis, axis), cells)
    values = values.reshape(cells + 1, cells + 1, cells + 1)
    for _ in range(config.levels):
        split = _mixed(values)
        for dim in range(3):
            split = split.repeat_interleave(2, dim)
        cells *= 2
        values = torch.nn.functional.interpolate(
            values[None, None], size=(cells + 1,) * 3, mode="trilinear", align_corners=True
        )[0, 0]
        known = torch.zeros_like(values, dtype=torch.bool)
        known[::2, ::2, ::2] = True
        wanted = _corners(split) & ~known
        while bool(wanted.any()):
            values[wanted] = _evaluated(field, wanted.nonzero(), cells)
            known = known | wanted
            wanted = _corners(_mixed(values)) & ~known
    return values


def _evaluated(
    field: Inside, index: Int[Tensor, "points 3"], cells: int
) -> Float[Tensor, " points"]:
    """The field at grid points."""
    points = index.float() * (PADDING / cells) - PADDING / 2
    return torch.cat([field(part) for part in points.split(AT_ONCE)])


def _mixed(values: Float[Tensor, "n n n"]) -> Bool[Tensor, "m m m"]:
    """Cells whose corners differ in sign."""
    inside = (values > 0)[None, None].float()
    most = torch.nn.functional.max_pool3d(inside, 2, stride=1)
    least = -torch.nn.functional.max_pool3d(-inside, 2, stride=1)
    return (most != least)[0, 0]


def _corners(cells: Bool[Tensor, "m m m"]) -> Bool[Tensor, "n n n"]:
    """Grid points that are corners of the cells."""
    padded = torch.nn.functional.pad(cells[None, None].float(), (1,) * 6)
    return torch.nn.functional.max_pool3d(padded, 2, stride=1)[0, 0] > 0


def occupied_mesh(
    network: OccupancyNetwork, mesh: Mesh, config: ExtractConfig | None = None
) -> Mesh:
    """What the network makes of a mesh: closed, in the same box.

    The points that it sees are spread evenly over the surface, in the axes and the size of its
    training data (ShapeNet's: our x and z change places, the longest side is one).

    Raises:
        ValueError: If the network finds nothing inside.
    """
    source = used(mesh)
    low, high = box(source.verts)
    middle, longest = (low + high) / 2, (high - low).max()
    points, _ = sample_surface(source, POINTS)
    cloud = ((points - middle) / longest).float().flip(-1)
    with torch.no_grad():
        code = network.encoder(cloud[None])
        found = extract(lambda p: network.decoder(p[None], code)[0], config or ExtractConfig())
    verts, faces = found.verts.flip(-1), found.faces.flip(-1)  # the change of axes is a mirror
    return fit_box(Mesh(verts.to(mesh.verts), faces), low, high)
