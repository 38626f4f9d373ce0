"""What a capture may ask for beyond the paper; each extension wraps the pipeline.

The pipeline and everything below it know nothing of them.
"""

from mover.core.run import Run
from mover.core.types import Capture, Room
from mover.extensions.missing_seats import with_missing_seats
from mover.extensions.moved_furniture import reconstruct_moved
from mover.extensions.moving_camera import with_metric_path
from mover.pipeline.presets import Config


def reconstruct(capture: Capture, config: Config, run: Run, pinned: tuple[str, ...] = ()) -> Room:
    """From a capture to a consistent room; `pinned` objects stay where they start.

    The path of a moving camera is taken into metres first; furniture that is moved has segments;
    seats that no detector saw are proposed.

    Raises:
        InputError: If a setting is out of its range, the capture cannot be true, or the result.
    """
    capture = with_metric_path(capture, config, run)
    room = reconstruct_moved(capture, config, run, pinned)
    return with_missing_seats(room, capture, config, run) if config.propose_seats else room
