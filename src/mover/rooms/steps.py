"""Where feet land: stations of the body along a path, and the footsteps that lead there."""

import numpy as np
from jaxtyping import Float, Int

from ..records import record
from .person import STANCE
from .turns import heading_of, left_of

STEP = 0.5  # [m], length of an indoor step
STEP_TIME = 0.5  # [s]
TURN = np.radians(40)  # [rad], of one step on the spot

Floor = Float[np.ndarray, "_ 2"]


@record
class Steps:
    """Where the feet land; the first two rows are where they stood, left then right."""

    side: Int[np.ndarray, " steps"]
    place: Float[np.ndarray, "steps 2"]
    """x and z of the ankle [m]."""
    heading: Float[np.ndarray, " steps"]
    """Of the foot [rad]."""


@record
class Stations:
    """Where the body stands when each step lands."""

    place: Float[np.ndarray, "steps 2"]
    heading: Float[np.ndarray, " steps"]


def stations(path: Floor, start: float, end: float, outer: Floor | None = None) -> Stations:
    """Turn on the spot, walk along the path, turn on the spot [rad, m].

    Args:
        path: Points on the floor (x, z).
        start: Heading at the first point.
        end: Heading at the last point.
        outer: Two places before and after the path that are reached without turning: a step out
            of a seat, and a step back into the next one.
    """
    route = _rounded(path)
    lengths = np.linalg.norm(np.diff(route, axis=0), axis=1)
    total = float(lengths.sum())
    places: list[np.ndarray] = [path[0]] if outer is None else [outer[0], path[0]]
    headings: list[float] = [start] * len(places)
    if total > 0.05:
        walked, along = _paces(route, lengths)
        _turn_to(places, headings, float(along[0]), settle=False)
        along = along + _lap(headings[-1] - along[0])
        places += list(walked[1:])
        headings += list(along[1:])
    _turn_to(places, headings, end, settle=True)
    if outer is not None:
        places.append(outer[1])
        headings.append(headings[-1])
    return Stations(np.array(places), np.array(headings))


def _paces(route: Floor, lengths: np.ndarray) -> tuple[Floor, np.ndarray]:
    """Places and headings, a step apart, along a route."""
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    goals = np.linspace(0, at[-1], max(1, int(np.ceil(at[-1] / STEP))) + 1)
    walked = np.stack([np.interp(goals, at, route[:, k]) for k in (0, 1)], -1)
    ahead = np.interp(np.minimum(goals + 0.1, at[-1]), at, np.arange(len(at)))
    segment = np.minimum(ahead.astype(int), len(lengths) - 1)
    return walked, np.unwrap(heading_of(np.diff(route, axis=0)[segment]))


def _turn_to(places: list[np.ndarray], headings: list[float], goal: float, settle: bool) -> None:
    """Append stations on the spot until the heading is (almost) `goal`."""
    turn = float((goal - headings[-1] + np.pi) % (2 * np.pi) - np.pi)
    slack = 0.0 if settle else TURN
    count = int(np.ceil(max(0.0, abs(turn) - slack) / TURN - 1e-9))
    first = headings[-1]
    share = 1.0 if settle else max(0.0, abs(turn) - slack / 2) / max(abs(turn), 1e-9)
    for k in range(count):
        places.append(places[-1])
        headings.append(first + turn * share * (k + 1) / count)


def _lap(difference: float) -> float:
    return float(2 * np.pi * np.round(difference / (2 * np.pi)))


def _rounded(path: Floor) -> Floor:
    """The path with its corners cut to arcs, sampled every 4 cm."""
    from scipy.ndimage import gaussian_filter1d

    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    count = max(2, int(at[-1] / 0.04) + 1)
    dense = np.stack([np.interp(np.linspace(0, at[-1], count), at, path[:, k]) for k in (0, 1)], -1)
    odd = 2 * np.array([dense[0], dense[-1]])
    pad = min(20, count - 1)
    long = np.concatenate([odd[0] - dense[pad:0:-1], dense, odd[1] - dense[-2 : -pad - 2 : -1]])
    return gaussian_filter1d(long, 4.0, axis=0)[pad : pad + count]


def steps_of(way: Stations) -> Steps:
    """Alternate feet on the stations, then bring the other foot beside the last."""
    places, headings = way.place, way.heading
    first = 0 if headings[-1] >= headings[0] else 1
    if len(places) > 1:
        first = 0 if headings[1] >= headings[0] else 1
    order = [(first + k) % 2 for k in range(len(places))]
    last = len(places) - 1
    rows = [(0, 0), (1, 0), *((order[k], k + 1) for k in range(last)), (order[last], last)]
    side = np.array([s for s, _ in rows])
    station = np.array([k for _, k in rows])
    out = (STANCE * (1 - 2 * side))[:, None] * left_of(headings[station])
    return Steps(side, places[station] + out, headings[station])


def duration(way: Stations) -> float:
    """Time of all steps [s]."""
    return STEP_TIME * len(way.place)
