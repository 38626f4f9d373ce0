"""From keypoints to bodies: the batch fit of a whole video."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies import BodyModel
from mover.bodies.keypoints import LAYOUTS
from mover.bodies.skinning import shaped, widths_of
from mover.bodies.smpl_model import FLAT, Model, SmplBody, growth_of, skin_of_model
from mover.core.observe import Observer, Step, silent
from mover.core.records import record, rows_of
from mover.core.types import Bodies, BodyPose, Camera, Keypoints
from mover.fitting.config import FitConfig, Stage
from mover.fitting.energy import Seen, Weighed, body_energy
from mover.fitting.given import begin_from
from mover.fitting.ground import (
    distances_of_lying_people,
    plane_of,
    sole_heights,
    soles_of,
    standing_share,
)
from mover.fitting.noise import Bias, at_most, bias_of, noise_of, noisy, without
from mover.fitting.offsets import lasting_of
from mover.fitting.prior import ANGLES, PosePrior, encoded
from mover.fitting.start import FitStart, begin
from mover.fitting.stature import UNKNOWN, stature_of
from mover.fitting.tracks import (
    Window,
    at_stage,
    chosen,
    confidence_of,
    joint_speed,
    seen_at_all,
    seen_of,
    stages_of,
    tracks_of,
    triples_of,
    usable_rows,
    windows_of,
)
from mover.fitting.unknowns import (
    EVERYTHING,
    HAND,
    OF_ROWS,
    Frame,
    Rig,
    Unknowns,
    floor_of,
    grown,
    hand_angles,
    log_depth,
    pelvis_of,
    points_of,
    rig_of,
    solve,
    turns_of,
)
from mover.geometry.camera import project
from mover.geometry.rotations import rotation_vectors

SHAPES = 10
EXPRESSION = 10


@dataclass(frozen=True)
class FitInputs:
    """What bodies are fitted to, and with what."""

    keypoints: Keypoints
    camera: Camera
    """The true lens; its rotation is the first guess of upright."""
    model: Model
    start: Bodies | None = None
    """Bodies of another tool in the camera frame, with parameters."""
    prior: PosePrior = ANGLES
    ground: float | None = None
    """Height of the floor in the camera's world [m], where it is known: no person goes below it."""
    heights: tuple[float, ...] = ()
    """How tall each person is, in the order of their numbers, or one for everybody [m]."""


@record
class Fitted:
    """Bodies in the camera frame, and how well they explain the keypoints."""

    bodies: Bodies
    rows: Int[Tensor, " bodies"]
    """The row of the keypoints of each body."""
    miss: Float[Tensor, " bodies"]
    """Root mean square distance of the keypoints that are seen [px]."""
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _BodyFit:
    """A fit under way."""

    inputs: FitInputs
    config: FitConfig
    rig: Rig
    names: list[str]
    seen: Seen
    observe: Observer


def fit_bodies(
    inputs: FitInputs, config: FitConfig | None = None, observe: Observer = silent
) -> Fitted:
    """Fit a body model to the keypoints of a video: E_Body of the paper.

    Raises:
        InputError: If no row has enough keypoints.
    """
    config = config or FitConfig()
    rows, warnings = usable_rows(inputs.keypoints, config)
    stature = stature_of(inputs.model, inputs.heights, inputs.keypoints.person, rows)
    some = rows_of(inputs.keypoints, rows)
    inputs = dataclasses.replace(inputs, keypoints=some)
    rig = rig_of(inputs.model, some.layout, seen_at_all(some, config))
    names = [LAYOUTS[some.layout][k] for k in rig.keypoints.tolist()]
    seen = seen_of(some, rig, inputs.camera, config)
    seen = dataclasses.replace(seen, floor=inputs.ground)
    job = _BodyFit(inputs, config, rig, names, seen, observe)
    start = _start_of(job)
    lasting = lasting_of(names) if config.lasting else None
    seen = dataclasses.replace(seen, stature=stature, lasting=lasting)
    job = dataclasses.replace(job, seen=seen)
    at, frame, seen = _solved(start, job)
    pose = pose_of(at, frame, inputs.model, inputs.prior)
    miss = miss_of(at, frame, seen, inputs.prior)
    bodies = bodies_of(pose, inputs.model, some)
    spread = UNKNOWN if bool(stature.given.isnan().any()) else 0.0
    bodies = dataclasses.replace(bodies, size_spread=spread)
    return Fitted(bodies, rows, miss, warnings)


def _start_of(job: _BodyFit) -> FitStart:
    """From given bodies, or from keypoints alone; the code is that of the prior."""
    inputs = job.inputs
    if inputs.start is None:
        start = begin(inputs.keypoints, job.seen, job.rig, inputs.camera, job.config)
    else:
        start = begin_from(inputs.start, inputs.keypoints, job.seen, job.rig, job.config)
    code = encoded(inputs.prior, start.at.code)
    return dataclasses.replace(start, at=dataclasses.replace(start.at, code=code))


def _solved(start: FitStart, job: _BodyFit) -> tuple[Unknowns, Frame, Seen]:
    """All rows; the shapes first from some of them where there are too many at once."""
    seen = dataclasses.replace(job.seen, centre=start.centre, spread=start.spread)
    people, person = job.inputs.keypoints.person.unique(return_inverse=True)
    at = dataclasses.replace(start.at, **_widened(start.at, len(people), job))
    frame = Frame(job.rig, start.root, person, growth_of(job.inputs.model))
    seen, at = _on_a_floor(seen, at, frame, job)
    windows = windows_of(job.inputs.keypoints, job.config)
    first = _stages(at, frame, seen, windows[0], (job, EVERYTHING))
    bias, parts = _bias(first, job), [first.at]
    if len(windows) > 1:
        shared = {name: getattr(first.at, name) for name in ("betas", "offset", "floor")}
        at = dataclasses.replace(at, **shared)
        windows = windows[1:]
        parts = [_stages(at, frame, seen, window, (job, OF_ROWS)).at for window in windows]
    fields = {
        name: torch.cat([getattr(p, name)[w.keep] for p, w in zip(parts, windows, strict=True)])
        for name in OF_ROWS
    }
    back = torch.argsort(torch.cat([w.rows[w.keep] for w in windows]))
    fields = {name: value[back] for name, value in fields.items()}
    at = dataclasses.replace(parts[0], **fields)
    at = at if bias is None else without(at, bias, frame.person)
    return at, frame, seen


def _on_a_floor(seen: Seen, at: Unknowns, frame: Frame, job: _BodyFit) -> tuple[Seen, Unknowns]:
    """With a floor that is sought, first level and below the feet."""
    if not job.config.stands:
        return seen, at
    soles, decode = soles_of(job.inputs.model), job.inputs.prior.decode
    with torch.no_grad():
        low = sole_heights(points_of(at, frame, decode).joints, soles, seen.up)
    level = low.median() if seen.floor is None else low.new_tensor(seen.floor)
    floor = torch.stack([torch.zeros_like(level), torch.zeros_like(level), level])
    return dataclasses.replace(seen, soles=soles), dataclasses.replace(at, floor=floor)


def _widened(at: Unknowns, people: int, job: _BodyFit) -> dict[str, Tensor]:
    """Shapes of all people, and hands and faces where they are seen and the model has them."""
    rows, model = len(at.turn), job.inputs.model
    skin = job.rig.skin
    shapes = min(SHAPES, skin.shape_dirs.shape[-1])
    hands, face = 0, 0
    full = len(skin.parents) > 24
    if full and any("index" in name for name in job.names):
        space = getattr(model, "hands", None)
        hands = HAND if space is None else min(job.config.hands, space.components.shape[1])
    if len(skin.parents) == 55 and any(n.startswith("face_") for n in job.names):
        face = 3 + min(EXPRESSION, getattr(model, "expression_dirs").shape[-1])  # noqa: B009
    return {
        "betas": at.place.new_zeros(people, shapes),
        "hands": at.place.new_zeros(rows, 2 * hands),
        "face": at.place.new_zeros(rows, face),
        "offset": at.place.new_zeros(people, 0 if job.seen.lasting is None else len(job.names), 3),
    }


@dataclass(frozen=True)
class _Lowered:
    """What all stages make of some rows."""

    at: Unknowns
    seen: Seen
    """What they were fitted to at last."""
    frame: Frame
    noise: Float[Tensor, " bodies"] | None
    """Of the keypoints [px]; None: as assumed."""


def _stages(
    at: Unknowns, frame: Frame, seen: Seen, window: Window, what: tuple[_BodyFit, tuple[str, ...]]
) -> _Lowered:
    """All stages over some of the rows."""
    job, free = what
    rows, stages = window.rows, stages_of(job.config, job.names)
    some = rows_of(job.inputs.keypoints, rows)
    at = dataclasses.replace(at, **{name: getattr(at, name)[rows] for name in OF_ROWS})
    frame = dataclasses.replace(frame, root=frame.root[rows], person=frame.person[rows])
    seen = chosen(seen, rows, triples_of(some, _speed(at, frame, some, job), job.config))
    noise = None
    for index, stage in enumerate(stages):
        seen = _standing(at, frame, seen, job)
        if index == 1 and job.config.left:
            quick = dataclasses.replace(stage, steps=job.config.noise_steps)
            at = _lowered(at, frame, seen, (job, quick, free))
            off = _seen_at(at, frame, seen, job) - seen.pixels
            noise = noise_of(off, seen, frame.person, job.config.left)
            seen = at_most(seen, noise, stage.pose)
        at = _lowered(at, frame, seen, (job, stage, free))
        at, seen = _laid(at, frame, some, seen, job)
        if seen.about is not None:  # not jointly: the lying bodies moved the upright ones
            at = _lowered(at, frame, seen, (job, stage, OF_ROWS))
        job.observe(Step("fit_bodies", index, len(stages)))
    return _Lowered(at, seen, frame, noise)


def _lowered(
    at: Unknowns, frame: Frame, seen: Seen, what: tuple[_BodyFit, Stage, tuple[str, ...]]
) -> Unknowns:
    """Minimise E_Body of one stage."""
    job, stage, free = what
    by = Weighed(stage, job.config, job.inputs.prior.decode, job.inputs.prior.width > 0)
    observed = at_stage(seen, job.names, stage)
    return solve(lambda u: body_energy(u, frame, observed, by), at, stage.steps, free)


def _seen_at(at: Unknowns, frame: Frame, seen: Seen, job: _BodyFit) -> Tensor:
    """Where the keypoints of bodies are in the image [px]."""
    with torch.no_grad():
        return project(points_of(at, frame, job.inputs.prior.decode).keypoints, seen.K)


def _bias(found: _Lowered, job: _BodyFit) -> Bias | None:
    """What noise did to shapes and distances; None: not known."""
    if found.noise is None:
        return None
    person, stage = found.frame.person, stages_of(job.config, job.names)[-1]
    pixels = noisy(_seen_at(found.at, found.frame, found.seen, job), found.noise)
    seen = dataclasses.replace(found.seen, pixels=pixels)
    quick = dataclasses.replace(stage, steps=job.config.noise_steps)
    again = _lowered(found.at, found.frame, seen, (job, quick, EVERYTHING))
    left = noise_of(_seen_at(again, found.frame, seen, job) - pixels, seen, person, job.config.left)
    share = (found.noise / left.clamp_min(1e-6)).square().clamp_max(1)
    return bias_of(found.at, again, person, share)


def _standing(at: Unknowns, frame: Frame, seen: Seen, job: _BodyFit) -> Seen:
    """What is seen, with the bodies that their legs carry, as they are now."""
    if not job.config.balance or not at.floor.numel():
        return seen
    with torch.no_grad():
        joints = points_of(at, frame, job.inputs.prior.decode).joints
        up, _ = plane_of(floor_of(at, frame), seen.up, seen.floor)
    return dataclasses.replace(seen, standing=standing_share(joints, up))


def _laid(
    at: Unknowns, frame: Frame, keypoints: Keypoints, seen: Seen, job: _BodyFit
) -> tuple[Unknowns, Seen]:
    """Move people who lie along the view to their expected distance."""
    if keypoints.fps is None or not job.config.lies:
        return at, seen
    with torch.no_grad():
        joints = points_of(at, frame, job.inputs.prior.decode).joints
    tracks = tracks_of(keypoints.frame, keypoints.person)
    about = distances_of_lying_people(joints, seen.up, tracks, keypoints.frame / keypoints.fps)
    free = about.isnan()
    if bool(free.all()):
        return at, seen
    about = about - grown(at, frame)[frame.person]
    depth = torch.where(free, at.place[:, 2], about)
    place = torch.cat([at.place[:, :2], depth[:, None]], -1)
    return dataclasses.replace(at, place=place), dataclasses.replace(seen, about=about)


def _speed(
    at: Unknowns, frame: Frame, keypoints: Keypoints, job: _BodyFit
) -> Float[Tensor, "rows joints"] | None:
    """How fast joints seem to move across the view [m/s]; None without a frame rate."""
    if keypoints.fps is None:
        return None
    there = confidence_of(keypoints, job.config) > 0
    pixels = joint_speed(keypoints, there).to(at.place)
    return pixels * log_depth(at, frame).exp()[:, None] / job.seen.K[0, 0]


# What was solved, as bodies.


CHUNK = 128  # rows that are posed at once


def pose_of(at: Unknowns, frame: Frame, model: Model, prior: PosePrior) -> BodyPose:
    """Parameters of the fitted bodies."""
    angles = prior.decode(at.code)
    skin = skin_of_model(model)
    assert skin is not None
    width = widths_of(skin)["body_pose"]
    body = torch.cat([angles, angles.new_zeros(len(angles), width - angles.shape[1])], -1)
    betas = at.betas[frame.person]
    rest = shaped(skin, betas)[1][:, 0]
    extra: dict[str, Tensor] = {}
    if at.face.shape[1]:
        extra = {"jaw_pose": at.face[:, :3], "expression": at.face[:, 3:]}
    if at.face.shape[1] and isinstance(model, SmplBody):
        count = at.face.shape[1] - 3
        dirs = model.expression_joint_dirs[0, :, :count].to(rest)
        rest = rest + at.face[:, 3:] @ dirs.mT
    if at.hands.shape[1]:
        extra["left_hand_pose"], extra["right_hand_pose"] = (
            hand_angles(frame.rig, at.hands, side) for side in (0, 1)
        )
        extra[FLAT] = body.new_ones(len(body), 1)
    return BodyPose(
        model=model.name,
        gender=model.gender if isinstance(model, SmplBody) else "neutral",
        betas=betas,
        global_orient=rotation_vectors(turns_of(at, frame, angles)[:, 0]),
        body_pose=body,
        transl=pelvis_of(at, frame) - rest,
        extra=extra,
    )


def bodies_of(pose: BodyPose, model: BodyModel, keypoints: Keypoints) -> Bodies:
    """Meshes and joints, in the camera frame."""
    with torch.no_grad():
        parts = [
            model.posed(rows_of(pose, rows)) for rows in torch.arange(len(pose.transl)).split(CHUNK)
        ]
    return Bodies(
        verts=torch.cat([verts for verts, _ in parts]),
        faces=model.faces,
        joints=torch.cat([joints for _, joints in parts]),
        joint_names=model.joint_names,
        frame=keypoints.frame,
        person=keypoints.person,
        fps=keypoints.fps,
        space="camera",
        pose=pose,
    )


def miss_of(at: Unknowns, frame: Frame, seen: Seen, prior: PosePrior) -> Float[Tensor, " bodies"]:
    """Root mean square distance of the keypoints that are seen from their projections [px]."""
    with torch.no_grad():
        pixels = project(points_of(at, frame, prior.decode).keypoints, seen.K)
    there = (seen.weight > 0).to(pixels)
    squared = (pixels - seen.pixels).square().sum(-1) * there
    return (squared.sum(1) / there.sum(1).clamp_min(1)).sqrt()
