"""Whether the soles that tell the floor are seen on a bed or a sofa, whose top would then be it.

A sole counts where its pixel lies well inside the mask of such furniture and next to its person's
visible mask: the feet of who walks behind a bed are not seen, those of who sits on it are before
it. Where the camera moves, masks of the reference image tell nothing of the other frames.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.types import Camera, Detection, People
from mover.energy.human_terms import FootContacts
from mover.furniture.library import canonical
from mover.geometry.camera import project
from mover.geometry.rle import decode

SOFT = ("bed", "sofa")
"""What people stand on; under chairs and tables feet are seen between the legs."""
WELL = 0.02  # of the image's height from the border: well inside a mask, or next to one
LEAST, SHARE = 5, 0.2  # frames, and share of those that tell the floor, that are worth a warning


def doubt_floor(
    feet: FootContacts, detections: Sequence[Detection], people: People | None, camera: Camera
) -> tuple[str, ...]:
    """A warning for each bed or sofa on which soles are seen."""
    soft = [d for d in detections if canonical(d.category) in SOFT and d.mask is not None]
    if people is None or not soft or not len(feet.frame):
        return ()
    bodies, pixels = _soles(feet, camera)
    reach = max(1, round(WELL * camera.height))
    seen = _seen(bodies, pixels, people, reach)
    frames, found = len(bodies[:, 0].unique()), list[str]()
    for one in soft:
        assert one.mask is not None
        inside = ~_around(~decode(one.mask, 0), pixels, reach)
        many = len(bodies[seen & inside, 0].unique())
        if many >= max(LEAST, SHARE * frames):
            found.append(
                f"feet are seen on a {one.category} (annotation {one.id}) in {many} of the {frames}"
                " frames that tell the floor, which may be too high: 'height' of camera.json tells"
                " where it is"
            )
    return tuple(found)


def _soles(
    feet: FootContacts, camera: Camera
) -> tuple[Int[Tensor, "bodies 2"], Float[Tensor, "bodies 2"]]:
    """Frame and person of each body that tells the floor, and the pixel of its sole."""
    keys = torch.stack([feet.frame, feet.person], -1)
    bodies, body = keys.unique(dim=0, return_inverse=True)
    total = feet.points_cam.new_zeros(len(bodies), 3).index_add(0, body, feet.points_cam)
    return bodies, project(total / torch.bincount(body)[:, None], camera.K.to(total))


def _seen(
    bodies: Int[Tensor, "bodies 2"], pixels: Float[Tensor, "bodies 2"], people: People, reach: int
) -> Bool[Tensor, " bodies"]:
    """Whose sole is next to the visible mask of its person."""
    keys = zip(people.frame.tolist(), people.person.tolist(), strict=True)
    row_of = {key: row for row, key in enumerate(keys)}
    rows = [row_of.get((frame, person)) for frame, person in bodies.tolist()]
    near = [
        row is not None and bool(_around(decode(people.masks, row), pixels[k : k + 1], reach))
        for k, row in enumerate(rows)
    ]
    return torch.tensor(near)


def _around(
    mask: Bool[Tensor, "h w"], pixels: Float[Tensor, "points 2"], reach: int
) -> Bool[Tensor, " points"]:
    """Whether a mask has a pixel in the square about each point; beyond the image there is one."""
    whole = torch.nn.functional.pad(mask, (reach,) * 4, value=True)
    size = pixels.new_tensor([mask.shape[1], mask.shape[0]])
    x, y = pixels.floor().clamp_min(0).minimum(size - 1).long().unbind(-1)
    span = torch.arange(2 * reach + 1)
    return whole[(y[:, None] + span)[:, :, None], (x[:, None] + span)[:, None]].flatten(1).any(1)
