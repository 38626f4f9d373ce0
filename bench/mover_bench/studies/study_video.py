"""What a longer video gives, in accuracy and in time, and whether it is the interactions."""

from mover_bench.studies.compare import Interval, interval, markdown
from mover_bench.studies.finished import SPENT, Finished, Frame, Source, by_room, rows_of
from mover_bench.studies.study_page import Line, Panel, draw_panels, gain_text
from mover_bench.studies.study_rows import Ask, Page, Plan
from mover_bench.studies.variants import LENGTHS, SEGMENTS, SHARES
from mover_bench.tables import published

WHOLE = "whole"


def length_plan(ask: Ask) -> Plan:
    """Ten segments of each length, and the whole video."""
    return [(ask.rooms, name) for s in LENGTHS for name in _names(s)] + [(ask.rooms, "robust")]


def _names(seconds: int) -> tuple[str, ...]:
    return tuple(f"{seconds}s-{k}" for k in range(SEGMENTS))


def length(ask: Ask, finished: Finished) -> Page:
    """The paper's table of video lengths: mean, and standard deviation over the segments."""
    seeds, robust = ask.seeds[ask.rooms], Source(ask.rooms, ("robust",))
    whole = by_room(finished, robust, "iou3d", seeds)
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
        points.append((rows_of(finished.scenes, robust, seeds).seconds.mean(), last))
    line = Line(
        "robust", tuple((x, y.mean) for x, y in points), tuple((y.low, y.high) for _, y in points)
    )
    note = f"Means over {SEGMENTS} segments a room, evenly spread over its video."
    table = f"## Length of the video\n\n{note}\n\n{markdown(head, rows)}"
    plot = draw_panels([Panel("Length of the video", "s", "IoU3D", (line,))])
    return Page((), [table], {"video-length": plot})


def _length_cells(
    ask: Ask, finished: Finished, seconds: int, values: dict[int, float], whole: dict[int, float]
) -> list[str]:
    if not values:
        return ["-", "-", "-", "0"]
    spreads = segments_of(ask, finished, seconds).groupby("seed").iou3d.std()[list(values)]
    mean, gain = sum(values.values()) / len(values), gain_text("iou3d", values, whole)
    return [f"{mean:.3f}", f"{spreads.mean():.3f}", gain, str(len(values))]


def segments_of(ask: Ask, finished: Finished, seconds: int) -> Frame:
    """All segments of a length that are done, with IoU3D above the mean of their room's."""
    seeds = ask.seeds[ask.rooms]
    found = rows_of(finished.scenes, Source(ask.rooms, _names(seconds)), seeds)
    found = found.dropna(subset=["iou3d"])
    return found.assign(above=found.iou3d - found.groupby("seed").iou3d.transform("mean"))


def interactions(ask: Ask, finished: Finished) -> Page:
    """IoU3D against how many different interactions a segment of one length shows."""
    sections, lines = list[str](), list[Line]()
    for seconds in LENGTHS:
        found = segments_of(ask, finished, seconds)
        groups = found.astype({"interactions": int}).groupby("interactions")
        means = groups[["iou3d", "above"]].mean().assign(count=groups.size())
        rows = [
            [str(row.Index), f"{row.iou3d:.3f}", f"{row.above:+.3f}", str(row.count)]
            for row in means.itertuples()
        ]
        head = ["interactions", "IoU3D ↑", "above the room's mean ↑", "segments"]
        sections.append(f"## Segments of {seconds} s\n\n{markdown(head, rows)}\n\n{_slope(found)}")
        lines.append(Line(f"{seconds} s", tuple(means.above.items())))
    panel = Panel(
        "Interactions in a segment", "number", "IoU3D above the room's mean", tuple(lines)
    )
    return Page((), sections, {"interactions": draw_panels([panel])})


def _slope(segments: Frame) -> str:
    """Mean of the rooms' least-squares changes of IoU3D with one interaction more."""
    slopes = [
        room.iou3d.cov(room.interactions) / room.interactions.var()
        for _, room in segments.groupby("seed")
        if room.interactions.nunique() > 1
    ]
    if not slopes:
        return "No room has segments with different counts."
    found = interval(slopes)
    return (
        f"Within a room, one interaction more changes IoU3D by {found.mean:+.4f}"
        f" [{found.low:+.4f}, {found.high:+.4f}] ({found.rooms} rooms)."
    )


def time_plan(ask: Ask) -> Plan:
    """Growing parts of one video, nothing taken from other jobs."""
    return [(ask.rooms, f"time-{share:g}") for share in SHARES]


def time(ask: Ask, finished: Finished) -> Page:
    """Time to place the objects against the number of frames, which it should not grow with."""
    names = tuple(name for _, name in time_plan(ask))
    found = rows_of(finished.scenes, Source(ask.rooms, names), ask.seeds[ask.rooms])
    groups = found.groupby("name")
    means = groups[["frames", *SPENT]].mean().assign(rooms=groups.size())
    means = means.reindex(names).dropna()
    rows = [
        [f"{frames:.0f}", f"{placing:.1f}", f"{rest:.1f}", f"{rooms:.0f}"]
        for frames, placing, rest, rooms in means.itertuples(index=False)
    ]
    rows += [
        [f"*{label}* (paper)", f"{60 * minutes:.0f}", "-", "-"]
        for label, minutes in published.MINUTES.items()
    ]
    head = ["frames", "optimisation [s]", "everything else [s]", "rooms"]
    note = (
        "One thread a job. Optimisation: every descent of the objects and of the camera with them."
    )
    lines = [Line(label, tuple(zip(means.frames, means[label], strict=True))) for label in SPENT]
    table = f"## Time and frames\n\n{note}\n\n{markdown(head, rows)}"
    plot = draw_panels([Panel("Time", "frames", "s", tuple(lines))])
    return Page((), [table], {"time": plot})
