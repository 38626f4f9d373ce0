"""Objects that the user has placed for good: they price the evidence but do not move."""

import torch
from jaxtyping import Bool

from ..records import record
from ..types import Layout
from .starts import merged


@record
class Pinned:
    """Which objects are held, and where."""

    fixed: Bool[torch.Tensor, " objects"]
    layout: Layout
    """Without an axis of starts; rows that are not fixed have no meaning."""


def hold(layout: Layout, pinned: Pinned | None) -> Layout:
    """The layout with the pinned objects at their places, in every start; no gradient there."""
    if pinned is None:
        return layout
    return merged(pinned.fixed, pinned.layout, layout)
