"""The method (Sec. 3): from a capture to a consistent room, each stage kept on disk."""

from dataclasses import replace

from mover.core.run import Run as Run
from mover.core.settings import check_settings
from mover.core.types import Capture, Room
from mover.io.capture.faults import check_against_picture
from mover.io.capture.plausible import check_plausible
from mover.pipeline import objects as steps
from mover.pipeline.people import Located, check_floor, estimate_people, through_its_lens
from mover.pipeline.presets import PRESETS as PRESETS
from mover.pipeline.presets import Config as Config
from mover.pipeline.result import check_room, furnished, unfurnished
from mover.stages.objects.find_image_cues import ground_without_people


def reconstruct(capture: Capture, config: Config, run: Run, pinned: tuple[str, ...] = ()) -> Room:
    """From a capture to a consistent room; `pinned` objects stay where they start.

    Raises:
        InputError: If a setting is out of its range, the capture cannot be true, or the result.
    """
    check_settings(config, "config")
    odd: list[str] = []
    check_plausible(capture, odd.append)
    odd += check_against_picture(capture).warnings
    capture = replace(capture, warnings=tuple(dict.fromkeys((*capture.warnings, *odd))))
    given, capture = capture.scene, through_its_lens(capture, config, run, pinned)  # robust
    people = estimate_people(capture, config, run)  # frames, depth, feet: camera and ground
    if not capture.scene.objects:
        room = unfurnished(capture, people)
    elif people is None:
        room = from_image(capture, config, run, pinned)
    else:
        room = from_image_and_people(capture, people, config, run, pinned)
    return replace(check_room(room), initial=given)


def from_image(capture: Capture, config: Config, run: Run, pinned: tuple[str, ...]) -> Room:
    """Place the objects where there are no people: L_scene, the image alone."""
    setup = steps.prepare(capture, config, run, pinned)
    ground = ground_without_people(capture, setup.prepared)
    check_floor(ground, capture)
    placed = steps.place_by_image(setup, capture.scene.camera, ground)
    return furnished(setup, placed, None, None)


def from_image_and_people(
    capture: Capture, people: Located, config: Config, run: Run, pinned: tuple[str, ...]
) -> Room:
    """Place the objects by the image, then by the image and the people: Eq. 1."""
    setup = steps.facing_people(steps.prepare(capture, config, run, pinned), people)
    camera, ground = people.alignment.camera, people.alignment.ground
    placed = steps.place_by_image(setup, camera, ground)  # L_scene: the image alone
    setup = steps.with_learnt_sizes(setup, placed)
    placed = steps.refine_camera_and_objects(setup, people, placed)  # robust
    fit = steps.image_fit(setup, placed)
    people, placed = steps.estimate_scale(setup, people, placed)  # robust: one scale for all
    humans = steps.gather_humans(setup, people, placed)  # depth range, free space, contacts
    for number in range(1 + config.outer_iterations):
        if number:
            placed = steps.ordered(setup, placed)
            humans = steps.gather_humans(setup, people, placed, humans)
        setup = steps.with_seats_lifted(setup, people, placed, humans, fit)  # robust
        placed = steps.place_by_all(setup, people, placed, humans, fit)  # Eq. 1
    return furnished(setup, placed, people, humans)
