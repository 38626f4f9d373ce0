"""Readers of what the paper is measured on: PROX, PiGraphs, HolisticMesh, MOVER's release."""
