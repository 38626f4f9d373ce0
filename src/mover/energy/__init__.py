"""Eq. 1: its terms, their sum, and how it is minimised."""
