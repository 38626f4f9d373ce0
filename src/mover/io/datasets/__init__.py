"""PROX and PiGraphs as they are published."""
