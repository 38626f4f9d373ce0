"""Stretches of a long video that are solved one after the other."""

import dataclasses

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from ..records import record
from ..types import Keypoints
from .config import FitConfig
from .energy import Seen
from .tracks import triples_of
from .unknowns import Frame, Unknowns

MARGIN = 20  # rows of its neighbours that a stretch solves as well, at most


@record
class Window:
    """Rows that are solved together, with their neighbours in time."""

    rows: Int[Tensor, " rows"]
    keep: Bool[Tensor, " rows"]
    """Rows that are taken from this window; its neighbours have the others."""
    frame: Int[Tensor, " rows"]
    person: Int[Tensor, " rows"]
    fps: float | None


def windows_of(keypoints: Keypoints, config: FitConfig) -> list[Window]:
    """One window of all rows; or first some rows of the whole video, and then its stretches."""
    count = len(keypoints.frame)
    order = torch.argsort(keypoints.frame, stable=True)
    if count <= config.chunk:
        return [_window(order, torch.ones(count, dtype=torch.bool), keypoints)]
    spread = torch.linspace(0, count - 1, config.chunk // 2).round().long().unique()
    found = [_window(order[spread], torch.ones(len(spread), dtype=torch.bool), keypoints)]
    margin = min(MARGIN, config.chunk // 4)
    inner = max(1, config.chunk - 2 * margin)
    for first in range(0, count, inner):
        low, high = max(0, first - margin), min(count, first + inner + margin)
        place = torch.arange(low, high)
        keep = (place >= first) & (place < first + inner)
        found.append(_window(order[low:high], keep, keypoints))
    return found


def _window(rows: Tensor, keep: Tensor, keypoints: Keypoints) -> Window:
    return Window(rows, keep, keypoints.frame[rows], keypoints.person[rows], keypoints.fps)


def rows_at(
    at: Unknowns, frame: Frame, seen: Seen, window: Window, config: FitConfig
) -> tuple[Unknowns, Frame, Seen]:
    """The rows of a window."""
    rows = window.rows
    fields = {n: getattr(at, n)[rows] for n in ("turn", "code", "place", "hands", "face")}
    triples = triples_of(window.frame, window.person, window.fps, config)
    part = dataclasses.replace(
        seen,
        pixels=seen.pixels[rows],
        weight=seen.weight[rows],
        triples=triples,
        centre=seen.centre[rows],
        joints=None if seen.joints is None else seen.joints[rows],
    )
    small = Frame(frame.rig, frame.root[rows], frame.person[rows])
    return dataclasses.replace(at, **fields), small, part
