"""Scenes that other tools wrote."""
