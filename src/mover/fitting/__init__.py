"""The fit of bodies to keypoints: E_Body of the paper, in batch over the whole video."""

from .bodies import FitInputs, Fitted, fit_bodies
from .config import FitConfig
from .one_euro import OneEuroConfig, smooth_bodies, smooth_keypoints
from .vposer import load_vposer, vposer_prior

__all__ = [
    "FitConfig", "FitInputs", "Fitted", "OneEuroConfig", "fit_bodies", "load_vposer",
    "smooth_bodies", "smooth_keypoints", "vposer_prior",
]  # fmt: skip
