"""People whom SAM 3D's notebooks leave beside the objects: human.ply in an OpenGL camera's axes."""

from pathlib import Path

import numpy as np

from .fields import At
from .mesh_file import KINDS, read_mesh
from .parts import Parts
from .placing import FLIP

NAMES = ("human_aligned", "human", "person", "body")


def person_parts(folder: Path) -> Parts:
    """The person of a folder as one body in frame 0; nothing where there is none.

    The notebook of the human alignment scales the person to the depth in which the objects were
    made and shifts it to its mask; such a mesh (human_aligned) comes first.

    Raises:
        InputError: If the mesh is wrong.
    """
    for name in NAMES:
        for path in sorted(p for kind in KINDS for p in folder.glob(f"{name}*{kind}")):
            mesh, _ = read_mesh(At(path.name, path.name), folder)
            arrays = {
                "vertices": (mesh.verts.double().numpy() @ FLIP)[None].astype(np.float32),
                "faces": mesh.faces.numpy(),
                "frame": np.zeros(1, dtype=np.int64),
                "person": np.zeros(1, dtype=np.int64),
                "space": np.array("camera"),
            }
            note = f"{path.name} is the person of frame 0"
            return Parts(name=folder.name, bodies=At(arrays, path.name), notes=(note,))
    return Parts(name=folder.name)
