"""Further starts of the descent: other ways in which a first scene's objects may stand."""

from collections.abc import Sequence

import torch

from ..geometry.boxes import box_of
from ..types import Layout, Objects, Piece


def other_starts(others: Sequence[Piece], objects: Objects, start: Layout) -> Layout:
    """Starts in which each object stands as its next hypothesis says.

    An object keeps its own shape, and gets the place, front and size of the hypothesis; one with
    fewer hypotheses than others stays at its start in the rest.

    Args:
        others: Hypotheses; the id of each is that of its object. Those of unknown objects are left
            out.
        objects: The furniture.
        start: Where the objects stand in the scene.

    Returns:
        As many starts as the object with most hypotheses has; none without hypotheses.
    """
    index = {name: i for i, name in enumerate(objects.ids)}
    ranks = dict.fromkeys(objects.ids, 0)
    found: list[tuple[int, int, Piece]] = []
    for piece in others:
        if piece.id in index:
            found.append((ranks[piece.id], index[piece.id], piece))
            ranks[piece.id] += 1
    count = max(ranks.values(), default=0)
    place = start.t_world_object.repeat(count, 1, 1)
    yaw, sizes = start.yaw.repeat(count, 1), start.log_scale.repeat(count, 1, 1)
    for rank, k, piece in found:
        box = box_of(piece)
        half = torch.stack([torch.zeros(()), box.size[1] / 2, torch.zeros(())])
        place[rank, k] = (box.center - half).to(place)
        yaw[rank, k] = piece.yaw.to(yaw)
        sizes[rank, k] = (box.size.to(sizes) / objects.size[k]).log()
    return Layout(place, yaw, sizes)
