"""Parametric furniture: closed pieces with a known front, seat, back and top."""

from .library import PIECES, SEATS, canonical, make_piece
from .pieces import Furniture

__all__ = ["PIECES", "SEATS", "Furniture", "canonical", "make_piece"]
