"""The parts of the page; a part that has nothing to show is empty."""

import math
import re
from html import escape
from importlib.resources import files

from .geometry.camera import pitch_roll
from .report_content import ReportContent
from .report_curves import draw_curves
from .report_doubts import doubts_list, draw_doubts
from .report_numbers import QUANTITIES, write_quantity
from .report_pictures import data_url, draw_comparison, shrink
from .report_plan import draw_top, extent_of
from .report_tables import (
    config_list,
    find_changes,
    metrics_table,
    objects_table,
    stage_bars,
    warnings_box,
)
from .report_view import pack_view
from .types import Scene

WIDEST = 1280  # [px], of a picture in the page
TILES = ("iou3d", "center_error", "contact_f1", "pitch_error")


def asset(name: str) -> str:
    """Text of a file that comes with the package."""
    return files("mover").joinpath("assets", name).read_text(encoding="utf-8")


def fill(name: str, **parts: str) -> str:
    """Put `parts` in the places of an asset that are marked {{so}}."""
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], asset(name))


def all_sections(content: ReportContent) -> list[str]:
    """Everything between the title and the foot of the page, in order."""
    return [
        warnings_box(content.warnings),
        _overlays(content),
        _stage(content),
        _plans(content),
        _section("How far from the truth", metrics_table(content.metrics or {})),
        _section(
            "Objects",
            objects_table(content.initial, content.result, content.objects, content.metrics),
        ),
        _section("What holds them", doubts_list(content.explanations)),
        _running(content),
    ]


def _section(title: str, body: str) -> str:
    return f"<section><h2>{title}</h2>{body}</section>" if body else ""


def lead(content: ReportContent) -> str:
    """What the run saw, in a sentence, and what it did, in another."""
    parts = [_count(len(content.result.pieces), "object")]
    if content.bodies is not None:
        parts.append(_count(len(content.bodies.person.unique()), "person", "people"))
        parts.append(_count(len(content.bodies.frame.unique()), "frame"))
    changes = sorted(c.moved for c in find_changes(content.initial, content.result).values())
    moves = f"furniture moved {100 * changes[len(changes) // 2]:.0f} cm (median)" if changes else ""
    scenes = (content.initial, content.result)
    seen = f"camera pitch {_from_to([_tilt(s) for s in scenes], '°')}"
    heights = [-s.ground for s in scenes if s.ground is not None]
    above = f", height {_from_to([f'{h:.2f}' for h in heights], ' m')}" if heights else ""
    did = "; ".join(part for part in (moves, seen + above) if part)
    return f"{', '.join(parts)}. {did[0].upper()}{did[1:]}."


def _from_to(values: list[str], unit: str) -> str:
    """The first and the last value; one alone where they are the same."""
    return " → ".join(dict.fromkeys((values[0], values[-1]))) + unit


def _tilt(scene: Scene) -> str:
    degrees = math.degrees(float(pitch_roll(scene.camera.R_cam_world)[0]))
    return f"{round(degrees, 1) + 0.0:.1f}".replace("-", "\N{MINUS SIGN}")


def _count(number: int, one: str, many: str = "") -> str:
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def tiles(content: ReportContent) -> str:
    """The few numbers that matter most, before and after."""
    before, after = ((content.metrics or {}).get(k) or {} for k in ("initial", "result"))
    cards = [
        f"<div><dt>{escape(QUANTITIES[k].label)}</dt>"
        f"<dd><small>{write_quantity(k, before.get(k), False)} →</small> "
        f"{write_quantity(k, after.get(k))}</dd></div>"
        for k in TILES
        if k in after
    ]
    return f'<dl class="tiles">{"".join(cards)}</dl>' if cards else ""


def _overlays(content: ReportContent) -> str:
    pictures = draw_comparison(content.image, content.initial, content.result, WIDEST)
    return _section("On the image", pictures)


def _stage(content: ReportContent) -> str:
    """The frame around the 3D view: what can be switched on in it."""
    switches = (
        ("people", "People", content.peopled, " checked"),
        ("truth", "Truth", content.truth is not None, ""),
        ("photo", "Photo", content.image is not None, " checked"),
        ("labels", "Names", True, " checked"),
    )
    boxes = "".join(
        f'<label><input type="checkbox" data-show="{key}"{on}> {name}</label>'
        for key, name, there, on in switches
        if there
    )
    worlds = (
        '<div class="choice" role="group" aria-label="Which scene">'
        '<button type="button" data-world="initial">Before</button>'
        '<button type="button" data-world="result">After</button></div>'
    )
    time = fill("report_time.html") if content.peopled else ""
    return fill("report_stage.html", worlds=worlds, checks=boxes, time=time)


def data(content: ReportContent) -> str:
    """The 3D view's data, and the clean image for its camera."""
    scenes = {"initial": content.initial, "result": content.result, "truth": content.truth}
    people = {"initial": content.initial_bodies, "result": content.bodies}
    view = pack_view(
        {name: scene for name, scene in scenes.items() if scene is not None},
        {name: bodies for name, bodies in people.items() if bodies is not None},
    )
    photo = ""
    if content.image is not None:
        photo = f'<img id="photo" hidden alt="" src="{data_url(shrink(content.image, WIDEST))}">'
    return (
        f'{photo}<script type="application/json" id="view-data">{view.text}</script>'
        f'<script type="text/plain" id="view-block">{view.block}</script>'
    )


def _plans(content: ReportContent) -> str:
    scenes = [content.initial, content.result, content.truth]
    extent = extent_of(*scenes, content.initial_bodies, content.bodies)
    sides = (
        ("Before", content.initial, content.initial_bodies, ""),
        ("After", content.result, content.bodies, draw_doubts(content.explanations)),
    )
    figures = "".join(
        f"<figure><figcaption>{name}</figcaption>"
        f"{draw_top(scene, content.truth, bodies, extent=extent, over=over)}</figure>"
        for name, scene, bodies, over in sides
    )
    return _section("From above", f'<div class="plans">{figures}</div>{_key(content)}')


def _key(content: ReportContent) -> str:
    """What the signs of the plans mean."""
    dots = '<path stroke="var(--person)" stroke-width="{}" d="M4 6h0M13 6h0M22 6h0"/>'
    signs = [('<path d="M8 9L13 4L18 9"/>', "front of an object")]
    if content.truth is not None:
        signs.append(('<path stroke-dasharray="4 4" d="M0 6H26"/>', "truth"))
    if content.explanations:
        ring = '<ellipse cx="13" cy="6" rx="12" ry="5" stroke-width="1"/>'
        signs.append((ring, "90 % of where its middle is"))
    if content.peopled:
        signs += [(dots.format(5), "hips of people"), (dots.format(3), "their feet")]
    form = '<svg viewBox="0 0 26 12" class="sign" aria-hidden="true">'
    items = "".join(f"<span>{form}{sign}</svg>{name}</span>" for sign, name in signs)
    return f'<p class="key">{items}</p>'


def _running(content: ReportContent) -> str:
    """How the result was made: curves, stages, settings and the command."""
    settings, command = config_list(content.config), escape(content.command)
    parts = {
        "<h3>Energies</h3>{}": draw_curves(content.traces),
        "<h3>Stages</h3>{}": stage_bars(content.stages),
        '<h3>Command</h3><pre class="command">{}</pre>': command,
        "<details><summary>Settings</summary>{}</details>": settings,
    }
    body = "".join(frame.format(part) for frame, part in parts.items() if part)
    return f'<section class="run"><h2>How it was made</h2>{body}</section>' if body else ""
