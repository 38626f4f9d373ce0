"""Pickles of other programs, read without running anything in them."""

from ..pickles import load_pickle

__all__ = ["load_pickle"]
