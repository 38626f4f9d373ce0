"""What a longer video gives, in accuracy and in time, and whether it is the interactions."""

import math
import statistics
from collections.abc import Sequence

from mover_bench.studies.compare import Interval, interval, markdown, paired_rooms
from mover_bench.studies.finished import Finished, Source, by_room, value_of
from mover_bench.studies.plots import Line, Panel, draw_panels
from mover_bench.studies.study_rows import Ask, Page, Plan
from mover_bench.studies.variants import LENGTHS, SEGMENTS, SHARES
from mover_bench.tables import published

PLACING = ("place_objects", "find_image_cues", "refine_camera")  # stages that optimise
WHOLE = "whole"
Segment = tuple[int, float]  # distinct interactions, IoU3D


def length_plan(ask: Ask) -> Plan:
    """Ten segments of each length, and the whole video."""
    return [(ask.rooms, name) for s in LENGTHS for name in _names(s)] + [(ask.rooms, "robust")]


def _names(seconds: int) -> tuple[str, ...]:
    return tuple(f"{seconds}s-{k}" for k in range(SEGMENTS))


def length(ask: Ask, finished: Finished) -> Page:
    """The paper's table of video lengths: mean, and standard deviation over the segments."""
    seeds = ask.seeds[ask.rooms]
    whole = by_room(finished, Source(ask.rooms, ("robust",)), "iou3d", seeds)
    rows: list[list[str]] = []
    points: list[tuple[float, Interval]] = []
    for seconds in LENGTHS:
        values = by_room(finished, Source(ask.rooms, _names(seconds)), "iou3d", seeds)
        if values:
            points.append((seconds, interval(list(values.values()))))
        rows.append([f"{seconds} s", *_length_cells(ask, finished, seconds, values, whole)])
    last = interval(list(whole.values())) if whole else None
    count = "-" if last is None else str(last.rooms)
    rows.append([WHOLE, "-" if last is None else f"{last.mean:.3f}", "-", "-", count])
    for label, (mean, spread) in published.LENGTH.items():
        deviation = "-" if spread is None else f"{spread:.3f}"
        rows.append([f"*MOVER, {label}* (paper)", f"{mean:.3f}", deviation, "-", "10"])
    head = ["", "IoU3D ↑", "std over segments ↓", "difference from the whole video", "rooms"]
    if last is not None and points:
        points.append((_seconds(ask, finished), last))
    line = Line(
        "robust", tuple((x, y.mean) for x, y in points), tuple((y.low, y.high) for _, y in points)
    )
    note = f"Means over {SEGMENTS} segments a room, evenly spread over its video."
    table = f"## Length of the video\n\n{note}\n\n{markdown(head, rows)}"
    return Page((), [table], {"video-length": draw_panels([_plot([line])])})


def _plot(lines: Sequence[Line]) -> Panel:
    return Panel("Length of the video", "s", "IoU3D", tuple(lines))


def _seconds(ask: Ask, finished: Finished) -> float:
    """Mean length of the whole videos [s]."""
    return _mean(
        [
            tree["seconds"]
            for seed in ask.seeds[ask.rooms]
            if (tree := finished.of(ask.rooms, seed, "robust")) is not None
        ]
    )


def _length_cells(
    ask: Ask, finished: Finished, seconds: int, values: dict[int, float], whole: dict[int, float]
) -> list[str]:
    if not values:
        return ["-", "-", "-", "0"]
    spreads = [
        statistics.stdev(y for _, y in segments_of(ask, finished, seconds, [seed]))
        for seed in values
    ]
    difference, found = "-", paired_rooms(values, whole)
    if found is not None:
        difference = f"{found.mean:+.3f} [{found.low:+.3f}, {found.high:+.3f}]"
    mean, spread = (sum(x) / len(x) for x in (list(values.values()), spreads))
    return [f"{mean:.3f}", f"{spread:.3f}", difference, str(len(values))]


def segments_of(ask: Ask, finished: Finished, seconds: int, seeds: Sequence[int]) -> list[Segment]:
    """Interactions and IoU3D of all segments of a length that are done."""
    return [
        (int(tree["interactions"]), value)
        for seed in seeds
        for name in _names(seconds)
        if (tree := finished.of(ask.rooms, seed, name)) is not None
        and (value := value_of(tree, "full", "iou3d")) is not None
    ]


def interactions(ask: Ask, finished: Finished) -> Page:
    """IoU3D against how many different interactions a segment of one length shows."""
    seeds, sections, lines = ask.seeds[ask.rooms], list[str](), list[Line]()
    for seconds in LENGTHS:
        groups = _groups(ask, finished, seconds)
        rows = [
            [str(n), f"{_mean([v for v, _ in found]):.3f}",
             f"{_mean([d for _, d in found]):+.3f}", str(len(found))]
            for n, found in sorted(groups.items())
        ]  # fmt: skip
        slopes = [
            slope
            for seed in seeds
            if (slope := slope_of(segments_of(ask, finished, seconds, [seed]))) is not None
        ]
        told = "No room has segments with different counts."
        if slopes:
            found = interval(slopes)
            told = (
                f"Within a room, one interaction more changes IoU3D by {found.mean:+.4f}"
                f" [{found.low:+.4f}, {found.high:+.4f}] ({found.rooms} rooms)."
            )
        head = ["interactions", "IoU3D ↑", "above the room's mean ↑", "segments"]
        sections.append(f"## Segments of {seconds} s\n\n{markdown(head, rows)}\n\n{told}")
        points = tuple((n, _mean([d for _, d in g])) for n, g in sorted(groups.items()))
        lines.append(Line(f"{seconds} s", points))
    panel = Panel(
        "Interactions in a segment", "number", "IoU3D above the room's mean", tuple(lines)
    )
    return Page((), sections, {"interactions": draw_panels([panel])})


def _groups(ask: Ask, finished: Finished, seconds: int) -> dict[int, list[tuple[float, float]]]:
    """By count: (IoU3D, IoU3D above the mean of the room's segments of this length)."""
    groups: dict[int, list[tuple[float, float]]] = {}
    for seed in ask.seeds[ask.rooms]:
        found = segments_of(ask, finished, seconds, [seed])
        mean = _mean([y for _, y in found]) if found else 0.0
        for count, value in found:
            groups.setdefault(count, []).append((value, value - mean))
    return groups


def slope_of(found: Sequence[Segment]) -> float | None:
    """Least-squares change of IoU3D with one interaction more; None: all have as many."""
    if not found:
        return None
    x0, y0 = _mean([x for x, _ in found]), _mean([y for _, y in found])
    spread = sum((x - x0) ** 2 for x, _ in found)
    return sum((x - x0) * (y - y0) for x, y in found) / spread if spread else None


def time_plan(ask: Ask) -> Plan:
    """Growing parts of one video, nothing taken from other jobs."""
    return [(ask.rooms, f"time-{share:g}") for share in SHARES]


def time(ask: Ask, finished: Finished) -> Page:
    """Time to place the objects against the number of frames, which it should not grow with."""
    rows, placing, gathering = list[list[str]](), list[Interval](), list[Interval]()
    frames: list[float] = []
    for share in SHARES:
        trees = [finished.of(ask.rooms, s, f"time-{share:g}") for s in ask.seeds[ask.rooms]]
        done = [tree for tree in trees if tree is not None]
        if not done:
            continue
        placed = [_sum(tree["stages"], placing=True) for tree in done]
        gathered = [_sum(tree["stages"], placing=False) for tree in done]
        frames.append(_mean([tree["frames"] for tree in done]))
        placing.append(interval(placed))
        gathering.append(interval(gathered))
        rows.append([f"{frames[-1]:.0f}", _span(placing[-1]), _span(gathering[-1]), str(len(done))])
    rows += [
        [f"*{label}* (paper)", f"{60 * minutes:.0f}", "-", "-"]
        for label, minutes in published.MINUTES.items()
    ]
    head = ["frames", "optimisation [s]", "everything else [s]", "rooms"]
    note = (
        "One thread a job. Optimisation: every descent of the objects and of the camera with them."
    )
    lines = [
        Line(label, tuple((x, y.mean) for x, y in zip(frames, found, strict=True)))
        for label, found in (("optimisation", placing), ("everything else", gathering))
    ]
    panel = Panel("Time", "frames", "s", tuple(lines))
    table = f"## Time and frames\n\n{note}\n\n{markdown(head, rows)}"
    return Page((), [table], {"time": draw_panels([panel])})


def _sum(stages: Sequence[dict[str, float | str]], *, placing: bool) -> float:
    """Seconds of the stages that optimise, or of the others."""
    return math.fsum(
        float(stage["seconds"]) for stage in stages if (stage["name"] in PLACING) == placing
    )


def _span(found: Interval) -> str:
    return f"{found.mean:.1f}"


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values)
