"""scene.glb: objects as nodes, floor, camera, and people who move."""

from pathlib import Path
from typing import Literal

from ..export import write_glb
from ..records import InputError
from ..report_colours import person_colour
from ..types import Bodies
from .finished import Exported, Finished
from .glb_morph import add_morphing
from .glb_motion import Channel
from .glb_skin import Skin, add_skinned, fit_skin
from .gltf import Document
from .people import FPS, tracks_of
from .posed import motion_of, skin_of

BodyForm = Literal["auto", "skin", "morph", "none"]
FAR_OFF = 0.01  # [m]
SKIN_MISS = 0.02  # [m], the most that a skinned body may miss the result's mesh


def export_glb(finished: Finished, folder: Path, body: BodyForm = "auto") -> Exported:
    """Write the room with moving people as one binary glTF file.

    Args:
        finished: The result.
        folder: Where `scene.glb` goes.
        body: How people move: on the bones of their model (skin: small, a copy within 2 cm), by
            shapes of chosen frames (morph: those are exact), or not at all (none); auto: on bones
            where the parameters are known.

    Raises:
        InputError: If bones are asked for and there are none.
    """
    path = write_glb(finished.scene, None, folder / "scene.glb")
    bodies = finished.bodies
    if bodies is None or body == "none":
        return Exported((path,), ("no people",))
    skin = _fit(finished) if body in ("auto", "skin") else "morph was asked for"
    document = Document(path.read_bytes())
    first, step = int(bodies.frame.min()), 1 / (bodies.fps or FPS)
    notes = [f"frame {first} of the video is at 0 s, each next one {step:g} s later"]
    if isinstance(skin, str) and body == "skin":
        raise InputError(f"--body skin: {skin}")
    if isinstance(skin, str):
        notes += [] if body == "morph" else [f"people move by shapes, not on bones: {skin}"]
    else:
        notes.append(f"people move on bones, at most {1e3 * skin.miss:.0f} mm off the result")
    notes += _add_people(document, bodies, None if isinstance(skin, str) else skin)
    document.write(path)
    return Exported((path,), tuple(notes))


def _add_people(document: Document, bodies: Bodies, skin: Skin | None) -> list[str]:
    """Append everybody and the one animation; what there is to say about it."""
    channels: list[Channel] = []
    notes: list[str] = []
    animation = document.add("animations", {"name": "motion", "channels": [], "samplers": []})
    for track in tracks_of(bodies):
        tint = person_colour(track.person)
        if skin is None:
            moved, miss = add_morphing(document, animation, bodies, track, tint)
            if miss > FAR_OFF:
                notes.append(f"person {track.person}: up to {100 * miss:.1f} cm off between shapes")
        else:
            moved = add_skinned(document, animation, skin, track, tint)
        channels += moved
    _connect(document, animation, channels)
    return notes


def _fit(finished: Finished) -> Skin | str:
    """The bones that move the result's bodies, or why there are none."""
    motion = motion_of(finished)
    if isinstance(motion, str):
        return motion
    assert finished.bodies is not None
    model = skin_of(motion.pose, finished.bodies)
    if model is None:
        return f"the model {motion.pose.model!r} has no bones that are known here"
    skin = fit_skin(motion, model, finished.bodies)
    if not skin.miss <= SKIN_MISS:
        return f"its bones miss the result's meshes by {skin.miss:.3f} m"
    return skin


def _connect(document: Document, animation: int, channels: list[Channel]) -> None:
    """Fill the animation: which sampler moves which property of which node."""
    animations = document.tree["animations"]
    if not channels:
        del document.tree["animations"]
        return
    animations[animation]["channels"] = [
        {"sampler": sampler, "target": {"node": node, "path": path}}
        for sampler, node, path in channels
    ]
