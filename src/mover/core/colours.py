"""One colour for each object, the same in every picture of the report."""

import colorsys

PALETTE = (
    (0.298, 0.471, 0.729), (0.902, 0.561, 0.196), (0.357, 0.639, 0.322), (0.792, 0.329, 0.341),
    (0.545, 0.427, 0.745), (0.216, 0.627, 0.627), (0.827, 0.451, 0.635), (0.596, 0.447, 0.345),
    (0.694, 0.639, 0.239), (0.431, 0.533, 0.620),
)  # fmt: skip
PEOPLE = ((0.82, 0.73, 0.65), (0.66, 0.74, 0.80), (0.74, 0.80, 0.66), (0.79, 0.69, 0.79))
Colour = tuple[float, float, float]


def colour(index: int) -> Colour:
    """Colour of object `index`, in [0, 1]; indices beyond the palette get other shades of it."""
    turn, place = divmod(index, len(PALETTE))
    hue, light, saturation = colorsys.rgb_to_hls(*PALETTE[place])
    light = min(0.8, light * (1.0, 1.3, 0.72)[turn % 3])
    return colorsys.hls_to_rgb((hue + 0.035 * turn) % 1, light, saturation)


def person_colour(person: int) -> Colour:
    """Calm colour of a tracked person, in [0, 1]."""
    return PEOPLE[person % len(PEOPLE)]


def css(rgb: Colour) -> str:
    """`rgb` as CSS writes it."""
    return "#" + "".join(f"{round(255 * c):02x}" for c in rgb)
