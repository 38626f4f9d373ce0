"""The parts of the fused kernel."""
