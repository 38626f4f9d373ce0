"""One file for each term of the objective: its evidence, how it is gathered, its price."""

from typing import Literal

Form = Literal["paper", "release", "robust"]
"""How a term is priced: as printed, as in the authors' released code, or normalised and robust."""
