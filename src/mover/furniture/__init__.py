"""Parametric furniture: closed pieces with a known front, seat, back and top."""
