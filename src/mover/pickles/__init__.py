"""Pickles of other programs, read as data: nothing that a file names is ever imported or called."""

from .load import load_pickle

__all__ = ["load_pickle"]
