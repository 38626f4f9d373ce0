"""A closed mesh from an Occupancy Network for point clouds (Mescheder et al., CVPR 2019).

The paper closes the meshes of its detector with it. The authors' checkpoints (`onet_pcl2mesh`) load
by their keys; widths are read off the file. Encoder: a ResNet-PointNet. Decoder: five residual
blocks whose batch norms take scale and shift from the shape's code. The surface is found by
multiresolution extraction and marching cubes.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import interpolate, max_pool3d, pad

from mover.core.errors import InputError
from mover.core.pickles import load_weights
from mover.core.types import Mesh
from mover.geometry.mesh import box, fit_box, sample_surface, used
from mover.geometry.topology import level_set

BLOCKS = 5
PADDING = 1.1  # side of the box around the unit cube, as MOVER runs it; so is the next
POINTS = 2048  # of the cloud that is encoded
OUTSIDE = -1e6  # logit beyond the box, so that every surface closes
AT_ONCE = 100_000  # points that the network sees
EPS = 1e-5  # of batch norms
IGNORED = re.compile(r"^encoder_latent\.|\.num_batches_tracked$")
KEYS = re.compile(
    r"(encoder\.(fc_pos|fc_c|block_[0-4]\.fc_[01])|decoder\.(fc_p|fc_z|fc_out|block[0-4]\.fc_[01])|"
    r"decoder\.(block[0-4]\.bn_[01]|bn)\.conv_(gamma|beta))\.(weight|bias)|"
    r"encoder\.block_[0-4]\.shortcut\.weight|"
    r"decoder\.(block[0-4]\.bn_[01]|bn)\.bn\.running_(mean|var)"
)
Inside = Callable[[Float[Tensor, "points 3"]], Float[Tensor, " points"]]


@dataclass(frozen=True)
class OccupancyNetwork:
    """Encoder and decoder, by the parameters of a checkpoint."""

    weights: dict[str, Tensor]

    def encode(self, cloud: Float[Tensor, "shapes points 3"]) -> Float[Tensor, "shapes code"]:
        """Code of a point cloud; each block sees its own point and the largest value of all."""
        x = self._linear("encoder.fc_pos", cloud)
        for k in range(BLOCKS):
            if k:
                x = torch.cat([x, x.amax(1, keepdim=True).expand_as(x)], -1)
            name = f"encoder.block_{k}"
            inner = self._linear(f"{name}.fc_0", x.relu()).relu()
            shortcut = x @ self.weights[f"{name}.shortcut.weight"].mT
            x = shortcut + self._linear(f"{name}.fc_1", inner)
        return self._linear("encoder.fc_c", x.amax(1).relu())

    def decode(
        self, points: Float[Tensor, "shapes points 3"], code: Float[Tensor, "shapes code"]
    ) -> Float[Tensor, "shapes points"]:
        """Logits of points being inside the shapes; a latent code, if any, is at its mean."""
        x, code = self._linear("decoder.fc_p", points), code[:, None]
        if "decoder.fc_z.bias" in self.weights:
            x = x + self.weights["decoder.fc_z.bias"]
        for k in range(BLOCKS):
            name = f"decoder.block{k}"
            inner = self._linear(f"{name}.fc_0", self._norm(f"{name}.bn_0", x, code).relu())
            x = x + self._linear(f"{name}.fc_1", self._norm(f"{name}.bn_1", inner, code).relu())
        return self._linear("decoder.fc_out", self._norm("decoder.bn", x, code).relu())[..., 0]

    def _linear(self, name: str, x: Tensor) -> Tensor:
        weight, bias = self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]
        return torch.nn.functional.linear(x, weight.flatten(1), bias)

    def _norm(self, name: str, x: Tensor, code: Tensor) -> Tensor:
        """Batch norm whose scale and shift are linear in the code."""
        mean, var = (self.weights[f"{name}.bn.running_{part}"] for part in ("mean", "var"))
        scale, shift = (self._linear(f"{name}.conv_{part}", code) for part in ("gamma", "beta"))
        return scale * (x - mean) / (var + EPS).sqrt() + shift


def load_occupancy(path: Path) -> OccupancyNetwork:
    """The network of a checkpoint (`model.pt`, `onet_pcl2mesh-*.pt`), ready for use.

    No code in the file is executed.

    Raises:
        InputError: If the file is missing, is no checkpoint of a point-cloud network, or keys are
            missing, unknown, or of another shape.
    """
    state = load_weights(path, "model", "an Occupancy Network")
    try:
        return network_of(state)
    except (KeyError, ValueError, RuntimeError, IndexError) as error:
        text = str(error).splitlines()[0][:120]
        raise InputError(
            f"{path.name}: is not an Occupancy Network for point clouds ({text}), expected "
            "pointnet_resnet and cbatchnorm, as in onet_pcl2mesh"
        ) from error


def network_of(state: dict[str, Tensor]) -> OccupancyNetwork:
    """The network whose parameters have these names and shapes.

    Raises:
        KeyError, ValueError, RuntimeError, IndexError: If it is another network's.
    """
    state = {key.removeprefix("module."): value for key, value in state.items()}
    state = {key: value for key, value in state.items() if not IGNORED.search(key)}
    unknown = [key for key in state if not KEYS.fullmatch(key)]
    if unknown:
        raise ValueError(f"unknown parameter {unknown[0]}")
    network = OccupancyNetwork(state)
    network.decode(torch.zeros(1, 1, 3), network.encode(torch.zeros(1, 2, 3)))  # else it raises
    return network


COARSE, LEVELS = 32, 2  # cells along a side at first; how often they are halved near the surface
THRESHOLD = 0.2  # probability of the surface; all three as MOVER runs it


def extract(
    inside: Inside, *, coarse: int = COARSE, levels: int = LEVELS, threshold: float = THRESHOLD
) -> Mesh:
    """The surface of logits in the unit cube, found cell by cell where they change sign.

    Raises:
        ValueError: If nothing is inside.
    """
    limit = float(np.log(threshold) - np.log1p(-threshold))
    field = refined(lambda p: inside(p) - limit, coarse, levels)
    if not bool((field > 0).any()):
        raise ValueError("extract: nothing is inside")
    padded = pad(field, (1,) * 6, value=OUTSIDE).double().numpy()
    cell = PADDING / (len(padded) - 3)
    verts, faces = level_set(-np.maximum(padded, -20.0), [-PADDING / 2 - cell] * 3, cell, 0.0)
    return Mesh(torch.from_numpy(verts).float(), torch.from_numpy(faces))


def refined(field: Inside, coarse: int, levels: int) -> Float[Tensor, "n n n"]:
    """Values on the finest grid; away from the surface they are interpolated from coarser ones.

    Cells whose corners differ in sign are halved. Where a new value changes the sign of a cell that
    was taken for uniform, its corners are evaluated, too, until nothing changes: what hangs
    together with anything found is found wholly.
    """

    def evaluated(index: Int[Tensor, "points 3"], cells: int) -> Float[Tensor, " points"]:
        points = index.float() * (PADDING / cells) - PADDING / 2
        return torch.cat([field(part) for part in points.split(AT_ONCE)])

    cells, axis = coarse, torch.arange(coarse + 1)
    values = evaluated(torch.cartesian_prod(axis, axis, axis), cells)
    values = values.reshape(cells + 1, cells + 1, cells + 1)
    for _ in range(levels):
        split = _mixed(values)
        for dim in range(3):
            split = split.repeat_interleave(2, dim)
        cells *= 2
        values = interpolate(
            values[None, None], size=(cells + 1,) * 3, mode="trilinear", align_corners=True
        )[0, 0]
        known = torch.zeros_like(values, dtype=torch.bool)
        known[::2, ::2, ::2] = True
        wanted = _corners(split) & ~known
        while bool(wanted.any()):
            values[wanted] = evaluated(wanted.nonzero(), cells)
            known = known | wanted
            wanted = _corners(_mixed(values)) & ~known
    return values


def _mixed(values: Float[Tensor, "n n n"]) -> Bool[Tensor, "m m m"]:
    """Cells whose corners differ in sign."""
    inside = (values > 0)[None, None].float()
    most, least = (sign * max_pool3d(sign * inside, 2, stride=1) for sign in (1, -1))
    return (most != least)[0, 0]


def _corners(cells: Bool[Tensor, "m m m"]) -> Bool[Tensor, "n n n"]:
    """Grid points that are corners of the cells."""
    return max_pool3d(pad(cells[None, None].float(), (1,) * 6), 2, stride=1)[0, 0] > 0


def occupied_mesh(network: OccupancyNetwork, mesh: Mesh) -> Mesh:
    """What the network makes of a mesh: closed, in the same box.

    It sees even points of the surface in the axes and the size of its training data (ShapeNet's:
    our x and z change places, the longest side is one).

    Raises:
        ValueError: If the network finds nothing inside.
    """
    source = used(mesh)
    low, high = box(source.verts)
    middle, longest = (low + high) / 2, (high - low).max()
    points, _ = sample_surface(source, POINTS)
    cloud = ((points - middle) / longest).float().flip(-1)
    with torch.no_grad():
        code = network.encode(cloud[None])
        found = extract(lambda p: network.decode(p[None], code)[0])
    verts, faces = found.verts.flip(-1), found.faces.flip(-1)  # the change of axes is a mirror
    return fit_box(Mesh(verts.to(mesh.verts), faces), low, high)
