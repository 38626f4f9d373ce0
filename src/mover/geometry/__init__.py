"""Maths on plain tensors; knows neither people nor furniture."""
