"""Experiments on known rooms and real sets, and the tables of the paper."""
