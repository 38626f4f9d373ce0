r"""How a camera turned between two pictures, straight from their pixels.

    min_{R, z}  \sum_x  rho( I(H x) - I_0(x) ),   H = K diag(z, z, 1) R K^-1

over pyramids, by Gauss-Newton; slow changes of light are taken out of both pictures, and the
Jacobian uses the mean of both gradients (Benhimane & Malis 2004), which doubles the reach of a
step. rho is Tukey's with the scale of the median: people, who move otherwise than the room, do not
count. Four numbers (turn and zoom) instead of the eight of any homography, because the other four
follow people where they fill a part of the picture.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from ..records import record

SIDES = (60, 120, 240, 480)  # [px], larger side of the picture on each level
STEPS = 12  # most on a level
LEAST = 50  # pixels with detail, fewer tell nothing
STILL = 0.02  # [px], a step that moves no corner by more ends a level
TUKEY = 4.685  # of robust standard deviations
GAUSS = 1.4826  # standard deviation of a normal distribution over its median deviation
SAME = 0.4  # [contrast], two pixels that show the same differ by less
LIGHT = 9  # [px], what changes over more is light


FOCAL = 0.9  # of the larger side: a lens of 58 degrees, where none is known


@record
class Fit:
    """How a picture lies over the reference."""

    H: Float[Tensor, "3 3"]
    """Pixels of the picture from pixels of the reference."""
    agree: float
    """Share of the pixels with detail that are as bright as in the reference."""


def align(
    reference: Float[Tensor, "h w"],
    picture: Float[Tensor, "h w"],
    start: Float[Tensor, "3 3"],
    focal: float | None = None,
    *,
    coarsest: int = SIDES[0],
) -> Fit:
    """The homography from the reference to the picture.

    Args:
        reference: Brightness in [0, 1].
        picture: The same size.
        start: A first guess.
        focal: Of the lens [px]; it may be off by half.
        coarsest: Larger side at which to begin; the more, the nearer the guess must be [px].
    """
    at, agree = start.double(), 0.0
    h, w = reference.shape
    f = focal or FOCAL * max(h, w)
    K = torch.tensor([[f, 0, w / 2], [0, f, h / 2], [0, 0, 1]], dtype=torch.float64)
    for side in SIDES:
        scale = side / max(reference.shape)
        if scale > 1 or side < coarsest:
            continue
        small = [detailed(resized(x, scale)) for x in (reference, picture)]
        lens = torch.diag(torch.tensor([scale, scale, 1.0], dtype=torch.float64)) @ K
        at, agree = _level((small[0], small[1]), _scaled(at, scale), lens)
        at = _scaled(at, 1 / scale)
    return Fit((at / at[2, 2]).to(start), agree)


def moved(
    H: Float[Tensor, "*b 3 3"], points: Float[Tensor, "points 2"]
) -> Float[Tensor, "*b points 2"]:
    """Points under homographies."""
    flat = torch.cat([points, torch.ones_like(points[:, :1])], -1).to(H)
    image = flat @ H.mT
    return image[..., :2] / image[..., 2:]


def warp(
    picture: Float[Tensor, "h w c"], H: Float[Tensor, "3 3"], size: tuple[int, int]
) -> tuple[Float[Tensor, "h2 w2 c"], Float[Tensor, "h2 w2"]]:
    """The picture seen in the pixels of the reference, and where it is known (1) or not (0).

    Args:
        picture: What is sampled.
        H: Its pixels from those of the reference.
        size: Height and width of the reference [px].
    """
    at = moved(H.float(), centres(*size)).reshape(*size, 2)
    h, w = picture.shape[:2]
    grid = at / torch.tensor([w, h]) * 2 - 1
    sampled = torch.nn.functional.grid_sample(
        picture.permute(2, 0, 1)[None], grid[None], padding_mode="border", align_corners=False
    )
    known = ((grid.abs() < 1).all(-1)).float()
    return sampled[0].permute(1, 2, 0), known


def centres(height: int, width: int) -> Float[Tensor, "points 2"]:
    """Centres of all pixels, row by row [px]."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return torch.stack([x, y], -1).reshape(-1, 2)


def resized(picture: Float[Tensor, "h w"], scale: float) -> Float[Tensor, "h2 w2"]:
    """A smaller picture, without aliasing."""
    if scale == 1:
        return picture
    size = [max(8, round(n * scale)) for n in picture.shape]
    return torch.nn.functional.interpolate(
        picture[None, None], size, mode="bilinear", antialias=True, align_corners=False
    )[0, 0]


def detailed(picture: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """The picture without slow changes of light."""
    near = [min(LIGHT, (n - 1) // 2) for n in picture.shape]
    padded = torch.nn.functional.pad(
        picture[None, None], (near[1], near[1], near[0], near[0]), mode="reflect"
    )
    mean = torch.nn.functional.avg_pool2d(padded, (2 * near[0] + 1, 2 * near[1] + 1), stride=1)
    return picture - mean[0, 0]


def _level(
    pair: tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]], at: Tensor, K: Tensor
) -> tuple[Tensor, float]:
    """Gauss-Newton at one resolution."""
    reference, picture = pair
    h, w = reference.shape
    points, own, agree = centres(h, w), _gradient(reference), 0.0
    corners = torch.tensor([[0.0, 0], [w, 0], [0, h], [w, h]])
    basis = _basis(K, (h, w))
    for _ in range(STEPS):
        seen, known = warp(picture[..., None], at, (h, w))
        image = seen[..., 0]
        slope = ((_gradient(image) + own) / 2).reshape(-1, 2)
        steep = slope.norm(dim=-1)
        used = (known.reshape(-1) > 0) & (steep >= steep.mean())
        if int(used.sum()) < LEAST:
            return at, 0.0
        rest = (image - reference).reshape(-1)[used]
        weight = _trust(rest)
        contrast = reference.reshape(-1)[used].square().mean().sqrt()
        agree = float((rest.abs() < SAME * contrast).float().mean()) * float(known.mean())
        J = _jacobian(points[used], slope[used], (h, w)) @ basis
        JW = J * weight[:, None]
        change = _turned(_solved((JW.mT @ J).double(), -(JW.mT @ rest).double()), K)
        at = at @ change
        if float((moved(change, corners) - corners).abs().max()) < STILL:
            break
    return at, agree


def _solved(A: Tensor, b: Tensor) -> Float[Tensor, "4"]:
    """A step, also where a direction cannot be seen."""
    ridge = 1e-9 * A.diagonal().mean().clamp_min(1e-9)
    return torch.linalg.solve(A + ridge * torch.eye(4, dtype=A.dtype), b)


def _trust(rest: Float[Tensor, " pixels"]) -> Float[Tensor, " pixels"]:
    """Tukey's weights."""
    sigma = GAUSS * rest.abs().median().clamp_min(1e-3)
    return (1 - (rest / (TUKEY * sigma)).square()).clamp_min(0).square()


def _generators() -> Float[Tensor, "4 3 3"]:
    """Turns about x, y, z, and the zoom, in coordinates of a lens of focal length one."""
    G = torch.zeros(4, 3, 3, dtype=torch.float64)
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        G[k, j, i], G[k, i, j] = 1.0, -1.0
    G[3, 0, 0] = G[3, 1, 1] = 1.0
    return G


def _turned(step: Float[Tensor, "4"], K: Tensor) -> Tensor:
    """The homography of a turn and a zoom."""
    change = torch.linalg.matrix_exp((step[:, None, None] * _generators()).sum(0))
    return K @ change @ torch.linalg.inv(K)


def _basis(K: Tensor, size: tuple[int, int]) -> Float[Tensor, "8 4"]:
    """What each generator does to the eight entries of `_jacobian`."""
    h, w = size
    norm = torch.tensor([[2 / w, 0, -1], [0, 2 / h, -1], [0, 0, 1]], dtype=torch.float64)
    A = norm @ K
    moves = A @ _generators() @ torch.linalg.inv(A)
    moves = moves - moves[:, 2:, 2:] * torch.eye(3, dtype=torch.float64)
    return moves.flatten(1)[:, :8].mT.float()


def _jacobian(
    points: Float[Tensor, "points 2"], slope: Float[Tensor, "points 2"], size: tuple[int, int]
) -> Float[Tensor, "points 8"]:
    """Change of brightness with the eight entries of I + dH, in coordinates from -1 to 1."""
    h, w = size
    u, v = points[:, 0] * 2 / w - 1, points[:, 1] * 2 / h - 1
    gx, gy = slope[:, 0] * w / 2, slope[:, 1] * h / 2
    both = -(gx * u + gy * v)
    return torch.stack([gx * u, gx * v, gx, gy * u, gy * v, gy, both * u, both * v], -1)


def _gradient(picture: Float[Tensor, "h w"]) -> Float[Tensor, "h w 2"]:
    """Central differences along x and y."""
    y, x = torch.gradient(picture)
    return torch.stack([x, y], -1)


def _scaled(H: Tensor, scale: float) -> Tensor:
    """The homography of pictures that are `scale` times as large."""
    grow = torch.diag(torch.tensor([scale, scale, 1.0], dtype=H.dtype))
    return grow @ H @ torch.linalg.inv(grow)
