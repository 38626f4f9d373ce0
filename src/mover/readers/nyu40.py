"""The classes of NYU40, as SUN RGB-D and Total3D number and spell them."""

CLASSES = (
    "void", "wall", "floor", "cabinet", "bed", "chair", "sofa", "table", "door", "window",
    "bookshelf", "picture", "counter", "blinds", "desk", "shelves", "curtain", "dresser",
    "pillow", "mirror", "floor_mat", "clothes", "ceiling", "books", "refridgerator",
    "television", "paper", "towel", "shower_curtain", "box", "whiteboard", "person",
    "night_stand", "toilet", "sink", "lamp", "bathtub", "bag", "otherstructure",
    "otherfurniture", "otherprop",
)  # fmt: skip
"""NYU40's names, by class id."""
FURNITURE = (
    "cabinet", "bed", "chair", "sofa", "table", "bookshelf", "counter", "desk", "shelves",
    "dresser", "refridgerator", "television", "box", "night_stand", "toilet", "sink", "lamp",
    "bathtub", "otherfurniture",
)  # fmt: skip
"""Those that stand in a room and are worth placing."""
LIFTED = ("television", "box", "sink", "lamp")
"""What may stand on something else or hang on a wall."""
