"""How well drawn bodies fill a mask whose border may be too wide or too narrow everywhere."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d

COVERED = 0.05  # of a pixel of the smaller picture, from which it counts as covered
MARGINS = 9  # borders from one pixel too narrow to one pixel too wide are tried


def small(mask: Bool[Tensor, "h w"], width: int) -> Float[Tensor, "small_h small_w"]:
    """Share of each pixel of a smaller picture that is set."""
    height = max(1, round(mask.shape[0] * width / mask.shape[1]))
    return interpolate(mask[None, None].float(), (height, width), mode="area")[0, 0]


def uncovered(mask: Bool[Tensor, "h w"], width: int) -> Bool[Tensor, "small_h small_w"]:
    """The pixels of a smaller picture in which next to nothing is set."""
    return small(mask, width) < COVERED


def overlaps(
    drawn: Bool[Tensor, "items h w"], mask: Float[Tensor, "h w"], known: Bool[Tensor, "h w"]
) -> Float[Tensor, " items"]:
    """Intersection over union with the mask, in the known pixels, at the best width of its border.

    A mask that is two pixels too wide all around looks like a person who is 3 % nearer, were it
    not that arms and legs grow by as much as the whole body.
    """
    image, inside = drawn.float(), mask[known]
    wide, narrow = _grown(image)[:, known], 1 - _grown(1 - image)[:, known]
    best, exact = torch.zeros(len(drawn)).to(mask), image[:, known]
    for margin in torch.linspace(-1, 1, MARGINS).tolist():  # a few; all at once is much memory
        part = exact + abs(margin) * ((wide if margin > 0 else narrow) - exact)
        both, either = torch.minimum(part, inside).sum(1), torch.maximum(part, inside).sum(1)
        best = torch.maximum(best, both / either.clamp_min(1))
    return best


def _grown(image: Float[Tensor, "items h w"]) -> Float[Tensor, "items h w"]:
    """Each pixel or the largest of its four neighbours."""
    columns = max_pool2d(image[:, None], (3, 1), 1, (1, 0))
    rows = max_pool2d(image[:, None], (1, 3), 1, (0, 1))
    return torch.maximum(columns, rows)[:, 0]
