"""Readers of what results are measured on: PROX, PiGraphs, i3DB, HolisticMesh, MOVER's release."""
