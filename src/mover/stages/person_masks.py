"""Which mask belongs to which body, decoded only when it is drawn."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from ..geometry.runs import decode
from ..types import Bodies, Masks, People


@dataclass(frozen=True)
class MaskTable:
    """Rows of `people` for each body: its own mask, and those of the others in its frame."""

    masks: Masks
    own: tuple[int | None, ...]
    """None: the track has no mask in that frame, so the body says nothing about depth."""
    others: tuple[tuple[int, ...], ...]

    def decode(self, body: int) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
        """The visible mask of a body, and the union of the other people's."""
        own = self.own[body]
        blank = torch.zeros(self.masks.height, self.masks.width, dtype=torch.bool)
        rest = blank
        for row in self.others[body]:
            rest = rest | decode(self.masks, row)
        return (blank if own is None else decode(self.masks, own)), rest


def mask_table(people: People, bodies: Bodies) -> MaskTable:
    """Match masks with bodies by frame and track."""
    row_of = {
        key: row
        for row, key in enumerate(zip(people.frame.tolist(), people.person.tolist(), strict=True))
    }
    in_frame: dict[int, list[int]] = {}
    for row, frame in enumerate(people.frame.tolist()):
        in_frame.setdefault(frame, []).append(row)
    keys = list(zip(bodies.frame.tolist(), bodies.person.tolist(), strict=True))
    own = tuple(row_of.get(key) for key in keys)
    others = tuple(
        tuple(row for row in in_frame.get(frame, []) if row != mine)
        for (frame, _), mine in zip(keys, own, strict=True)
    )
    return MaskTable(people.masks, own, others)
