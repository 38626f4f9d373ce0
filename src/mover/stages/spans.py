"""Ranges of the scales, and unknowns that cannot leave them (release)."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..types import Layout, Objects


def spans_of(objects: Objects, span: float, chair_span: float) -> Float[Tensor, " objects"]:
    """Range of the scale of each object, 0 where it is free."""
    spans = [chair_span if c == "chair" else span for c in objects.categories]
    return torch.tensor(spans, device=objects.size.device)


def bounded(free: Layout, span: Float[Tensor, " objects"]) -> Layout:
    """Scales s = 1 + span (sigmoid(x) - 1/2), where there is a span."""
    wide = span.unsqueeze(-1)
    scale = 1 + wide * (free.log_scale.sigmoid() - 0.5)
    return replace(free, log_scale=torch.where(wide > 0, scale.log(), free.log_scale))


def unbounded(layout: Layout, span: Float[Tensor, " objects"]) -> Layout:
    """The inverse of `bounded` (the release codes it without its denominator, by mistake)."""
    wide = span.unsqueeze(-1)
    share = (layout.log_scale.exp() - 1) / wide.clamp_min(1e-6) + 0.5
    return replace(
        layout, log_scale=torch.where(wide > 0, share.clamp(0.01, 0.99).logit(), layout.log_scale)
    )
